"""
Fit at known redshifts
======================

You have spectroscopic redshifts for your sources, or for some of them. You want masses and AGN fractions at these
redshifts.
"""

# %%
# Forty simulated galaxies in seven bands; three in four have a spectroscopic redshift.

import matplotlib.pyplot as plt
import numpy as np
from astropy.table import QTable

from miricigale import BayesFitter, SEDModel

bands = ["acs.f606w", "acs.f814w", "wfc3.f125w", "wfc3.f160w"]
bands += ["irac.ch1", "miri.f770w", "miri.f1500w"]
rng = np.random.default_rng(11)
n = 40
truth = QTable({"id": np.arange(n), "redshift": rng.uniform(0.3, 2.5, n)})
truth["mass"] = 10 ** rng.uniform(9.5, 11, n)
truth["age"], truth["ebv"] = rng.uniform(0.8, 3, n), rng.uniform(0.1, 0.5, n)
model = SEDModel.survey()
fluxes = model.fluxes(truth, bands)
photometry = QTable({"id": truth["id"]})
for band in bands:
    error = 0.1 * fluxes[band]
    photometry[band] = fluxes[band] + error * rng.normal(size=n)
    photometry[f"{band}_err"] = error
photometry["z_spec"] = np.where(truth["id"] % 4 == 0, np.nan, truth["redshift"])

# %%
# ``redshift="z_spec"`` takes the column. A row without a redshift is flagged and not fitted, so fit the others
# with free redshifts and join the two.

fitter = BayesFitter(bands)
has = np.isfinite(photometry["z_spec"])
known = fitter.fit(photometry[has], redshift="z_spec")
free = fitter.fit(photometry)
table = QTable({"id": known.ids, "z_spec": photometry["z_spec"][has].round(3)})
for label, fit in [("known", known), ("free", free[has])]:
    table[f"log_mass_{label}"] = np.log10(fit["mass"].value).round(2)
table["log_mass_true"] = np.log10(truth["mass"][has]).round(2)
table[:5]

# %%
# An error of the redshift changes the mass, by the distance and by the color. Here the redshifts are good, so that
# most of the scatter comes from the ages. At known redshifts the fit is also faster: it uses only the models at
# one redshift.

off = {
    "free": np.log10(free[has]["mass"].value / truth["mass"][has]),
    "known": np.log10(known["mass"].value / truth["mass"][has]),
}
fig, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
z, error = free.mean("redshift"), free.std("redshift")
left.errorbar(truth["redshift"], z, error, fmt="o", ms=4, color="tab:orange")
left.plot([0, 3], [0, 3], "k:")
left.set(xlabel="true redshift", ylabel="redshift of the free fit")
left.set(xlim=(0, 3), ylim=(0, 3))
for label, values in off.items():
    bins = np.linspace(-0.6, 0.6, 25)
    right.hist(values, bins, alpha=0.6, label=f"redshift {label}")
right.set(xlabel="log10(mass / true mass)", ylabel="galaxies")
right.legend()
plt.show()

# %%
# On the command line: ``miricigale fit catalog.fits --redshift z_spec``. A probability distribution of each
# redshift is ``fit(photometry, redshift_prior=(z, pdf))``; :doc:`priors` has an example. See
# :doc:`/method/fitting`.
