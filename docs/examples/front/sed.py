"""
What MIRI adds to a spectral energy distribution
================================================

The figure of the front page: a simulated galaxy with an AGN, fitted without and with six MIRI bands.
"""

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.table import QTable

from miricigale import BayesFitter, ErrorModel, FilterSet, SEDModel

survey = ErrorModel.yang2021()
existing = list(survey.filters)
miri = [f"miri.f{number}w" for number in (770, 1000, 1280, 1500, 1800, 2100)]
model = SEDModel.yang2021()
galaxy = {"redshift": 1.6, "tau": 1 * u.Gyr, "age": 1 * u.Gyr, "ebv": 0.3}
agn = {"mass": 4e10 * u.Msun, "alpha": 2.0, "frac_agn": 0.4, "tau97": 7.0}
light = model.fluxes(QTable([{"id": 1, **galaxy, **agn}]), existing + miri)
photometry = survey.perturb(light["id", *existing], seed=2)
# noise of 5 % in the MIRI bands
noise = np.random.default_rng(3).normal(0.0, 0.05, len(miri))
for name, offset in zip(miri, noise, strict=True):
    photometry[name] = light[name] * (1.0 + offset)
    photometry[f"{name}_err"] = 0.05 * light[name]

axes = SEDModel.yang2021_axes("quick") | {"redshift": np.linspace(1, 2.4, 29)}
choices = {
    "without MIRI": (existing, "#2563eb"),
    "with MIRI": (existing + miri, "#dc3c1e"),
}
_, ax = plt.subplots(figsize=(7.5, 4.2), layout="constrained")
for label, (filters, color) in choices.items():
    samples = BayesFitter(model, filters, axes=axes).sample(photometry, 400, seed=1)
    draws = samples.to_table()
    z, f = draws["redshift"], draws["frac_agn"]
    label += f": $z$ = {z.mean():.2f} ± {z.std():.2f}"
    label += f", fracAGN = {f.mean():.2f} ± {f.std():.2f}"
    band = samples.sed_band(1, rest=False)
    wave = band["wave"].to_value(u.um)
    low, middle, high = (band[p].to_value(u.uJy) for p in ("p16", "p50", "p84"))
    ax.fill_between(wave, low, high, color=color, alpha=0.3, lw=0, label=label)
    ax.plot(wave, middle, color=color, lw=1)
for filters, marker, color in ((existing, "o", "0.25"), (miri, "D", "#dc3c1e")):
    wave = FilterSet(filters).pivot.to_value(u.um)
    flux, error = (
        [photometry[name + end][0].to_value(u.uJy) for name in filters]
        for end in ("", "_err")
    )
    ax.errorbar(wave, flux, error, fmt=marker, color=color, ms=5, mfc="white")
truth = f"truth: $z$ = {galaxy['redshift']:.2f}, fracAGN = {agn['frac_agn']:.2f}"
sed = model.evaluate(**galaxy, **agn)
ax.plot(sed.wave.to_value(u.um), sed.fnu.to_value(u.uJy), "k:", lw=1, label=truth)
ax.set(xscale="log", yscale="log", xlim=(0.3, 30), ylim=(0.1, 300))
ax.set_xticks([0.3, 1, 3, 10, 30], ["0.3", "1", "3", "10", "30"])
ax.set(xlabel="observed wavelength (µm)", ylabel="flux density (µJy)")
ax.legend(loc="upper left", frameon=False)
plt.show()
