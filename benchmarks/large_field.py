"""
Run a study of a large field of several pointings, and say what each stage took.

    python benchmarks/large_field.py FOLDER [--n 20000] [--tiles 3 3] [--until STAGE]

Sources are draws of the bundled catalog, up to 2 mag fainter, at random places over the field: 620 for
each square arcmin with the defaults, about what F160W counts have to 28 mag. One band of the quick
exposures, as rates. Run again it resumes where it was stopped.
"""

import argparse
import json
import math
import resource
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord

from miricigale.scene import read_catalog
from miricigale.utils.parallel import process_pool
from miricigale.workflow import disk_use, load_config, run_study
from miricigale.workflow.stages.exposures import grid_of

BANDS = ("f115w", "f150w", "f200w", "f277w", "f356w", "f444w")
COLUMNS = (
    "id", "sky", "redshift", "star", "half_light_radius", "sersic_index", "axis_ratio",
    "position_angle", "wfc3.f160w", *(f"nircam.{band}" for band in BANDS),
)  # fmt: skip


def large_catalog(wcs, n, *, seed=1):
    """Draws of the bundled catalog over the pixels of a grid."""
    rng = np.random.default_rng(seed)
    table = read_catalog("catalog.goodss")
    table = table[rng.integers(0, len(table), n)]
    table["id"] = np.arange(1, n + 1)
    nx, ny = wcs.pixel_shape
    sky = wcs.pixel_to_world(rng.uniform(0, nx, n), rng.uniform(0, ny, n))
    table["sky"] = SkyCoord(sky.ra, sky.dec)
    fainter = 10 ** (-0.4 * rng.uniform(0, 2, n))
    for name in COLUMNS:
        if "." in name:
            table[name] = table[name] * fainter
    table["redshift"] = np.maximum(table["redshift"] * (1 + 0.03 * rng.normal(size=n)), 0.01)
    table.meta.clear()
    return table[list(COLUMNS)]


def main():
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--n", type=int, default=20_000)
    parser.add_argument("--tiles", type=int, nargs=2, default=(3, 3))
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--until")
    options = parser.parse_args()
    options.folder.mkdir(exist_ok=True)
    path = options.folder / "catalog.fits"
    values = {
        "run": {"name": "large field", "threads": options.threads},
        "catalog": {"source": str(path), "mag_limit": 29.0},
        "pointing": {"tiles": list(options.tiles)},
        "exposures": {"kind": "rates", "plan": "quick", "filters": ["miri.f770w"]},
        "sed": {"axes": "quick"},
        "fit": {"axes": "quick", "min_detected": 1},
        "point_sources": {"enabled": False},
    }
    config = load_config("goodss", overrides=values)
    if not path.exists():
        large_catalog(grid_of(config, 0.11), options.n).write(path)
    run = options.folder / "run"
    with process_pool(options.threads) as executor:
        run_study(config, run, executor=executor, until=options.until, progress_bar=True)
    forecast, found = disk_use(config), {}
    for key, record in json.loads((run / "manifest.json").read_text())["stages"].items():
        entry = found.setdefault(key.partition(":")[0], np.zeros(3))
        size = math.fsum(product["bytes"] for product in record["products"].values())
        entry += 1, record["seconds"], size / 1e6
    print(f"{'stage':12s} {'units':>5s} {'s':>8s} {'MB':>8s} {'forecast':>8s}")
    for name, (n_units, seconds, size) in found.items():
        print(
            f"{name:12s} {n_units:5.0f} {seconds:8.1f} {size:8.1f} "
            f"{forecast.get(name, 0) / 1e6:8.1f}"
        )
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    cpu = sum(one.ru_utime + one.ru_stime for one in used) * u.s
    largest = max(one.ru_maxrss for one in used) / 1e6
    print(f"processor time of this call {cpu.to(u.min):.1f}, largest process {largest:.2f} GB")


if __name__ == "__main__":
    main()
