"""
How often 68 % intervals hold the truth where it lies between the nodes of a coarse grid.

    python benchmarks/coverage.py [--n 300] [--draws 0 1000] [--model-error 0.1]

Objects have parameters drawn evenly within the ranges of the axes (not on nodes), and S/N 10 in 21 bands, u*
to MIPS 24; the grid has 1.2 million models in 31 redshifts. ``--draws`` is ``interpolate`` of the fitter.
"""

import argparse
import time

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.fitting import BayesFitter, FitFlags
from miricigale.sed import SEDModel

BANDS = [
    "megacam.u", "megacam.g", "megacam.r", "megacam.i", "megacam.z", "acs.f606w", "acs.f814w",
    "wfc3.f125w", "wfc3.f140w", "wfc3.f160w", "irac.ch1", "irac.ch2", "irac.ch3", "irac.ch4", "mips.24",
    "miri.f770w", "miri.f1000w", "miri.f1280w", "miri.f1500w", "miri.f1800w", "miri.f2100w",
]  # fmt: skip
AXES = {
    "tau": [0.1, 0.5, 1.0, 5.0],
    "age": [0.5, 1.0, 3.0, 5.0],
    "ebv": [0.1, 0.2, 0.4, 0.6, 0.9],
    "alpha": [1.0, 2.0, 2.5],
    "tau97": [3.0, 7.0, 11.0],
    "ebv_polar": [0.0, 0.15, 0.3],
    "temperature_polar": [100.0, 170.0, 300.0],
    "frac_agn": [0.0, 0.2, 0.4, 0.6, 0.8, 0.99],
}
NAMES = ("redshift", "frac_agn", "stellar_mass", "sfr", "dust_luminosity")


def objects(model, n, rng):
    """Photometry with noise, and true values by name."""
    true = QTable()
    for name, values in AXES.items():
        true[name] = rng.uniform(values[0], values[-1], n) * model.parameters[name].unit
    true["redshift"] = np.expm1(rng.uniform(np.log1p(0.15), np.log1p(4.0), n)) * u.one
    old = true["age"] > model.cosmology.age(true["redshift"].value)
    true["age"][old] = rng.uniform(0.5, 1.4, np.count_nonzero(old)) * u.Gyr
    fluxes = model.fluxes(true, BANDS)
    for name in NAMES[2:]:
        true[name] = fluxes[name]
    table = QTable({"id": np.arange(n)})
    for name in BANDS:
        table[name] = fluxes[name] * (1.0 + 0.1 * rng.normal(size=n))
        table[f"{name}_err"] = 0.1 * fluxes[name]
    return table, true


def main():
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--n", type=int, default=300)
    parser.add_argument("--draws", type=int, nargs="+", default=[0, 1000])
    parser.add_argument("--model-error", type=float, default=0.1)
    args = parser.parse_args()
    model = SEDModel.yang2021(libraries="bundled")
    table, true = objects(model, args.n, np.random.default_rng(5))
    redshift = SEDModel.yang2021_axes("quick")["redshift"][2:]
    grid = model.grid(AXES | {"redshift": redshift}, BANDS)
    print(grid)
    print(f"draws  ms {' '.join(f'{name:>16s}' for name in NAMES)}  on one node")
    for n_draws in args.draws:
        start = time.process_time()
        fitter = BayesFitter(grid, BANDS, model_error=args.model_error, interpolate=n_draws)
        results = fitter.fit(table)
        spent = 1e3 * (time.process_time() - start) / args.n
        held = []
        for name in NAMES:
            low, high = results.percentile(name, [0.16, 0.84]).T
            held.append(np.mean((true[name] >= low) & (true[name] <= high)))
        alone = np.mean((results.flags & int(FitFlags.ONE_NODE)) != 0)
        print(
            f"{n_draws:5d} {spent:3.0f} {' '.join(f'{100 * h:15.0f}%' for h in held)} {100 * alone:11.0f}%"
        )


if __name__ == "__main__":
    main()
