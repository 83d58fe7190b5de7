"""
Read and write files of CIGALE
==============================

You have a catalog and a ``pcigale.ini`` of CIGALE. You want to fit them here and get CIGALE's columns.
"""

# %%
# A catalog in CIGALE's format: fluxes in mJy, -9999 for a missing flux, a negative error for an upper limit. The
# fluxes are simulated.

import warnings

import matplotlib.pyplot as plt

from miricigale.cigale import (
    read_cigale_catalog,
    read_cigale_results,
    read_pcigale_ini,
)

names = ["hst.wfc3.F160W", "IRAC1", "F770W", "MIPS1"]
bands = ", ".join(f"{name}, {name}_err" for name in names)
catalog = f"""\
# id redshift {bands.replace(",", "")}
a 1.0  1.9e-2 6e-4  3.6e-2 2e-3  2.2e-2 1.5e-3  1.2e-1 -4e-2
b 0.5  2.6e-2 8e-4  3.1e-2 2e-3  3.4e-2 2.0e-3  -9999  -9999
c 1.0  9.6e-3 4e-4  2.3e-2 1e-3  5.1e-2 3.0e-3  2.1e-1 2e-2
"""
with open("galaxies.txt", "w") as file:
    file.write(catalog)
photometry = read_cigale_catalog("galaxies.txt")
table = photometry["id", "redshift", "irac.ch1", "mips.24", "mips.24_limit"]
table.round(2)
table

# %%
# A configuration of CIGALE, shortened.

modules = ["sfhdelayed", "bc03", "dustatt_modified_starburst"]
modules += ["dale2014", "skirtor2016", "redshifting"]
ini = f"""\
data_file = galaxies.txt
parameters_file =
sed_modules = {", ".join(modules)}
analysis_method = pdf_analysis
bands = {bands}
additionalerror = 0.1
[sed_modules_params]
  [[sfhdelayed]]
    tau_main = 500, 1000, 5000
    age_main = 500, 1000, 3000, 5000
    f_burst = 0
  [[bc03]]
    imf = 1
    metallicity = 0.02
  [[dustatt_modified_starburst]]
    E_BV_lines = 0.1, 0.3, 0.5, 0.8
    E_BV_factor = 1.0
  [[dale2014]]
    fracAGN = 0.0
    alpha = 1.5, 2.0, 2.5
  [[skirtor2016]]
    t = 3, 7
    i = 70
    fracAGN = 0.0, 0.2, 0.4, 0.6, 0.8
  [[redshifting]]
    redshift =
[analysis_params]
  variables = agn.fracAGN, stellar.m_star, sfh.sfr, dust.luminosity
  lim_flag = full
"""
with open("pcigale.ini", "w") as file:
    file.write(ini)

# %%
# One warning names what is left out, replaced, or different from CIGALE. Read it before you compare results.

with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    setup = read_pcigale_ini("pcigale.ini")
print(*str(caught[0].message).split("; "), sep="\n")

# %%
# Fit, and write CIGALE's columns. ``fit_cigale("pcigale.ini", output="results.fits")`` does all of this in one
# call.

results = setup.fit(setup.catalog())
setup.write_results(results, "results.fits", overwrite=True)
table = read_cigale_results("results.fits")
columns = ["bayes.agn.fracAGN", "bayes.agn.fracAGN_err", "bayes.stellar.m_star"]
for name, digits in zip(columns, [".2f", ".2f", ".2e"], strict=True):
    table[name].info.format = digits
table[["id", *columns]]

# %%
# The results are also `~miricigale.fitting.FitResults`, with percentiles, evidences, and plots.

fig, panels = plt.subplots(1, 3, figsize=(11, 3.6), layout="constrained")
for ax, result in zip(panels, results, strict=True):
    result.plot_sed(ax)
    ax.set(xlim=(0.3, 60), ylim=(1, 1000))
plt.show()

# %%
# See :doc:`/method/cigale` for what is read, and :doc:`/coming_from/cigale` for what differs.
