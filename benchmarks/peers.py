"""
Other programs on the same data, each in an environment of its own: a table for the accuracy pages.

    MIRICIGALE_DATA=../shared/data python benchmarks/peers.py FOLDER [--only eazy photutils] [--n 300]
        [--eazy-data CLONE] [--lephare-data CLONE] [--mophongo CLONE]

FOLDER keeps the environments, what both sides read, and their results (JSON); a part that is there is not made
again, so that a run goes on where the last one ended. Versions are pinned in `PEERS`. What pip cannot install is a
row of the table with pip's last words.

eazy: redshifts of sources of CEERS (`ceers.sample`) without and with MIRI, our bandpasses in both. Its templates
are not in its package: CLONE is one of github.com/gbrammer/eazy-photoz.
lephare: the same, with its templates of COSMOS; CLONE is one of github.com/lephare-photoz/lephare-data.
photutils: `PSFPhotometry` at the true positions of a crowded field of points against `ForcedPhotometer`.
bagpipes: fluxes of its galaxies, and of ours with the same history, dust and redshift.
mophongo: forced photometry of a crowded field of galaxies and points whose kernel is known exactly. It is on no
registry: pip takes the commit in `MOPHONGO` from GitHub, or from a clone of it with ``--mophongo``.

Times are CPU seconds of this machine, without imports and compilation.
"""

import argparse
import dataclasses
import json
import os
import subprocess
import sys
import time
import venv
from collections.abc import Callable
from pathlib import Path

import numpy as np

FWHM = 2.5
#: Pixels of the side of the crowded field, and its number of points.
SIDE, N_POINTS = 200, 400
#: Sources of the field of galaxies, its side (arcsec), and the noise (uJy) in a pixel of 0.06 arcsec.
N_GALAXIES, GALAXY_SIDE = 650, 53
PRIOR_NOISE, IMAGE_NOISE = 0.004, 0.02
#: Commit of mophongo.
MOPHONGO = "6a128b15c8c20be206108723acd63b13024a9b11"


@dataclasses.dataclass(frozen=True)
class Peer:
    """A program: what pip installs, what makes its input and our results, what runs it, and the rows."""

    requirements: tuple[str, ...]
    ours: Callable | None = None
    theirs: Callable | None = None
    rows: Callable | None = None
    python: str = sys.executable


def save(path, **values):
    """Write numbers and lists of numbers."""
    path.write_text(json.dumps({name: np.asarray(v).tolist() for name, v in values.items()}))


def load(path):
    return {name: np.asarray(v) for name, v in json.loads(path.read_text()).items()}


# ----------------------------------------------------------------------------- eazy


def write_bandpasses(path, bands):
    """Write our bandpasses as EAZY's file; EAZY interpolates each template at all points, so that 300 are kept."""
    import astropy.units as u

    from miricigale.filters import FilterSet

    with path.open("w") as file:
        for one in FilterSet.from_names(bands):
            wave = one.wave.to_value(u.AA)
            some = np.linspace(wave[0], wave[-1], 300)
            curve = np.maximum(np.interp(some, wave, one.throughput), 0.0)
            file.write(f"{some.size} {one.name} lambda_c= {one.pivot.to_value(u.AA):.4e}\n")
            for k, (x, y) in enumerate(zip(some, curve, strict=True), start=1):
                file.write(f"{k} {x:.3f} {y:.6e}\n")


def write_catalog(folder, args):
    """Write the sources of CEERS that redshifts are compared for: our table of them, and its bands."""
    import astropy.units as u
    from ceers import sample

    path = Path(os.environ["MIRICIGALE_DATA"]) / "ceers/ceers_photometry_part.fits"
    table, bands, n_miri = sample(path)
    rng = np.random.default_rng(5)
    rows = np.sort(rng.choice(len(table), min(args.n, len(table)), replace=False))
    table = table[rows]
    flux = np.transpose([table[name].to_value(u.uJy) for name in bands])
    error = np.transpose([table[f"{name}_err"].to_value(u.uJy) for name in bands])
    save(
        folder / "catalog.json", flux=flux, error=error, redshift=table["redshift"], bands=bands,
        n_miri=n_miri[rows],
    )  # fmt: skip
    return table, bands


