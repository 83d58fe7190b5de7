import pytest
from astropy.io import fits

from miricigale.instrument import exposure_keywords, joined_header


@pytest.mark.parametrize(
    ("keywords", "said"),
    [
        (
            {"FILTER": "F770W", "READPATT": "FASTR1", "SUBARRAY": "FULL", "PATT_NUM": 3},
            ("miri.f770w", "FASTR1", "FULL", 2),
        ),
        # ground tests have the former names of patterns, darks no filter
        ({"FILTER": "OPAQUE", "READPATT": "FAST "}, (None, "FASTR1", None, 0)),
        ({}, (None, None, None, 0)),
    ],
)
def test_what_was_exposed(keywords, said):
    assert exposure_keywords(fits.Header(keywords)) == said


def test_the_primary_header_goes_first_and_the_layout_is_left_out():
    primary = fits.PrimaryHDU(header=fits.Header({"FILTER": "F770W"}))
    science = fits.ImageHDU(header=fits.Header({"FILTER": "F560W", "BUNIT": "DN/s"}), name="SCI")
    hdus = fits.HDUList([primary, science])
    header = joined_header(hdus)
    assert (header["FILTER"], header["BUNIT"]) == ("F770W", "DN/s")
    assert "EXTNAME" not in header
    assert list(joined_header(hdus, "DQ")) == ["FILTER"]
