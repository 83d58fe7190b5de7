"""
Compare attenuation laws
========================

You want to know how the dust laws differ, and what the choice does to colors of the same galaxy.
"""

# %%
# Each law is a component. ``factors`` gives the transmission for young and old stars. All are drawn for the same
# attenuation at 0.55 um.

import matplotlib.pyplot as plt
import numpy as np
from astropy.table import Table

from miricigale import SEDModel
from miricigale.sed import components as c

laws = {
    "Calzetti": c.CalzettiLeitherer(),
    "Calzetti, slope -0.5": c.CalzettiLeitherer(slope=-0.5),
    "Calzetti, bump 3": c.CalzettiLeitherer(uv_bump=3.0),
    "Charlot & Fall (young stars)": c.CharlotFall(),
    "SMC (Pei 1992)": c.SMC(law="pei1992"),
}
wave = np.geomspace(0.1, 30.0, 800)

fig, ax = plt.subplots(figsize=(8, 4.5))
for label, law in laws.items():
    values = {name: par.default for name, par in law.parameters.items()}
    attenuation = -2.5 * np.log10(law.factors(wave, values)[0])
    visual = np.interp(0.55, wave, attenuation)
    ax.loglog(wave, np.maximum(attenuation / visual, 1e-4), label=label)
ax.axvline(0.55, color="0.7", lw=0.8)
ax.set(xlabel="rest wavelength (µm)", ylabel="A / A(0.55 µm)", ylim=(3e-3, 15))
ax.legend()
plt.show()

# %%
# In a model: the same stars behind each law, with the color excess that gives A_V = 1 for the whole galaxy. The
# dust luminosity changes little, the ultraviolet slope ``beta`` by more than 3.


def at_visual(law, amount):
    """Derived quantities where A_V is 1, by bisection of the amount of dust."""
    model = SEDModel([c.DelayedSFH(age=0.5), c.BC03(), law, c.DraineLi2007()])
    low, high = 0.0, 3.0
    for _ in range(30):
        middle = 0.5 * (low + high)
        a_v = model.derived(**{amount: middle}, redshift=0.0)["a_v"].value
        low, high = (middle, high) if a_v < 1.0 else (low, middle)
    return model.derived(**{amount: middle}, redshift=0.0)


rows = []
for label, law in laws.items():
    derived = at_visual(law, "av_ism" if law.name == "charlot_fall" else "ebv")
    infrared = np.log10(derived["dust_luminosity"].to_value("Lsun"))
    colors = [derived[name].value for name in ("beta", "nuv_r", "v_j")]
    rows.append((label, *colors, infrared))
table = Table(rows=rows, names=["law", "beta", "NUV - r", "V - J", "log L_dust"])
table.round(2)
table

# %%
# Gas behind more dust than the stars is :doc:`/method/sed/modified_starburst`. The equations and what each law was
# tested against: :doc:`/method/sed/calzetti`, :doc:`/method/sed/charlot_fall`, :doc:`/method/sed/smc` and
# :doc:`/accuracy/sed_components`.
