"""The sources of a measurement one by one: pictures, fluxes, limits and flags."""

from pathlib import Path

import numpy as np

from miricigale.filters import Filter
from miricigale.filters.band_names import band_label
from miricigale.instrument.sky_axes import grid_angle
from miricigale.pages.browser import (
    band_entries,
    image_note,
    list_column,
    pages_beside,
    rounded,
)
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
    fluxes below ``detected`` sigma are shown as limits.
    """
    name = _browser_name(path)
    sources = _Sources(bands, highres, confidence, detected)
    return pages_beside(
        path,
        name,
        title,
        sources.describe(),
        sources.order,
        sources.shown,
        sources.entry,
        sources.sheet,
    )


class _Sources:
    """What the page has of the sources of a measurement."""

    def __init__(self, bands, highres, confidence, detected):
        self.results = {band.name: band.result for band in bands}
        self.highres = highres
        self.confidence = confidence
        self.detected = detected
        first = bands[0].result
        self.id = first.id
        self.sky = first.sky
        self.limits = {
            band: result.upper_limit(confidence) for band, result in self.results.items()
        }
        # what a page of a source shows of each band: image, model and residual
        images = {}
        for band, result in self.results.items():
            image = result.residual_image.copy()
            model = result.model_image
            image.data = image.data + model.data
            images[band] = image, model, result.residual_image
        self.pictures = Cutouts(highres, images)
        self.imaged = self.pictures.on_image(self.sky)
        # sources with pictures first, by their best signal-to-noise
        best = np.max(
            [np.nan_to_num(result.snr, nan=-np.inf) for result in self.results.values()], axis=0
        )
        self.order = np.lexsort((-best, ~self.imaged))
        self.shown = np.zeros(len(first), bool)
        pictured = self.order[:_PICTURES]
        self.shown[pictured] = self.imaged[pictured]

    def sheet(self, rows):
        """Return pictures of some sources, and where their stretches end."""
        return self.pictures.sheet(self.sky[rows])

    def describe(self):
        """Return what all sources have in common, and the list of them."""
        layout = self.pictures.describe()
        waves = [Filter.from_name(band).pivot.value for band in self.results]
        labels = list(map(band_label, self.results))
        flag_columns = []
        for band, label in zip(self.results, labels, strict=True):
            flag_columns.append([f"flags_{band}", "photometry", label])
        limits = f"{self.confidence:.3g} confidence where below {self.detected:g} sigma"
        return {
            "turn": float(grid_angle(self.highres.wcs, self.highres.shape).to_value("deg")),
            "detected": self.detected,
            "prior": str(self.highres.meta.get("filter", "")),
            "cutouts": layout,
            "flags": {"photometry": ForcedFlags.meanings()},
            "flag_columns": flag_columns,
            "bands": band_entries(self.results, labels, waves, miri=self.results),
            "sets": [],
            "wave": rounded([0.7 * min(waves), 1.4 * max(waves)]),
            "table": self._table(),
            "columns": self._columns(labels, f"magnitude, or its limit ({limits})"),
            "shows": {
                "all": ["all of the catalog", None],
                "detected": ["with a magnitude in any band", "with_magnitude"],
            },
            "heading": [["ra", "RA", 6], ["dec", "Dec", 6]],
            "notes": {
                "pictured": f"{self.shown.sum()} sources have pictures, those of the highest signal-to-noise.",
                "images": image_note(
                    layout, "along the pixels of each image; circle: 1 arcsec about the position"
                ),
                "spectrum": f"Arrows: upper limits, {limits}.",
            },
        }

    def _table(self):
        """Return columns of the table of all sources, in the order of the page."""
        table = {"id": self.id, "ra": self.sky.ra.deg, "dec": self.sky.dec.deg}
        has_magnitude = np.zeros(len(self.id), bool)
        for band, result in self.results.items():
            # magnitudes of detections, limits of all others
            is_limit = ~(result.snr > self.detected)
            has_magnitude |= ~is_limit
            mag = np.where(is_limit, ab_magnitude(self.limits[band]), ab_magnitude(result.flux))
            table |= {f"mag_{band}": mag, f"limit_{band}": is_limit, f"sn_{band}": result.snr}
            table |= {f"chi2_{band}": result.chi2, f"flags_{band}": result.flags}
        table["with_magnitude"] = has_magnitude
        for key, values in table.items():
            digits = 9 if key in ("ra", "dec") else 4
            table[key] = rounded(np.asarray(values)[self.order], digits)
        return table

    def _columns(self, labels, magnitude):
        """Describe the columns of the list of sources, ``magnitude`` being what those are."""
        columns = [list_column("id", "id", "id of the catalog")]
        groups = (
            ("AB", "mag", magnitude, 2),
            ("χ²", "chi2", "template-weighted mean of (residual / sigma)²", 2),
            ("S/N", "sn", "measured flux over its error", 1),
        )
        for group, key, title, digits in groups:
            for band, label in zip(self.results, labels, strict=True):
                options = {"group": group, "digits": digits}
                if key == "mag":
                    options["limit"] = f"limit_{band}"
                columns.append(list_column(f"{key}_{band}", label, title, **options))
        title = "flags of all bands"
        columns.append(list_column("flags", "in words", title, group="flags", text=True))
        return columns

    def entry(self, row):
        """Return the details of a source."""
        values = {"flux": [], "error": [], "flags": [], "upper": []}
        for band, result in self.results.items():
            values["flux"].append(result.flux.value[row])
            values["error"].append(result.flux_err.value[row])
            values["flags"].append(result.flags[row])
            values["upper"].append(self.limits[band].value[row])
        for key, numbers in values.items():
            values[key] = rounded(numbers)
        values["bits"] = {"photometry": values.pop("flags")}
        return values | {"imaged": bool(self.imaged[row])}
