"""
Measure and use errors of the models
====================================

Your models fit some wavelengths worse than others. You want errors of the models by rest wavelength, a template
error.
"""

# %%
# 120 galaxies with spectroscopic redshifts are simulated from models with emission lines and bursts, and fitted
# with models that have neither: the difference stands for that of real galaxies and models. Photometric errors are
# 3 %.

import warnings

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.table import QTable

from miricigale import BayesFitter, FilterSet, SEDModel
from miricigale.fitting import measure_template_error
from miricigale.utils.exceptions import FitWarning

bands = ["acs.f435w", "acs.f606w", "acs.f814w", "wfc3.f125w", "wfc3.f160w"]
bands += [
    "nircam.f200w",
    "nircam.f277w",
    "nircam.f356w",
    "nircam.f444w",
    "miri.f770w",
]
rng = np.random.default_rng(9)
n = 120
truth = QTable({"id": np.arange(n), "redshift": rng.uniform(0.2, 2.5, n)})
truth["mass"], truth["age"] = np.full(n, 1e10), rng.uniform(0.3, 2, n)
truth["ebv"], truth["f_burst"] = rng.uniform(0.1, 0.6, n), rng.choice([0, 0.05], n)
fluxes = SEDModel.survey().fluxes(truth, bands)
photometry = QTable({"id": truth["id"], "z_spec": truth["redshift"]})
for band in bands:
    error = 0.03 * fluxes[band]
    photometry[band] = fluxes[band] + error * rng.normal(size=n)
    photometry[f"{band}_err"] = error

# %%
# Start with a model error of 10 %, fit at the known redshifts, and measure the error that the residuals need.
# Repeat with what was found. Use one half of the sample here and test on the other. Fits warn of bands that
# scatter by more than the errors in use; here this scatter is what we measure.

warnings.filterwarnings("ignore", "fluxes scatter", FitWarning)
model = SEDModel.yang2021(agn=False)
grid = model.grid(SEDModel.yang2021_axes("galaxy"), bands)
half = photometry[: n // 2]
fitter = BayesFitter(grid, model_error=0.1)
for _ in range(3):
    error = measure_template_error(fitter.fit(half, redshift="z_spec"))
    fitter = BayesFitter(grid, model_error=0, template_error=error)

# %%
# Redshifts of the other half with three errors of the models. Without any, intervals are too narrow.

other = photometry[n // 2 :]
z = other["z_spec"]
fits = {
    "none": BayesFitter(grid, model_error=0).fit(other),
    "10 % in all bands": BayesFitter(grid, model_error=0.1).fit(other),
    "template error": fitter.fit(other),
}
rows = []
for label, fit in fits.items():
    q = fit.percentile("redshift", [0.16, 0.5, 0.84]).value
    off = (q[:, 1] - z) / (1 + z)
    scatter = 1.48 * np.median(np.abs(off - np.median(off)))
    inside = 100 * np.mean((q[:, 0] < z) & (z < q[:, 2]))
    chi2 = np.median(fit.reduced_chi2)
    rows.append((label, f"{scatter:.3f}", f"{inside:.0f}", f"{chi2:.1f}"))
QTable(rows=rows, names=["model error", "scatter", "in 68 % (%)", "reduced chi2"])

# %%
# The error that was found, and residuals of the best models without it.

fig, ax = plt.subplots(figsize=(8, 4), layout="constrained")
fit = BayesFitter(grid, model_error=0).fit(half, redshift="z_spec")
pivot = FilterSet.from_names(bands).pivots.to_value("um")
wave = pivot / (1 + half["z_spec"][:, None])
ax.semilogx(wave, 100 * (fit.flux / fit.best_flux - 1), ".", ms=3, color="0.6")
x = np.geomspace(0.12, 6, 200)
ax.plot(x, 100 * error(x * u.um), "tab:red", label="template error")
ax.plot(x, -100 * error(x * u.um), "tab:red")
ax.axhline(0, color="k", lw=0.8)
ax.set(
    xlabel="rest wavelength (um)",
    ylabel="flux / best model - 1 (%)",
    ylim=(-40, 40),
)
ax.legend()
plt.show()

# %%
# ``SurveyCalibration.survey().template_error`` is the error of ``SEDModel.survey()``, measured on CEERS;
# ``BayesFitter(bands)`` and ``miricigale fit`` use it. :func:`~miricigale.fitting.calibrate` measures such an
# error with zero points, errors of bands and priors: :doc:`photometric_redshifts`. See also
# :doc:`/method/fitting_errors`.
