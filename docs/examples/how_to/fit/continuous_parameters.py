"""
Fit between the nodes of a grid
===============================

Your data are better than the grid is fine: results are flagged ``one_node``. You want posteriors of continuous
parameters.
"""

# %%
# Ten simulated galaxies between the nodes of the grid, in 11 bands with errors of 8 %.

import matplotlib.pyplot as plt
import numpy as np
from astropy.table import QTable

from miricigale import BayesFitter, SEDModel
from miricigale.fitting import GridSettings

bands = ["acs.f435w", "acs.f606w", "acs.f814w", "wfc3.f125w", "wfc3.f160w"]
bands += ["nircam.f277w", "nircam.f356w", "nircam.f444w"]
bands += ["miri.f770w", "miri.f1000w", "miri.f1500w"]
model = SEDModel.survey(agn=False)
rng = np.random.default_rng(8)
n = 10
truth = QTable({"id": np.arange(n), "redshift": rng.uniform(0.8, 1.2, n)})
truth["age"], truth["ebv"] = rng.uniform(0.6, 4, n), rng.uniform(0.12, 0.6, n)
truth["tau"], truth["mass"] = np.full(n, 0.5), np.full(n, 3e10)
fluxes = model.fluxes(truth, bands)
photometry = QTable({"id": truth["id"]})
for band in bands:
    error = 0.08 * fluxes[band]
    photometry[band] = fluxes[band] + error * rng.normal(size=n)
    photometry[f"{band}_err"] = error

# %%
# A fit draws models between the nodes of the grid, whose fluxes are interpolated; with ``interpolate=0`` it does
# not. ``finer`` is the model that made the grid: it refines the grid until fluxes between its nodes are good to
# 0.5 %. If a model is fitted instead of a grid, this happens by itself.

axes = {"tau": [0.5], "age": [0.5, 1, 3, 5], "ebv": [0.1, 0.2, 0.3, 0.5, 0.7]}
axes["redshift"] = np.expm1(np.arange(np.log(1.6), np.log(2.5), 0.03))
grid = model.grid(axes, bands)
fitters = {
    "nodes": BayesFitter(grid, model_error=0, settings=GridSettings(interpolate=0)),
    "between": BayesFitter(grid, model_error=0, settings=GridSettings(finer=model)),
}
fits = {label: fitter.fit(photometry) for label, fitter in fitters.items()}
rows = []
for label, fit in fits.items():
    for name in ("redshift", "mass", "ebv"):
        q = fit.percentile(name, [0.16, 0.84]).value
        inside = np.sum((q[:, 0] < truth[name]) & (truth[name] < q[:, 1]))
        rows.append((label, name, f"{inside} of {n}"))
QTable(rows=rows, names=["fit", "parameter", "truth within 68 %"])

# %%
# Ten galaxies are too few to measure how often intervals hold the truth, but they show the effect: on the nodes
# one or two models have all the weight, and some intervals of masses are far too narrow.

fig, panels = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
styles = dict(zip(fits, [(-0.12, "0.6"), (0.12, "tab:red")], strict=True))
for label, fit in fits.items():
    shift, color = styles[label]
    levels = [0.16, 0.5, 0.84]
    z, mass = (fit.percentile(x, levels).value.T for x in ("redshift", "mass"))
    z = (z - truth["redshift"]) / (1 + truth["redshift"])
    mass = np.log10(mass / truth["mass"])
    for ax, q in zip(panels, (z, mass), strict=True):
        errors = [q[1] - q[0], q[2] - q[1]]
        style = {"fmt": "o", "color": color, "label": label}
        ax.errorbar(np.arange(n) + shift, q[1], errors, **style)
for ax, label in zip(
    panels, ["offset of redshift / (1 + z)", "log10(mass / true mass)"], strict=True
):
    ax.axhline(0, color="k", lw=0.8)
    ax.set(xlabel="galaxy", ylabel=label)
panels[0].legend()
plt.show()

# %%
# For a few objects, and for parameters that no grid can hold, a nested sampler takes continuous priors (``pip
# install 'miricigale[samplers]'``):
#
# .. code-block:: python
#
#    priors = {"redshift": (0.01, 6), "age": (0.1, 13), "ebv": (0, 1), "tau": (0.1, 10, "log")}
#    fitter = BayesFitter(model, bands, priors=priors, engine="nautilus")
#    results = fitter.fit(photometry, seed=1)
#
# It takes some 20 s an object. See :doc:`/method/grids` and :doc:`/method/samplers` for both methods, and
# :doc:`/accuracy/fitting` for how often their intervals contain the truth.
