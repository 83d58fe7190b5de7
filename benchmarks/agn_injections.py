"""
What injecting fewer AGN, and fitting them with fewer models, changes in `miricigale.agn.AGNSurvey`.

    python benchmarks/agn_injections.py FOLDER [--n 200] [--each 20]

A survey of galaxies at z = 0.93 to 1.07, three of ten with an AGN, is drawn from `SEDModel.yang2021` with errors
of 26th magnitude and 5 %, and nuclei in MIRI's bands. It is run without injected AGN, with ``--each`` of them for
every galaxy, with as many as the completeness of each bin needs, and with the default. Each line: the run,
CPU-seconds and injected AGN; a row for each bin of luminosity with the completeness, purity, number of AGN and
density, with ends of their 68 % intervals. The first run of an installation compiles kernels.
"""

import argparse
import time
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale import ErrorModel, SEDModel
from miricigale.agn import AGNSurvey
from miricigale.utils.tables import error_column

BANDS = [
    *("acs.f814w", "wfc3.f160w", "irac.ch1"),
    *("miri.f770w", "miri.f1000w", "miri.f1500w", "miri.f2100w"),
]
AXES = {
    "redshift": [0.9, 1.0, 1.1],
    "age": [1.0, 3.0],
    "ebv": [0.1, 0.3],
    "frac_agn": [0.0, 0.2, 0.4, 0.6, 0.9],
    "tau97": [3.0, 7.0],
}
DEPTH = 26.0
BINS = {"redshift": (0.5, 1.5), "log_luminosity": (43.0, 43.75, 44.5, 45.25)}
#: Errors of nuclei over those of total fluxes, and the correlation of the two.
NUCLEUS_ERROR = 0.7
NUCLEUS_CORRELATION = 0.5


def write_catalog(model, n, path):
    """Write photometry of n galaxies."""
    rng = np.random.default_rng(5)
    truth = QTable({"id": np.arange(n) + 1, "redshift": rng.uniform(0.93, 1.07, n)})
    truth["age"] = rng.uniform(1.1, 2.9, n)
    truth["ebv"] = rng.uniform(0.12, 0.28, n)
    truth["mass"] = 10 ** rng.uniform(9.8, 11.0, n)
    truth["tau97"] = rng.uniform(3.2, 6.8, n)
    truth["frac_agn"] = np.where(rng.random(n) < 0.3, rng.uniform(0.1, 0.85, n), 0.0)
    light = model.fluxes(truth, BANDS)
    truth["frac_agn"] = np.zeros(n)
    of_hosts = model.fluxes(truth, BANDS)
    errors = ErrorModel.from_depths(dict.fromkeys(BANDS, DEPTH), fractional=0.05)
    table = errors.perturb(light[["id", *BANDS]], seed=1)
    table.meta = {}
    for band in BANDS:
        if not band.startswith("miri."):
            continue
        name = f"{band}_flux_point"
        error = NUCLEUS_ERROR * table[error_column(band)]
        table[name] = light[band] - of_hosts[band] + error * rng.standard_normal(n)
        table[error_column(name)] = error
        table[f"{name}_corr"] = np.full(n, NUCLEUS_CORRELATION)
    table.write(path, overwrite=True)


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--n", type=int, default=200, help="galaxies")
    parser.add_argument("--each", type=int, default=20, help="injected AGN for each")
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    model = SEDModel.yang2021(libraries="bundled")
    catalog = args.folder / "catalog.fits"
    write_catalog(model, args.n, catalog)
    most = args.n * args.each
    runs = {
        "none": {"n_injections": 0},
        "all": {"n_injections": most, "completeness_error": 0, "injected_models": 600},
        "as many as are needed": {"n_injections": most},
        "default": {},
    }
    for name, settings in runs.items():
        survey = AGNSurvey(20 * u.arcmin**2, seed=3, **BINS, **settings)
        begin = time.process_time()
        result = survey.run(
            catalog,
            args.folder / name.replace(" ", "-"),
            models=lambda _: (model, AXES),
            calibration=None,
            calibrate=False,
            model_error=0.02,
            nuclei=True,
        )
        seconds = time.process_time() - begin
        print(f"{name}: {seconds:.1f} CPU-seconds, {len(result.injected)} injected AGN")
        columns = ["log_luminosity_low", "n_injected", "purity"]
        for column in ("completeness", "n", "n_corrected", "density"):
            columns += [column, f"{column}_low", f"{column}_high"]
        result.numbers[columns].pprint_all()


if __name__ == "__main__":
    main()
