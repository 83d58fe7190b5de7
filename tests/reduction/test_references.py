"""Ramps of another detector, with its reference files in the form of CRDS."""

import numpy as np
import pytest
from astropy.stats import mad_std
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses, warned
from helpers.exposures import exposure_of, sky_of
from helpers.references import nameless, write_photom, write_reference, write_references
from miricigale.detector import CosmicRays, Detector, InterpixelCapacitance, ResetAnomaly
from miricigale.instrument import DQ, field_mask, flat_field, miri_detector, photmjsr
from miricigale.reduction import RampSettings, Reducer, ReferenceFiles
from miricigale.reduction.references.reference_maps import read_photom
from miricigale.utils.exceptions import DataError, MiricigaleWarning

SKY = 12.0
NOISE = {"gain": 5.5, "read_noise": 8.0, "bias": 9000.0, "dark_current": 0.9}
OTHER = miri_detector().replace(**NOISE, full_well=250e3, nonlinearity=(0.0, 1.0, 3e-6, 4e-11))


@pytest.fixture(scope="module")
def exposure():
    return exposure_of(n_groups=30, n_integrations=2)


@pytest.fixture(scope="module")
def ramp(exposure):
    """A ramp with stars that fill a fifth of the well, by the other detector."""
    light = np.full(exposure.shape, SKY)
    light[40:210:17, 60:230:17] = 660.0
    anomaly = ResetAnomaly((-60.0, -40.0))
    detector = Detector.miri_imager(anomaly, properties=OTHER)
    detector = detector.without(CosmicRays, InterpixelCapacitance)
    return detector.expose(sky_of(exposure, light), exposure, seed=4, n_threads=1)


@pytest.fixture(scope="module")
def references(exposure, ramp, tmp_path_factory):
    """The other detector's reference files."""
    folder = tmp_path_factory.mktemp("references")
    offsets = ResetAnomaly((-60.0, -40.0)).offsets(2, 30)
    sees = (ramp.pixel_dq & DQ.REFERENCE_PIXEL) == 0
    path = folder / "reset.fits"
    reset = write_reference(
        path, "reset", exposure, offsets[:, :, None, None] * sees, READPATT="FAST"
    )
    bad = np.where(ramp.pixel_dq != 0, 1, 0)
    return ReferenceFiles(**write_references(folder, exposure, OTHER, bad), reset=reset)


@pytest.fixture(scope="module")
def real(ramp, tmp_path_factory):
    """The same ramp in a file that does not tell who made it."""
    return nameless(ramp, tmp_path_factory.mktemp("ramps"))


def test_the_last_group_is_left_out_where_nothing_says_that_it_is_good(real, ramp, references):
    n_int, n_group = ramp.shape[:2]
    for reducer, one, left_out in (
        (Reducer(references=references), real, 2),
        (Reducer(references=references, skip_last=0), real, 1),
        (Reducer(references=references, skip_first=0, skip_last=0), real, 0),
        (Reducer(references="simulated", reset_anomaly=ResetAnomaly()), ramp, 0),
    ):
        used = reducer.fit_groups(one).n_used
        assert used.max() == n_int * (n_group - 1 - left_out)


def test_another_detector_comes_out_right_with_its_references(exposure, real, ramp, references):
    reducer = Reducer(references=references, skip_first=0, skip_last=0)
    rate = reducer.fit_ramp(real)
    truth = SKY / photmjsr(exposure.filter, gain=OTHER.gain)
    truth = truth * flat_field(exposure.filter, subarray="SUB256")
    good = ~rate.mask & (rate.data < 3 * np.median(rate.data[~rate.mask]))
    pull = ((rate.data - truth) / rate.uncertainty.array)[good]
    assert pull.std() == pytest.approx(1, abs=0.02)
    assert abs(pull.mean()) < 4 / np.sqrt(good.sum()) + 0.02
    # up to a fifth of the well, where the response falls by several per cent
    stars = ~rate.mask & (rate.data > 30 * truth)
    assert stars.sum() > 80
    bright = 660.0 / photmjsr(exposure.filter, gain=OTHER.gain)
    bright = bright * flat_field(exposure.filter, subarray="SUB256")[stars]
    assert np.mean(rate.data[stars] / bright) == pytest.approx(1, abs=1e-3)
    cal = reducer.calibrate(rate)
    sky = ~cal.mask & good & field_mask(subarray="SUB256")
    error = cal.uncertainty.array[sky].mean() / np.sqrt(sky.sum())
    assert cal.data[sky].mean() == pytest.approx(SKY, abs=4 * error + 0.01)
    # headers say which file was used
    for name in ("mask", "linearity", "dark", "gain", "reset", "flat", "photom"):
        assert cal.meta[f"reference_{name}"] == f"{name}.fits"
    assert cal.meta["reference_read_noise"] == "readnoise.fits"
    assert cal.meta["reference_bias"] == "none"
    assert {"linearity", "dark", "flat", "photom"} <= set(cal.meta["steps"])
    # who made the ramp does not matter then
    same = reducer.replace(ramps=RampSettings(ipc=False)).fit_ramp(ramp)
    assert_array_equal(same.data, rate.data)


