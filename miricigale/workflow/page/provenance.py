"""What the report says of where its numbers come from: exposures, libraries, software, citations."""

import importlib.metadata
from pathlib import Path

import astropy.units as u
import numpy as np

from miricigale import sed
from miricigale.evaluation import CEERS_DUST
from miricigale.pages import sentence
from miricigale.refdata import citations, resource, resources
from miricigale.utils.meta import provenance
from miricigale.utils.missing_values import floats
from miricigale.workflow.background import background_text
from miricigale.workflow.labels import band_label, texts_of
from miricigale.workflow.stages.exposures import (
    IMAGE_RESOURCES,
    background_options,
    dithers_text,
    study_background,
    study_exposures,
    study_pointings,
)
from miricigale.workflow.stages.inputs import DUST_SHOWS, catalog_bands, existing_bands, input_bands


def exposure_kinds(config, forecasts, bands):
    """
    Return kinds of exposures of each band as dictionaries, with what the dithers of a pointing have together.

    ``forecasts`` are tables by unit, ``bands`` the plain numbers of the bands; filling and saturation
    are the highest of the dithers.
    """
    n_pointings = len(study_pointings(config))
    kinds = {}
    for unit, e in study_exposures(config).items():
        key = (e.filter, f"{e.readout} {e.subarray}", e.n_groups, e.n_integrations)
        kinds.setdefault(key, []).append(unit)
    exposures = study_exposures(config)
    rows = []
    for (name, readout, n_groups, n_integrations), units in kinds.items():
        tables = [forecasts[unit] for unit in units]
        time = sum(exposures[unit].exposure_time for unit in units).to_value(u.s)
        n_exposures = f"{n_pointings} x {len(units) // n_pointings}"
        if len(units) % n_pointings:
            n_exposures = f"{len(units)} at {n_pointings} pointings"
        row = {
            "band": band_label(name),
            "as_ceers": "yes" if bands[name]["ceers"] else "no",
            "readout": readout,
            "frames": f"{n_groups} x {n_integrations}",
            "exposures": n_exposures,
            "time": time / n_pointings,
            "background": study_background(config, name).value,
            "fill": max(float(table["sky_fraction"][0]) for table in tables),
            "saturated": max(int(table["n_pixels"][0]) for table in tables),
        }
        rows.append(row)
    return rows


def stand_ins(config, model):
    """Return sentences on everything that is not what Yang et al. 2021, or the observatory, have."""
    texts = texts_of("stand_ins")
    residual = config.detector.residual
    names = [name for name in model.resources if name in texts]
    names.append("instrument")
    names.append("no_residual" if residual == 0.0 else "residual")
    if config.exposures.kind == "rates":
        names.append("rates")
    names.append("existing" if all(existing_bands(config).values()) else "own")
    rays = " and read-out"
    if config.detector.cosmic_rays:
        rays = ", read-out and cosmic rays"
    return [sentence(texts[name], {"rays": rays, "residual": residual}) for name in names]


def library_rows(model):
    """Return role, component, and reference data of each component of a model."""
    rows = []
    for part in model.components:
        library = "closed form"
        reference = part.reference
        record = None
        if part.resource:
            record = resources().get(part.resource)
        if record:
            library = f"{record.title} ({part.resource})"
            reference = reference or record.citation
        if part.role == "stellar":
            library += f"; IMF {part.imf}"
        rows.append((part.role, part.name, library, reference or ""))
    return rows


def catalog_facts(config, catalog):
    """Describe the sources of the catalog, and how their SEDs are fitted: dict of text."""
    options = config.catalog
    # the folder of a user's file is not part of the result
    source = f"{Path(options.source).name}, the user's file"
    if options.source in resources():
        source = f"{options.source}: {resource(options.source).title}"
    n_sources = str(len(catalog))
    if n_all := catalog.meta.get("n_sources"):
        n_sources = f"{len(catalog)} of {n_all}"
    facts = {
        "source": source,
        "cut": f"{options.mag_column} <= {options.mag_limit:g}, {n_sources} sources",
        "fluxes": _fluxes_text(catalog),
        "input SEDs fitted to": _input_text(config, catalog),
    }
    if config.sed.infrared == "ceers":
        n = CEERS_DUST[sed.SEDModel.yang2021(agn=False).component("dust").name][-1]
        drawn = f"drawn from CEERS' distribution, measured on {n} sources"
        facts["dust colors"] = f"{drawn}, where no band of the fit of the input SED shows the dust"
    has_redshift = floats(catalog["redshift"]) > 0
    is_star = np.asarray(catalog["star"], bool)
    if n := np.count_nonzero(~has_redshift & ~is_star):
        facts["galaxies without redshift"] = f"{n}: without a model SED, and so on no image"
    existing = existing_bands(config)
    errors = "the errors of each source in the catalog"
    if all(existing.values()):
        errors = "depths"
    fitted = f"{len(existing)} existing bands, with {errors} ({', '.join(existing)})"
    facts["fitted in the end"] = f"{fitted}, and {len(config.exposures.filters)} of MIRI"
    excess = " or ".join(f"{value:g}" for value in config.fit.dust_excess)
    facts["dust of the fit"] = f"{excess or 1} times the power that attenuation takes"
    if "redshift_source" in catalog.colnames:
        kinds, counts = np.unique(np.asarray(catalog["redshift_source"], str), return_counts=True)
        pairs = zip(counts, kinds, strict=True)
        facts["redshifts"] = ", ".join(f"{n} {kind}" for n, kind in pairs)
    facts["stars"] = str(np.count_nonzero(is_star))
    return facts


