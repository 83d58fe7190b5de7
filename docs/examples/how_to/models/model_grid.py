"""
Make a grid of models
=====================

You want the band fluxes of thousands of models for a fit, to know how large the grid is, and what its axes do to
colors.
"""

# %%
# Axes are a dict of parameter names and values. ``yang2021_axes`` and ``survey_axes`` are ready-made:
# change them as needed.

import matplotlib.pyplot as plt
import numpy as np

from miricigale import SEDModel

model = SEDModel.yang2021(libraries="bundled")
axes = SEDModel.yang2021_axes("quick")
axes |= {"redshift": np.arange(0.1, 4.0, 0.1), "frac_agn": [0.0, 0.3, 0.6, 0.9]}
bands = ["F160W", "IRAC1", "F770W", "F1000W", "F1500W", "F2100W"]
grid = model.grid(axes, bands)
grid

# %%
# Galaxies and AGN are kept apart: arrays of redshift, model and band. ``galaxy`` is in uJy per solar mass
# formed, ``agn`` in uJy per watt of AGN power. Their sum for a fraction f is galaxy + f / (1 - f) L_dust agn.

print("galaxies", grid.galaxy.shape, " AGN", grid.agn.shape)
size = sum(array.nbytes for array in (grid.galaxy, grid.agn)) / 1e6
print(f"{size:.1f} MB for {grid.n_models:,} models")

# %%
# Parameters and derived quantities of each galaxy are tables.

table = grid.galaxy_parameters["tau", "age", "ebv", "alpha"][:4]
table["sfr_100myr"] = grid.galaxy_properties["sfr_100myr"][:4]
table["sfr_100myr"].info.format = ".2e"
table

# %%
# Colors of all models at z = 1, galaxies and galaxies with AGN. Models that are too old for the redshift are not
# ``allowed``.

z = np.argmin(np.abs(grid.redshift - 1.0))
names = ("miri.f770w", "miri.f1000w", "miri.f2100w")
blue, middle, red = (grid.filters.index(name) for name in names)


def colors(flux):
    magnitude = -2.5 * np.log10(flux)
    x = magnitude[..., middle] - magnitude[..., red]
    return x.ravel(), (magnitude[..., blue] - magnitude[..., middle]).ravel()


galaxies = grid.galaxy[z][grid.allowed[z]]
dust = grid.dust_luminosity[grid.allowed[z]]
fig, ax = plt.subplots(figsize=(7, 5))
for fraction, color in ((0.9, "tab:red"), (0.6, "tab:orange"), (0.3, "gold")):
    power = fraction / (1 - fraction) * dust[:, None, None]
    both = galaxies[:, None, :] + power * grid.agn[z]
    ax.plot(*colors(both), ".", ms=2, color=color, label=f"AGN fraction {fraction}")
ax.plot(*colors(galaxies), "o", ms=4, color="black", label="no AGN")
ax.set(xlabel="F1000W - F2100W (AB)", ylabel="F770W - F1000W (AB)")
ax.set_title("Colors of the models of a grid at z = 1")
ax.legend(markerscale=2)
plt.show()

# %%
# ``grid.write("grid.fits")`` and ``ModelGrid.read`` keep it; ``model.grid`` keeps it in a cache by itself.
# ``BayesFitter(grid)`` fits with it. Which axes for what: :doc:`/method/grids`; what the factors mean:
# :doc:`/method/sed/index`.