def test_a_bias_of_its_own_stands_before_the_polynomial(exposure, real, references, tmp_path):
    above = np.array(OTHER.nonlinearity)[:, None, None] * np.ones(exposure.shape)
    level = np.full(exposure.shape, OTHER.bias)
    bias = write_reference(tmp_path / "bias.fits", "superbias", exposure, level)
    linearity = write_reference(tmp_path / "linearity.fits", "linearity", exposure, above)
    other = references.replace(bias=bias, linearity=linearity)
    one, two = (Reducer(references=r).fit_ramp(real) for r in (references, other))
    assert_allclose(two.data, one.data, rtol=2e-3, atol=2e-3)
    assert two.meta["reference_bias"] == "bias.fits"
    number = Reducer(references=other.replace(bias=OTHER.bias)).fit_ramp(real)
    assert_array_equal(number.data, two.data)


def test_without_references_it_is_refused(ramp, real, references):
    refuses(r"did not simulate \(needed: mask, saturation, linear", Reducer().fit_ramp, real)
    # our own ramps of another detector are not ours to reduce in silence either
    refuses("was made by another detector than miri_detector", Reducer().fit_ramp, ramp)
    rate = Reducer(references="simulated", skip_first=9).fit_ramp(ramp)
    assert rate.meta["reference_gain"] == "4 e-/DN of the simulated detector"
    rate = Reducer(properties=OTHER, skip_first=9).fit_ramp(ramp)
    assert rate.meta["reference_gain"] == "5.5 e-/DN of the simulated detector"
    reducer = Reducer(references=references.replace(dark=None))
    refuses("'references' must be complete for slopes .* none for dark", reducer.fit_ramp, real)
    partial = references.replace(dark=None, incomplete=True)
    rate = warned("slopes without references for dark", Reducer(references=partial).fit_ramp, real)
    assert rate.meta["reference_dark"] == "none"
    with pytest.warns(
        MiricigaleWarning, match="nothing says that the dark current was taken out of the slopes"
    ):
        Reducer(references=partial).calibrate(rate)
    refuses("must be given for surface brightness", Reducer().calibrate, rate)


