"""
Get the noise of a mosaic right
===============================

You have a mosaic and want errors of aperture fluxes. Drizzled pixels share the light, and so the noise, of input
pixels: the errors of pixels in quadrature are too small.
"""

# %%
# Four simulated dithers of an empty sky, drizzled to three pixel scales.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.nddata import CCDData
from astropy.table import Table

from miricigale import Detector, Exposure, Reducer
from miricigale.instrument import north_up_wcs

exposure = Exposure(
    "F1000W",
    n_groups=80,
    subarray="SUB256",
    pointing="53.13 -27.83",
    roll=30 * u.deg,
)
sky = CCDData(np.full(exposure.shape, 11.5), unit="MJy/sr")
reducer = Reducer()
images = []
for dither in exposure.dithered("4-point"):
    charge = Detector.miri_imager().collect(sky, dither, seed=1)
    image = reducer.calibrate(reducer.fit_ramp(charge))
    images.append(reducer.subtract_background(image)[0])

mosaics = {}
for scale in (0.11, 0.06, 0.04):
    n_pixels = round(18 / scale)
    wcs = north_up_wcs(exposure.pointing, scale * u.arcsec, (n_pixels, n_pixels))
    mosaics[scale] = reducer.mosaic(images, wcs)

# %%
# The scatter of sums over squares of growing size, over their errors in quadrature. It rises from below 1 to the
# factor that the mosaic states in ``meta["noise_correction"]``.


def scatter_of_sums(mosaic, side):
    """Scatter of sums over squares, in units of errors in quadrature."""
    ny, nx = (n // side * side for n in mosaic.shape)

    def sums(values):
        blocks = values[:ny, :nx].reshape(ny // side, side, nx // side, side)
        return blocks.sum(axis=(1, 3))

    pulls = sums(mosaic.data) / np.sqrt(sums(mosaic.uncertainty.array**2))
    pulls = pulls[np.isfinite(pulls)]
    return 1.4826 * np.median(np.abs(pulls - np.median(pulls)))


fig, ax = plt.subplots(figsize=(7, 4), layout="constrained")
rows = []
for number, (scale, mosaic) in enumerate(mosaics.items()):
    style = {"color": f"C{number}"}
    widths = np.array([0.12, 0.24, 0.5, 1.0, 1.5])
    sides = np.maximum(np.round(widths / scale), 1).astype(int)
    factor = mosaic.meta["noise_correction"]
    measured = [scatter_of_sums(mosaic, side) for side in sides]
    label = f"pixels of {scale} arcsec"
    ax.plot(sides * scale, measured, "o-", label=label, **style)
    ax.axhline(factor, ls=":", **style)
    error = np.nanmedian(mosaic.uncertainty.array)
    rows.append((scale, round(float(error), 4), round(factor, 2)))
ax.set(xlabel="side of the square (arcsec)", ylabel="scatter / quadrature errors")
ax.legend()
plt.show()

# %%
# Multiply the error of an aperture that is wider than a few input pixels by this factor:

Table(rows=rows, names=["pixel (arcsec)", "error (MJy/sr)", "noise_correction"])

# %%
# `~miricigale.photometry.ForcedPhotometer` measures the correlated noise on the image and needs no factor.
#
# See :doc:`/method/reduction_mosaics` for the formula, :doc:`/accuracy/reduction` for how well it holds.
