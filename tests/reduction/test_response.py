"""Loss of response with time and by sub-array: its tables, simulated ramps, limits, and calibrations."""

import astropy.units as u
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from helpers.exposures import exposure_of, sky_of
from helpers.references import nameless, write_photom
from miricigale.depth import fitted_noise, saturation_flux, sensitivity
from miricigale.detector import Detector, Ramp
from miricigale.instrument import background_level, imager_filters, miri_detector, photmjsr
from miricigale.reduction import Reducer, ReferenceFiles, imager_response

PARTS = {"FULL": 1.0, "BRIGHTSKY": 1.005, "SUB256": 0.98, "SUB128": 1.0, "SUB64": 0.966}
ROWS = [(f[5:].upper(), p, photmjsr(f) / r) for f in imager_filters() for p, r in PARTS.items()]
TIMES = {
    "TIMECOEFF_EXPONENTIAL": {"t0": 59720.0, "amplitude": 0.25, "tau": 200.0, "const": 0.75},
    "TIMECOEFF_LINEAR": {"t0": 59720.0, "lossperyear": 0.002},
}


def test_the_loss_is_that_of_the_tables(tmp_path):
    timed = write_photom(tmp_path / "a.fits", ROWS, times=TIMES)
    # a year after the first day: a loss of 21 % (STScI newsletter of 2023-09-29, F2550W)
    detector = miri_detector().replace(response=imager_response(timed, date="2023-05-21"))
    loss = (0.25 * np.exp(-365 / 200) + 0.75) * (1 - 0.002)
    assert loss == pytest.approx(0.79, abs=0.002)
    for part, share in PARTS.items():
        assert detector.relative_response("miri.f2550w", part) == pytest.approx(loss * share, 1e-6)
    # sub-arrays alone, up to the 3.4 % of Gordon et al. 2025
    alone = imager_response()
    assert (len(alone), min(row[2] for row in alone)) == (45, 0.966)
    refuses("'photom, date'", imager_response, date="2023-05-21")
    last = detector.replace(response=alone[-1:])
    refuses("with miri.f770w and FULL", last.relative_response, "miri.f770w")


def test_light_seen_by_less_response_is_less_light(tmp_path):
    """A detector of response R sees a sky B and a source F as one of response 1 sees R B and R F."""
    share, name = 0.8, "miri.f1000w"
    aged = miri_detector().replace(response=[(name, part, share) for part in PARTS])
    exposure = exposure_of(n_groups=6)
    ramp = Detector.miri_imager(properties=aged).expose(sky_of(exposure, 12.0), exposure, seed=2)
    less = Detector.miri_imager().expose(sky_of(exposure, 12.0 * share), exposure, seed=2)
    assert_array_equal(ramp.data, less.data)
    image = Reducer(properties=aged).calibrate(Reducer(properties=aged).fit_ramp(ramp))
    dimmer = Reducer().calibrate(Reducer().fit_ramp(less))
    assert_allclose(image.data, dimmer.data / share, rtol=1e-5)
    ramp.write(tmp_path / "a_uncal.fits")
    assert Ramp.read(tmp_path / "a_uncal.fits").properties == aged
    sky = background_level(name)
    for limit in (sensitivity, lambda f, **kw: fitted_noise(f, 1e4 * u.s, **kw)[0]):
        expected = limit(name, background=share * sky) / share
        assert_allclose(limit(name, detector=aged), expected, rtol=1e-6)
    full = saturation_flux(exposure, background=share * sky) / share
    assert_allclose(saturation_flux(exposure, detector=aged), full, rtol=1e-6)


@pytest.mark.filterwarnings("ignore::miricigale.utils.exceptions.MiricigaleWarning")
def test_calibrated_images_are_calibrated_again(tmp_path):
    exposure = exposure_of(n_groups=12)
    timed = write_photom(tmp_path / "timed.fits", ROWS, times=TIMES)
    # on the day that files of simulated ramps state
    aged = miri_detector().replace(response=imager_response(timed, date="2022-06-21"))
    ramp = Detector.miri_imager(properties=aged).expose(sky_of(exposure, 12.0), exposure, seed=2)
    plain = write_photom(tmp_path / "plain.fits", ROWS)
    files = {"gain": aged.gain, "read_noise": aged.read_noise, "incomplete": True}
    before, after = (
        Reducer(references=ReferenceFiles(photom=photom, **files), skip_first=0, skip_last=0)
        for photom in (plain, timed)
    )
    rate = before.fit_ramp(nameless(ramp, tmp_path))
    old, new = before.calibrate(rate), after.calibrate(rate)
    again = after.calibrate(old)
    response = aged.relative_response("miri.f1000w", "SUB256")
    ratio = new.meta["photmjsr"] / old.meta["photmjsr"]
    assert ratio == pytest.approx(1 / (response / 0.98), rel=1e-4)
    good = ~new.mask
    assert_allclose(again.data[good], new.data[good], rtol=1e-5)
    assert_allclose(again.uncertainty.array[good], new.uncertainty.array[good], rtol=1e-5)
    assert again.meta["reference_photom"] == "timed.fits"
    # the reduction does so itself with a reference that is given
    for reducer, image in ((after, new), (before, old)):
        assert reducer.reduce(old)[1].meta["photmjsr"] == image.meta["photmjsr"]
    del old.meta["photmjsr"]
    refuses("an image with its PHOTMJSR", after.calibrate, old)
