"""
Use your own PSF in a scene
===========================

You have a PSF from STPSF, from stars, or as a FITS file. You want to paint a scene with it in place of the
package's model.
"""

# %%
# A scene takes models of photutils, kernels of astropy, arrays, and files read by `~miricigale.psf.read_psf`.
# The PSF must be on the pixels of the image and hold the pixel response. Here a Gaussian and a Moffat profile
# stand for yours.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.modeling.models import Moffat2D
from astropy.table import QTable

from miricigale import Exposure
from miricigale.instrument import psf_fwhm
from miricigale.psf import make_psf
from miricigale.scene import Scene

exposure = Exposure(
    "F1500W",
    n_groups=50,
    subarray="SUB64",
    pointing="53.13 -27.83",
    roll=0 * u.deg,
)
fwhm = (psf_fwhm("miri.f1500w") / (0.1109 * u.arcsec)).value
y, x = np.mgrid[-30:31, -30:31]
gaussian = np.exp(-4 * np.log(2) * (x**2 + y**2) / fwhm**2)
moffat = Moffat2D(gamma=fwhm / 1.287, alpha=2.5)(x, y)

# %%
# `~miricigale.psf.make_psf` turns an array into a PSF: it needs the pixel scale, and says what the PSF includes,
# so that the detector does not apply it again.

options = {
    "pixel_scale": 0.1109 * u.arcsec,
    "frame": "detector",
    "includes": ["pixel", "ipc"],
}
psfs = {
    "model (default)": None,
    "your Gaussian": make_psf(gaussian / gaussian.sum(), **options),
    "your Moffat": make_psf(moffat / moffat.sum(), **options),
}
star = QTable({"id": [1], "sky": [exposure.wcs.pixel_to_world(35, 32)]})
star["F1500W"] = [500] * u.uJy
star["profile"] = "point"
scenes = {name: Scene(star, exposure, psf=psf) for name, psf in psfs.items()}
images = {name: scene.render().data for name, scene in scenes.items()}

fig, axes = plt.subplots(1, 4, figsize=(11, 2.8), layout="constrained")
for ax, (name, image) in zip(axes[:3], images.items(), strict=True):
    ax.imshow(np.log10(np.maximum(image, 1e-3)), origin="lower", vmin=-2, vmax=2)
    ax.set_title(name)
    ax.set_axis_off()
    axes[3].semilogy(np.arange(35, 64) - 35, image[32, 35:64], label=name)
axes[3].set(xlabel="pixels from the star", ylabel="MJy/sr", ylim=(1e-4, 1e3))
axes[3].legend(fontsize=7)
plt.show()

# %%
# PSFs that vary over the field are a photutils ``GriddedPSFModel``: STPSF writes one, and
# `~miricigale.psf.miri_psf_grid` makes one. A PSF whose pixel or filter is not that of the image is refused.
#
# See :doc:`/method/psf` for reading and checking PSFs, :doc:`/method/scene` for how they are used.
