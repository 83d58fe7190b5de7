"""
Whatever made a file, and whatever was done to it, it is reduced to the truth, or refused by name.

Files are the package's own, those that the official pipeline makes of its simulation (or a stand-in, the exact
steps in plain numpy), and the same without a word of who simulated them; references are none, the simulated
detector's own, files, and a CRDS cache.
"""

import importlib.util
import itertools
import shutil

import numpy as np
import pytest
from astropy.io import fits
from numpy.testing import assert_array_equal

from helpers.errors import refuses
from helpers.exposures import exposure_of, sky_of
from helpers.references import write_cache, write_references
from miricigale.detector import Detector, Ramp
from miricigale.instrument import (
    DQ,
    STEPS,
    bad_pixel_mask,
    field_mask,
    flat_field,
    miri_detector,
    photmjsr,
)
from miricigale.reduction import RampSettings, Reducer, ReferenceCache, ReferenceFiles, write_image
from miricigale.utils.exceptions import DataError

OWN = miri_detector()
EXPOSURE = exposure_of(n_groups=25, n_integrations=2)
PART = {"subarray": EXPOSURE.subarray}
FLAT, CONVERSION = flat_field(EXPOSURE.filter, **PART), photmjsr(EXPOSURE.filter)
STEP = EXPOSURE.group_time.to_value("s")
DARK = OWN.dark_current / OWN.gain
#: Faint and bright sky, from 10 e- a group to a tenth of the well.
LIGHT = np.where(np.arange(256) < 128, 12.0, 400.0) * np.ones((256, 256))
#: Pixels that were not read.
ZERO = slice(100, 103), slice(60, 63)
DONE = ("dq_init", "saturation", "linearity", "dark", "lastframe", "jump")


@pytest.fixture(scope="module")
def ramp():
    """A simulated ramp with cosmic rays, and with pixels of 0 DN."""
    sky = sky_of(EXPOSURE, LIGHT, psf_includes=["ipc"])
    ramp = Detector.miri_imager().expose(sky, EXPOSURE, seed=4)
    data = np.array(ramp.data)
    data[:, :, *ZERO] = 0
    return Ramp(data, EXPOSURE, **ramp._values())


@pytest.fixture(scope="module")
def ours(ramp, tmp_path_factory):
    """What the package writes."""
    folder, reducer = tmp_path_factory.mktemp("ours"), Reducer(ramps=RampSettings(ipc=False))
    rate = reducer.fit_ramp(ramp, planes=True)
    write_image(rate, folder / "sim_rate.fits")
    write_image(reducer.fit_integrations(ramp, planes=True), folder / "sim_rateints.fits")
    write_image(reducer.calibrate(rate.image), folder / "sim_cal.fits")
    ramp.write(folder / "sim_uncal.fits")
    return folder


def save(path, planes, uncal, steps, unit):
    """A product with the keywords of level 1b and of the steps behind it."""
    with fits.open(uncal) as hdus:
        primary, science = hdus[0].header, hdus["SCI"].header
        words = {word: "COMPLETE" for word, step in STEPS.items() if step in steps}
        primary.update(words | {"R_GAIN": "crds://jwst_miri_gain_0001.fits"})
        kept = {key: science[key] for key in ("RA_REF", "DEC_REF", "ROLL_REF")}
        extra = [
            hdus[name].copy() for name in ("SIM_META", "SIM_PIXELDQ") if path.stem == "sim_ramp"
        ]
        new = [fits.ImageHDU(plane, name=name) for name, plane in planes.items()]
        new[0].header.update(kept | {"BUNIT": unit, "PHOTMJSR": CONVERSION})
        fits.HDUList([fits.PrimaryHDU(header=primary), *new, *extra]).writeto(path)


