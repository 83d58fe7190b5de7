"""Results come back as they were: from files, pickles and copies."""

import copy
import pickle

import astropy.units as u
import numpy as np
import pytest
from astropy.io.registry import IORegistryError
from astropy.table import QTable
from numpy.testing import assert_array_equal

from helpers.errors import refuses
from helpers.mosaics import WHITE
from helpers.results import assert_equal_values
from miricigale.photometry import ErrorModel, ForcedPhotometryResult
from miricigale.utils.exceptions import DataError

SHIFT = {"max_shift": 0.2 * u.arcsec}
OPTIONS = {
    "plain": {},
    "all": {"background_order": 1, "components": 2, "second_pass": True, **SHIFT},
    "map": {"offset_order": 0, "errors": WHITE, **SHIFT},
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
    return tools.measured(image, catalog, **OPTIONS[request.param])


def test_result_comes_back(result, tmp_path):
    path = tmp_path / "r.fits"
    result.write(path)
    chi2 = result.chi2_image.data
    again = ForcedPhotometryResult.read(path), pickle.loads(pickle.dumps(result))
    for one in (*again, copy.deepcopy(result), copy.copy(result)):
        assert_equal_values("result", result, one)
        assert_array_equal(result.sample(3, seed=1).value, one.sample(3, seed=1).value)
        assert_array_equal(one.chi2_image.data, chi2)
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
    result.write(tmp_path / "r.txt")
    assert_array_equal(QTable.read(tmp_path / "r.txt", format="ascii.ecsv")["flux"], result.flux)
    for name in ("r.doc", "r"):
        refuses(r"a file ending in one of \.fits", result.write, tmp_path / name)
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
    form = {"sigma": 0.1, "rng": np.random.default_rng(1)}
    image = tools.picture(tools.places([]), [], (60, 60), **form)
    tools.measured(image, tools.places([])).write(tmp_path / "r.fits")
    assert len(ForcedPhotometryResult.read(tmp_path / "r.fits")) == 0
    image.write(tmp_path / "image.fits")
    with pytest.raises(DataError, match="holds no forced photometry"):
        ForcedPhotometryResult.read(tmp_path / "image.fits")
