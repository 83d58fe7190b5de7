"""
Measure many bands at once
==========================

You have images in several MIRI bands and one prior. You want all bands measured with the same sources and
shapes, in one table with colors.
"""

# %%
# Simulated images in three bands.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np

from miricigale.photometry import (
    SourceTemplates,
    detect_sources,
    join_bands,
    measure_bands,
)
from miricigale.psf import MatchingKernel
from miricigale.scene import example_field

bands = ["miri.f770w", "miri.f1000w", "miri.f1500w"]
field = example_field(["F160W", *bands], size=16 * u.arcsec)
prior, prior_psf = field.images["wfc3.f160w"], field.psfs["wfc3.f160w"]

# %%
# Templates are made once. They do not depend on the band, only on the prior.

segments, sources = detect_sources(prior)
templates = SourceTemplates.from_images(prior, segments, sources, psf=prior_psf)
templates

# %%
# One kernel for each band, and one call for all of them. ``templates.write("templates.fits")`` and
# ``kernel.write("kernel.fits")`` keep them for later images.

images = {name: field.images[name] for name in bands}
kernels = {
    name: MatchingKernel.from_psfs(prior_psf, field.psfs[name], extent=8 * u.arcsec)
    for name in bands
}
results = measure_bands(images, kernels, templates)

table = join_bands(results)
for name in bands:
    table[name].info.format = table[f"{name}_err"].info.format = ".3f"
table["id", *bands, "miri.f1500w_err"][:5]

# %%
# Colors of the sources above 5 sigma in all bands:

good = np.all([table[f"{name}_snr"] > 5 for name in bands], axis=0)
mag = {name: table[name][good].to_value(u.ABmag) for name in bands}
fig, axes = plt.subplots(1, 4, figsize=(10.4, 3.0), layout="constrained")
for ax, name in zip(axes, bands, strict=False):
    style = {"origin": "lower", "cmap": "gray_r", "vmin": -0.05, "vmax": 0.4}
    ax.imshow(images[name].data, **style)
    ax.set(title=name, xticks=[], yticks=[])
axes[3].scatter(
    mag["miri.f770w"] - mag["miri.f1000w"],
    mag["miri.f770w"] - mag["miri.f1500w"],
    c=mag["miri.f770w"],
)
axes[3].set(xlabel="F770W - F1000W", ylabel="F770W - F1500W", title="colors (AB)")
plt.show()

# %%
# With files, ``miricigale photometry f770w.fits f1000w.fits f1500w.fits prior.fits -o miri.ecsv`` does all of
# this. ``table.write("miri.ecsv")`` writes what ``BayesFitter`` and ``miricigale fit`` read. A source that one
# band lacks has NaN and the flag NO_DATA there. For options that differ between bands put a ``ForcedPhotometer``
# in place of a kernel. See :doc:`/method/photometry`.
