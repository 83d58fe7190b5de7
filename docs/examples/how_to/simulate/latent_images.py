"""
Simulate latent images
======================

You observe a deep field after a bright star was on the detector. You want to know what its latent image does to
the next exposures.
"""

# %%
# The effect is optional. The earlier exposures are an argument of ``expose``, so that an exposure depends only on
# its arguments.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.table import QTable

from miricigale import Detector, Exposure, Reducer
from miricigale.detector import Latent, Persistence
from miricigale.scene import Scene

detector = Detector.miri_imager(Persistence())
first = Exposure("F1000W", n_groups=60, subarray="SUB128", pointing="53 -27")
star = QTable({"id": [1], "sky": [first.wcs.pixel_to_world(80, 64)]})
star["F1000W"] = [400] * u.mJy
star["profile"] = "point"
bright = detector.expose(Scene(star, first, background="low"), seed=1)

# %%
# `~miricigale.detector.Latent` remembers the pixels that the star filled. The telescope then points to a faint
# source, and takes three exposures at growing distance in time.

rows, images = [], []
faint = QTable({"id": [2], "sky": [first.wcs.pixel_to_world(40, 90)]})
faint["F1000W"] = [300] * u.uJy
faint["profile"] = "point"
reducer = Reducer()
for number, gap in enumerate([20, 60, 300], start=1):
    exposure = first.replace(dither=number)
    latent = Latent.from_ramp(bright, gap=gap * u.s)
    scene = Scene(faint, exposure, background="low")
    ramp = detector.expose(scene, seed=1, previous=latent)
    clean = detector.expose(scene, seed=1)
    cal, without = (reducer.calibrate(reducer.fit_ramp(r)) for r in (ramp, clean))
    images.append((gap, cal.data))
    excess = np.nansum((cal.data - without.data)[59:70, 75:86])
    rows.append((gap, round(float(excess), 1)))

fig, axes = plt.subplots(1, 3, figsize=(10, 3.6), layout="constrained")
for ax, (gap, data) in zip(axes, images, strict=True):
    ax.imshow(data, origin="lower", vmin=8, vmax=30, cmap="afmhot")
    ax.set_title(f"{gap} s after the star")
    ax.set_axis_off()
plt.show()

# %%
# Light that the latent image adds in 11 x 11 pixels around the place of the star:

QTable(rows=rows, names=["gap (s)", "excess (sum of MJy/sr)"])

# %%
# The amplitudes and times are plausible values, not measurements, and can be given:
# ``Persistence(amplitudes=(0.004,), times=(60.0,))``. The Reducer does not correct latent images; dithers that
# are wider than the star reject them.
#
# See :doc:`/method/detector_effects`.
