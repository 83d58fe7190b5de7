"""
Find out what saturates
=======================

You have bright stars or galaxies in the field. You want to know at which magnitude they saturate, and which
readout avoids it: fewer groups, or a subarray.
"""

# %%
# The magnitude of a point whose brightest pixel is full at the end of an integration, by number of groups and
# subarray:

import astropy.units as u
import matplotlib.pyplot as plt
from astropy.table import QTable

from miricigale import Detector, Exposure, Scene
from miricigale.depth import saturation_flux, saturation_forecast, saturation_time

groups = [5, 10, 20, 40, 80]
ax = plt.subplots(layout="constrained")[1]
for subarray in ("FULL", "BRIGHTSKY", "SUB256", "SUB64"):
    exposures = [Exposure("F770W", n_groups=n, subarray=subarray) for n in groups]
    limits = [saturation_flux(exposure).to_value(u.ABmag) for exposure in exposures]
    ax.semilogx(groups, limits, "o-", label=subarray)
ax.set(xlabel="groups", ylabel="F770W saturates at (AB)")
ax.legend()
plt.show()

# %%
# The sky also fills the well, above all at long wavelengths. ``saturation_time`` is the time at which the well is
# full, and ``saturation_forecast`` gives the filled share of the well at the end of an exposure. Keep this share
# below 0.6.

rows = []
for name in ("F770W", "F1500W", "F2100W", "F2550W"):
    exposure = Exposure(name, n_groups=20)
    row = {"filter": name, "sky fills the well in": saturation_time(name).round(1)}
    row["share after 20 groups"] = round(saturation_forecast(exposure), 3)
    row["points saturate at"] = saturation_flux(exposure).to(u.ABmag).round(2)
    rows.append(row)
QTable(rows)

# %%
# In a simulation the saturated pixels of a star can be seen: groups after saturation are flagged and not fitted.

star = {"ra": [53.13], "dec": [-27.83], "F770W": [30] * u.mJy, "profile": "point"}
options = {"subarray": "SUB256", "pointing": "53.13 -27.83"}
exposure = Exposure("F770W", n_groups=40, **options)
ramp = Detector().expose(Scene(star, exposure, background="low"), seed=1)
y, x = divmod(int(ramp.data[0, -1].argmax()), ramp.shape[-1])
ax = plt.subplots(layout="constrained")[1]
ramp.plot(pixel=(y, x), ax=ax)
ramp.plot(pixel=(y + 4, x), ax=ax)
plt.show()

# %%
# ``miricigale run`` writes such a forecast for each exposure before it is simulated, and ``miricigale plan``
# counts the saturated sources of a plan (``saturates``, ``n_saturated`` of its table of exposures) and those that
# have no flux for it (``n_missing``). See :doc:`/method/planning` and :doc:`/method/detector`.
