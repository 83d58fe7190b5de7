"""
Measure a mosaic larger than the memory
=======================================

You have mosaics of tens of thousands of pixels across. You want forced photometry of all of their sources on a
machine of ordinary memory, or on many, and to go on where it was stopped.
"""

# %%
# ``--patches`` names a folder. The prior is measured in squares, each with an overlap around it; what is finished
# stays in the folder, and the same command resumes the rest:
#
# .. code-block:: console
#
#    $ miricigale photometry f770w_i2d.fits f1000w_i2d.fits f444w_sci.fits \
#          --patches patches -o miri.fits
#    $ miricigale photometry f770w_i2d.fits f1000w_i2d.fits f444w_sci.fits \
#          --patches /shared/patches -o miri.fits --scheduler tcp://host:8786
#
# Patches are as large as 2 GB allow, unless ``--patch-size`` says so, and as many are measured side by side as the
# processors and half of the memory of the machine allow. With ``--catalog`` the table has the rows of the catalog,
# in its order. The same in Python, with a small simulated field in place of the mosaics:

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np

from miricigale.photometry import MosaicFile, measure_files
from miricigale.scene import example_field
from miricigale.workflow import measure_patches

field = example_field(["F160W", "F770W"], size=30 * u.arcsec)
for name, image in field.images.items():
    image.write(f"{name}.fits", overwrite=True)
    field.psfs[name].write(f"{name}.psf.fits", overwrite=True)

image, prior = (
    MosaicFile(f"{name}.fits", psf=f"{name}.psf.fits")
    for name in ("miri.f770w", "wfc3.f160w")
)
options = {"second_pass": False}
table = measure_patches(
    image,
    prior,
    "patches",
    patch_size=300,
    overlap=5 * u.arcsec,
    pages=False,
    **options,
)
print(f"{len(table)} sources in {len(set(table['patch']))} patches")
table["id", "sky", "miri.f770w", "miri.f770w_err", "patch"][:5]

# %%
# The folder has the table (``table.fits``), a page of all patches (``index.html``), and of each a table, a page
# and, for each band, images of the model and of the residual. Fluxes are those of the images as a whole, but for
# what each patch finds by itself (background, offset, correlation of the noise, sizes of galaxies):

whole = measure_files(image, prior, **options)
index, apart, _ = whole["sky"].match_to_catalog_sky(table["sky"])
same = apart < 0.02 * u.arcsec
flux, error = whole["miri.f770w"][same], whole["miri.f770w_err"][same]
difference = ((table["miri.f770w"][index[same]] - flux) / error).value
print(f"{len(whole)} sources, {same.sum()} the same in patches")
print(f"median difference {np.nanmedian(np.abs(difference)):.3f} of the error")

ax = plt.subplots(figsize=(6.5, 4), layout="constrained")[1]
ax.semilogx(flux.value, difference, ".")
ax.set(
    xlabel="flux of the whole (µJy)", ylabel="difference in errors", ylim=(-1, 1)
)
plt.show()

# %%
# :doc:`/method/photometry_files` says what is of each patch and what of all, :doc:`/accuracy/photometry_real` how
# fluxes differ and what it takes. See :doc:`/how_to/run/cluster` for workers on other machines.
