"""Dither patterns by name, from tables and from APT's list of pointings."""

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import QTable
from astropy.wcs import WCS
from numpy.testing import assert_allclose

from helpers.errors import refuses
from miricigale.instrument import (
    Exposure,
    dither_offsets,
    imager_columns,
    read_centers,
    read_dithers,
    tile_offsets,
)
from miricigale.utils.exceptions import DataError

PIXEL = np.array([0.110497, 0.111336])
HEADER = (
    "Tar Tile Exp Dith Aperture Name             Target       RA         Dec        BaseX    BaseY"
    "    DithX    DithY    V2       V3       IdlX     IdlY   Level      Type      ExPar  DkPar   dDist"
)
ROW = (
    "  1    1   {exp}    {dith} {aperture}              1 FIELD  +80.48750  -69.49750   +0.000   +0.000"
    "   {x:+.3f}   {y:+.3f}  -453.559 -373.814   {x:+.3f}   {y:+.3f} DITHER  {kind}        0      0  0.215"
)


def pointing_list(path, rows_by_observation):
    lines = ["# APT Output Product", "=" * 40]
    for number, rows in rows_by_observation.items():
        lines += [f"* Deep field (Obs {number})", f"** Visit {number}:1", HEADER]
        lines += [ROW.format(**row) for row in rows] + [""]
    path.write_text("\n".join(lines))
    return path


def row(dith, x, y, *, exp=1, aperture="MIRIM_FULL", kind="SCIENCE"):
    return {"dith": dith, "x": x, "y": y, "exp": exp, "aperture": aperture, "kind": kind}


@pytest.mark.parametrize(
    ("name", "limit"), [("cycling-small", 11), ("cycling-medium", 64), ("cycling-large", 128)]
)
def test_cycling_spreads_over_its_circle_and_the_pixel(name, limit):
    points = dither_offsets(name).value / PIXEL
    assert points.shape == (311, 2)
    assert len(np.unique(points.round(3), axis=0)) > 0.8 * 311
    radius = np.hypot(*points.T)
    assert 0.8 * limit < radius.max() <= limit
    assert_allclose(points.mean(axis=0), 0, atol=0.06 * limit)
    # four in a row sample the pixel by halves
    for k in (0, 40, 200):
        phases = np.round(points[k : k + 4] % 1, 3) % 1
        assert {tuple(p) for p in phases} == {(0, 0), (0.5, 0), (0.5, 0.5), (0, 0.5)}
    # any stretch goes round: all four quadrants within sixteen points
    for k in range(0, 290, 37):
        quadrants = {(a > 0, b > 0) for a, b in points[k : k + 16]}
        assert len(quadrants) == 4
    if name == "cycling-small":
        assert radius.min() > 3


def test_cycling_goes_on_from_tile_to_tile():
    every = dither_offsets("cycling-medium", 20)
    first = dither_offsets("cycling-medium", 12)
    then = dither_offsets("cycling-medium", 8, start=12)
    assert_allclose(np.vstack([first, then]).value, every.value)
    field = SkyCoord(53.1, -27.8, unit="deg")
    base = Exposure("miri.f2100w", n_groups=10, pointing=field, roll=20 * u.deg)
    tile = base.dithered("cycling-medium", 3, first=12, start=12)
    assert [one.dither for one in tile] == [12, 13, 14]
    for one, (dx, dy) in zip(tile, then[:3].value, strict=True):
        x, y = one.wcs.world_to_pixel(field)
        assert_allclose([x - 692.5, y - 511.5], [-dx / 0.1105, -dy / 0.1113], atol=0.7)


def test_all_of_a_pattern_by_default():
    assert dither_offsets("4-point").shape == (4, 2)
    offsets = [[0, 0], [1, 2], [3, 4]]
    assert dither_offsets(offsets * u.arcsec, start=1).value.tolist() == offsets[1:]


@pytest.mark.parametrize("suffix", ["ecsv", "fits"])
def test_a_table_and_its_file(tmp_path, suffix):
    table = QTable({"x_offset": [0, 1, -2.5] * u.arcsec, "y_offset": [0, 0.02, 0.03] * u.arcmin})
    truth = [[0, 0], [1, 1.2], [-2.5, 1.8]]
    assert_allclose(dither_offsets(table).value, truth)
    path = tmp_path / f"dithers.{suffix}"
    table.write(path)
    assert_allclose(read_dithers(path).value, truth)
    assert_allclose(dither_offsets(path, 2).value, truth[:2])
    for name in ("observation", "exposure"):
        refuses(f"'{name}' must be left out, but for a .pointing", read_dithers, path, **{name: 1})
    path.write_text("nonsense")
    refuses("cannot be read as a table", read_dithers, path, error=DataError)


