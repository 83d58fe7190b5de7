"""
An AGN luminosity function from a MIRI field
============================================

You have MIRI mosaics of a field, a NIRCam image, and a catalog with fluxes in other bands. You will measure
MIRI fluxes with the nuclei of galaxies, and count AGN: how many per volume and luminosity, what share of them
is obscured, and what share you would have found.
"""

# %%
# 1. The data
# -----------
# This cell simulates what you would have as files: 45" of GOODS-S with the positions, shapes, redshifts and
# F160W fluxes of real galaxies. A third of them have an AGN, a point of its own spectrum in the center: obscured
# ones and quasars. In the sky these are rarer, and a field has to be larger. MIRI has two bands, NIRCam one, and
# the catalog 15 from u to 24 µm with the noise of real surveys.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.table import QTable, join, vstack

from miricigale import BayesFitter, ErrorModel, ForcedPhotometer, SEDModel
from miricigale.agn import AGNSurvey
from miricigale.instrument import north_up_wcs
from miricigale.photometry import detect_sources, join_bands
from miricigale.psf import filter_psf
from miricigale.scene import highres_image, read_catalog

miri = ["miri.f770w", "miri.f1000w"]
nircam = "nircam.f150w"
existing = ErrorModel.yang2021()
bands = [*existing.filters, nircam, *miri]
width = 45 * u.arcsec

catalog = read_catalog("catalog.goodss")
center = catalog["sky"][catalog["id"] == 16066][0]
east, north = center.spherical_offsets_to(catalog["sky"])
inside = (abs(east) < 0.5 * width) & (abs(north) < 0.5 * width)
bright = catalog["mag_f160w"] < 25 * u.ABmag
near = (catalog["redshift"] > 0.2) & (catalog["redshift"] < 4)
galaxies = catalog[inside & bright & near & ~catalog["star"]]
n = len(galaxies)

rng = np.random.default_rng(2)
order = np.arange(n)
obscured = order % 4 == 0
quasar = (order % 8 == 2) & (galaxies["mag_f160w"] > 23 * u.ABmag)
has_agn = obscured | quasar

model = SEDModel.survey()
hosts = galaxies["id", "redshift"]
hosts["tau"] = hosts["age"] = 1 * u.Gyr
hosts["ebv"] = rng.uniform(0.1, 0.4, n)
hosts["frac_agn"] = 0.0
light = model.fluxes(hosts, bands)
scale = galaxies["wfc3.f160w"] / light["wfc3.f160w"]
hosts["mass"] = light["stellar_mass_formed"] * scale
with_agn = hosts.copy()
with_agn["frac_agn"][obscured] = rng.uniform(0.3, 0.9, obscured.sum())
with_agn["frac_agn"][quasar] = rng.uniform(0.8, 0.95, quasar.sum())
with_agn["inclination"] = np.where(quasar, 30, 70) * u.deg
host_light = model.fluxes(hosts, bands)
total_light = model.fluxes(with_agn, bands)

# an image has the galaxies, and points in their centers
smooth = galaxies.copy()
nuclei = galaxies[has_agn]
nuclei["id"] += 100_000
nuclei["profile"] = "point"
for name in (nircam, *miri):
    smooth[name] = host_light[name]
    nuclei[name] = (total_light[name] - host_light[name])[has_agn]
scene = vstack([smooth, nuclei])

images, psfs = {}, {}
for name, depth in zip((nircam, *miri), [28.5, 26.0, 25.0] * u.ABmag, strict=True):
    pixel = 0.06 * u.arcsec if name == nircam else 0.11 * u.arcsec
    n_pixels = round((width / pixel).to_value(u.one))
    psfs[name] = filter_psf(name, pixel_scale=pixel, pa=0 * u.deg)
    options = {"psf": psfs[name], "depth": depth, "seed": 1}
    options["wcs"] = north_up_wcs(center, pixel, (n_pixels, n_pixels))
    images[name] = highres_image(scene, filter=name, **options)

fluxes = total_light["id", *existing.filters]
fluxes["sky"] = galaxies["sky"]
photometry = existing.perturb(fluxes, seed=1)

