"""The galaxies of a plan: from a catalog, or drawn after a luminosity function."""

import astropy.units as u
import numpy as np
from astropy.table import vstack

from miricigale.planning.config import check_plan
from miricigale.refdata import resources
from miricigale.sed import SEDModel
from miricigale.utils.arrays import middles, quiet_division
from miricigale.utils.exceptions import argument_error, config_error
from miricigale.utils.missing_values import floats, plain_floats
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.random import stream
from miricigale.utils.table_files import read_table
from miricigale.utils.tables import require_columns
from miricigale.workflow.config import StudyConfig
from miricigale.workflow.stages.inputs import bright_sources, fit_seds, study_catalog
from miricigale.workflow.stages.truth import (
    add_agn,
    add_field_agn,
    galaxy_parameters,
    library_fluxes,
    other_skies,
)

#: Largest number of galaxies whose AGN are drawn in other skies, those of some 200 pointings, and of these skies:
#: as many AGN as make the error of the completeness smaller than those that follow from the sample itself.
_MAX_DRAWS = 76000
_MAX_SKIES = 75
#: Stellar populations may not be older than the universe: the fit's ages, Gyr, are cut to this share.
_AGE_SHARE = 0.95


def catalog_area(config, catalog):
    """Return the area of the catalog in square arcmin; None where neither it nor the configuration states it."""
    if config.sample.area:
        return config.sample.area * u.arcmin**2
    if config.catalog.source in resources() and "radius_arcsec" in catalog.meta:
        radius = catalog.meta["radius_arcsec"] * u.arcsec
        return (np.pi * radius**2).to(u.arcmin**2)
    return None


