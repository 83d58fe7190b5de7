"""Typed run configuration: frozen dataclasses from TOML, strict about every key."""

import dataclasses
import warnings
from importlib import resources
from pathlib import Path

from astropy.utils.exceptions import AstropyDeprecationWarning

from miricigale.instrument import CEERS_FILTERS
from miricigale.photometry import YANG2021_DEPTHS
from miricigale.utils.exceptions import ConfigError, unknown_name
from miricigale.workflow.options import (
    from_text,
    read_text,
    replace_sections,
    sections_toml,
)
from miricigale.workflow.options import option as _option
from miricigale.workflow.options import require as _require
from miricigale.workflow.truths import (
    ALL,
    EFFECTS,
    EXPERIMENTS,
    FIELD,
    NEEDS_AGN,
    SETS,
    perturbed_values,
)

__all__ = ["StudyConfig", "load_config", "present_names", "preset_names"]


#: Keys that had another name, which files may still have.
_FORMER = {"photometry.n_pixels": "photometry.min_area"}


@dataclasses.dataclass(frozen=True)
class RunSection:
    """What the run is called and how it goes."""

    name: str = _option("study", "Name of the run; its folder unless --output is given.")
    seed: int = _option(20210211, "Seed of every random draw.", low=0)
    threads: int = _option(0, "Threads; 0 for as many as there are cores.", low=0)
    memory: float = _option(0.0, "Memory (GB) of steps side by side; 0 for half of all.", low=0.0)
    keep_level1b: bool = _option(False, "Whether the level-1b (uncal) files are kept.")


@dataclasses.dataclass(frozen=True)
class CatalogSection:
    """The real sources that are simulated."""

    source: str = _option("catalog.goodss", "Resource name or path of the catalog.")
    columns: tuple[str, ...] = _option(
        (), 'Our names of its columns and the file\'s: "redshift=z_best", "wfc3.f160w=FLUX_H".'
    )
    units: tuple[str, ...] = _option(
        (), 'Units where the file gives none: "flux=mJy" for all fluxes, "ra=hourangle".'
    )
    mag_limit: float = _option(26.6, "Faint limit in the magnitude column.", low=10.0, high=40.0)
    mag_column: str = _option(
        "mag_f160w",
        "Column that the limit applies to; without it the flux of the high-resolution band counts.",
    )


@dataclasses.dataclass(frozen=True)
class PointingSection:
    """Where the telescope looks."""

    ra: float = _option(
        53.13440, "Right ascension of the field center in degrees.", low=0, high=360
    )
    dec: float = _option(-27.83444, "Declination of the field center in degrees.", low=-90, high=90)
    roll: float = _option(0.0, "Position angle of V3 in degrees.", low=-360, high=360)


@dataclasses.dataclass(frozen=True)
class SedSection:
    """How the input SEDs are fitted and what AGN is added."""

    axes: str = _option("galaxy", "Grid of the input fit.", choices=("galaxy", "quick"))
    catalog_error: float = _option(
        0.05, "Relative error of fluxes whose band has no column of errors.", low=1e-4, high=1.0
    )
    max_wavelength: float = _option(
        3.0,
        "Longest pivot wavelength (um) of the bands without errors that are fitted.",
        low=0.3,
        high=30.0,
    )
    alpha: tuple[float, ...] = _option(
        (1.5, 2.5), "Range from which the dust's alpha is drawn where no band shows it."
    )
    alpha_draw: str = _option(
        "uniform",
        "How it is drawn: uniform, or nodes: from those of the fit's grid within the range, where "
        "best fits on that grid lie.",
        choices=("uniform", "nodes"),
    )
    frac_agn: tuple[float | str, ...] = _option(
        (0.0,),
        "fracAGN of the injected sources, one simulated sky for each; the first gives the error "
        "functions. 'field' draws AGN from a luminosity function.",
        low=0.0,
        high=0.99,
        choices=(FIELD,),
        single=True,
    )
    infrared: str = _option(
        "fit",
        "Dust luminosity: by energy balance of the fit, or of the star-forming main sequence.",
        choices=("fit", "main-sequence"),
    )


