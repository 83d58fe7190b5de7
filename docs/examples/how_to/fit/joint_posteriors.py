"""
Plot joint posteriors
=====================

You have a fit. You want to see which parameters are degenerate: a corner plot.
"""

# %%
# A simulated galaxy at redshift 1.2 with a weak AGN, in seven bands with errors of 10 %.

import matplotlib.pyplot as plt
import numpy as np
from astropy.table import QTable

from miricigale import BayesFitter, SEDModel

bands = ["acs.f606w", "acs.f814w", "wfc3.f125w", "wfc3.f160w"]
bands += ["irac.ch1", "miri.f770w", "miri.f1500w"]
model = SEDModel.survey()
truth = {
    "redshift": 1.2,
    "mass": 3e10,
    "age": 3.0,
    "ebv": 0.3,
    "tau": 1.0,
    "frac_agn": 0.2,
}
fluxes = model.fluxes({name: [value] for name, value in truth.items()}, bands)
photometry = QTable({"id": ["galaxy"]})
for band in bands:
    photometry[band] = fluxes[band]
    photometry[f"{band}_err"] = 0.1 * fluxes[band]

# %%
# ``pairs`` asks for joint posteriors, which are summed over all 18 million models. The pair of redshift and
# AGN fraction is always kept. Any two parameters of the grid can be a pair.

names = ["redshift", "frac_agn", "ebv", "age"]
pairs = [(a, b) for i, a in enumerate(names) for b in names[i + 1 :]]
fitter = BayesFitter(model, bands, model_error=0.05)
galaxy = fitter.fit(photometry, pairs=pairs)["galaxy"]

# %%
# A corner plot: contours hold 68 and 95 % of the posterior, crosses are the true values.

n = len(names)
limits = {
    "redshift": (0.7, 1.7),
    "frac_agn": (0, 0.8),
    "ebv": (0, 0.7),
    "age": (0.2, 6),
}
fig, axes = plt.subplots(n, n, figsize=(9, 9), layout="constrained")
for i, y in enumerate(names):
    for j, x in enumerate(names):
        ax = axes[i, j]
        if j > i:
            ax.set_axis_off()
            continue
        if i == j:
            galaxy.plot_pdf(x, ax)
            ax.axvline(truth[x], color="k", lw=1, ls="--")
            ax.set(ylabel="", yticks=[])
        else:
            galaxy.plot_pdf2d(x, y, ax, truth=(truth[x], truth[y]))
            ax.set_ylim(limits[y])
        ax.set_xlim(limits[x])
        ax.label_outer()
plt.show()

# %%
# The numbers of a pair are ``galaxy.joint_pdf("ebv", "age")``. A correlation coefficient from them:

pdf = galaxy.joint_pdf("ebv", "age")
x, y = (galaxy.axes[name].values for name in ("ebv", "age"))
dx, dy = x - pdf.sum(axis=1) @ x, y - pdf.sum(axis=0) @ y
spread = np.sqrt((dx**2 @ pdf.sum(axis=1)) * (dy**2 @ pdf.sum(axis=0)))
print(f"correlation of E(B-V) and age: {dx @ pdf @ dy / spread:.2f}")

# %%
# Pairs with derived quantities, such as mass and A_V, come from draws of the posterior.

samples = fitter.sample(photometry, 2000, seed=1)
fig, ax = plt.subplots(figsize=(5, 4), layout="constrained")
samples.plot_pdf2d("galaxy", "a_v", "sfr", ax)
plt.show()

# %%
# ``miricigale fit catalog.fits --pairs age:ebv redshift:ebv`` keeps them in the files. See
# :doc:`/method/fitting_results`.