def test_slopes_without_any_reference_have_measured_noise(real):
    reducer = Reducer(references="none", skip_first=8)
    with (
        pytest.warns(MiricigaleWarning, match="mask, saturation, linearity, dark: these steps"),
        pytest.warns(MiricigaleWarning, match="is that of all noise that grows with time"),
    ):
        rate = reducer.fit_ramp(real)
    assert rate.unit == "adu / s"
    assert rate.meta["reference_read_noise"].endswith("DN (measured on the ramp)")
    assert float(rate.meta["reference_read_noise"].split()[0]) == pytest.approx(8.0, rel=0.02)
    # a sub-array without reference pixels does not tell photons from slow noise
    assert rate.meta["reference_gain"].endswith("e-/DN, effective (measured on the ramp)")
    assert float(rate.meta["reference_gain"].split()[0]) == pytest.approx(OTHER.gain, rel=0.15)
    assert rate.meta["reference_saturation"] == "the highest number of the converter"
    # errors are those of the scatter, where the sky is flat
    good = ~rate.mask & (np.arange(256) // 20 == 1)
    flat = flat_field("miri.f1000w", subarray="SUB256")
    expected = np.median(rate.uncertainty.array[good])
    assert mad_std((rate.data / flat)[good]) == pytest.approx(expected, rel=0.1)
    with (
        pytest.warns(MiricigaleWarning, match="surface brightness without references for flat"),
        pytest.raises(ValueError, match="given with 'photom' for surface brightness"),
    ):
        reducer.calibrate(rate)


def test_files_for_something_else_are_refused(exposure, real, references, data_file, tmp_path):
    def refused(name, kind, array, match, **keywords):
        path = write_reference(tmp_path / f"{kind}.fits", kind, exposure, array, **keywords)
        reducer = Reducer(references=references.replace(**{name: path}))
        refuses(match, reducer.fit_ramp, real, error=DataError)

    flat = np.ones(exposure.shape)
    refused("gain", "gain", flat, "its DETECTOR is MIRIFULONG, not MIRIMAGE", DETECTOR="MIRIFULONG")
    refused("gain", "gain", flat, "its REFTYPE is FLAT, not GAIN", REFTYPE="FLAT")
    refused("gain", "gain", flat, "its INSTRUME is NIRCAM, not MIRI", INSTRUME="NIRCAM")
    refused("gain", "gain", flat, "it covers .* and not SUB256", SUBSTRT2=700)
    refused("read_noise", "readnoise", flat, "READPATT is SLOWR1, not FASTR1", READPATT="SLOW")
    few = np.ones((1, 12, *exposure.shape))
    refused("dark", "dark", few, "it has 12 groups, and the ramp 30")
    refused("linearity", "linearity", flat, "must hold coefficients")
    # a real one, of another part of the detector
    path = data_file("miri_facts/jwst_miri_readnoise_SLITLESSPRISM.fits")
    with pytest.raises(DataError, match="and not SUB256"):
        Reducer(references=references.replace(read_noise=path)).fit_ramp(real)
    refuses("'gain' must be the path of a file, got nowhere", ReferenceFiles, gain="nowhere.fits")
    refuses("'gain' must be a path or a number above 0 in e-/DN", ReferenceFiles, gain=-1.0)
    refuses(r"'flat' must be a path, got 1\.0", ReferenceFiles, flat=1.0)


def test_flags_of_references_are_read_by_their_names(exposure, real, references, tmp_path):
    dq = np.zeros(exposure.shape, int)
    dq[100, 100], dq[101, 101], dq[102, 102] = 1, 2, 4
    legend = ["HOT", "DO_NOT_USE", "SOMETHING_ELSE"]
    mask = write_reference(tmp_path / "mask.fits", "mask", exposure, dq=dq, legend=legend)
    gain = np.full(exposure.shape, 5.5)
    gain[110, 110] = np.nan
    gain = write_reference(tmp_path / "gain.fits", "gain", exposure, gain)
    rate = Reducer(references=references.replace(mask=mask, gain=gain)).fit_ramp(real)
    assert rate.flags[100, 100] & DQ.HOT
    assert not rate.mask[100, 100]
    assert rate.mask[101, 101]
    assert not rate.mask[102, 102]
    assert rate.flags[110, 110] & DQ.NO_GAIN_VALUE
    assert rate.mask[110, 110]


def test_the_conversion_follows_time_as_the_pipeline_has_it(exposure, tmp_path):
    rows = [("F770W", "GENERIC", 0.4), ("F1000W", "GENERIC", 0.5)]
    day = 60000.0
    plain = write_photom(tmp_path / "a.fits", rows)
    assert read_photom(plain, exposure, None) == pytest.approx(0.5)
    tables = {
        "TIMECOEFF_LINEAR": {"t0": 59000.0, "lossperyear": 0.01},
        "TIMECOEFF_EXPONENTIAL": {"t0": 59500.0, "amplitude": 0.1, "tau": 250.0, "const": 0.9},
        "TIMECOEFF_POWERLAW": {"t0": 59635.0, "year1value": 0.98, "tsoft": 1.0, "alpha": -0.02},
    }
    factor = 1 - 0.01 * 1000 / 365
    factor *= 0.1 * np.exp(-2) + 0.9
    factor *= 0.98
    timed = write_photom(tmp_path / "b.fits", rows, times=tables)
    assert read_photom(timed, exposure, day) == pytest.approx(0.5 / factor, rel=1e-6)
    old = {"TIMECOEFF": {"amplitude": 0.2, "tau": 250.0, "t0": 59500.0}}
    old = write_photom(tmp_path / "c.fits", rows, times=old)
    assert read_photom(old, exposure, day) == pytest.approx(0.5 + 0.2 * np.exp(-2), rel=1e-6)
    refuses("the exposure does not state when", read_photom, old, exposure, None, error=DataError)
    other, wanted = exposure.replace(filter="miri.f560w"), "has no row for F560W and SUB256"
    refuses(wanted, read_photom, plain, other, None, error=DataError)


def test_integrations_apart(real, references):
    reducer = Reducer(references=references, jump_threshold=None)
    rates = reducer.fit_integrations(real)
    assert [rate.meta["integration"] for rate in rates] == [0, 1]
    whole = reducer.fit_ramp(real)
    good = ~whole.mask & ~rates[0].mask & ~rates[1].mask
    # independent halves of the same light, each with its own anomaly taken off
    difference = (rates[1].data - rates[0].data)[good]
    error = np.hypot(rates[0].uncertainty.array, rates[1].uncertainty.array)[good]
    assert np.std(difference / error) == pytest.approx(1, abs=0.03)
    mean = 0.5 * (rates[0].data + rates[1].data)[good]
    assert_allclose(mean, whole.data[good], rtol=0.01, atol=0.02)