@dataclasses.dataclass(frozen=True)
class ExposureSection:
    """What is exposed, and for how long."""

    filters: tuple[str, ...] = _option(CEERS_FILTERS, "MIRI filters.")
    plan: str = _option("ceers", "Exposure plan.", choices=("ceers", "quick"))
    kind: str = _option(
        "ramps",
        "ramps: every group is simulated; rates: slopes with the noise of the ramps, 30 times faster.",
        choices=("ramps", "rates"),
    )
    n_groups: tuple[int, ...] = _option((), "Groups of each filter instead of the plan's.")
    n_integrations: tuple[int, ...] = _option((), "Integrations of each filter, likewise.")
    n_dithers: tuple[int, ...] = _option((), "Dithers of each filter, likewise.")


@dataclasses.dataclass(frozen=True)
class SceneSection:
    """The sky behind the sources."""

    background_gradient: float = _option(0.05, "Relative gradient per arcmin.", low=0.0, high=1.0)
    gradient_angle: float = _option(45.0, "Position angle of the gradient in degrees.")
    background_scale: float = _option(
        1.0, "Factor on the low-zodi background.", low=0.0, high=100.0
    )


@dataclasses.dataclass(frozen=True)
class HighresSection:
    """The high-resolution image that is the prior."""

    filter: str = _option("wfc3.f160w", "Its filter.")
    pixel_scale: float = _option(0.06, "Pixel scale in arcsec.", low=0.01, high=0.2)
    depth: float = _option(27.6, "5-sigma AB depth of a point source.", low=20.0, high=35.0)


@dataclasses.dataclass(frozen=True)
class DetectorSection:
    """What the detector does to the light."""

    cosmic_rays: bool = _option(True, "Whether cosmic rays hit.")
    residual: float | str = _option(
        0.0,
        "Fraction of the light that stays as a fixed pattern (flat, sky), or that of the exposure "
        "time calculator.",
        low=0.0,
        high=0.1,
        choices=("etc",),
    )


@dataclasses.dataclass(frozen=True)
class ReductionSection:
    """How ramps become mosaics."""

    jump_threshold: float = _option(5.0, "Jump detection threshold in sigma.", low=2.0, high=50.0)
    background_box: int = _option(32, "Box of the background mesh in pixels.", low=8, high=512)
    background_filter: int = _option(3, "Median filter of the mesh in cells.", low=1, high=15)
    pixel_scale: float = _option(0.11, "Pixel scale of the mosaics in arcsec.", low=0.02, high=0.5)
    pixfrac: float = _option(1.0, "Drop size of the drizzling.", low=0.1, high=1.0)


@dataclasses.dataclass(frozen=True)
class PhotometrySection:
    """How sources are found and measured."""

    method: str = _option(
        "package", "Forced photometry: own, or Yang et al. 2021.", choices=("package", "yang2021")
    )
    threshold: float = _option(
        0.25, "Detection threshold in sigma of a pixel.", low=0.01, high=100.0
    )
    n_pixels: int = _option(
        60, "Least number of connected pixels of a detection.", low=1, high=10000
    )
    regularization: str = _option(
        "auto", "Regularization of the matching kernels: auto, yang2021 (0.03) or a number."
    )
    match_radius: float = _option(
        0.5, "Radius of the match to the truth in arcsec.", low=0.05, high=3.0
    )
    rivals: bool = _option(
        False,
        "Whether the first sky is measured by the other method and as by Source Extractor too.",
    )


@dataclasses.dataclass(frozen=True)
class ErrorSection:
    """How the error function is made."""

    statistic: str = _option("mad", "Scatter statistic.", choices=("mad", "median_abs"))
    bin_size: int = _option(30, "Sources per bin.", low=5, high=1000)


