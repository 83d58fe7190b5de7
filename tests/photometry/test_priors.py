"""Segmentation maps and catalogues as others write them."""

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import QTable, Table
from numpy.testing import assert_array_equal

from helpers.errors import refuses, warned
from miricigale.instrument import north_up_wcs
from miricigale.photometry import read_prior
from miricigale.utils.exceptions import DataError

SHAPE, SCALE = (200, 220), 0.06
#: Ids as they come: large, with gaps, in no order.
IDS = np.array([150605, 7, 2_000_000_123, 42])
PLACES = np.array([[40, 50], [150, 60], [60, 150], [170, 160]])  # x, y


@pytest.fixture
def prior(tools):
    wcs = north_up_wcs(tools.CENTER, SCALE * u.arcsec, SHAPE)
    sky = wcs.pixel_to_world(*PLACES.T)
    data = tools.render(sky, np.full(4, 10.0), 0.12, wcs, SHAPE)
    labels = np.zeros(SHAPE, np.int64)
    y, x = np.indices(SHAPE)
    for one, (a, b) in zip(IDS, PLACES, strict=True):
        # a segment that is no circle about its source
        labels[((x - a - 2) ** 2 + (y - b) ** 2) < 100] = one
    return tools.as_ccd(data, wcs, 1e-3, meta={"source": "prior.fits"}), labels, sky


def save(folder, labels, wcs, *, name="seg.fits", shift=0.0, dtype=np.int64):
    header = None
    if wcs is not None:
        header = wcs.to_header()
        header["CRPIX1"] += shift
    fits.writeto(folder / name, labels.astype(dtype), header)
    return folder / name


def test_segments_of_any_ids_are_sources_at_their_bright_parts(prior, tmp_path):
    image, labels, sky = prior
    path = save(tmp_path, labels, image.wcs)
    segments, sources = read_prior(image, segmentation=path)
    assert sorted(sources["id"]) == sorted(IDS)
    assert segments.max() == len(sources) == 4
    for row in sources:
        k = list(IDS).index(row["id"])
        assert row["sky"].separation(sky[k]) < 0.01 * u.arcsec
        assert_array_equal(segments == row["label"], labels == IDS[k])


@pytest.mark.parametrize("form", ["fits", "ecsv", "csv", "cat", "skycoord"])
def test_catalogues_of_all_forms_keep_their_ids(prior, tmp_path, form):
    image, labels, sky = prior
    path = tmp_path / ("table.ecsv" if form == "skycoord" else f"table.{form}")
    if form == "skycoord":
        QTable({"ID": IDS, "position": sky.galactic}).write(path)
    else:
        table = Table({"id": IDS, "RA": sky.ra.deg, "DEC": sky.dec.deg})
        if form == "ecsv":
            table["RA"], table["DEC"] = sky.ra.rad, sky.dec.rad
            table["RA"].unit = table["DEC"].unit = "rad"
        table.write(path, format="ascii.commented_header" if form == "cat" else None)
    seg = save(tmp_path, labels, image.wcs)
    segments, sources = read_prior(image, segmentation=seg, catalog=path)
    assert list(sources["id"]) == list(IDS)
    assert np.all(sources["sky"].separation(sky) < 1 * u.mas)
    for row, one in zip(sources, IDS, strict=True):
        assert_array_equal(segments == row["label"], labels == one)
    assert read_prior(image, catalog=path)[0] is None
    again, _ = read_prior(image, segmentation=labels, catalog=path)
    assert_array_equal(again, segments)


def write_csv(path, ids, sky):
    Table({"id": ids, "ra": sky.ra.deg, "dec": sky.dec.deg}).write(path, overwrite=True)
    return path


def test_segments_belong_by_id_or_by_position(prior, tmp_path):
    image, labels, sky = prior
    seg = save(tmp_path, labels, image.wcs)
    # one source just beyond its own segment keeps it by its id
    moved = SkyCoord([sky[0].directional_offset_by(0 * u.deg, 1 * u.arcsec), *sky[1:]])
    path = write_csv(tmp_path / "a.csv", IDS, moved)
    segments, sources = read_prior(image, segmentation=seg, catalog=path)
    assert_array_equal(segments == sources["label"][0], labels == IDS[0])
    # ids of another catalogue say nothing of the segments
    path = write_csv(tmp_path / "b.csv", [7, 42, 150605, 5], sky)
    segments, sources = read_prior(image, segmentation=seg, catalog=path)
    for row, one in zip(sources, IDS, strict=True):
        assert_array_equal(segments == row["label"], labels == one)


def test_what_is_not_measured_is_said(prior, tmp_path):
    image, labels, sky = prior
    seg = save(tmp_path, labels, image.wcs)
    short = write_csv(tmp_path / "a.csv", IDS[:3], sky[:3])
    message = r"1 segments of .* belong to no source .*\(ids 42\)"
    _, sources = warned(message, read_prior, image, segmentation=seg, catalog=short)
    assert len(sources) == 3
    away = SkyCoord([*sky, sky[0].directional_offset_by(0 * u.deg, 5 * u.arcmin)])
    longer = write_csv(tmp_path / "b.csv", [*IDS, 1], away)
    _, sources = read_prior(image, segmentation=seg, catalog=longer)
    assert sources["label"][4] == 0


def test_a_prior_on_other_pixels_is_refused_by_name(prior, tmp_path):
    image, labels, _ = prior
    cases = [
        ({"shift": 2.0}, r"moved.fits is not on the pixels of prior.fits: .* 2 pixels apart"),
        ({"cut": 10}, r"moved.fits \(the segmentation\) has the shape .* not on the same pixels"),
        ({"scale": 0.5}, "values that are no whole numbers"),
        ({"scale": -1}, "negative ids"),
        ({"scale": 0}, "has no segment"),
        ({"dtype": np.float32}, "ids above 2\\^24 in single precision"),
    ]
    for change, message in cases:
        cut, scale = change.pop("cut", 0), change.pop("scale", 1)
        dtype = change.pop("dtype", np.float64 if scale == 0.5 else np.int64)
        path = tmp_path / "moved.fits"
        path.unlink(missing_ok=True)
        save(tmp_path, (labels * scale)[cut:], image.wcs, name=path.name, dtype=dtype, **change)
        refuses(message, read_prior, image, error=DataError, segmentation=path)


def test_catalogues_that_cannot_be_used_are_refused(prior, tmp_path):
    image, _, sky = prior
    path = tmp_path / "a.csv"
    Table({"id": IDS, "x": PLACES[:, 0]}).write(path)
    refuses(r"a.csv' must be a table with positions: 'sky'", read_prior, image, catalog=path)
    with pytest.raises(ValueError, match="ids are unique"):
        read_prior(image, catalog=write_csv(tmp_path / "b.csv", [1, 1, 2, 3], sky))
    Table({"ra": ["10:61:00"], "dec": ["-27:00:00"]}).write(tmp_path / "c.csv")
    match = "angles in 'ra', got 10:61:00 in row 0"
    refuses(match, read_prior, image, catalog=tmp_path / "c.csv")
    with pytest.raises(DataError, match=r"absent.csv cannot be read as a table: no such file"):
        read_prior(image, catalog=tmp_path / "absent.csv")
    refuses("'segmentation' or 'catalog' must be given", read_prior, image)
