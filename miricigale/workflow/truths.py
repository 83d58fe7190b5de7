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
        """Plain values, for hashing; perturbations are listed only where there are some."""
        values = {"name": self.name, "frac_agn": self.frac_agn}
        if self.perturbations:
            values["perturbations"] = dict(self.perturbations)
        return values


def study_truths(config):
    """
    The truths of a configuration by name.

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
    truths = [Truth(_name(value), value) for value in config.sed.frac_agn]
    for value in perturbed_values(config):
        effects, base = _effects(config.perturb, value), _name(value)
        skies = {effect[0]: (effect,) for effect in effects}
        if config.perturb.together and len(effects) > 1:
            skies[ALL] = effects
        truths += [Truth(f"{base}+{label}", value, own, base) for label, own in skies.items()]
    return {truth.name: truth for truth in truths}


def perturbed_values(config):
    """Values of fracAGN whose truths are perturbed."""
    if not config.perturb.effects:
        return ()
    return config.perturb.of or config.sed.frac_agn[:1]


def _name(frac_agn):
    return frac_agn if isinstance(frac_agn, str) else f"agn{100 * frac_agn:02.9g}"


def _effects(options, frac_agn):
    """Effects on a truth and their sizes, in the order of `EFFECTS`."""
    sizes = dataclasses.asdict(options)
    sizes[CUTOUTS] = {
        "image": options.cutouts, "psf": options.cutouts_psf, "of": options.cutouts_of
    }  # fmt: skip
    chosen = [n for n in EFFECTS if n in options.effects or ALL in options.effects]
    if not options.cutouts:
        chosen = [name for name in chosen if name != CUTOUTS]
    return tuple((n, sizes.get(n)) for n in chosen if frac_agn != 0 or n not in NEEDS_AGN)


def truth_names(config):
    """Names of the truths."""
    return tuple(study_truths(config))


def reference(config):
    """Name of the truth that gives the prior image and the error functions."""
    return truth_names(config)[0]


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


def unit_names(*parts):
    """Names of units, ``a/b/...``, of all combinations of some parts; one without a name is left out."""
    return tuple("/".join(filter(None, one)) for one in itertools.product(*parts))


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
    chosen, changes = config.variants.images, {}
    if chosen and config.exposures.kind == "ramps":
        changes["rates"] = {}
    for name, (section, key, (on, off)) in VARIANTS.items():
        if name in chosen or ALL in chosen:
            value = getattr(getattr(config, section), key)
            changes[name] = {section: {key: off if value else on}}
    return changes
