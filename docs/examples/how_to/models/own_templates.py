"""
Fit with your own templates
===========================

You have spectra, such as a library of stars or your favorite galaxies. You want to know which of them fits
measured fluxes, and how bright it is.
"""

# %%
# A template is an ``SED``: wavelengths and flux densities. ``read_spectra`` reads a folder of FITS or text
# files. Here they are blackbodies of stars and two power laws in F_lambda, written as text.

from pathlib import Path

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.modeling.physical_models import BlackBody

from miricigale import BayesFitter
from miricigale.filters import FilterSet
from miricigale.sed import read_spectra, template_grid

Path("templates").mkdir(exist_ok=True)
wave = np.geomspace(3000, 350000, 800)  # Angstrom
for kelvin in (3500, 4500, 6000, 8000):
    fnu = BlackBody(kelvin * u.K)(wave * u.AA).value
    np.savetxt(f"templates/star_{kelvin}.txt", np.c_[wave, fnu / wave**2])
for slope in (1, 2):
    np.savetxt(f"templates/power_{slope}.txt", np.c_[wave, wave ** (slope - 2.0)])

spectra = read_spectra("templates")
list(spectra)

# %%
# ``template_grid`` turns them into a grid at redshift 0 for the fitter. The free scale is the mean flux.

bands = ["F606W", "F160W", "IRAC1", "IRAC2", "F770W", "F1500W"]
grid = template_grid(spectra, bands)
grid

# %%
# Fluxes of two objects with 5 % errors: a star of 6000 K, and one whose flux rises to the red.

rng = np.random.default_rng(1)
shapes = [spectra["star_6000"].fluxes(bands), spectra["power_2"].fluxes(bands)]
fluxes = np.array([8.0 * s.value / s.value.mean() for s in shapes])
fluxes *= 1.0 + 0.05 * rng.standard_normal(fluxes.shape)
catalog = {"id": ["a", "b"]}
for band, flux in zip(bands, fluxes.T, strict=True):
    catalog[band], catalog[f"{band}_err"] = flux * u.uJy, 0.05 * flux * u.uJy

results = BayesFitter(grid).fit(catalog)
table = results.to_table()["id", "n_bands", "chi2_best"]
names = grid.meta["templates"]
numbers = results.to_table()["template_best"].value.astype(int)
table["template"] = [names[number] for number in numbers]
table["chi2_best"].info.format = ".1f"
table

# %%
# The measured fluxes and all templates, scaled to them; the best one is red.

fig, axes = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
for ax, row, flux in zip(axes, table, fluxes, strict=True):
    for name, sed in spectra.items():
        model, best = sed.fluxes(bands).value, name == row["template"]
        scaled = sed * (flux @ model / (model @ model))
        scaled.plot(ax, color="tab:red" if best else "0.75", lw=2 if best else 0.8)
    pivots = FilterSet(bands).pivots.value
    ax.errorbar(pivots, flux, 0.05 * flux, fmt="o", color="black")
    ax.set(xlim=(0.4, 22), ylim=(0.05, 60))
    ax.set_title(f"object {row['id']}: {row['template']}")
plt.show()

# %%
# For real stars, download the atlas of Pickles (1998) or model atmospheres from STScI, and give the folder.
# Spectra that end before the bands do need ``beyond="rayleigh-jeans"``. To fit templates at other redshifts,
# write a component (:doc:`own_component`). See :doc:`/method/fitting`.
