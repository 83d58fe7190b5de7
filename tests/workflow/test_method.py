"""The stage of forced photometry, by the package's method and by the paper's."""

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, StdDevUncertainty
from astropy.table import QTable

from miricigale.instrument import north_up_wcs
from miricigale.photometry import detect_sources
from miricigale.psf import hst_psf
from miricigale.scene import Scene, highres_image
from miricigale.workflow import Context
from miricigale.workflow.config import StudyConfig
from miricigale.workflow.stages import study_stages
from miricigale.workflow.stages.images import mosaic_psf

STAGES = {stage.name: stage for stage in study_stages()}
BAND, PRIOR = "miri.f1000w", "wfc3.f160w"
CENTER = SkyCoord(53.13440 * u.deg, -27.83444 * u.deg)


def config_of(method):
    return StudyConfig.from_dict(
        {
            "exposures": {
                "filters": [BAND], "n_groups": [7], "n_integrations": [1], "n_dithers": [1],
            },
            "fit": {"min_detected": 1},
            "photometry": {"method": method},
        }
    )  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Twelve points on made-up mosaics of both grids, the prior and its detections."""
    folder = tmp_path_factory.mktemp("method")
    config = config_of("package")
    rng = np.random.default_rng(3)
    grid = np.meshgrid(np.linspace(-9, 9, 4), np.linspace(-7, 7, 3))
    dx, dy = (a.ravel() + rng.uniform(-0.1, 0.1, 12) for a in grid)
    n = len(dx)
    catalog = QTable({"id": np.arange(1, n + 1)})
    catalog["sky"] = CENTER.spherical_offsets_by(dx * u.arcsec, dy * u.arcsec)
    catalog["redshift"] = np.ones(n)
    catalog["profile"] = np.full(n, "point")
    catalog["half_light_radius"] = np.zeros(n) * u.arcsec
    catalog["sersic_index"] = catalog["axis_ratio"] = np.ones(n)
    catalog["position_angle"] = np.zeros(n) * u.deg
    catalog[BAND] = np.geomspace(20, 200, n) * u.uJy
    catalog[PRIOR] = np.full(n, 30.0) * u.uJy
    made = Context(config, folder)
    made.save_table("agn00/truth.ecsv", catalog)
    for suffix, scale, size in (("", 0.11, 280), ("_fine", 0.06, 514)):
        wcs = north_up_wcs(CENTER, scale * u.arcsec, (size, size))
        wcs.pixel_shape = size, size
        image = Scene(catalog, filter=BAND, wcs=wcs, psf=mosaic_psf(config, BAND, scale)).render()
        noise = np.full(image.shape, 0.1 * 0.06 / scale)
        data = image.data + rng.normal(0, noise)
        made.save_image(
            f"agn00/mosaic_{BAND}{suffix}.fits",
            CCDData(data, unit="MJy/sr", wcs=wcs, uncertainty=StdDevUncertainty(noise),
                    mask=np.zeros(image.shape, bool)),
        )  # fmt: skip
    psf = hst_psf(PRIOR, pixel_scale=0.06 * u.arcsec)
    prior = highres_image(catalog, filter=PRIOR, wcs=wcs, psf=psf, seed=1)
    segmentation, detected = detect_sources(prior)
    made.save_image("f160w.fits", prior)
    made.save_image("segm.fits", prior, segmentation=np.asarray(segmentation.data, np.int32))
    made.save_table("detections.ecsv", detected)
    return folder


@pytest.mark.parametrize(("method", "scale"), [("package", 0.11), ("yang2021", 0.06)])
def test_points_come_back_by_either_method(folder, method, scale):
    config = config_of(method)
    for name, unit in (("kernels", BAND), ("templates", ""), ("photometry", f"agn00/{BAND}")):
        STAGES[name].function(Context(config, folder, stage=STAGES[name], unit=unit), unit)
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