@takes_other_keywords
def make_sample(config, bands, *, executor=None):
    """
    Return the sources with their true parameters and fluxes.

    Parameters
    ----------
    config : `~miricigale.planning.PlanConfig`
        Sections ``catalog``, ``sample``, ``sed`` and ``agn`` are used. The catalog may have a column
        ``frac_agn``, which takes the place of the AGN of a field and of the mix of ``agn``.
    bands : iterable of str
        Bands of the fluxes.
    executor : `concurrent.futures.Executor`, optional
        Threads to fit the catalog with.

    Returns
    -------
    sources : `~astropy.table.QTable`
        A row for each: ``id``, ``redshift``, ``frac_agn``, the other parameters, ``size`` (full width at
        half maximum) and the fluxes; ``meta["density"]`` is the number of all that the cuts leave
        per square arcmin (NaN if the area is not known). With the AGN of a field ``sky`` is 0 for the sample,
        and further rows are the AGN above the limit that the same galaxies have in other skies, all
        together in ``meta["n_skies"]``.

    Raises
    ------
    `~miricigale.utils.exceptions.ConfigError`
        If the cuts leave no source.

    Examples
    --------
    >>> from miricigale.planning import load_plan, make_sample  # doctest: +SKIP
    >>> config = load_plan(overrides={"sample": {"n_sources": 100}})  # doctest: +SKIP
    >>> sources = make_sample(config, ["wfc3.f160w", "miri.f770w"])  # doctest: +SKIP
    >>> sources["redshift", "frac_agn", "miri.f770w"]  # doctest: +SKIP
    """
    check_plan(config)
    seed = config.plan.seed
    rng = stream(seed, "plan", "sample")
    sources, density = _catalog_galaxies(config, executor)
    sources, density = _resampled(sources, density, config.sample, rng)
    model = SEDModel.yang2021()
    sources["sky"] = 0
    n_skies = 1
    if "frac_agn" in sources.colnames:
        agn = "catalog"
        fractions = sources["frac_agn"]
        add_agn(sources, fractions, seed)
    elif config.agn.frac_agn:
        agn = "mix"
        add_agn(sources, agn_mix(config.agn, len(sources), rng), seed)
    else:
        agn = "field"
        band = next(iter(bands))
        add_field_agn(sources, model, band, seed)
        n_other = min(_MAX_DRAWS // len(sources), _MAX_SKIES)
        n_skies += n_other
        limit = config.agn.limit
        agn_elsewhere, _ = other_skies(sources, model, band, n_other, min_frac_agn=limit, seed=seed)
        sources = vstack([sources, agn_elsewhere], metadata_conflicts="silent")
    light = library_fluxes(model, sources, list(bands))
    for name in bands:
        sources[name] = light[name]
    usable = np.all([np.isfinite(sources[name].value) for name in bands], axis=0)
    sources = _cut(sources, usable, "the models")
    sources.meta = {"density": density, "agn": agn, "n_skies": n_skies}
    sources.meta["libraries"] = list(model.meta["libraries"])
    return sources


def _catalog_galaxies(config, executor):
    """Galaxies of the catalog within the cuts, with fitted parameters, and their number per square arcmin."""
    options = config.sample
    study = StudyConfig(catalog=config.catalog, sed=config.sed)
    catalog = study_catalog(config.catalog)
    catalog = bright_sources(catalog, config.catalog, study.highres.filter)
    area = catalog_area(config, catalog)
    redshift = floats(catalog["redshift"])
    chosen = (redshift >= options.redshift[0]) & (redshift <= options.redshift[1])
    catalog = _cut(catalog, chosen & ~np.asarray(catalog["star"], bool), "[sample] redshift")
    results = fit_seds(
        catalog, config.sed, model_error=config.fit.model_error, executor=executor
    ).to_table()
    sources = galaxy_parameters(study, catalog, results, seed=config.plan.seed)
    sources["luminosity"] = results["dust_luminosity_best"].to(u.Lsun)
    if "dust_excess" in sources.colnames:
        sources["luminosity"] *= sources["dust_excess"]
    # full width at half maximum of a Gaussian with the half-light radius; 0 of points
    size = 2 * u.Quantity(catalog["half_light_radius"]).to_value(u.arcsec)
    sources["size"] = np.where(np.isfinite(size) & (size > 0), size, 0.0) * u.arcsec
    if "frac_agn" in catalog.colnames:
        sources["frac_agn"] = floats(catalog["frac_agn"])
    with quiet_division():
        luminosity = np.log10(sources["luminosity"].value)
        is_complete = np.isfinite(sources["mass"].value) & np.isfinite(luminosity)
        inside = (luminosity >= options.luminosity[0]) & (luminosity <= options.luminosity[1])
    sources = _cut(sources, is_complete & inside, "[sample] luminosity")
    density = np.nan
    if area is not None:
        density = len(sources) / area.to_value(u.arcmin**2)
    return sources, density


def _resampled(sources, density, options, rng):
    """As many galaxies as are asked for, and the number per square arcmin that they stand for."""
    n = options.n_sources
    if options.luminosity_function:
        return _by_luminosity(sources, options, rng)
    if 0 < n < len(sources):
        rows = rng.choice(len(sources), n, replace=False)
        sources = sources[np.sort(rows)]
    elif n > len(sources):
        # the same galaxies in other skies: with AGN and noise of their own
        sources = sources[np.arange(n) % len(sources)]
        sources["template"] = sources["id"]
        sources["id"] = np.arange(1, len(sources) + 1)
    return sources, density


def _cut(table, chosen, reason):
    if not np.any(chosen):
        raise config_error(reason, f"leaves none of the {len(table)} sources")
    return table[chosen]


def agn_mix(options, n, rng):
    """Return the AGN fractions in the shares of the configuration, in random order."""
    shares = np.asarray(options.shares or np.ones(len(options.frac_agn)), float)
    edges = np.round(np.cumsum(shares / shares.sum()) * n).astype(int)
    counts = np.diff(np.concatenate([[0], edges]))
    return rng.permutation(np.repeat(options.frac_agn, counts))


def _luminosity_function(options):
    """Log luminosities, redshifts and phi, shape (n_redshift, n_luminosity), of the table that is asked for."""
    try:
        table = read_table(options.luminosity_function, wanted="a luminosity function")
    except OSError as err:
        option = f"[sample] luminosity_function = {options.luminosity_function!r}"
        raise config_error(option, f"cannot be read: {err}") from err
    names = ("log_luminosity", "redshift", "phi")
    require_columns(table, names, "luminosity_function")
    log_luminosity, redshift, phi = (
        plain_floats(table[name], name, "luminosity_function") for name in names
    )
    for name, numbers in zip(names, (log_luminosity, redshift, phi), strict=True):
        n_bad = np.count_nonzero(~np.isfinite(numbers))
        wanted = f"a table of finite numbers in {name!r}"
        check_that(not n_bad, "luminosity_function", wanted, f"{n_bad} that are not")
    levels = np.unique(log_luminosity)
    steps = np.unique(redshift)
    if len(levels) < 2 or len(steps) < 2 or len(table) != len(levels) * len(steps):
        wanted = "a grid of at least two luminosities and two redshifts, a row for each pair"
        raise argument_error("luminosity_function", wanted, f"{len(table)} rows")
    values = np.empty((len(steps), len(levels)))
    values[np.searchsorted(steps, redshift), np.searchsorted(levels, log_luminosity)] = phi
    return levels, steps, values


def _by_luminosity(sources, options, rng):
    """
    Return the sources drawn after a luminosity function, and their number per square arcmin.

    Each cell of the function is taken by draws of redshift and luminosity in proportion to phi and the
    comoving volume; a draw has the SED of the nearest source of the catalog, scaled to its luminosity
    and moved to its redshift.
    """
    cosmology = SEDModel.yang2021().cosmology
    levels, steps, values = _luminosity_function(options)
    # a fine grid within the ranges asked for, phi interpolated linearly
    low = np.maximum(options.redshift[0], steps[0]), np.maximum(options.luminosity[0], levels[0])
    high = np.minimum(options.redshift[1], steps[-1]), np.minimum(options.luminosity[1], levels[-1])
    z, logs = (np.linspace(a, b, 201) for a, b in zip(low, high, strict=True))
    z = middles(z)
    logs = middles(logs)
    at_levels = np.array([np.interp(logs, levels, row) for row in values])
    fine = np.array([np.interp(z, steps, column) for column in at_levels.T]).T
    volume = cosmology.differential_comoving_volume(z).to_value(u.Mpc**3 / u.arcmin**2)
    cells = fine * volume[:, None] * (high[0] - low[0]) / 200 * (high[1] - low[1]) / 200
    wanted = "phi of at least 0, and not 0 everywhere"
    check_that(np.all(cells >= 0) and cells.sum() > 0, "luminosity_function", wanted, "none")
    n = options.n_sources or 500
    drawn = rng.choice(cells.size, n, p=(cells / cells.sum()).ravel())
    z = z[drawn // 200]
    logs = logs[drawn % 200]
    own_z = np.asarray(sources["redshift"])
    own_log = np.log10(sources["luminosity"].value)
    distance = (np.log1p(own_z) - np.log1p(z)[:, None]) ** 2 / 0.01
    distance += (own_log - logs[:, None]) ** 2 / 0.04
    nearest = np.argmin(distance, axis=1)
    out = sources[nearest]
    out["template"] = out["id"]
    out["id"] = np.arange(1, n + 1)
    out["mass"] = out["mass"] * 10 ** (logs - own_log[nearest])
    out["luminosity"] = 10**logs * u.Lsun
    out["redshift"] = z
    oldest = _AGE_SHARE * cosmology.age(z).to_value(u.Gyr)
    out["age"] = np.minimum(out["age"].to_value(u.Gyr), oldest) * u.Gyr
    return out, float(cells.sum())
