"""
Get upper limits and depth
==========================

You have sources that are not detected in a band. You want upper limits for them, and the depth (limiting
magnitude) of the image from fits at empty positions.
"""

# %%
# This cell simulates a field. The sources are detected in F160W, and forced photometry gives each of them a flux
# and an error in F1000W, whether it is detected there or not.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.coordinates import SkyCoord

from miricigale import ForcedPhotometer
from miricigale.photometry import image_errors
from miricigale.scene import example_field

field = example_field(["F160W", "F1000W"], size=20 * u.arcsec)
image, prior = field.images["miri.f1000w"], field.images["wfc3.f160w"]
photometer = ForcedPhotometer(
    psf=field.psfs["miri.f1000w"],
    highres_psf=field.psfs["wfc3.f160w"],
)
result = photometer.measure(image, prior)

# %%
# Upper limits have a confidence: the true flux, which is not negative, is below them in 95 of 100 cases. Keep
# flux and error for fits: they say more than a limit.

table = result.to_table(confidence=0.95)["id", "flux", "flux_err", "snr", "upper"]
faint = table[table["snr"] < 3]
faint["limit_mag"] = faint["upper"].to(u.ABmag)
for name in ("flux", "flux_err", "snr", "upper", "limit_mag"):
    faint[name].info.format = ".2f"
faint[:5]

# %%
# Depth of the image alone, without a catalog: for circles, and points that are fitted with the PSF. ``factor`` is
# what the correlation of the noise adds, and ``scatter`` that of fluxes at empty positions over the errors.

psf = field.psfs["miri.f1000w"]
errors = image_errors(image, diameters=[0.5, 1.0] * u.arcsec, psf=psf, seed=1)
for name in ("error", "factor", "limit_mag", "scatter"):
    errors.table[name].info.format = ".3f"
errors.table["aperture", "error", "factor", "limit_mag", "scatter"]

# %%
# As a check, fit points at empty positions, on the image without its sources. Here they are on a grid of 1.5
# arcsec, at least 1 arcsec from any source.

empty = image.copy()
empty.data = result.residual.data
x, y = np.mgrid[8:173:13.6, 8:173:13.6].reshape(2, -1)
sky = SkyCoord.from_pixel(x, y, image.wcs)
away = sky.match_to_catalog_sky(result.sky)[1] > 1 * u.arcsec
points = ForcedPhotometer(psf=field.psfs["miri.f1000w"])
blank = points.measure(empty, sky[away])

# %%
# Their scatter is the error of a point source. The stated errors should agree with it.

flux = blank.flux
scatter = 1.4826 * np.median(np.abs(flux - np.median(flux)))
stated = np.median(blank.flux_err)
print(f"{len(blank)} positions: scatter {scatter:.4f}, stated error {stated:.4f}")
print(f"5-sigma depth {(5 * scatter).to(u.ABmag):.2f}")

# %%

fig, ax = plt.subplots(figsize=(6.4, 4), layout="constrained")
edges = np.linspace(-5, 8, 40) * scatter.value
ax.hist(flux.value, edges, alpha=0.5, label="empty positions")
ax.hist(result.flux.value, edges, histtype="step", label="sources of the prior")
ax.axvline(3 * scatter.value, color="k", ls="--", label="3 sigma")
ax.axvline(5 * scatter.value, color="k", ls=":", label="5 sigma")
ax.set(xlabel="F1000W flux (uJy)", ylabel="number")
ax.legend()
plt.show()

# %%
# ``miricigale errors image.fits`` writes the table, a page and maps of the limits; the page of ``miricigale
# photometry`` has the test at empty positions. For limits before you observe see
# :doc:`/method/depth`; for errors in your image by injected sources, :doc:`check_errors`.
