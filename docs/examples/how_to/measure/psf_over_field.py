"""
Use a PSF that varies over a field
==================================

You have a mosaic whose PSF differs from region to region. You want each source measured with the kernel of
its own place.
"""

# %%
# A simulated image: the PSF (Gaussian) grows from 0.30 to 0.40 arcsec from west to east. All sources have 2
# uJy.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, StdDevUncertainty
from astropy.table import QTable

from miricigale import ForcedPhotometer
from miricigale.instrument import north_up_wcs
from miricigale.photometry import SourceTemplates
from miricigale.psf import KernelField, MatchingKernel, gaussian_psf

center = SkyCoord(53.1, -27.8, unit="deg")
wcs = north_up_wcs(center, 0.11 * u.arcsec, (120, 300))
x, y = np.meshgrid(np.arange(12, 290, 11.5), np.arange(10, 111, 10))
sky = SkyCoord.from_pixel(x.ravel(), y.ravel(), wcs)

form = {"pixel_scale": 0.06 * u.arcsec, "fov": 4 * u.arcsec}
sharp = gaussian_psf(0.15 * u.arcsec, **form)
places = SkyCoord.from_pixel([0, 75, 150, 225, 299], [60] * 5, wcs)
widths = [0.40, 0.375, 0.35, 0.325, 0.30] * u.arcsec
kernels = [MatchingKernel.from_psfs(sharp, gaussian_psf(w, **form)) for w in widths]

yy, xx = np.mgrid[:120, :300]
data = np.random.default_rng(1).normal(0, 0.02, xx.shape)
pixel = (0.11 * u.arcsec) ** 2
for x0, y0 in zip(x.ravel(), y.ravel(), strict=True):
    s = (0.40 - 0.10 * x0 / 299) / 2.3548 / 0.11
    shape = np.exp(-0.5 * ((xx - x0) ** 2 + (yy - y0) ** 2) / s**2)
    peak = 2 * u.uJy / pixel / (2 * np.pi * s**2)
    data += shape * peak.to_value(u.MJy / u.sr)
noise = StdDevUncertainty(np.full(data.shape, 0.02))
image = CCDData(data, unit="MJy/sr", wcs=wcs, uncertainty=noise)

# %%
# A ``KernelField`` holds kernels and the places for which they were made, such as the centers of regions. A
# photometer takes it in place of a kernel and blends the kernels next to each source.

field = KernelField(kernels, places)
sources = SourceTemplates.from_catalog(QTable({"sky": sky}))
one = ForcedPhotometer(kernels[2]).measure(image, templates=sources)
many = ForcedPhotometer(field).measure(image, templates=sources)

# %%

fig, axes = plt.subplots(2, 1, figsize=(8, 5.4), layout="constrained")
axes[0].imshow(data, origin="lower", cmap="gray_r", vmin=-0.1, vmax=0.8)
axes[0].set(title="simulated: the PSF is wider on the left", xticks=[], yticks=[])
for result, label in ((one, "one kernel"), (many, "kernel field")):
    axes[1].plot(result.x * 0.11, result.flux, ".", label=label)
axes[1].axhline(2, color="k", lw=1)
axes[1].set(xlabel="x (arcsec)", ylabel="flux (uJy)")
axes[1].legend()
plt.show()

# %%
# Scatter of the fluxes over 2 uJy, with one kernel and with the field:

[round(float(np.std(result.flux.value) / 2), 4) for result in (one, many)]

# %%
# ``KernelField.from_psfs(hi, lo, wcs=wcs)`` makes it of PSFs over the field, such as
# :func:`~miricigale.psf.miri_psf_grid` for MIRI or :func:`~miricigale.psf.psf_grid` for your own. See
# :doc:`/method/photometry_options`.
