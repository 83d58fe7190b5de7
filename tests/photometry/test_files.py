"""Results come back as they were: from files, pickles and copies."""

import copy
import dataclasses
import pickle

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io.registry import IORegistryError
from astropy.nddata import CCDData
from astropy.table import QTable, Table
from numpy.testing import assert_array_equal

from helpers.errors import refuses
from miricigale.instrument import north_up_wcs
from miricigale.photometry import (
    ErrorModel,
    ErrorSettings,
    ForcedPhotometer,
    ForcedPhotometryResult,
)
from miricigale.utils.exceptions import DataError

OPTIONS = {
    "plain": {},
    "all": {
        "background_order": 1,
        "max_shift": 0.2 * u.arcsec,
        "components": 2,
        "second_pass": True,
        "positive": True,
    },
    "map": {
        "max_shift": 0.2 * u.arcsec,
        "offset_order": 0,
        "errors": ErrorSettings(correlated_noise=False),
    },
}


@pytest.fixture(scope="module", params=OPTIONS)
def result(request, tools, field):
    rng = np.random.default_rng(5)
    image = field.image.copy()
    image.meta["filter"] = "miri.f770w"
    image.data = image.data + rng.normal(0, 0.01, image.shape)
    image.mask = np.zeros(image.shape, bool)
    image.mask[3:9, :40] = True
    catalog = field.catalog[: 55 if request.param == "all" else None]
    if request.param == "all":
        catalog["components"] = np.where(np.arange(len(catalog)) == 3, 2, 1)
    options = OPTIONS[request.param]
    return ForcedPhotometer(tools.kernel, template="psf", **options).measure(image, catalog=catalog)


def check(one, other):
    """Every field of a result, by what kind it is."""
    for name in (field.name for field in dataclasses.fields(one)):
        mine, theirs = getattr(one, name), getattr(other, name)
        same_value(name, mine, theirs)
    assert_array_equal(one.sample(3, seed=1).value, other.sample(3, seed=1).value)
    assert_array_equal(one.chi2_image.data, other.chi2_image.data)


def same_value(name, mine, theirs):
    assert (mine is None) == (theirs is None), name
    if mine is None:
        return
    if isinstance(mine, SkyCoord):
        assert_array_equal(mine.icrs.ra.deg, theirs.icrs.ra.deg)
        assert_array_equal(mine.icrs.dec.deg, theirs.icrs.dec.deg)
    elif isinstance(mine, CCDData):
        assert mine.unit == theirs.unit
        assert mine.meta == theirs.meta
        x = np.array([0.0, 100.0])
        assert_array_equal(*(one.wcs.pixel_to_world_values(x, x) for one in (mine, theirs)))
        same_value(name, mine.data, theirs.data)
        same_value(name, mine.mask, theirs.mask)
        if mine.uncertainty is not None:
            same_value(name, mine.uncertainty.array, theirs.uncertainty.array)
    elif isinstance(mine, Table):
        assert mine.colnames == theirs.colnames
        for column in mine.colnames:
            same_value(column, mine[column], theirs[column])
    elif hasattr(mine, "toarray"):
        assert type(mine) is type(theirs)
        assert_array_equal(mine.toarray(), theirs.toarray())
    elif dataclasses.is_dataclass(mine):
        for one in dataclasses.fields(mine):
            if one.name != "wcs":
                same_value(one.name, getattr(mine, one.name), getattr(theirs, one.name))
    elif isinstance(mine, (dict, int, tuple)):
        assert mine == theirs
    else:
        assert getattr(mine, "unit", None) == getattr(theirs, "unit", None)
        assert_array_equal(np.asarray(mine), np.asarray(theirs))
        assert np.asarray(mine).dtype == np.asarray(theirs).dtype, name


def test_result_comes_back(result, tmp_path):
    path = tmp_path / "r.fits"
    result.write(path)
    check(result, ForcedPhotometryResult.read(path))
    check(result, pickle.loads(pickle.dumps(result)))
    check(result, copy.deepcopy(result))
    check(result, copy.copy(result))
    refuses("overwrite", result.write, path, error=OSError)
    before = path.read_bytes()
    result.write(path, overwrite=True)
    assert path.read_bytes() == before


def test_names_say_what_is_written(result, tmp_path):
    result.write(tmp_path / "r.ecsv")
    table = QTable.read(tmp_path / "r.ecsv")
    assert_array_equal(table["flux"].value, result.flux.value)
    assert table["flux_err"].info.description == "1-sigma error of the flux"
    result.write(tmp_path / "r.csv")
    assert_array_equal(QTable.read(tmp_path / "r.csv")["flux"], result.flux.value)
    for name in ("r.txt", "r"):
        with pytest.raises(ValueError, match=r"a file ending in one of \.fits"):
            result.write(tmp_path / name)
        assert not (tmp_path / name).exists()
    with pytest.raises(IORegistryError):
        ForcedPhotometryResult.read(tmp_path / "r.ecsv")
    ErrorModel.yang2021().write(tmp_path / "e.fits")
    assert len(QTable.read(tmp_path / "e.fits")) == len(ErrorModel.yang2021().to_table())


def test_other_programs_find_the_table_first(result, tmp_path):
    """What opens the first extension of a file with all of a result has its table."""
    result.write(tmp_path / "r.fits")
    first = QTable.read(tmp_path / "r.fits", hdu=1)
    table = result.to_table()
    assert first.colnames == table.colnames
    assert_array_equal(first["flux"], table["flux"])
    assert_array_equal(first["sky"].ra, table["sky"].ra)
    assert_array_equal(ForcedPhotometryResult.read(tmp_path / "r.fits").flux, result.flux)


def test_nothing_to_measure_can_be_kept(tools, tmp_path):
    wcs = north_up_wcs(tools.CENTER, 0.11 * u.arcsec, (60, 60))
    image = tools.as_ccd(np.random.default_rng(1).normal(0, 0.1, (60, 60)), wcs, 0.1)
    catalog = QTable({"sky": SkyCoord([], [], unit="deg")})
    result = ForcedPhotometer(tools.kernel, template="psf").measure(image, catalog=catalog)
    result.write(tmp_path / "r.fits")
    assert len(ForcedPhotometryResult.read(tmp_path / "r.fits")) == 0
    image.write(tmp_path / "image.fits")
    with pytest.raises(DataError, match="holds no forced photometry"):
        ForcedPhotometryResult.read(tmp_path / "image.fits")
