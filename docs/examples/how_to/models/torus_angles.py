"""
Vary angle and depth of a torus
===============================

You want to know how an AGN looks from above and from the side, and what its optical depth and
polar dust change.
"""

# %%
# ``templates`` gives disk, torus and polar dust for one watt of dust emission.

import matplotlib.pyplot as plt
import numpy as np
from astropy.table import Table

from miricigale.sed import components as c

torus = c.ParametricTorus(ebv_polar=0.0)
wave = torus.nodes()
defaults = {name: par.default for name, par in torus.parameters.items()}


def light(**values):
    """wave x L_lambda of all parts over the accretion power."""
    parts = torus.templates(wave, defaults | values)
    return wave * parts.total / parts.accretion_power


fig, axes = plt.subplots(1, 2, figsize=(10, 4.2), sharey=True, layout="constrained")
for inclination in (0, 30, 50, 60, 80):
    color, label = plt.cm.viridis(inclination / 90), f"{inclination} deg"
    axes[0].loglog(wave, light(inclination=inclination), color=color, label=label)
for tau in (3, 7, 11):
    color = plt.cm.magma((tau - 2) / 12)
    for angle, line in ((30, "-"), (80, "--")):
        style = {"color": color, "ls": line, "label": f"{tau}, {angle} deg"}
        axes[1].loglog(wave, light(inclination=angle, tau97=tau), **style)
axes[0].set(xlim=(0.1, 200), ylim=(3e-3, 1))
axes[0].set_ylabel("$\\lambda L_\\lambda$ over accretion power")
axes[0].legend(title="inclination")
axes[1].set(xlim=(0.1, 200))
axes[1].legend(title="tau97", ncol=2)
for ax in axes:
    ax.set_xlabel("rest wavelength (µm)")
plt.show()

# %%
# With the default opening angle of 40 deg the disk is hidden at inclinations above 50 deg: a type-2 AGN. The
# silicates at 9.7 um turn from emission to absorption. The share of the accretion power that is seen per unit of
# ln(wavelength):

rest = np.array([0.5, 2.0, 6.0, 9.7, 20.0])
table = Table({"inclination": [0, 30, 49, 60, 90]})
for um in rest:
    seen = [light(inclination=float(angle)) for angle in table["inclination"]]
    table[f"{um:g} um"] = [np.interp(um, wave, spectrum) for spectrum in seen]
table.round(3)
table

# %%
# Polar dust reddens the disk of a type-1 AGN and emits at 10-100 um. Here it has 200 K and is seen at 30 deg.

ax = plt.figure(figsize=(8, 4.2)).gca()
for ebv in (0.0, 0.05, 0.2, 0.5):
    color = plt.cm.cividis(ebv * 1.8)
    y = light(inclination=30.0, ebv_polar=ebv, temperature_polar=200.0)
    ax.loglog(wave, y, color=color, label=f"E(B-V) = {ebv:g}")
ax.set(xlim=(0.1, 200), ylim=(3e-3, 1), xlabel="rest wavelength (µm)")
ax.set_ylabel("$\\lambda L_\\lambda$ over accretion power")
ax.legend()
plt.show()

# %%
# In a model these are parameters: ``model(inclination=30, tau97=5, ebv_polar=0.2, ...)``. Yang et al. (2021) fit
# the optical depth and the polar dust and fix the other torus parameters. See
# :doc:`/method/sed/parametric_torus`, :doc:`/method/sed/polar_dust` and, with the library registered,
# :doc:`/method/sed/skirtor2016`.
