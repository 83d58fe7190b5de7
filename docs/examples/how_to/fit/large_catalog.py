"""
Fit a large catalog and resume
==============================

Your catalog is larger than memory, or the fit takes hours. You want it on disk, in parts, and to resume it after
it was stopped.
"""

# %%
# A catalog of 60 simulated galaxies at known redshifts, as a FITS file. Parquet is read by parts too, with
# ``pip install miricigale[parquet]``.

from pathlib import Path

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.table import QTable

from miricigale import BayesFitter, SEDModel
from miricigale.fitting import fit_file, open_results

bands = [
    "acs.f606w",
    "acs.f814w",
    "wfc3.f125w",
    "wfc3.f160w",
    "irac.ch1",
    "miri.f770w",
    "miri.f1500w",
]
rng = np.random.default_rng(12)
n = 60
truth = QTable({"id": np.arange(n), "redshift": rng.uniform(0.3, 3, n)})
truth["mass"] = 10 ** rng.uniform(9, 11, n) * u.Msun
truth["age"], truth["tau"] = rng.uniform(0.1, 2, n), rng.uniform(0.2, 3, n)
truth["ebv"] = rng.uniform(0, 0.6, n)
fluxes = SEDModel.survey().fluxes(truth, bands)
catalog = QTable({"id": truth["id"], "z_spec": truth["redshift"]})
for band in bands:
    catalog[band] = fluxes[band] * (1 + 0.1 * rng.normal(size=n))
    catalog[f"{band}_err"] = 0.1 * fluxes[band]
catalog.write("catalog.fits", overwrite=True)

# %%
# ``BayesFitter()`` fits real galaxies in the bands of the catalog. ``chunk_rows`` objects are in memory at a time
# and become one file of results. ``resume=False`` replaces what an earlier fit left in the folder.

fitter = BayesFitter()
options = {"chunk_rows": 15, "redshift": "z_spec"}
results = fit_file(fitter, "catalog.fits", "fits", resume=False, **options)
results

# %%
# A part is lost, as after a crash. The same call fits only what is missing. Results of other settings
# are refused in this folder.

Path("fits/part-00002.fits").unlink()
results = fit_file(fitter, "catalog.fits", "fits", **options)
sorted(path.name for path in Path("fits").glob("part-*.fits"))

# %%
# Open the folder later, and take some columns. ``results.write_table("table.fits")`` joins everything in one FITS
# file, ``table.parquet`` in one of parquet.

results = open_results("fits")
table = results.to_table(["id", "redshift_best", "mass_p50", "sfr_p50", "flags"])
table["redshift_best"].info.format = ".3f"
table["mass_p50"].info.format = table["sfr_p50"].info.format = ".2g"
table[:4]

# %%
# Star-formation rate over stellar mass of the catalog.

fig, ax = plt.subplots(figsize=(6, 4.5), layout="constrained")
mass, sfr = table["mass_p50"].value, np.maximum(table["sfr_p50"].value, 1e-3)
points = ax.scatter(mass, sfr, c=table["redshift_best"], s=4)
ax.set(xscale="log", yscale="log", ylim=(1e-3, 1e4))
ax.set(
    xlabel="stellar mass formed (solar masses)",
    ylabel="star-formation rate (Msun / yr)",
)
fig.colorbar(points, label="redshift")
plt.show()

# %%
# The command does the same. Ctrl-C stops it; the same command resumes it, and the joined table is
# ``fits/table.fits``:
#
# .. code-block:: console
#
#    $ miricigale fit catalog.fits -o fits --redshift z_spec --threads 8 --chunk-rows 15
#
# The tutorial :doc:`/tutorials/large_catalogs` has threads, processes and clusters.
