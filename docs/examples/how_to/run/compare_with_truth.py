"""
Compare results with the truth
==============================

You have measured fluxes or fitted redshifts of simulated sources. You want offsets, scatter, outliers and
coverage, with errors.
"""

# %%
# Measured fluxes of a simulated field, by forced photometry:

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.table import QTable

from miricigale import BayesFitter, ErrorModel, ForcedPhotometer, SEDModel
from miricigale.evaluation import (
    bootstrap,
    coverage_table,
    match_truth,
    photoz_metrics,
    posterior_ranks,
    recovery_metrics,
)
from miricigale.scene import example_field

field = example_field(["F160W", "F770W"], size=20 * u.arcsec)
psfs, images = field.psfs, field.images
options = {"psf": psfs["miri.f770w"], "highres_psf": psfs["wfc3.f160w"]}
photometer = ForcedPhotometer(**options)
result = photometer.measure(images["miri.f770w"], images["wfc3.f160w"])

# %%
# ``match_truth`` matches by position, one to one, and keeps every true source. Sources at 10 sigma or more are
# compared here.

measured = match_truth(field.truth, result.to_table("miri.f770w"), ["miri.f770w"])
true, flux = measured["miri.f770w_true"], measured["miri.f770w"]
bright = flux > 10 * measured["miri.f770w_err"]
metrics = recovery_metrics(true[bright].value, flux[bright].value, relative=True)
print(f"{np.sum(measured['matched'])} matched, {metrics.n} compared")
print(f"offset {metrics.median:+.3f} +- {metrics.median_err:.3f}")
print(f"scatter {metrics.sigma_mad:.3f}")

# %%
# Redshifts of a mock catalog, in the 15 existing bands of Yang et al. 2021:

model, errors = SEDModel.yang2021(), ErrorModel.yang2021()
rng = np.random.default_rng(1)
n = 100
truth = QTable({"id": np.arange(n), "redshift": rng.uniform(0.3, 3, n)})
truth["mass"] = 10 ** rng.uniform(9.3, 11, n) * u.Msun
light = model.fluxes(truth, list(errors.filters))
photometry = errors.perturb(light["id", *errors.filters], seed=1)
axes = SEDModel.yang2021_axes("quick")
fits = BayesFitter(model, list(errors.filters), axes=axes).fit(photometry)
z_true, z_fit = truth["redshift"], fits.mean("redshift").value
photoz_metrics(z_true, z_fit)

# %%
# ``bootstrap`` gives any statistic its error. Sources are drawn with replacement.

delta = (z_fit - z_true) / (1 + z_true)
share = bootstrap(lambda d: np.mean(np.abs(d) > 0.15, axis=-1), delta, seed=1)
print(f"outliers: {100 * share.value:.1f} +- {100 * share.error:.1f} %")

# %%
# If posteriors are right, the ranks of the truth in them are uniform, and 68 % of the truths are in the central
# 68 %.

values, levels = fits.cdf("redshift")
ranks = posterior_ranks(z_true, values, levels)
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
left.errorbar(z_true, z_fit, fits.std("redshift").value, fmt=".", lw=0.8)
left.plot([0, 3.2], [0, 3.2], color="0.5")
left.set(xlabel="true redshift", ylabel="redshift", ylim=(0, 4))
right.hist(ranks, np.linspace(0, 1, 11), color="C2", edgecolor="white")
right.axhline(n / 10, color="0.5")
right.set(xlabel="rank of the truth in its posterior", ylabel="sources")
plt.show()

# %%
# These posteriors are too wide: the fit allows for a model error of 10 %, and the mock fluxes have none.

table = coverage_table({"redshift": ranks})
table = table["name", "n", "level", "share", "mean_rank"]
table.round(2)
table

# %%
# See :doc:`/method/evaluation` for definitions, and :doc:`/accuracy/study` for the numbers of a full study.
