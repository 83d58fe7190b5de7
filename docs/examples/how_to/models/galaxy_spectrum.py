"""
Plot a spectrum by component
============================

You want the spectrum of a galaxy with stars, gas, dust and an AGN, its parts, and its fluxes in JWST bands.
"""

# %%
# ``SEDModel.survey`` is a chain of components for real galaxies. A model is called with values of its parameters;
# the others keep their defaults.

import matplotlib.pyplot as plt

from miricigale import SEDModel
from miricigale.filters import FilterSet

model = SEDModel.survey(libraries="bundled")
values = {"age": 2.0, "tau": 1.0, "ebv": 0.35, "q_pah": 3.2, "frac_agn": 0.25}
sed = model(redshift=1.2, mass=5e10, **values)
sed

# %%
# ``components`` holds the parts as observed. Everything but ``stellar_intrinsic``, the light before dust, sums
# to the whole.

bands = FilterSet(["F606W", "F160W", "IRAC1", "F770W", "F1000W", "F1500W"])
colors = {
    "stellar": "tab:orange",
    "nebular": "tab:green",
    "dust": "tab:red",
    "agn_disk": "tab:blue",
    "agn_torus": "tab:purple",
    "agn_polar": "tab:brown",
}

fig, ax = plt.subplots(figsize=(8, 4.5))
intrinsic = sed.components["stellar_intrinsic"]
intrinsic.plot(ax, color="0.7", lw=0.7, label="before dust")
for name, color in colors.items():
    width = 0.4 if name == "nebular" else 1.2
    sed.components[name].plot(ax, color=color, lw=width, label=name)
sed.plot(ax, color="black", lw=1.0, label="sum")
ax.plot(bands.pivots, sed.fluxes(bands), "o", mec="k", mfc="gold", label="bands")
ax.set(xlim=(0.2, 1000), ylim=(0.03, 3e4), title="A galaxy with an AGN at z = 1.2")
ax.legend(ncol=2, fontsize="small")
plt.show()

# %%
# The same fluxes as a table.

table = bands.to_table()
table["flux"] = sed.fluxes(bands).round(2)
table["magnitude"] = table["flux"].to("mag(AB)").round(2)
table

# %%
# Derived quantities come with the spectrum.

for name in ("stellar_mass", "sfr_100myr", "dust_luminosity", "accretion_power"):
    print(f"{name:16s} {sed.derived[name]:.3g}")

# %%
# ``sed.write("galaxy.ecsv")`` writes the spectrum with its parts, ``sed.redshifted(2.0)`` moves it. The
# parameters and their bounds are ``model.parameters``; what each component computes is in
# :doc:`/method/sed/index`.