@dataclasses.dataclass(frozen=True)
class FitSection:
    """The final fits, with and without MIRI."""

    bands: tuple[str, ...] = _option(tuple(YANG2021_DEPTHS), "Existing bands.")
    depths: tuple[float, ...] = _option(tuple(YANG2021_DEPTHS.values()), "Their 5-sigma AB depths.")
    axes: str = _option("fit", "Grid of the fit.", choices=("fit", "quick"))
    model_error: float = _option(0.1, "Relative model error.", low=0.0, high=1.0)
    min_detected: int = _option(2, "MIRI bands a source must be detected in.", low=0, high=9)
    sets: tuple[str, ...] = _option(
        ("all", "none"),
        "Sets of the MIRI bands that are fitted with the existing ones.",
        choices=SETS,
    )
    experiments: tuple[str, ...] = _option(
        (), "Further fits of each sample with all MIRI bands.", choices=EXPERIMENTS
    )


@dataclasses.dataclass(frozen=True)
class PointSourceSection:
    """The check with bright point sources on a grid."""

    enabled: bool = _option(True, "Whether the check is made.")
    spacing: float = _option(15.0, "Spacing of the grid in arcsec.", low=6.0, high=60.0)
    signal_to_noise: float = _option(1000.0, "Approximate S/N of each.", low=20.0, high=1e5)


@dataclasses.dataclass(frozen=True)
class PerturbSection:
    """In what the sky differs from what the analysis takes it for: one more sky for each effect."""

    effects: tuple[str, ...] = _option(
        (), "Effects; 'all' are those that the skies allow.", choices=(*EFFECTS, ALL), single=True
    )
    together: bool = _option(True, "Whether one more sky has all of them.")
    of: tuple[float | str, ...] = _option(
        (),
        "fracAGN of the skies that are perturbed, out of [sed] frac_agn; without any the first.",
        low=0.0,
        high=0.99,
        choices=(FIELD,),
        single=True,
    )
    psf_width: float = _option(
        0.02, "Relative width of the PSF, + or - by band.", low=0.0, high=0.2
    )
    gain: float = _option(0.01, "Relative gain.", low=-0.2, high=0.2)
    linearity: float = _option(0.01, "Relative signal near a full well.", low=-0.1, high=0.1)
    zero_point: float = _option(0.02, "Relative flux, + or - by band.", low=0.0, high=0.5)
    astrometry: float = _option(
        0.03, "Shift against the prior in arcsec, in a direction of each band.", low=0.0, high=1.0
    )


@dataclasses.dataclass(frozen=True)
class ReportSection:
    """The page at the end."""

    dpi: int = _option(110, "Resolution of the figures.", low=40, high=400)


