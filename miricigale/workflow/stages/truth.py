"""Stage 3: what the sky holds, by truth: galaxies as fitted, and their AGN."""

from pathlib import Path

import numpy as np
from astropy.table import QTable, hstack

from miricigale import sed
from miricigale.evaluation import (
    CEERS_DUST,
    AGNPopulation,
    agn_fraction,
    ceers_dust,
    main_sequence_dust,
)
from miricigale.refdata.lookup import fingerprint
from miricigale.utils.content_hash import file_sha256
from miricigale.utils.exceptions import DataError
from miricigale.utils.files import file_place
from miricigale.utils.meta import provenance
from miricigale.utils.missing_values import floats
from miricigale.utils.random import stream
from miricigale.utils.tables import error_column
from miricigale.workflow.engine.stage import stage
from miricigale.workflow.morphology import RealGalaxies, stamps_of_sources, write_stamps
from miricigale.workflow.options import require
from miricigale.workflow.perturbation import perturbed_model, perturbed_parameters, point_columns
from miricigale.workflow.stages.inputs import (
    FitPieces,
    catalog_bands,
    catalog_pieces,
    existing_bands,
    measured_error,
    sed_resources,
    shows_dust,
    sources_memory,
)
from miricigale.workflow.stages.stars import star_fluxes
from miricigale.workflow.truths import CATALOG, CUTOUTS, FIELD, study_truths, truth_names

#: What the models of the galaxies depend on beside their fits.
MODELS = ("sed.alpha", "sed.alpha_draw", "sed.infrared", "sed.max_wavelength", "sed.catalog_error")
GALAXY_PARAMETERS = ("tau", "age", "ebv", "alpha", "metallicity")
#: Inclinations (deg) of AGN seen through the torus, after Yang et al. 2021.
EDGE_ON = (60.0, 70.0, 80.0, 90.0)
#: Inclinations (deg) of the other AGN.
FACE_ON = (0.0, 10.0, 20.0, 30.0, 40.0)
#: Parameters of the injected tori, in the order of their draws: values (a list) or a uniform range (a tuple).
TORUS = {
    "tau97": [3.0, 5.0, 7.0, 9.0, 11.0],
    "p": [0.0, 0.5, 1.0, 1.5],
    "q": [0.0, 0.5, 1.0, 1.5],
    "inclination": list(EDGE_ON),
    "ebv_polar": (0, 0.3),
    "temperature_polar": (100, 300),
    "emissivity_polar": (1, 2),
}


def galaxy_parameters(config, catalog, best, *, seed):
    """
    Return the parameters of the galaxies: best fits, scaled to the measured flux in the prior's band.

    ``best`` is the table of the fits of the input SEDs, row by row; ``config`` has
    ``sed.alpha``, ``sed.infrared`` and ``highres.filter``. ``prior_ratio`` is the factor of the scaling, NaN
    where there is no measured flux.
    """
    table = QTable({"id": catalog["id"]})
    table["redshift"] = floats(catalog["redshift"])
    for name in GALAXY_PARAMETERS + ("mass",):
        if f"{name}_best" in best.colnames:
            table[name] = best[f"{name}_best"]
    # sources of which a band of the fit shows the dust
    shown = np.zeros(len(table), bool)
    if "alpha" in table.colnames:
        shown = shows_dust(catalog, config.sed)
    if not shown.all():
        drawn = _drawn_alpha(config.sed, table["id"], seed)
        if shown.any():
            table["alpha"] = np.where(shown, table["alpha"], drawn)
        else:
            table["alpha"] = drawn
    model = sed.SEDModel.yang2021(agn=False)
    prior = config.highres.filter
    if prior in catalog.colnames:
        fitted = model.fluxes(table, [prior])[prior]
        measured = catalog[prior]
        usable = np.isfinite(fitted) & (fitted > 0) & np.isfinite(measured) & (measured > 0)
        ratio = (measured / np.where(usable, fitted, 1 * fitted.unit)).value
        table["mass"] = table["mass"] * np.where(usable, ratio, 1.0)
        table["prior_ratio"] = np.where(usable, ratio, np.nan)
    if config.sed.infrared != "fit":
        _add_dust_excess(table, config.sed.infrared, model, prior, shown=shown, seed=seed)
    return table


def _drawn_alpha(options, ids, seed):
    """Draw the dust's alpha of sources from the range that the section ``sed`` (``options``) has."""
    low, high = options.alpha
    values = (low, high)
    if options.alpha_draw == "nodes":
        nodes = sed.SEDModel.yang2021_axes("fit")["alpha"]
        values = list(nodes[(nodes >= low) & (nodes <= high)])
        wanted = "must hold a node of the fit's grid with alpha_draw = 'nodes'"
        require(values, "sed", "alpha", wanted, [low, high])
    return np.array([_draw(stream(seed, "truth", "alpha", str(key)), values) for key in ids], float)