@pytest.fixture(scope="module")
def stand_in(ramp, ours, tmp_path_factory):
    """What another pipeline would make of it: exact steps, and slopes with the noise that they state."""
    folder, uncal = tmp_path_factory.mktemp("theirs"), ours / "sim_uncal.fits"
    shutil.copy(uncal, folder)
    linear = OWN.linearize(ramp.data - OWN.bias) + OWN.bias
    linear -= STEP * DARK * np.arange(1, 26)[:, None, None]
    bad = np.where(bad_pixel_mask(**PART), int(DQ.DO_NOT_USE), 0).astype(np.uint32)
    group_dq, truth = np.zeros(ramp.shape, np.uint8), LIGHT * FLAT / CONVERSION
    noise = np.sqrt(2 * OWN.read_noise**2 + truth * STEP / OWN.gain)
    hit = np.abs(np.diff(linear, axis=1) - truth * STEP) > 4 * noise
    group_dq[:, 1:][hit] = DQ.JUMP_DET
    group_dq[:, -1] |= np.uint8(DQ.DO_NOT_USE)
    group_dq[:, :, *ZERO] = DQ.DO_NOT_USE | DQ.AD_FLOOR
    planes = {"SCI": linear.astype(np.float32), "PIXELDQ": bad, "GROUPDQ": group_dq}
    save(folder / "sim_ramp.fits", planes, uncal, DONE, "DN")
    rng = np.random.default_rng(1)
    error = 0.03 * truth * np.ones((2, 1, 1)) * np.sqrt(2)
    rates = rng.normal(truth, error)
    rates[:, *ZERO], steps = np.nan, (*DONE, "ramp_fit")
    bad[ZERO] = DQ.DO_NOT_USE
    several = {"SCI": rates, "ERR": error, "DQ": np.broadcast_to(bad, rates.shape).copy()}
    one = {"SCI": rates.mean(axis=0), "ERR": error[0] / np.sqrt(2), "DQ": bad}
    scale = CONVERSION / FLAT
    cal = {"SCI": one["SCI"] * scale, "ERR": one["ERR"] * scale, "DQ": bad}
    save(folder / "sim_rateints.fits", several, uncal, steps, "DN/s")
    save(folder / "sim_rate.fits", one, uncal, steps, "DN/s")
    save(folder / "sim_cal.fits", cal, uncal, (*steps, "flat", "photom"), "MJy/sr")
    return folder


@pytest.fixture(scope="module")
def pipeline(ours, tools, tmp_path_factory):
    """What the official pipeline makes of it."""
    if importlib.util.find_spec("jwst") is None:
        pytest.skip("needs the official pipeline: pip install miricigale[jwst]")
    folder = tmp_path_factory.mktemp("pipeline")
    shutil.copy(ours / "sim_uncal.fits", folder)
    options = "--filters", EXPOSURE.filter, "--groups", "25", "--subarray", "SUB256"
    crds = tools.make_crds(folder / "crds", *options)
    tools.run_stage("detector1+ramp", folder, [folder / "sim_uncal.fits"], crds)
    tools.run_stage("image2", folder, [folder / "sim_rate.fits"], crds)
    return folder


@pytest.fixture(scope="module")
def references(tmp_path_factory):
    """Of each kind."""
    cache = tmp_path_factory.mktemp("crds")
    kinds = "mask", "photom", "saturation", "linearity", "dark", "gain", "readnoise", "flat"
    rules = {
        kind: ("(('META.INSTRUMENT.DETECTOR',),)", f"Match({{'MIRIMAGE' : '{kind}.fits'}})")
        for kind in kinds
    }
    write_cache(cache, rules)
    folder = cache / "references/jwst/miri"
    files = write_references(folder, EXPOSURE, OWN, bad_pixel_mask(**PART))
    kinds = {"none": None, "own": "simulated", "files": ReferenceFiles(**files)}
    return {**kinds, "crds": ReferenceCache(cache)}


def edited(path, folder, **words):
    """A copy with other keywords; None removes one. Without ORIGIN nothing tells who simulated it."""
    with fits.open(path) as hdus:
        for word, value in words.items():
            if value is None:
                hdus[0].header.remove(word)
            else:
                hdus[0].header[word] = value
        foreign = "ORIGIN" in words
        kept = [hdu for hdu in hdus if not (foreign and hdu.name.startswith("SIM_"))]
        fits.HDUList(kept).writeto(folder / path.name)
    return folder / path.name


