"""
Use upper limits in a fit
=========================

You have a catalog with an upper limit where a source was not detected. You want the fit to use it.
"""

# %%
# The galaxy is simulated, at redshift 1, without an AGN. At 10 and 15 um it is fainter than the noise: its catalog
# gives 3-sigma upper limits there.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.table import QTable

from miricigale import BayesFitter, SEDModel

bands = ["acs.f606w", "acs.f814w", "wfc3.f125w", "wfc3.f160w", "irac.ch1"]
bands += ["miri.f1000w", "miri.f1500w"]
model = SEDModel.survey()
truth = {
    "redshift": [1.0],
    "mass": [2e9],
    "age": [1.0],
    "ebv": [0.2],
    "frac_agn": [0.0],
}
fluxes = model.fluxes(truth, bands)
photometry = QTable({"id": ["galaxy"]})
for band in bands:
    photometry[band] = fluxes[band]
    photometry[f"{band}_err"] = 0.05 * fluxes[band]
for band, sigma in [("miri.f1000w", 0.6), ("miri.f1500w", 1.0)]:
    photometry[band] = [3 * sigma] * u.uJy
    photometry[f"{band}_err"] = [sigma] * u.uJy

# %%
# A boolean column ``<band>_limit`` marks the limits: the flux is the limiting flux, the error its 1 sigma. Without
# the column the same numbers would be detections of 3 sigma.

limits = photometry.copy()
limits["miri.f1000w_limit"] = limits["miri.f1500w_limit"] = [True]
ignored = photometry.copy()
for band in ("miri.f1000w", "miri.f1500w"):
    ignored[band] = np.nan * u.uJy

# without the priors for real galaxies, of which few have an AGN
fitter = BayesFitter(model, bands, model_error=0.05)
fits = {
    "limits left out": fitter.fit(ignored)["galaxy"],
    "upper limits": fitter.fit(limits)["galaxy"],
}
summary = QTable({"fit": list(fits)})
summary["limits"] = [fit.n_limits for fit in fits.values()]
for name in ("ebv", "sfr"):
    q = [fit.percentile(name, [0.5, 0.84]).value.round(2) for fit in fits.values()]
    summary[f"{name}_p50"], summary[f"{name}_p84"] = np.transpose(q)
summary

# %%
# The limits exclude dusty galaxies, whose dust would shine at 10 and 15 um. They are drawn as arrows.

fig, (left, right) = plt.subplots(
    1, 2, figsize=(10, 4), width_ratios=[1.5, 1], layout="constrained"
)
fits["upper limits"].plot_sed(left)
left.set(xlim=(0.4, 40), ylim=(0.03, 30))
for fit in fits.values():
    fit.plot_pdf("ebv", right)
right.set(xlabel="E(B-V)")
right.legend(list(fits))
plt.show()

# %%
# A catalog of CIGALE marks limits by negative errors; ``read_catalog_photometry(path, limits=True)`` reads them,
# and ``miricigale fit`` does with ``limits = true`` in the map of columns. Where you have a measured flux, even a
# negative one, fit the flux: it contains more information. See :doc:`/method/upper_limits`.
