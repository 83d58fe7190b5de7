"""
Look at the ramp of one pixel
=============================

You have ramps, simulated or real. You want to see how the counts of a pixel grow, where a cosmic ray hit it, and
where it saturates.
"""

# %%
# Two bright stars on a dark sky: one that saturates, one that does not.

import astropy.units as u
import matplotlib.pyplot as plt
from astropy.table import QTable

from miricigale import Detector, Exposure, Reducer
from miricigale.instrument import DQ
from miricigale.scene import Scene

exposure = Exposure(
    "F770W",
    n_groups=50,
    subarray="SUB128",
    pointing="53.13 -27.83",
    roll=0 * u.deg,
)
sky = exposure.wcs.pixel_to_world([40, 90], [60, 60])
stars = QTable({"id": [1, 2], "sky": sky, "F770W": [60, 5] * u.mJy})
stars["profile"] = "point"
scene = Scene(stars, exposure, background="low")
ramp = Detector.miri_imager().expose(scene, seed=2)

# %%
# The fit of the slopes lists every jump that it found, with its significance. The largest in the sky:

fit = Reducer().fit_groups(ramp)
jumps = QTable(fit.jumps)
jumps["significance"].info.format = ".1f"
jumps.sort("significance", reverse=True)
jumps = jumps[(jumps["group"] > 10) & (jumps["group"] < 40) & (jumps["y"] > 90)]
jumps[:5]

# %%
# ``ramp.plot`` draws the counts of a pixel. Flagged groups are crossed: of a saturated pixel all from the group
# in which it is full. The counts of the hit pixel jump, and go on with the slope from before.

x, y = int(jumps["x"][0]), int(jumps["y"][0])
fig, axes = plt.subplots(1, 3, figsize=(10, 3.4), layout="constrained")
places = {"saturated star": (40, 60), "star": (90, 60), "cosmic ray": (x, y)}
for ax, (title, pixel) in zip(axes, places.items(), strict=True):
    ramp.plot(pixel, ax=ax)
    ax.set_title(title)
plt.show()

# %%
# The flags of the slopes say the same: what was left out, and why.

rows = []
for name, (x, y) in places.items():
    flags = ", ".join(DQ.names(int(fit.flags[y, x])))
    rows.append((name, fit.rate[y, x].round(2), fit.n_used[y, x], flags))
QTable(rows=rows, names=["pixel", "slope (DN/s)", "differences used", "flags"])

# %%
# ``Ramp.read("jw..._uncal.fits")`` gives such a ramp of a real exposure, and ``plot()`` without a pixel takes
# one that steadily gathers most counts. See :doc:`/method/reduction_slopes` for the detection of jumps.
