"""Options of a plan: frozen dataclasses from TOML, like those of a run."""

import dataclasses
from typing import ClassVar

from miricigale.depth.fitted import EXCESS
from miricigale.instrument import CEERS_FILTERS, imager_filters, readout_patterns
from miricigale.instrument.published_tables import imager_filter
from miricigale.utils.files import is_path
from miricigale.utils.options import check_that, check_type
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.workflow.analysis_sections import FitBasics
from miricigale.workflow.background import check_levels
from miricigale.workflow.earlier import EarlierKey
from miricigale.workflow.options import Configuration, Section, option, read_text
from miricigale.workflow.sections import CatalogSection, RunBasics, SedSection


class PlanSection(RunBasics):
    """What the plan is called and how it goes."""

    name: str = option(
        "plan", "Name of the plan; its folder unless --output is given.", folder=True
    )


class SampleSection(Section):
    """The galaxies of the mock photometry."""

    n_sources: int = option(
        1000,
        "Sources drawn from the catalog; 0 for all. More than it has are galaxies of "
        "several skies, with other AGN and noise.",
        low=0,
        high=1000000,
    )
    redshift: tuple[float, ...] = option((0.01, 6.0), "Range of redshifts.", low=0.0, high=20.0)
    luminosity: tuple[float, ...] = option(
        (0.0, 16.0), "Range of log10 of the dust's luminosity (Lsun).", low=0.0, high=20.0
    )
    area: float = option(
        0.0, "Area of the catalog (square arcmin); 0 for the bundled one's.", low=0.0, high=1e5
    )
    luminosity_function: str = option(
        "",
        "Table of log_luminosity, redshift, phi (per Mpc3 and dex) that the sample is drawn after.",
    )


class AgnSection(Section):
    """The mix of AGN, and how they are selected."""

    frac_agn: tuple[float, ...] = option(
        (),
        "fracAGN of a made-up mix; by default AGN are those of a column frac_agn of "
        "the catalog, or of a real field, after an X-ray luminosity function.",
        low=0.0,
        high=0.99,
        single=True,
    )
    shares: tuple[float, ...] = option(
        (),
        "Share of the sources of each fracAGN of the mix; equal ones by default.",
        low=0.0,
        high=1e6,
        single=True,
    )
    limit: float = option(0.4, "fracAGN from which a source is an AGN.", low=0.01, high=0.99)
    threshold: float = option(
        0.5,
        "Least probability of a fracAGN above the limit of a selected source.",
        low=0.0,
        high=1.0,
    )


#: Exposure times and dithers of CEERS by band.
_CEERS = {
    "time": dict.fromkeys(CEERS_FILTERS, 1665.0) | {"miri.f2100w": 4662.0},
    "dithers": dict.fromkeys(CEERS_FILTERS, 3) | {"miri.f2100w": 6},
}


