"""
Use your own PSF
================

You have the PSF of your mosaic as an array, a FITS file or a model. You want to check it and to measure with
it.
"""

# %%
# Here a Moffat profile stands for an empirical PSF of F770W on pixels of 0.06 arcsec: an array whose sum is not
# 1 and whose core is off the center.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.io import fits
from astropy.modeling.models import Moffat2D

from miricigale.psf import (
    MatchingKernel,
    checked_psf,
    encircled_energy,
    filter_psf,
    hst_psf,
    make_psf,
    psf_table,
    read_psf,
)

y, x = np.mgrid[-50:51, -50:51]
array = 7 * Moffat2D(x_0=0.4, y_0=-0.3, gamma=3.6, alpha=2.0)(x, y)

# %%
# ``make_psf`` states the pixel, and with ``enclosed`` the fraction of all light that is on the grid. A FITS
# file is read in the same way; pixel and angle come from its header if it has them.

facts = {"enclosed": 0.93, "filter": "miri.f770w"}
psf = make_psf(array, pixel_scale=0.06 * u.arcsec, **facts)

header = fits.Header({"PIXELSCL": 0.06})
fits.writeto("psf_f770w.fits", array, header, overwrite=True)
psf = read_psf("psf_f770w.fits", **facts)

# %%
# Compare it with the model of the filter. ``checked_psf`` refuses one that is much wider or narrower than the
# model, or that is not turned as the image.

psf = checked_psf(psf, "F770W")
model = filter_psf("F770W", pixel_scale=0.06 * u.arcsec, pa=0 * u.deg)
table = psf_table([psf, model], radii=[0.3, 0.5, 1.0, 2.0] * u.arcsec)
for name in ("fwhm", "r80", "enclosed", "eef_0.3", "eef_0.5", "eef_1", "eef_2"):
    table[name].info.format = ".3f"
table["fwhm", "r80", "enclosed", "eef_0.3", "eef_0.5", "eef_1", "eef_2"]

# %%

radii = np.linspace(0.05, 2.5, 60) * u.arcsec
fig, ax = plt.subplots(figsize=(6, 4), layout="constrained")
for label, shown in {"own": psf, "model": model}.items():
    ax.plot(radii.value, encircled_energy(shown, radii), label=label)
ax.set(xlabel="radius (arcsec)", ylabel="encircled energy", ylim=(0, 1))
ax.legend()
plt.show()

# %%
# The kernel to this PSF. Its core is brought to the center; ``meta`` records by how much (arcsec).

kernel = MatchingKernel.from_psfs(hst_psf("F160W"), psf)
kernel.meta["centering"]

# %%
# ``ForcedPhotometer(psf=..., highres_psf=...)`` takes all these forms too: arrays, files, photutils and astropy
# models. With the command, use ``--psf file.fits[EXTENSION]`` and ``--psf-scale``. To measure a PSF from stars
# see :doc:`psf_stars`; what is corrected and refused is listed in :doc:`/method/kernels`.
