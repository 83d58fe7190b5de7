"""
Align images
============

You have dithers, or a mosaic, whose coordinates are off by a fraction of an arcsecond. You want them on the
positions of Gaia or of a NIRCam catalog.
"""

# %%
# Simulated dithers, whose WCS is then shifted by hand.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.table import Table

from miricigale import Detector, Exposure, Reducer
from miricigale.reduction import align_images
from miricigale.scene import Scene, read_catalog

catalog = read_catalog("catalog.goodss")
catalog["F770W"] = np.nan_to_num(catalog["nircam.f444w"])
exposure = Exposure(
    "F770W",
    n_groups=400,
    subarray="BRIGHTSKY",
    pointing=catalog["sky"][600],
    roll=107 * u.deg,
)
reducer = Reducer()
images = []
offsets = [(0.25, -0.1), (-0.15, 0.2)]
dithers = exposure.dithered("4-point", 2)
for dither, (east, north) in zip(dithers, offsets, strict=True):
    scene = Scene(catalog, dither, background="low")
    charge = Detector.miri_imager().collect(scene, seed=1)
    image = reducer.calibrate(reducer.fit_ramp(charge))
    wcs = image.wcs.deepcopy()
    shift = [east / np.cos(exposure.pointing.dec), north] * u.arcsec
    wcs.wcs.crval += shift.to_value("deg")
    image.wcs = wcs
    images.append(image)

# %%
# `~miricigale.reduction.align_images` finds the sources of each image, matches them with the catalog, and fits a
# shift and a rotation. Without a catalog the images are aligned to the first.

near = catalog["sky"].separation(exposure.pointing) < 45 * u.arcsec
reference = catalog["sky"][near & (catalog["F770W"] > 3 * u.uJy)]
aligned, solutions = align_images(images, reference, radius=1 * u.arcsec)
Table(
    {
        "offset that was put in": [f"{e:+.2f} {n:+.2f}" for e, n in offsets],
        "east": u.Quantity([s.east for s in solutions]).to("arcsec").round(3),
        "north": u.Quantity([s.north for s in solutions]).to("arcsec").round(3),
        "sources": [s.n_matched for s in solutions],
        "scatter": u.Quantity([s.scatter for s in solutions]).to("mas").round(1),
    }
)

# %%
# Positions of the catalog on a part of the first image, before and after:

fig, axes = plt.subplots(1, 2, figsize=(8.5, 4.3), layout="constrained")
panels = {"before": images[0], "after": aligned[0]}
for ax, (title, image) in zip(axes, panels.items(), strict=True):
    ax.imshow(image.data, origin="lower", vmin=4.8, vmax=5.7, cmap="Greys")
    x, y = image.wcs.world_to_pixel(reference)
    ax.plot(x, y, "o", mfc="none", mec="C3", ms=10)
    ax.set(xlim=(190, 390), ylim=(190, 390), title=title)
    ax.set_xticks([])
    ax.set_yticks([])
plt.show()

# %%
# In a reduction: ``Reducer().run(paths, align=reference)``, or ``align="dithers"``; ``align="visits"`` moves the
# exposures of a visit, which share a guide star, as a whole. The distortion is not changed.
#
# See :doc:`/method/reduction_mosaics`, and :doc:`/accuracy/reduction` for positions after offsets.
