"""Groups that are means of frames (FASTGRPAVG8 and its kind): covariance, hits, saturation, references, files."""

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from helpers.references import write_reference
from miricigale.depth import sensitivity
from miricigale.detector import (
    ADConversion,
    Bias,
    CosmicRays,
    Detector,
    Nonlinearity,
    Photons,
    Ramp,
    ReadNoise,
    Saturation,
)
from miricigale.instrument import Exposure, frames_per_group
from miricigale.reduction import DetectorMaps, Reducer, fit_groups, measure_noise
from miricigale.reduction.references.reference_maps import READERS
from miricigale.utils.exceptions import DataError, DetectorWarning

PLAIN = (Photons(flat=False), Nonlinearity(), Bias(), ReadNoise(), ADConversion())
GAIN, READ = 4.0, 6.0


def exposure_of(readout="FASTGRPAVG8", n_groups=12):
    return Exposure(
        "F770W", n_groups=n_groups, subarray="SUB64", readout=readout, pointing="53 -27"
    )


def ramp_of(exposure, *effects, level=10.0, seed=1):
    sky = np.full(exposure.shape, level) * u.MJy / u.sr
    return Detector(effects or PLAIN).expose(sky, exposure, seed=seed)


def slope_by_dense_algebra(groups, n_frames, v, s):
    """Slope, its variance and that of the photons alone, from the covariance of the frames themselves."""
    n_all = groups.size * n_frames
    frame = np.arange(1, n_all + 1)
    # charge is a random walk; each read has noise of its own
    photons = v * np.minimum.outer(frame, frame)
    covariance = photons + s * np.eye(n_all)
    mean = np.kron(np.eye(groups.size), np.full((1, n_frames), 1 / n_frames))
    inverse = np.linalg.inv(mean @ covariance @ mean.T)
    design = np.stack([np.ones(groups.size), mean @ frame], axis=1)
    errors = np.linalg.inv(design.T @ inverse @ design)
    weight = (errors @ design.T @ inverse)[1] @ mean
    return weight @ np.repeat(groups, n_frames), errors[1, 1], weight @ photons @ weight


@pytest.mark.parametrize("n_frames", [2, 8, 64])
@pytest.mark.parametrize("rate", [0.02, 3.0, 400.0])
def test_slopes_and_errors_are_those_of_the_frames_covariance(n_frames, rate):
    """Where read noise counts, where photons do, and between, where both covariances cancel."""
    rng = np.random.default_rng(n_frames)
    n_groups, step = 9, 2.775
    frames = np.cumsum(rng.poisson(rate * GAIN, n_groups * n_frames)) / GAIN
    frames = frames + rng.normal(0, READ, frames.size)
    groups = frames.reshape(n_groups, n_frames).mean(axis=1)
    data = groups.astype(np.float32)[None, :, None, None]
    maps = DetectorMaps(gain=GAIN, read_noise=READ)
    options = {"group_time": n_frames * step, "n_frames": n_frames, "jump_threshold": None}
    fit = fit_groups(data, maps, **options)
    got = float(fit.rate[0, 0]) * step
    truth = slope_by_dense_algebra(groups, n_frames, max(got, 0) / GAIN, READ**2)
    slope, variance, photons = truth
    assert_allclose(got, slope, rtol=1e-3, atol=1e-3 * np.sqrt(variance))
    assert_allclose(fit.error[0, 0] * step, np.sqrt(variance), rtol=2e-3)
    assert_allclose(fit.var_poisson[0, 0] * step**2, photons, rtol=1e-2, atol=1e-6 * variance)


def test_simulated_groups_are_means_of_the_frames_of_the_same_exposure():
    averaged = ramp_of(exposure_of())
    frames = ramp_of(exposure_of("FASTR1", 96))
    expected = frames.data.reshape(1, 12, 8, *frames.shape[2:]).sum(axis=2, dtype=int) // 8
    assert_array_equal(averaged.data, expected)
    assert averaged.exposure.integration_time == frames.exposure.integration_time
    assert frames_per_group("FASTGRPAVG64") == 64


@pytest.mark.parametrize("level", [0.5, 100.0])
def test_scatter_is_the_error_and_slopes_are_those_of_frames(level):
    fit = Reducer().fit_groups(ramp_of(exposure_of(), level=level))
    frames = Reducer().fit_groups(ramp_of(exposure_of("FASTR1", 96), level=level))
    good = np.isfinite(fit.rate)
    error = np.median(fit.error[good])
    assert fit.rate[good].std() / error == pytest.approx(1, abs=0.04)
    difference = (fit.rate - frames.rate)[good]
    assert abs(difference.mean()) < 0.01 * error
    # little is lost by averaging
    assert error / np.median(frames.error[good]) == pytest.approx(1.01, abs=0.01)


def test_hits_amid_a_group_leave_no_bias():
    """Their charge shows in two differences, and both go."""
    effects = (PLAIN[0], CosmicRays(flux=1e-6), Saturation(), *PLAIN[1:])
    exposure = exposure_of(n_groups=40)
    fit = Reducer().fit_groups(ramp_of(exposure, *effects, seed=3))
    clean = np.nanmedian(Reducer().fit_groups(ramp_of(exposure)).rate)
    hit = fit.n_jump > 0
    assert np.count_nonzero(hit) > 300
    pulls = (fit.rate[hit] - clean) / fit.error[hit]
    assert abs(pulls.mean()) < 4 / np.sqrt(pulls.size)
    assert pulls.std() == pytest.approx(1, abs=0.1)


