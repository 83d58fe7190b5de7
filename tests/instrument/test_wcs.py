"""World coordinates against closed forms, the full transformation and pysiaf."""

import io
import os
import subprocess
import sys

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.wcs import WCS
from numpy.testing import assert_allclose

from helpers.errors import refuses
from miricigale.instrument import (
    Exposure,
    aperture,
    attitude_matrix,
    ceers_exposures,
    imager_columns,
    imager_wcs,
    mosaic_wcs,
    north_up_wcs,
    pixel_area_map,
    pixel_to_sky,
    pixel_to_v2v3,
    subarrays,
    tangent_offset,
    v2v3_to_sky,
)
from miricigale.instrument.asdf_extension import imager_gwcs
from miricigale.instrument.wcs import chebyshev_pixels

FIELD = SkyCoord(53.1344, -27.83444, unit="deg")
ROLL = 35 * u.deg
# SIAF PRDOPSSOC-075, MIRIM_FULL
V3_IDEAL_Y_ANGLE = 4.83544897
SR_TO_ARCSEC2 = (180 * 3600 / np.pi) ** 2


def grid(subarray, n=25):
    ny, nx = aperture(subarray).shape
    return np.meshgrid(np.linspace(-0.5, nx - 0.5, n), np.linspace(-0.5, ny - 0.5, n))


@pytest.mark.parametrize("subarray", subarrays())
def test_reference_pixel_looks_at_the_pointing(subarray):
    x, y = aperture(subarray).reference
    sky = pixel_to_sky(x, y, FIELD, ROLL, subarray=subarray)
    assert sky.separation(FIELD) < 1e-6 * u.arcsec


@pytest.mark.parametrize("roll", [0.0, 35.0, 212.0])
def test_position_angle_of_the_columns(roll):
    x, y = aperture("FULL").reference
    up = pixel_to_sky(x, y + 1, FIELD, roll * u.deg)
    # the column leans from ideal +y towards ideal +x (clockwise on the sky: parity -1) by
    # the ratio of the linear terms of the SIAF
    lean = np.degrees(np.arctan2(-3.076759730923348e-04, 1.113355037982930e-01))
    expected = roll + V3_IDEAL_Y_ANGLE - lean
    assert_allclose(FIELD.position_angle(up).deg, expected % 360, atol=1e-3)
    # 0.111336" a row
    assert_allclose(FIELD.separation(up).arcsec, 0.111336, atol=2e-6)


def test_columns_turn_over_the_field_as_the_page_says():
    exposure = Exposure("F770W", n_groups=10, pointing=FIELD, roll=ROLL)
    x, y = map(np.ravel, np.meshgrid(np.linspace(359, 1031, 13), np.linspace(2, 1020, 13)))
    low, high = (exposure.wcs.pixel_to_world(x, y + step) for step in (-1, 1))
    turn = (low.position_angle(high) - exposure.pa_aper).wrap_at("180d").deg
    assert turn.min() == pytest.approx(-0.17, abs=0.01)
    assert turn.max() == pytest.approx(0.47, abs=0.01)


def test_parity_is_that_of_the_sky():
    # north up: +x points west
    x, y = aperture("FULL").reference
    right = pixel_to_sky(x + 10, y, FIELD, -V3_IDEAL_Y_ANGLE * u.deg)
    assert right.ra < FIELD.ra
    assert_allclose(FIELD.position_angle(right).deg, 270, atol=0.4)


def test_attitude_turns_v3_to_the_roll():
    matrix = attitude_matrix(53.0, -27.0, 35.0, v2=-453.0, v3=-373.0)
    assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-15)
    assert_allclose(v2v3_to_sky(-453.0, -373.0, matrix), (53.0, -27.0), atol=1e-12)
    here = SkyCoord(53, -27, unit="deg")
    for v2, v3, expected in ((-453.0, -372.0, 35.0), (-452.0, -373.0, 125.0)):
        there = SkyCoord(*v2v3_to_sky(v2, v3, matrix), unit="deg")
        assert_allclose(here.position_angle(there).deg, expected, atol=1e-3)
        assert_allclose(here.separation(there).arcsec, 1, rtol=1e-5)


@pytest.mark.parametrize("subarray", subarrays())
@pytest.mark.parametrize("place", [(53.1344, -27.83444), (0.0, 89.9), (359.999, 2.0)])
def test_sip_equals_the_full_transformation(subarray, place):
    pointing = SkyCoord(*place, unit="deg")
    x, y = grid(subarray)
    wcs = imager_wcs(pointing, 123 * u.deg, subarray=subarray)
    sky = pixel_to_sky(x, y, pointing, 123 * u.deg, subarray=subarray)
    assert wcs.pixel_to_world(x, y).separation(sky).max() < 1e-7 * u.arcsec
    # and back
    assert_allclose(wcs.all_world2pix(sky.ra.deg, sky.dec.deg, 0), (x, y), atol=1e-4)


