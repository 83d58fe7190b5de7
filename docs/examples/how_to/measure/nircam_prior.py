"""
Use a NIRCam image as prior
===========================

You have a NIRCam mosaic (F444W, say) of your MIRI field. You want to use it as the high-resolution prior: its
sources and their shapes, measured on the MIRI image.
"""

# %%
# Simulated mosaics stand for the files: F444W on pixels of 0.06 arcsec and F1000W on 0.11 arcsec. The two
# images may have any pixel scale and orientation; the PSFs must be those of the mosaics, turned to the sky and
# drizzled. :func:`~miricigale.psf.filter_psf` computes such models from the filter, the pixel and PA_APER.

import astropy.units as u
import matplotlib.pyplot as plt

from miricigale import ForcedPhotometer
from miricigale.photometry import detect_sources
from miricigale.plotting.images import plot_segmentation
from miricigale.psf import MatchingKernel, filter_psf
from miricigale.scene import example_field

field = example_field(["F444W", "F1000W"], size=20 * u.arcsec)
nircam, miri = field.images["nircam.f444w"], field.images["miri.f1000w"]

nircam_psf = filter_psf("F444W", pixel_scale=0.06 * u.arcsec, pa=0 * u.deg)
miri_psf = filter_psf("F1000W", pixel_scale=0.06 * u.arcsec, pa=0 * u.deg)
kernel = MatchingKernel.from_psfs(nircam_psf, miri_psf)
kernel

# %%
# Detect the sources on NIRCam. ``stated_on`` converts settings that are meant for other pixels, and ``preset``
# chooses them.

segments, sources = detect_sources(nircam, preset="default")

fig, (left, right) = plt.subplots(1, 2, figsize=(9, 4.4), layout="constrained")
plot_segmentation(nircam.data, segments.data, ax=left, pixel_scale=0.06)
left.set_title(f"F444W, {segments.n_labels} segments")

result = ForcedPhotometer(kernel).measure(miri, nircam, segments, sources)
flux, error = result.flux.value, result.flux_err.value
right.errorbar(sources["flux"].value, flux, error, fmt="o", ms=3)
right.set(xscale="log", xlabel="light in the F444W segment (uJy)")
right.set_yscale("symlog", linthresh=0.1)
right.set(ylabel="F1000W flux (uJy)", ylim=(-0.1, 50))
plt.show()

# %%
# Each source is measured with the template that its F444W image gives: a point, a profile or the image itself.

table = result.to_table("miri.f1000w")
for name in ("miri.f1000w", "miri.f1000w_err", "miri.f1000w_template_snr"):
    table[name].info.format = ".2f"
columns = [
    "miri.f1000w",
    "miri.f1000w_err",
    "miri.f1000w_template",
    "miri.f1000w_template_snr",
]
table["id", *columns][:6]

# %%
# From files, with the models for PSFs that are not given:
#
# .. code-block:: console
#
#    $ miricigale photometry --image f1000w_i2d.fits --highres f444w_i2d.fits -o f1000w.ecsv
#
# Background, weight maps and catalogs of your own are described in :doc:`/method/photometry_files`, templates
# in :doc:`/method/photometry`.