def fit_ours(folder, table, bands):
    """Fit a catalog as ``miricigale fit`` does by default, without and with MIRI."""
    from miricigale import BayesFitter
    from miricigale.fitting import calibrate_bands
    from miricigale.sed import SEDModel

    grid = SEDModel.survey().grid(SEDModel.survey_axes(), bands)
    results = {}
    optical = [name for name in bands if not name.startswith("miri")]
    for label, used in (("optical", optical), ("all", bands)):
        fitter = BayesFitter(grid, used)
        fitter.fit(table[:4])
        begin = time.process_time()
        fitter = fitter.replace(calibration=calibrate_bands(fitter, table))
        results[f"calibration_{label}"] = time.process_time() - begin
        begin = time.process_time()
        fit = fitter.fit(table)
        results[f"seconds_{label}"] = time.process_time() - begin
        quantiles = fit.percentile("redshift", (0.16, 0.5, 0.84)).value
        results[f"z_{label}"] = quantiles
    save(folder / "ours.json", **results)


def eazy_ours(folder, args):
    """Write what EAZY reads, and fit."""
    table, bands = write_catalog(folder, args)
    write_bandpasses(folder / "FILTER.RES", bands)
    fit_ours(folder, table, bands)


def eazy_theirs(folder, args):
    """Fit with EAZY's default templates, template errors and prior of F160W."""
    from astropy.table import Table
    from eazy import photoz

    # of one template through all bandpasses, on a busy machine
    photoz.MULTIPROCESSING_TIMEOUT = 1e5
    catalog = load(folder / "catalog.json")
    bands = catalog["bands"].tolist()
    folder = folder.resolve()
    os.chdir(args.eazy_data)
    table = Table({"id": np.arange(len(catalog["flux"]))})
    table["z_spec"] = catalog["redshift"]
    lines = []
    for k in range(len(bands)):
        bad = ~np.isfinite(catalog["flux"][:, k]) | ~np.isfinite(catalog["error"][:, k])
        table[f"f_{k}"] = np.where(bad, -99.0, catalog["flux"][:, k])
        table[f"e_{k}"] = np.where(bad, -99.0, catalog["error"][:, k])
        lines += [f"f_{k} F{k + 1}", f"e_{k} E{k + 1}"]
    table.write(folder / "catalog.fits", overwrite=True)
    (folder / "catalog.translate").write_text("\n".join(lines) + "\n")
    params = {
        "CATALOG_FILE": str(folder / "catalog.fits"),
        "FILTERS_RES": str(folder / "FILTER.RES"),
        "MAIN_OUTPUT_FILE": str(folder / "eazy"),
        "PRIOR_FILTER": bands.index("wfc3.f160w") + 1,
        "PRIOR_ABZP": 23.9,
        # redshifts of the sample end at 5.5
        "Z_MAX": 6.0,
        # twice the default, far below the scatter: bandpasses are integrated in half the time
        "Z_STEP": 0.02,
    }
    fit = photoz.PhotoZ(
        param_file=None, translate_file=str(folder / "catalog.translate"), params=params,
        load_prior=True, load_products=False, n_proc=0,
    )  # fmt: skip
    results = {}
    for label in ("all", "optical"):
        if label == "optical":
            miri = np.array([name.startswith("miri") for name in bands])
            fit.fnu[:, miri] = fit.efnu[:, miri] = -99.0
            fit.set_ok_data()
            fit.set_template_error()
        begin = time.process_time()
        fit.fit_catalog(n_proc=0, prior=True)
        results[f"seconds_{label}"] = time.process_time() - begin
        results[f"z_{label}"] = fit.pz_percentiles(percentiles=[16, 50, 84])
        results[f"best_{label}"] = fit.zbest
    save(folder / "theirs.json", **results)


