"""
Separate an AGN from its host galaxy
====================================

You have galaxies with a nucleus (an AGN) that MIRI shows and the prior does not. You want the flux of the
point source and the total, each with its error.
"""

# %%
# Six simulated galaxies: Sersic profiles on F160W, and in F770W the same profiles with a point of 0 to 1.5 uJy
# on top.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, StdDevUncertainty
from astropy.table import QTable

from miricigale import ForcedPhotometer
from miricigale.instrument import north_up_wcs
from miricigale.photometry import SourceTemplates
from miricigale.psf import MatchingKernel, filter_psf, hst_psf

center = SkyCoord(53.1, -27.8, unit="deg")
wcs = north_up_wcs(center, 0.11 * u.arcsec, (60, 240))
sky = SkyCoord.from_pixel(20 + 40 * np.arange(6), [30] * 6, wcs)
galaxies = QTable({"id": np.arange(6), "sky": sky, "flux": np.full(6, 3.0) * u.uJy})
galaxies["half_light_radius"] = np.full(6, 0.45) * u.arcsec
galaxies["sersic_index"] = 1.0
galaxies["axis_ratio"] = 0.6
galaxies["position_angle"] = np.arange(6) * 30 * u.deg
nuclei = galaxies["id", "sky"]
nuclei["id"] += 100
point = np.array([0.0, 0.1, 0.2, 0.4, 0.8, 1.5]) * u.uJy

psf = filter_psf("F770W", pixel_scale=0.06 * u.arcsec, pa=0 * u.deg)
kernel = MatchingKernel.from_psfs(hst_psf("F160W"), psf, extent=6 * u.arcsec)
photometer = ForcedPhotometer(kernel)
hosts = SourceTemplates.from_catalog(galaxies, template="sersic")
points = SourceTemplates.from_catalog(nuclei)

noise = np.full((60, 240), 0.012)
data = np.random.default_rng(4).normal(0, noise)
image = CCDData(data, unit="MJy/sr", wcs=wcs, uncertainty=StdDevUncertainty(noise))
image.data += photometer.render(image, hosts, galaxies["flux"]).value
image.data += photometer.render(image, points, point).value

# %%
# ``components=2`` fits a template and a point where this is the better fit. Otherwise ``flux_point`` is NaN.

result = photometer.replace(components=2).measure(image, templates=hosts)
columns = ["id", "flux", "flux_err", "flux_point", "flux_point_err", "chi2"]
table = result.to_table()[columns]
table["true_point"] = point
for name in table.colnames[1:]:
    table[name].info.format = ".2f"
table

# %%

fig, axes = plt.subplots(2, 1, figsize=(8, 6), layout="constrained")
axes[0].imshow(np.arcsinh(image.data / 0.3), origin="lower", cmap="magma")
axes[0].set(
    title="F770W, simulated: the nucleus grows from left to right",
    xticks=[],
    yticks=[],
)
flux, error = result.flux_point.value, result.flux_point_err.value
axes[1].errorbar(np.arange(6), flux, error, fmt="o")
axes[1].plot(np.arange(6), point, "k_", ms=24, label="truth")
axes[1].set(xlabel="galaxy", ylabel="flux of the point (uJy)")
axes[1].legend()
plt.show()

# %%
# A galaxy with a color gradient can look like one with a nucleus: of sources without one some are split too
# (:doc:`/accuracy/photometry`), with a total that stays right. A column ``components`` of the catalog says
# which sources to split. The command has ``--components 2``. See :doc:`/method/photometry_options`.
