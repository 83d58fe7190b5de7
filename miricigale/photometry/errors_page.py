"""The page of the errors of an image."""

from pathlib import Path

import numpy as np
from astropy.table import Table

from miricigale.pages import Page, SectionWriter
from miricigale.photometry.arrays import pixel_scale
from miricigale.plotting.axes import new_figure
from miricigale.plotting.images import plot_image
from miricigale.utils.declared import declared


def write_errors_page(path, errors):
    """Write the page of the errors of an image (`~miricigale.photometry.ImageErrors`)."""
    table, meta = errors.table, errors.table.meta
    report = Page(f"Errors of {Path(meta['source']).name}", subtitle=meta.get("filter", ""))
    page = SectionWriter(report, declared("miricigale.photometry"))
    facts = {"over": meta["noise_over_stated"], "factor": errors.factor}
    page.section("errors", n_free=errors.n_free, **facts)
    page.table("table", [dict(zip(table.colnames, row, strict=True)) for row in Table(table)])
    aperture, limit = next((k, v.value) for k, v in errors.limits.items())
    step = max(1, -(-max(limit.shape) // 1500))
    scale = step * pixel_scale(errors.noise.wcs)
    figure, [[left, right]] = new_figure(1, 2, size=(5.2, 4.2))
    form = {"limits": np.nanpercentile(limit, [1, 99]), "colorbar": "limit (uJy)"}
    plot_image(limit[::step, ::step], ax=left, pixel_scale=scale, stretch="linear", **form)
    form = {"limits": (0, 1), "colorbar": "correlation"}
    shown = errors.correlation / errors.correlation.max()
    plot_image(shown, ax=right, stretch="linear", **form).set(
        xlabel="x (pixels)", ylabel="y (pixels)"
    )
    what = "a point fitted" if aperture == "psf" else f"a circle of {aperture} arcsec"
    page.figure("map", figure, aperture=what, n_sigma=meta["n_sigma"])
    report.write(path)