def test_inverse_polynomials():
    # without iteration AP, BP alone bring a pixel back
    wcs = imager_wcs(FIELD, ROLL)
    places = np.reshape(grid("FULL"), (2, -1)).T
    u_v = wcs.wcs_world2pix(wcs.all_pix2world(places, 0), 0)
    back = wcs.sip_foc2pix(u_v - wcs.wcs.crpix + 1, 1)
    assert_allclose(back - 1, places, atol=2e-4)


def test_header_holds_the_whole_wcs():
    wcs = imager_wcs(FIELD, ROLL)
    again = WCS(wcs.to_header(relax=True))
    x, y = grid("FULL")
    assert_allclose(again.all_pix2world(x, y, 0), wcs.all_pix2world(x, y, 0), atol=1e-11)
    assert wcs.pixel_shape == (1032, 1024)


def test_subarrays_look_where_their_pixels_of_the_full_frame_look():
    for name in subarrays():
        part = aperture(name)
        v2, v3 = pixel_to_v2v3(*part.reference, subarray=name)
        assert_allclose((v2, v3), (part.v2, part.v3), atol=1e-5)


def test_pixel_areas_vary_as_published():
    area = pixel_area_map(imager_wcs(FIELD, ROLL), (1024, 1032))
    assert_allclose(area[512, 692] * SR_TO_ARCSEC2, 0.110498 * 0.111336, rtol=1e-4)
    area = area[:, slice(*imager_columns())]
    median = np.median(area)
    assert_allclose(area.min() / median - 1, -0.030, atol=0.0015)
    assert_allclose(area.max() / median - 1, 0.008, atol=0.0015)


def test_pixel_areas_sum_to_the_area_of_the_frame():
    wcs = imager_wcs(FIELD, ROLL)
    total = pixel_area_map(wcs, (1024, 1032)).sum()
    # polygon of the rim in the equal-area plane about the middle
    t = np.linspace(0, 1, 400, endpoint=False)
    rim = np.concatenate([t, np.ones(400), 1 - t, np.zeros(400)])
    sky = wcs.pixel_to_world(rim * 1032 - 0.5, np.roll(rim, 400) * 1024 - 0.5)
    r = 2 * np.sin(FIELD.separation(sky).rad / 2)
    pa = FIELD.position_angle(sky).rad
    px, py = r * np.sin(pa), r * np.cos(pa)
    polygon = 0.5 * abs(np.sum(px * np.roll(py, -1) - py * np.roll(px, -1)))
    assert_allclose(total, polygon, rtol=1e-6)


def test_north_up_grid():
    wcs = north_up_wcs(FIELD, 0.06 * u.arcsec, (301, 401))
    assert wcs.pixel_shape == (401, 301)
    assert wcs.pixel_to_world(200, 150).separation(FIELD) < 1e-7 * u.arcsec
    up = FIELD.position_angle(wcs.pixel_to_world(200, 200))
    assert_allclose(up.wrap_at("180d").deg, 0, atol=1e-6)
    assert wcs.pixel_to_world(100, 150).ra > FIELD.ra


def test_area_of_a_gnomonic_pixel():
    # scale^2 cos^3 of the distance to the tangent point
    scale = 60 * u.arcsec
    area = pixel_area_map(north_up_wcs(FIELD, scale, (101, 151)), (101, 151))
    y, x = np.mgrid[-50:51, -75:76]
    rho = scale.to_value(u.rad) * np.hypot(x, y)
    assert_allclose(area, scale.to_value(u.rad) ** 2 * np.cos(np.arctan(rho)) ** 3, rtol=1e-6)


def test_mosaic_holds_every_exposure_and_no_more():
    exposures = ceers_exposures(FIELD, ROLL, quick=True)
    wcs = mosaic_wcs(exposures, 0.11 * u.arcsec)
    nx, ny = wcs.pixel_shape
    skies = (exposure.wcs.pixel_to_world(*grid(exposure.subarray)) for exposure in exposures)
    x, y = np.concatenate([wcs.world_to_pixel(sky) for sky in skies], axis=1).reshape(2, -1)
    for values, n in ((x, nx), (y, ny)):
        assert -0.51 < values.min() < 1.5
        assert n - 2.5 < values.max() < n - 0.49


def test_offsets_follow_the_turned_axes():
    moved = tangent_offset(FIELD, [0, 3, 0] * u.arcmin, [2, 0, 0] * u.arcmin, 30 * u.deg)
    assert_allclose(FIELD.position_angle(moved[:2]).deg, [30, 300], atol=1e-9)
    expected = np.arctan(np.radians([2 / 60, 3 / 60, 0]))
    assert_allclose(FIELD.separation(moved).rad, expected, atol=1e-13)


