"""
Calibrate photometric redshifts
===============================

You have the photometry of a survey, and spectroscopic redshifts of some of its sources. You want photometric
redshifts (photo-z), with zero points, errors and priors calibrated on the spectroscopic ones.
"""

# %%
# 220 galaxies are simulated at the redshifts and F160W magnitudes of the bundled catalog of GOODS-S, with errors
# of 3 %. Two bands have wrong zero points: fluxes in F606W are 12 % too low, in NIRCam F356W 10 % too high.

import warnings

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.table import QTable

from miricigale import BayesFitter, SEDModel
from miricigale.fitting import calibrate
from miricigale.scene import read_catalog
from miricigale.utils.exceptions import FitWarning

bands = ["acs.f435w", "acs.f606w", "acs.f814w", "wfc3.f125w", "wfc3.f160w"]
bands += ["nircam.f200w", "nircam.f277w", "nircam.f356w", "nircam.f444w"]

rng = np.random.default_rng(2)
catalog = read_catalog("catalog.goodss")
catalog = catalog[(catalog["redshift"] > 0.1) & (catalog["redshift"] < 3.5)][:220]
n = len(catalog)
truth = QTable({"id": catalog["id"], "redshift": catalog["redshift"]})
truth["mass"] = np.full(n, 1e10) * u.Msun
truth["age"] = rng.choice([0.3, 0.7, 1.5], n) * u.Gyr
truth["tau"] = rng.choice([0.5, 3.0], n) * u.Gyr
truth["ebv"] = rng.choice([0.1, 0.2, 0.35, 0.5], n) * u.mag
model = SEDModel.survey(agn=False)
fluxes = model.fluxes(truth, bands)
scale = catalog["wfc3.f160w"] / fluxes["wfc3.f160w"]

photometry = QTable({"id": truth["id"], "z_spec": truth["redshift"]})
for band in bands:
    flux = (fluxes[band] * scale).to(u.uJy)
    error = np.hypot(0.03 * flux, 0.005 * u.uJy)
    wrong = {"acs.f606w": 0.88, "nircam.f356w": 1.10}.get(band, 1.0)
    photometry[band] = wrong * (flux + error * rng.normal(size=n))
    photometry[f"{band}_err"] = wrong * error

# %%

warnings.simplefilter("ignore", FitWarning)
axes = SEDModel.survey_axes() | {
    "metallicity": [0.02],
    "slope": [0.0],
    "f_burst": [0.0],
}
axes = {name: values for name, values in axes.items() if name in model.parameters}
axes["redshift"] = axes["redshift"][axes["redshift"] < 5]
fitter = BayesFitter(model, bands, axes=axes)
found = calibrate(
    fitter, photometry[:110], redshift="z_spec", reference="wfc3.f160w"
)
table = found.bands["band", "zero_point", "zero_point_err"]
table["needed"] = np.ones(len(bands))
table["needed"][1], table["needed"][7] = 1 / 0.88, 1 / 1.10
table.round(3)
table

# %%
# Each half of these sources was also fitted with free redshifts, before and after the calibration by the other
# half: that is what to expect of sources without a spectroscopic redshift.

scores = found.scores
scores.round(3)
scores

# %%
# Fit the other sources. ``found.write("calibration.ecsv")`` keeps the calibration for later.

z_spec = photometry["z_spec"][110:]
fits = {
    "as given": fitter.fit(photometry[110:]),
    "calibrated": fitter.replace(calibration=found).fit(photometry[110:]),
}
rows = []
for label, fit in fits.items():
    off = (fit["redshift"] - z_spec) / (1 + z_spec)
    outliers = 100 * np.mean(np.abs(off) > 0.15)
    scatter = 1.48 * np.median(np.abs(off - np.median(off)))
    bias = np.median(off)
    rows.append((label, f"{bias:+.3f}", f"{scatter:.3f}", f"{outliers:.0f}"))
QTable(rows=rows, names=["photometry", "bias", "scatter", "outliers (%)"])

# %%
# The redshifts before and after the calibration.

fig, panels = plt.subplots(1, 2, figsize=(9, 4.5), layout="constrained")
for ax, (label, fit) in zip(panels, fits.items(), strict=True):
    z = fit.percentile("redshift", [0.16, 0.5, 0.84]).value
    errors = [z[:, 1] - z[:, 0], z[:, 2] - z[:, 1]]
    ax.errorbar(z_spec, z[:, 1], errors, fmt=".", ms=4, lw=0.5, color="tab:purple")
    ax.plot([0, 4], [0, 4], "k", lw=0.8)
    ax.set(title=label, xlabel="spectroscopic redshift", xlim=(0, 4), ylim=(0, 4))
panels[0].set_ylabel("photometric redshift")
plt.show()

# %%
# The axes here are thin. ``BayesFitter(bands)`` has those for real galaxies, and without known redshifts errors
# and priors that were measured on CEERS. On the command line ``miricigale fit catalog.fits --calibrate z_spec``
# does all of this, and draws this figure on the page of the fit. How well redshifts of CEERS are found is in
# :doc:`/accuracy/fitting_real`, what is measured in :doc:`/method/fitting_errors`.
