"""
Measure the PSF from stars
==========================

You have dithered images with stars. You want to know whether the model PSF is theirs, and a corrected one
if it is not.
"""

# %%
# Four simulated F770W exposures with nine stars each, at different sub-pixel positions and with noise. Their PSF
# is 5 % wider than the model.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.nddata import NDData, StdDevUncertainty
from astropy.table import Table

from miricigale.plotting.images import plot_image
from miricigale.psf import miri_psf, psf_from_stars, psf_table

model = miri_psf("F770W", fov=12 * u.arcsec)
scale = 1.05 * model.pixel_scale
truth = model.replace(pixel_scale=scale)
rng = np.random.default_rng(3)
images, stars = [], []
yy, xx = np.mgrid[:165, :165]
for _ in range(4):
    place = np.array([(x, y) for x in (30, 82, 134) for y in (30, 82, 134)])
    x, y = (place + rng.uniform(-0.5, 0.5, place.shape)).T
    data = rng.normal(0, 1.0, xx.shape)
    for x0, y0 in zip(x, y, strict=True):
        data += truth.evaluate(
            (xx - x0) / 1.05, (yy - y0) / 1.05, 3000.0 / 1.05**2, 0, 0
        )
    images.append(NDData(data, uncertainty=StdDevUncertainty(np.ones(data.shape))))
    stars.append(Table({"x": x.round(), "y": y.round()}))

# %%
# Positions must be correct to half a pixel. The wings of the PSF are taken from the model.

psf = psf_from_stars(images, stars, model, fov=4 * u.arcsec)
fig, axes = plt.subplots(1, 3, figsize=(11, 3.8), layout="constrained")
plot_image(images[0].data, ax=axes[0], pixel_scale=0.111, title="one exposure")
plot_image(psf.data, ax=axes[1], pixel_scale=psf.cell, title="PSF from 36 stamps")
change = psf.data - model.data
plot_image(change, ax=axes[2], pixel_scale=psf.cell, title="less the model")
for ax in axes[1:]:
    ax.set(xlim=(-2, 2), ylim=(-2, 2))
plt.show()

# %%
# The meta dictionary says what was done, and how accurate the flux of a point source is with this PSF:

for name in ("correction", "width", "wings_4", "flux_err"):
    value = psf.meta[name]
    print(name, value if isinstance(value, str) else round(value, 3))

# %%

table = psf_table([model, psf, truth], radii=[0.3, 0.5, 1.0, 1.5] * u.arcsec)
names = ["fwhm", "enclosed", "eef_0.3", "eef_0.5", "eef_1", "eef_1.5"]
for name in names:
    table[name].info.format = ".3f"
table[names]

# %%
# ``psf.write("psf.fits")`` keeps it. Forced photometry does all this by itself with
# ``ForcedPhotometer(kernel, psf_stars=True)``: it finds the stars on the image and the prior. See
# :doc:`/method/psf`, and :doc:`/accuracy/psf` for tests.