def redshift_numbers(z, quantiles, true, rows):
    """Scatter, outliers and coverage of redshifts as text."""
    offset = ((z - true) / (1 + true))[rows]
    fitted = np.isfinite(offset)
    scatter = 1.4826 * np.median(np.abs(offset[fitted] - np.median(offset[fitted])))
    # a source without a redshift is one that is wrong
    outliers = np.mean(~(np.abs(offset) < 0.15))
    low, _, high = quantiles[rows].T
    inside = np.mean((true[rows] >= low) & (true[rows] <= high))
    return f"{scatter:.3f}, {100 * outliers:.1f} %, {100 * inside:.0f} %"


def redshift_rows(folder):
    catalog, ours, theirs = (load(folder / f"{n}.json") for n in ("catalog", "ours", "theirs"))
    true, two = catalog["redshift"], catalog["n_miri"] >= 2
    rows = []
    for label, words in (("optical", "HST, NIRCam"), ("all", "with MIRI")):
        for what, some in (("all", np.ones(true.size, bool)), ("two in MIRI", two)):
            name = f"{words}, {what} ({some.sum()}): sigma_MAD, outliers, in 68 %"
            best = redshift_numbers(theirs[f"best_{label}"], theirs[f"z_{label}"], true, some)
            own = ours[f"z_{label}"]
            rows.append((name, best, redshift_numbers(own[:, 1], own, true, some)))
        times = [1e3 * one[f"seconds_{label}"] / true.size for one in (theirs, ours)]
        rows.append((f"{words}: ms an object", *(f"{value:.0f}" for value in times)))
    return rows


# -------------------------------------------------------------------------- lephare

#: Errors of models in magnitudes: those of LePhare's settings for COSMOS in its optical bands, its near infrared
#: ones, and IRAC's reddest.
LEPHARE_ERRORS = {"acs": 0.02, "wfc3": 0.05, "nircam": 0.05, "miri": 0.3}


def lephare_ours(folder, args):
    """Write what LePhare reads, and fit, unless the run of EAZY has fitted the same."""
    import astropy.units as u

    from miricigale.filters import FilterSet

    table, bands = write_catalog(folder, args)
    for band in FilterSet.from_names(bands):
        columns = np.column_stack([band.wave.to_value(u.AA), np.maximum(band.throughput, 0.0)])
        np.savetxt(folder / f"{band.name}.pb", columns)
    same = args.folder / "eazy" / "ours.json"
    if same.exists():
        (folder / "ours.json").write_bytes(same.read_bytes())
    else:
        fit_ours(folder, table, bands)


