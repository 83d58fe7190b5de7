"""
Fit a large catalog
===================

``BayesFitter.fit`` takes a table and returns results, both in memory. A catalog of millions of galaxies is fitted
from file to file instead. `~miricigale.fitting.fit_file` reads some rows, fits them, writes their results, and
continues. The results are those that one call of ``fit`` gives, number for number. A call that was stopped
resumes, and threads, processes or a cluster can share the work.

This tutorial does all of it with a catalog of 240 simulated galaxies, in seconds: it makes the catalog, fits it,
looks at the results, breaks and repairs them, and checks the redshifts.
"""

# %%
# A catalog on disk
# -----------------
#
# FITS (a binary table) and parquet are read by ranges of rows; ECSV, CSV and other tables are read as a whole. The
# columns are those of ``fit``: ``id``, a flux for each filter, and its error.
#
# The galaxies are drawn from a small grid of models without AGN, with errors of 5 %.

import json
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.table import QTable

from miricigale import BayesFitter, SEDModel
from miricigale.fitting import fit_file, open_results

bands = ["acs.f606w", "acs.f814w", "wfc3.f125w", "wfc3.f160w"]
bands += ["irac.ch1", "miri.f770w", "miri.f1500w"]
axes = {
    "redshift": np.expm1(np.linspace(np.log(1.2), np.log(4.0), 40)),
    "tau": [0.5, 5.0] * u.Gyr,
    "age": [0.5, 1.0, 2.0] * u.Gyr,
    "ebv": [0.0, 0.2, 0.5] * u.mag,
    "alpha": [1.5, 2.5],
}
grid = SEDModel.yang2021(agn=False).grid(axes, bands)
grid

# %%
# Models are counted from 0: ``grid.flux(z, model)`` are their fluxes for one solar mass.

rng = np.random.default_rng(1)
n = 240
z, model = rng.integers(40, size=n), rng.integers(grid.n_galaxies, size=n)
mass = 10 ** rng.uniform(9, 11, n)
flux = mass[:, None] * grid.flux(z, model) * u.uJy
catalog = QTable({"id": np.arange(n), "z_spec": grid.redshift[z].round(4)})
for i, band in enumerate(bands):
    error = 0.05 * flux[:, i]
    catalog[band] = flux[:, i] + rng.normal(size=n) * error
    catalog[f"{band}_err"] = error
catalog.write("catalog.fits", overwrite=True)
table = catalog["id", "z_spec", "wfc3.f160w", "miri.f770w"][:4]
table.round(3)
table

# %%
# From file to file
# -----------------
#
# ``chunk_rows`` is the number of rows that are in memory at a time, with their results, and that one file of
# results has; it is 10000 by default. ``resume=False`` replaces what an earlier run of this tutorial left in the
# folder.

fitter = BayesFitter(grid)
results = fit_file(fitter, "catalog.fits", "fits", chunk_rows=60, resume=False)
results

# %%
# Each part is a file of `~miricigale.fitting.FitResults`, complete in itself.

