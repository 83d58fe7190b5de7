"""
Change the priors of a fit
==========================

You know more than the photometry says: how redshifts depend on magnitude, or how rare AGN are. You want to use it.
"""

# %%
# One faint simulated galaxy at redshift 0.7 in four bands with errors of 15 %, which leave redshifts up to 3
# possible.

import matplotlib.pyplot as plt
import numpy as np
from astropy.table import QTable
from scipy import stats

from miricigale import BayesFitter, SEDModel
from miricigale.fitting import magnitude_prior

bands = ["acs.f814w", "wfc3.f160w", "irac.ch1", "miri.f770w"]
model = SEDModel.survey()
truth = {
    "redshift": [0.7],
    "mass": [1e9],
    "age": [1.0],
    "ebv": [0.3],
    "frac_agn": [0.1],
}
fluxes = model.fluxes(truth, bands)
photometry = QTable({"id": ["galaxy"]})
for band in bands:
    photometry[band] = fluxes[band]
    photometry[f"{band}_err"] = 0.15 * fluxes[band]

# %%
# A fit of real galaxies has the priors of its calibration; with ``calibration=None`` they are flat in the nodes of
# the grid. ``priors`` takes for each parameter a function of the value, a distribution of scipy, weights of the
# nodes, or ``"log"``. ``redshift_prior`` is a density of redshift for each object;
# `~miricigale.fitting.magnitude_prior` makes one of its magnitude.

rare_agn = {
    "frac_agn": stats.expon(scale=0.1),
    "ebv": lambda ebv: np.exp(-ebv / 0.3),
}
by_magnitude = magnitude_prior(photometry["wfc3.f160w"])
flat = BayesFitter(bands, calibration=None)
fits = {
    "flat": flat.fit(photometry),
    "redshift given magnitude": flat.fit(photometry, redshift_prior=by_magnitude),
    "weak AGN and little dust": flat.replace(priors=rare_agn).fit(photometry),
    "of real galaxies": BayesFitter(bands).fit(photometry),
}
table = QTable({"prior": list(fits)})
for name in ("redshift", "frac_agn", "ebv"):
    q = [fit.percentile(name, [0.16, 0.5, 0.84])[0].value for fit in fits.values()]
    table[name] = [f"{b:.2f} -{b - a:.2f} +{c - b:.2f}" for a, b, c in q]
table

# %%
# What changes with the prior is not determined by the data.

fig, panels = plt.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
colors = ["0.7", "tab:blue", "tab:green", "tab:red"]
for ax, name in zip(panels, ["redshift", "frac_agn"], strict=True):
    for color, fit in zip(colors, fits.values(), strict=True):
        fit[0].plot_pdf(name, ax, fill=False, alpha=1, lw=2, color=color)
    ax.axvline(truth[name][0], color="k", ls=":")
panels[0].set_xlim(0, 4)
panels[0].legend(list(fits))
plt.show()

# %%
# The prior that was used is ``fitter.priors.axes["frac_agn"].weights``. A sample of known redshift measures priors
# of its own, which is the best source of them:
#
# .. code-block:: python
#
#    known = BayesFitter(bands).fit(photometry, redshift="z_spec")
#    priors = measure_priors(known)
#
# See :doc:`/method/fitting` for priors of star-formation rates, and :doc:`/method/fitting_errors` for measured
# priors.
