"""
Separate galaxy, quasar and star
================================

You have a catalog in which some sources are stars or quasars. You want to know which, from the photometry.
"""

# %%
# Sixty simulated sources in ten bands with errors of 5 %: galaxies, type-1 AGN that outshine their galaxies, and
# stars. Black bodies represent the stars here; use spectra of a library for real ones:
# ``read_spectra("pickles/")``.

import warnings

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.modeling.models import BlackBody
from astropy.table import QTable, vstack

from miricigale import SED, BayesFitter, FilterSet, SEDModel
from miricigale.fitting import compare_classes
from miricigale.sed import quasar_axes, template_grid
from miricigale.utils.exceptions import FitWarning

bands = ["acs.f606w", "acs.f814w", "wfc3.f125w", "wfc3.f160w", "irac.ch1"]
bands += ["miri.f560w", "miri.f770w", "miri.f1000w", "miri.f1500w", "miri.f2100w"]
rng = np.random.default_rng(6)
n = 20


def star(temperature):
    wave = np.geomspace(0.2, 60, 1500) * u.um
    return SED(wave, 1e-21 * BlackBody(temperature * u.K)(wave) * u.sr)


model = SEDModel.survey()
galaxies = {"redshift": rng.uniform(0.2, 3, n), "mass": np.full(n, 3e10)}
quasars = galaxies | {
    "frac_agn": rng.uniform(0.8, 0.95, n),
    "inclination": np.full(n, 30.0),
}
galaxies |= {"age": rng.uniform(0.3, 1.5, n), "ebv": rng.uniform(0, 0.6, n)}
quasars |= {"ebv": rng.uniform(0, 0.2, n)}
stars = FilterSet.from_names(bands).synthetic_fluxes
sources = [model.fluxes(table, bands)[bands] for table in (galaxies, quasars)]
values = [stars(star(t)) for t in rng.uniform(3000, 10000, n)]
sources.append(
    QTable(np.array([v.to_value(u.uJy) for v in values]) * u.uJy, names=bands),
)
fluxes = vstack(sources, metadata_conflicts="silent")
photometry = QTable({"id": np.arange(3 * n)})
for band in bands:
    error = 0.05 * fluxes[band]
    photometry[band] = fluxes[band] + error * rng.normal(size=3 * n)
    photometry[f"{band}_err"] = error

# %%
# Fit the same photometry with the models of each class and compare the evidences. Fits of sources of another class
# may warn of bands that scatter, which is left out here.

warnings.simplefilter("ignore", FitWarning)
axes = SEDModel.survey_axes() | {
    "f_burst": [0.0],
    "metallicity": [0.02],
    "slope": [0.0],
}
axes |= {"tau": [0.5, 3.0], "ebv": [0.0, 0.2, 0.5, 1.0]}
templates = {f"{t} K": star(t) for t in np.geomspace(2500, 12000, 60).round()}
results = {
    "galaxy": BayesFitter(model.grid(axes, bands)).fit(photometry),
    "quasar": BayesFitter(model.grid(quasar_axes(), bands)).fit(photometry),
    "star": BayesFitter(template_grid(templates, bands)).fit(photometry),
}
table = compare_classes(results)
true = np.repeat(list(results), n)
counts = QTable({"true class": list(results)})
for name in results:
    found = table["class"] == name
    counts[f"found: {name}"] = [np.sum(found & (true == kind)) for kind in results]
counts

# %%
# Each source by its two ratios of evidence. Above 0 the class beats the galaxies; 5 is 150 to 1.

fig, ax = plt.subplots(figsize=(6.5, 5), layout="constrained")
for name, marker in zip(results, "os*", strict=True):
    rows = true == name
    x, y = table["log_ratio_quasar"][rows], table["log_ratio_star"][rows]
    ax.plot(x, y, marker, ms=6, label=name)
ax.axhline(0, color="0.6", lw=0.8)
ax.axvline(0, color="0.6", lw=0.8)
ax.set_xscale("symlog", linthresh=5)
ax.set_yscale("symlog", linthresh=5)
ax.set(xlabel="ln(evidence quasar / galaxy)", ylabel="ln(evidence star / galaxy)")
ax.legend(title="simulated as")
plt.show()

# %%
# The command fits all three and writes the classes into its table and page:
#
# .. code-block:: console
#
#    $ miricigale fit catalog.fits --classes quasars,stars --stars pickles/
#
# Look at the reduced chi2 of the best class too: an artifact belongs to none. See :doc:`/method/classes`, and
# :doc:`/accuracy/fitting` for real sources.