files = sorted(path for path in Path("fits").glob("[!.]*") if path.is_file())
sizes = [path.stat().st_size // 1000 for path in files]
QTable({"file": [path.name for path in files], "kB": sizes})

# %%
# Look at the results
# -------------------
#
# `~miricigale.fitting.open_results` opens the folder at any later time. Ask for the columns that you need:

results = open_results("fits")
columns = ["id", "redshift_p16", "redshift_p50", "redshift_p84", "mass_p50"]
table = results.to_table(columns)
for name in table.colnames[1:]:
    table[name].info.format = ".2e" if name == "mass_p50" else ".2f"
table[:4]

# %%
# An object has its posterior by its id. ``parts()`` goes through the results a part at a time, with little memory.

good = sum(np.count_nonzero(part.reduced_chi2 < 2) for part in results.parts())
print(f"{good} of {len(results)} objects have a reduced chi2 below 2")

# %%
# Redshifts against the known ones, and the posterior of one object.

fig, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
low, mid, high = (table[f"redshift_{p}"] for p in ("p16", "p50", "p84"))
errors = [mid - low, high - mid]
left.errorbar(catalog["z_spec"], mid, errors, fmt=".", ms=3, lw=0.5)
left.plot([0, 3], [0, 3], "k", lw=0.8)
left.set(xlabel="known redshift", ylabel="photometric redshift")
worst = int(np.argmax(np.abs(mid - catalog["z_spec"])))
results.loc[worst].plot_pdf("redshift", right)
right.axvline(catalog["z_spec"][worst], color="k", ls="--")
right.set_title(f"object {worst}, the largest difference")
plt.show()

# %%
# Nothing depends on the division into parts. One call in memory gives the same numbers:

whole = fitter.fit(catalog)
largest = np.max(np.abs(whole.to_table()["mass_p50"] - table["mass_p50"]))
print(f"largest difference of masses: {largest:.1f}")

# %%
# ``results.write_table("table.fits")`` writes the table of all objects into one file, FITS or parquet, without
# ever having it in memory.
#
# Stop and resume
# ---------------
#
# Parts are written under another name and renamed when they are complete. After a crash the same call fits only
# what is missing. Here one part is lost, and another is damaged:

lost, damaged, kept = (Path(f"fits/part-0000{i}.fits") for i in (1, 2, 3))
before = kept.stat().st_mtime_ns
lost.unlink()
with open(damaged, "r+b") as stream:
    stream.truncate(100_000)
results = fit_file(fitter, "catalog.fits", "fits", chunk_rows=60)
age = kept.stat().st_mtime_ns - before
print(f"{len(results)} objects; part 3 is {age} ns younger")

# %%
# ``manifest.json`` records how the parts were made: checksums of the catalog and the grid, settings, and versions.

manifest = json.loads(Path("fits/manifest.json").read_text())
sorted(manifest)

# %%
# Parts of another fit are never mixed in. Here the redshifts are fixed, which is another fit:

try:
    fit_file(fitter, "catalog.fits", "fits", chunk_rows=60, redshift="z_spec")
except ValueError as error:
    print(error)

# %%
# - ``open_results(path, partial=True)`` reads a folder while it is being filled.
# - While a call fills a folder it holds ``fit.lock`` there, which names its host and process; a second call for
#   the folder is refused. The next call on the same host takes over the lock of a call that was killed. From
#   another host it cannot be seen whether a process still runs: the message names the file to remove if it does
#   not.
# - An id that occurs again is flagged ``DUPLICATE_ID``, in whichever part it occurred first.
#
# Threads, processes, clusters
# ----------------------------
#
# Any `concurrent.futures.Executor` shares the work of each part. Threads are enough on one machine, since the
# compiled functions release the interpreter's lock. Processes and machines get the grid once each, and with every
# task the photometry of 64 objects. The answer does not depend on who did it.

known = {"chunk_rows": 60, "redshift": "z_spec", "resume": False}
with ThreadPoolExecutor(2) as executor:
    shared = fit_file(fitter, "catalog.fits", "threads", executor=executor, **known)
shared

# %%
# At the known redshifts, masses have no error of the redshift. The figure compares both fits with the truth.

fig, ax = plt.subplots(figsize=(7, 4), layout="constrained")
bins = np.linspace(-0.5, 0.5, 61)
for label, fit in [("free redshifts", results), ("known redshifts", shared)]:
    found = fit.to_table(["id", "mass_p50"])["mass_p50"].value
    ax.hist(np.log10(found / mass), bins, alpha=0.6, label=label)
ax.set(xlabel="log10(mass / true mass)", ylabel="objects")
ax.legend()
plt.show()

# %%
# With `dask.distributed <https://distributed.dask.org>`_ (``pip install 'miricigale[dask]'``) the executor is that
# of a client, which connects to a cluster. Where there are as many parts as workers, each worker fits and writes
# whole parts: the workers must see the folder by the same path, and the process that calls ``fit_file`` sends them
# the rows. A part whose worker is lost is made by another one, with the same bytes.
#
# .. code-block:: python
#
#    from distributed import Client, LocalCluster
#
#    if __name__ == "__main__":
#        with LocalCluster(n_workers=2) as cluster, Client(cluster) as client:
#            fit_file(fitter, "catalog.fits", "dask", executor=client.get_executor())
#
# The command line
# ----------------
#
# .. code-block:: console
#
#    $ miricigale fit catalog.fits -o fits --threads 8
#    $ miricigale fit catalog.parquet -o fits --scheduler tcp://host:8786
#
# fit as ``fit_file(BayesFitter(), ...)`` does, with the models for real galaxies and their calibration, in the
# filters of the catalog (the grid of this tutorial is a small one of its own). The results are joined in
# ``fits/table.fits``, or ``fits/table.parquet`` of a catalog in parquet. Ctrl-C keeps the parts that are finished;
# the same command resumes. ``--redshift z_spec`` takes known redshifts from a column, ``--pairs age:tau
# redshift:ebv`` keeps joint posteriors, ``--chunk-rows`` sets the length of the parts, and ``--no-resume`` begins
# anew.
#
# Other inputs
# ------------
#
# - ``redshift`` takes a column or an array of all rows; ``redshift_prior=(z, "p_z")`` takes p(z) from a column of
#   vectors.
# - Other names, magnitudes, and codes for missing values: ``catalog_map=`` (``--map``;
#   :doc:`/how_to/fit/own_catalog`).
# - CSV has no units: ``flux_unit="uJy"`` gives them. The type of a column is what all of its rows can be read as.
# - Compressed files (gzip, bzip2, xz, zip) and FITS tables with columns of variable length, which are left out and
#   named, are read as a whole. Ids that are text but not ASCII, which FITS tables cannot hold, are refused before
#   anything is fitted; ``BayesFitter.fit`` takes them.
#
# Memory and times for millions of objects are in :doc:`/accuracy/fitting`. Next: :doc:`/how_to/fit/mock_analysis`
# tests the errors of the results.
