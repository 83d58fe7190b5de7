"""
The study by hand
=================

``miricigale run`` goes through the stages of a study by itself (:doc:`/method/dataflow`). Here you do them one by
one, for forty real galaxies, two MIRI bands and two dithers. The input and the output of each stage are objects
that you can look at, plot, write, change, or replace by your own.
"""

# %%
# 1. Catalog
# ----------
# A catalog is a table with positions, redshifts, shapes, and fluxes in columns that have the names of filters. The
# package brings a part of GOODS-S, of which 56" x 56" are needed here (the BRIGHTSKY subarray).

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.table import QTable

from miricigale import ErrorModel, ForcedPhotometer
from miricigale.detector import Detector
from miricigale.evaluation import classify, match_truth, photoz_metrics
from miricigale.fitting import BayesFitter, GridSettings
from miricigale.instrument import Exposure, mosaic_wcs
from miricigale.photometry import detect_sources, join_bands
from miricigale.psf import MatchingKernel, hst_psf, miri_psf, psf_mosaic
from miricigale.reduction import Reducer
from miricigale.scene import Scene, highres_image, read_catalog
from miricigale.sed import SEDModel

options = {"subarray": "BRIGHTSKY", "pointing": "53.129 -27.842"}
exposure = Exposure("F770W", n_groups=60, n_integrations=2, **options)
catalog = read_catalog("catalog.goodss")
inside = exposure.wcs.footprint_contains(catalog["sky"])
galaxies = catalog[inside & ~catalog["star"]]
galaxies.sort("mag_f160w")
galaxies = galaxies[:40]
galaxies["id", "redshift", "half_light_radius", "wfc3.f160w"][:5]

# %%
# 2. Spectra
# ----------
# The fluxes of the catalog are fitted at the known redshifts with galaxies without an AGN. The grid has these
# redshifts, rounded to 0.01, and a coarse set of star formation histories, attenuations and dust temperatures.

bands = [name for name in galaxies.colnames if name.startswith("nircam.")]
photometry = galaxies["id", "redshift", *bands]
for name in bands:
    photometry[f"{name}_err"] = 0.05 * np.abs(photometry[name])
names = ("tau", "age", "ebv", "alpha")
axes = {name: SEDModel.yang2021_axes("quick")[name] for name in names}
axes["redshift"] = np.unique(np.round(photometry["redshift"], 2))
model = SEDModel.yang2021(agn=False)
# on the nodes, as studies fit their input: the model has to be one that the grid has
settings = GridSettings(redshift_tolerance=0.01, interpolate=0)
fitter = BayesFitter(model, bands, axes=axes, settings=settings)
spectra = fitter.fit(photometry, redshift="redshift")

# %%
# 3. Model fluxes
# ---------------
# The best model of each galaxy becomes its truth: its fluxes in two MIRI bands, and in the 15 existing bands of
# Yang et al. 2021, from u to 24 µm. A model with an AGN would take a column ``frac_agn``, too.

miri = ["miri.f770w", "miri.f1500w"]
existing = ErrorModel.yang2021()
parameters = galaxies["id", "redshift"]
for name in (*names, "mass"):
    parameters[name] = spectra.to_table()[f"{name}_best"]
light = model.fluxes(parameters, [*existing.filters, *miri])
truth = galaxies.copy()
for name in (*existing.filters, *miri):
    truth[name] = light[name]
ax = plt.subplots(layout="constrained")[1]
ax.semilogy(truth["redshift"], truth["miri.f1500w"] / truth["miri.f770w"], "o")
ax.set(xlabel="redshift", ylabel="F1500W / F770W")
plt.show()

# %%
# 4. Scene
# --------
# A scene is the catalog as MIRI sees it without noise: through the distortion of the detector and the PSF.

dithers, scenes = {}, {}
for name in miri:
    dithers[name] = exposure.replace(filter=name).dithered("ceers", 2)
    views = dithers[name]
    scenes[name] = [Scene(truth, view, background="low") for view in views]
scenes["miri.f770w"][0].plot(ax=plt.subplots(figsize=(6, 5))[1])
plt.show()

# %%
# 5. Ramps
# --------
# The detector applies its effects in a fixed order, and turns a scene into counts, group by group. The figure
# shows the counts of one pixel in both integrations. ``Ramp.write`` writes level 1b files for the JWST pipeline.

detector = Detector.miri_imager()
ramps = {k: [detector.expose(scene, seed=1) for scene in scenes[k]] for k in miri}
ramps["miri.f770w"][0].plot(pixel=(250, 260))
plt.show()

# %%
# 6. Rates and calibrated images
# ------------------------------
# The reducer fits straight lines to the ramps, cut where cosmic rays hit. Then it subtracts the dark, divides by
# the flat field, converts to surface brightness and subtracts the background. The errors are right if the pulls,
# values over their errors, have a standard normal distribution. Galaxies make the tail on the right.

reducer = Reducer()
images = {name: [] for name in miri}
for name in miri:
    for ramp in ramps[name]:
        calibrated = reducer.calibrate(reducer.fit_ramp(ramp))
        images[name].append(reducer.subtract_background(calibrated)[0])
image = images["miri.f770w"][0]
pull = (image.data / image.uncertainty.array)[~image.mask]
ax = plt.subplots(layout="constrained")[1]
x = np.linspace(-5, 8, 131)
ax.hist(pull, bins=x, density=True, color="0.75", label="pixels")
ax.plot(x, np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi), color="C3", label="normal")
ax.set(yscale="log", ylim=(1e-5, 1), xlabel="value / error", ylabel="density")
ax.legend()
plt.show()

