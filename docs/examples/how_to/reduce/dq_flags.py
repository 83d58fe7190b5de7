"""
Read the data quality (DQ) flags
================================

You have a reduced image or a JWST product. You want to know why a pixel is masked, and select pixels by their
flags.
"""

# %%
# A simulated exposure of a saturated star, reduced to a calibrated image.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.table import Table

from miricigale import Detector, Exposure, Reducer
from miricigale.instrument import DQ
from miricigale.scene import Scene

exposure = Exposure(
    "F770W",
    n_groups=60,
    subarray="SUB128",
    pointing="53.13 -27.83",
    roll=0 * u.deg,
)
place = exposure.wcs.pixel_to_world(70, 60)
star = {"id": [1], "ra": [place.ra.deg], "dec": [place.dec.deg]}
star["F770W"] = [900] * u.mJy
scene = Scene(star | {"profile": ["point"]}, exposure, background="low")
reducer = Reducer()
ramp = Detector.miri_imager().expose(scene, seed=1)
image = reducer.calibrate(reducer.fit_ramp(ramp))

# %%
# ``image.flags`` has the bits of JWST. `~miricigale.instrument.DQ` gives them names:

present = DQ.names(int(np.bitwise_or.reduce(image.flags, axis=None)))
rows = []
for name in present:
    bit = int(DQ[name.upper()])
    rows.append((name, bit, int(((image.flags & bit) != 0).sum())))
Table(rows=rows, names=["flag", "value", "pixels"])

# %%
# A pixel is masked where DO_NOT_USE is set. The other flags say why, or that a slope is based on fewer groups:
# saturated pixels are only masked if no two groups are left.

fig, axes = plt.subplots(1, 4, figsize=(11, 3), layout="constrained")
axes[0].imshow(np.log10(np.maximum(image.data, 1)), origin="lower", cmap="gray")
axes[0].set_title("image", fontsize=10)
flags = (DQ.SATURATED, DQ.JUMP_DET, DQ.DO_NOT_USE)
for ax, flag in zip(axes[1:], flags, strict=True):
    ax.imshow((image.flags & int(flag)) != 0, origin="lower", cmap="Greys")
    ax.set_title(flag.name, fontsize=10)
for ax in axes:
    ax.set_xticks([])
    ax.set_yticks([])
plt.show()

# %%
# All flags of one pixel:

", ".join(DQ.names(int(image.flags[60, 70])))

# %%
# ``read_images("..._cal.fits")[0].image.flags`` gives the flags of a file, and ``ramp.pixel_dq`` and
# ``ramp.group_dq`` the flags of a ramp. Bits above 2^31 are conditions that JWST does not distinguish; files keep
# them in a plane of their own.
#
# See :doc:`/method/reduction` for the conventions.
