"""Injection into ramps: light is conserved, noise is that of the photons, and the user's reduction sees it."""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from miricigale import Detector, Exposure, Ramp, Reducer, Scene
from miricigale.cli import main
from miricigale.detector import CosmicRays, InterpixelCapacitance, Nonlinearity
from miricigale.injection.light import light_on_image
from miricigale.injection.ramps import inject_file, inject_ramp, is_ramp
from miricigale.instrument import DQ, pixel_area_map
from miricigale.psf import miri_psf
from miricigale.utils.exceptions import DataError

SKY = 5.0 * u.MJy / u.sr


class Photons:
    """Random numbers whose Poisson numbers are their means."""

    def __init__(self, seed):
        self.uniform = np.random.default_rng(seed).uniform

    def poisson(self, mean, size):
        return np.broadcast_to(mean, size)


def stars(exposure, xy, flux):
    sky = exposure.wcs.pixel_to_world(*np.transpose(xy)).icrs
    rows = QTable({"sky": sky, "profile": np.full(len(xy), "point")})
    for name, value in (("sersic_index", 1.0), ("axis_ratio", 1.0)):
        rows[name] = np.full(len(xy), value)
    rows["half_light_radius"] = np.zeros(len(xy)) * u.arcsec
    rows["position_angle"] = np.zeros(len(xy)) * u.deg
    rows["flux"] = np.full(len(xy), flux) * u.uJy
    return rows


@pytest.fixture(scope="module")
def exposure():
    return Exposure("F770W", n_groups=12, subarray="SUB64", pointing="53 -27")


def ramp_of(exposure, *effects, seed=1, light=SKY):
    image = np.full(exposure.shape, light.value) * light.unit
    detector = Detector.miri_imager(*effects).without(CosmicRays)
    return detector.expose(image, exposure, seed=seed)


def with_counts(ramp, data):
    values = {"pixel_dq": ramp.pixel_dq, "effects": ramp.effects, "properties": ramp.properties}
    return Ramp(data, ramp.exposure, meta=dict(ramp.meta), **values)


def brightness(ramp):
    reducer = Reducer(jump_threshold=None)
    return reducer.calibrate(reducer.fit_ramp(ramp))


@pytest.mark.parametrize("linear", [True, False])
def test_injected_flux_is_conserved_through_a_ramp(exposure, linear):
    ramp = ramp_of(exposure, Nonlinearity(linear=linear))
    reducer = Reducer()
    if linear:
        properties = reducer.detector.replace(nonlinearity=(0.0, 1.0))
        reducer = Reducer(properties=properties, references="simulated")
    xy = [(20.3, 20.1), (44.7, 30.2), (30.0, 50.6)]
    sources = stars(exposure, xy, 300.0)
    data = inject_ramp(ramp, sources, reducer, Photons(1))
    before, after = (
        reducer.calibrate(reducer.fit_ramp(one)) for one in (ramp, with_counts(ramp, data))
    )
    gained = after.data - before.data
    seen = np.isfinite(gained)
    area = pixel_area_map(exposure.wcs, exposure.shape) * 1e12
    psf = miri_psf("F770W", includes=("jitter", "cruciform", "pixel"))
    light = light_on_image(sources, sources["flux"], exposure.wcs, exposure.shape, psf)
    assert_allclose(np.sum((gained * area)[seen]), np.sum((light * area)[seen]), rtol=1e-3)


def test_a_star_on_the_first_pixel_has_its_light(exposure):
    image = np.full(exposure.shape, SKY.value) * SKY.unit
    detector = Detector.miri_imager().without(CosmicRays, InterpixelCapacitance)
    ramp = detector.expose(image, exposure, seed=1)
    blind = (ramp.pixel_dq & int(DQ.REFERENCE_PIXEL)) != 0
    first_y, first_x = np.argwhere(~blind)[0]
    gained = []
    for x, y in ((first_x, first_y), (30, 30)):
        sources = stars(exposure, [(float(x), float(y))], 300.0)
        data = inject_ramp(ramp, sources, Reducer(), Photons(1))
        counts = data[0, :, y, x].astype(float) - ramp.data[0, :, y, x]
        gained.append(np.diff(counts).mean())
    # pixels differ by their flat
    assert_allclose(gained[0], gained[1], rtol=0.1)


