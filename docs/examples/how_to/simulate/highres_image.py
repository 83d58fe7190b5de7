"""
Simulate a high-resolution image
================================

You want an HST or NIRCam image of a simulated field, to a given depth, as the prior of forced photometry.
"""

# %%
# The image has its own grid, north up, and its own PSF. The catalog gives F160W fluxes and shapes of real
# galaxies.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.table import Table

from miricigale.instrument import north_up_wcs
from miricigale.psf import filter_psf
from miricigale.scene import highres_image, read_catalog

catalog = read_catalog("catalog.goodss")
scale = 0.06 * u.arcsec
wcs = north_up_wcs(catalog["sky"][600], scale, (400, 400))
psf = filter_psf("wfc3.f160w", pixel_scale=scale, pa=0 * u.deg)

# %%
# The depth is the 5-sigma limit in an aperture of 0.2" in radius. The figure shows three depths of the same field:

depths = [25.5, 27.6, 29.0]
options = {"wcs": wcs, "psf": psf, "seed": 1}
images = [highres_image(catalog, depth=d * u.ABmag, **options) for d in depths]
fig, axes = plt.subplots(1, 3, figsize=(10, 3.5), layout="constrained")
for ax, depth, image in zip(axes, depths, images, strict=True):
    shown = np.arcsinh(image.data / 0.02)
    ax.imshow(shown, origin="lower", cmap="gray", vmin=-2, vmax=4)
    ax.set_title(f"F160W, 5 sigma {depth} mag")
    ax.set_axis_off()
plt.show()

# %%
# Each image carries its noise as an uncertainty, which agrees with the scatter of the empty sky.

rows = []
for depth, image in zip(depths, images, strict=True):
    scatter = 1.4826 * np.median(np.abs(image.data - np.median(image.data)))
    error = np.median(image.uncertainty.array)
    rows.append((depth, error.round(4), scatter.round(4)))
Table(rows=rows, names=["depth (mag)", "uncertainty (MJy/sr)", "scatter (MJy/sr)"])

# %%
# ``image.write("f160w.fits")`` writes it for `~miricigale.photometry.ForcedPhotometer` or ``miricigale
# photometry``. A NIRCam image needs ``filter="nircam.f444w"`` and the PSF of that filter.
# `~miricigale.scene.example_field` makes images of several bands at once.
#
# See :doc:`/method/scene`.
