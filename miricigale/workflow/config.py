"""Typed run configuration: frozen dataclasses from TOML, strict about every key."""

import dataclasses
import warnings
from importlib import resources
from pathlib import Path
from typing import ClassVar

from astropy.utils.exceptions import AstropyDeprecationWarning

from miricigale.utils.exceptions import ConfigError, unknown_name
from miricigale.workflow.background import check_levels
from miricigale.workflow.options import Configuration, read_text, require
from miricigale.workflow.sections import (
    CatalogSection,
    DetectorSection,
    ErrorSection,
    ExposureSection,
    FitSection,
    HighresSection,
    PerturbSection,
    PhotometrySection,
    PointingSection,
    PointSourceSection,
    ReductionSection,
    ReportSection,
    RunSection,
    SceneSection,
    SedSection,
    VariantSection,
)
from miricigale.workflow.truths import ALL, CUTOUTS, NEEDS_AGN, perturbed_values

#: Keys that had another name, which files may still have.
_FORMER = {"photometry.n_pixels": "photometry.min_area"}


@dataclasses.dataclass(frozen=True)
class StudyConfig(Configuration):
    """
    Everything that a run depends on.

    Each attribute is a section of the TOML file; every key has a default, a type,
    limits and a line of documentation (see ``to_toml``).

    Raises
    ------
    `~miricigale.utils.exceptions.ConfigError`
        If lists that belong together have different lengths.
    """

    heading: ClassVar = "# miricigale run configuration; 'miricigale run FILE' takes it back"

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
    variants: VariantSection = dataclasses.field(default_factory=VariantSection)
    report: ReportSection = dataclasses.field(default_factory=ReportSection)

    def __post_init__(self):
        exposures, fit, n = self.exposures, self.fit, len(self.exposures.filters)
        kernels, alpha, pixel = (
            self.photometry.regularization,
            self.sed.alpha,
            self.highres.pixel_scale,
        )
        n_patterns = len(exposures.dithers)
        wanted = f"must have one pattern, or one per filter ({n})"
        require(n_patterns in (0, 1, n), "exposures", "dithers", wanted, n_patterns)
        lists = any(name.lower().endswith(".pointing") for name in exposures.dithers)
        for key in ("dither_observation", "dither_exposures"):
            value = getattr(exposures, key)
            wanted = "must come with a .pointing file in dithers"
            require(lists or not value, "exposures", key, wanted, value)
        for key in ("n_groups", "n_integrations", "n_dithers", "dither_exposures"):
            values = getattr(exposures, key)
            wanted = f"must have one number per filter ({n})"
            require(len(values) in (0, n), "exposures", key, wanted, len(values))
            least = min(values, default=1)
            require(least >= 1, "exposures", key, "must be at least 1", least)
        require(n, "exposures", "filters", "must name at least one filter", "none")
        names = list(exposures.filters)
        require(len(set(names)) == n, "exposures", "filters", "must not repeat", names)
        for section, key, values in (
            ("sed", "frac_agn", list(self.sed.frac_agn)),
            ("fit", "sets", list(fit.sets)),
        ):
            require(values, section, key, "must have at least one value", "none")
        for section, key, values in (
            ("sed", "frac_agn", list(self.sed.frac_agn)),
            ("fit", "sets", list(fit.sets)),
            ("fit", "experiments", list(fit.experiments)),
            ("perturb", "effects", list(self.perturb.effects)),
            ("perturb", "of", list(self.perturb.of)),
            ("variants", "images", list(self.variants.images)),
        ):
            require(len(set(values)) == len(values), section, key, "must not repeat", values)
        scene = self.scene
        check_levels("scene", "background", scene.background, n, scene.background_date)
        first = self.sed.frac_agn[0]
        require(
            not isinstance(first, str), "sed", "frac_agn", "must begin with a number", repr(first)
        )
        require("all" in fit.sets, "fit", "sets", "must have 'all'", list(fit.sets))
        halves = {"blue", "red"}.intersection(fit.sets)
        wanted = "may have 'blue' and 'red' with two filters and more only"
        require(n > 1 or not halves, "fit", "sets", wanted, list(fit.sets))
        foreign = sorted(set(self.perturb.of) - set(self.sed.frac_agn), key=str)
        wanted = f"must be out of [sed] frac_agn, {list(self.sed.frac_agn)}"
        require(not foreign, "perturb", "of", wanted, foreign)
        lacking = sorted(set(NEEDS_AGN).intersection(self.perturb.effects))
        with_agn = any(value != 0 for value in perturbed_values(self))
        wanted = f"must have a value above 0 for {lacking}"
        require(with_agn or not lacking, "perturb", "of", wanted, list(self.perturb.of))
        perturb, with_image = self.perturb, bool(self.perturb.cutouts)
        wanted = "must name an image for the effect 'cutouts'"
        good = with_image or CUTOUTS not in perturb.effects
        require(good, "perturb", "cutouts", wanted, repr(perturb.cutouts))
        wanted = "must be empty without the effect 'cutouts'"
        good = not with_image or {CUTOUTS, ALL}.intersection(perturb.effects)
        require(good, "perturb", "cutouts", wanted, repr(perturb.cutouts))
        wanted = "must be empty without an image in cutouts"
        good = with_image or not perturb.cutouts_psf
        require(good, "perturb", "cutouts_psf", wanted, repr(perturb.cutouts_psf))
        for key in ("columns", "units"):
            pairs = getattr(self.catalog, key)
            good = all(len(pair.split("=")) == 2 and all(pair.split("=")) for pair in pairs)
            require(good, "catalog", key, "must have the form 'name=value'", list(pairs))
        ramps = exposures.kind == "ramps"
        wanted = "must be false with [exposures] kind = 'rates', which have no ramps"
        require(ramps or not self.run.keep_level1b, "run", "keep_level1b", wanted, "true")
        backend = self.reduction.backend
        wanted = "must be 'native' with [exposures] kind = 'rates', which have no ramps"
        require(ramps or backend == "native", "reduction", "backend", wanted, repr(backend))
        good = len(alpha) == 2 and 0 < alpha[0] <= alpha[1] <= 4
        require(good, "sed", "alpha", "must be two numbers in order, above 0 to 4", list(alpha))
        wanted = f"must be at most the number of MIRI filters ({n})"
        require(fit.min_detected <= n, "fit", "min_detected", wanted, fit.min_detected)
        wanted = f"must have one number per band ({len(fit.bands)})"
        require(len(fit.bands) == len(fit.depths), "fit", "depths", wanted, len(fit.depths))
        good = self.photometry.method != "yang2021" or pixel == 0.06
        require(good, "highres", "pixel_scale", "must be 0.06 with method = 'yang2021'", pixel)
        good = not self.photometry.rivals or pixel == 0.06
        require(good, "highres", "pixel_scale", "must be 0.06 with [photometry] rivals", pixel)
        good = kernels in ("auto", "yang2021") or _is_positive(kernels)
        wanted = "must be 'auto', 'yang2021' or a positive number as text"
        require(good, "photometry", "regularization", wanted, repr(kernels))

    @classmethod
    def from_dict(cls, values, *, base=None):
        """As of `~miricigale.workflow.options.Configuration`; keys may have their former names."""
        present = {
            name: _present_entries(name, entries) if isinstance(entries, dict) else entries
            for name, entries in values.items()
        }
        return super().from_dict(present, base=base)

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
    return StudyConfig.from_texts(texts, overrides)
