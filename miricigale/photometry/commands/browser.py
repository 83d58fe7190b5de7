"""The sources of a measurement one by one: pictures, fluxes, limits and flags."""

from pathlib import Path

import numpy as np

from miricigale.filters import Filter
from miricigale.instrument.sky_axes import grid_angle
from miricigale.pages.browser import rounded, source_pages
from miricigale.photometry.images.flags import ForcedFlags
from miricigale.plotting.cutouts import Cutouts
from miricigale.utils.files import replacing
from miricigale.utils.units import ab_magnitude

#: Largest number of sources with pictures: those of the highest signal-to-noise.
_PICTURES = 5000


def browser_files(path):
    """Page of the sources beside the page of a measurement, and the folder of its data."""
    path = Path(path)
    name = _browser_name(path)
    return path.with_name(f"{name}.html"), path.with_name(name)


def _browser_name(path):
    return f"{path.name.partition('.')[0]}-sources"


def write_browser(path, title, bands, highres, confidence, detected):
    """
    Write the page of the sources beside the page of a measurement: its name.

    ``bands`` are as for `~miricigale.photometry.commands.page.write_page`, which has the other arguments too;
    fluxes below
    ``detected`` sigma are shown as limits.
    """
    name = _browser_name(path)
    results = {band.name: band.result for band in bands}
    first = bands[0].result
    images = {}
    for band, result in results.items():
        image = result.residual_image.copy()
        model = result.model_image
        image.data = image.data + model.data
        images[band] = image, model, result.residual_image
    pictures = Cutouts(highres, images)
    imaged = pictures.on_image(first.sky)
    best = np.max([np.nan_to_num(result.snr, nan=-np.inf) for result in results.values()], axis=0)
    order = np.lexsort((-best, ~imaged))
    shown = np.zeros(len(first), bool)
    shown[order[:_PICTURES]] = imaged[order[:_PICTURES]]
    columns = {"id": first.id, "ra": first.sky.ra.deg, "dec": first.sky.dec.deg}
    limits = {band: result.upper_limit(confidence) for band, result in results.items()}
    for band, result in results.items():
        is_limit = ~(result.snr > detected)
        mag = np.where(is_limit, ab_magnitude(limits[band]), ab_magnitude(result.flux))
        columns |= {f"mag_{band}": mag, f"limit_{band}": is_limit, f"sn_{band}": result.snr}
        columns |= {f"chi2_{band}": result.chi2, f"flags_{band}": result.flags}
    waves = [Filter.from_name(band).pivot.value for band in results]
    facts = {
        "turn": float(grid_angle(highres.wcs, highres.shape).to_value("deg")),
        "report": path.name,
        "limits": f"{confidence:.3g} confidence where below {detected:g} sigma",
        "detected": detected,
        "prior": str(highres.meta.get("filter", "")),
        "cutouts": pictures.describe(),
        "flags": {"photometry": ForcedFlags.meanings()},
        "bands": [
            {"name": k, "label": k.rpartition(".")[2].upper(), "wave": wave, "miri": True}
            for k, wave in zip(results, rounded(waves), strict=True)
        ],
        "wave": rounded([0.7 * min(waves), 1.4 * max(waves)]),
        "table": {
            key: rounded(values[order], 9 if key in ("ra", "dec") else 4)
            for key, values in columns.items()
        },
    }

    def entry(row):
        parts = {"flux": "flux", "error": "flux_err", "flags": "flags"}
        values = {
            key: rounded([np.asarray(getattr(result, part))[row] for result in results.values()])
            for key, part in parts.items()
        }
        values["upper"] = rounded([limit[row].value for limit in limits.values()])
        return values | {"imaged": bool(imaged[row])}

    def save(file, write):
        place = path.parent / file
        place.parent.mkdir(parents=True, exist_ok=True)
        with replacing(place) as partial:
            write(partial)

    names = (name, name)
    source_pages(
        save, ".", names, title, facts, order, shown, entry, lambda k: pictures.sheet(first.sky[k])
    )
    return f"{name}.html"
