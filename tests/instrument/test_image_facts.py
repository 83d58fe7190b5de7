import numpy as np
import pytest
from astropy.io import fits
from astropy.nddata import CCDData

from helpers.cases import cases_of
from helpers.errors import refuses
from miricigale.instrument import ImageFacts


def test_what_an_image_does_not_say_is_open():
    for image in (CCDData(np.zeros((2, 2)), unit="MJy/sr"), np.zeros((2, 2))):
        assert ImageFacts.of(image) == ImageFacts()
    assert ImageFacts().band is None
    assert not ImageFacts().ipc


@pytest.mark.parametrize(
    "includes", [["pixel", "ipc"], ("PIXEL", "IPC"), "pixel, ipc", "pixel ipc"]
)
def test_lists_and_the_text_that_a_header_makes_of_them(includes):
    image = CCDData(np.zeros((2, 2)), unit="MJy/sr", meta={"psf_includes": includes, "seed": 3})
    assert ImageFacts.of(image).psf_includes == ("pixel", "ipc")


def test_headers_of_files_are_understood():
    header = fits.Header({"FILTER": "F770W", "SUBARRAY": "FULL"})
    facts = ImageFacts.of(CCDData(np.zeros((2, 2)), unit="MJy/sr", meta=header))
    assert facts.band == ImageFacts(filter="miri.f770w").band == "f770w"
    assert facts.subarray == "FULL"


@pytest.mark.parametrize(("key", "value"), cases_of(__file__, "others"))
def test_values_of_another_kind_are_named(key, value):
    image = CCDData(np.zeros((2, 2)), unit="MJy/sr", meta={key: value})
    refuses(rf"'image' must be one whose meta\['{key}'\] is", ImageFacts.of, image)
