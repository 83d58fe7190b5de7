"""
Measure the PSF from stars
==========================

You have dithered images with stars. You want an empirical PSF (effective PSF, ePSF) and to know how it
compares with the model.
"""

# %%
# Four simulated F770W exposures with nine stars each, at different sub-pixel positions and with noise.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.nddata import NDData, StdDevUncertainty
from astropy.table import Table

from miricigale.plotting.images import plot_image
from miricigale.psf import MIRI_PIXEL_SCALE, miri_psf, psf_from_stars, psf_table

truth = miri_psf("F770W")
rng = np.random.default_rng(3)
images, stars = [], []
yy, xx = np.mgrid[:165, :165]
for _ in range(4):
    place = np.array([(x, y) for x in (30, 82, 134) for y in (30, 82, 134)])
    x, y = (place + rng.uniform(-0.5, 0.5, place.shape)).T
    data = rng.normal(0, 1.0, xx.shape)
    for one in zip(x, y, strict=True):
        truth.x_0, truth.y_0, truth.flux = *one, 3000.0
        data += truth(xx, yy)
    images.append(NDData(data, uncertainty=StdDevUncertainty(np.ones(data.shape))))
    stars.append(Table({"x": x.round(), "y": y.round()}))

# %%
# Positions need to be good to a pixel. Stars do not show how much light is outside of their stamps:
# ``enclosed`` takes that from the model.

psf = psf_from_stars(
    images,
    stars,
    fov=4 * u.arcsec,
    oversampling=2,
    pixel_scale=MIRI_PIXEL_SCALE,
    enclosed=truth,
)
fig, axes = plt.subplots(1, 3, figsize=(11, 3.8), layout="constrained")
plot_image(images[0].data, ax=axes[0], pixel_scale=0.111, title="one exposure")
plot_image(psf.data, ax=axes[1], pixel_scale=psf.cell, title="PSF from 36 stamps")
model = miri_psf("F770W", oversampling=2, fov=4 * u.arcsec)
plot_image(model.data, ax=axes[2], pixel_scale=model.cell, title="true PSF")
plt.show()

# %%

table = psf_table([psf, truth], radii=[0.3, 0.5, 1.0, 1.5] * u.arcsec)
names = ["fwhm", "enclosed", "eef_0.3", "eef_0.5", "eef_1", "eef_1.5"]
for name in names:
    table[name].info.format = ".3f"
table[names]

# %%
# ``psf.write("psf.fits")`` keeps it. On images with a WCS give one table with ``sky``; for a drizzled mosaic
# add ``frame="sky"`` and ``includes=(*EFFECTS, "drizzle")``. See :doc:`/method/psf`, and :doc:`/accuracy/psf`
# for a test with stars of lower signal-to-noise.
