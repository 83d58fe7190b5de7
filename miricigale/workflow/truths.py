"""What a study simulates more than once, and what it fits of each: truths and sets of bands."""

import dataclasses
import itertools

from miricigale.filters import Filter

#: Sets of MIRI bands that join the existing ones in a fit: Yang et al. 2021, section 4.
SETS = ("all", "none", "blue", "red")
#: Further fits of each sample.
EXPERIMENTS = ("free_agn", "far_infrared", "no_model_error", "known_redshift", "between")
#: In place of a fracAGN: AGN as in a real field.
FIELD = "field"
#: In place of a fracAGN: that of each source, in the column ``frac_agn`` of the catalog.
CATALOG = "catalog"
#: Where the sky may differ from what the analysis assumes (section [perturb]).
EFFECTS = (
    "psf", "psf_width", "flat", "gain", "linearity", "zero_point", "zero_point_existing", "astrometry",
    "stars", "dust", "torus", "point_agn", "clumps", "cutouts",
)  # fmt: skip
#: Effects that need an AGN.
NEEDS_AGN = ("torus", "point_agn")

#: Setting that each variant image changes: section, key, and its two values.
VARIANTS = {
    "residual": ("detector", "residual", ("etc", 0.0)),
    "gradient": ("scene", "background_gradient", (0.05, 0.0)),
    "plane": ("reduction", "background_plane", (True, False)),
}
#: The effect that needs an image.
CUTOUTS = "cutouts"
#: All effects, or the sky that has all of them.
ALL = "all"


@dataclasses.dataclass(frozen=True)
class Truth:
    """
    One simulated sky.

    Parameters
    ----------
    name : str
        Folder of its products and first part of its units, such as ``"agn20"``.
    frac_agn : float, "field" or "catalog"
        fracAGN of its sources; AGN of a realistic field (`FIELD`) are drawn from a luminosity function, those of
        the catalog (`CATALOG`) have a column.
    perturbations : tuple of (str, float or dict or None), optional
        Names out of `EFFECTS` and their sizes, None for those that have no size; of `CUTOUTS` the keys
        ``image``, ``psf`` (empty without one) and ``of``.
    base : str, optional
        Name of the truth without the perturbations, where there are any.
    """

    name: str
    frac_agn: float | str
    perturbations: tuple = ()
    base: str = ""

    def values(self):
        """Return the plain values, for hashing; perturbations are listed only where there are some."""
        values = {"name": self.name, "frac_agn": self.frac_agn}
        if self.perturbations:
            values["perturbations"] = dict(self.perturbations)
        return values


def study_truths(config):
    """
    Return the truths of a configuration by name.

    The first is the reference: of it the prior image is made and the error functions are measured.
    Perturbed ones follow, of those of ``perturb.of`` one for each effect and one for all of them.

    Parameters
    ----------
    config : `~miricigale.workflow.StudyConfig`
        The configuration.

    Returns
    -------
    truths : dict of str to `Truth`
    """
    truths = {}

    def add(name, *args):
        truths[name] = Truth(name, *args)

    for value in config.sed.frac_agn:
        add(_name(value), value)
    for value in perturbed_values(config):
        effects = _effects(config.perturb, value)
        base = _name(value)
        for effect in effects:
            add(f"{base}+{effect[0]}", value, (effect,), base)
        if config.perturb.together and len(effects) > 1:
            add(f"{base}+{ALL}", value, effects, base)
    return truths


def perturbed_values(config):
    """Return the values of fracAGN whose truths are perturbed."""
    if not config.perturb.effects:
        return ()
    return config.perturb.of or config.sed.frac_agn[:1]


def _name(frac_agn):
    if isinstance(frac_agn, str):
        return frac_agn
    return f"agn{100 * frac_agn:02.9g}"


def _effects(options, frac_agn):
    """Return effects on a truth and their sizes, in the order of `EFFECTS`."""
    sizes = dataclasses.asdict(options)
    sizes[CUTOUTS] = {
        "image": options.cutouts,
        "psf": options.cutouts_psf,
        "of": options.cutouts_of,
    }
    effects = []
    for name in EFFECTS:
        chosen = name in options.effects or ALL in options.effects
        has_image = options.cutouts or name != CUTOUTS
        has_agn = frac_agn != 0 or name not in NEEDS_AGN
        if chosen and has_image and has_agn:
            effects.append((name, sizes.get(name)))
    return tuple(effects)


def truth_names(config):
    """Return the names of the truths."""
    return tuple(study_truths(config))


def reference(config):
    """Return the name of the truth that gives the prior image and the error functions."""
    return truth_names(config)[0]


def band_sets(config):
    """
    Return the MIRI bands of each fit.

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
    members = {"all": bands, "none": (), "blue": by_wave[:half], "red": by_wave[half:]}
    sets = {}
    for name in config.fit.sets:
        sets[name] = tuple(band for band in bands if band in members[name])
    return sets


def unit_names(*parts):
    """Return names of units, ``a/b/...``, of all combinations of parts; a part without a name is left out."""
    return tuple("/".join(filter(None, names)) for names in itertools.product(*parts))


def variant_changes(config):
    """
    Return the settings of the variant images that differ from the study's.

    Parameters
    ----------
    config : `~miricigale.workflow.StudyConfig`
        The configuration.

    Returns
    -------
    changes : dict of str to dict
        By name out of ``variants.images``, in the order of `VARIANTS`: section, key and value of what is
        switched, off where the study has it on and on where it has it off. With ramps there is one
        more, ``"rates"``, first: the study's own images by rates, which all others are drawn as.
    """
    images = config.variants.images
    changes = {}
    if images and config.exposures.kind == "ramps":
        changes["rates"] = {}
    for name, (section, key, (on, off)) in VARIANTS.items():
        if name in images or ALL in images:
            value = getattr(getattr(config, section), key)
            changes[name] = {section: {key: off if value else on}}
    return changes
