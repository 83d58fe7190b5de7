"""
Compare two plans: deep or wide
===============================

You have a fixed time. You want to know whether one deep pointing or several shallow ones give more AGN, and what
accuracy the wide survey loses.
"""

# %%
# The same times are divided among 1, 4 and 16 pointings. The sample is small here to be fast, and a third of its
# sources have an AGN: a made-up mix, which compares plans with few sources. Leave ``agn`` out for the AGN of a
# real field, and take 2000 sources or more.

import matplotlib.pyplot as plt

from miricigale.planning import Planner, area_table, load_plan

bands = ["miri.f770w", "miri.f1500w"]
overrides = {
    "exposures": {"bands": bands, "time": 6000, "dithers": 4},
    "survey": {"areas": [1, 4, 16]},
    "sample": {"n_sources": 120},
    "agn": {"frac_agn": [0.0, 0.2, 0.4, 0.8], "shares": [6, 1, 1, 1]},
    "fit": {"axes": "quick"},
}
planner = Planner(load_plan(overrides=overrides))
plans = planner.divide()
table = area_table(planner, plans)
columns = ["time", "area", "n_detected", "n_agn", "z_scatter", "frac_scatter"]
shown = table["pointings", *columns]
shown.round(3)
shown

# %%
# ``time`` is what the observatory charges, with overheads: it grows with the pointings although the exposures
# together do not. ``n_agn`` counts the AGN of the mix.

figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
left.loglog(table["time"], table["n_detected"], "o-", label="sources")
left.loglog(table["time"], table["n_agn"], "s-", label="AGN found")
left.set(xlabel="hours with overheads", ylabel="number")
left.legend()
labels = {"z_scatter": "dz / (1 + z)", "frac_scatter": "AGN fraction"}
for name, label in labels.items():
    error = table[f"{name}_err"]
    right.errorbar(table["pointings"], table[name], error, label=label)
right.set(xscale="log", xlabel="pointings", ylabel="scatter", ylim=(0, None))
right.legend()
plt.show()

# %%
# Two plans with other differences are compared in the same way: make a ``Planner`` of each configuration, and
# compare their tables. The seed and the sources are the same, so that the differences are of the exposures.

shallow, deep = plans[-1], plans[0]
for plan in (deep, shallow):
    numbers = planner.accuracy(plan)
    value = numbers["frac_scatter"]
    print(f"{plan.name:>2} pointings: {value.value:.3f} +- {value.error:.3f}")

# %%
# .. code-block:: console
#
#    $ miricigale plan --bands f770w f1500w --time 6000 --areas 1 4 16
#
# See :doc:`/method/planning`.
