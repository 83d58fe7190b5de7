"""Scenes of catalogs, filters, PSFs and grids in the forms that users have."""

import astropy.units as u
import numpy as np
import pandas as pd
import pytest
from astropy.convolution import Gaussian2DKernel
from astropy.coordinates import SkyCoord
from astropy.stats import gaussian_sigma_to_fwhm
from astropy.table import QTable, Table
from numpy.testing import assert_allclose
from photutils.psf import CircularGaussianPRF, MoffatPSF

from helpers import scenes
from helpers.errors import refuses
from miricigale.detector import Detector
from miricigale.filters import Filter
from miricigale.instrument import Exposure
from miricigale.psf import as_psf, miri_psf
from miricigale.scene import Scene, as_sources

RA, DEC = np.array([150.1, 150.102]), np.array([2.2, 2.201])
SKY = SkyCoord(RA, DEC, unit="deg")
FLUX = np.array([5.0, 7.0])
MAG = 23.9 - 2.5 * np.log10(FLUX)


@pytest.fixture(scope="module")
def exposure():
    return Exposure("F770W", n_groups=10, pointing="150.1 2.2", subarray="SUB128")


def pixels(exposure):
    x, y = exposure.wcs.world_to_pixel(SKY)
    return {"X": x, "Y": y, "flux": FLUX * u.uJy}


@pytest.mark.parametrize(
    "catalog",
    [
        QTable({"sky": SKY, "miri.f770w": FLUX * u.uJy}),
        QTable({"position": SKY, "F770W": FLUX * u.uJy}),
        Table({"RA": RA, "DEC": DEC, "f_f770w": FLUX * 1e3 * u.nJy}),
        {"ra": RA * u.deg, "dec": np.radians(DEC) * u.rad, "F770W": FLUX * 1e-6 * u.Jy},
        {"ALPHA_J2000": RA, "DELTA_J2000": DEC, "mag_F770W": MAG},
        {"RAJ2000": RA, "DECJ2000": DEC, "F770W": FLUX * u.uJy},
        {"RAJ2000": RA / 15 * u.hourangle, "DEJ2000": DEC, "JWST/MIRI.F770W": MAG * u.ABmag},
        pd.DataFrame({"ra": RA, "dec": DEC, "mag": MAG}),
        Table({"ra": RA, "dec": DEC, "mag": MAG}).as_array(),
        pixels,
    ],
)
def test_one_truth_of_any_catalog(catalog, exposure):
    if callable(catalog):
        catalog = catalog(exposure)
    with pytest.warns(match="sources are points"):
        truth = Scene(catalog, exposure).truth
    assert truth["id"].tolist() == [1, 2]
    assert truth["sky"].separation(SKY).max() < 1e-4 * u.arcsec
    np.testing.assert_allclose(truth["flux_total"].to_value(u.uJy), FLUX, rtol=1e-4)


def test_shapes_by_their_usual_names():
    shapes = {"Re": [0.3] * u.arcsec, "n": [1.0], "q": [0.5], "PA": [30.0] * u.deg, "z": [1.5]}
    table = as_sources({"ra": [150.1], "dec": [2.2], "flux": [1.0] * u.uJy, **shapes}, "miri.f770w")
    names = {"half_light_radius", "sersic_index", "axis_ratio", "position_angle", "redshift"}
    assert names | {"miri.f770w"} <= set(table.colnames)


def test_an_exposure_gives_filter_grid_and_psf(exposure):
    catalog = {"sky": SKY, "F770W": FLUX * u.uJy, "profile": "point"}
    scene = Scene(catalog, exposure)
    by_hand = Scene(
        catalog, filter=Filter("F770W"), wcs=exposure.wcs, psf=miri_psf("JWST/MIRI.F770W")
    )
    np.testing.assert_array_equal(scene.render().data, by_hand.render().data)
    assert len(scene) == 2


@pytest.mark.parametrize("band", ["F770W", "F2550W"])
def test_bright_points_on_no_sky_are_exposed(band):
    """The splines of the PSF undershoot by some 1e-5 of the peak."""
    exposure = Exposure(band, n_groups=3, pointing="53.131 -27.831", subarray="SUB256")
    stars = {"ra": [53.1301, 53.1317], "dec": [-27.8312, -27.8301], "profile": "point"}
    ramp = Detector().expose(Scene(stars | {band: [200, 100] * u.uJy}, exposure), seed=1)
    assert ramp.shape == (1, 3, 256, 256)


def test_what_lacks_is_named(exposure):
    for catalog, options, message in (
        ({"F770W": FLUX * u.uJy}, {}, "a table with positions: 'sky'"),
        ({"ra": RA, "dec": [2.2, np.nan], "flux": FLUX * u.uJy}, {}, "finite positions, got 1"),
        ({"ra": RA, "dec": DEC}, {}, r"columns \['miri.f770w'\]"),
        ({"ra": RA, "dec": DEC}, {"exposure": None}, "'filter' must be given, or an exposure"),
        (3, {}, "'catalog' must be a table, a dict of columns"),
    ):
        refuses(message, Scene, catalog, **{"exposure": exposure} | options)
    catalog = {"ra": RA, "dec": DEC, "flux": FLUX * u.uJy, "profile": "point"}
    match = "'psf' must be given for a grid that is not that of an exposure"
    refuses(match, Scene, catalog, filter="F770W", wcs=exposure.wcs)


def test_psfs_of_others():
    y, x = np.mgrid[:21, :21]
    line = scenes.pixel_gaussian(21, 10, 0.85)
    expected = np.outer(line, line)
    kernel = Gaussian2DKernel(0.85, x_size=21, y_size=21, mode="oversample", factor=11)
    for given in (CircularGaussianPRF(fwhm=gaussian_sigma_to_fwhm * 0.85), kernel, expected):
        model = as_psf(given)
        model.x_0, model.y_0 = 10, 10
        np.testing.assert_allclose(model(x, y), expected, atol=2e-3 * expected.max())


def test_the_model_of_the_user_is_left_alone():
    model = MoffatPSF(flux=3.0, x_0=7.0, y_0=5.0, alpha=2.0, beta=3.0)
    assert as_psf(model).data.sum() == pytest.approx(16)
    assert (model.flux.value, model.x_0.value) == (3.0, 7.0)


def test_a_scene_with_another_setting_is_another(exposure):
    star = {"ra": [53.0], "dec": [-27.0], "flux": [20] * u.uJy, "profile": "point"}
    scene = Scene(star, exposure)
    bright = scene.replace(background=2 * u.MJy / u.sr)
    difference = bright.render().data - scene.render().data
    assert_allclose(difference, 2.0, rtol=1e-6)
    assert bright.exposure is exposure
    # columns of the catalog are found
    assert scene.catalog["F1500W" if scene.filter == "miri.f1500w" else "F770W"] == scene.flux
    assert scene.flux == scene.catalog[scene.filter]
    assert scene.sky.ra.deg == pytest.approx(53.0)
    refuses("has no argument 'nebula'; it has cat", scene.replace, nebula=3, error=TypeError)
