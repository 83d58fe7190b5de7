"""
Compare a fit with and without MIRI
===================================

You have photometry up to 5 um. You want to see what MIRI adds for one galaxy: its spectrum, its AGN fraction, its
dust luminosity.
"""

# %%
# The galaxy is simulated: redshift 1.5, with 40 % of the infrared power from an AGN. Errors are 5 % in all bands.

import matplotlib.pyplot as plt
import numpy as np
from astropy.table import QTable

from miricigale import BayesFitter, Filter, SEDModel

hst = ["acs.f435w", "acs.f606w", "acs.f814w", "wfc3.f125w", "wfc3.f160w"]
nircam = ["nircam.f200w", "nircam.f277w", "nircam.f356w", "nircam.f444w"]
miri = ["miri.f560w", "miri.f770w", "miri.f1000w", "miri.f1280w"]
miri += ["miri.f1500w", "miri.f1800w", "miri.f2100w"]
bands = hst + nircam + miri

model = SEDModel.survey()
truth = {"redshift": 1.5, "mass": 5e10, "age": 3.0, "ebv": 0.3, "frac_agn": 0.4}
fluxes = model.fluxes({name: [value] for name, value in truth.items()}, bands)
rng = np.random.default_rng(3)
photometry = QTable({"id": ["galaxy"]})
for band in bands:
    error = 0.05 * fluxes[band]
    photometry[band] = fluxes[band] + error * rng.normal(size=1)
    photometry[f"{band}_err"] = error

# %%
# Fit the bands up to 5 um, and all bands. The galaxy is one of the models, so that an error of 5 % is enough;
# leave ``model_error`` out for real ones. The mass is in 1e10 solar masses, the dust luminosity in 1e11 solar
# luminosities.

fitters = {
    "HST, NIRCam": BayesFitter(model, hst + nircam, model_error=0.05),
    "HST, NIRCam, MIRI": BayesFitter(model, bands, model_error=0.05),
}
fits = {name: fitter.fit(photometry)["galaxy"] for name, fitter in fitters.items()}
table = QTable({"bands": list(fits)})
units = {"redshift": "", "frac_agn": ""}
units |= {"mass": "1e10 Msun", "dust_luminosity": "1e11 Lsun"}
for name, unit in units.items():
    mean = [fit.mean(name).to_value(unit) for fit in fits.values()]
    std = [fit.std(name).to_value(unit) for fit in fits.values()]
    table[name] = [f"{m:.2f} ± {s:.2f}" for m, s in zip(mean, std, strict=True)]
table

# %%
# Draws from the posterior show the spectra that the data allow: the shaded bands hold 68 % of them.

true = model.evaluate(**truth)
fig, (left, right) = plt.subplots(
    1, 2, figsize=(11, 4.2), width_ratios=[2.2, 1], layout="constrained"
)
colors = dict(zip(fitters, ["tab:blue", "tab:red"], strict=True))
for label, fitter in fitters.items():
    style = {"color": colors[label], "label": label}
    samples = fitter.sample(photometry, 400, seed=1)
    samples.plot_sed_band("galaxy", left, rest=False, **style)
    fits[label].plot_pdf("frac_agn", right, alpha=0.4, color=colors[label])
left.plot(true.wave.to("um"), true.fnu.to("uJy"), "k:", lw=1, label="truth")
for names, marker, face in [(hst + nircam, "o", "white"), (miri, "s", "tab:red")]:
    wave = [Filter.from_name(name).pivot.to_value("um") for name in names]
    value = [photometry[name][0].value for name in names]
    error = [photometry[f"{name}_err"][0].value for name in names]
    left.errorbar(wave, value, error, fmt="k" + marker, mfc=face, ms=6, zorder=5)
left.set(xlim=(0.4, 40), ylim=(0.03, 300))
left.legend(loc="upper left")
right.axvline(truth["frac_agn"], color="k", ls=":", label="truth")
right.set(xlabel="AGN fraction", ylabel="posterior density", xlim=(0, 1))
plt.show()

# %%
# See :doc:`/method/fitting` for what is computed, :doc:`agn_fraction` for whether an AGN is real, and
# :doc:`/method/planning` to find the bands and depths that a survey needs.
