"""
An AGN luminosity function
==========================

You have the photometry of a field and want the numbers of its AGN by luminosity, not a list of objects with a high
AGN fraction.
"""

# %%
# A small simulated field: 40 galaxies near redshift 1 in bands of HST, IRAC and MIRI, a third of them with an AGN.
# With your own catalog you would begin below.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.table import QTable

from miricigale import ErrorModel, SEDModel
from miricigale.agn import AGNSurvey

bands = ["acs.f814w", "wfc3.f160w", "irac.ch1", "miri.f770w"]
bands += ["miri.f1000w", "miri.f1500w", "miri.f2100w"]
model = SEDModel.yang2021(libraries="bundled")

rng = np.random.default_rng(3)
n = 40
truth = QTable({"id": np.arange(1, n + 1), "redshift": rng.uniform(0.92, 1.08, n)})
truth["age"] = rng.uniform(1, 3, n)
truth["ebv"] = rng.uniform(0.1, 0.3, n)
truth["mass"] = 10 ** rng.uniform(9.8, 11, n)
has_agn = rng.random(n) < 1 / 3
truth["frac_agn"] = np.where(has_agn, rng.uniform(0.15, 0.85, n), 0.0)
fluxes = model.fluxes(truth, bands)
errors = ErrorModel.from_depths(dict.fromkeys(bands, 26.5), fractional=0.05)
photometry = errors.perturb(fluxes[["id", *bands]], seed=1)
photometry.meta.clear()
photometry.write("catalog.ecsv", overwrite=True)

# %%
# The survey is fitted twice: as it is, and with AGN of known luminosity added to the galaxies. The axes are those
# of a small example; without ``models`` and the line of ``calibration`` the fits are those of ``miricigale fit``.
# On the command line: ``miricigale agn catalog.ecsv --area 5``.

axes = {"redshift": [0.9, 1.0, 1.1], "age": [1.0, 3.0], "ebv": [0.1, 0.3]}
axes["frac_agn"] = [0.0, 0.2, 0.4, 0.6, 0.9]

survey = AGNSurvey(
    5 * u.arcmin**2,
    redshift=(0.9, 1.1),
    log_luminosity=(43.5, 44.0, 44.5, 45.0),
    n_injections=24,
    seed=1,
)
result = survey.run(
    "catalog.ecsv",
    "agn",
    models=lambda bands: (model, axes),
    calibration=None,
    calibrate=False,
    model_error=0.02,
    interpolate=60,
)
totals = result.totals.copy()
totals.round(1)
totals

# %%
# The prior of the grid has an AGN in four of five galaxies. The prior that the sample itself asks for has fewer:

prior = result.prior["frac_agn_low", "frac_agn_high", "shipped", "measured"][:7]
prior.round(2)
prior

# %%
# Numbers by luminosity. ``completeness`` is the share of the injected AGN that are selected (``frac_agn_p50`` of
# 0.4 or more), ``above`` the share with a fraction of 0.1 or more, which are those that ``n`` counts.

names = ["log_luminosity_low", "n", "n_shipped", "n_selected"]
names += ["completeness", "above"]
shown = result.numbers[names]
shown.round(2)
shown

# %%
# The luminosity function, and what went in:

numbers = result.numbers[np.isfinite(result.numbers["log_luminosity_high"])]
low, high = numbers["log_luminosity_low"], numbers["log_luminosity_high"]
middle = (low + high) / 2
density = numbers["density"].value
bars = [
    density - numbers["density_low"].value,
    numbers["density_high"].value - density,
]
true = np.log10(fluxes["accretion_power"][has_agn].to_value("erg/s"))
counts, _ = np.histogram(true, [*low, high[-1]])
inner, outer = model.cosmology.comoving_volume(survey.bins.redshift)
shell = outer - inner
cubic_mpc = (shell * (5 * u.arcmin**2) / (4 * np.pi * u.sr)).to_value("Mpc3")

fig, ax = plt.subplots(figsize=(6, 4), layout="constrained")
ax.stairs(counts / cubic_mpc / 0.5, [*low, high[-1]], color="0.6", label="truth")
for x, y, bar, good in zip(
    middle, density, np.transpose(bars), numbers["constrained"], strict=True
):
    face = "tab:blue" if good else "none"
    ax.errorbar(x, y, bar[:, None], fmt="o", color="tab:blue", mfc=face)
ax.set(xlabel="log L (erg/s)", ylabel="AGN / Mpc³ / dex", yscale="log")
ax.legend()
plt.show()

# %%
# Open points, as on the page ``agn/page.html``, are bins whose ``constrained`` is false: most AGN of such a
# luminosity are too faint beside their galaxies, and the density rests on the few that are not.
# :doc:`/method/agn_numbers` says what is assumed, and how well it works.
