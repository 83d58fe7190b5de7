"""
Time the spectra.

    python benchmarks/sed.py
"""

import resource
import sys
import time

import numpy as np
from astropy.table import QTable

from miricigale.filters import FilterSet
from miricigale.sed import SEDModel, yang2021_axes

BANDS = [
    *(f"megacam.{band}" for band in "ugriz"),
    *("acs.f606w", "acs.f814w", "wfc3.f125w", "wfc3.f140w", "wfc3.f160w"),
    *("irac.ch1", "irac.ch2", "irac.ch3", "irac.ch4", "mips.24"),
    *("miri.f770w", "miri.f1000w", "miri.f1280w", "miri.f1500w", "miri.f1800w", "miri.f2100w"),
]


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


def main():
    """Print the table."""
    filters = FilterSet.from_names(BANDS)
    model = SEDModel.yang2021()
    report = []
    seconds, _ = clock(lambda: model.evaluate(age=1.0))
    report.append(("first spectrum (tables read, kernels loaded)", f"{seconds:.2f} s"))
    seconds, _ = clock(lambda: [model.evaluate(age=1.0, ebv=e) for e in np.linspace(0, 1, 50)])
    report.append(("one more spectrum", f"{seconds / 50 * 1e3:.1f} ms"))
    model.fluxes(rows(3, repeat=True), filters)
    for repeat, text in ((True, "12 histories"), (False, "every history new")):
        seconds, _ = clock(lambda repeat=repeat: model.fluxes(rows(3000, repeat=repeat), filters))
        report.append((f"fluxes(), 21 bands, exact redshifts, {text}", f"{3000 / seconds:.0f} /s"))
    report.append(("   CIGALE / Bagpipes, a core", "3800 / 1020 /s"))
    for kind in ("quick", "fit"):
        fresh = SEDModel.yang2021()
        seconds, grid = clock(
            lambda kind=kind, fresh=fresh: fresh.grid(yang2021_axes(kind), filters)
        )
        size = (grid.galaxy.nbytes + grid.agn.nbytes) / 1e6
        text = f"{seconds:.2f} s, {size:.0f} MB"
        report.append((f"grid({kind!r}), 21 bands, {grid.n_models:,} models", text))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    report.append(("peak memory", f"{peak / (1e9 if sys.platform == 'darwin' else 1e6):.2f} GB"))
    for name, value in report:
        print(f"{name:62s} {value}")


if __name__ == "__main__":
    main()
