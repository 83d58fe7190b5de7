"""
Drizzle images onto your own grid
=================================

You have calibrated images (``_cal.fits``). You want a mosaic on the pixels of another image, such as a NIRCam
mosaic.
"""

# %%
# Three simulated dithers stand for the calibrated images. ``Reducer.run`` takes their paths: exposures of any
# stage are reduced from where they are.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np

from miricigale import Detector, Exposure
from miricigale.instrument import north_up_wcs
from miricigale.reduction import Reducer, write_image
from miricigale.scene import Scene, read_catalog

catalog = read_catalog("catalog.goodss")
catalog["F770W"] = np.nan_to_num(catalog["nircam.f444w"])
exposure = Exposure(
    "F770W",
    n_groups=80,
    subarray="SUB256",
    pointing=catalog["sky"][600],
    roll=107 * u.deg,
)
reducer = Reducer()
paths = []
for dither in exposure.dithered("ceers", 3):
    scene = Scene(catalog, dither, background="low")
    charge = Detector.miri_imager().collect(scene, seed=1)
    cal = reducer.calibrate(reducer.fit_ramp(charge))
    paths.append(f"dither{dither.dither}_cal.fits")
    write_image(cal, paths[-1], overwrite=True)

# %%
# The grid is a WCS with its ``pixel_shape``: that of your image (``WCS(header)``), or a new one. Here it has
# pixels of 0.04" and is smaller than the field.

wcs = north_up_wcs(catalog["sky"][600], 0.04 * u.arcsec, (450, 450))
result = reducer.run(paths, wcs=wcs)

# %%
# Without a WCS the mosaic is the smallest north-up grid that holds all dithers, with ``pixel_scale`` of 0.11".

default = reducer.run(paths)
fig, axes = plt.subplots(1, 2, figsize=(9, 4.6), layout="constrained")
for ax, mosaic, title in zip(
    axes,
    (result.mosaic, default.mosaic),
    ("your grid, 0.04 arcsec", "default, 0.11 arcsec"),
    strict=True,
):
    ax.imshow(mosaic.data, origin="lower", vmin=-0.15, vmax=0.6, cmap="cividis")
    ny, nx = mosaic.shape
    ax.set_title(f"{title}: {nx} x {ny} pixels", fontsize=10)
    ax.set_axis_off()
plt.show()

# %%
# Write the mosaic with its planes (ERR, DQ, WHT, CON, BKG).

result.write("mosaic_f770w.fits", overwrite=True)
result

# %%
# The Reducer has the settings of all steps: ``Reducer(mosaics=MosaicSettings(pixfrac=0.8))``,
# ``Reducer(background="dithers")``. The PSF of the mosaic is wider than that of an exposure; see
# `~miricigale.psf.psf_mosaic`.
#
# See :doc:`/method/reduction_mosaics`.