def test_rejects_what_is_no_pointing():
    refuses("'pointing' must be one SkyCoord", imager_wcs, 53, ROLL)
    match = "'roll' must be a quantity convertible to deg"
    refuses(match, imager_wcs, FIELD, 35, error=u.UnitsError)
    match, other = "no sub-array 'SUB999'; known: BRIGHTSKY, FULL", {"subarray": "SUB999"}
    refuses(match, imager_wcs, FIELD, ROLL, error=KeyError, **other)
    refuses("'pixel_scale' must be positive", north_up_wcs, FIELD, 0 * u.arcsec, (3, 3))
    refuses("'exposures' must be at least one exposure", mosaic_wcs, [], 0.1 * u.arcsec)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("subarray", subarrays())
def test_equals_pysiaf(subarray):
    pysiaf = pytest.importorskip("pysiaf")
    siaf = pysiaf.Siaf("MIRI")[f"MIRIM_{subarray}"]
    x, y = (t.ravel() for t in grid(subarray))
    pointing = (FIELD.ra.deg, FIELD.dec.deg, ROLL.value)
    attitude = pysiaf.utils.rotations.attitude(siaf.V2Ref, siaf.V3Ref, *pointing)
    ra, dec = pysiaf.utils.rotations.tel_to_sky(attitude, *siaf.sci_to_tel(x + 1, y + 1))
    exposure = Exposure("miri.f770w", n_groups=5, subarray=subarray, pointing=FIELD, roll=ROLL)
    separation = exposure.wcs.pixel_to_world(x, y).separation(SkyCoord(ra, dec))
    assert separation.max() < 1e-6 * u.arcsec


def test_areas_filled_into_an_array_are_the_same():
    wcs = imager_wcs(FIELD, ROLL)
    for out, rtol in ((np.zeros((1024, 1032)), 1e-12), (np.zeros((1024, 1032), "f4"), 2e-7)):
        assert pixel_area_map(wcs, out.shape, out=out) is out
        assert_allclose(out, pixel_area_map(wcs, out.shape), rtol=rtol)


@pytest.mark.parametrize("subarray", ["FULL", "SUB64"])
def test_gwcs_of_an_image_is_its_wcs(subarray):
    pytest.importorskip("gwcs", reason="needs gwcs: pip install miricigale[gwcs]")
    exposure = Exposure("miri.f770w", n_groups=5, subarray=subarray, pointing="359.9999 -89.5")
    exact = imager_gwcs(exposure.wcs, exposure.shape, exposure.pointing_keywords())
    x, y = grid(subarray)
    sky = SkyCoord(*exact(x, y), unit="deg")
    assert sky.separation(exposure.wcs.pixel_to_world(x, y)).max() < 1e-4 * u.mas
    assert_allclose(
        exact.invert(sky.ra.deg, sky.dec.deg, with_bounding_box=False), [x, y], atol=1e-3
    )
    assert exact.available_frames == ["detector", "v2v3", "v2v3vacorr", "world"]


WRITTEN = """
from miricigale.instrument import Exposure
from miricigale.instrument.asdf_extension import asdf_extension
exposure = Exposure("miri.f770w", n_groups=5, subarray="SUB64", pointing="53 -27.8")
hdu = asdf_extension(exposure.wcs, exposure.shape, exposure.pointing_keywords())
text = hdu.data["ASDF_METADATA"][0].tobytes()
"""


@pytest.mark.slow
def test_gwcs_has_the_same_bytes_in_every_process():
    pytest.importorskip("gwcs", reason="needs gwcs: pip install miricigale[gwcs]")
    import asdf

    here = {}
    exec(WRITTEN, here)
    texts = [here["text"]]
    # the order of sets of strings differs between these
    for seed in (1, 2):
        done = subprocess.run(
            [sys.executable, "-c", f"import sys{WRITTEN}sys.stdout.buffer.write(text)"],
            env={**os.environ, "PYTHONHASHSEED": str(seed)},
            stdout=subprocess.PIPE,
            check=True,
        )
        texts.append(done.stdout)
    assert texts[0] == texts[1] == texts[2]
    with asdf.open(io.BytesIO(texts[0])) as file:
        used = [entry["extension_uri"] for entry in file["history"]["extensions"]]
        assert len(used) == len(set(used)) >= 4
        assert file["meta"]["wcs"].available_frames[-1] == "world"


def test_nodes_of_fits_lie_evenly_about_the_middle_of_the_image():
    """Between the outer edges of the pixels, and near them."""
    for nodes, n in zip(chebyshev_pixels((30, 50)), (50, 30), strict=True):
        assert_allclose(np.sort(nodes.ravel()), np.sort(n - 1 - nodes.ravel()), atol=1e-9)
        assert -0.5 < nodes.min() < -0.4
        assert n - 0.6 < nodes.max() < n - 0.5


def test_subarrays_have_their_names_of_the_siaf_too():
    assert aperture("MIRIM_SUB256") == aperture("SUB256")
    assert aperture("MIRIM_FULL").name == "FULL"
