"""
Time the spectra.

    python benchmarks/sed.py

Models per second are those of one core (BLAS is held to one thread), grids use all.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time

import numpy as np
from astropy.table import QTable

from miricigale import conf
from miricigale.filters import FilterSet
from miricigale.sed import SEDModel, components, yang2021_axes

BANDS = [
    *(f"megacam.{band}" for band in "ugriz"),
    *("acs.f606w", "acs.f814w", "wfc3.f125w", "wfc3.f140w", "wfc3.f160w"),
    *("irac.ch1", "irac.ch2", "irac.ch3", "irac.ch4", "mips.24"),
    *("miri.f770w", "miri.f1000w", "miri.f1280w", "miri.f1500w", "miri.f1800w", "miri.f2100w"),
]
#: Measured by others' users on one core, models/s (exact redshifts, about 20 bands).
OTHERS = "CIGALE 3800, Bagpipes 1020"
COLD = """
import time
start = time.perf_counter()
from miricigale.filters import Filter
Filter.from_name("miri.f770w")
print(time.perf_counter() - start)
"""


def clock(function):
    """Seconds that a call takes, and what it returns."""
    start = time.perf_counter()
    out = function()
    return time.perf_counter() - start, out


def rows(n, *, repeat):
    """Random models at exact redshifts; with ``repeat`` their histories are few."""
    rng = np.random.default_rng(1)
    axes = yang2021_axes()
    take = lambda name: rng.choice(axes[name], n)  # noqa: E731
    table = QTable({name: take(name) for name in ("tau", "ebv", "alpha", "tau97", "frac_agn")})
    table["redshift"] = rng.uniform(0.05, 2.0, n)
    table["age"] = rng.choice([0.5, 1.0, 3.0], n) if repeat else rng.uniform(0.2, 3.0, n)
    table["ebv_polar"] = rng.uniform(0.0, 0.3, n)
    table["temperature_polar"] = rng.uniform(100.0, 300.0, n)
    table["inclination"] = rng.choice([60.0, 70.0, 80.0, 90.0], n)
    return table


def everything():
    """A chain with a component of every role."""
    parts = [c for c in SEDModel.yang2021().components if c.role != "igm"]
    more = ("Nebular", "XRay", "Inoue2014", "GalacticExtinction")
    return SEDModel([*parts, *(getattr(components, name)() for name in more)])


def time_models():
    """Lines of the table that are for one core."""
    filters = FilterSet.from_names(BANDS)
    model = SEDModel.yang2021()
    seconds, _ = clock(lambda: model.evaluate(age=1.0))
    yield "first spectrum (tables read, kernels loaded)", f"{seconds:.2f} s"
    seconds, _ = clock(lambda: [model.evaluate(age=1.0, ebv=e) for e in np.linspace(0, 1, 50)])
    yield "one more spectrum, all parts and derived quantities", f"{seconds / 50 * 1e3:.1f} ms"
    full = everything()
    for chain, name in ((model, ""), (full, ", nebular, X-ray, foreground")):
        chain.fluxes(rows(300, repeat=True), filters)
        for repeat, text in ((True, "12 histories"), (False, "every history new")):
            table = rows(5000, repeat=repeat)
            runs = [clock(lambda c=chain, t=table: c.fluxes(t, filters))[0] for _ in range(3)]
            yield f"fluxes(), 21 bands, exact z, {text}{name}", f"{5000 / min(runs):.0f} /s"
    yield "   others, a core", OTHERS


def time_grids():
    """Lines of the table for grids."""
    filters = FilterSet.from_names(BANDS)
    axes = yang2021_axes()
    with tempfile.TemporaryDirectory() as folder, conf.set_temp("cache_folder", folder):
        SEDModel.yang2021().grid(yang2021_axes("quick"), filters, cache=False)
        seconds, grid = clock(lambda: SEDModel.yang2021().grid(axes, filters, cache=False))
        size = (grid.galaxy.nbytes + grid.agn.nbytes) / 1e6
        name = f"grid(), 21 bands, {grid.n_models:,} models"
        yield name, f"{seconds:.2f} s, {size:.0f} MB"
        SEDModel.yang2021().grid(axes, filters)
        seconds, _ = clock(lambda: SEDModel.yang2021().grid(axes, filters))
        yield "   the same from the cache", f"{seconds:.2f} s"
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield "   peak memory", f"{peak / (1e9 if sys.platform == 'darwin' else 1e6):.2f} GB"


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--part", choices=("models", "grids"), help="only this, in this process")
    part = parser.parse_args().part
    if part:
        for name, value in (time_models if part == "models" else time_grids)():
            print(f"{name:76s} {value}", flush=True)
        return
    run = [sys.executable, "-c", COLD]
    cold = [
        float(subprocess.run(run, capture_output=True, text=True, check=True).stdout)
        for _ in range(3)
    ]
    print(f"{'Filter.from_name in a new process, imports included':76s} {min(cold):.2f} s")
    one = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    for name, environment in (("models", one), ("grids", os.environ)):
        subprocess.run([sys.executable, __file__, "--part", name], env=environment, check=True)


if __name__ == "__main__":
    main()
