"""What the header of a file of the pipeline says: what was exposed, and what was done to it."""

from astropy.io import fits

#: Read-out patterns by the names that they had before the launch.
READOUT_NAMES = {"FAST": "FASTR1", "SLOW": "SLOWR1"}

#: Where the light is blocked there is no filter.
_NO_FILTER = ("", "OPAQUE", "N/A", "ANY")

#: Steps of the JWST pipeline by the keywords that record them.
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

    Examples
    --------
    >>> from astropy.io.fits import Header
    >>> from miricigale.instrument import steps_done
    >>> sorted(
    ...     steps_done(
    ...         Header(
    ...             {"S_DARK": "COMPLETE", "S_LINEAR": "COMPLETE", "S_JUMP": "SKIPPED"}
    ...         )
    ...     )
    ... )
    ['dark', 'linearity']
    """
    return frozenset(
        step
        for keyword, step in STEPS.items()
        if str(header.get(keyword, "")).strip().upper() == "COMPLETE"
    )


def joined_header(hdus, name="SCI"):
    """
    Keywords of a file.

    Parameters
    ----------
    hdus : `~astropy.io.fits.HDUList`
        The file.
    name : str, optional
        Of an extension, which need not be there.

    Returns
    -------
    header : `~astropy.io.fits.Header`
        Those of the primary header, and of the extension what it lacks, but for the layout of the file.

    Examples
    --------
    >>> from astropy.io import fits
    >>> from miricigale.instrument import joined_header
    >>> primary = fits.PrimaryHDU()
    >>> primary.header["FILTER"] = "F770W"
    >>> science = fits.ImageHDU(name="SCI")
    >>> science.header["BUNIT"] = "MJy/sr"
    >>> header = joined_header(fits.HDUList([primary, science]))
    >>> header["FILTER"], header["BUNIT"]
    ('F770W', 'MJy/sr')
    """
    header = hdus[0].header.copy(strip=True)
    science = hdus[name].header.copy(strip=True) if name in hdus else fits.Header()
    for layout in ("BSCALE", "BZERO", "EXTNAME", "EXTVER", "EXTEND", "NEXTEND"):
        header.remove(layout, ignore_missing=True)
        science.remove(layout, ignore_missing=True)
    for card in science.cards:
        if card.keyword not in ("", "COMMENT", "HISTORY", *header):
            header.append(card)
    return header


def exposure_keywords(header):
    """
    What was exposed, in the names of this package.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        As `joined_header` makes it.

    Returns
    -------
    filter, readout, subarray : str or None
        None where the header says nothing; without a filter also where the light was blocked.
    dither : int
        Position in the pattern of dithers, from 0.

    Examples
    --------
    >>> from astropy.io.fits import Header
    >>> from miricigale.instrument import exposure_keywords
    >>> header = Header(
    ...     {"FILTER": "F770W", "READPATT": "FASTR1", "SUBARRAY": "FULL", "PATT_NUM": 2}
    ... )
    >>> exposure_keywords(header)
    ('miri.f770w', 'FASTR1', 'FULL', 1)
    """
    name, pattern, part = (
        str(header.get(key, "")).strip() for key in ("FILTER", "READPATT", "SUBARRAY")
    )
    return (
        None if name in _NO_FILTER else f"miri.{name.lower()}",
        READOUT_NAMES.get(pattern, pattern) or None,
        part or None,
        max(int(header.get("PATT_NUM", 1)), 1) - 1,
    )
