"""Sub-arrays and several integrations through calwebb_detector1 and calwebb_image2."""

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits

from miricigale.instrument import DQ, Exposure, flat_field, photmjsr

pytest.importorskip("jwst", reason="needs the official pipeline: pip install miricigale[jwst]")
pytestmark = pytest.mark.slow

FILTER, SUBARRAY = "miri.f1500w", "SUB256"


@pytest.fixture(scope="module")
def observation(tmp_path_factory, tools):
    folder = tmp_path_factory.mktemp("subarray")
    options = ("--filters", FILTER, "--groups", "12", "--subarray", SUBARRAY)
    crds = tools.make_crds(folder / "crds", *options)
    exposure = Exposure(
        FILTER,
        n_groups=12,
        n_integrations=3,
        subarray=SUBARRAY,
        pointing=tools.POINTING,
        roll=20 * u.deg,
    )
    x, y = (g.ravel() for g in np.meshgrid([60.3, 128.0, 190.6], [55.1, 130.4, 200.0]))
    catalog = tools.star_field(exposure, x, y, np.full(9, 2e3))
    (seen,) = tools.observe([exposure], catalog, folder)
    tools.run_stage("detector1", folder, [seen.uncal], crds)
    tools.run_stage("image2", folder, [seen.product(folder, "rate")], crds)
    return folder, seen


def test_rates_and_errors(observation):
    folder, seen = observation
    with fits.open(seen.product(folder, "rate")) as hdus:
        rate, error = (hdus[name].data.astype(float) for name in ("SCI", "ERR"))
        clean = hdus["DQ"].data == 0
    truth = seen.light * flat_field(FILTER, subarray=SUBARRAY) / photmjsr(FILTER)
    for these in (clean & (truth < 100), clean & (truth > 200)):
        assert np.count_nonzero(these) > 100
        assert rate[these].sum() == pytest.approx(truth[these].sum(), rel=5e-3)
    pull = (rate[clean] - truth[clean]) / error[clean]
    assert 0.95 < np.std(pull) < 1.1


def test_brightness(observation):
    folder, seen = observation
    path = seen.product(folder, "cal")
    with fits.open(path) as hdus:
        use = (hdus["DQ"].data & DQ.DO_NOT_USE) == 0
        data = hdus["SCI"].data[use].astype(float)
    assert data.sum() == pytest.approx(seen.light[use].sum(), rel=2e-3)
