"""
Choose between F770W and F1500W
===============================

You can afford one MIRI band, or two, of F770W and F1500W or any others. You want to know which gives better
redshifts and AGN fractions, and which finds more AGN in an hour of telescope time.
"""

# %%
# A plan draws galaxies of the bundled catalog, gives them AGN, adds the noise of the exposures and fits them, with
# and without MIRI. By default the AGN are those of a real field, and 1000 sources or more are wanted. Here the
# sources are few to be fast, with an AGN in every third. Redshifts are restricted by
# ``{"sample": {"redshift": [1, 3]}}``.

import matplotlib.pyplot as plt
import numpy as np

from miricigale.planning import Planner, comparison_table, load_plan

exposures = {
    "bands": ["miri.f770w", "miri.f1500w"],
    "time": 1500,
    "dithers": 4,
    "sets": ["f770w", "f1500w", "all"],
}
overrides = {"exposures": exposures, "sample": {"n_sources": 120}}
overrides["fit"] = {"axes": "quick"}
overrides["agn"] = {"frac_agn": [0.0, 0.2, 0.4, 0.8], "shares": [6, 1, 1, 1]}
planner = Planner(load_plan(overrides=overrides))
plans = planner.compare()

# %%
# All sets are compared on the same sources. They are ranked by ``merit``: here the number of AGN found, times the
# purity, for each hour. With 120 sources differences of less than the errors mean nothing.

table = comparison_table(planner, plans)
columns = ["z_scatter", "frac_scatter", "completeness", "purity", "merit"]
shown = table["plan", "time", *columns]
shown.round(3)
shown

# %%
# The scatter of redshifts and AGN fractions with errors:

figure, axes = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
rows = np.arange(len(table))
for ax, name in zip(axes, ["z_scatter", "frac_scatter"], strict=True):
    ax.errorbar(table[name], rows, xerr=table[f"{name}_err"], fmt="o")
    ax.set(xlabel=name, xlim=(0, None))
    ax.set_yticks(rows, table["plan"] if ax is axes[0] else [""] * len(rows))
plt.show()

# %%
# The exposures behind the numbers:

plans[-1].band_table()["filter", "time", "groups", "limit", "saturates"]

# %%
# The command makes a page of this comparison:
#
# .. code-block:: console
#
#    $ miricigale plan --bands f770w f1500w --time 1500 --sets f770w f1500w all
#
# See :doc:`/method/planning` for what is computed, and :doc:`/accuracy/planning` for how well plans hold.