figure, axes = plt.subplots(1, 2, figsize=(9, 4.6), layout="constrained")
for ax, name in zip(axes, (nircam, miri[1]), strict=True):
    pixels = images[name].data / np.std(images[name].data)
    ax.imshow(np.arcsinh(20 * pixels), origin="lower", cmap="magma")
    ax.set(title=name, xticks=[], yticks=[])
    x, y = images[name].wcs.world_to_pixel(nuclei["sky"])
    ax.plot(x, y, "o", ms=12, mfc="none", color="white", lw=0.5)
plt.show()

# %%
# 2. Measure, with nuclei
# -----------------------
# Use a prior image in which AGN are faint, here F150W. ``components=2`` fits a point in the center of each galaxy
# in addition to its smooth light.

prior = images[nircam]
segmentation, detected = detect_sources(prior, preset="default")
photometry["components"] = 2
results = {}
for name in miri:
    photometer = ForcedPhotometer(psf=psfs[name], highres_psf=psfs[nircam])
    image = images[name]
    results[name] = photometer.measure(image, prior, segmentation, photometry)
measured = join_bands(results)
measured.meta.clear()

# %%
# Points of obscured AGN have the flux of the AGN, and those of galaxies without one are noise. Galaxies as small
# as the PSF have no point. Quasars outshine their galaxies on F150W already: the template is a point, and if a
# second one is fitted, it is what the template is off by. Use points of AGN that the prior does not show.

truth = galaxies["id", "redshift"]
truth["kind"] = np.where(obscured, "obscured", "none")
truth["kind"][quasar] = "quasar"
truth["log_luminosity"] = -np.inf
luminosity = total_light["accretion_power"][has_agn]
truth["log_luminosity"][has_agn] = np.log10(luminosity.to_value("erg/s"))
for name in miri:
    truth[f"{name}_agn"] = total_light[name] - host_light[name]
both = join(truth, measured, keys="id")

figure, axes = plt.subplots(1, 2, figsize=(9, 4.2), layout="constrained")
for ax, name in zip(axes, miri, strict=True):
    point, error = f"{name}_flux_point", f"{name}_flux_point_err"
    for kind, color in (("none", "0.6"), ("obscured", "C3"), ("quasar", "C0")):
        rows = both[both["kind"] == kind]
        values = [rows[column].value for column in (f"{name}_agn", point, error)]
        ax.errorbar(*values, fmt="o", ms=4, color=color, label=kind)
    ax.plot([0, 100], [0, 100], color="0.5", lw=0.7)
    ax.set_xscale("symlog", linthresh=0.3)
    ax.set_yscale("symlog", linthresh=0.3)
    ax.set(title=name, xlabel="light of the AGN (µJy)")
axes[0].set_ylabel("flux of the point (µJy)")
axes[0].legend(title="AGN")
plt.show()

# %%
# 3. Points as light of AGN
# -------------------------
# Fit the galaxies whose point is detected (5 sigma) twice: with the total fluxes alone, and with
# ``nuclei=True``, which takes the points as light of the AGN. The table has the true luminosity of the AGN,
# log10 in erg/s, and the medians of both fits. The total fluxes do not need two of the AGN (``-inf``).

columns = [f"{name}{end}" for name in miri for end in ("", "_err")]
ends = ("", "_err", "_corr")
points = [f"{name}_flux_point{end}" for name in miri for end in ends]
joined = join(photometry, measured[["id", *columns, *points]], keys="id")
snr = [
    joined[f"{name}_flux_point"] / joined[f"{name}_flux_point_err"] for name in miri
]
with_point = joined[np.any(np.nan_to_num(snr) > 5, axis=0)]

fitter = BayesFitter([*existing.filters, *miri])
without_points = with_point.copy()
without_points.remove_columns(points)
shown = truth["id", "redshift", "log_luminosity"]
for label, fits in (
    ("totals", fitter.fit(without_points)),
    ("and_points", fitter.replace(nuclei=True).fit(with_point)),
):
    luminosity = fits.median("accretion_power").to_value("erg/s")
    with np.errstate(divide="ignore"):
        column = QTable({"id": fits.ids, label: np.log10(luminosity)})
    shown = join(shown, column, keys="id")
