"""
Correct for Galactic extinction
===============================

You have a catalog and the color excess E(B-V) of the Milky Way, one number or a map. You want fluxes without it.
"""

# %%
# The table has the extinction in each band. The law of Gordon et al. (2023) is the default, because it is the only
# law here that extends to the MIRI bands.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable

from miricigale.filters import FilterSet
from miricigale.sed import band_extinction, color_excess, deredden

bands = ["F435W", "F606W", "F814W", "F160W", "IRAC1", "F770W", "F1000W", "F2100W"]
bands = FilterSet(bands)
excess = np.array([0.005, 0.02, 0.1])
table = band_extinction(bands, excess)

fig, ax = plt.subplots(figsize=(8, 4.2))
for i, ebv in enumerate(excess):
    values = [table[name][i].value for name in bands.names]
    ax.plot(bands.pivots, values, "o-", label=f"E(B-V) = {ebv:g}")
ax.axhline(0.01, color="0.6", ls=":", lw=1)
ax.loglog()
ax.set(xlabel="wavelength (µm)", ylabel="extinction (mag)")
ax.set_title("Galactic extinction in HST, IRAC and MIRI bands")
ax.legend()
plt.show()

# %%
# A map gives E(B-V) at each position: any object with a method ``query``. Those of the package dustmaps work as
# they are; here a gradient stands for one.


class Gradient:
    def query(self, sky):
        return 0.02 + 0.05 * (sky.ra.deg - 53.0)


sky = SkyCoord([53.02, 53.10, 53.18] * u.deg, [-27.8] * 3 * u.deg)
ebv = color_excess(sky, Gradient(), scale=0.86)
ebv.round(4)

# %%
# ``deredden`` corrects fluxes and errors. The table remembers it, and a second correction is an error.

catalog = QTable({"id": [1, 2, 3]})
catalog["acs.f606w"] = [1.0, 0.4, 2.5] * u.uJy
catalog["acs.f606w_err"] = [0.02, 0.02, 0.03] * u.uJy
catalog["miri.f770w"] = [5.0, 9.0, 7.0] * u.uJy
catalog["miri.f770w_err"] = [0.2, 0.2, 0.2] * u.uJy
corrected = deredden(catalog, ebv, ["acs.f606w", "miri.f770w"])
for name in corrected.colnames[1:]:
    corrected[name].info.format = ".3f"
corrected

# %%
# Instead of the data, the models can be dimmed: ``miricigale fit --ebv 0.01``, or ``GalacticExtinction`` in the
# chain. Do one, not both. Multiply values of Schlegel, Finkbeiner & Davis (1998) by 0.86. The laws, their ranges
# and the color of the source are in :doc:`/method/sed/galactic_extinction`.
