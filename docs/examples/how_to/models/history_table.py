"""
Use a star formation history
============================

You have star-formation histories of a simulation, or one drawn by hand. You want the spectra, colors and masses
of such galaxies.
"""

# %%
# A table has a column ``time`` and a column of rates for each galaxy. Each row begins a bin of constant rate.
# Bins may have any width.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.table import QTable, Table

from miricigale import SEDModel
from miricigale.sed import components as c

time = np.arange(0, 3000, 20)
rng = np.random.default_rng(3)
table = QTable({"time": time * u.Myr})
table["steady"] = np.full(time.size, 5.0) * u.Msun / u.yr
table["bursty"] = 5.0 * np.exp(rng.normal(0, 1.2, time.size)) * u.Msun / u.yr
table["quenched"] = 12.0 * np.exp(-(((time - 900) / 500.0) ** 2)) * u.Msun / u.yr
table.write("histories.ecsv", overwrite=True)

# %%
# ``TableSFH`` takes the table or the file. ``sfh_index`` selects the galaxy, so that it can be an axis of a grid.

sfh = c.TableSFH("histories.ecsv")
dust = c.CalzettiLeitherer(ebv=0.15), c.DraineLi2007()
model = SEDModel([sfh, c.BC03(), c.Nebular(), *dust])
names = table.colnames[1:]

fig, axes = plt.subplots(2, 1, figsize=(8, 7), layout="constrained")
for i, name in enumerate(names):
    axes[0].step(time / 1e3, table[name].value, where="post", label=name, lw=1)
    formed = np.sum(table[name].value) * 20e6
    model(sfh_index=i, redshift=1.0, mass=formed).plot(axes[1], label=name, lw=1)
axes[0].set(xlabel="time (Gyr)", ylabel="SFR (Msun/yr)")
axes[0].set(yscale="log", ylim=(0.02, 200))
axes[1].set(xlim=(0.2, 40), ylim=(0.02, 100), title="The same galaxies at z = 1")
axes[0].legend(loc="lower left")
plt.show()

# %%
# ``mass`` scales a history: it is the mass of all stars ever formed. Quantities of the galaxies:

quantities = ["sfr_10myr", "sfr_100myr", "age_mass", "u_v", "v_j"]
rows = []
for i, name in enumerate(names):
    formed = np.sum(table[name].value) * 20e6
    d = model.derived(sfh_index=i, redshift=1.0, mass=formed)
    values = [d[quantity].value for quantity in quantities]
    rows.append((name, np.log10(d["stellar_mass"].value), *values))
result = Table(rows=rows, names=["history", "log_stellar_mass", *quantities])
result.round(2)
result

# %%
# In a configuration of a fit: ``{name = "sfh_table", path = "histories.ecsv"}``. How bins become steps of 1 Myr
# is in :doc:`/method/sed/sfh_table`; analytic histories are :doc:`/method/sed/delayed` and
# :doc:`/method/sed/double_exponential`.
