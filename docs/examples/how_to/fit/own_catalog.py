"""
Fit your catalog in AB magnitudes
=================================

You have a catalog with column names of your own, AB magnitudes, and gaps where a source was not measured. You want
to fit it without renaming anything.
"""

# %%
# Here a CSV file with simulated magnitudes stands for your catalog.

import matplotlib.pyplot as plt

from miricigale import BayesFitter
from miricigale.filters import read_catalog_photometry

catalog = """\
name,V,dV,I,dI,J,dJ,H,dH,ch1,dch1,F770,dF770,F1500,dF1500
EGS-1,25.42,0.05,24.53,0.04,23.24,0.03,22.80,0.03,21.62,0.05,21.75,0.06,20.48,0.08
EGS-2,24.11,0.03,23.40,0.03,22.83,0.03,22.57,0.03,21.93,0.05,22.30,0.08,20.91,0.10
EGS-3,26.20,0.08,25.61,0.07,24.41,0.05,23.98,0.04,,,23.33,0.15,,
"""
with open("mine.csv", "w") as file:
    file.write(catalog)

# %%
# ``columns`` names your column for each filter, and ``units`` states the unit. Errors of magnitudes become errors
# of fluxes. Blank fields are missing bands. Codes such as -99 and 99 are missing bands too, and a warning counts
# them.

columns = {
    "id": "name",
    "acs.f606w": "V",
    "acs.f814w": "I",
    "wfc3.f125w": "J",
    "wfc3.f160w": "H",
    "irac.ch1": "ch1",
    "miri.f770w": "F770",
    "miri.f1500w": "F1500",
}
bands = [name for name in columns if name != "id"]
columns |= {f"{band}_err": f"d{columns[band]}" for band in bands}
units = {"flux": "ABmag"}
photometry = read_catalog_photometry("mine.csv", columns=columns, units=units)
table = photometry["id", "wfc3.f160w", "wfc3.f160w_err", "irac.ch1"]
table.round(3)
table

# %%
# The fitter takes this table. By default it has the models for real galaxies, their grid, and their calibration:
# the errors of the models by rest wavelength, and the priors of the parameters and of the errors of the bands.

fitter = BayesFitter(bands)
results = fitter.fit(photometry)
columns = ["id", "redshift_p50", "mass_p50", "frac_agn_p50", "chi2_best"]
table = results.to_table()[columns]
for name in table.colnames[1:]:
    table[name].info.format = ".2g" if name == "mass_p50" else ".2f"
table

# %%
# Look at the fit of a source.

fig, axes = plt.subplots(
    2, 1, sharex=True, height_ratios=[3, 1], figsize=(7, 5), layout="constrained"
)
results["EGS-1"].plot_sed(axes)
axes[0].set(xlim=(0.4, 30), ylim=(0.05, 100))
plt.show()

# %%
# The command line reads the same map from a file, and gives the same numbers:
#
# .. code-block:: console
#
#    $ miricigale fit mine.csv --map mine.toml -o fits
#
# with ``mine.toml``:
#
# .. code-block:: toml
#
#    [columns]
#    id = "name"
#    "acs.f606w" = "V"
#    "acs.f606w_err" = "dV"
#    "acs.f814w" = "I"
#    "acs.f814w_err" = "dI"
#    "wfc3.f125w" = "J"
#    "wfc3.f125w_err" = "dJ"
#    "wfc3.f160w" = "H"
#    "wfc3.f160w_err" = "dH"
#    "irac.ch1" = "ch1"
#    "irac.ch1_err" = "dch1"
#    "miri.f770w" = "F770"
#    "miri.f770w_err" = "dF770"
#    "miri.f1500w" = "F1500"
#    "miri.f1500w_err" = "dF1500"
#
#    [units]
#    flux = "ABmag"
#
# The command prints a table of the errors of the bands, and three lines that list the models, the bands, and the
# errors with the priors. Three sources are too few to measure the errors of the bands, so these have their prior:
# in MIRI's bands the errors of the catalog times 3.3, and 15 % of the flux. In a catalog of a hundred sources or
# more the command measures them; in Python, :func:`~miricigale.fitting.calibrate_bands` does
# (:doc:`/method/fitting_errors`). ``--classes all`` also fits quasars and little red dots
# (:doc:`/method/classes`).
#
# If the columns of a CSV file have usual names (``mag_F770W`` and ``magerr_F770W``, or ``F770W`` and
# ``F770W_err``), no map is needed: ``miricigale fit mine.csv --flux-unit ABmag``, or in Python
# ``BayesFitter().fit(table, unit="ABmag")``.
#
# Catalogs of CANDELS, 3D-HST, JADES, DJA, COSMOS2020 and CEERS have ready maps: ``read_catalog_photometry(path,
# "candels")``. See :doc:`/method/filters`.
