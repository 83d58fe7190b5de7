"""
Memory of the stages of a study that have the tables of all its sources.

    python benchmarks/large_field.py D --catalog --n 100000
    miricigale run cosmosweb --quick --until truth --threads 1 -o D/run \
        --set catalog.source=D/catalog.fits --set catalog.mag_limit=29
    python benchmarks/large_tables.py D/run

The run ends with the truth. Of what comes next only the sizes matter: the photometry is the truth with noise of
0.1 uJy, images are flat with noise of one value, kernels are Gaussians, and each stage is a process of its own.
"""

import argparse
import resource
import subprocess
import sys
import time
import warnings
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.nddata import CCDData, StdDevUncertainty
from astropy.table import QTable

from miricigale.psf import MatchingKernel, gaussian_psf
from miricigale.utils.units import FNU
from miricigale.workflow import load_config, study_stages
from miricigale.workflow.engine.stage import Context
from miricigale.workflow.stages.exposures import study_exposures
from miricigale.workflow.stages.grids import grid_of

STAGES = ("errors", "matches", "fits", "sources", "report")
NOISE = 0.1


class Sizes(Context):
    """A context whose images, kernels and forecasts are made up."""

    def image(self, name, *planes):
        stem = name.rpartition("/")[2].removesuffix(".fits")
        stem = stem.removesuffix("_model").removesuffix("_residual")
        config = load_config(self.products.folder / "config.toml")
        if "/exposures/" in name:
            exposure = study_exposures(config)[stem.rpartition("_")[0]]
            wcs, shape = exposure.wcs, exposure.shape
            meta = {"filter": exposure.filter, "subarray": exposure.subarray}
        else:
            fine, meta = stem.startswith("f160w"), {}
            scale = config.highres.pixel_scale if fine else config.reduction.pixel_scale
            wcs = grid_of(config, scale, stem.rpartition("_")[2])
            shape = wcs.pixel_shape[::-1]
        noise = np.random.default_rng(1).normal(0, 0.01, 1000)
        image = CCDData(
            np.resize(noise, shape),
            unit="adu/s" if stem.endswith("_rate") else "MJy/sr",
            wcs=wcs,
            meta=meta,
            mask=np.zeros(shape, bool),
            uncertainty=StdDevUncertainty(np.full(shape, 0.01)),
            flags=np.zeros(shape, np.uint32),
        )
        return (image, *(np.full(shape, 2) for _ in planes)) if planes else image

    def path(self, name):
        if not name.startswith("kernel_"):
            return super().path(name)
        place = self.products.folder / "kernel.fits"
        if not place.exists():
            grid = {"pixel_scale": 0.03 * u.arcsec, "fov": 5 * u.arcsec}
            psfs = (gaussian_psf(fwhm * u.arcsec, **grid) for fwhm in (0.15, 0.27))
            MatchingKernel.from_psfs(*psfs, pixel_scale=0.06 * u.arcsec).write(place)
        return place

    def table(self, name):
        if not name.endswith("_forecast.ecsv"):
            return super().table(name)
        config = load_config(self.products.folder / "config.toml")
        exposure = study_exposures(config)[name.rpartition("/")[2].removesuffix("_forecast.ecsv")]
        names = ("filter", "dither", "readout", "subarray", "n_groups", "n_integrations")
        row = {key: [getattr(exposure, key)] for key in names} | {"group_time": [2.775] * u.s}
        row |= {key: [0] for key in ("sky_group", "n_pixels", "n_sources", "first_group")}
        return QTable(row | {"sky_fraction": [0.0], "ids": [""]})


def photometry(context, band):
    """The photometry of all sources of the truth that the prior would show."""
    truth = context.table("agn00/truth.ecsv")
    seen = np.isfinite(truth[band]) & (truth["wfc3.f160w"] > 0.05 * u.uJy)
    n, rng = np.count_nonzero(seen), np.random.default_rng(2)
    table = QTable({"id": np.arange(1, n + 1)})
    table["sky"] = truth["sky"][seen]
    table["flux"] = truth[band][seen].to(FNU) + rng.normal(0, NOISE, n) * FNU
    table["flux_err"] = np.full(n, NOISE) * FNU
    table["flags"] = np.zeros(n, int)
    context.save_table(f"agn00/photometry/{band}.ecsv", table)


def one(folder, name):
    """Do a stage and print its seconds and peak memory."""
    warnings.simplefilter("ignore")
    config = load_config(folder / "config.toml")
    (stage,) = (stage for stage in study_stages() if stage.name == name)
    start, cpu = time.time(), time.process_time()
    for unit in stage.unit_names(config):
        stage.function(Sizes(config, folder, stage=stage, unit=unit), unit)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    stated = stage.memory(config, stage.unit_names(config)[0]) / 1e6 if stage.memory else 0
    print(
        f"{name:8s} {time.time() - start:6.0f} s {time.process_time() - cpu:6.0f} CPU-s "
        f"{memory:6.0f} MB, stated {stated:.0f}",
        flush=True,
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument("folder", type=Path, help="of a run until the truth")
    parser.add_argument("--stages", nargs="+", default=STAGES, choices=STAGES)
    parser.add_argument("--one", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one:
        one(args.folder, args.one)
        return
    config = load_config(args.folder / "config.toml")
    context = Context(config, args.folder)
    for band in config.exposures.filters:
        photometry(context, band)
    for name in args.stages:
        subprocess.run([sys.executable, __file__, str(args.folder), "--one", name], check=True)
    matched = context.table("agn00/matched.ecsv")
    sample = np.count_nonzero(matched["selection"] == 0)
    print(f"{len(matched)} sources, of which {sample} are fitted")


if __name__ == "__main__":
    main()
