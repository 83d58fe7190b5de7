"""
Use a galaxy image as a source
==============================

You have an image of a nearby galaxy, or of a simulated one. You want to see it as MIRI would, with an active
nucleus.
"""

# %%
# A spiral that is drawn here stands for the image. `~miricigale.scene.Cutout` needs the array, the pixel scale
# and the position angle; ``Cutout.from_image`` takes them from an image with a WCS. Only the form counts: the
# flux is that of the catalog.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.table import QTable

from miricigale import Exposure
from miricigale.scene import Cutout, Scene

y, x = np.mgrid[-60:61, -60:61]
radius, angle = np.hypot(x, y * 1.4), np.arctan2(y * 1.4, x)
arms = 1 + 0.9 * np.cos(2 * angle - radius / 5)
light = np.exp(-radius / 14) * arms
galaxy = Cutout(light, pixel_scale=0.05 * u.arcsec, angle=30 * u.deg)

# %%
# The catalog gives the place and the flux. A column without unit that ``agn`` names is the share of the flux in
# a point at the center.

exposure = Exposure(
    "F770W",
    time=20 * u.min,
    subarray="SUB64",
    pointing="53.13 -27.83",
    roll=0 * u.deg,
)
center = exposure.wcs.pixel_to_world(35.5, 31.5)
shares = [0.0, 0.2, 0.6]
scenes = []
for share in shares:
    sources = QTable({"id": [1], "sky": [center], "F770W": [200] * u.uJy})
    sources["profile"] = "cutout"
    sources["frac_agn"] = share
    options = {"cutouts": {1: galaxy}, "agn": "frac_agn", "background": "low"}
    scenes.append(Scene(sources, exposure, **options))

fig, axes = plt.subplots(1, 4, figsize=(11, 3), layout="constrained")
axes[0].imshow(light, origin="lower", cmap="magma")
axes[0].set_title("image that was given")
for ax, share, scene in zip(axes[1:], shares, scenes, strict=True):
    ax.imshow(np.arcsinh(scene.render().data - 4.9), origin="lower", cmap="magma")
    ax.set_title(f"F770W, AGN fraction {share}")
for ax in axes:
    ax.set_axis_off()
plt.show()

# %%
# The truth keeps the two parts apart.

truth = scenes[1].truth
for name in ("flux_total", "flux_agn", "flux_in_image"):
    truth[name].info.format = ".2f"
truth["id", "profile", "flux_total", "flux_agn", "flux_in_image"]

# %%
# The image stands for the light before the telescope. If it was taken by a telescope whose PSF is not much
# sharper than MIRI's, take that PSF out first with `~miricigale.scene.deconvolve`.
#
# See :doc:`/method/scene` for cutouts and AGN, :doc:`/accuracy/scene` for their accuracy.