def test_groups_that_are_averaged_on_board_hold_the_mean_of_their_frames():
    averaged = Exposure(
        "F770W", n_groups=6, subarray="SUB64", readout="FASTGRPAVG8", pointing="53 -27"
    )
    ramp = ramp_of(averaged, Nonlinearity(linear=True))
    properties = Reducer().detector.replace(nonlinearity=(0.0, 1.0))
    reducer = Reducer(properties=properties, references="simulated")
    data = inject_ramp(ramp, stars(averaged, [(30.0, 30.0)], 300.0), reducer, Photons(1))
    gained = (data.astype(float) - ramp.data)[0].sum(axis=(1, 2))
    step = np.diff(gained).mean()
    # frames 1 to 8 of a group hold 1/8 to 8/8 of its charge
    assert_allclose(gained / step, np.arange(6) + 4.5 / 8, atol=0.05)


def test_injected_light_has_its_photon_noise(exposure):
    """The electrons of the core of a bright star vary as Poisson numbers, in each group."""
    ramp = ramp_of(exposure)
    sources = stars(exposure, [(30.0, 30.0)], 3000.0)
    cut = np.s_[:, 26:35, 26:35]
    linear = Reducer().detector.linearize
    bias, gain = Reducer().detector.bias, Reducer().detector.gain
    before = linear(ramp.data[0][cut] - bias)
    sums = []
    for k in range(40):
        data = inject_ramp(ramp, sources, Reducer(), np.random.default_rng(k))
        sums.append((linear(data[0][cut] - bias) - before).sum(axis=(1, 2)) * gain)
    steps = np.diff(sums, axis=1)
    # rounding adds a tenth
    ratio = (steps - steps.mean(axis=0)).var() / steps.mean()
    assert 0.85 < ratio < 1.3
    assert_allclose(steps.mean(axis=0), steps.mean(), rtol=0.02)


def test_reference_pixels_and_saturated_groups_stay(exposure):
    ramp = ramp_of(exposure)
    sources = stars(exposure, [(30.0, 30.0), (2.0, 40.0)], 2e7)
    data = inject_ramp(ramp, sources, Reducer(), np.random.default_rng(1))
    reference = (ramp.pixel_dq & int(DQ.REFERENCE_PIXEL)) != 0
    assert reference.any()
    assert_array_equal(data[..., reference], ramp.data[..., reference])
    detector = Reducer().detector
    full = data[0, -1] >= detector.bias + 0.98 * detector.saturation_dn
    assert full.sum() > 4
    # counts never fall where light is added
    assert np.all(np.diff(data[0].astype(int)[:, full], axis=0) > -100)
    fit = Reducer().fit_groups(with_counts(ramp, data))
    usable = full & (ramp.pixel_dq & int(DQ.DO_NOT_USE) == 0) & ~reference
    assert np.all(fit.flags[usable] & int(DQ.SATURATED) != 0)
    nothing = inject_ramp(ramp, sources[:0], Reducer(), np.random.default_rng(1))
    assert_array_equal(nothing, ramp.data)