def _fluxes_text(catalog):
    """Return the number of bands of a catalog, and how its file describes them."""
    bands = catalog_bands(catalog)
    descriptions = dict.fromkeys(catalog[name].info.description for name in bands)
    text = "; ".join(filter(None, descriptions))
    if not text:
        return f"{len(bands)} bands, as the file gives them, without a description"
    return f"{len(bands)} bands; the description in the file: {text}"


def _input_text(config, catalog):
    """Return the bands that the input SEDs are fitted to, and how."""
    limit = config.sed.max_wavelength
    bands, longest = input_bands(catalog, limit)
    with_errors = [name for name, has_errors in bands.items() if has_errors]
    guess = f"{100 * config.sed.catalog_error:g} % error each"
    text = ", ".join(bands)
    if not with_errors:
        text += f" (pivot up to {limit:g} µm), {guess}, for the catalog gives none"
    elif len(with_errors) == len(bands):
        text += ", with the catalog's errors"
    else:
        text += f", with the catalog's errors in {', '.join(with_errors)}; {guess} in the others"
    if longest > DUST_SHOWS:
        text += "; the dust's alpha is fitted too, of sources with a flux there"
    if config.highres.filter in catalog_bands(catalog):
        text += f"; each SED is scaled to the flux in {config.highres.filter}"
    return text


def versions(*metas):
    """
    Return software as pairs of package and version.

    ``metas`` are those of products, whose version of this package may be another than today's.
    """
    version = provenance()["version"]
    of_products = sorted({meta["version"] for meta in metas if "version" in meta})
    if of_products not in ([], [version]):
        version = f"{version} (products: {', '.join(of_products)})"
    rows = [("miricigale", version)]
    for name in ("numpy", "astropy", "photutils", "numba", "scipy", "drizzle", "astro-sedpy"):
        rows.append((name, importlib.metadata.version(name)))
    return rows


def sources_to_cite(names, metas):
    """
    Return what to cite for resources (``names``) and for products (their ``metas``), each once.

    Entries are sorted, and one that another contains is left out.
    """
    entries = set(citations(*names))
    for meta in metas:
        entries.update(meta.get("citations", ()))
    longest = []
    for entry in sorted(entries):
        if not any(entry != longer and entry in longer for longer in entries):
            longest.append(entry)
    return longest


def write_exposures(page):
    """Write the section on what was exposed, of the reference truth, and of which sources."""
    config = page.config
    context = page.context
    page.section("exposures")
    forecasts = {}
    for unit in study_exposures(config):
        forecasts[unit] = context.table(f"{page.first.name}/exposures/{unit}_forecast.ecsv")
    page.table("exposures", exposure_kinds(config, forecasts, page.metrics["bands"]))
    page.report.text(f"Dithers: {dithers_text(config)}. {_background_sentence(config)}.")
    catalog = context.table("catalog.ecsv")
    page.report.table(catalog_facts(config, catalog).items(), header=("catalog", ""), text=2)


def _background_sentence(config):
    """Return which background the images have, where it is from and how it varies."""
    options = config.scene
    text = f"Background at the center of the field: {background_text(**background_options(config))}"
    if options.background_scale != 1:
        text += f", times {options.background_scale:g}"
    if options.background_gradient == 0:
        return f"{text}; it is the same everywhere"
    return (
        f"{text}; it grows by {100 * options.background_gradient:g} % of that for each arcmin toward position "
        f"angle {options.gradient_angle:g} deg"
    )


def write_origin(page, metas):
    """Write the section on libraries, software and citations; ``metas`` are those of products."""
    report = page.report
    model = page.model
    page.section("origin")
    header = ("part", "component", "library", "reference")
    report.table(library_rows(model), header=header, caption=page.sentence("library"), text=4)
    report.bullets(model.meta["libraries"])
    report.table(versions(*metas), header=("software", "version"), text=2)
    page.text("cite")
    catalog = {page.config.catalog.source} & set(resources())
    names = {*IMAGE_RESOURCES, "instrument.etc", *model.resources, *catalog}
    report.bullets(sources_to_cite(names, metas))
