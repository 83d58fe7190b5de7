"""Binary tables of FITS files, against those that astropy writes."""

import io
import warnings

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import Column, MaskedColumn, QTable, Table
from astropy.time import Time

from miricigale.utils.fits_tables import described_hdu


def plain():
    return Table({"id": [1, 2, 3], "name": ["a", "bcd", ""], "good": [True, False, True]})


def described():
    table = plain()
    # lines of the description are longer than a card
    table["id"].info.description = "Number of the source, " + 20 * "as it is in the catalog "
    table["flux"] = Column(np.arange(6.0).reshape(3, 2), unit="uJy", description="Two of them.")
    return table


def masked():
    table = described()
    mask = [True, False, False]
    table["n"] = MaskedColumn([4, 5, 6], mask=mask, description="How many.")
    table["part"] = MaskedColumn(np.float32([0.1, 0.2, 0.3]), mask=mask, format=".2f")
    table["class"] = MaskedColumn(["galaxy", "star", "quasar"], mask=mask)
    return table


def quantities():
    table = QTable({"mass": [1e9, 1e10] * u.Msun, "size": [0.1, 0.2] * u.arcsec})
    table["slope"] = [0.1, 0.2] * u.dex
    table["mass"].info.description = "Stellar mass"
    table.meta = {"version": "1.0", "comments": ["made by hand", "twice"], "n": 3}
    return table


def mixins():
    table = QTable({"sky": SkyCoord([10, 20] * u.deg, [1, 2] * u.deg)})
    table["begin"] = Time([60000.0, 60001.5], format="mjd", scale="utc")
    table["sky"].info.description = "Position"
    return table


@pytest.mark.parametrize("rows", [slice(None), slice(0)])
@pytest.mark.parametrize("make", [plain, described, masked, quantities, mixins])
def test_bytes_are_those_that_astropy_writes(make, rows):
    table = make()[rows]
    expected = io.BytesIO()
    found = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        table.write(expected, format="fits")
        described_hdu(table).writeto(found)
    assert found.getvalue() == expected.getvalue()
    assert make()[rows].meta == table.meta
    found.seek(0)
    with fits.open(found) as hdus:
        assert hdus[1].data.dtype.names is not None
        assert QTable.read(hdus).colnames == table.colnames
