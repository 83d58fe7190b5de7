"""The official pipeline goes on from what the package writes, to what it comes to by itself."""

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from numpy.testing import assert_allclose, assert_array_equal

from miricigale.instrument import DQ, Exposure
from miricigale.reduction import Reducer, reduce_files

pytest.importorskip("jwst", reason="needs the official pipeline: pip install miricigale[jwst]")
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def continued(tools, tmp_path_factory):
    """Our rates and images of three dithers, and what image2 makes of the rates."""
    folder = tmp_path_factory.mktemp("continued")
    ours, theirs = folder / "ours", folder / "theirs"
    options = {"n_groups": 20, "subarray": "BRIGHTSKY", "pointing": tools.POINTING}
    base = Exposure("F770W", roll=110 * u.deg, **options)
    rng = np.random.default_rng(3)
    x, y = (g.ravel() + rng.uniform(-8, 8, g.size) for g in np.mgrid[50:500:85, 50:500:85])
    catalog = tools.star_field(base, x, y, 10 ** rng.uniform(2.3, 3.0, x.size))
    crds = tools.make_crds(
        folder / "crds", "--filters", base.filter, "--groups", "20", "--subarray", "BRIGHTSKY"
    )
    seen = list(tools.observe(base.dithered("4-point", 3), catalog, folder))
    reduce_files([one.uncal for one in seen], ours, reducer=Reducer(background="none"))
    theirs.mkdir()
    tools.run_stage("image2", theirs, sorted(ours.glob("*_rate.fits")), crds)
    return ours, theirs, crds


def test_image2_makes_our_images_of_our_rates(continued):
    ours, theirs, _ = continued
    for path in sorted(theirs.glob("*_cal.fits")):
        with fits.open(path) as other, fits.open(ours / path.name) as own:
            good = (other["DQ"].data & int(DQ.DO_NOT_USE)) == 0
            assert_array_equal((own["DQ"].data & int(DQ.DO_NOT_USE)) == 0, good)
            for name in ("SCI", "ERR", "VAR_POISSON", "VAR_RNOISE", "AREA"):
                assert_allclose(own[name].data[good], other[name].data[good], rtol=1e-5)
            for name in ("PIXAR_SR", "PIXAR_A2", "PHOTMJSR"):
                assert own["SCI"].header[name] == pytest.approx(other["SCI"].header[name], rel=1e-6)


@pytest.mark.parametrize(("stage", "tolerance"), [("image3+level", 1e-5), ("image3+align", 1e-4)])
def test_image3_makes_one_mosaic_of_both(continued, tools, stage, tolerance):
    # the mode of a histogram, which is its level, makes 1e-4 of the noise of differences of 1e-7
    *folders, crds = continued
    mosaics = []
    for folder in folders:
        # an association names files beside it
        cals = [path.name for path in sorted(folder.glob("*_cal.fits"))]
        tools.run_stage(stage, folder, cals, crds)
        with fits.open(folder / "mosaic_i2d.fits") as hdus:
            done = "COMPLETE" if "align" in stage else "SKIPPED"
            assert hdus[0].header["S_TWKREG"] == done
            mosaics.append(hdus["SCI"].data)
    assert np.isfinite(mosaics[0]).mean() > 0.9
    assert_allclose(*mosaics, rtol=tolerance)
