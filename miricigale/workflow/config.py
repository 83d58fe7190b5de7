"""Typed run configuration: frozen dataclasses from TOML, strict about every key."""

from importlib import resources
from pathlib import Path
from typing import ClassVar

from miricigale.refdata import resources as known_resources
from miricigale.utils.exceptions import ConfigError
from miricigale.utils.options import check_names, check_type
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.workflow.analysis_sections import (
    ErrorSection,
    FitSection,
    PerturbSection,
    PhotometrySection,
    PointSourceSection,
    ReportSection,
    VariantSection,
)
from miricigale.workflow.background import check_levels
from miricigale.workflow.earlier import EarlierKey
from miricigale.workflow.options import Configuration, read_text
from miricigale.workflow.sections import (
    CatalogSection,
    DetectorSection,
    ExposureSection,
    HighresSection,
    PatchesSection,
    PointingSection,
    ReductionSection,
    RunSection,
    SceneSection,
    SedSection,
)
from miricigale.workflow.truths import ALL, CUTOUTS, NEEDS_AGN, perturbed_values


class StudyConfig(Configuration):
    """
    Everything that a run depends on.

    Each attribute is a section of the TOML file; every key has a default, a type,
    limits and a line of documentation (see ``to_toml``).

    Raises
    ------
    `~miricigale.utils.exceptions.ConfigError`
        If lists that belong together have different lengths.

    Examples
    --------
    >>> from miricigale.workflow import StudyConfig, load_config
    >>> config = load_config("goodss")
    >>> config.highres.filter, config.fit.min_detected
    ('wfc3.f160w', 2)
    >>> print(config.to_toml().splitlines()[0])
    # miricigale run configuration; 'miricigale run FILE' takes it back
    """

    heading: ClassVar = "# miricigale run configuration; 'miricigale run FILE' takes it back"
    earlier: ClassVar = {
        "photometry.min_area": EarlierKey("photometry.n_pixels"),
        "reduction.residual_cosmic_rays": EarlierKey(
            without_effect=(False,),
            instead="hits that ramps kept are rejected between the dithers; remove the line",
        ),
    }

    run: RunSection
    catalog: CatalogSection
    pointing: PointingSection
    sed: SedSection
    exposures: ExposureSection
    scene: SceneSection
    highres: HighresSection
    detector: DetectorSection
    reduction: ReductionSection
    patches: PatchesSection
    photometry: PhotometrySection
    errors: ErrorSection
    fit: FitSection
    point_sources: PointSourceSection
    perturb: PerturbSection
    variants: VariantSection
    report: ReportSection

    def __post_init__(self):
        self._check_exposures()
        self._check_fits()
        self._check_perturbations()
        self._check_photometry()

    def _check_exposures(self):
        """Refuse exposures, and a background, that do not go with the filters."""
        exposures = self.exposures
        n = len(exposures.filters)
        self.check(n, "exposures.filters", "must name at least one filter")
        self.check_length(
            "exposures.dithers", (0, 1, n), f"must have one pattern, or one per filter ({n})"
        )
        has_file = any(name.lower().endswith(".pointing") for name in exposures.dithers)
        for key in ("dither_observation", "dither_exposures"):
            good = has_file or not getattr(exposures, key)
            self.check(good, f"exposures.{key}", "must come with a .pointing file in dithers")
        wanted = f"must have one number per filter ({n})"
        for key in ("n_groups", "n_integrations", "n_dithers", "dither_exposures"):
            self.check_length(f"exposures.{key}", (0, n), wanted)
        scene = self.scene
        check_levels("scene", "background", scene.background, n, scene.background_date)
        if exposures.kind == "rates":
            reason = "with [exposures] kind = 'rates', which have no ramps"
            self.check(not self.run.keep_level1b, "run.keep_level1b", f"must be false {reason}")
            good = self.reduction.backend == "native"
            self.check(good, "reduction.backend", f"must be 'native' {reason}")

    def _check_fits(self):
        """Refuse fits that do not go with the truths, the filters or the catalog."""
        fit = self.fit
        n = len(self.exposures.filters)
        good = self.sed.frac_agn and not isinstance(self.sed.frac_agn[0], str)
        self.check(good, "sed.frac_agn", "must begin with a number")
        self.check("all" in fit.sets, "fit.sets", "must have 'all'")
        good = n > 1 or not {"blue", "red"}.intersection(fit.sets)
        self.check(good, "fit.sets", "may have 'blue' and 'red' with two filters and more only")
        wanted = f"must be at most the number of MIRI filters ({n})"
        self.check(fit.min_detected <= n, "fit.min_detected", wanted)
        good = fit.depths or not fit.bands or self.catalog.source not in known_resources()
        wanted = f"must have one number per band ({len(fit.bands)}), for the catalog has no errors"
        self.check(good, "fit.depths", wanted)

    def _check_perturbations(self):
        """Refuse perturbed truths that have no base, no AGN or no image."""
        perturb = self.perturb
        foreign = sorted(set(perturb.of) - set(self.sed.frac_agn), key=str)
        wanted = f"must be out of [sed] frac_agn, {list(self.sed.frac_agn)}"
        self.check(not foreign, "perturb.of", wanted, foreign)
        need_agn = sorted(set(NEEDS_AGN).intersection(perturb.effects))
        good = not need_agn or any(value != 0 for value in perturbed_values(self))
        self.check(
            good, "perturb.of", f"must have a value above 0 for {need_agn}", list(perturb.of)
        )
        good = perturb.cutouts or CUTOUTS not in perturb.effects
        self.check(good, "perturb.cutouts", "must name an image for the effect 'cutouts'")
        good = not perturb.cutouts or {CUTOUTS, ALL}.intersection(perturb.effects)
        self.check(good, "perturb.cutouts", "must be empty without the effect 'cutouts'")
        good = perturb.cutouts or not perturb.cutouts_psf
        self.check(good, "perturb.cutouts_psf", "must be empty without an image in cutouts")

    def _check_photometry(self):
        """Refuse photometry that does not go with the grid of the prior, or with patches."""
        photometry = self.photometry
        patches = self.patches
        is_paper_grid = self.highres.pixel_scale == 0.06
        good = photometry.method != "yang2021" or is_paper_grid
        self.check(good, "highres.pixel_scale", "must be 0.06 with method = 'yang2021'")
        good = not photometry.rivals or is_paper_grid
        self.check(good, "highres.pixel_scale", "must be 0.06 with [photometry] rivals")
        if patches.size:
            self.check(
                patches.size >= patches.overlap, "patches.size", "must be 0 or above overlap"
            )
            self.check(
                photometry.method == "package", "photometry.method", "must be 'package' in patches"
            )
            wanted = "must be left out in patches: whole fields are compared"
            self.check(not photometry.rivals, "photometry.rivals", wanted)
            self.check(not self.variants.images, "variants.images", wanted)


