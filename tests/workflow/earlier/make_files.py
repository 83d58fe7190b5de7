"""Small files of each kind by an earlier version, in an empty folder: see README.rst beside this file."""

import subprocess
import sys
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.nddata import CCDData, StdDevUncertainty
from astropy.table import QTable

BANDS = ("wfc3.f160w", "miri.f770w", "miri.f1500w")


def make_run():
    command = [sys.executable, "-m", "miricigale", "run", "goodss", "--quick", "-o", "run", "-q"]
    options = ["--until", "catalog", "--set", "catalog.mag_limit=19.0", "--no-progress"]
    subprocess.run([*command, *options], check=True)


def make_plan():
    from miricigale.planning import PlanConfig

    Path("plan-2026-11-26.toml").write_text(PlanConfig().to_toml(), encoding="utf-8")


def make_photometry():
    from miricigale import ForcedPhotometer
    from miricigale.instrument import north_up_wcs
    from miricigale.photometry import ErrorCalibration, SourceTemplates
    from miricigale.psf import MatchingKernel, gaussian_psf

    form = {"pixel_scale": 0.1 * u.arcsec, "fov": 1.9 * u.arcsec, "oversampling": 1}
    sharp = gaussian_psf(0.25 * u.arcsec, **form)
    wide = gaussian_psf(0.45 * u.arcsec, **form)
    MatchingKernel.from_psfs(sharp, wide, pixel_scale=0.1 * u.arcsec).write("kernel.fits")

    wcs = north_up_wcs("53 -27", 0.1 * u.arcsec, (40, 40))
    x = np.array([12.0, 27.0])
    y = np.array([14.0, 25.0])
    rows, columns = np.mgrid[:40, :40]
    image = np.zeros((40, 40))
    for light, at_x, at_y in zip((3.0, 5.0), x, y, strict=True):
        apart = (columns - at_x) ** 2 + (rows - at_y) ** 2
        image += light * np.exp(-apart / 2 / (4.5 / 2.3548) ** 2)
    rng = np.random.default_rng(1)
    noise = np.full(image.shape, 0.02)
    image += rng.normal(0, 0.02, image.shape)
    mosaic = CCDData(image, unit="MJy/sr", wcs=wcs, uncertainty=StdDevUncertainty(noise))
    catalog = QTable({"id": [7, 11], "sky": wcs.pixel_to_world(x, y)})
    templates = SourceTemplates.from_catalog(catalog)
    result = ForcedPhotometer(psf=wide).measure(mosaic, templates=templates)
    result.to_table().write("photometry.ecsv")
    result.write("photometry.fits")

    sources = QTable({"flux_true": rng.uniform(1, 20, 60) * u.uJy})
    sources["flux_err"] = sources["flux_err_noise"] = np.full(60, 0.3) * u.uJy
    sources["flux"] = sources["flux_true"] + 0.45 * rng.normal(size=60) * u.uJy
    ErrorCalibration.from_sources(sources).write("calibration.ecsv")


def make_fit():
    from miricigale import BayesFitter, SEDModel
    from miricigale.fitting import fit_file
    from miricigale.sed import yang2021_axes

    model = SEDModel.yang2021()
    parameters = QTable({"id": [7, 11], "redshift": [0.8, 1.4], "mass": [2e10, 5e10]})
    catalog = model.fluxes(parameters, list(BANDS))
    catalog["redshift"] = [0.8, 1.4]
    errors = []
    for band in BANDS:
        errors.append(f"{band}_err")
        catalog[errors[-1]] = 0.05 * catalog[band]
    catalog["id", "redshift", *BANDS, *errors].write("catalog.ecsv")
    axes = {name: np.atleast_1d(values)[:2] for name, values in yang2021_axes("quick").items()}
    axes["redshift"] = np.array([0.8, 1.4])
    fit_file(BayesFitter(model, list(BANDS), axes=axes), "catalog.ecsv", "fit", redshift="redshift")


if __name__ == "__main__":
    make_run()
    make_plan()
    make_photometry()
    make_fit()
