"""
Correct offsets between images
==============================

You have a MIRI image whose astrometry differs from the prior's, by a shift or a distortion. You want it
measured and corrected in the fit.
"""

# %%
# A simulated field. The WCS of F770W is wrong by 0.06 arcsec along x, and stretched.

import warnings

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np

from miricigale import ForcedPhotometer
from miricigale.photometry import SourceTemplates
from miricigale.psf import MatchingKernel
from miricigale.scene import example_field

field = example_field(["F160W", "F770W"], size=50 * u.arcsec)
image = field.images["miri.f770w"]
image.wcs.wcs.crpix += [0.06 / 0.11, 0]
image.wcs.wcs.cdelt *= 1.002
kernel = MatchingKernel.from_psfs(
    field.psfs["wfc3.f160w"], field.psfs["miri.f770w"], extent=6 * u.arcsec
)
galaxies = field.truth[field.truth["miri.f770w"] > 0.1 * u.uJy]
templates = SourceTemplates.from_catalog(galaxies, template="sersic")

# %%
# A warning says how far the image lies from its templates. ``max_shift`` fits one shift of the whole image; larger
# shifts are rejected.

photometer = ForcedPhotometer(kernel)
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    without = photometer.measure(image, templates=templates)
print(caught[0].message)
with_shift = photometer.replace(max_shift=0.3 * u.arcsec)
shifted = with_shift.measure(image, templates=templates)
print(f"shift (x, y): {shifted.shift.round(3)} +- {shifted.shift_err.round(3)}")

# %%
# ``offset_order=1`` measures bright isolated sources one by one and fits a linear map of position.

options = {"max_shift": 0.3 * u.arcsec, "offset_order": 1}
mapped = photometer.replace(**options).measure(image, templates=templates)
mapped.offset_map.plot()
plt.show()

# %%

table = mapped.offset_map.sources["id", "dx", "dy", "offset_err", "used"]
for name in ("dx", "dy", "offset_err"):
    table[name].info.format = ".3f"
table[:5]

# %%
# Fluxes of the bright galaxies, with and without the correction:

true = galaxies["miri.f770w"]
fig, ax = plt.subplots(figsize=(6.4, 4), layout="constrained")
for result, label in (
    (without, "no offset"),
    (shifted, "one shift"),
    (mapped, "map"),
):
    bright = result.snr > 20
    ax.plot(true[bright], (result.flux / true)[bright], "o", ms=4, label=label)
    print(f"{label}: median {np.median((result.flux / true)[bright]):.3f}")
ax.axhline(1, color="k", lw=1)
ax.set(
    xscale="log",
    xlabel="true flux (uJy)",
    ylabel="measured / true",
    ylim=(0.6, 1.2),
)
ax.legend()
plt.show()

# %%
# With too few bright sources the order is lowered, with a warning. The command has ``--offset-order``. See
# :doc:`/method/photometry_options`.