def lephare_theirs(folder, args):
    """Fit with LePhare's settings for COSMOS: 31 galaxies, four attenuation laws, its errors."""
    os.environ["LEPHAREDIR"] = str(args.lephare_data.resolve())
    os.environ["LEPHAREWORK"] = str(folder.resolve() / "work")
    for name in ("filt", "lib_bin", "lib_mag", "zphota"):
        (folder / "work" / name).mkdir(parents=True, exist_ok=True)
    import lephare
    from astropy.table import Table

    catalog = load(folder / "catalog.json")
    bands = catalog["bands"].tolist()
    errors = [LEPHARE_ERRORS[name.split(".")[0]] for name in bands]
    config = lephare.default_cosmos_config.copy()
    settings = {
        "FILTER_LIST": ",".join(f"{name}.pb" for name in bands),
        "FILTER_REP": str(folder.resolve()),
        "FILTER_CALIB": ",".join("0" for _ in bands),
        "ERR_SCALE": ",".join(str(value) for value in errors),
        "ZPHOTLIB": "CE_COSMOS",
        "GAL_SED": "sed/GAL/COSMOS_SED/COSMOS_MOD.list",
        # which templates have which of the four laws: the package's default of 0,0 attenuates none
        "MOD_EXTINC": "18,26,26,33,26,33,26,33",
        # redshifts of the sample end at 5.5
        "Z_STEP": "0.04,0.,6.",
        # bands of absolute magnitudes and colors, which are not used here
        "MABS_FILT": "1",
        "MABS_ZBIN": "0,6",
        "MABS_REF": "1",
        "MABS_CONTEXT": "-1",
        "RF_COLORS": "1,2,1,2",
        "MAG_REF": "1",
    }
    for name, value in settings.items():
        config[name] = lephare.keyword(name, value)
    begin = time.process_time()
    if not (folder / "work/lib_mag/CE_COSMOS.doc").exists():
        lephare.prepare(config, star_config=None, qso_config=None)
    results = {"preparation": time.process_time() - begin}
    jansky = 1e-29
    for label in ("all", "optical"):
        flux = catalog["flux"] * jansky
        error = catalog["error"] * jansky
        missing = ~np.isfinite(flux) | ~np.isfinite(error)
        if label == "optical":
            missing[:, [name.startswith("miri") for name in bands]] = True
        flux[missing] = error[missing] = -99.0
        table = Table({"id": np.arange(len(flux))})
        for k, name in enumerate(bands):
            table[name] = flux[:, k]
            table[f"{name}_err"] = error[:, k]
        # every band of every source may be used
        table["context"] = 0
        table["zspec"] = catalog["redshift"]
        table["string"] = "-"
        begin = time.process_time()
        output, _ = lephare.process(config, table)
        results[f"seconds_{label}"] = time.process_time() - begin
        quantiles = [output[name] for name in ("Z_MED68_LOW", "Z_MED", "Z_MED68_HIGH")]
        best = np.array(output["Z_BEST"], float)
        best[best < 0] = np.nan
        results[f"z_{label}"] = np.transpose(quantiles)
        results[f"best_{label}"] = best
    save(folder / "theirs.json", **results)


# ------------------------------------------------------------------------ photutils


def photutils_ours(folder, args):
    """Make a crowded field of points with noise, and measure it at the true positions."""
    import astropy.units as u
    from astropy.coordinates import SkyCoord
    from astropy.nddata import CCDData, StdDevUncertainty
    from astropy.wcs import WCS
    from photutils.psf import CircularGaussianPRF

    from miricigale.photometry import ForcedPhotometer
    from miricigale.psf import make_psf

    rng = np.random.default_rng(1)
    x, y = rng.uniform(10, SIDE - 10, (2, N_POINTS))
    flux = 10 ** rng.uniform(0.5, 2.5, N_POINTS)
    grid_y, grid_x = np.mgrid[:SIDE, :SIDE]
    sigma = 0.5
    data = rng.normal(0, sigma, (SIDE, SIDE))
    for total, x_0, y_0 in zip(flux, x, y, strict=True):
        data += CircularGaussianPRF(flux=total, x_0=x_0, y_0=y_0, fwhm=FWHM)(grid_x, grid_y)
    save(folder / "catalog.json", data=data, x=x, y=y, flux=flux, sigma=sigma)
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crpix = [SIDE / 2, SIDE / 2]
    wcs.wcs.crval = [150.0, 2.0]
    wcs.wcs.cdelt = [-0.11 / 3600, 0.11 / 3600]
    error = StdDevUncertainty(np.full(data.shape, sigma))
    image = CCDData(data, unit=u.uJy, wcs=wcs, uncertainty=error)
    # the same function, with the response of the pixels, on cells of a quarter of a pixel
    cells = np.arange(-60, 61) / 4
    profile = CircularGaussianPRF(fwhm=FWHM)(*np.meshgrid(cells, cells))
    psf = make_psf(profile, pixel_scale=0.11 * u.arcsec, oversampling=4, frame="sky")
    sky = SkyCoord(wcs.pixel_to_world(x, y))
    photometer = ForcedPhotometer(psf=psf, background_order=None, second_pass=False)
    photometer.measure(image, sky)
    begin = time.process_time()
    result = photometer.measure(image, sky)
    seconds = time.process_time() - begin
    table = result.to_table()
    save(
        folder / "ours.json", flux=table["flux"].value, error=table["flux_err"].value,
        seconds=seconds,
    )  # fmt: skip