@dataclasses.dataclass(frozen=True)
class StudyConfig:
    """
    Everything that a run depends on.

    Each attribute is a section of the TOML file; every key has a default, a type,
    limits and a line of documentation (see `to_toml`).

    Raises
    ------
    `~miricigale.utils.exceptions.ConfigError`
        If lists that belong together have different lengths.
    """

    run: RunSection = dataclasses.field(default_factory=RunSection)
    catalog: CatalogSection = dataclasses.field(default_factory=CatalogSection)
    pointing: PointingSection = dataclasses.field(default_factory=PointingSection)
    sed: SedSection = dataclasses.field(default_factory=SedSection)
    exposures: ExposureSection = dataclasses.field(default_factory=ExposureSection)
    scene: SceneSection = dataclasses.field(default_factory=SceneSection)
    highres: HighresSection = dataclasses.field(default_factory=HighresSection)
    detector: DetectorSection = dataclasses.field(default_factory=DetectorSection)
    reduction: ReductionSection = dataclasses.field(default_factory=ReductionSection)
    photometry: PhotometrySection = dataclasses.field(default_factory=PhotometrySection)
    errors: ErrorSection = dataclasses.field(default_factory=ErrorSection)
    fit: FitSection = dataclasses.field(default_factory=FitSection)
    point_sources: PointSourceSection = dataclasses.field(default_factory=PointSourceSection)
    perturb: PerturbSection = dataclasses.field(default_factory=PerturbSection)
    report: ReportSection = dataclasses.field(default_factory=ReportSection)

    def __post_init__(self):
        exposures, fit, n = self.exposures, self.fit, len(self.exposures.filters)
        kernels, alpha, pixel = (
            self.photometry.regularization,
            self.sed.alpha,
            self.highres.pixel_scale,
        )
        for key in ("n_groups", "n_integrations", "n_dithers"):
            values = getattr(exposures, key)
            wanted = f"must have one number per filter ({n})"
            _require(len(values) in (0, n), "exposures", key, wanted, len(values))
            least = min(values, default=1)
            _require(least >= 1, "exposures", key, "must be at least 1", least)
        _require(n, "exposures", "filters", "must name at least one filter", "none")
        names = list(exposures.filters)
        _require(len(set(names)) == n, "exposures", "filters", "must not repeat", names)
        for section, key, values in (
            ("sed", "frac_agn", list(self.sed.frac_agn)),
            ("fit", "sets", list(fit.sets)),
        ):
            _require(values, section, key, "must have at least one value", "none")
        for section, key, values in (
            ("sed", "frac_agn", list(self.sed.frac_agn)),
            ("fit", "sets", list(fit.sets)),
            ("fit", "experiments", list(fit.experiments)),
            ("perturb", "effects", list(self.perturb.effects)),
            ("perturb", "of", list(self.perturb.of)),
        ):
            _require(len(set(values)) == len(values), section, key, "must not repeat", values)
        first = self.sed.frac_agn[0]
        _require(first != FIELD, "sed", "frac_agn", "must begin with a number", repr(first))
        _require("all" in fit.sets, "fit", "sets", "must have 'all'", list(fit.sets))
        halves = {"blue", "red"}.intersection(fit.sets)
        wanted = "may have 'blue' and 'red' with two filters and more only"
        _require(n > 1 or not halves, "fit", "sets", wanted, list(fit.sets))
        foreign = sorted(set(self.perturb.of) - set(self.sed.frac_agn), key=str)
        wanted = f"must be out of [sed] frac_agn, {list(self.sed.frac_agn)}"
        _require(not foreign, "perturb", "of", wanted, foreign)
        lacking = sorted(set(NEEDS_AGN).intersection(self.perturb.effects))
        with_agn = any(value != 0 for value in perturbed_values(self))
        wanted = f"must have a value above 0 for {lacking}"
        _require(with_agn or not lacking, "perturb", "of", wanted, list(self.perturb.of))
        for key in ("columns", "units"):
            pairs = getattr(self.catalog, key)
            good = all(len(pair.split("=")) == 2 and all(pair.split("=")) for pair in pairs)
            _require(good, "catalog", key, "must have the form 'name=value'", list(pairs))
        ramps = exposures.kind == "ramps"
        wanted = "must be false with [exposures] kind = 'rates', which have no ramps"
        _require(ramps or not self.run.keep_level1b, "run", "keep_level1b", wanted, "true")
        good = len(alpha) == 2 and 0 < alpha[0] <= alpha[1] <= 4
        _require(good, "sed", "alpha", "must be two numbers in order, above 0 to 4", list(alpha))
        wanted = f"must be at most the number of MIRI filters ({n})"
        _require(fit.min_detected <= n, "fit", "min_detected", wanted, fit.min_detected)
        wanted = f"must have one number per band ({len(fit.bands)})"
        _require(len(fit.bands) == len(fit.depths), "fit", "depths", wanted, len(fit.depths))
        good = self.photometry.method != "yang2021" or pixel == 0.06
        _require(good, "highres", "pixel_scale", "must be 0.06 with method = 'yang2021'", pixel)
        good = not self.photometry.rivals or pixel == 0.06
        _require(good, "highres", "pixel_scale", "must be 0.06 with [photometry] rivals", pixel)
        good = kernels in ("auto", "yang2021") or _is_positive(kernels)
        wanted = "must be 'auto', 'yang2021' or a positive number as text"
        _require(good, "photometry", "regularization", wanted, repr(kernels))

    @classmethod
    def from_dict(cls, values, *, base=None):
        """
        Make a configuration from nested dictionaries.

        Parameters
        ----------
        values : dict of dict
            Sections and their keys; what is absent keeps the value of ``base``.
        base : `StudyConfig`, optional
            Where absent keys come from; the defaults if not given.

        Raises
        ------
        `~miricigale.utils.exceptions.ConfigError`
            For an unknown section or key (the message lists the known ones), a wrong
            type, or a value outside its limits.
        """
        present = {
            name: _present_entries(name, entries) if isinstance(entries, dict) else entries
            for name, entries in values.items()
        }
        return replace_sections(base or cls(), present)

    def values(self, *names):
        """Plain values of sections (``"scene"``) and keys (``"run.name"``), for hashing."""
        found = {}
        for name in names:
            section, _, key = name.partition(".")
            values = getattr(self, section)
            value = getattr(values, key) if key else dataclasses.asdict(values)
            # under the former name, so that the new one makes no other hash
            found[_FORMER.get(name, name)] = value
        return found

    def to_toml(self):
        """
        The whole configuration as TOML, each key with its documentation.

        Returns
        -------
        text : str
            Gives the same configuration back through `load_config`.
        """
        return sections_toml(
            self, "# miricigale run configuration; 'miricigale run FILE' takes it back"
        )


