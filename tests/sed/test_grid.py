import copy
import pickle

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from miricigale.sed import ModelGrid
from miricigale.utils.exceptions import DataError


def make(**changes):
    values = {"filters": ("a", "b"), "redshift": [0.1, 0.2], "frac_agn": [0.0, 0.5]}
    values |= {"galaxy": np.ones((2, 3, 2)), "agn": np.full((2, 1, 2), 0.5)}
    values |= {"dust_luminosity": [1.0, 2.0, 3.0], "allowed": np.ones((2, 3), bool)}
    values |= {"agn_multiplicity": [3], "agn_parameters": QTable({"tau97": [3.0]})}
    values |= {"agn_properties": QTable({"accretion_power": [3.0]})}
    for name, column in (("galaxy_parameters", "tau"), ("galaxy_properties", "sfr")):
        values[name] = QTable({column: [1.0, 2.0, 3.0]})
    return ModelGrid(**(values | changes))


def test_flux_is_the_stated_sum():
    assert_allclose(make().flux(0, 2, 0, 1), 1.0 + 1.0 * 3.0 * 0.5)
    assert make().flux(0, [0, 1], 0, 1).shape == (2, 2)
    assert make().n_models == 2 * 3 * 2 * 3


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"redshift": [0.2, 0.1]}, "'redshift' must be ascending"),
        ({"galaxy": np.ones((2, 3, 3))}, r"'galaxy' must be of shape \(2, 3, 2\)"),
        ({"frac_agn": [0.0, 1.0]}, r"'frac_agn' must be ascending values in \[0, 1\)"),
        ({"agn_multiplicity": [0]}, "'agn_multiplicity' must be >= 1"),
        ({"galaxy": np.full((2, 3, 2), np.nan)}, "'galaxy' must be finite"),
        ({"agn_parameters": QTable()}, "'agn_parameters' must be a table of 1 rows"),
        ({"filters": ("a", "a")}, "'filters' must be one or more different names"),
        ({"inert": [(), ()]}, "'inert' must be names for each of 1 AGN models, got 2"),
        ({"frac_agn_definition": "all"}, "'frac_agn_definition' must be one of"),
    ],
)
def test_arrays_that_do_not_agree_are_refused(changes, match):
    refuses(match, make, **changes)


def test_foreign_and_truncated_files_are_refused(tmp_path):
    fits.PrimaryHDU(np.zeros(3)).writeto(tmp_path / "other.fits")
    (tmp_path / "text.fits").write_text("text")
    for name, text in (("text", ""), ("none", "no such file")):
        match = rf"{name}\.fits cannot be read as model grid data: {text}"
        refuses(match, ModelGrid.read, tmp_path / f"{name}.fits", error=DataError)
    refuses("holds no model grid data", ModelGrid.read, tmp_path / "other.fits", error=DataError)
    make().write(tmp_path / "grid.fits")
    with fits.open(tmp_path / "grid.fits") as hdus:
        del hdus["GALAXY"]
        hdus.writeto(tmp_path / "part.fits")
    match = "not a complete file of model grid data"
    refuses(match, ModelGrid.read, tmp_path / "part.fits", error=DataError)


FACTS = {
    "axes": {"tau97": [3.0, 7.0]},
    "inert": [("temperature_polar",)],
    "bounds": {"tau": (0.001, 100.0)},
    "frac_agn_definition": "3-1000um",
    "recipe": {"components": ["sfh: delayed (delayed)"], "imf": "Kroupa (inferred)"},
}


def same_facts(grid):
    assert {name: values.tolist() for name, values in grid.axes.items()} == FACTS["axes"]
    assert grid.inert == (("temperature_polar",),)
    assert grid.bounds["tau"] == (0.001, 100.0)
    assert grid.frac_agn_definition == "3-1000um"
    assert grid.recipe["imf"] == "Kroupa (inferred)"


def test_facts_that_decide_are_attributes_and_survive_writing_copying_and_pickling(tmp_path):
    grid = make(**FACTS, meta={"note": "for people"})
    grid.write(tmp_path / "grid.fits")
    copies = (ModelGrid.read(tmp_path / "grid.fits"), copy.deepcopy(grid), copy.copy(grid))
    for other in (*copies, pickle.loads(pickle.dumps(grid))):
        same_facts(other)
        assert other.meta == {"note": "for people"}
        assert_array_equal(other.galaxy, grid.galaxy)
        assert not other.galaxy.flags.writeable