def photutils_theirs(folder, args):
    """Fit all points at once where they overlap, with positions held."""
    from astropy.table import QTable
    from photutils.psf import CircularGaussianPRF, PSFPhotometry, SourceGrouper

    catalog = load(folder / "catalog.json")
    model = CircularGaussianPRF(fwhm=FWHM)
    model.x_0.fixed = True
    model.y_0.fixed = True
    start = QTable({"x": catalog["x"], "y": catalog["y"], "flux": np.full(N_POINTS, 10.0)})
    error = np.full(catalog["data"].shape, float(catalog["sigma"]))
    results = {}
    for label, grouper in (("single", None), ("groups", SourceGrouper(3 * FWHM))):
        photometry = PSFPhotometry(model, (9, 9), grouper=grouper, aperture_radius=4)
        begin = time.process_time()
        table = photometry(catalog["data"], error=error, init_params=start)
        results[f"seconds_{label}"] = time.process_time() - begin
        table.sort("id")
        results[f"flux_{label}"] = table["flux_fit"]
        results[f"error_{label}"] = table["flux_err"]
    save(folder / "theirs.json", **results)


def photutils_rows(folder):
    catalog, ours, theirs = (load(folder / f"{n}.json") for n in ("catalog", "ours", "theirs"))
    true = catalog["flux"]

    def pulls(flux, error):
        pull = (flux - true) / error
        good = np.isfinite(pull)
        wide = 1.4826 * np.median(np.abs(pull[good] - np.median(pull[good])))
        return f"{np.median(pull[good]):+.2f}, {wide:.2f}, {np.mean(np.abs(pull[good]) > 5):.3f}"

    own = pulls(ours["flux"], ours["error"])
    rows = []
    for label, words in (("groups", "in groups"), ("single", "one by one")):
        got = pulls(theirs[f"flux_{label}"], theirs[f"error_{label}"])
        rows.append((f"pulls {words}: median, scatter, beyond 5", got, own))
        seconds = f"{theirs[f'seconds_{label}']:.2f}"
        rows.append((f"s of {N_POINTS} points, {words}", seconds, f"{ours['seconds']:.2f}"))
    return rows


# ------------------------------------------------------------------------- bagpipes

GALAXIES = [
    {"redshift": z, "tau": tau, "age": age, "ebv": ebv}
    for z in (0.5, 2.0)
    for tau, age, ebv in ((1.0, 3.0, 0.0), (1.0, 3.0, 0.3), (0.3, 1.0, 0.1), (3.0, 2.5, 0.2))
]
#: Bands from the rest ultraviolet to the near infrared, where both have BC03 stars.
BANDS = ("acs.f606w", "acs.f814w", "wfc3.f125w", "wfc3.f160w", "nircam.f277w", "nircam.f444w")


def bagpipes_ours(folder, args):
    """Fluxes of delayed histories under Calzetti's attenuation that formed 1e10 Msun."""
    import astropy.units as u
    from astropy.cosmology import FlatLambdaCDM
    from astropy.table import QTable

    from miricigale.filters import FilterSet
    from miricigale.sed import SEDModel

    for one in FilterSet.from_names(BANDS):
        columns = np.column_stack([one.wave.to_value(u.AA), np.maximum(one.throughput, 0)])
        np.savetxt(folder / f"{one.name}.dat", columns)
    # bagpipes has this cosmology
    model = SEDModel.yang2021(agn=False, cosmology=FlatLambdaCDM(70, 0.3))
    table = QTable({name: [one[name] for one in GALAXIES] for name in GALAXIES[0]})
    table["mass"] = 1e10 * u.Msun
    begin = time.process_time()
    fluxes = model.fluxes(table, BANDS)
    seconds = time.process_time() - begin
    flux = np.transpose([fluxes[name].to_value(u.uJy) for name in BANDS])
    save(folder / "ours.json", flux=flux, seconds=seconds)


