"""
Classify AGN, get completeness
==============================

You have fitted AGN fractions. You want classes (galaxy, composite, AGN), and how complete and pure a selection of
AGN is as a function of flux.
"""

# %%
# A mock catalog stands for yours: galaxies of which half have an AGN, in 15 existing bands and three bands of
# MIRI.

import warnings

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.table import QTable

from miricigale import BayesFitter, ErrorModel, SEDModel
from miricigale.evaluation import (
    classify,
    completeness,
    confusion,
    half_complete,
    selection_quality,
)

model, existing = SEDModel.yang2021(), ErrorModel.yang2021()
depths = {"miri.f770w": 25.5, "miri.f1000w": 25.0, "miri.f1500w": 24.0}
miri = ErrorModel.from_depths({k: v * u.ABmag for k, v in depths.items()})
rng = np.random.default_rng(1)
n = 150
truth = QTable({"id": np.arange(n), "redshift": rng.uniform(0.3, 3, n)})
truth["frac_agn"] = rng.choice([0.0, 0.0, 0.2, 0.6], n)
truth["mass"] = 10 ** rng.uniform(8, 10.5, n) * u.Msun
light = model.fluxes(truth, [*existing.filters, *depths])
photometry = existing.perturb(light["id", *existing.filters], seed=1)
mock = miri.perturb(light["id", *depths], seed=1)
for name in mock.colnames[1:]:
    photometry[name] = mock[name]
axes = SEDModel.yang2021_axes("quick")
# the nodes of this grid are too far apart for F1500W, which is warned of
warnings.filterwarnings("ignore", "fluxes scatter")
fitter = BayesFitter(model, [*existing.filters, *depths], axes=axes)
results = fitter.fit(photometry)
fraction = results.to_table()["frac_agn_mean"]

# %%
# Classes by the AGN's share of the infrared light: below 0.1, below 0.4, and above. The table has a row for each
# true class.

true, found = classify(truth["frac_agn"]), classify(fraction)
table = confusion(true, found)["class", "n", "galaxy", "composite", "agn", "purity"]
table["purity"] = table["purity"].round(2)
table

# %%
# The completeness of AGN (true fraction above 0.4) by F1500W flux, with 68 % intervals, and the flux at which
# half of them are found:

agn, selected = true == "agn", found == "agn"
flux = np.log10(light["miri.f1500w"].to_value(u.uJy))
table = completeness(flux[agn], selected[agn], np.arange(-1, 3.6, 0.5))
middle = 0.5 * (table["low"] + table["high"])
down, up = table["share"] - table["share_low"], table["share_high"] - table["share"]
ax = plt.subplots(layout="constrained")[1]
ax.errorbar(10**middle, table["share"], [down, up], fmt="o")
ax.set(xscale="log", xlabel="F1500W (µJy)", ylabel="completeness of AGN")
plt.show()
print(f"half complete at {10 ** half_complete(flux[agn], selected[agn]):.2g} µJy")

# %%
# Purity and completeness of the selection as a whole. Purity depends on how common AGN are: it means something
# only for a sample as in a real field.

quality = selection_quality(agn, selected)
for name in ("completeness", "purity"):
    one = getattr(quality, name)
    print(f"{name}: {one.value:.2f} ({one.low:.2f} to {one.high:.2f})")

# %%
# See :doc:`/method/evaluation` for the classes, and :doc:`/method/agn` for what an AGN fraction is.