def _add_dust_excess(table, infrared, model, prior, *, shown, seed):
    """Add ``dust_excess``, and the strength of PAH, where no band of the fit shows the dust."""
    light = model.fluxes(table, [prior])
    light["redshift"] = table["redshift"]
    if infrared == "main-sequence":
        table["dust_excess"] = main_sequence_dust(light, seed=seed)["dust_excess"]
        return
    kind = model.component("dust").name
    if "pah_33" in model.parameters:
        table["pah_33"] = np.where(shown, 1.0, CEERS_DUST[kind][6])
    table["dust_excess"] = np.where(shown, 1.0, ceers_dust(light, kind, seed=seed)["dust_excess"])


def add_agn(table, frac_agn, seed):
    """
    Give each source an AGN drawn from the ranges of Yang et al. 2021 (those of q are inferred).

    ``frac_agn`` is one number, or one for each source. Columns are added to ``table``, which has ``id``: each
    source has its own random stream. See table 3
    of Yang et al. 2021, ApJ 908, 144.
    """
    table["frac_agn"] = np.broadcast_to(np.asarray(frac_agn, float), len(table)).copy()
    streams = [stream(seed, "truth", str(key)) for key in table["id"]]
    for name, values in TORUS.items():
        table[name] = np.array([_draw(rng, values) for rng in streams], dtype=float)


def _draw(rng, values):
    """Draw out of a list of values, or from a uniform range (a tuple)."""
    if isinstance(values, tuple):
        return rng.uniform(*values)
    return rng.choice(values)


def catalog_fractions(catalog):
    """Return the column ``frac_agn`` of a catalog, or a `ConfigError` that says what is wrong with it."""
    has_column = "frac_agn" in catalog.colnames
    wanted = "'catalog' needs a column frac_agn in the catalog"
    require(has_column, "sed", "frac_agn", wanted, catalog.colnames)
    values = floats(catalog["frac_agn"])
    bad = values[~((values >= 0) & (values <= 0.99))]
    wanted = "'catalog' needs a column frac_agn of values between 0 and 0.99"
    require(
        not len(bad), "sed", "frac_agn", wanted, f"{len(bad)} of {len(values)} others, {bad[:3]}"
    )
    return values


def add_field_agn(table, model, band, seed):
    """
    Give sources the AGN of a realistic field, of the luminosities of `AGNPopulation`.

    The torus of each is drawn as by `add_agn`; unobscured ones are seen within 40 degrees of its axis.
    ``model`` is an `~miricigale.sed.SEDModel` with AGN, and ``band`` any filter. Columns of the draw are
    added too.
    """
    add_agn(table, 0.5, seed)
    light = model.fluxes(table, [band])
    light["redshift"] = table["redshift"]
    drawn = AGNPopulation().draw(light, seed=seed)
    for row in np.flatnonzero(drawn["has_agn"] & ~drawn["obscured"]):
        rng = stream(seed, "truth", "inclination", str(table["id"][row]))
        table["inclination"][row] = rng.choice(FACE_ON)
    # by the luminosity that half of the power gives, with the inclination that was drawn
    table["frac_agn"] = agn_fraction(drawn["l_6um"], model.fluxes(table, [band])["l_6um"])
    for name in ("has_agn", "l_2_10kev", "obscured", "compton_thick"):
        table[name] = drawn[name]


def other_skies(galaxies, model, band, n_skies, *, min_frac_agn, seed, n_complete=0):
    """
    Draw AGN from a fracAGN of ``min_frac_agn`` on that galaxies have in other skies, as by `add_field_agn`.

    Of the first ``n_complete`` skies all galaxies are kept, with the AGN that they have or none. ``galaxies`` has
    the parameters of ``model``. Returns the table, with ``sky`` from 1 on and ids of its own, and the row of the
    galaxy of each.
    """
    n = len(galaxies)
    ids = galaxies["id"]
    numbers = np.arange(n * n_skies)
    rows = numbers % n
    skies = galaxies[rows]
    skies["sky"] = 1 + numbers // n
    if np.asarray(ids).dtype.kind in "iu":
        skies["id"] = np.max(ids) + 1 + numbers
    else:
        pairs = zip(skies["id"], skies["sky"], strict=True)
        skies["id"] = [f"{key}-{sky}" for key, sky in pairs]
    light = QTable(skies["id", "redshift"])
    light["stellar_mass"] = model.fluxes(galaxies, [band])["stellar_mass"][rows]
    # each id has draws of its own, so that these are the AGN that are added
    has_agn = AGNPopulation().draw(light, seed=seed)["has_agn"]
    keep = has_agn | (skies["sky"] <= n_complete)
    skies = skies[keep]
    rows = rows[keep]
    if len(skies):
        add_field_agn(skies, model, band, seed)
    keep = (skies["frac_agn"] >= min_frac_agn) | (skies["sky"] <= n_complete)
    return skies[keep], rows[keep]


