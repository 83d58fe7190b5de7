"""
From images of a field to its AGN
=================================

You have MIRI mosaics of a field, an image of higher resolution, and a catalog with fluxes in other bands. You
will measure the MIRI fluxes, join them with the catalog, fit redshifts and AGN fractions, and find the AGN.
"""

# %%
# 1. The data
# -----------
# This cell simulates what you would have as files: 30" of GOODS-S with the positions, shapes, redshifts and F160W
# fluxes of real galaxies. In every fourth of them an AGN emits 80 % of the infrared light. MIRI has three bands;
# the catalog has 15 bands from u to 24 µm with the noise of real surveys.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.table import join
from astropy.visualization import make_lupton_rgb

from miricigale import BayesFitter, ErrorModel, ForcedPhotometer, SEDModel
from miricigale.evaluation import photoz_metrics, selection_quality
from miricigale.instrument import north_up_wcs
from miricigale.photometry import detect_sources, join_bands
from miricigale.psf import filter_psf
from miricigale.scene import highres_image, read_catalog

miri = ["miri.f770w", "miri.f1000w", "miri.f1500w"]
existing = ErrorModel.yang2021()
catalog = read_catalog("catalog.goodss")
center = catalog["sky"][catalog["id"] == 13531][0]
near = catalog["sky"].separation(center) < 21 * u.arcsec
truth = catalog[near & ~catalog["star"] & (catalog["mag_f160w"] < 25.5 * u.ABmag)]

parameters = truth["id", "redshift"]
parameters["frac_agn"] = np.where(np.arange(len(truth)) % 4 == 0, 0.8, 0.0)
parameters["tau"] = parameters["age"] = 1 * u.Gyr
parameters["ebv"] = np.random.default_rng(1).uniform(0.1, 0.4, len(truth))
light = SEDModel.survey().fluxes(parameters, [*existing.filters, *miri])
scale = truth["wfc3.f160w"] / light["wfc3.f160w"]
for name in (*existing.filters, *miri):
    truth[name] = light[name] * scale

images, psfs = {}, {}
depths = [27.6, 25.5, 25.0, 24.5] * u.ABmag
for name, depth in zip(["wfc3.f160w", *miri], depths, strict=True):
    pixel = 0.06 * u.arcsec if name == "wfc3.f160w" else 0.11 * u.arcsec
    n_pixels = round((30 * u.arcsec / pixel).value)
    psfs[name] = filter_psf(name, pixel_scale=pixel, pa=0 * u.deg)
    options = {"psf": psfs[name], "depth": depth, "seed": 1}
    options["wcs"] = north_up_wcs(center, pixel, (n_pixels, n_pixels))
    images[name] = highres_image(truth, filter=name, **options)
photometry = existing.perturb(truth["id", "sky", *existing.filters], seed=1)

# %%
# The MIRI images are shown in color, with F1500W in red. AGN have red colors, but so do galaxies whose PAH
# features are in F1500W.

planes = [images[name].data / images[name].data.std() for name in reversed(miri)]
ax = plt.subplots(figsize=(6, 6))[1]
ax.imshow(make_lupton_rgb(*planes, stretch=2, Q=6), origin="lower")
ax.set_axis_off()
plt.show()

# %%
# 2. Measure
# ----------
# Sources are detected on the F160W image. Each segment is the template of the catalog's source in it, so that the
# results have the catalog's ids. The photometer makes the kernels from the PSFs; images may be paths of files,
# too.

prior = images["wfc3.f160w"]
segmentation, detected = detect_sources(prior)
results = {}
for name in miri:
    photometer = ForcedPhotometer(psf=psfs[name], highres_psf=psfs["wfc3.f160w"])
    image = images[name]
    results[name] = photometer.measure(image, prior, segmentation, photometry)
results["miri.f1000w"].plot()
plt.show()

# %%
# 3. Join
# -------
# The fluxes in all MIRI bands go into one table, which is joined with the catalog by id. The sample leaves out
# sources that MIRI does not detect in two bands (5 sigma).

measured = join_bands(results)
columns = [column for name in miri for column in (name, f"{name}_err")]
joined = join(photometry, measured[["id", *columns]], keys="id")
joined.meta.clear()
detected = [joined[name] > 5 * joined[f"{name}_err"] for name in miri]
sample = joined[np.sum(detected, axis=0) >= 2]
shown = sample["id", "wfc3.f160w", *miri][:5]
shown.round(2)
shown

# %%
# 4. Fit
# ------
# The fitter compares each source with a grid of models of real galaxies with AGN. It takes into account the errors
# of these models, and how rare AGN are.

fitter = BayesFitter([*existing.filters, *miri])
fits = fitter.fit(sample)
table = fits.to_table()
columns = ["redshift_mean", "redshift_std", "frac_agn_mean", "frac_agn_std"]
shown = table["id", *columns][:5]
shown.round(3)
shown

# %%
# 5. Find the AGN
# ---------------
# A source is selected if the median of the posterior of its AGN fraction is at least 0.4, that is, if the fraction
# is at least 0.4 with a probability of one half. Plans and studies have the same rule. Redshifts and fractions are
# compared with the truth, which is known here.

selected = table["frac_agn_p50"] >= 0.4
order = [list(truth["id"]).index(key) for key in table["id"]]
z_true, f_true = truth["redshift"][order], parameters["frac_agn"][order]
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4.5), layout="constrained")
for flag, color, label in ((False, "C0", "not selected"), (True, "C3", "selected")):
    rows = selected == flag
    options = {"fmt": "o", "ms": 4, "color": color, "label": label}
    z, z_err, f, f_err = (table[name][rows] for name in columns)
    left.errorbar(z_true[rows], z, z_err, **options)
    jitter = np.linspace(-0.06, 0.06, len(f))
    right.errorbar(f_true[rows] + jitter, f, f_err, **options)
left.plot([0, 4], [0, 4], color="0.5")
left.set(xlabel="true redshift", ylabel="redshift")
right.set(xlabel="true AGN fraction", ylabel="AGN fraction")
right.legend()
plt.show()

# %%
# These are the numbers of this small sample. The fractions are below the true ones, because AGN as strong as these
# are rare according to the prior; in this field every fourth galaxy has one.

quality = selection_quality(f_true > 0, selected)
metrics = photoz_metrics(z_true, table["redshift_mean"])
print(f"redshift: scatter {metrics.sigma_mad:.3f}, outliers {metrics.n_outliers}")
print(f"AGN in the sample: {np.sum(f_true > 0)}, selected: {np.sum(selected)}")
print(f"completeness {quality.completeness.value:.2f}")
print(f"purity {quality.purity.value:.2f}")

# %%
# 6. Look at one of them
# ----------------------
# The figure shows the selected source with the best-known AGN fraction, and its model. ``fits.write("fits.fits")``
# keeps all posteriors.

best = np.argmin(np.where(selected, table["frac_agn_std"], np.inf))
fits[best].plot_sed()
plt.show()

# %%
# With your own files the steps are the commands ``miricigale photometry`` and ``miricigale fit``, which without
# options gives the numbers of ``BayesFitter(bands)``. See
# :doc:`/method/photometry` and :doc:`/method/fitting` for what is computed, and :doc:`/method/agn` for the AGN
# fraction.