def test_charge_is_shared_as_in_the_detector(exposure):
    """A star that is injected looks like one that was exposed, interpixel capacitance included."""
    xy = [(30.0, 30.0)]
    sources = stars(exposure, xy, 200.0)
    rows = QTable({"id": [1], "sky": sources["sky"], "profile": ["point"]})
    rows["miri.f770w"] = sources["flux"]
    optics = miri_psf("F770W", includes=("jitter", "cruciform", "pixel"))
    image = Scene(rows, exposure, psf=optics, background=SKY).render()
    detector = Detector.miri_imager().without(CosmicRays)
    assert any(isinstance(one, InterpixelCapacitance) for one in detector.effects)
    ramp = ramp_of(exposure)
    cut = np.s_[26:35, 26:35]
    exposed, injected = [], []
    for k in range(6):
        exposed.append(brightness(detector.expose(image, exposure, seed=k)).data[cut])
        data = inject_ramp(
            ramp_of(exposure, seed=50 + k), sources, Reducer(), np.random.default_rng(k)
        )
        injected.append(brightness(with_counts(ramp, data)).data[cut])
    peak = np.mean(exposed, axis=0).max()
    assert_allclose(np.mean(injected, axis=0), np.mean(exposed, axis=0), atol=0.04 * peak)


def test_files_keep_all_but_their_counts(exposure, tmp_path):
    ramp = ramp_of(exposure)
    path = ramp.write(tmp_path / "a_uncal.fits")
    assert is_ramp(path)
    sources = stars(exposure, [(30.0, 30.0)], 50.0)
    other = inject_file(
        path, tmp_path / "b_uncal.fits", sources, Reducer(), np.random.default_rng(1)
    )
    again = Ramp.read(other)
    expected = inject_ramp(ramp, sources, Reducer(), np.random.default_rng(1))
    assert_array_equal(again.data, expected)
    assert again.effects == ramp.effects
    assert_array_equal(again.pixel_dq, ramp.pixel_dq)
    rate = Reducer().fit_ramp(ramp, planes=True)
    from miricigale.reduction import write_image

    write_image(rate.image, tmp_path / "a_rate.fits", planes=rate.planes)
    assert not is_ramp(tmp_path / "a_rate.fits")
    with pytest.raises(DataError):
        inject_file(tmp_path / "a_rate.fits", tmp_path / "c.fits", sources, Reducer(), None)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the image lies about")
def test_ramps_go_through_the_users_reduction(tmp_path, capsys):
    """By the command: dithers of a field of stars, own bright stars, no prior."""
    first = Exposure("F770W", n_groups=8, subarray="SUB128", pointing="53 -27")
    rng = np.random.default_rng(4)
    xy = np.stack([rng.uniform(20, 120, 14), rng.uniform(10, 120, 14)], axis=-1)
    field = stars(first, xy, 1.0)
    rows = QTable({"id": np.arange(14), "sky": field["sky"], "profile": field["profile"]})
    rows["miri.f770w"] = rng.uniform(5, 50, 14) * u.uJy
    paths = []
    for k, dither in enumerate(first.dithered([[0, 0], [1.1, 0.7]] * u.arcsec)):
        image = Scene(rows, dither, background="low").render()
        ramp = Detector.miri_imager().expose(image, dither, seed=k)
        paths.append(str(ramp.write(tmp_path / f"d{k}_uncal.fits")))
    own = QTable({"F770W": np.full(10, 20.0) * u.uJy})
    own.write(tmp_path / "own.ecsv")
    options = ["--sources", str(tmp_path / "own.ecsv"), "--trials", "1", "--number", "10"]
    assert main(["inject", *paths, *options, "-o", str(tmp_path / "run"), "--no-progress"]) == 0
    assert "10 sources" in capsys.readouterr().out
    found = QTable.read(tmp_path / "run" / "sources.fits")
    free = np.asarray(found["neighbor_light"]) < 0.3
    ratio = (found["flux"] / found["flux_true"]).value[free]
    error = (found["flux_err"] / found["flux_true"]).value[free]
    assert len(ratio) >= 6
    assert abs(np.mean(ratio) - 1) < 3 * np.sqrt(np.sum(error**2)) / len(ratio) + 0.02
    assert main(["inject", *paths, "--weight", "x", "-o", str(tmp_path / "run")]) == 2
    assert "--weight must be left out for ramps" in capsys.readouterr().err
