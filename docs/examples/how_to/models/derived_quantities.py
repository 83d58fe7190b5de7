"""
Get masses, SFRs and colors
===========================

You have models. You want their physical quantities: stellar mass, star-formation rate, dust and AGN luminosity,
A_V, UV slope, rest-frame colors, or a color of your own.
"""

# %%
# ``derived_columns`` lists what a model gives, with unit and meaning.

import matplotlib.pyplot as plt
import numpy as np
from astropy.table import QTable, Table

from miricigale import SEDModel

model = SEDModel.survey(libraries="bundled")
rows = [(n, str(d.unit), d.text) for n, d in model.derived_columns().items()]
Table(rows=rows, names=["name", "unit", "meaning"])

# %%
# One model:

derived = model.derived(redshift=1.0, age=2.0, tau=0.5, frac_agn=0.2, mass=3e10)
for name in ("stellar_mass", "sfr_100myr", "a_v", "beta", "ir_luminosity", "l_6um"):
    print(f"{name:14s} {derived[name]:.3g}")

# %%
# Many models come as a table, with the fluxes in any bands. Here 600 galaxies of random ages and amounts of dust.

rng = np.random.default_rng(0)
n = 600
galaxies = QTable({"redshift": np.full(n, 0.8)})
galaxies["age"] = rng.uniform(0.3, 6.0, n)
galaxies["tau"] = 10 ** rng.uniform(-1.0, 0.7, n)
galaxies["ebv"] = rng.uniform(0.0, 0.7, n)
fluxes = model.fluxes(galaxies, ["F160W", "F770W"])
specific = fluxes["sfr_100myr"] / fluxes["stellar_mass"]

fig, ax = plt.subplots(figsize=(6.5, 5))
log_rate = np.log10(specific.value)
style = {"s": 14, "cmap": "coolwarm_r", "vmin": -12}
dots = ax.scatter(fluxes["v_j"], fluxes["u_v"], c=log_rate, **style)
fig.colorbar(dots, label="log sSFR of 100 Myr (1/yr)")
ax.plot([0.0, 0.69, 1.6, 1.6], [1.3, 1.3, 2.1, 3.0], "k--", lw=1)
ax.set(xlabel="V - J, rest frame (AB)", ylabel="U - V, rest frame (AB)")
ax.set(title="Model galaxies and the UVJ selection", ylim=(0.0, 3.0))
plt.show()

# %%
# Any other rest-frame color or absolute magnitude: redshift 0 stands for 10 pc.

rest = QTable(galaxies[:5], copy=True)
rest["redshift"] = 0.0
absolute = model.fluxes(rest, ["sedpy.galex_FUV", "sedpy.sdss_r0"])
table = QTable({"age": rest["age"].round(2), "ebv": rest["ebv"].round(2)})
table["M_FUV"] = absolute["sedpy.galex_FUV"].to("mag(AB)").round(2)
table["FUV - r"] = table["M_FUV"] - absolute["sedpy.sdss_r0"].to("mag(AB)").round(2)
table

# %%
# ``mass`` is the mass ever formed, ``stellar_mass`` that of surviving stars. The definitions are in
# :doc:`/method/sed/index`; posteriors of the same quantities come with a fit, :doc:`/method/fitting`.
