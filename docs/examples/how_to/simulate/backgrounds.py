"""
Give a scene its background
===========================

You want a scene with the zodiacal and telescope background of a filter, a brighter sky, or a gradient.
"""

# %%
# ``background="low"`` is the sky with low zodiacal light. In the red filters the telescope itself dominates, and
# limits how long an integration may be.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import Table

from miricigale import Exposure
from miricigale.depth import saturation_forecast
from miricigale.instrument import (
    background_level,
    background_spectrum,
    imager_filters,
)
from miricigale.scene import Background, Scene

wave = np.geomspace(3, 28, 300) * u.um
fig, ax = plt.subplots(figsize=(7, 3.8), layout="constrained")
ax.loglog(wave, background_spectrum(wave), label="with low zodiacal light")
telescope = background_spectrum(wave, zodi="none")
ax.loglog(wave, telescope, "--", label="telescope alone")
for name in imager_filters():
    micron = float(name.split("f")[-1][:-1]) / 100
    level = background_level(name).value
    ax.plot(micron, level, "ko")
    label = {"rotation": 60, "fontsize": 7, "ha": "right"}
    ax.annotate(name[5:].upper(), (micron, level * 1.3), **label)
ax.set(xlabel="wavelength (um)", ylabel="background (MJy/sr)", ylim=(1e-3, 1e4))
ax.legend()
plt.show()

# %%
# The share of the well that the sky fills in 100 s:

rows = []
for name in ("F560W", "F1000W", "F1500W", "F2100W"):
    exposure = Exposure(name, n_groups=36)
    level = background_level(exposure.filter)
    share = saturation_forecast(exposure)
    rows.append((name, round(level.value, 2), round(100 * share, 1)))
Table(rows=rows, names=["filter", "background (MJy/sr)", "well filled (%)"])

# %%
# A gradient is fixed on the sky: with a ``center``, all dithers see the same one. Here the sky grows by 20 % per
# arcmin toward the north-east.

center = SkyCoord(53.13, -27.83, unit="deg")
tilted = Background(
    6 * u.MJy / u.sr,
    gradient=0.2 / u.arcmin,
    position_angle=45 * u.deg,
    center=center,
)
exposure = Exposure("F770W", n_groups=50, subarray="BRIGHTSKY", pointing=center)
stars = {"id": [1, 2], "ra": [53.131, 53.127], "dec": [-27.829, -27.832]}
stars["F770W"] = [20, 60] * u.uJy
stars["profile"] = ["point", "point"]
image = Scene(stars, exposure, background=tilted).render()
fig, ax = plt.subplots(figsize=(5, 4.2), layout="constrained")
shown = ax.imshow(image.data, origin="lower", vmin=5, vmax=7.2, cmap="viridis")
fig.colorbar(shown, label="MJy/sr")
plt.show()

# %%
# A number is a constant level: ``background=5 * u.MJy / u.sr``. The zodiacal light of a field and date is
# `~miricigale.depth.zodiacal_factor`; give ``background_level(name, zodi=factor)``.
#
# See :doc:`/method/instrument` for the source of the levels.