shown.round(2)
shown

# %%
# 4. Count AGN
# ------------
# Objects with a high AGN fraction are no census. :class:`~miricigale.agn.AGNSurvey` fits the catalog as galaxies
# and as quasars, fits it again with AGN of known luminosity added, and measures on the sample how frequent AGN
# are. Here it takes total fluxes; ``images`` puts the AGN into images (:class:`~miricigale.agn.AGNImages`).

joined.remove_columns([*points, "sky", "components"])
joined.write("catalog.ecsv", overwrite=True)
survey = AGNSurvey(
    width**2,
    redshift=(0.5, 2.5),
    log_luminosity=(43, 44, 45, 46),
    n_injections=24,
)
result = survey.run("catalog.ecsv", "agn", classes="quasars", calibrate=False)
totals = result.totals[
    "frac_agn", "n", "n_low", "n_high", "n_shipped", "n_selected"
]
totals.round(1)
totals

# %%
# ``n`` is the number of AGN with at least this fraction, with its 68 % interval, and ``n_shipped`` what the
# prior of the fits makes of it, in which AGN are rare. ``n_selected`` objects have a median fraction of 0.4 or
# more. What went in, all with fractions of at least 0.3:

in_bin = (truth["redshift"] > 0.5) & (truth["redshift"] < 2.5) & has_agn
print(f"{in_bin.sum()} AGN, {np.sum(in_bin & obscured)} of them obscured")

# %%
# 5. Luminosity function, obscured share, completeness
# ----------------------------------------------------
# The truth is gray. Most AGN fainter than log L = 44 are not selected, and the numbers allow for that. Where the
# column ``constrained`` is false, most AGN of such a luminosity are too faint beside their galaxies.

numbers = result.numbers
edges = np.append(numbers["log_luminosity_low"], 47)
middle = 0.5 * (edges[:-1] + edges[1:])
counts = np.histogram(truth["log_luminosity"][in_bin], edges)[0]
hidden = np.histogram(truth["log_luminosity"][in_bin & obscured], edges)[0]
inner, outer = model.cosmology.comoving_volume([0.5, 2.5])
volume = ((outer - inner) * (width**2 / (4 * np.pi * u.sr))).to_value("Mpc3")
share = np.where(counts > 0, hidden / np.maximum(counts, 1), np.nan)
true = {"density": counts / volume, "obscured": share}
labels = {"density": "AGN / Mpc³ / dex", "obscured": "obscured share"}
labels["completeness"] = "share that is selected"

figure, axes = plt.subplots(1, 3, figsize=(11, 3.8), layout="constrained")
for ax, (name, label) in zip(axes, labels.items(), strict=True):
    value = np.asarray(numbers[name])
    below = value - np.asarray(numbers[f"{name}_low"])
    above = np.asarray(numbers[f"{name}_high"]) - value
    ax.errorbar(middle, value, [below, above], fmt="o")
    if name in true:
        ax.stairs(true[name], edges, color="0.6")
    ax.set(xlabel="log L (erg/s)", ylabel=label, xlim=(43, 47))
axes[0].set(yscale="log", ylim=(2e-4, 2e-2))
plt.show()

# %%
# Obscured AGN are those in fits as a galaxy, whose torus hides the disk; the share of a bin without AGN is that
# of the prior. The folder ``agn`` has these numbers as tables, and as a page with all figures (``page.html``).
#
# With your own files:
#
# .. code-block:: console
#
#    $ miricigale photometry --components 2 ...
#    $ miricigale agn catalog.fits --area 0.5625 --classes quasars \
#        --redshift-bins 0.5 2.5 --luminosity-bins 43 44 45 46 -o agn
#
# :doc:`/method/agn_numbers` states what is assumed and how well it works, :doc:`/method/fitting_nuclei` does so
# for points.