def library_fluxes(model, parameters, bands):
    """Return fluxes of models; a `DataError` if the registered libraries lack parameters of some."""
    light = model.fluxes(parameters, bands)
    lacking = np.count_nonzero(light["flags"] & int(sed.ModelFlags.NOT_IN_LIBRARY))
    if lacking:
        msg = (
            f"{lacking} of {len(light)} sources have parameters that the registered libraries lack ("
            f"{'; '.join(model.meta['libraries'])}): register whole ones (miricigale data add), or remove these"
        )
        raise DataError(msg)
    return light


def _truth_plan(config, unit):
    """Return the truth; libraries of its models where they differ from those of the fits; content of its files."""
    values = study_truths(config)[unit].values()
    effects = values.get("perturbations", {})
    if CUTOUTS in effects:
        values["files"] = []
        for key in ("image", "psf"):
            if name := effects[CUTOUTS][key]:
                path = Path(file_place(name)[0]).expanduser()
                values["files"].append(file_sha256(path))
    if model := perturbed_model(effects, agn=values["frac_agn"] != 0):
        values["libraries"] = {name: fingerprint(name) for name in model.resources}
    return values


def _light(config, catalog, star, model, parameters, bands):
    """Return fluxes of galaxies by their models and of stars (``star`` is True), and the errors of the catalog."""
    light = library_fluxes(model, parameters, bands)
    light.rename_column("flags", "sed_flags")
    if np.any(star):
        stars = star_fluxes(catalog[star], catalog_bands(catalog), bands)
        for band in bands:
            light[band][star] = stars[band]
    for band, depth in existing_bands(config).items():
        if depth is None:
            error = measured_error(catalog, band, config.sed.catalog_error)
            has_flux = np.isfinite(catalog[band])
            light[error_column(band)] = np.where(has_flux, error, np.nan * error.unit)
    return light


@stage(
    "truth",
    "model fluxes",
    version=3,
    needs=("catalog", "seds"),
    sections=MODELS + ("catalog", "exposures.filters", "fit.bands", "fit.depths", "highres.filter"),
    resources=sed_resources,
    units=truth_names,
    reads=lambda config, _: catalog_pieces(config),
    plan=_truth_plan,
    memory=sources_memory,
)
def make_truth(context, name):
    """Stage 3: the best-fit SED (and its AGN) of each source through every band."""
    config = context.config
    frac_agn = context.plan["frac_agn"]
    effects = context.plan.get("perturbations", {})
    catalog = context.table("catalog.ecsv")
    best = FitPieces(context, "input_seds", len(catalog)).to_table()
    prior = config.highres.filter
    bands = list(dict.fromkeys([*existing_bands(config), *config.exposures.filters, prior]))
    model = sed.SEDModel.yang2021(agn=frac_agn != 0)
    parameters = galaxy_parameters(config, catalog, best, seed=context.seed)
    if frac_agn == FIELD:
        add_field_agn(parameters, model, bands[0], context.seed)
    elif model.has_agn:
        shares = frac_agn
        if frac_agn == CATALOG:
            shares = catalog_fractions(catalog)
        add_agn(parameters, shares, context.seed)
    if perturbed := perturbed_model(effects, agn=model.has_agn):
        models = (model, perturbed)
        parameters = perturbed_parameters(effects, parameters, models, prior, seed=context.seed)
        model = perturbed
    star = np.asarray(catalog["star"], bool)
    light = _light(config, catalog, star, model, parameters, bands)
    # what a column frac_agn of the catalog says is of the truth of that name only
    computed = {"frac_agn", *light.colnames, *parameters.colnames}
    facts = [c for c in catalog.colnames if c not in computed and "." not in c]
    columns = [c for c in light.colnames if c not in parameters.colnames]
    tables = [parameters, catalog[facts], light[columns]]
    truth = hstack(tables, metadata_conflicts="silent")
    if "point_agn" in effects:
        for column, share in point_columns(model, parameters, config.exposures.filters).items():
            # the light of a star is not that of the model
            truth[column] = np.where(star, 0.0, share)
    if CUTOUTS in effects:
        files = effects[CUTOUTS]
        galaxies = RealGalaxies.read(files["image"], psf=files["psf"] or None)
        stamps = stamps_of_sources(truth, galaxies, of=files["of"], seed=context.seed)
        context.save(f"{name}/stamps.fits", lambda path: write_stamps(stamps, path))
    if "frac_agn" not in truth.colnames:
        truth["frac_agn"] = np.zeros(len(truth))
    citations = [*catalog.meta.get("citations", ()), *model.meta["citations"]]
    truth.meta.clear()
    truth.meta.update(provenance(citations=citations, stage="truth"))
    context.save_rows(f"{name}/truth", truth)
