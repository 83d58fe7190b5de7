import numpy as np
from astropy.io import fits

from helpers.cases import cases_of
from helpers.errors import refuses
from miricigale.instrument import DQ, dq_legend, read_dq
from miricigale.utils.exceptions import DataError

#: Bits of JWST from the lowest, as its pipeline documents them.
JWST = cases_of(__file__, "jwst")


def test_bits_of_jwst_have_its_values_and_our_own_lie_above():
    assert [DQ[name] for name in JWST.split()] == [2**n for n in range(32)]
    assert all(flag >= 2**32 for flag in DQ if flag and flag.name not in JWST.split())


def test_the_legend_names_every_bit():
    header = dq_legend()
    assert header["DQBIT1"] == "SATURATED"
    names = {key[5:]: value for key, value in header.items() if key.startswith("DQBIT")}
    bits = {DQ[name]: 2 ** int(bit) for bit, name in names.items()}
    assert bits == {flag: flag.value for flag in DQ if flag}


def test_planes_with_a_legend_are_read_as_they_are(tmp_path):
    flags = np.array([[0, 2**35 + 1], [2**31, 6]])
    fits.ImageHDU(flags, dq_legend(), name="DQ").writeto(tmp_path / "dq.fits")
    with fits.open(tmp_path / "dq.fits") as hdus:
        np.testing.assert_array_equal(read_dq(hdus["DQ"]), flags)


def test_flags_of_another_kind_are_refused():
    unknown = fits.ImageHDU(np.array([[2**20]]), name="DQ")
    refuses("DQ holds flags of another kind", read_dq, unknown, error=DataError)
    hdu = fits.ImageHDU(np.zeros((2, 2), np.int32), name="DQ")
    hdu.header["DQSCHEME"] = "HST"
    refuses("DQSCHEME HST", read_dq, hdu, error=DataError)
