"""
Read the products of a reduction
================================

You have ``_rate``, ``_cal`` and mosaic files, of this package or of the JWST pipeline. You want to use them with
astropy and photutils.
"""

# %%
# First make some: three simulated exposures, reduced to a folder.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.io import fits
from astropy.table import Table
from photutils.aperture import SkyCircularAperture, aperture_photometry

from miricigale import Detector, Exposure
from miricigale.instrument import pixel_area_map
from miricigale.reduction import read_images, reduce_files
from miricigale.scene import Scene

exposure = Exposure(
    "F770W",
    n_groups=60,
    subarray="SUB128",
    pointing="53.13 -27.83",
    roll=20 * u.deg,
)
star = {"id": [1], "ra": [53.13], "dec": [-27.83], "F770W": [100] * u.uJy}
star["profile"] = ["point"]
paths = []
for dither in exposure.dithered("ceers", 3):
    scene = Scene(star, dither, background="low")
    paths.append(f"star{dither.dither}_uncal.fits")
    Detector.miri_imager().expose_to(paths[-1], scene, seed=1, overwrite=True)
files = reduce_files(paths, "products", resume=False)
files["file", "filter", "status"]

# %%
# The planes of a mosaic:

with fits.open("products/mosaic_f770w.fits") as hdus:
    images = [hdu for hdu in hdus[1:] if hdu.is_image]
    planes = Table(
        {
            "extension": [hdu.name for hdu in images],
            "shape": [str(hdu.shape) for hdu in images],
            "type": [hdu.data.dtype.name for hdu in images],
        }
    )
planes

# %%
# `~miricigale.reduction.read_images` gives a `~astropy.nddata.CCDData` with errors, mask, flags, WCS and the
# history in its meta dictionary. It reads files of the pipeline in the same way.

mosaic = read_images("products/mosaic_f770w.fits")[0]
image = mosaic.image
fig, axes = plt.subplots(1, 3, figsize=(10, 3.4), layout="constrained")
for ax, data, title in (
    (axes[0], image.data, "SCI (MJy/sr)"),
    (axes[1], image.uncertainty.array, "ERR (MJy/sr)"),
    (axes[2], mosaic.planes["CON"][0], "CON (exposures)"),
):
    low, high = np.nanpercentile(data, [1, 99.8])
    shown = ax.imshow(data, origin="lower", vmin=low, vmax=high)
    ax.set_title(title)
    ax.set_axis_off()
    fig.colorbar(shown, ax=ax, shrink=0.7)
plt.show()

# %%
# Aperture photometry with photutils. The image is surface brightness: multiply it by the solid angle of the
# pixels.

flux = np.nan_to_num(image.data) * pixel_area_map(image.wcs, image.shape)
flux = (flux * u.MJy).to(u.uJy)
aperture = SkyCircularAperture(exposure.pointing, r=0.7 * u.arcsec)
table = aperture_photometry(flux, aperture, wcs=image.wcs)
table["aperture_sum"][0].round(1)

# %%
# The aperture of 0.7" holds 80 % of the 100 uJy of the star: see the encircled energies in :doc:`/method/psf`.
# For crowded fields use `~miricigale.photometry.ForcedPhotometer`.
#
# See :doc:`/method/reduction_files` for all planes.