def test_a_list_of_pointings(tmp_path):
    rows = [
        row(1, 0.0, 0.0, kind="T_ACQ"),
        row(1, 1.101, -0.25),
        row(1, 1.101, -0.25, exp=2),
        row(2, -1.601, 3.0),
        row(2, 9.0, 9.0, aperture="NRCALL_FULL"),
        row(3, 0.5, -2.75, kind="PARALLEL"),
        # another filter at the same places
        row(2, -1.601, 3.0, exp=2),
        row(3, 0.5, -2.75, exp=2),
    ]
    path = pointing_list(tmp_path / "plan.pointing", {4: rows})
    truth = [[-1.101, 0.25], [1.601, -3.0], [-0.5, 2.75]]
    assert_allclose(read_dithers(path).value, truth)
    assert_allclose(dither_offsets(path).value, truth)
    several = pointing_list(tmp_path / "two.pointing", {4: rows, 7: rows[:4]})
    found = read_dithers(several, observation=7, exposure=1)
    assert_allclose(np.diff(found.value, axis=0), [[2.702, -3.25]])
    # all exposures have these
    assert_allclose(read_dithers(path, exposure=1).value, truth)
    refuses(r"'observation' must be one of \[4, 7\], got None", read_dithers, several)
    other = pointing_list(tmp_path / "nircam.pointing", {1: rows[4:5]})
    match = r"no exposures of MIRIM apertures; it has \['NRCALL_FULL'\]"
    refuses(match, read_dithers, other, error=DataError)


@pytest.mark.filterwarnings("ignore:.*made the change:astropy.wcs.FITSFixedWarning")
def test_pointings_of_a_list_are_where_an_exposure_in_flight_was(tmp_path, data_file):
    """By XOFFSET and YOFFSET of its header, with which other dithers of the list have no part."""
    path = data_file("real/i2d/jw01288015001_04101_00001_mirimage_i2d.fits")
    first, second = (fits.getheader(path, name) for name in (0, "SCI"))
    assert np.hypot(first["XOFFSET"], first["YOFFSET"]) > 15
    place = f"{first['TARG_RA']:+.5f}  {first['TARG_DEC']:+.5f}"
    lines = ["* Orion Bar (Obs 15)", HEADER]
    for dith, x, y in ((1, first["XOFFSET"], first["YOFFSET"]), (2, 4.0, 9.0)):
        lines.append(ROW.format(**row(dith, x, y)).replace("+80.48750  -69.49750", place))
    plan = tmp_path / "plan.pointing"
    plan.write_text("\n".join(lines))
    roll = (second["PA_APER"] - 4.83545) * u.deg
    (center,), _ = read_centers(plan, roll)
    base = Exposure("F1130W", n_groups=5, pointing=center, roll=roll, subarray="SUB128")
    exposure = base.dithered(read_dithers(plan))[0]
    # the middle of the sub-array's part that sees the sky
    seen = WCS(second).celestial.pixel_to_world(68.3, 64.5)
    assert seen.separation(exposure.wcs.pixel_to_world(69.5, 64.5)) < 0.3 * u.arcsec


@pytest.mark.parametrize("overlap", [0.0, 0.2])
def test_tiles_meet_on_the_sky(overlap):
    """Edges of the imager's field, by the distorted WCS of each tile, about which the offsets know nothing."""
    center = SkyCoord(0.01, -60.0, unit="deg")
    base = Exposure("miri.f770w", n_groups=5, pointing=center, roll=40 * u.deg)
    tiles = base.dithered(tile_offsets(2, 3, overlap=overlap))
    assert [tile.dither for tile in tiles] == [0, 1, 2, 3, 4, 5]
    first, last = imager_columns()
    ny, middle = base.shape[0], 0.5 * (first + last - 1)
    # the columns (rows) of two neighbors that share the same sky in the middle of the edge
    for one, two, here, there in (
        (0, 1, (last - 0.5 - overlap * (last - first), 510), (first - 0.5, 510)),
        (0, 2, (middle, ny - 0.5 - overlap * ny), (middle, -0.5)),
    ):
        places = [tiles[k].wcs.pixel_to_world(*xy) for k, xy in ((one, here), (two, there))]
        apart = places[0].separation(places[1])
        # edges bend by a per cent of the field, and +x of the sky may be either way of the columns
        assert apart < 1.5 * u.arcsec
    mean = np.mean([tile.pointing.cartesian.xyz.value for tile in tiles], axis=0)
    found = SkyCoord(*mean, representation_type="cartesian")
    assert found.separation(center) < 0.01 * u.arcsec