def refusal(who, product, references):
    """Why a file is refused, if it is."""
    if references != "none" or who == "ours" or product == "cal":
        return None
    if "foreign" in who:
        return "'references' must be given for .* the package's Detector did not simulate"
    simulated = (
        r"that the package simulated \(ORIGIN\), with a detector that its file does not state"
    )
    return simulated if product != "ramp" else None


def pull_of(path):
    """Scatter of what a file holds over the errors that it states."""
    with fits.open(path) as hdus:
        data, error, dq = (hdus[name].data for name in ("SCI", "ERR", "DQ"))
        truth = LIGHT if hdus["SCI"].header["BUNIT"] == "MJy/sr" else LIGHT * FLAT / CONVERSION
        good = (dq & 1 == 0) & field_mask(**PART)
        return np.std(((data - truth) / error)[good])


MAKERS = ("ours", "stand_in", "stand_in foreign", "pipeline", "pipeline foreign")
PRODUCTS = ("uncal", "ramp", "rate", "rateints", "cal")


# level 1b that no pipeline changed is ours
CASES = [
    pair
    for pair in itertools.product(MAKERS, PRODUCTS)
    if pair not in [("stand_in", "uncal"), ("pipeline", "uncal")]
]


@pytest.mark.parametrize("with_references", ["none", "own", "files", "crds"])
@pytest.mark.parametrize(("who", "product"), CASES)
def test_truth_or_refusal(who, product, with_references, request, references, ramp, tmp_path):
    if with_references == "crds":
        pytest.importorskip("crds", reason="needs crds: pip install miricigale[jwst]")
    maker, _, foreign = who.partition(" ")
    path = request.getfixturevalue(maker) / f"sim_{product}.fits"
    theirs = 1.0 if product in ("uncal", "ramp") or maker == "ours" else pull_of(path)
    exposure = path if (maker, product) != ("ours", "ramp") else ramp
    if foreign:
        exposure = edited(path, tmp_path, ORIGIN="STSCI")
    settings = {"ramps": RampSettings(ipc=False), "background": "none"}
    reducer = Reducer(references=references[with_references], **settings)
    if (match := refusal(who, product, with_references)) is not None:
        refuses(match, reducer.reduce, exposure)
        return
    rate, image, background = reducer.reduce(exposure)
    data = image.data + background.level
    good = ~image.mask & field_mask(**PART)
    assert good.mean() > 0.98
    assert image.mask[ZERO].all()
    assert np.std(((data - LIGHT) / image.uncertainty.array)[good]) == pytest.approx(
        theirs, abs=0.02
    )
    for level in (12.0, 400.0):
        assert data[good & (level == LIGHT)].mean() == pytest.approx(level, rel=2e-3)
    hit = good & ((image.flags if rate is None else rate.flags) & int(DQ.JUMP_DET) != 0)
    if product in ("uncal", "ramp"):
        assert data[hit].sum() == pytest.approx(LIGHT[hit].sum(), rel=5e-3)
        assert hit.sum() > 200


def test_headers_that_contradict_themselves_or_say_nothing(ours, stand_in, tmp_path):
    reducer = Reducer(background="none")
    for path in (ours / "sim_uncal.fits", ours / "sim_rate.fits", stand_in / "sim_ramp.fits"):
        wrong = edited(path, tmp_path, FILTER="F770W")
        match = "FILTER is F770W in the header and miri.f1000w in"
        refuses(match, reducer.reduce, wrong, error=DataError)
        wrong.unlink()
        plain = reducer.reduce(path)[1].data
        silent = edited(path, tmp_path, INSTRUME=None)
        assert_array_equal(reducer.reduce(silent)[1].data, plain)
        (tmp_path / path.name).unlink()
    silent = edited(stand_in / "sim_rate.fits", tmp_path, INSTRUME=None, DETECTOR=None)
    match = "must be an exposure of the MIRI imager .* got None"
    refuses(match, reducer.reduce, silent, error=DataError)


def test_slopes_of_another_detector_are_not_calibrated_with_ours(ramp):
    other = OWN.replace(gain=5.5)
    rate = Reducer(properties=other).fit_ramp(ramp)
    refuses("by another detector than .* a gain of 5.5", Reducer().calibrate, rate)
    assert np.isfinite(Reducer(properties=other).calibrate(rate).data).any()