def _is_positive(text):
    try:
        return float(text) > 0
    except ValueError:
        return False


def present_names(section, entries):
    """Values of a section by key, former names of keys replaced by the present ones."""
    names = {former: name.partition(".")[2] for name, former in _FORMER.items()}
    return {names.get(f"{section}.{key}", key): value for key, value in entries.items()}


def _present_entries(section, entries):
    """As `present_names`, with a warning for each former name."""
    present = present_names(section, entries)
    for old, new in zip(entries, present, strict=True):
        if old != new:
            msg = f"[{section}] {old} is called {new} now"
            warnings.warn(msg, AstropyDeprecationWarning, stacklevel=2)
    return present


def preset_names():
    """Names of the configurations that come with the package."""
    folder = resources.files("miricigale.workflow") / "presets"
    names = (Path(entry.name) for entry in folder.iterdir() if entry.name.endswith(".toml"))
    return sorted(path.stem for path in names if "." not in path.stem)


def load_config(source, *, quick=False, overrides=None):
    """
    Read a run configuration.

    Parameters
    ----------
    source : str or path-like
        Name of a preset (``"goodss"``) or path of a TOML file.
    quick : bool, optional
        For presets: use the quick variant. Not allowed with a file, which already says
        everything.
    overrides : dict of dict, optional
        Sections and keys that replace those of the source.

    Returns
    -------
    config : `StudyConfig`

    Raises
    ------
    `~miricigale.utils.exceptions.ConfigError`
        If the file is missing, not TOML, or holds an unknown or wrong key.
    KeyError
        If there is no such preset.
    """
    source = str(source)
    if source.endswith(".toml"):
        if quick:
            msg = "--quick belongs to presets; a configuration file already says how long to expose"
            raise ConfigError(msg)
        texts = [(source, read_text(source))]
    else:
        if source not in preset_names():
            raise unknown_name("preset", source, preset_names())
        folder = resources.files("miricigale.workflow") / "presets"
        names = [f"{source}.toml", *([f"{source}.quick.toml"] if quick else [])]
        texts = [(name, (folder / name).read_text(encoding="utf-8")) for name in names]
    config = StudyConfig()
    for label, text in texts:
        config = from_text(label, text, config)
    return StudyConfig.from_dict(overrides, base=config) if overrides else config
