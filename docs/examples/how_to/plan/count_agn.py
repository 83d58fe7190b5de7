"""
How many AGN does a survey find?
================================

You plan a survey and want the number of AGN that MIRI detects, by redshift, and how many of them dominate the
infrared light of their galaxies.
"""

# %%
# Galaxies of the bundled catalog get AGN after published luminosity and mass functions. First their models
# without an AGN, scaled to the F160W flux:

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.table import QTable

from miricigale import SEDModel
from miricigale.depth import sensitivity
from miricigale.evaluation import AGNPopulation, agn_fraction
from miricigale.scene import read_catalog

catalog = read_catalog("catalog.goodss")
keep = ~catalog["star"] & (catalog["redshift"] > 0.1) & (catalog["redshift"] < 5)
catalog = catalog[keep]
model = SEDModel.yang2021()
bands = ["wfc3.f160w", "miri.f770w", "miri.f1500w"]
galaxies = QTable({"id": catalog["id"], "redshift": catalog["redshift"]})
galaxies["age"], galaxies["tau"] = 1 * u.Gyr, 1 * u.Gyr
galaxies["frac_agn"] = 0.5
half = model.fluxes(galaxies, bands)
scale = (catalog["wfc3.f160w"] / half["wfc3.f160w"]).value
galaxies["stellar_mass"] = half["stellar_mass"] * scale

# %%
# Then the AGN are drawn, and their fraction of the infrared light follows from the luminosity at 6 µm.

agn = AGNPopulation().draw(galaxies, seed=1)
fraction = agn_fraction(agn["l_6um"], half["l_6um"] * scale)
galaxies["frac_agn"] = np.nan_to_num(fraction)
fluxes = model.fluxes(galaxies, bands)
limits = {name: sensitivity(name, 1 * u.h) for name in bands[1:]}
detected = np.all([fluxes[name] * scale > limits[name] for name in limits], axis=0)

# %%
# Numbers for one field of the imager (74" x 113"). The catalog has no fainter hosts than its own limit.

ra, dec = catalog["sky"].ra, catalog["sky"].dec
area = (np.ptp(ra.arcmin) * np.cos(np.median(dec))) * np.ptp(dec.arcmin)
fields = area / (74 * 113 / 3600)
strong = galaxies["frac_agn"] > 0.4
has = np.asarray(agn["has_agn"])
rows = {"all": has, "detected in both bands": has & detected}
rows["detected, fraction above 0.4"] = has & detected & strong
numbers = [round(float(np.sum(selected) / fields), 1) for selected in rows.values()]
QTable({"AGN": list(rows), "in one field": numbers})

# %%
# By redshift:

edges = np.arange(0, 5.5, 0.5)
ax = plt.subplots(layout="constrained")[1]
for label, selected in rows.items():
    z = galaxies["redshift"][selected]
    weights = np.full(len(z), 1 / fields)
    ax.hist(z, edges, weights=weights, alpha=0.6, label=label)
ax.set(xlabel="redshift", ylabel="AGN in one field")
ax.legend(fontsize="small", loc="upper left")
plt.show()

# %%
# Whether a detected AGN is also recognized is a question for fits: ``miricigale plan`` gives the number found and
# the purity. See :doc:`/method/populations` for the functions, and
# :doc:`/method/planning`.
