"""
Measure blends in a crowded field
=================================

You have sources closer together than the PSF is wide. You want their fluxes, and errors that say how much of
one flux may belong to the neighbor: covariance, correlation, and draws.
"""

# %%
# Two points 0.35 arcsec apart and a third one alone, simulated with the PSF of F1500W (FWHM 0.5 arcsec).

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, StdDevUncertainty
from astropy.table import QTable

from miricigale import ForcedPhotometer
from miricigale.instrument import north_up_wcs
from miricigale.photometry import ForcedFlags, SourceTemplates
from miricigale.plotting.images import plot_image
from miricigale.psf import filter_psf

center = SkyCoord(53.1, -27.8, unit="deg")
wcs = north_up_wcs(center, 0.11 * u.arcsec, (81, 81))
east, north = [-1.5, -1.15, 2] * u.arcsec, [-1, -1, 1] * u.arcsec
sky = center.spherical_offsets_by(east, north)
sources = QTable({"id": ["left", "right", "alone"], "sky": sky})
psf = filter_psf("F1500W", pixel_scale=0.11 * u.arcsec, pa=0 * u.deg)

photometer = ForcedPhotometer(psf=psf)
points = SourceTemplates.from_catalog(sources)
sigma = np.full((81, 81), 0.03)
data = np.random.default_rng(5).normal(0, sigma)
image = CCDData(data, unit="MJy/sr", wcs=wcs, uncertainty=StdDevUncertainty(sigma))
image.data += photometer.render(image, points, [1.5, 1.0, 1.5] * u.uJy).value

# %%
# The errors of the blended pair are larger than that of the source alone, which has the same noise.

result = photometer.measure(image, catalog=sources)
table = result.to_table()["id", "flux", "flux_err", "crowded", "flags"]
table["flux"].info.format = table["flux_err"].info.format = ".3f"
table

# %%
# Light that the fit takes from one source goes to the other, so their errors are anticorrelated. The sum of the
# two fluxes is known better than either flux.

pair = result.covariance.toarray()[:2, :2]
print(f"correlation {result.correlation('left', 'right'):.2f}")
print(f"sum {result.flux[:2].sum():.3f} +- {np.sqrt(pair.sum()):.3f}")

# %%
# ``sample`` draws fluxes from the covariance, for colors and fits of blended sources.

draws = result.sample(2000, seed=1)
fig, (left, right) = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
plot_image(image.data, ax=left, pixel_scale=0.11, title="F1500W, simulated")
right.plot(*draws[:, :2].T.value, ".", ms=2, label="left and right")
right.plot(*draws[:, [0, 2]].T.value, ".", ms=2, label="left and alone")
right.plot(1.5, 1.0, "k+", ms=14, label="truth (pair)")
right.set(xlabel="flux of left (uJy)", ylabel="flux of the other (uJy)")
right.legend()
plt.show()

# %%
# The flag BLENDED marks sources whose error is more than twice that of the source alone:

[list(ForcedFlags.names(flag)) for flag in result.flags]

# %%
# Leave such sources out, or fit them together. See :doc:`/method/photometry_errors`, and
# :doc:`/accuracy/photometry` for tests on blended pairs.
