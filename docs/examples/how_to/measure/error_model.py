"""
Model errors as a function of flux
==================================

You have fluxes without images: a mock catalog, a model, a proposal. You want realistic errors for them, from an
exposure, from survey depths, or from fluxes of which you know the truth.
"""

# %%
# From an exposure: photons of sky and source, dark current and read noise, for a point source on a drizzled
# mosaic, as noisy as surveys in flight; ``excess="ideal"`` is an ideal fit.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.table import QTable

from miricigale.photometry import ErrorModel

exposure = ErrorModel.from_exposure("F770W", 1665 * u.s)
exposure.limiting_magnitude("F770W").round(2)

# %%
# From depths: 5-sigma AB magnitudes, and a fraction of the flux for calibration and PSF.

survey = ErrorModel.from_depths({"F160W": 27.6, "F444W": 28.9}, fractional=0.03)

# %%
# From truth: simulated photometry of 3000 sources here. Errors are measured in bins of flux.

rng = np.random.default_rng(1)
true = 10 ** rng.uniform(-2, 1.5, 3000)
noise = rng.normal(0, np.hypot(0.04, 0.05 * true))
truth = QTable({"F1000W": true * u.uJy})
measured = QTable({"F1000W": (true + noise) * u.uJy})
simulated = ErrorModel.from_tables(truth, measured, bin_size=150)

# %%
# The operator ``|`` joins these models to one.

model = exposure | survey | simulated
fig, ax = plt.subplots(figsize=(6.6, 4.2), layout="constrained")
model.plot(ax)
plt.show()

# %%
# ``perturb`` draws measured fluxes for a catalog, with the errors; ``assign`` gives errors to measured fluxes.

catalog = QTable({"id": [1, 2, 3], "miri.f770w": [0.05, 0.5, 5] * u.uJy})
drawn = model.perturb(catalog, seed=1)
drawn["miri.f770w"].info.format = drawn["miri.f770w_err"].info.format = ".3f"
drawn

# %%
# ``model.write("errors.ecsv")`` keeps it; ``miricigale run`` reads it. See :doc:`/method/photometry_errors` for
# the equations and :doc:`/accuracy/depth` for the comparison with simulated, reduced and fitted sources.
