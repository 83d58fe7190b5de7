"""What the report says of where its numbers come from: exposures, libraries, software, citations."""

import importlib.metadata
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.pages import number
from miricigale.refdata import citations, resource, resources
from miricigale.utils.meta import provenance
from miricigale.workflow.background import background_text
from miricigale.workflow.stages.exposures import (
    IMAGE_RESOURCES,
    background_options,
    dithers_text,
    study_background,
    study_exposures,
    study_pointings,
)
from miricigale.workflow.stages.figures import band_label
from miricigale.workflow.stages.inputs import catalog_bands, input_bands

__all__ = [
    "catalog_facts",
    "exposure_rows",
    "library_rows",
    "sources_to_cite",
    "stand_ins",
    "versions",
    "write_exposures",
    "write_origin",
]


#: What is not the library of Yang et al. 2021, and what that changes, by resource.
STAND_INS = {
    "ssp.bc03": (
        "Stars: a thinned table of Bruzual & Charlot's populations (2016 version) with a Kroupa IMF "
        "(inferred) stands in for their files with a Chabrier IMF, which Yang et al. 2021 have "
        "(ssp.bc03_user)."
    ),
    "dust.dl07": (
        "Dust: Draine & Li 2007 with an approximate mapping of alpha stands in for the templates of "
        "Dale et al. 2014 (dust.dale2014): fluxes in MIRI bands differ by up to 0.4 mag, by 1 mag "
        "at the 3.3 µm feature."
    ),
    "torus.parametric": (
        "Torus: a parametric form stands in for SKIRTOR (torus.skirtor2016): fitted to 50 of its "
        "spectra, all with p = 1, q = 0, to 0.06 dex rms; other values of p and q, such as q = 1 of "
        "the fits, are an extrapolation."
    ),
}

EXPOSURE_HEADER = (
    "band",
    "readout",
    "groups x integrations",
    "pointings x dithers",
    "time (s)",
    "background (MJy/sr)",
    "sky fills of the well",
    "saturated pixels",
    "as CEERS",
)


def exposure_rows(config, forecasts, ceers):
    """
    Rows under `EXPOSURE_HEADER`, one for each kind of exposure of a band.

    ``forecasts`` are tables by unit, ``ceers`` says of each band whether it is exposed as CEERS did;
    filling and saturation are the highest of the dithers.
    """
    kinds, n_pointings = {}, len(study_pointings(config))
    for unit, e in study_exposures(config).items():
        key = (e.filter, f"{e.readout} {e.subarray}", e.n_groups, e.n_integrations)
        kinds.setdefault(key, []).append((e, forecasts[unit]))
    rows = []
    for (name, readout, n_groups, n_integrations), group in kinds.items():
        time = sum(e.exposure_time for e, _ in group).to_value(u.s) / n_pointings
        fill = max(float(table["sky_fraction"][0]) for _, table in group)
        full = max(int(table["n_pixels"][0]) for _, table in group)
        rows.append(
            (
                band_label(name),
                readout,
                f"{n_groups} x {n_integrations}",
                f"{n_pointings} x {len(group) // n_pointings}",
                f"{time:.0f}",
                f"{study_background(config, name).value:.4g}",
                number(fill, "{:.0f} %", "no usable pixel", scale=100),
                full,
                "yes" if ceers[name] else "no",
            )
        )
    return rows


def stand_ins(config, model):
    """Sentences on everything that is not what Yang et al. 2021, or the observatory, have."""
    found = [STAND_INS[name] for name in model.resources if name in STAND_INS]
    found.append(
        "Instrument: PSFs are computed from the outline of the pupil; non-linearity, flat field and "
        "bad pixels are stand-ins of the right size; the zodiacal light is two black bodies."
    )
    rays = ", read-out and cosmic rays" if config.detector.cosmic_rays else " and read-out"
    noise = f"Noise: photons, dark current{rays}"
    if config.detector.residual == 0.0:
        noise += (
            " only; the correlated residual of flat field and sky that the exposure time calculator "
            "allows for is off"
        )
    else:
        noise += f"; residual of flat field and sky: {config.detector.residual}"
    found.append(f"{noise}.")
    if config.exposures.kind == "rates":
        found.append(
            "Exposures: slopes with the noise that fits to ramps have; no groups were simulated, and "
            "what ramps show beyond noise, cosmic rays and saturation is left out."
        )
    found.append(
        "Existing bands of the fit: true fluxes with Gaussian noise of the depths in [fit], and 3 % of "
        "the flux (10 % in IRAC and MIPS bands), fractions of our own. Stars: black bodies."
    )
    return found