# %%
# 7. Mosaics
# ----------
# The dithers are drizzled onto one grid with north up, here with the pixel size of the detector.

all_dithers = [*dithers["miri.f770w"], *dithers["miri.f1500w"]]
grid = mosaic_wcs(all_dithers, 0.11 * u.arcsec)
mosaics = {name: reducer.mosaic(images[name], grid) for name in miri}
mosaics["miri.f1500w"].plot()
plt.show()

# %%
# 8. Prior and kernels
# --------------------
# An F160W image of the same galaxies with noise is the prior: the sources that are found on it will be measured.
# A kernel turns the sharp PSF into that of the mosaic: the two encircled energies should then agree.

sharp = hst_psf("wfc3.f160w", pixel_scale=0.06 * u.arcsec)
fine = mosaic_wcs(all_dithers, 0.06 * u.arcsec)
prior = highres_image(truth, filter="wfc3.f160w", wcs=fine, psf=sharp, seed=1)
segmentation, detected = detect_sources(prior)
kernels = {}
for name in miri:
    angles = u.Quantity([dither.pa_aper for dither in dithers[name]])
    target = psf_mosaic(miri_psf(name), 0.11 * u.arcsec, angles)
    kernels[name] = MatchingKernel.from_psfs(sharp, target)
kernels["miri.f1500w"].plot(ax=plt.subplots(layout="constrained")[1])
plt.show()

# %%
# 9. Forced photometry
# --------------------
# Each galaxy is cut from the sharp image and brought to the resolution of MIRI. All of them are fitted to the
# mosaic at once. The residual shows noise.

results = {}
for name in miri:
    photometer = ForcedPhotometer(kernels[name])
    results[name] = photometer.measure(mosaics[name], prior, segmentation, detected)
results["miri.f770w"].plot()
plt.show()

# %%
# The measured fluxes are matched to the true ones by position.

measured = match_truth(truth, join_bands(results), miri)
figure, axes = plt.subplots(1, 2, figsize=(10, 4), sharey=True)
for ax, name in zip(axes, miri, strict=True):
    true, flux = measured[f"{name}_true"].value, measured[name].value
    ax.errorbar(true, flux / true, measured[f"{name}_err"].value / true, fmt="o")
    ax.axhline(1, color="0.5")
    ax.set(xscale="log", ylim=(0, 2), title=name, xlabel="true flux (µJy)")
axes[0].set_ylabel("measured / true flux")
plt.show()

# %%
# 10. Error function
# ------------------
# Formal errors do not include the errors of templates and backgrounds. The comparison with the truth does: the
# scatter of measured against true flux, as a function of flux, is the error that enters the fits. It also gives
# the depth.

errors = ErrorModel.from_tables(truth, measured, filters=miri, bin_size=10)
measured = errors.assign(measured, filters=miri)
errors.plot(ax=plt.subplots(layout="constrained")[1])
plt.show()

# %%
# 11. Fits
# --------
# The existing bands get noise of the depths of their surveys; the MIRI bands are the measured ones. Redshift, AGN
# fraction and all other parameters are fitted together, with and without MIRI, for the galaxies that MIRI detects
# in both bands.

snr = np.array([measured[name] / measured[f"{name}_err"] for name in miri])
sample = np.all(snr > 5, axis=0)
photometry = existing.perturb(truth["id", *existing.filters][sample], seed=1)
for name in (column for band in miri for column in (band, f"{band}_err")):
    photometry[name] = measured[name][sample]
model, axes = SEDModel.yang2021(), SEDModel.yang2021_axes("quick")
fits = {}
for label, names in {"without MIRI": [], "with MIRI": miri}.items():
    fitter = BayesFitter(model, [*existing.filters, *names], axes=axes)
    fits[label] = fitter.fit(photometry)
tables = {label: fit.to_table() for label, fit in fits.items()}
widths = [table["frac_agn_std"] for table in tables.values()]
best = np.argmax(widths[0] - widths[1])
fits["with MIRI"][best].plot_sed()
plt.show()

# %%
# The figure above has the galaxy whose AGN fraction MIRI constrains most. Its posteriors follow, and the mean and
# the standard deviation for all galaxies:

figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
for label, table in tables.items():
    fits[label][best].plot_pdf("frac_agn", ax=left, label="AGN fraction")
    mean, std = table["frac_agn_mean"], table["frac_agn_std"]
    right.errorbar(np.arange(len(mean)), mean, std, fmt="o", ms=4, label=label)
left.autoscale(axis="y")
right.set(xlabel="galaxy", ylabel="AGN fraction (truth: 0)")
right.legend()
plt.show()

# %%
# 12. Evaluation
# --------------
# The results are compared with the truth: all galaxies are without an AGN. These are too few galaxies to say what
# MIRI does for their redshifts, but their AGN fractions show it.

rows = []
for label, table in tables.items():
    metrics = photoz_metrics(truth["redshift"][sample], table["redshift_mean"])
    row = {"fit": label, "n": metrics.n, "sigma_mad": round(metrics.sigma_mad, 3)}
    for name in ("frac_agn_mean", "frac_agn_std"):
        row[name] = np.mean(table[name]).round(3)
    row["called galaxy"] = np.sum(classify(table["frac_agn_mean"]) == "galaxy")
    rows.append(row)
QTable(rows)

# %%
# ``miricigale run`` does this for six bands and hundreds of galaxies, resumes after a stop, and writes numbers
# and figures on one page: see :doc:`/method/workflow`. :doc:`/accuracy/study` has the results.
