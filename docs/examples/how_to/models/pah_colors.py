"""
Follow MIRI colors with redshift
================================

You want to know at which redshifts a PAH feature brightens a MIRI band, how far colors change, and how an AGN
hides it.
"""

# %%
# One table of parameters, a row for each redshift, gives the fluxes at exact redshifts.

import matplotlib.pyplot as plt
import numpy as np
from astropy.table import QTable, Table

from miricigale import SEDModel
from miricigale.filters import FilterSet

bands = FilterSet(["F770W", "F1000W", "F1500W", "F2100W"])
model = SEDModel.survey(libraries="bundled")
redshift = np.linspace(0.01, 3.0, 150)


def colors(**values):
    rows = QTable({"redshift": redshift})
    for name, value in ({"age": 1.0, "ebv": 0.4} | values).items():
        rows[name] = value
    fluxes = model.fluxes(rows, bands)
    magnitudes = {name: fluxes[name].to_value("mag(AB)") for name in bands.names}
    pairs = zip(bands.names, bands.names[1:], strict=False)
    return {(blue, red): magnitudes[blue] - magnitudes[red] for blue, red in pairs}


# %%
# A galaxy with many PAHs, one with few, and one with an AGN.

cases = {
    "PAH-rich (q_pah = 4.58 %)": ({"q_pah": 4.58}, "tab:red"),
    "PAH-poor (q_pah = 0.47 %)": ({"q_pah": 0.47}, "tab:blue"),
    "PAH-rich, AGN fraction 0.5": ({"q_pah": 4.58, "frac_agn": 0.5}, "black"),
}
fig, axes = plt.subplots(3, 1, figsize=(8, 8), sharex=True, layout="constrained")
for label, (values, color) in cases.items():
    drawn = zip(axes, colors(**values).items(), strict=True)
    for ax, ((blue, red), index) in drawn:
        ax.plot(redshift, index, color=color, label=label)
        names = [name.removeprefix("miri.").upper() for name in (blue, red)]
        ax.set_ylabel(" - ".join(names) + " (AB)")
for ax, band in zip(axes, bands[:3], strict=True):
    for feature in (3.3, 6.2, 7.7, 11.3):
        z = band.pivot.value / feature - 1.0
        if 0.0 < z < 3.0:
            ax.axvline(z, color="0.7", ls=":", lw=1)
            top = ax.get_xaxis_transform()
            ax.text(z, 1.02, f"{feature} µm", ha="center", transform=top)
axes[0].legend(fontsize="small", loc="lower right")
axes[-1].set_xlabel("redshift (dotted: PAH feature at the pivot of the bluer band)")
plt.show()

# %%
# Where each color of the PAH-rich galaxy is bluest, that is, the feature is in the bluer band.

rows = []
for (blue, red), index in colors(q_pah=4.58).items():
    best = np.argmin(index)
    rows.append((blue, red, redshift[best].round(2), index[best].round(2)))
Table(rows=rows, names=["blue", "red", "bluest at z", "color there"])

# %%
# The feature redshifts of all bands are ``miricigale.evaluation.feature_redshifts``. ``q_pah`` is a parameter of
# :doc:`/method/sed/dl07`; Dale et al. 2014 (:doc:`/method/sed/dale2014`) has one shape of the features. See
# :doc:`add_agn` for the fraction.
