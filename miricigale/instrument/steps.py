"""What the pipeline did to a file, as its header says."""

__all__ = ["STEPS", "steps_done"]

#: Steps of the JWST pipeline by the keywords that tell of them.
STEPS = {
    "S_DQINIT": "dq_init",
    "S_SATURA": "saturation",
    "S_IPC": "ipc",
    "S_FRSTFR": "firstframe",
    "S_LASTFR": "lastframe",
    "S_SUPERB": "superbias",
    "S_RESET": "reset",
    "S_LINEAR": "linearity",
    "S_RSCD": "rscd",
    "S_DARK": "dark",
    "S_REFPIX": "refpix",
    "S_JUMP": "jump",
    "S_GANSCL": "gain_scale",
    "S_RAMP": "ramp_fit",
    "S_FLAT": "flat",
    "S_BKDSUB": "background",
    "S_PHOTOM": "photom",
    "S_SKYMAT": "skymatch",
    "S_OUTLIR": "outlier",
    "S_RESAMP": "resample",
}


def steps_done(header):
    """
    Steps that a file has behind it.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        Of the primary extension.

    Returns
    -------
    steps : frozenset of str
        Names of `STEPS` whose keyword says COMPLETE.
    """
    return frozenset(
        step
        for keyword, step in STEPS.items()
        if str(header.get(keyword, "")).strip().upper() == "COMPLETE"
    )