def test_a_group_whose_last_frames_are_full_takes_no_part():
    exposure = exposure_of()
    light = np.geomspace(1e4, 1e5, np.prod(exposure.shape)).reshape(exposure.shape)
    detector = Detector((PLAIN[0], Saturation(), *PLAIN[1:]))
    with pytest.warns(DetectorWarning, match="the sky in"):
        ramp = detector.expose(light * u.MJy / u.sr, exposure, seed=1)
    fit = Reducer().fit_groups(ramp)
    full = np.isfinite(fit.rate) & ((fit.flags & 2) != 0)
    assert full.sum() > 500
    ratio = np.nanmedian((fit.rate / light)[full])
    pulls = ((fit.rate - ratio * light) / fit.error)[full]
    assert np.abs(pulls).max() < 5
    assert abs(pulls.mean()) < 0.1


def test_read_noise_of_a_frame_is_measured_on_averaged_groups():
    noise = measure_noise(ramp_of(exposure_of(n_groups=50)))
    assert noise.read_noise == pytest.approx(READ, abs=0.3)
    assert noise.gain == pytest.approx(GAIN, abs=4 * noise.gain_err)


def test_darks_and_anomalies_of_frames_are_averaged(tmp_path):
    exposure = exposure_of(n_groups=3)
    frames = np.arange(30.0)[None, :, None, None] * np.ones((1, 1, *exposure.shape))
    path = write_reference(tmp_path / "dark.fits", "dark", exposure, frames, READPATT="FAST")
    dark, _ = READERS["dark"](path, exposure)
    assert_allclose(dark[0, :, 0, 0], [3.5, 11.5, 19.5])
    path = write_reference(tmp_path / "reset.fits", "reset", exposure, frames, READPATT="FAST")
    reset, _ = READERS["reset"](path, exposure)
    # nothing is subtracted from frames beyond those of the anomaly
    assert_allclose(reset[0, :, 0, 0], [3.5, 11.5, 19.5, (24 + 25 + 26 + 27 + 28 + 29) / 8])
    keywords = {"READPATT": "FASTGRPAVG8", "NFRAMES": 8}
    path = write_reference(tmp_path / "own.fits", "dark", exposure, frames, **keywords)
    assert READERS["dark"](path, exposure)[0].shape[1] == 30


def test_files_state_frames_and_the_time_of_a_group(tmp_path):
    ramp = ramp_of(exposure_of())
    path = ramp.write(tmp_path / "own_uncal.fits")
    header = fits.getheader(path)
    assert [header[name] for name in ("READPATT", "NFRAMES", "FRMDIVSR", "NGROUPS")] == [
        "FASTGRPAVG8", 8, 8, 12,
    ]  # fmt: skip
    assert header["TGROUP"] == pytest.approx(8 * header["TFRAME"])
    again = Ramp.read(path)
    assert_array_equal(again.data, ramp.data)
    assert again.exposure.readout == "FASTGRPAVG8"


def test_files_with_the_time_of_a_frame_as_that_of_a_group(tmp_path):
    """As the archive had them until 2024, NFRAMES too: slopes were eight times too large."""
    ramp = ramp_of(exposure_of())
    path = ramp.write(tmp_path / "old_uncal.fits")
    with fits.open(path, mode="update") as hdus:
        hdus[0].header["TGROUP"] = hdus[0].header["TFRAME"]
        hdus[0].header["NFRAMES"] = 1
    with pytest.warns(DetectorWarning, match=r"TGROUP = 0\.085 s is the time of a frame.*0\.68 s"):
        old = Ramp.read(path)
    assert old.group_time == pytest.approx(0.68)
    assert_array_equal(Reducer().fit_groups(old).rate, Reducer().fit_groups(ramp).rate)
    with fits.open(path, mode="update") as hdus:
        hdus[0].header["NFRAMES"] = 4
    message = "NFRAMES is 4 in the header and 8 of FASTGRPAVG8"
    refuses(message, Ramp.read, path, error=DataError)


def test_limits_know_the_time_of_a_group():
    time = 1e4 * u.s
    options = {"method": "aperture", "n_groups": 12, "readout": "FASTGRPAVG8"}
    averaged = sensitivity("F1000W", time, **options)
    frames = sensitivity("F1000W", time, method="aperture", n_groups=96)
    assert (averaged / frames).value == pytest.approx(1.01, abs=0.01)
    fitted = sensitivity("F1000W", time, n_groups=12, readout="FASTGRPAVG8")
    alone = sensitivity("F1000W", time, n_groups=96)
    assert (fitted / alone).value == pytest.approx(1.01, abs=0.01)


def test_charge_without_groups_is_refused():
    exposure = exposure_of()
    sky = np.full(exposure.shape, 10.0) * u.MJy / u.sr
    collect = Detector(PLAIN).collect
    refuses("'exposure' must be one of groups that are single frames", collect, sky, exposure)
