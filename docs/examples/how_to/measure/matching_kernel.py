"""
Make a matching kernel of two PSFs
==================================

You have two images of different resolution. You want the kernel that brings the sharp one to the PSF of the
wide one, and to know how good it is.
"""

# %%
# PSFs of the mosaics: F444W and F560W on pixels of 0.06 arcsec. Arrays, files and photutils models work too.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np

from miricigale.plotting.images import plot_image
from miricigale.psf import MatchingKernel, filter_psf
from miricigale.scene import example_field

form = {"pixel_scale": 0.06 * u.arcsec, "pa": 30 * u.deg}
sharp, wide = filter_psf("F444W", **form), filter_psf("F560W", **form)
kernel = MatchingKernel.from_psfs(sharp, wide, extent=10 * u.arcsec)

# %%
# The regularization is chosen automatically. Larger values leave an error of the encircled energy, smaller ones
# amplify noise more.

print("regularization  error of the encircled energy  noise gain")
for value in (0.1, 0.001, kernel.regularization, 1e-8):
    options = {"extent": 10 * u.arcsec, "regularization": value}
    one = MatchingKernel.from_psfs(sharp, wide, **options)
    print(f"{value:14.1e}  {one.meta['max_error']:29.4f}  {one.noise_gain:10.3f}")

# %%
# Kernel, encircled energies, and their difference.

fig, axes = plt.subplots(1, 3, figsize=(12.4, 3.8), layout="constrained")
data = kernel.array / kernel.array.max()
style = {"limits": (-0.02, 0.3), "softening": 0.005, "cmap": "cividis"}
plot_image(data, ax=axes[0], pixel_scale=0.06, title="kernel", **style)
axes[0].set(xlim=(-2.5, 2.5), ylim=(-2.5, 2.5))
kernel.plot(axes[1])
axes[1].set_xlim(0, 3)
radii = np.arange(0.06, 4, 0.06) * u.arcsec
axes[2].plot(radii, 100 * kernel.encircled_energy_error(radii))
axes[2].set(xlabel="radius (arcsec)", ylabel="error of the encircled energy (%)")
plt.show()

# %%
# Convolve an image: here F444W to the resolution of F560W, for colors in matched apertures.

image = example_field(["F444W"], size=12 * u.arcsec).images["nircam.f444w"]
matched = kernel.apply(image)

fig, axes = plt.subplots(1, 2, figsize=(8.4, 4.1), layout="constrained")
plot_image(image.data, ax=axes[0], pixel_scale=0.06, title="F444W")
plot_image(matched.data, ax=axes[1], pixel_scale=0.06, title="at the PSF of F560W")
plt.show()

# %%
# ``kernel.write("kernel.fits")`` keeps it, ``MatchingKernel.read`` reads it back, and also kernels of other
# programs. See :doc:`/method/kernels`, and :doc:`/accuracy/psf` for all MIRI bands.
