"""
Run a study of a large field of several pointings, and say what each stage took.

    python benchmarks/large_field.py FOLDER [--n 20000] [--tiles 3 3] [--patches 100] [--until STAGE]
    python benchmarks/large_field.py FOLDER --catalog     of the preset cosmosweb, for 'miricigale run'

Sources are draws of the bundled catalog, up to 2 mag fainter, at random places over the field: 620 for
each square arcmin with the defaults, about what F160W counts have to 28 mag. One band of the quick
exposures, as rates. Run again it resumes where it was stopped. Times by stage are elapsed, of units side by side;
the last columns share the processor time of this call out by them, beside what ``study_cost`` says.
"""

import argparse
import json
import math
import resource
from pathlib import Path

import numpy as np
from astropy.coordinates import SkyCoord

from miricigale.scene import read_catalog
from miricigale.utils.parallel import process_pool
from miricigale.workflow import load_config, run_study, study_cost
from miricigale.workflow.stages.grids import grid_of

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
    parser.add_argument("--patches", type=float, default=0.0, help="arcsec; 0 for the field in one")
    parser.add_argument("--catalog", action="store_true", help="write a catalog of COSMOS-Web only")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--until")
    options = parser.parse_args()
    options.folder.mkdir(exist_ok=True)
    path = options.folder / "catalog.fits"
    if options.catalog:
        large_catalog(grid_of(load_config("cosmosweb"), 0.11), options.n).write(path)
        return
    values = {
        "run": {"name": "large field", "threads": options.threads},
        "catalog": {"source": str(path), "mag_limit": 29.0},
        "pointing": {"tiles": list(options.tiles)},
        "patches": {"size": options.patches},
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
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    cpu = sum(one.ru_utime + one.ru_stime for one in used)
    table, found = study_cost(config), {}
    for key, record in json.loads((run / "manifest.json").read_text())["stages"].items():
        entry = found.setdefault(key.partition(":")[0], np.zeros(2))
        size = math.fsum(product["bytes"] for product in record["products"].values())
        entry += record["seconds"], size / 1e6
    seconds, size = np.transpose([found.get(name, (0.0, 0.0)) for name in table["stage"]])
    table["elapsed"], table["took"] = seconds, cpu * seconds / seconds.sum()
    table["written"] = size
    for name in ("cpu", "disk", "memory", "elapsed", "took", "written"):
        table[name].info.format = ".1f"
    table.pprint_all()
    largest = max(one.ru_maxrss for one in used) / 1e6
    print(f"processor time of this call {cpu / 60:.1f} min, largest process {largest:.2f} GB")


if __name__ == "__main__":
    main()
