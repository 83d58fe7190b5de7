"""
Set the background by place and date
====================================

You observe far from the ecliptic poles, or on a certain day. You want the background there, and what it costs in
depth.
"""

# %%
# ``"low"`` is the default, about the darkest tenth of the sky; ``"medium"`` and ``"high"`` are percentiles of the
# zodiacal light.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable

from miricigale.depth import sensitivity, sky_background, zodiacal_factor

rows = []
for name in ("F770W", "F1000W", "F1500W", "F2100W"):
    row = {"filter": name}
    for level in ("low", "medium", "high"):
        background = sky_background(name, level)
        limit = sensitivity(name, 1 * u.h, background=background)
        row[f"{level} sky"] = background.round(1)
        row[f"{level} limit"] = limit.to(u.ABmag).round(2)
    rows.append(row)
QTable(rows)

# %%
# With a position, the levels are percentiles over the days on which the position can be observed.

fields = {"GOODS-S": "53.1 -27.8", "EGS": "214.9 52.8", "COSMOS": "150.1 2.2"}
for label, place in fields.items():
    position = SkyCoord(place, unit="deg")
    sky = sky_background("F1000W", "medium", position=position)
    print(f"{label:8} {sky:.1f}")

# %%
# The figure shows the zodiacal light relative to the low level, by ecliptic latitude:

latitude = np.arange(0, 91, 10)
ax = plt.subplots(layout="constrained")[1]
for level in ("low", "medium", "high"):
    factor = []
    for b in latitude:
        place = SkyCoord(90 * u.deg, b * u.deg, frame="barycentrictrueecliptic")
        factor.append(zodiacal_factor("F1000W", level, position=place.icrs))
    ax.plot(latitude, factor, "o-", label=level)
ax.set(xlabel="ecliptic latitude (deg)", ylabel="zodiacal light / low one (F1000W)")
ax.legend()
plt.show()

# %%
# For one day the model is evaluated (``pip install miricigale[background]``): ``sky_background("F1000W",
# position=position, date="2027-03-01")``. Scenes, plans and studies take these levels:
#
# .. code-block:: console
#
#    $ miricigale plan --bands f770w --time 1500 --background medium --position 53.1 -27.8
#    $ miricigale run goodss --set 'scene.background=["high"]'
#
# See :doc:`/method/planning`.