def test_exposures_of_a_list_with_dithers_of_their_own(tmp_path):
    patterns = {1: [(-1.446, 3.956), (3.771, -5.358), (1.035, 4.889)]}
    patterns[2] = [(2.983, -21.46), (1.08, -11.849)]
    rows = [
        row(dith, *offset, exp=exp, aperture="MIRIM_ILLUM")
        for exp, offsets in patterns.items()
        for dith, offset in enumerate(offsets, start=1)
    ]
    path = pointing_list(tmp_path / "plan.pointing", {1: rows})
    middle = np.mean([place for places in patterns.values() for place in places], axis=0)
    for exp, places in patterns.items():
        assert_allclose(read_dithers(path, exposure=exp).value, middle - places)
    for exposure in (None, 3):
        match = rf"'exposure' must be one of \[1, 2\], got {exposure}"
        refuses(match, read_dithers, path, exposure=exposure)


def test_tiles_have_one_pattern_or_none(tmp_path):
    """Places of a mosaic of 2 x 1 as APT lists them (M51 of the examples of mirage)."""
    tiles = [
        [(-57.221, -82.6), (0.779, -59.1), (58.779, -35.6)],
        [(-58.779, 35.6), (-0.779, 59.1), (57.221, 82.6)],
    ]
    path, lines = tmp_path / "plan.pointing", ["* Deep field (Obs 1)", HEADER]
    for number, places in enumerate(tiles, start=1):
        rows = [ROW.format(**row(k, *place)) for k, place in enumerate(places, start=1)]
        lines += [f"  1    {number}" + text[8:] for text in rows]
    path.write_text("\n".join(lines))
    assert_allclose(read_dithers(path).value, [[58, 23.5], [0, 0], [-58, -23.5]], atol=1e-9)
    path.write_text("\n".join(lines).replace("+57.221", "+57.321"))
    refuses(r"plan\.pointing: tiles of the observation have dithers", read_dithers, path)
    path.write_text("\n".join(lines).replace("+57.221", "+57.2{21"))
    with pytest.raises(ValueError, match=r"could not convert .*57\.2\{21") as caught:
        read_dithers(path)
    assert caught.value.__notes__ == [f"in {path}"]


def test_centers_of_a_list_have_the_target_where_the_list_has_it(tmp_path):
    """At its distance and angle from +y, which is V3IdlYAngle from V3 (SIAF: 4.835 deg for MIRIM_FULL)."""
    prime = [row(1, 100.0, 50.0, aperture="MIRIM_ILLUM"), row(2, 104.0, 46.0, exp=2)]
    beside = [row(1, 0.0, 0.0, aperture="NRCBS_FULL"), row(1, -380.417, -90.488, kind="PARALLEL")]
    extra = [row(1, 9.0, 9.0, kind="T_ACQ"), row(1, 9.0, 9.0, aperture="MIRIM_SUB256")]
    path = pointing_list(tmp_path / "plan.pointing", {3: prime + extra, 8: beside})
    target, roll = SkyCoord(80.48750, -69.49750, unit="deg"), 200 * u.deg
    centers, others = read_centers(path, roll)
    assert others == ["MIRIM_FULL (T_ACQ)", "MIRIM_SUB256 (SCIENCE)", "NRCBS_FULL (SCIENCE)"]
    for center, (x, y) in zip(centers, [(102.0, 48.0), (-380.417, -90.488)], strict=True):
        assert_allclose(center.separation(target).arcsec, np.hypot(x, y), atol=2e-3)
        angle = center.position_angle(target) - roll - 4.83545 * u.deg + np.arctan2(x, y) * u.rad
        assert_allclose(np.sin(angle) * np.hypot(x, y), 0, atol=2e-3)
        assert np.cos(angle) > 0.99
    pointing_list(path, {1: beside[:1]})
    match = r"no exposures of the full imager; it has \['NRCBS_FULL \(SCIENCE\)'\]"
    refuses(match, read_centers, path, roll, error=DataError)


OFFSETS = [[0, 0], [1, 2]] * u.arcsec
BARE = QTable({"x_offset": [1.0], "y_offset": [1.0]})
WANTED = r"offsets of shape \(3, 2"


@pytest.mark.parametrize(
    ("function", "args", "options", "error", "match"),
    [
        (tile_offsets, [2, 2], {"overlap": 1}, ValueError, "'overlap' must be at least 0 and less"),
        (read_dithers, ["nothing.ecsv"], {}, DataError, "no file of dithers"),
        (dither_offsets, [BARE[["x_offset"]]], {}, ValueError, "'pattern' must be .*'y_offset'"),
        (dither_offsets, ["spiral", 3], {}, KeyError, "no dither pattern 'spiral'; known: 4-point"),
        (dither_offsets, [OFFSETS, 3], {}, ValueError, rf"'pattern' must be {WANTED}"),
        (dither_offsets, [OFFSETS, 2], {"start": 1}, ValueError, f"must be {WANTED}"),
    ],
)
def test_refuses(function, args, options, error, match):
    refuses(match, function, *args, error=error, **options)
