"""
Simulate ramps and level-1b files
=================================

You have a scene. You want the raw counts that MIRI would send down, as a JWST ``_uncal.fits`` file.
"""

# %%
# The bundled catalog of GOODS-S has real positions, shapes and redshifts. The flux of a model at 4.4 um stands
# for that at 7.7 um here.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.io import fits
from astropy.table import Table

from miricigale import Detector, Exposure
from miricigale.scene import Scene, read_catalog

catalog = read_catalog("catalog.goodss")
catalog["F770W"] = np.nan_to_num(catalog["nircam.f444w"])
exposure = Exposure(
    "F770W",
    n_groups=60,
    n_integrations=2,
    subarray="SUB256",
    pointing=catalog["sky"][600],
    roll=107 * u.deg,
)
scene = Scene(catalog, exposure, background="low")

# %%
# A forecast tells which sources saturate before anything is exposed.

detector = Detector.miri_imager()
print(detector.forecast(scene, sources=scene.truth).describe())

# %%
# The ramp holds the counts of every group of every integration. The same seed gives the same counts, on any
# number of threads.

ramp = detector.expose(scene, seed=1)
fig, axes = plt.subplots(1, 2, figsize=(8, 4), sharey=True, layout="constrained")
for ax, group in zip(axes, (0, -1), strict=True):
    counts = ramp.data[0, group]
    low, high = np.percentile(counts, [1, 99.7])
    image = ax.imshow(counts, origin="lower", vmin=low, vmax=high, cmap="bone")
    ax.set_title("first group" if group == 0 else "last group")
    fig.colorbar(image, ax=ax, label="DN", shrink=0.7)
plt.show()

# %%
# Write it as level 1b. The official pipeline and other tools read the file.

path = ramp.write("jw01234001001_02101_00001_mirimage_uncal.fits", overwrite=True)
with fits.open(path) as hdus:
    header = hdus[0].header
    keys = ["FILTER", "READPATT", "SUBARRAY", "NGROUPS", "NINTS", "TGROUP"]
    cards = Table({"keyword": keys, "value": [str(header[key]) for key in keys]})
    shape = hdus["SCI"].shape
cards

# %%
# ``Ramp.read(path)`` reads it again. For full frames with many groups, `~miricigale.detector.Detector.expose_to`
# writes the file without holding the ramp in memory. A whole survey from a configuration file is ``miricigale
# run``.
#
# See :doc:`/method/detector` for the effects, :doc:`/method/detector_files` for the file and the official
# pipeline, and :doc:`/accuracy/detector` for the comparison of counts with theory.
