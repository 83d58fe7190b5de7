"""The stage of forced photometry, by the package's method and by the paper's."""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable

from helpers.points import PRIOR, point_catalog, save_points
from helpers.runs import do_stage, one_band
from miricigale.workflow import Context

BAND = "miri.f1000w"


def config_of(method):
    return one_band(BAND, photometry={"method": method})


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Twelve points on made-up mosaics of both grids, the prior and its detections."""
    folder = tmp_path_factory.mktemp("method")
    config = config_of("package")
    rng = np.random.default_rng(3)
    places = np.meshgrid(np.linspace(-9, 9, 4), np.linspace(-7, 7, 3))
    catalog = point_catalog(*places, rng, {BAND: np.geomspace(20, 200, 12), PRIOR: 30.0})
    save_points(Context(config, folder), catalog, BAND, rng, width=30.84)
    return folder


@pytest.mark.parametrize(("method", "scale"), [("package", 0.11), ("yang2021", 0.06)])
def test_points_come_back_by_either_method(folder, method, scale):
    config = config_of(method)
    for name, unit in (("kernels", BAND), ("templates", ""), ("photometry", f"agn00/{BAND}")):
        do_stage(config, folder, name, unit)
    table = QTable.read(folder / "agn00" / "photometry" / f"{BAND}.ecsv")
    truth = QTable.read(folder / "agn00" / "truth.ecsv")
    index, separation, _ = truth["sky"].match_to_catalog_sky(table["sky"])
    assert separation.arcsec.max() < 0.05
    ratio = (table["flux"][index] / truth[BAND]).to_value(u.one)
    # the paper's factor for stamps cut to a square is that of a circle
    assert abs(np.median(ratio) - 1) < (0.003 if method == "package" else 0.03)
    assert np.ptp(ratio) < 0.03
    assert table.meta["pixel_scale"] == pytest.approx(scale, rel=1e-3)
    assert table.meta.get("method", "package") == method
    model = Context(config, folder).image(f"agn00/photometry/{BAND}_model.fits")
    assert model.shape == ((280, 280) if method == "package" else (514, 514))
