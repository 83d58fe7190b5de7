"""
Find cosmic-ray hits in ramps
=============================

You have ramps. You want to know where cosmic rays hit, what was cut out, and how the threshold acts.
"""

# %%
# A simulated exposure of a flat sky, of which the true hits are known.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.nddata import CCDData
from astropy.table import QTable

from miricigale import Detector, Exposure, Reducer
from miricigale.instrument import DQ

exposure = Exposure(
    "F1000W",
    n_groups=100,
    subarray="SUB256",
    pointing="53.13 -27.83",
    roll=0 * u.deg,
)
sky = CCDData(np.full(exposure.shape, 11.5), unit="MJy/sr")
detector = Detector.miri_imager()
ramp = detector.expose(sky, exposure, seed=1)

# %%
# ``fit_groups`` gives every plane of the fit, and a table of the jumps: pixel, integration, the first group
# after the jump, and significance.

fit = Reducer(jump_threshold=5).fit_groups(ramp)
jumps = QTable(fit.jumps)
jumps["significance"].info.format = ".1f"
jumps[:5]

# %%
# Two flags mark the pixels of the slope image: a jump of its own, or that of a neighbor. Neither masks the
# pixel. Its slope comes from the groups before and after, with a larger error.

own = (fit.flags & int(DQ.JUMP_DET)) != 0
neighbor = ((fit.flags & int(DQ.JUMP_NEIGHBOR)) != 0) & ~own
plain = Reducer(jump_threshold=None).fit_groups(ramp)

fig, axes = plt.subplots(1, 3, figsize=(11, 3.6), layout="constrained")
for ax, one, title in (
    (axes[0], plain, "slopes without jump detection"),
    (axes[1], fit, "slopes with jumps cut out"),
):
    ax.imshow(one.rate, origin="lower", vmin=20, vmax=36, cmap="gray")
    ax.set_title(title, fontsize=10)
axes[2].imshow(own + 2 * neighbor, origin="lower", cmap="inferno")
axes[2].set_title("jump (violet), neighbor (yellow)", fontsize=10)
for ax in axes:
    ax.set_axis_off()
plt.show()

# %%
# A lower threshold finds fainter hits, and cuts differences in which there is only noise. ``Detector.collect``
# with the same seed has the true hits, so that these can be counted. Cuts in neighbors of large hits are not
# jumps of their own.

hits = detector.collect(sky, exposure, seed=1).hits
true = set(zip(*hits.tolist(), strict=True))
rows = []
for threshold in (4.0, 4.5, 5.0, 7.0):
    found = Reducer(jump_threshold=threshold).fit_groups(ramp).jumps
    noise = sum(tuple(j) not in true for j in found[["group", "y", "x"]].tolist())
    rows.append((threshold, len(found), noise))
QTable(rows=rows, names=["threshold (sigma)", "jumps", "without a hit"])

# %%
# For showers around large hits use ``Reducer(ramps=RampSettings(shower_threshold=5))``. Dithers reject what is
# left (`~miricigale.reduction.reject_outliers`).
#
# See :doc:`/method/reduction_slopes` for the statistic, and :doc:`/accuracy/reduction_real` for recall and
# precision.
