"""
Fit sources with missing bands
==============================

You have sources that are not covered by all images, or are masked in some. You want to fit each with the bands it
has.
"""

# %%
# Six simulated galaxies: the first two have all bands, the next two no MIRI, the last two only HST. A missing band
# is NaN (or masked) in the flux or the error; zero is a measurement.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.table import QTable

from miricigale import BayesFitter, SEDModel

hst = ["acs.f606w", "acs.f814w", "wfc3.f125w", "wfc3.f160w"]
nircam = ["nircam.f277w", "nircam.f444w"]
miri = ["miri.f770w", "miri.f1000w", "miri.f1500w"]
bands = hst + nircam + miri

model = SEDModel.survey()
truth = QTable({"id": ["A", "B", "C", "D", "E", "F"], "redshift": [0.6, 1.7] * 3})
for name, value in [("mass", 3e10), ("age", 3.0), ("ebv", 0.3), ("frac_agn", 0.2)]:
    truth[name] = np.full(6, value)
fluxes = model.fluxes(truth, bands)
rng = np.random.default_rng(5)
photometry = QTable({"id": truth["id"]})
for band in bands:
    error = 0.05 * fluxes[band]
    photometry[band] = fluxes[band] + error * rng.normal(size=6)
    photometry[f"{band}_err"] = error
for band in miri:
    photometry[band][2:] = np.nan * u.uJy
for band in nircam:
    photometry[band][4:] = np.nan * u.uJy

# %%
# ``n_bands_min`` sets how many bands an object needs; with fewer it is flagged and not fitted. ``n_bands`` is the
# number that was used. The flag ``few_for_parameters`` marks objects with fewer than three fluxes of 2 sigma or
# more: their posteriors are wide, and rest on the priors.

fitter = BayesFitter(bands, n_bands_min=4)
results = fitter.fit(photometry)
table = results.summary()["id", "flags"]
table["n_bands"] = results.n_bands
for name in ("redshift", "frac_agn"):
    pairs = zip(results.mean(name).value, results.std(name).value, strict=True)
    table[name] = [f"{mean:.2f} +- {std:.2f}" for mean, std in pairs]
table

# %%
# Bands that were not measured are predicted, with errors.

predicted = results.predict()["id", "miri.f770w", "miri.f770w_err"]
predicted["true"] = fluxes["miri.f770w"]
predicted.round(1)
predicted

# %%
# The redshift and the AGN fraction of the three sources at redshift 1.7. Fewer bands make posteriors wider.

fig, panels = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
labels = {"B": "HST, NIRCam, MIRI", "D": "HST, NIRCam", "F": "HST"}
for ax, name in zip(panels, ["redshift", "frac_agn"], strict=True):
    for key in labels:
        results[key].plot_pdf(name, ax)
    ax.axvline(truth[name][1], color="k", ls=":")
    ax.set(xlabel=name)
panels[0].set_xlim(1, 2.5)
panels[0].legend(labels.values())
plt.show()

# %%
# ``BayesFitter()`` fits all bands that a catalog has. A band without a filter or an error is not fitted, with a
# warning. Numbers such as -99 are missing bands too, and a warning counts them. See :doc:`/method/fitting`.