def bagpipes_theirs(folder, args):
    """The same by bagpipes: stars of solar metallicity, no nebulae, no dust emission in these bands."""
    import bagpipes

    filters = [str(folder.resolve() / f"{name}.dat") for name in BANDS]
    flux, seconds = [], []
    for one in GALAXIES:
        history = {"age": one["age"], "tau": one["tau"], "massformed": 10.0, "metallicity": 1.0}
        parts = {"redshift": one["redshift"], "delayed": history}
        parts["dust"] = {"type": "Calzetti", "Av": 4.05 * one["ebv"], "eta": 1.0}
        begin = time.process_time()
        galaxy = bagpipes.model_galaxy(parts, filt_list=filters, phot_units="mujy")
        seconds.append(time.process_time() - begin)
        flux.append(galaxy.photometry)
    save(folder / "theirs.json", flux=flux, seconds=seconds)


def bagpipes_rows(folder):
    ours, theirs = (load(folder / f"{name}.json") for name in ("ours", "theirs"))
    ratio = ours["flux"] / theirs["flux"]
    rows = []
    for k, name in enumerate(BANDS):
        text = f"{np.median(ratio[:, k]):.3f} ({ratio[:, k].min():.3f} to {ratio[:, k].max():.3f})"
        rows.append((f"{name}: ours over theirs, median (range)", "1", text))
    return rows


# ------------------------------------------------------------------------- mophongo


def mophongo_ours(folder, args):
    """Make a crowded field whose image is the prior's light through a known kernel, and measure it."""
    import astropy.units as u
    from scipy.signal import fftconvolve

    from miricigale.photometry import ErrorSettings, ForcedPhotometer, detect_sources
    from miricigale.psf import MatchingKernel
    from miricigale.utils.tables import match_sky
    from photometry import FINE, cutout_kernel, galaxy_field, mosaic

    automatic = cutout_kernel()
    # what the kernel makes of the sharp PSF is the wide one: there is no error of the kernel
    wide = fftconvolve(automatic.source, automatic.array, mode="same")
    kernel = MatchingKernel(automatic.array, pixel_scale=FINE, source=automatic.source, target=wide)
    rng = np.random.default_rng(1)
    prior, light, sky, flux = galaxy_field(N_GALAXIES, GALAXY_SIDE, kernel, rng)
    light = light + rng.normal(0, IMAGE_NOISE, light.shape)
    image = mosaic(light, prior.wcs, IMAGE_NOISE)
    segmentation, detected = detect_sources(prior, threshold=1.0, n_pixels=8)
    index, _ = match_sky(detected["sky"], sky, radius=0.3 * u.arcsec)
    truth = np.full(len(detected), np.nan)
    truth[index[index >= 0]] = flux[index >= 0]
    # bright and faint sources in one segment have no true flux of their own
    x, y = prior.wcs.world_to_pixel(sky)
    labels = segmentation.data[np.rint(y).astype(int), np.rint(x).astype(int)]
    sources_of_label = np.bincount(labels, minlength=segmentation.max_label + 1)
    truth[sources_of_label[detected["label"]] != 1] = np.nan
    x, y = prior.wcs.world_to_pixel(detected["sky"])
    np.savez(
        folder / "field.npz", prior=prior.data / prior.uncertainty.array * PRIOR_NOISE,
        image=light, segmentation=segmentation.data, label=detected["label"], x=x, y=y,
        kernel=kernel.array, source=kernel.source, target=kernel.target,
    )  # fmt: skip
    segments_alone = {
        "template": "cutout", "wings": False, "errors": ErrorSettings(size_scatter=None),
    }  # fmt: skip
    results = {"truth": truth}
    for label, options in (("default", {}), ("segments", segments_alone)):
        photometer = ForcedPhotometer(kernel, **options)
        photometer.measure(image, prior, segmentation, detected)
        begin = time.process_time()
        result = photometer.measure(image, prior, segmentation, detected)
        results[f"seconds_{label}"] = time.process_time() - begin
        results[f"flux_{label}"] = result.flux.value
        results[f"error_{label}"] = result.flux_err.value
    save(folder / "ours.json", **results)


