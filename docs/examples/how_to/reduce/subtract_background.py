"""
Subtract the background and check it
====================================

You have a calibrated image with the sky in it. You want to subtract the background without the light of the
sources, and know how far the result can be trusted.
"""

# %%
# A simulated exposure with a gradient of the sky.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.table import Table

from miricigale import Detector, Exposure, Reducer
from miricigale.reduction import BackgroundSettings
from miricigale.scene import Background, Scene, read_catalog

catalog = read_catalog("catalog.goodss")
catalog["F770W"] = np.nan_to_num(catalog["nircam.f444w"])
exposure = Exposure(
    "F770W",
    n_groups=80,
    subarray="BRIGHTSKY",
    pointing=catalog["sky"][600],
    roll=107 * u.deg,
)
tilted = Background(5 * u.MJy / u.sr, gradient=0.1 / u.arcmin)
scene = Scene(catalog, exposure, background=tilted)
reducer = Reducer()
rate = reducer.fit_ramp(Detector.miri_imager().collect(scene, seed=1))
cal = reducer.calibrate(rate)

# %%
# ``subtract_background`` returns the image without it, and the `~miricigale.reduction.Background` itself.

image, background = reducer.subtract_background(cal)
background

# %%
# Sources are masked before the level is measured. The mask shows what was taken for a source.

fig, axes = plt.subplots(1, 4, figsize=(12, 3.2), layout="constrained")
panels = (
    (cal.data, 4.7, 5.5, "calibrated"),
    (background.source_mask, 0, 1, "taken for sources"),
    (background.level, 4.7, 5.5, "background"),
    (image.data, -0.2, 0.4, "subtracted"),
)
for ax, (data, low, high, title) in zip(axes, panels, strict=True):
    ax.imshow(data, origin="lower", vmin=low, vmax=high, cmap="viridis")
    ax.set_title(title)
    ax.set_axis_off()
plt.show()

# %%
# ``background.trusted`` and ``flags`` say whether there was enough sky, ``error`` how well the level is known.
# Compare it with the true level, and with the plain mesh that Yang et al. (2021) use:

truth = tilted.image(exposure.wcs, exposure.shape)
plain = Reducer(background=BackgroundSettings("sep", box=32))
rows = []
for name, tested in (("masked", reducer), ("sep", plain)):
    level = tested.subtract_background(cal)[1].level
    error = level - truth
    rows.append((name, np.median(error).round(4), np.std(error).round(4)))
Table(rows=rows, names=["method", "median error (MJy/sr)", "scatter (MJy/sr)"])

# %%
# With three dithers or more ``Reducer(background="dithers")`` takes structure that stays on the detector from
# the other dithers.
#
# See :doc:`/method/reduction_mosaics` for the method, and :doc:`/accuracy/reduction` for the light of sources
# that a background takes.
