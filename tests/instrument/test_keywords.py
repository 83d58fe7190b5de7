from astropy.io import fits

from miricigale.instrument import exposure_keywords, joined_header


def test_what_was_exposed():
    words = {"FILTER": "F770W", "READPATT": "FASTR1", "SUBARRAY": "FULL", "PATT_NUM": 3}
    assert exposure_keywords(fits.Header(words)) == ("miri.f770w", "FASTR1", "FULL", 2)
    # ground tests have the former names of patterns, darks no filter
    words = {"FILTER": "OPAQUE", "READPATT": "FAST "}
    assert exposure_keywords(fits.Header(words)) == (None, "FASTR1", None, 0)
    assert exposure_keywords(fits.Header()) == (None, None, None, 0)


def test_the_primary_header_goes_first_and_the_layout_is_left_out():
    primary = fits.PrimaryHDU(header=fits.Header({"FILTER": "F770W"}))
    science = fits.ImageHDU(header=fits.Header({"FILTER": "F560W", "BUNIT": "DN/s"}), name="SCI")
    hdus = fits.HDUList([primary, science])
    header = joined_header(hdus)
    assert (header["FILTER"], header["BUNIT"]) == ("F770W", "DN/s")
    assert "EXTNAME" not in header
    assert list(joined_header(hdus, "DQ")) == ["FILTER"]