def check_config(config):
    """Refuse what is no `StudyConfig` (a `ValueError`)."""
    wanted = "a StudyConfig (load_config('goodss', quick=True) makes one)"
    check_type(config, "config", StudyConfig, wanted)


def preset_names():
    """
    Return the names of the configurations that come with the package.

    Examples
    --------
    >>> from miricigale.workflow import preset_names
    >>> preset_names()
    ['cosmosweb', 'goodss', 'yang2021']
    """
    folder = resources.files("miricigale.workflow") / "presets"
    names = []
    for entry in folder.iterdir():
        stem, _, suffix = entry.name.partition(".")
        # the others are quick variants
        if suffix == "toml":
            names.append(stem)
    return sorted(names)


@takes_other_keywords
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

    Examples
    --------
    >>> from miricigale.workflow import load_config
    >>> config = load_config("goodss", quick=True, overrides={"sed": {"frac_agn": 0.4}})
    >>> config.exposures.plan, config.sed.frac_agn
    ('quick', (0.4,))
    """
    source = str(source)
    if source.endswith(".toml"):
        if quick:
            msg = "--quick belongs to presets; a configuration file already says how long to expose"
            raise ConfigError(msg)
        texts = [(source, read_text(source))]
    elif Path(source).is_dir() and source not in preset_names():
        raise ConfigError(_folder_problem(Path(source)))
    else:
        check_names([source], "preset", preset_names())
        names = [f"{source}.toml"]
        if quick:
            names.append(f"{source}.quick.toml")
        folder = resources.files("miricigale.workflow") / "presets"
        texts = [(name, (folder / name).read_text(encoding="utf-8")) for name in names]
    return StudyConfig.from_texts(texts, overrides)


def _folder_problem(folder):
    """Say what to run in place of a folder."""
    file = folder / "config.toml"
    if file.is_file():
        return f"{folder} is a folder; 'miricigale run {file} -o {folder}' resumes the run in it"
    return f"{folder} is a folder without a config.toml, wanted is a preset or a configuration file"