def mophongo_theirs(folder, args):
    """Measure the same images, segments and kernel: by default, and fluxes alone, of either sign."""
    from astropy.table import Table
    from mophongo.fit import FitConfig
    from mophongo.pipeline import Pipeline

    field = np.load(folder / "field.npz")
    catalog = Table({"id": field["label"], "x": field["x"], "y": field["y"]})
    images = [field["prior"].astype(np.float32), field["image"].astype(np.float32)]
    weights = []
    for image, noise in zip(images, (PRIOR_NOISE, IMAGE_NOISE), strict=True):
        weights.append(np.full(image.shape, noise**-2.0, np.float32))
    # as its guide says, PSFs and kernels have a unit sum
    psfs = [field[name] / field[name].sum() for name in ("source", "target")]
    kernel = field["kernel"] / field["kernel"].sum()
    settings = {
        "default": FitConfig(),
        # the same least squares as ours: fluxes alone, of either sign
        "segments": FitConfig(fit_method="lls", fit_astrometry_niter=0),
    }
    results = {}
    for label, config in settings.items():
        # compilation, and what is read on first use, count with neither program
        for _ in range(2):
            pipeline = Pipeline(
                [image.copy() for image in images], field["segmentation"].copy(),
                catalog=catalog, psfs=psfs, weights=[weight.copy() for weight in weights],
                kernels=[None, kernel], config=config,
            )  # fmt: skip
            begin = time.process_time()
            table, _ = pipeline.run()
            seconds = time.process_time() - begin
        results[f"seconds_{label}"] = seconds
        results[f"flux_{label}"] = table["flux_1"]
        results[f"error_{label}"] = table["err_1"]
    save(folder / "theirs.json", **results)


def mophongo_rows(folder):
    """Rows by true flux over our error by default; both by default first, then segments with least squares."""
    ours, theirs = (load(folder / f"{name}.json") for name in ("ours", "theirs"))
    true = ours["truth"]
    snr = true / ours["error_default"]

    def numbers(results, label, rows):
        flux = results[f"flux_{label}"][rows]
        pull = (flux - true[rows]) / results[f"error_{label}"][rows]
        # sources whose light is all masked have no flux
        good = np.isfinite(pull)
        wide = 1.4826 * np.median(np.abs(pull[good]))
        bias = np.median((flux / true[rows])[good]) - 1
        beyond = np.mean(np.abs(pull[good]) > 5)
        return f"{wide:.2f}, {100 * bias:+.1f} %, {100 * beyond:.0f} %"

    rows = []
    for label in ("default", "segments"):
        for low, high in ((0, 10), (10, 30), (30, np.inf)):
            some = (snr >= low) & (snr < high)
            texts = [numbers(results, label, some) for results in (theirs, ours)]
            name = f"{label}, S/N {low}-{high} ({some.sum()}): MAD of pulls, bias, beyond 5"
            rows.append((name, *texts))
        times = [f"{results[f'seconds_{label}']:.2f}" for results in (theirs, ours)]
        rows.append((f"{label}: CPU s of {true.size} sources", *times))
    return rows


