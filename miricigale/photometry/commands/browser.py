"""The sources of a measurement one by one: pictures, fluxes, limits and flags."""

from pathlib import Path

import numpy as np

from miricigale.filters import Filter
from miricigale.filters.band_names import band_label
from miricigale.instrument.sky_axes import grid_angle
from miricigale.pages.browser import image_note, list_column, rounded, saver, source_pages
from miricigale.photometry.images.flags import ForcedFlags
from miricigale.plotting.cutouts import Cutouts
from miricigale.utils.units import ab_magnitude

#: Largest number of sources with pictures: those of the highest signal-to-noise.
_PICTURES = 5000


def browser_files(path):
    """Return the path of the page of the sources beside the page of a measurement, and the folder of its data."""
    path = Path(path)
    name = _browser_name(path)
    return path.with_name(f"{name}.html"), path.with_name(name)


def _browser_name(path):
    return f"{path.name.partition('.')[0]}-sources"


def write_browser(path, title, bands, highres, confidence, detected):
    """
    Write the page of the sources beside the page of a measurement, and return its name.

    ``bands`` are as for `~miricigale.photometry.commands.page.write_page`, which has the other arguments too;
    fluxes below
    ``detected`` sigma are shown as limits.
    """
    name = _browser_name(path)
    results = {band.name: band.result for band in bands}
    first = bands[0].result
    # what a page of a source shows of each band: image, model and residual
    images = {}
    for band, result in results.items():
        image = result.residual_image.copy()
        model = result.model_image
        image.data = image.data + model.data
        images[band] = image, model, result.residual_image
    pictures = Cutouts(highres, images)
    imaged = pictures.on_image(first.sky)
    best = np.max([np.nan_to_num(result.snr, nan=-np.inf) for result in results.values()], axis=0)
    # sources with pictures first, by their best signal-to-noise
    order = np.lexsort((-best, ~imaged))
    shown = np.zeros(len(first), bool)
    shown[order[:_PICTURES]] = imaged[order[:_PICTURES]]
    table = {"id": first.id, "ra": first.sky.ra.deg, "dec": first.sky.dec.deg}
    limited = (
        f"magnitude, or its limit ({confidence:.3g} confidence where below {detected:g} sigma)"
    )
    columns = {"AB": [], "χ²": [], "S/N": []}
    flag_columns = []
    limits = {}
    bands_of_page = []
    waves = []
    has_magnitude = np.zeros(len(first), bool)
    for band, result in results.items():
        limits[band] = result.upper_limit(confidence)
        wave = Filter.from_name(band).pivot.value
        waves.append(wave)
        label = band_label(band)
        bands_of_page.append(
            {"name": band, "label": label, "wave": rounded([wave])[0], "miri": True}
        )
        # magnitudes of detections, limits of all others
        is_limit = ~(result.snr > detected)
        has_magnitude |= ~is_limit
        mag = np.where(is_limit, ab_magnitude(limits[band]), ab_magnitude(result.flux))
        table |= {f"mag_{band}": mag, f"limit_{band}": is_limit, f"sn_{band}": result.snr}
        table |= {f"chi2_{band}": result.chi2, f"flags_{band}": result.flags}
        of_limit = {"digits": 2, "limit": f"limit_{band}"}
        columns["AB"].append(list_column(f"mag_{band}", label, limited, group="AB", **of_limit))
        of_fit = "template-weighted mean of (residual / sigma)²"
        columns["χ²"].append(list_column(f"chi2_{band}", label, of_fit, group="χ²", digits=2))
        of_ratio = "measured flux over its error"
        columns["S/N"].append(list_column(f"sn_{band}", label, of_ratio, group="S/N", digits=1))
        flag_columns.append([f"flags_{band}", "photometry", label])
    table["with_magnitude"] = has_magnitude
    # the columns in the order of the page
    for key, values in table.items():
        digits = 9 if key in ("ra", "dec") else 4
        table[key] = rounded(np.asarray(values)[order], digits)
    layout = pictures.describe()
    flags_column = list_column("flags", "in words", "flags of all bands", group="flags", text=True)
    facts = {
        "turn": float(grid_angle(highres.wcs, highres.shape).to_value("deg")),
        "report": path.name,
        "detected": detected,
        "prior": str(highres.meta.get("filter", "")),
        "cutouts": layout,
        "flags": {"photometry": ForcedFlags.meanings()},
        "flag_columns": flag_columns,
        "bands": bands_of_page,
        "sets": [],
        "wave": rounded([0.7 * min(waves), 1.4 * max(waves)]),
        "table": table,
        "columns": [
            list_column("id", "id", "id of the catalog"),
            *columns["AB"],
            *columns["χ²"],
            *columns["S/N"],
            flags_column,
        ],
        "shows": {
            "all": ["all of the catalog", None],
            "detected": ["with a magnitude in any band", "with_magnitude"],
        },
        "heading": [["ra", "RA", 6], ["dec", "Dec", 6]],
        "notes": {
            "pictured": f"{shown.sum()} sources have pictures, those of the highest signal-to-noise.",
            "images": image_note(
                layout, "along the pixels of each image; circle: 1 arcsec about the position"
            ),
            "spectrum": f"Arrows: upper limits, {confidence:.3g} confidence where below {detected:g} sigma.",
        },
    }

    def entry(row):
        values = {"flux": [], "error": [], "flags": [], "upper": []}
        for band, result in results.items():
            values["flux"].append(result.flux.value[row])
            values["error"].append(result.flux_err.value[row])
            values["flags"].append(result.flags[row])
            values["upper"].append(limits[band].value[row])
        for key, numbers in values.items():
            values[key] = rounded(numbers)
        values["bits"] = {"photometry": values.pop("flags")}
        return values | {"imaged": bool(imaged[row])}

    names = (name, name)
    source_pages(
        saver(path.parent),
        ".",
        names,
        title,
        facts,
        order,
        shown,
        entry,
        lambda k: pictures.sheet(first.sky[k]),
    )
    return f"{name}.html"
