"""
Is this AGN real? AGN fractions
===============================

A fit gives one of your galaxies a high AGN fraction. You want to see whether the photometry needs an AGN.
"""

# %%
# Two galaxies at redshift 1 are simulated. In one, an AGN emits half of the infrared power; the other has no AGN.

import matplotlib.pyplot as plt
import numpy as np
from astropy.table import QTable

from miricigale import BayesFitter, SEDModel

bands = [
    "acs.f606w",
    "acs.f814w",
    "wfc3.f125w",
    "wfc3.f160w",
    "irac.ch1",
    "irac.ch2",
]
bands += ["miri.f560w", "miri.f770w", "miri.f1000w", "miri.f1280w", "miri.f1500w"]
bands += ["miri.f1800w", "miri.f2100w"]

model = SEDModel.survey()
truth = QTable({"id": ["with AGN", "without AGN"], "frac_agn": [0.5, 0.0]})
for name, value in [("redshift", 1.0), ("mass", 3e10), ("age", 3.0), ("ebv", 0.3)]:
    truth[name] = [value, value]
fluxes = model.fluxes(truth, bands)
rng = np.random.default_rng(4)
photometry = QTable({"id": truth["id"]})
for band in bands:
    error = 0.05 * fluxes[band]
    photometry[band] = fluxes[band] + error * rng.normal(size=2)
    photometry[f"{band}_err"] = error

# %%
# Fit with and without AGN, on the same axes otherwise. The gain in ln(evidence) counts the freedom of the AGN
# models: 1 to 3 is positive, 3 to 5 strong, more very strong. The galaxies are the models' own, so that an error
# of 5 % is enough; leave ``model_error`` out for real ones, whose errors of models and rarity of AGN then count.

plain = SEDModel.survey(agn=False)
with_agn = BayesFitter(model, bands, model_error=0.05).fit(photometry)
without = BayesFitter(plain, bands, model_error=0.05).fit(photometry)

table = QTable({"id": truth["id"], "frac_agn_true": truth["frac_agn"]})
table["frac_agn_p16"], table["frac_agn_p84"] = (
    with_agn.percentile("frac_agn", [0.16, 0.84]).round(2).T
)
table["chi2_with"], table["chi2_without"] = (
    with_agn.chi2.round(1),
    without.chi2.round(1),
)
table["ln_gain"] = (with_agn.log_evidence - without.log_evidence).round(1)
table

# %%
# By eye: the best models with and without an AGN, and the posterior of the fraction. A torus fills the minimum of
# the spectrum between starlight and dust.

fig, panels = plt.subplots(
    2, 2, figsize=(10, 6.5), width_ratios=[2, 1], sharex="col", layout="constrained"
)
for (left, right), name in zip(panels, truth["id"], strict=True):
    galaxy = with_agn[name]
    galaxy.plot_sed(left, title=f"simulated {name}")
    sed = without[name].best_sed()
    wave, flux = sed.wave.to("um"), sed.fnu.to("uJy")
    left.plot(wave, flux, "tab:green", label="best without AGN")
    left.set(xlim=(0.4, 40), ylim=(0.05, 500))
    left.legend(loc="upper left")
    galaxy.plot_pdf("frac_agn", right, color="tab:red")
    right.set(xlabel="AGN fraction", xlim=(0, 1))
plt.show()

# %%
# Before you rely on it, check three more things:
#
# - the redshift: at free redshift a PAH feature in one band can look like a torus (``one.plot_pdf2d("redshift",
#   "frac_agn")``);
# - the excess: it must be in several bands; one band alone is a line, a neighbor or a zero point
#   (`~miricigale.fitting.leave_out`);
# - the prior: fit a sample with ``priors={"frac_agn": ...}`` and see what changes (:doc:`priors`).
#
# See :doc:`/method/agn` for the odds, and for what looks like an AGN.
