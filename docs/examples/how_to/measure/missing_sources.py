"""
Find sources that the prior lacks
=================================

You have a MIRI image with sources that the high-resolution image does not show: red galaxies, drop-outs,
transients. You want their fluxes, and those of their neighbors without their light. This is the second pass.
"""

# %%
# A simulated field. Every third of the brighter galaxies is taken out of the catalog, as if the prior did not
# show it.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np

from miricigale import ForcedPhotometer
from miricigale.photometry import SourceTemplates
from miricigale.plotting.images import plot_image
from miricigale.psf import MatchingKernel
from miricigale.scene import example_field

field = example_field(["F160W", "F770W"], size=16 * u.arcsec)
image = field.images["miri.f770w"]
bright = field.truth[field.truth["miri.f770w"] > 0.2 * u.uJy]
known = bright[np.arange(len(bright)) % 3 > 0]
psfs = field.psfs["wfc3.f160w"], field.psfs["miri.f770w"]
kernel = MatchingKernel.from_psfs(*psfs)

# %%
# Here the known galaxies have the shapes that the catalog states (``template="sersic"``).

templates = SourceTemplates.from_catalog(known, template="sersic")
one_pass = ForcedPhotometer(kernel).measure(image, templates=templates)
photometer = ForcedPhotometer(kernel, second_pass=True)
result = photometer.measure(image, templates=templates)

new = result.new_sources["id", "sky", "flux", "flux_err", "snr", "flags"]
for name in ("flux", "flux_err", "snr"):
    new[name].info.format = ".2f"
new

# %%

noise = 8 * image.uncertainty.array.mean()
style = {
    "pixel_scale": 0.11,
    "limits": (-noise, noise),
    "stretch": "linear",
    "cmap": "RdBu_r",
}
fig, axes = plt.subplots(1, 2, figsize=(9, 4.4), layout="constrained")
plot_image(one_pass.residual.data, ax=axes[0], title="residual, one pass", **style)
plot_image(result.residual.data, ax=axes[1], title="residual, second pass", **style)
ny, nx = image.data.shape
x = (new["sky"].to_pixel(image.wcs)[0] - (nx - 1) / 2) * 0.11
y = (new["sky"].to_pixel(image.wcs)[1] - (ny - 1) / 2) * 0.11
axes[0].plot(x, y, "o", ms=16, mfc="none", mec="k")
plt.show()

# %%
# Known sources next to a new one change:

change = one_pass.flux - result.flux
row = np.nanargmax(change.value)
fluxes = one_pass.flux[row], result.flux[row]
print(f"source {result.id[row]}: {fluxes[0]:.2f} -> {fluxes[1]:.2f}")
print(f"truth: {known['miri.f770w'][row]:.2f}")

# %%
# ``second_pass=None`` leaves it to the evidence of the residual, as the command does: there the new sources are
# the last rows of the table, flagged NOT_IN_CATALOG. Look at them before you use them: residuals of imperfect
# templates can pass for sources. See :doc:`/method/photometry_options` and the completeness measured in
# :doc:`/accuracy/photometry`.
