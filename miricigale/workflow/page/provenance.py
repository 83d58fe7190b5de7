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
    Kinds of exposures of each band as dictionaries, with what the dithers of a pointing have together.

    ``forecasts`` are tables by unit, ``bands`` the plain numbers of the bands; filling and saturation
    are the highest of the dithers.
    """
    kinds, n_pointings = {}, len(study_pointings(config))
    for unit, e in study_exposures(config).items():
        key = (e.filter, f"{e.readout} {e.subarray}", e.n_groups, e.n_integrations)
        kinds.setdefault(key, []).append((e, forecasts[unit]))
    return [
        {
            "band": band_label(name),
            "as_ceers": "yes" if bands[name]["ceers"] else "no",
            "readout": readout,
            "frames": f"{n_groups} x {n_integrations}",
            "exposures": f"{len(group)} at {n_pointings} pointings"
            if len(group) % n_pointings
            else f"{n_pointings} x {len(group) // n_pointings}",
            "time": sum(e.exposure_time for e, _ in group).to_value(u.s) / n_pointings,
            "background": study_background(config, name).value,
            "fill": max(float(table["sky_fraction"][0]) for _, table in group),
            "saturated": max(int(table["n_pixels"][0]) for _, table in group),
        }
        for (name, readout, n_groups, n_integrations), group in kinds.items()
    ]


def stand_ins(config, model):
    """Sentences on everything that is not what Yang et al. 2021, or the observatory, have."""
    texts, residual = texts_of("stand_ins"), config.detector.residual
    chosen = [name for name in model.resources if name in texts]
    chosen += ["instrument", "no_residual" if residual == 0.0 else "residual"]
    chosen += ["rates"] if config.exposures.kind == "rates" else []
    rays = ", read-out and cosmic rays" if config.detector.cosmic_rays else " and read-out"
    facts = {"rays": rays, "residual": residual}
    chosen.append("existing" if all(existing_bands(config).values()) else "own")
    return [sentence(texts[name], facts) for name in chosen]


def library_rows(model):
    """Role, component, and reference data of each component of a model."""
    rows = []
    for part in model.components:
        record = resources().get(part.resource) if part.resource else None
        what = f"{record.title} ({part.resource})" if record else "closed form"
        if part.role == "stellar":
            what += f"; IMF {part.imf}"
        cite = part.reference or (record.citation if record else "")
        rows.append((part.role, part.name, what, cite))
    return rows


def catalog_facts(config, catalog):
    """What the sources that were taken are, and how their SEDs are fitted: dict of text."""
    options, limit = config.catalog, config.sed.max_wavelength
    # the folder of a user's file is not part of the result
    source = f"{Path(options.source).name}, the user's file"
    if options.source in resources():
        source = f"{options.source}: {resource(options.source).title}"
    bands = catalog_bands(catalog)
    descriptions = [catalog[name].info.description for name in bands]
    described = "; ".join(dict.fromkeys(text for text in descriptions if text is not None))
    fluxes = f"; the description in the file: {described}"
    if not described:
        fluxes = ", as the file gives them, without a description"
    fitted, longest = input_bands(catalog, limit)
    own = [name for name, errors in fitted.items() if errors]
    guess = f"{100 * config.sed.catalog_error:g} % error each"
    if not own:
        how = f" (pivot up to {limit:g} µm), {guess}, for the catalog gives none"
    else:
        others = "" if len(own) == len(fitted) else f" in {', '.join(own)}; {guess} in the others"
        how = f", with the catalog's errors{others}"
    if longest > DUST_SHOWS:
        how += "; the dust's alpha is fitted too, of sources with a flux there"
    if config.highres.filter in bands:
        how += f"; each SED is scaled to the flux in {config.highres.filter}"
    n_all, known = catalog.meta.get("n_sources"), np.asarray(catalog["redshift"], float) > 0
    number = f"{len(catalog)} of {n_all}" if n_all else f"{len(catalog)}"
    facts = {
        "source": source,
        "cut": f"{options.mag_column} <= {options.mag_limit:g}, {number} sources",
        "fluxes": f"{len(bands)} bands{fluxes}",
        "input SEDs fitted to": ", ".join(fitted) + how,
    }
    if config.sed.infrared == "ceers":
        n = CEERS_DUST[sed.SEDModel.yang2021(agn=False).component("dust").name][-1]
        drawn = f"drawn from CEERS' distribution, measured on {n} sources"
        facts["dust colors"] = f"{drawn}, where no band of the fit of the input SED shows the dust"
    if none := np.count_nonzero(~known & ~np.asarray(catalog["star"], bool)):
        facts["galaxies without redshift"] = f"{none}: without a model SED, and so on no image"
    existing = existing_bands(config)
    own = "depths" if all(existing.values()) else "the errors of each source in the catalog"
    of = f"{len(existing)} existing bands, with {own} ({', '.join(existing)})"
    facts["fitted in the end"] = f"{of}, and {len(config.exposures.filters)} of MIRI"
    excess = " or ".join(f"{value:g}" for value in config.fit.dust_excess)
    facts["dust of the fit"] = f"{excess or 1} times the power that attenuation takes"
    if "redshift_source" in catalog.colnames:
        kinds, counts = np.unique(np.asarray(catalog["redshift_source"], str), return_counts=True)
        pairs = zip(kinds, counts, strict=True)
        facts["redshifts"] = ", ".join(f"{n} {kind}" for kind, n in pairs)
    return facts | {"stars": str(np.count_nonzero(catalog["star"]))}


def versions(*metas):
    """
    Software: pairs of package and version.

    ``metas`` are those of products, whose version of this package may be another than today's.
    """
    here = provenance()["version"]
    made = sorted({meta["version"] for meta in metas if "version" in meta})
    own = here if made in ([], [here]) else f"{here} (products: {', '.join(made)})"
    packages = ("numpy", "astropy", "photutils", "numba", "scipy", "drizzle", "astro-sedpy")
    return [("miricigale", own), *((name, importlib.metadata.version(name)) for name in packages)]


def sources_to_cite(names, metas):
    """
    What to cite for resources (``names``) and for products (their ``metas``), each once.

    Entries are sorted, and one that another contains is left out.
    """
    entries = {entry for meta in metas for entry in meta.get("citations", ())}
    entries |= set(citations(*names))
    return sorted(one for one in entries if not any(one != two and one in two for two in entries))


def write_exposures(page):
    """The section on what was exposed, of the reference truth, and of which sources."""
    config, context = page.config, page.context
    page.section("exposures")
    forecasts = {
        unit: context.table(f"{page.first.name}/exposures/{unit}_forecast.ecsv")
        for unit in study_exposures(config)
    }
    page.table("exposures", exposure_kinds(config, forecasts, page.metrics["bands"]))
    page.report.text(f"Dithers: {dithers_text(config)}. {_background_sentence(config)}.")
    catalog = context.table("catalog.ecsv")
    page.report.table(catalog_facts(config, catalog).items(), header=("catalog", ""), text=2)


def _background_sentence(config):
    """Which background the images have, where it is from and how it varies."""
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
    """The section on libraries, software and citations; ``metas`` are those of products."""
    report, model = page.report, page.model
    page.section("origin")
    header = ("part", "component", "library", "reference")
    report.table(library_rows(model), header=header, caption=page.sentence("library"), text=4)
    report.bullets(model.meta["libraries"])
    report.table(versions(*metas), header=("software", "version"), text=2)
    page.text("cite")
    catalog = {page.config.catalog.source} & set(resources())
    names = {*IMAGE_RESOURCES, "instrument.etc", *model.resources, *catalog}
    report.bullets(sources_to_cite(names, metas))
