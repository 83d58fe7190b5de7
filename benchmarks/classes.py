"""
Galaxy, quasar or star by their evidence: simulated sources, real quasars of SDSS and real sources of CEERS.

    MIRICIGALE_DATA=../shared/data python benchmarks/classes.py [--n 40] [--seed 1]

Simulated sources lie between the nodes of the grids, S/N 20 in ten bands; their stars are Planck's law, as there
is no library of stars in the package. The real ones are fitted as ``miricigale fit --quasars`` does.
"""

import argparse
import os
import tempfile
import time
import warnings
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.modeling.models import BlackBody
from astropy.table import QTable

from miricigale.cigale import read_cigale_catalog
from miricigale.filters import read_catalog_photometry
from miricigale.fitting import BayesFitter, compare_classes
from miricigale.fitting.catalogs.classes import fit_classes, write_table
from miricigale.sed import SED, SEDModel, quasar_axes, template_grid

BANDS = ["acs.f606w", "acs.f814w", "wfc3.f125w", "wfc3.f160w", "irac.ch1", "irac.ch2"]
BANDS += ["miri.f770w", "miri.f1000w", "miri.f1500w", "miri.f2100w"]
#: Axes of the galaxies that simulated sources are compared with.
GALAXIES = {
    "tau": [0.1, 3.0],
    "age": [0.05, 0.3, 1.5, 6.0],
    "f_burst": [0.0, 0.3],
    "metallicity": [0.004, 0.02],
    "ebv": [0.0, 0.15, 0.35, 0.75],
    "q_pah": [2.5],
    "tau97": [5.0],
    "ebv_polar": [0.2],
    "frac_agn": [0.0, 0.3, 0.6, 0.9],
    "redshift": quasar_axes()["redshift"],
}


def planck(temperature):
    wave = np.geomspace(0.2, 60, 3000) * u.um
    return SED(wave, 1e10 * BlackBody(temperature * u.K)(wave) * u.sr)


def simulated(model, n, seed):
    """Fluxes of n galaxies, quasars and stars, 10 uJy in F160W, with noise of 5 %."""
    rng = np.random.default_rng(seed)
    z = np.expm1(rng.uniform(np.log1p(0.2), np.log1p(4), (2, n)))
    both = {
        "mass": np.full(n, 1e10), "q_pah": rng.uniform(0.5, 4.5, n), "tau97": rng.uniform(3, 11, n),
        "ebv_polar": rng.uniform(0, 0.3, n), "temperature_polar": rng.uniform(100, 300, n),
    }  # fmt: skip
    galaxy = both | {
        "redshift": z[0], "tau": 10 ** rng.uniform(-1, 0.3, n), "ebv": rng.uniform(0, 0.7, n),
        "age": np.minimum(10 ** rng.uniform(-1, 0.6, n), 0.8 * model.cosmology.age(z[0]).value),
        "frac_agn": np.where(rng.random(n) < 0.5, 0, rng.uniform(0, 0.8, n)),
    }  # fmt: skip
    quasar = both | {
        "redshift": z[1], "tau": np.full(n, 0.5), "age": np.full(n, 0.5), "ebv": rng.uniform(0.1, 0.4, n),
        "frac_agn": rng.uniform(0.75, 0.995, n), "inclination": rng.uniform(10, 40, n),
        "disk_slope": rng.uniform(-0.3, 0.3, n),
    }  # fmt: skip
    flux = [
        np.column_stack([out[b].value for b in BANDS])
        for out in (model.fluxes(QTable(table), BANDS) for table in (galaxy, quasar))
    ]
    stars = {f"{t}": planck(t) for t in np.exp(rng.uniform(np.log(2700), np.log(12000), n))}
    flux = np.concatenate([*flux, template_grid(stars, BANDS).galaxy[0]])
    flux *= 10.0 / flux[:, [3]]
    table = QTable({"id": np.arange(3 * n)})
    for k, band in enumerate(BANDS):
        error = 0.05 * flux[:, k]
        table[band] = (flux[:, k] + error * rng.normal(size=3 * n)) * u.uJy
        table[f"{band}_err"] = error * u.uJy
    return table


def sort(model, bands, table, stars=None, **error):
    """Classes of a table, and the CPU time of the fits."""
    fitters = {"galaxy": (model, GALAXIES), "quasar": (model, quasar_axes())}
    fitters = {n: BayesFitter(m, bands, axes=axes, **error) for n, (m, axes) in fitters.items()}
    if stars:
        fitters["star"] = BayesFitter(template_grid(stars, bands), **error)
    start = time.process_time()
    found = compare_classes({name: fitter.fit(table) for name, fitter in fitters.items()})
    return found, 1e3 * (time.process_time() - start) / len(table)


def real(what, table):
    """Print the classes of real sources by ``miricigale fit --quasars``."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "catalog.ecsv"
        table.write(path)
        start = time.process_time()
        fits = fit_classes(path, Path(folder) / "fit", quasars=True)
        cost = 1e3 * (time.process_time() - start) / len(table)
        write_table(fits, Path(folder) / "classes.fits")
        found = QTable.read(Path(folder) / "classes.fits")
    ratio, quasar = found["log_ratio_quasar"], np.asarray(found["class"]).astype(str) == "quasar"
    print(
        f"{what}, {len(table)} sources: {quasar.sum()} quasars "
        f"({quasar.mean():.0%}), {np.sum(ratio > 5)} beyond 150 to 1, {np.sum(ratio < -5)} galaxies "
        f"beyond it; median ln ratio {np.median(ratio):.1f}; {cost:.0f} ms of CPU an object"
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--n", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    model, n = SEDModel.survey(libraries="bundled"), args.n
    stars = {f"{t:.0f} K": planck(t) for t in np.geomspace(2500, 15000, 25)}
    table = simulated(model, n, args.seed)
    found, cost = sort(model, BANDS, table, stars, model_error=0.05)
    for i, name in enumerate(("galaxies", "quasars", "stars")):
        label, counts = np.unique(found["class"][i * n : (i + 1) * n], return_counts=True)
        print(f"{n} {name}: {dict(zip(label.tolist(), counts.tolist(), strict=True))}")
    print(f"{cost:.0f} ms of CPU an object, three classes")
    data = Path(os.environ.get("MIRICIGALE_DATA", "../shared/data"))
    quasars = read_cigale_catalog(data / "cigale/sdss_qso/sdss_qso.txt")[::8]
    columns = [f"sedpy.sdss_{b}0{end}" for b in "ugriz" for end in ("", "_err")]
    real("quasars of SDSS, ugriz", quasars["id", *columns])
    galaxies = read_catalog_photometry(data / "ceers/ceers_photometry_part.fits", "ceers")
    known = [b for b in galaxies.colnames if f"{b}_err" in galaxies.colnames]
    signal = np.array(
        [np.nan_to_num((galaxies[b] / galaxies[f"{b}_err"]).value) > 5 for b in known]
    )
    miri = np.array([b.startswith("miri") for b in known])
    some = (signal.sum(0) >= 8) & (signal[miri].sum(0) >= 2)
    real("CEERS, every band", galaxies[some][::3])


if __name__ == "__main__":
    main()
