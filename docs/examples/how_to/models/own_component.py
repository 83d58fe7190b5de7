"""
Write your own AGN component
============================

You have an AGN template, or a formula, that the package lacks. You want it in the chain of a model, so that
spectra, tables of fluxes, grids and fits use it.
"""

# %%
# An AGN is a subclass of ``AGN`` that returns three spectra in W/um on a common scale: the disk face on, the
# disk as seen, and the dust. Here the disk is a power law, and the dust two blackbodies whose temperatures and
# ratio are parameters. Each parameter has default, bounds, doc and unit; the fitter reads the same declaration.

import matplotlib.pyplot as plt
import numpy as np

from miricigale import BayesFitter, SEDModel
from miricigale.sed import Parameter, register
from miricigale.sed.components import AGN, TorusSpectra


def planck(wave, temperature):
    x = 14387.77 / (wave * temperature)
    return wave**-5 / np.expm1(np.minimum(x, 600.0))


@register
class TwoTemperatures(AGN):
    """A disk and dust of two temperatures."""

    name = "two_temperatures"
    reference = "this page"
    hot = Parameter(1300.0, (800.0, 1800.0), "Hot dust.", unit="K")
    warm = Parameter(250.0, (100.0, 500.0), "Warm dust.", unit="K")
    hot_share = Parameter(0.4, (0.0, 1.0), "Share of the hot dust in the power.")

    def nodes(self):
        return np.geomspace(0.008, 1000.0, 400)

    def torus_spectra(self, wave, values):
        hot, warm = planck(wave, values["hot"]), planck(wave, values["warm"])
        share = values["hot_share"]
        dust = share * hot / np.trapezoid(hot, wave)
        dust += (1.0 - share) * warm / np.trapezoid(warm, wave)
        disk = np.where(wave < 5.0, wave**-1.5, 0.0) * (wave > 0.05)
        disk *= 2.0 / np.trapezoid(disk, wave)
        hidden = values["inclination"] > 90.0 - values["opening_angle"]
        return TorusSpectra(disk, 0.02 * disk if hidden else disk, dust)


# %%
# The new component replaces the torus in a chain. The base class provides the inclination and the polar dust.

paper = SEDModel.yang2021(libraries="bundled")
parts = [part for part in paper.components if part.role != "agn"]
model = SEDModel([*parts, TwoTemperatures(inclination=30.0)])
model

# %%

fig, ax = plt.subplots(figsize=(8, 4.5))
values = {"redshift": 2.0, "age": 1.0, "ebv": 0.3, "frac_agn": 0.5, "mass": 3e10}
for share, color in ((0.1, "tab:red"), (0.4, "tab:orange"), (0.8, "tab:blue")):
    sed = model(**values, hot_share=share)
    sed.plot(ax, color=color, label=f"hot_share = {share}")
paper(**values).plot(ax, color="0.5", ls=":", label="torus of the package")
ax.set(xlim=(0.3, 300), ylim=(0.3, 5e3), title="A custom AGN in a galaxy at z = 2")
ax.legend()
plt.show()

# %%
# Grids and fits use the new component like any other. Here the fluxes of one model are fitted with errors of 5 %.

bands = ["F606W", "F160W", "F356W", "F770W", "F1000W", "F1500W", "F2100W"]
truth = model(**values, hot_share=0.6)
catalog = {"id": [1]}
for band, flux in zip(bands, truth.fluxes(bands), strict=True):
    catalog[band] = flux[None]
    catalog[f"{band}_err"] = 0.05 * flux[None]

axes = {
    "redshift": [2.0],
    "age": [0.5, 1.0, 2.0],
    "ebv": [0.1, 0.3, 0.5],
    "hot_share": np.linspace(0.0, 1.0, 11),
    "frac_agn": np.linspace(0.0, 0.9, 10),
}
results = BayesFitter(model, bands, axes=axes).fit(catalog)
row = results.to_table()[0]
for name, true in (("hot_share", 0.6), ("frac_agn", 0.5)):
    mean, std = row[f"{name}_mean"], row[f"{name}_std"]
    print(f"{name:10s} {mean:.2f} +- {std:.2f}, true {true}")

# %%
# ``@register`` lets a configuration name the component: ``{"name": "two_temperatures"}``. Raise ``version`` of
# the class when its numbers change, so that cached grids are made again. Components of other roles work the same
# way; the methods that each role needs, tests and the record of data are in :doc:`/developers/add_component`.