def library_rows(model):
    """Role, component, and reference data of each component of a model."""
    rows = []
    for part in model.components:
        record = resources().get(part.resource) if part.resource else None
        what = f"{record.title} ({part.resource})" if record else "closed form"
        if part.role == "stellar":
            what += f"; IMF {part.imf}"
        rows.append(
            (part.role, part.name, what, part.reference or (record.citation if record else ""))
        )
    return rows


def catalog_facts(config, catalog):
    """What the sources that were taken are, and how their SEDs are fitted: pairs of text."""
    options = config.catalog
    bundled = options.source in resources()
    # the folder of a user's file is not part of the result
    source = f"{options.source}: {resource(options.source).title}" if bundled else (
        f"{Path(options.source).name}, the user's file")  # fmt: skip
    bands = catalog_bands(catalog)
    fitted, longest = input_bands(catalog, config.sed.max_wavelength)
    told = dict.fromkeys(
        text for name in bands if (text := catalog[name].info.description) is not None
    )
    fluxes = f"{len(bands)} bands; the description in the file: {'; '.join(told)}" if told else (
        f"{len(bands)} bands, as the file gives them, without a description")  # fmt: skip
    prior = config.highres.filter
    own = [name for name, errors in fitted.items() if errors]
    guess = f"{100 * config.sed.catalog_error:g} % error"
    if not own:
        how = (
            f" (pivot up to {config.sed.max_wavelength:g} µm), {guess} each, for the catalog "
            "gives none"
        )
    elif len(own) == len(fitted):
        how = ", with the catalog's errors"
    else:
        how = f", with the catalog's errors in {', '.join(own)}; {guess} each in the others"
    if longest > config.sed.max_wavelength:
        how += "; the dust's alpha is fitted too"
    if prior in bands:
        how += f"; each SED is scaled to the flux in {prior}"
    facts = [
        ("source", source),
        ("cut", f"{options.mag_column} <= {options.mag_limit:g}, {len(catalog)} sources"),
        ("fluxes", fluxes),
        ("input SEDs fitted to", f"{', '.join(fitted)}{how}"),
    ]
    if "redshift_source" in catalog.colnames:
        kinds, counts = np.unique(np.asarray(catalog["redshift_source"], str), return_counts=True)
        text = ", ".join(f"{n} {kind}" for kind, n in zip(kinds, counts, strict=True))
        facts.append(("redshifts", text))
    facts.append(("stars", f"{np.count_nonzero(catalog['star'])}"))
    return facts


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


def write_exposures(context, report, metrics, truth):
    """Add the section on what was exposed, of a truth by name, and of which sources."""
    config = context.config
    report.section("Exposures and catalog")
    forecasts = {
        unit: QTable.read(context.path(f"{truth}/exposures/{unit}_forecast.ecsv"))
        for unit in study_exposures(config)
    }
    ceers = {name: entry["ceers"] for name, entry in metrics["bands"].items()}
    report.table(
        exposure_rows(config, forecasts, ceers),
        header=EXPOSURE_HEADER,
        caption="Exposures; time is that of all dithers of a pointing, filling (by the last group) and saturated "
        "pixels are the highest of a dither; 'as CEERS' holds for read-out, frames and dithers, not for "
        "the split of the frames into groups and integrations, which is our own",
        text=2,
    )
    report.text(f"Dithers: {dithers_text(config)}. {_background_sentence(config)}.")
    catalog = QTable.read(context.path("catalog.ecsv"))
    report.table(catalog_facts(config, catalog), header=("catalog", ""), text=2)


def _background_sentence(config):
    """Which background the images have, where it is from and how it varies."""
    options = config.scene
    text = f"Background at the center of the field: {background_text(**background_options(config))}"
    if options.background_scale != 1:
        text += f", times {options.background_scale:g}"
    if options.background_gradient == 0:
        return f"{text}; it is the same everywhere"
    return (
        f"{text}; it grows by {100 * options.background_gradient:g} % of that for each arcmin towards position "
        f"angle {options.gradient_angle:g} deg"
    )


def write_origin(report, config, model, metas):
    """Add the section on libraries, software and citations; ``metas`` are those of products."""
    report.section("How it was made")
    meta = model.meta
    report.table(
        library_rows(model),
        header=("part", "component", "library", "reference"),
        caption=f"SED models of the truth and the fits; cosmology {meta['cosmology']}; fracAGN by the "
        f"definition {meta['frac_agn_definition']!r}",
        text=4,
    )
    report.bullets(meta["libraries"])
    report.table(versions(*metas), header=("software", "version"), text=2)
    report.text(
        "The configuration is config.toml in the folder of the run; 'miricigale run' takes it. "
        "manifest.json says how long each stage took, with the checksum of each product. To be "
        "cited for the data:"
    )
    catalog = {config.catalog.source} & set(resources())
    names = {*IMAGE_RESOURCES, "instrument.etc", *model.resources, *catalog}
    report.bullets(sources_to_cite(names, metas))
