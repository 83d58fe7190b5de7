"""What a study simulates more than once, and what it fits of each: truths and sets of bands."""

import dataclasses

from miricigale.filters import Filter

__all__ = [
    "FIELD",
    "SETS",
    "Truth",
    "band_sets",
    "of_truth",
    "reference",
    "study_truths",
    "truth_names",
]

#: Sets of MIRI bands that join the existing ones in a fit: Yang et al. 2021, section 4.
SETS = ("all", "none", "blue", "red")
#: In place of a fracAGN: AGN as in a real field.
FIELD = "field"


@dataclasses.dataclass(frozen=True)
class Truth:
    """
    One simulated sky.

    Parameters
    ----------
    name : str
        Folder of its products and first part of its units, such as ``"agn20"``.
    frac_agn : float or "field"
        fracAGN of its sources; AGN of a realistic field (`FIELD`) are drawn from a luminosity function.
    """

    name: str
    frac_agn: float | str

    def values(self):
        """Plain values, for hashing."""
        return dataclasses.asdict(self)


def study_truths(config):
    """
    The truths of a configuration by name.

    The first is the reference: of it the prior image is made and the error functions are measured.

    Parameters
    ----------
    config : `~miricigale.workflow.StudyConfig`
        The configuration.

    Returns
    -------
    truths : dict of str to `Truth`
    """
    truths = (
        Truth(value if value == FIELD else f"agn{100 * value:02g}", value)
        for value in config.sed.frac_agn
    )
    return {truth.name: truth for truth in truths}


def truth_names(config):
    """Names of the truths."""
    return tuple(study_truths(config))


def reference(config):
    """Name of the truth that gives the prior image and the error functions."""
    return truth_names(config)[0]


def of_truth(config, unit):
    """The truth of a unit that begins with its name, as ``needs`` of a stage takes it."""
    return (unit.partition("/")[0],)


def band_sets(config):
    """
    MIRI bands of each fit.

    Parameters
    ----------
    config : `~miricigale.workflow.StudyConfig`
        The configuration, or the part of it with ``fit.sets`` and ``exposures.filters``.

    Returns
    -------
    sets : dict of str to tuple of str
        In the order of ``fit.sets``; ``blue`` is the half of the bands with the shorter
        wavelengths, ``red`` the others.
    """
    bands = tuple(config.exposures.filters)
    by_wave = sorted(bands, key=lambda name: Filter.from_name(name).pivot)
    half = (len(by_wave) + 1) // 2
    chosen = {"all": bands, "none": (), "blue": by_wave[:half], "red": by_wave[half:]}
    return {name: tuple(b for b in bands if b in chosen[name]) for name in config.fit.sets}