class ExposureSection(Section):
    """The MIRI bands, and how long each is exposed."""

    bands: tuple[str, ...] = option(
        CEERS_FILTERS, "MIRI filters.", choices=imager_filters(), unique=True
    )
    time: tuple[float, ...] = option(
        (),
        "Exposure time (s) of each band in a pointing, all dithers; one for all. By "
        "default that of CEERS, as the dithers, and for bands that it does not have "
        "that of F770W.",
        low=0.0,
        high=1e7,
        single=True,
    )
    depth: tuple[float, ...] = option(
        (), "5-sigma AB depth of each band instead of a time.", low=10.0, high=40.0, single=True
    )
    hours: float = option(
        0.0,
        "Budget of each set of bands in hours that are charged, with overheads: its "
        "times, in the ratio of time, are as long as that allows; 0: times as they "
        "are.",
        low=0.0,
        high=1e4,
    )
    dithers: tuple[int, ...] = option((), "Dithers of each band.", low=1, high=500, single=True)
    readout: str = option("FASTR1", "Readout pattern.", choices=readout_patterns())
    max_fill: float = option(
        0.6, "Largest share of the well that the sky fills.", low=0.05, high=0.95
    )
    max_groups: int = option(100, "Largest number of groups in an integration.", low=2, high=10000)
    photom: str = option(
        "",
        "Photom reference of CRDS, for the response on a date "
        "(miricigale.reduction.imager_response).",
    )
    date: str = option(
        "",
        "That date.",
    )
    sets: tuple[str, ...] = option(
        ("all",),
        "Sets of bands that are compared: all, or names joined by commas.",
    )
    pointings: int = option(1, "Pointings side by side.", low=1, high=10000)

    def by_band(self, key):
        """Return ``"time"``, ``"depth"`` or ``"dithers"`` of each band; the default for other bands is F770W's."""
        values = getattr(self, key)
        if not values:
            survey_value = _CEERS[key]
            values = [survey_value.get(name, survey_value["miri.f770w"]) for name in self.bands]
        return tuple(values) * (len(self.bands) // len(values))


class BackgroundSection(Section):
    """The sky."""

    level: tuple[str, ...] = option(
        ("low",),
        "Zodiacal light (low, medium, high) or surface brightness ('12.5 MJy/sr'); "
        "one for all filters, or one for each.",
        single=True,
    )
    ra: float = option(-1.0, "Right ascension in degrees; -1: no position.", low=-1, high=360)
    dec: float = option(0.0, "Declination in degrees.", low=-90, high=90)
    date: str = option(
        "",
        "Day, such as 2027-03-01, instead of a level (needs zodipy).",
    )


class NoiseSection(Section):
    """Where the errors of MIRI fluxes come from."""

    residual: float | str = option(
        0.0,
        "Fraction of the sky that stays as a fixed pattern, or the calculator's.",
        low=0.0,
        high=0.1,
        choices=("etc",),
    )
    fractional: float = option(
        0.03, "Part of the flux added in quadrature (templates, blends).", low=0.0, high=1.0
    )
    excess: float | str = option(
        EXCESS["flight"],
        "Factor on the noise of the sky of fitted sources: 1.4 (flight) by the limits "
        "of surveys, 1 (ideal).",
        low=0.1,
        high=10.0,
        choices=tuple(EXCESS),
    )
    sizes: bool = option(
        True,
        "Whether errors grow with the half-light radii of the sources.",
    )


class SurveySection(Section):
    """Depth against area."""

    areas: tuple[int, ...] = option(
        (), "Numbers of pointings that the exposure times are divided among.", low=1, high=1000
    )
    rank: str = option(
        "agn",
        "What is ranked for each hour: AGN found, or precision of fracAGN or redshift.",
        choices=("agn", "frac_agn", "redshift"),
    )


def _seconds(default, text):
    """Make an option of a time in s."""
    return option(default, text, low=0.0, high=1e5)


class OverheadSection(Section):
    """What the observatory charges besides the exposures, in s: approximations to APT."""

    # JDox is the JWST user documentation; its "JWST Instrument Overheads" are of APT 2023.3.4
    slew: float = _seconds(
        1800.0,
        "Slew to the first pointing (as in reports of APT's Smart Accounting).",
    )
    next_slew: float = _seconds(
        150.0,
        "Slew to a neighboring pointing; of our own: such reports have 51 s to the "
        "next visit of a target, and 169 s with another roll.",
    )
    guide_star: float = _seconds(
        284.0,
        "Acquisition of the guide star of each pointing (JDox, Visit Timing).",
    )
    visit: float = _seconds(
        90.0,
        "Scripts and cleanup of each pointing (JDox, JWST Instrument Overheads).",
    )
    filter: float = _seconds(
        50.0,
        "Move of the filter wheel, each band (JDox, JWST Instrument Overheads).",
    )
    script: float = _seconds(
        22.0,
        "Compilation of scripts, each band (JDox, JWST Instrument Overheads).",
    )
    exposure: float = _seconds(
        44.0,
        "Set-up and cleanup of each exposure (JDox, JWST Instrument Overheads: of the "
        "first of several dithers; APT charges less for the others).",
    )
    dither: float = _seconds(
        60.0,
        "Small angle maneuver between dithers; of our own: APT takes it from the "
        "distance (JDox, JWST Slew Times and Overheads).",
    )
    observatory: float = option(
        0.16, "Part added to all of it (JDox, JWST Observing Overheads Summary).", low=0.0, high=1.0
    )


class PlanConfig(Configuration):
    """
    Everything that a plan depends on; each attribute is a section of the TOML file.

    Raises
    ------
    `~miricigale.utils.exceptions.ConfigError`
        If lists that belong together have different lengths, or values contradict each other.

    Examples
    --------
    >>> from miricigale.planning import PlanConfig
    >>> config = PlanConfig()
    >>> config.exposures.bands[:3], config.exposures.by_band("time")[:3]
    (('miri.f770w', 'miri.f1000w', 'miri.f1280w'), (1665.0, 1665.0, 1665.0))
    >>> config.set_bands("f1500w,f770w")
    ('miri.f770w', 'miri.f1500w')
    """

    heading: ClassVar = (
        "# miricigale plan configuration; 'miricigale plan --config FILE' takes it back"
    )
    earlier: ClassVar = {
        "sample.source": EarlierKey("catalog.source"),
        "sample.mag_limit": EarlierKey("catalog.mag_limit"),
        "sample.mag_column": EarlierKey("catalog.mag_column"),
        "agn.field": EarlierKey(
            without_effect=(False,),
            instead="AGN are those of a real field without a mix: remove field, frac_agn and shares",
        ),
        "agn.select": EarlierKey(
            without_effect=("probability",),
            instead="sources are selected by the probability of a fracAGN above limit; remove the line",
        ),
        "noise.kind": EarlierKey(
            without_effect=("fitted",),
            instead="errors are those of a fit on the mosaic; remove the line",
        ),
        "noise.run": EarlierKey(
            without_effect=("",),
            instead="errors are those of a fit on the mosaic; remove the line",
        ),
        "images.enabled": EarlierKey(
            without_effect=(False,),
            instead="exposures are imaged by 'miricigale run'; remove the section [images]",
        ),
        "images.kind": EarlierKey(),
        "images.ra": EarlierKey(),
        "images.dec": EarlierKey(),
        "images.roll": EarlierKey(),
        # a plan's sets of bands are those of [exposures], and it never made other fits
        "fit.sets": EarlierKey(),
        "fit.experiments": EarlierKey(),
    }

    plan: PlanSection
    catalog: CatalogSection
    sample: SampleSection
    # dust that the models of the fit have, as in the presets of runs
    sed: SedSection
    agn: AgnSection
    exposures: ExposureSection
    background: BackgroundSection
    noise: NoiseSection
    fit: FitBasics = dataclasses.field(default_factory=lambda: FitBasics(min_detected=1))
    survey: SurveySection
    overheads: OverheadSection

    def __post_init__(self):
        exposures = self.exposures
        agn = self.agn
        n = len(self.exposures.bands)
        self.check(n, "exposures.bands", "must name at least one filter")
        wanted = f"must have one number, or one per band ({n})"
        for key in ("depth" if exposures.depth else "time", "dithers"):
            self.check_length(f"exposures.{key}", (0, 1, n), wanted)
        if not exposures.depth:
            shortest = min(exposures.by_band("time"))
            self.check(shortest > 0, "exposures.time", "must be positive", shortest)
        good = not (exposures.hours and exposures.depth)
        self.check(good, "exposures.hours", "must be left out with depths", exposures.hours)
        wanted = f"must have one number per fracAGN ({len(agn.frac_agn)})"
        self.check_length("agn.shares", (0, len(agn.frac_agn)), wanted)
        self.check(not agn.shares or sum(agn.shares) > 0, "agn.shares", "must not all be 0")
        good = self.sed.frac_agn == SedSection().frac_agn
        self.check(good, "sed.frac_agn", "must be left out: [agn] has the mix")
        for key in ("redshift", "luminosity"):
            span = getattr(self.sample, key)
            good = len(span) == 2 and span[0] < span[1]
            self.check(good, f"sample.{key}", "must be two numbers in order")
        background = self.background
        check_levels("background", "level", background.level, n, background.date)
        good = not background.date or background.ra >= 0
        self.check(good, "background.date", "must come with a position (ra, dec)")
        for name in exposures.sets:
            good = set(self.set_bands(name)) <= set(exposures.bands)
            wanted = f"must be 'all' or bands of {list(exposures.bands)}"
            self.check(good, "exposures.sets", wanted, repr(name))

    def set_bands(self, name):
        """Return the bands of one of the ``sets``, in order of wavelength."""
        if name == "all":
            return self.exposures.bands
        labels = [label.strip() for label in name.split(",") if label.strip()]
        try:
            bands = {imager_filter(label) for label in labels}
        except KeyError as err:
            self.check(False, "exposures.sets", f"has {err.args[0]}")
        return tuple(sorted(bands, key=imager_filters().index))


def check_plan(config):
    """Refuse what is no `PlanConfig` (a `ValueError`)."""
    wanted = "a PlanConfig (load_plan(path) or load_plan(overrides={'exposures': {'bands': ['miri.f1500w']}}))"
    check_type(config, "config", PlanConfig, wanted)


@takes_other_keywords
def load_plan(path=None, *, overrides=None):
    """
    Read the configuration of a plan.

    Parameters
    ----------
    path : path-like, optional
        TOML file; the defaults, the exposures of CEERS, if not given.
    overrides : dict of dict, optional
        Sections and keys that replace those of the file.

    Returns
    -------
    config : `PlanConfig`

    Raises
    ------
    `~miricigale.utils.exceptions.ConfigError`
        If the file is missing, not TOML, or holds an unknown or wrong key.

    Examples
    --------
    >>> from miricigale.planning import load_plan
    >>> exposures = {"bands": ["miri.f770w"], "time": 900, "dithers": 4}
    >>> config = load_plan(overrides={"exposures": exposures})
    >>> config.exposures.time
    (900.0,)
    """
    texts = []
    if path is not None:
        wanted = "the path of a configuration; load_plan(overrides=...) takes a dict of sections"
        check_that(is_path(path), "path", wanted, type(path).__name__)
        texts = [(str(path), read_text(path))]
    return PlanConfig.from_texts(texts, overrides)
