import dataclasses
import json
import os
import subprocess
import sys
import types
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import QTable

from helpers.scenes import catalog_at
from miricigale.detector import Detector
from miricigale.instrument import Exposure, pixel_to_sky
from miricigale.psf import miri_psf
from miricigale.scene import Background, Scene

HERE = Path(__file__).parent
MAKE_CRDS = HERE.parents[1] / "tools" / "make_crds.py"
POINTING = SkyCoord(214.953, 52.951, unit="deg")


@dataclasses.dataclass(frozen=True, eq=False)
class Observation:
    """One exposure: what it saw, and where its file lies."""

    exposure: Exposure
    light: np.ndarray  # MJy/sr, without noise
    sky: np.ndarray  # what of it is background
    truth: QTable
    uncal: Path

    def product(self, folder, name):
        return folder / self.uncal.name.replace("uncal", name)


def command(*arguments, environment=None):
    """Run Python; if it fails, show what it said last."""
    variables = {**os.environ, "PYTHONWARNINGS": "ignore", **(environment or {})}
    done = subprocess.run(
        [sys.executable, *map(str, arguments)], env=variables, capture_output=True, text=True
    )
    if done.returncode:
        pytest.fail(f"{arguments[0]} failed:\n" + done.stderr[-4000:])


def make_crds(folder, *options):
    """The cache as a user makes it, and the variables that its shell file sets."""
    command(MAKE_CRDS, folder, *options)
    variables = {}
    for line in (folder / "environment.sh").read_text().splitlines():
        key, value = line.removeprefix("export ").split("=", 1)
        variables[key] = value.strip("'")
    return variables


def run_stage(stage, folder, files, crds):
    """Run one stage of the pipeline (see run_stage.py), and return what it needed."""
    command(HERE / "run_stage.py", stage, folder, *files, environment=crds)
    return json.loads((folder / f"{stage.partition('+')[0]}.json").read_text())


def star_field(base, x, y, flux):
    """Stars on given pixels of an exposure."""
    sky = pixel_to_sky(x, y, base.pointing, base.roll, subarray=base.subarray)
    return catalog_at(sky, redshift=0.0, **{base.filter: flux * u.uJy})


def observe(exposures, catalog, folder, *, detector=None):
    """Scene, detector, file: our own part of the chain, at its defaults."""
    psf = miri_psf(exposures[0].filter)
    background = Background.low_zodi(exposures[0].filter, center=exposures[0].pointing)
    detector = detector or Detector.miri_imager()
    for exposure in exposures:
        form = {"filter": exposure.filter, "wcs": exposure.wcs, "psf": psf}
        scene = Scene(catalog, background=background, **form)
        image = scene.render()
        ramp = detector.expose(image, exposure, seed=20)
        path = ramp.write(folder / f"simulated_{exposure.dither + 1}_uncal.fits")
        sky = background.image(exposure.wcs, exposure.shape)
        yield Observation(exposure, image.data, sky, scene.truth, path)


@pytest.fixture(scope="package")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("jwst")


@pytest.fixture(scope="package")
def crds(folder):
    return make_crds(folder / "crds", "--filters", "miri.f770w", "--groups", "20")


@pytest.fixture(scope="package")
def observations(folder):
    """Four dithered exposures of 70 stars, 9 arcsec apart, at random phases of the pixels."""
    base = Exposure("miri.f770w", n_groups=20, pointing=POINTING, roll=110 * u.deg)
    rng = np.random.default_rng(3)
    x, y = (
        g.ravel() + rng.uniform(-8, 8, g.size)
        for g in np.meshgrid(430 + 85.0 * np.arange(7), 70 + 98.0 * np.arange(10))
    )
    catalog = star_field(base, x, y, 10 ** rng.uniform(2.0, 2.6, x.size))
    return list(observe(base.dithered("4-point", 4), catalog, folder))


@pytest.fixture(scope="package")
def detector1(folder, crds, observations):
    """What calwebb_detector1 needed; its products are in the folder."""
    return run_stage("detector1", folder, [o.uncal for o in observations], crds)


@pytest.fixture(scope="package")
def image2(folder, crds, observations, detector1):
    rates = [o.product(folder, "rate") for o in observations]
    return run_stage("image2", folder, rates, crds)


@pytest.fixture(scope="package")
def image3(folder, crds, observations, image2):
    # an association names files beside it
    cals = [o.product(folder, "cal").name for o in observations]
    return run_stage("image3", folder, cals, crds)


@pytest.fixture(scope="package")
def tools():
    """The functions above, for a test that makes an exposure of its own."""
    functions = (make_crds, run_stage, star_field, observe)
    return types.SimpleNamespace(POINTING=POINTING, **{f.__name__: f for f in functions})
