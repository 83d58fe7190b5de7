"""
Add an AGN and vary its fraction
================================

You have a model of a galaxy. You want to see what an AGN of a given fraction adds, and in which MIRI bands it
shows.
"""

# %%
# ``frac_agn`` is the AGN's dust emission over the sum of AGN and galaxy dust emission. The galaxy stays the
# same; the AGN is added.

import astropy.units as u
import matplotlib.pyplot as plt
from astropy.table import QTable

from miricigale import SEDModel

model = SEDModel.yang2021(libraries="bundled")
galaxy = {"redshift": 1.5, "age": 1.0, "tau": 0.5, "ebv": 0.3, "mass": 3e10}
fractions = [0.0, 0.1, 0.3, 0.5, 0.8]

fig, ax = plt.subplots(figsize=(8, 4.5))
for fraction in fractions:
    color = plt.cm.plasma(fraction)
    model(**galaxy, frac_agn=fraction).plot(ax, color=color, label=f"{fraction}")
ax.axvspan(5.0, 28.0, color="0.5", alpha=0.15, lw=0, label="MIRI imager")
ax.set(xlim=(0.3, 500), ylim=(0.1, 1e4))
ax.set_title("AGN fractions of one galaxy, z = 1.5")
ax.legend(title="frac_agn")
plt.show()

# %%
# The AGN shows most in the gap between starlight and PAH features, here in F560W to F770W.

bands = ["F160W", "F560W", "F770W", "F1000W", "F1500W", "F2100W"]
rows = QTable({"frac_agn": fractions})
for name, value in galaxy.items():
    rows[name] = value
fluxes = model.fluxes(rows, bands)
table = QTable({"frac_agn": fractions})
for name in fluxes.colnames:
    if "." in name:
        table[name] = fluxes[name].round(2)
table

# %%
# The fraction has two definitions. The second is the AGN's share of the light at 3-1000 um, and both come with
# every model. Other wavelengths work too, such as ``"5-20um"``.

other = SEDModel.yang2021(libraries="bundled", frac_agn_definition="5-20um")
for name, sed_model in (("dust", model), ("5-20um", other)):
    derived = sed_model.derived(**galaxy, frac_agn=0.3)
    power = derived["accretion_power"].to(u.erg / u.s)
    print(f"definition {name:6s}: accretion power {power:.2e}")

# %%
# A type-1 AGN is seen at a small inclination: ``inclination=30``, with polar dust ``ebv_polar``. See
# :doc:`torus_angles`, :doc:`/method/sed/parametric_torus` and, for whether a fitted fraction is real,
# :doc:`/method/agn`.
