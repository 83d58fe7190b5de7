"""
Test a fit with a mock analysis
===============================

You have results of a fit. You want to know which parameters the photometry determines, and whether the errors are
right.
"""

# %%
# 36 simulated galaxies stand for your catalog. They have redshifts and F160W magnitudes of GOODS-S, six bands
# with the depths of existing surveys, and two MIRI bands.

import matplotlib.pyplot as plt
import numpy as np
from astropy.table import QTable

from miricigale import BayesFitter, ErrorModel, SEDModel
from miricigale.fitting import leave_out, mock_analysis
from miricigale.photometry import YANG2021_DEPTHS
from miricigale.scene import read_catalog

bands = ["acs.f606w", "acs.f814w", "wfc3.f125w", "wfc3.f160w"]
bands += ["irac.ch1", "irac.ch2"]
depths = {band: YANG2021_DEPTHS[band] for band in bands}
depths |= {"miri.f770w": 25.5, "miri.f1500w": 24.0}
bands = list(depths)

rng = np.random.default_rng(10)
catalog = read_catalog("catalog.goodss")
bright = (catalog["mag_f160w"].value < 24) & (catalog["redshift"] > 0.2)
catalog = catalog[bright][:36]
n = len(catalog)
truth = QTable({"id": catalog["id"], "redshift": catalog["redshift"]})
truth["age"], truth["ebv"] = rng.uniform(0.6, 3, n), rng.uniform(0.1, 0.6, n)
truth["frac_agn"] = rng.choice([0, 0.3, 0.6], n)
model = SEDModel.survey()
fluxes = model.fluxes(truth, bands)
scale = (catalog["wfc3.f160w"] / fluxes["wfc3.f160w"]).to("")
true = QTable({"id": truth["id"]} | {band: fluxes[band] * scale for band in bands})
errors = ErrorModel.from_depths(depths, fractional=0.05)
photometry = errors.perturb(true, seed=1)
photometry["z_spec"] = truth["redshift"]

# %%
# The mock analysis perturbs the best model of every object by its errors and fits it again: there the truth is
# known. ``model_error=True`` includes the model error in the noise, as the fit allows for it.

fitter = BayesFitter(bands)
results = fitter.fit(photometry, redshift="z_spec")
options = {"model_error": True, "redshift": "z_spec"}
mock = mock_analysis(fitter, results, photometry, seed=3, **options)

# %%
# ``offset`` and ``scatter`` compare the recovered value with the truth; ``coverage`` is the part of truths within
# the 16-84 % interval, and should be 0.68.

metrics = mock.metrics(["mass", "sfr", "dust_luminosity", "frac_agn", "ebv"])
metrics.round(2)
metrics

# %%
# A parameter that the data determine follows the line. A flat cloud means that the result is the prior.

fig, panels = plt.subplots(1, 3, figsize=(11, 3.6), layout="constrained")
for ax, name in zip(panels, ["mass", "sfr", "frac_agn"], strict=True):
    mock.plot(name, ax)
panels[1].set(xlim=(1e-2, 1e3), ylim=(1e-2, 1e3))
plt.show()

# %%
# Errors of the photometry itself show in bands that are left out. The pull is (measured - predicted) over both
# errors; its scatter is 1 if errors are right. Here it is smaller: the fit allows for errors of models,
# and those that made this catalog have none.

check = leave_out(fitter, photometry, ["wfc3.f125w", "irac.ch2"], redshift="z_spec")
table = check.metrics()
table.round(2)
table

# %%
# See :doc:`/method/fitting_errors` for both tests, and :doc:`/accuracy/fitting` for how well the posteriors are
# calibrated.
