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
#: Inclinations (deg) of AGN seen through the torus, after Yang et al. 2021, and of the others.
EDGE_ON, FACE_ON = (60.0, 70.0, 80.0, 90.0), (0.0, 10.0, 20.0, 30.0, 40.0)
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
    Parameters of the galaxies: best fits, scaled to the measured flux in the prior's band.

    ``best`` is the table of the fits of the input SEDs, row by row; ``config`` has
    ``sed.alpha``, ``sed.infrared`` and ``highres.filter``. ``prior_ratio`` is the factor of the scaling, NaN
    where there is no measured flux.
    """
    table = QTable({"id": catalog["id"]})
    table["redshift"] = np.asarray(catalog["redshift"], float)
    for name in (*GALAXY_PARAMETERS, "mass"):
        if f"{name}_best" in best.colnames:
            table[name] = best[f"{name}_best"]
    shown = np.zeros(len(table), bool)
    if "alpha" in table.colnames:
        shown = shows_dust(catalog, config.sed)
    if not shown.all():
        # the bands of the fit do not show it
        values = low, high = config.sed.alpha
        if config.sed.alpha_draw == "nodes":
            nodes = sed.SEDModel.yang2021_axes("fit")["alpha"]
            values = list(nodes[(nodes >= low) & (nodes <= high)])
            wanted = "must hold a node of the fit's grid with alpha_draw = 'nodes'"
            require(values, "sed", "alpha", wanted, [low, high])
        streams = (stream(seed, "truth", "alpha", str(key)) for key in table["id"])
        drawn = np.array([_draw(rng, values) for rng in streams], float)
        table["alpha"] = np.where(shown, table["alpha"], drawn) if shown.any() else drawn
    model, prior = sed.SEDModel.yang2021(agn=False), config.highres.filter
    if prior in catalog.colnames:
        fitted, measured = model.fluxes(table, [prior])[prior], catalog[prior]
        usable = np.isfinite(fitted) & (fitted > 0) & np.isfinite(measured) & (measured > 0)
        ratio = np.where(usable, (measured / np.where(usable, fitted, 1 * fitted.unit)).value, 1.0)
        table["mass"] = table["mass"] * ratio
        table["prior_ratio"] = np.where(usable, ratio, np.nan)
    if config.sed.infrared != "fit":
        light, kind = model.fluxes(table, [prior]), model.component("dust").name
        light["redshift"] = table["redshift"]
        if config.sed.infrared == "ceers":
            excess = np.where(shown, 1.0, ceers_dust(light, kind, seed=seed)["dust_excess"])
            if "pah_33" in model.parameters:
                table["pah_33"] = np.where(shown, 1.0, CEERS_DUST[kind][6])
        else:
            excess = main_sequence_dust(light, seed=seed)["dust_excess"]
        table["dust_excess"] = excess
    return table


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
        table[name] = np.array([_draw(one, values) for one in streams], dtype=float)


def _draw(rng, values):
    return rng.uniform(*values) if isinstance(values, tuple) else rng.choice(values)


def catalog_fractions(catalog):
    """The column ``frac_agn`` of a catalog, or a `ConfigError` that says what is wrong with it."""
    known = "frac_agn" in catalog.colnames
    wanted = "'catalog' needs a column frac_agn in the catalog"
    require(known, "sed", "frac_agn", wanted, catalog.colnames)
    values = np.asarray(catalog["frac_agn"], float)
    bad = values[~((values >= 0) & (values <= 0.99))]
    wanted = "'catalog' needs a column frac_agn of values between 0 and 0.99"
    got = f"{len(bad)} of {len(values)} others, {bad[:3]}"
    require(not len(bad), "sed", "frac_agn", wanted, got)
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


def other_skies(galaxies, model, band, n_skies, *, least, seed, whole=0):
    """
    AGN from a fracAGN of ``least`` on that galaxies have in other skies, as by `add_field_agn`.

    Of the first ``whole`` skies all galaxies are kept, with the AGN that they have or none. ``galaxies`` has the
    parameters of ``model``. Returns the table, with ``sky`` from 1 on and ids of its own, and the row of the
    galaxy of each.
    """
    n, ids = len(galaxies), galaxies["id"]
    rows = np.arange(n * n_skies) % n
    others = galaxies[rows]
    others["sky"] = 1 + np.arange(n * n_skies) // n
    keys = [f"{key}-{sky}" for key, sky in zip(others["id"], others["sky"], strict=True)]
    numbers = np.asarray(ids).dtype.kind in "iu"
    others["id"] = np.max(ids) + 1 + np.arange(n * n_skies) if numbers else keys
    light = QTable(others["id", "redshift"])
    light["stellar_mass"] = model.fluxes(galaxies, [band])["stellar_mass"][rows]
    # each id has draws of its own, so that these are the AGN that are added
    keep = AGNPopulation().draw(light, seed=seed)["has_agn"] | (others["sky"] <= whole)
    others, rows = others[keep], rows[keep]
    if len(others):
        add_field_agn(others, model, band, seed)
    keep = (others["frac_agn"] >= least) | (others["sky"] <= whole)
    return others[keep], rows[keep]


def library_fluxes(model, parameters, bands):
    """Fluxes of models; a `DataError` if the registered libraries lack parameters of some."""
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
    """The truth; libraries of its models where they are others than those of the fits; content of its files."""
    values = study_truths(config)[unit].values()
    effects = values.get("perturbations", {})
    if CUTOUTS in effects:
        files = effects[CUTOUTS]
        paths = [file_place(files[key])[0] for key in ("image", "psf") if files[key]]
        values["files"] = [file_sha256(Path(path).expanduser()) for path in paths]
    if model := perturbed_model(effects, agn=values["frac_agn"] != 0):
        values["libraries"] = {name: fingerprint(name) for name in model.resources}
    return values


@stage(
    "truth",
    "model fluxes",
    version=3,
    needs=("catalog", "seds"),
    sections=(*MODELS, "catalog", "exposures.filters", "fit.bands", "fit.depths", "highres.filter"),
    resources=sed_resources,
    units=truth_names,
    reads=lambda config, _: catalog_pieces(config),
    plan=_truth_plan,
    memory=sources_memory,
)
def make_truth(context, name):
    """Stage 3: the best-fit SED (and its AGN) of each source through every band."""
    config, frac_agn = context.config, context.plan["frac_agn"]
    effects = context.plan.get("perturbations", {})
    catalog = context.table("catalog.ecsv")
    best = FitPieces(context, "input_seds", len(catalog)).to_table()
    parameters = galaxy_parameters(config, catalog, best, seed=context.seed)
    prior = config.highres.filter
    existing = existing_bands(config)
    bands = list(dict.fromkeys([*existing, *config.exposures.filters, prior]))
    model = sed.SEDModel.yang2021(agn=frac_agn != 0)
    if frac_agn == FIELD:
        add_field_agn(parameters, model, bands[0], context.seed)
    elif model.has_agn:
        shares = catalog_fractions(catalog) if frac_agn == CATALOG else frac_agn
        add_agn(parameters, shares, context.seed)
    if other := perturbed_model(effects, agn=model.has_agn):
        models = model, other
        parameters = perturbed_parameters(effects, parameters, models, prior, seed=context.seed)
        model = other
    light = library_fluxes(model, parameters, bands)
    light.rename_column("flags", "sed_flags")
    star = np.asarray(catalog["star"], bool)
    if np.any(star):
        stars = star_fluxes(catalog[star], catalog_bands(catalog), bands)
        for band in bands:
            light[band][star] = stars[band]
    for band in (name for name, limit in existing.items() if limit is None):
        error = measured_error(catalog, band, config.sed.catalog_error)
        light[error_column(band)] = np.where(np.isfinite(catalog[band]), error, np.nan * error.unit)
    # what a column frac_agn of the catalog says is of the truth of that name only
    own = {"frac_agn", *light.colnames, *parameters.colnames}
    known = catalog[[c for c in catalog.colnames if c not in own and "." not in c]]
    light = light[[c for c in light.colnames if c not in parameters.colnames]]
    truth = hstack([parameters, known, light], metadata_conflicts="silent")
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
