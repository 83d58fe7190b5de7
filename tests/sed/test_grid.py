import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable

from miricigale.sed import ModelGrid
from miricigale.utils.exceptions import DataError


def make(**changes):
    values = {
        "filters": ("a", "b"),
        "redshift": [0.1, 0.2],
        "galaxy": np.ones((2, 3, 2)),
        "agn": np.full((2, 1, 2), 0.5),
        "dust_luminosity": [1.0, 2.0, 3.0],
        "frac_agn": [0.0, 0.5],
        "allowed": np.ones((2, 3), bool),
        "galaxy_parameters": QTable({"tau": [1.0, 2.0, 3.0]}),
        "agn_parameters": QTable({"tau97": [3.0]}),
        "galaxy_properties": QTable({"sfr": [1.0, 2.0, 3.0]}),
        "agn_properties": QTable({"accretion_power": [3.0]}),
        "agn_multiplicity": [3],
    }
    return ModelGrid(**(values | changes))


def test_flux_is_the_stated_sum():
    np.testing.assert_allclose(make().flux(0, 2, 0, 1), 1.0 + 1.0 * 3.0 * 0.5)
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
    ],
)
def test_arrays_that_do_not_agree_are_refused(changes, match):
    with pytest.raises(ValueError, match=match):
        make(**changes)


def test_arrays_are_read_only():
    with pytest.raises(ValueError, match="read-only"):
        make().galaxy[0, 0, 0] = 2.0


def test_foreign_and_truncated_files_are_refused(tmp_path):
    fits.PrimaryHDU(np.zeros(3)).writeto(tmp_path / "other.fits")
    (tmp_path / "text.fits").write_text("text")
    for name, text in (("text", ""), ("none", "no such file")):
        with pytest.raises(
            DataError, match=rf"{name}\.fits cannot be read as a model grid: {text}"
        ):
            ModelGrid.read(tmp_path / f"{name}.fits")
    with pytest.raises(DataError, match="is not a model grid"):
        ModelGrid.read(tmp_path / "other.fits")
    make().write(tmp_path / "grid.fits")
    with fits.open(tmp_path / "grid.fits") as hdus:
        del hdus["GALAXY"]
        hdus.writeto(tmp_path / "part.fits")
    with pytest.raises(DataError, match="not a complete model grid"):
        ModelGrid.read(tmp_path / "part.fits")