PEERS = {
    "eazy": Peer(("eazy==0.8.7",), eazy_ours, eazy_theirs, redshift_rows),
    "photutils": Peer(
        ("photutils==3.1.1", "scipy"), photutils_ours, photutils_theirs, photutils_rows,
        python="python3.12",
    ),
    "bagpipes": Peer(("bagpipes==1.3.6",), bagpipes_ours, bagpipes_theirs, bagpipes_rows),
    "lephare": Peer(("lephare==1.0.0",), lephare_ours, lephare_theirs, redshift_rows),
    # installed only: the environments of tox compare them
    "jwst": Peer(("jwst==3.0.0",)),
    "stpsf": Peer(("stpsf==2.2.0",)),
    "pcigale": Peer(("pcigale",)),
    "mophongo": Peer(
        (f"mophongo @ git+https://github.com/ivolabbe/mophongo@{MOPHONGO}",),
        mophongo_ours, mophongo_theirs, mophongo_rows,
    ),
}  # fmt: skip


def environment(folder, peer):
    """Python of an environment with the peer; pip's last words if there is none."""
    python = folder / "env/bin/python"
    marker = folder / "installed"
    if marker.exists():
        return python, ""
    if peer.python == sys.executable:
        venv.create(folder / "env", with_pip=True, clear=True)
    else:
        command = [peer.python, "-m", "venv", "--clear", str(folder / "env")]
        try:
            subprocess.run(command, check=True, capture_output=True)
        except (OSError, subprocess.CalledProcessError) as err:
            return python, f"needs {peer.python}: {err}"
    command = [str(python), "-m", "pip", "install", "-q", *peer.requirements]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        errors = [line for line in done.stderr.splitlines() if line.startswith("ERROR")]
        return python, errors[-1] if errors else done.stderr.strip()[-200:]
    marker.touch()
    return python, ""


def judged(name, peer, args):
    """Rows of the table of a peer."""
    folder = args.folder / name
    folder.mkdir(parents=True, exist_ok=True)
    if name == "mophongo" and args.mophongo is not None:
        source = f"mophongo @ git+{args.mophongo.resolve().as_uri()}@{MOPHONGO}"
        peer = dataclasses.replace(peer, requirements=(source,))
    python, failure = environment(folder, peer)
    if failure:
        return [(f"not installed: {failure}", "", "")]
    if peer.theirs is None:
        return [("installed; not compared here", "", "")]
    data = {"eazy": args.eazy_data, "lephare": args.lephare_data}
    if name in data and data[name] is None:
        return [(f"its templates are not on PyPI: --{name}-data", "", "")]
    if not (folder / "ours.json").exists():
        peer.ours(folder, args)
    if not (folder / "theirs.json").exists():
        # without this folder, whose `mophongo.py` is another module
        command = [str(python), "-P", __file__, str(args.folder), "--inside", name]
        if data.get(name):
            command += [f"--{name}-data", str(data[name].resolve())]
        subprocess.run(command, check=True, env=os.environ | {"PYTHONPATH": ""})
    return peer.rows(folder)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", nargs="+", choices=PEERS, default=list(PEERS))
    parser.add_argument("--n", type=int, default=300, help="sources of CEERS")
    parser.add_argument("--eazy-data", type=Path, help="clone of gbrammer/eazy-photoz")
    parser.add_argument("--lephare-data", type=Path, help="clone of lephare-photoz/lephare-data")
    parser.add_argument("--mophongo", type=Path, help="clone of ivolabbe/mophongo, not GitHub's")
    parser.add_argument("--inside", choices=PEERS, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.inside:
        PEERS[args.inside].theirs(args.folder / args.inside, args)
        return
    for name in args.only:
        peer = PEERS[name]
        print(f"\n{peer.requirements[0]}")
        for what, theirs, ours in judged(name, peer, args):
            print(f"  {what:64s} {theirs:>22s} {ours:>22s}")


if __name__ == "__main__":
    main()
