"""
Reduce ramps from MAST to mosaics
=================================

You have ``_uncal.fits`` files of the MIRI imager, of one or several filters. You want calibrated images and a
mosaic of each filter.
"""

# %%
# Here simulated exposures stand for the files. They have the names and the format of files from MAST.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np

from miricigale import Detector, Exposure
from miricigale.reduction import Reducer, read_images, reduce_files
from miricigale.scene import Scene, read_catalog

catalog = read_catalog("catalog.goodss")
for name in ("F770W", "F1000W"):
    catalog[name] = np.nan_to_num(catalog["nircam.f444w"])
detector = Detector.miri_imager()
paths = []
for number, name in enumerate(("F770W", "F1000W"), start=1):
    exposure = Exposure(
        name,
        n_groups=60,
        subarray="SUB256",
        pointing=catalog["sky"][600],
        roll=107 * u.deg,
    )
    for dither in exposure.dithered("4-point", 3):
        scene = Scene(catalog, dither, background="low")
        observation = f"jw0123400{number}001_02101_{dither.dither + 1:05d}"
        path = f"{observation}_mirimage_uncal.fits"
        detector.expose_to(path, scene, seed=1, overwrite=True)
        paths.append(path)

# %%
# The files may be of any stage and in any order. Simulated ramps say which detector made them. For real ones
# tell the Reducer where the reference files are: a local CRDS cache, or files by path.
#
# .. code-block:: python
#
#    from miricigale.reduction import ReferenceCache, ReferenceFiles
#
#    reducer = Reducer(references=ReferenceCache("~/crds_cache"))
#    reducer = Reducer(references=ReferenceFiles(flat="flat.fits", linearity="lin.fits", ...))
#    reducer = Reducer(references="none")    # slopes in DN/s with measured noise

reducer = Reducer()
files = reduce_files(paths, "reduced", reducer=reducer, pixel_scale=0.09 * u.arcsec)
files["file", "filter", "status"]

# %%
# The folder has ``_rate`` and ``_cal`` of each exposure, a mosaic of each filter, and a page of pictures,
# ``index.html``.

fig, axes = plt.subplots(1, 2, figsize=(9, 4.4), layout="constrained")
for ax, name in zip(axes, ("f770w", "f1000w"), strict=True):
    mosaic = read_images(f"reduced/mosaic_{name}.fits")[0].image
    low, high = np.nanpercentile(mosaic.data, [5, 99.5])
    limits = {"vmin": low, "vmax": high}
    image = ax.imshow(mosaic.data, origin="lower", cmap="magma", **limits)
    ax.set_title(name.upper())
    ax.set_axis_off()
    fig.colorbar(image, ax=ax, label="MJy/sr", shrink=0.7)
plt.show()

# %%
# The same command again keeps what is there. On the command line:
#
# .. code-block:: console
#
#    $ miricigale reduce jw*_mirimage_uncal.fits --crds ~/crds_cache -o reduced
#
# For deep fields of several visits add ``--stripes --sky-flat 30 --align visits``
# (:doc:`/method/reduction_mosaics`). A warning that first groups still settle says which ``--skip-first`` to add.
#
# See :doc:`/method/reduction_files` for products and references, and :doc:`/accuracy/reduction_real` for the
# comparison with the official pipeline.
