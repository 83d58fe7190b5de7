"""
Do aperture photometry
======================

You have isolated sources and want fluxes in circular apertures, corrected to total, with errors that include
the correlated noise of a drizzled mosaic. Or you want to check forced photometry.
"""

# %%
# A simulated F770W image.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np

from miricigale import ForcedPhotometer
from miricigale.photometry import aperture_correction, aperture_photometry, crowded
from miricigale.psf import radius_of_encircled_energy
from miricigale.scene import example_field

field = example_field(["F160W", "F770W"], size=24 * u.arcsec)
image, psf, truth = (
    field.images["miri.f770w"],
    field.psfs["miri.f770w"],
    field.truth,
)

# %%
# The correction of a point source is the inverse of the encircled energy: it depends on the aperture.

for fraction in (0.5, 0.7, 0.8):
    radius = radius_of_encircled_energy(psf, fraction)
    print(f"{fraction:.0%} of the light within {radius:.2f}")

# %%
# Measure the galaxies that have no bright neighbor within 2 arcsec.

bright = truth["miri.f770w"] > 0.2 * u.uJy
alone = ~crowded(truth["sky"], truth["miri.f770w"])
inside = image.wcs.footprint_contains(truth["sky"])
galaxies = truth[bright & alone & inside]
true = galaxies["miri.f770w"]

fluxes = {}
for diameter in (0.5, 1.0, 2.0) * u.arcsec:
    table = aperture_photometry(image, galaxies["sky"], diameter)
    fluxes[diameter] = table["flux"] * aperture_correction(psf, diameter / 2)

# %%
# Small apertures have less noise, but galaxies are wider than a point: the correction is then too small. A fit
# with templates has neither problem.

prior = field.images["wfc3.f160w"]
photometer = ForcedPhotometer(psf=psf, highres_psf=field.psfs["wfc3.f160w"])
forced = photometer.measure(image, prior)
match, distance, _ = galaxies["sky"].match_to_catalog_sky(forced.sky)
near = distance < 0.2 * u.arcsec

fig, axes = plt.subplots(1, 4, figsize=(12, 3.4), sharey=True, layout="tight")
for ax, (diameter, flux) in zip(axes, fluxes.items(), strict=False):
    ax.plot(true, flux / true, "o", ms=4)
    ax.set_title(f"aperture of {diameter}")
ratio = forced.flux[match] / true
axes[3].plot(true[near], ratio[near], "o", ms=4, color="C1")
axes[3].set_title("forced photometry")
for ax in axes:
    ax.axhline(1, color="k", lw=1)
    ax.set(xscale="log", xlabel="true flux (uJy)", ylim=(0, 2))
axes[0].set_ylabel("measured / true")
plt.show()

# %%
# Median of measured over true flux for the three apertures:

[round(float(np.median(flux / true)), 2) for flux in fluxes.values()]

# %%
# The errors of apertures assume white noise. On a drizzled mosaic of the package, multiply them by
# ``image.meta["noise_correction"]``. See :doc:`/method/photometry_other` and :doc:`/accuracy/photometry`.
