"""Slow read-out, the reddest survey band and resets through the official pipeline."""

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits

from helpers.exposures import exposure_of
from miricigale.detector import Detector, FirstFrame, LastFrame, Ramp, ResetAnomaly
from miricigale.instrument import DQ, Exposure, field_mask, flat_field, photmjsr
from miricigale.reduction import Reducer

pytest.importorskip("jwst", reason="needs the official pipeline: pip install miricigale[jwst]")
pytestmark = pytest.mark.slow


def options_of(exposure):
    """What the cache of an exposure is made with."""
    return (
        *("--filters", exposure.filter, "--groups", str(exposure.n_groups)),
        *("--readout", exposure.readout, "--subarray", exposure.subarray),
    )


def reduce(tools, folder, exposure, catalog, *, stages, extra=(), detector=None):
    """One exposure through the stages of the pipeline."""
    crds = tools.make_crds(folder / "crds", *options_of(exposure), *extra)
    (seen,) = tools.observe([exposure], catalog, folder, detector=detector)
    files = [seen.uncal]
    for stage, product in stages.items():
        needed = tools.run_stage(stage, folder, files, crds)
        assert needed["attempts"] == []
        files = [seen.product(folder, product)]
    return seen


def rate_of(folder, seen):
    """Rate, error, flags and true rate of the pixels that see the sky."""
    exposure = seen.exposure
    with fits.open(seen.product(folder, "rate")) as hdus:
        rate, error = (hdus[name].data.astype(float) for name in ("SCI", "ERR"))
        dq = hdus["DQ"].data
    truth = seen.light * flat_field(exposure.filter, subarray=exposure.subarray)
    field = field_mask(subarray=exposure.subarray)
    truth = truth / photmjsr(exposure.filter)
    return [plane[field] for plane in (rate, error, dq, truth)]


def check_rate(folder, seen, *, split):
    """Rates within 0.5 % below and above a brightness, errors that are true."""
    rate, error, dq, truth = rate_of(folder, seen)
    clean = dq == 0
    for these in (clean & (truth < split), clean & (truth > split)):
        assert np.count_nonzero(these) > 100
        assert rate[these].sum() == pytest.approx(truth[these].sum(), rel=5e-3)
    pull = (rate[clean] - truth[clean]) / error[clean]
    assert 0.95 < np.std(pull) < 1.1
    assert abs(np.mean(pull)) < 0.05
    return clean.mean()


def test_slow_readout(tmp_path, tools):
    exposure = Exposure(
        "miri.f770w", readout="SLOWR1", n_groups=8, pointing=tools.POINTING, roll=70 * u.deg
    )
    x, y = (g.ravel() for g in np.meshgrid(450 + 120.3 * np.arange(5), 100 + 160.7 * np.arange(6)))
    catalog = tools.star_field(exposure, x, y, np.full(x.size, 120.0))
    seen = reduce(tools, tmp_path, exposure, catalog, stages={"detector1": "rate"})
    with fits.open(seen.product(tmp_path, "rate")) as hdus:
        head = hdus[0].header
        assert (head["READPATT"], head["TGROUP"]) == ("SLOWR1", 23.89)
    # 8.3e-8 hits per um2 and s in 191 s: a few per cent of the pixels and more around them
    assert 0.7 < check_rate(tmp_path, seen, split=20.0) < 0.99


def subarray_exposure(tools, band, n_groups, n_integrations, flux):
    """Several integrations of a small sub-array, and nine stars in it."""
    options = {"pointing": tools.POINTING, "roll": 20 * u.deg}
    exposure = exposure_of(band, n_groups=n_groups, n_integrations=n_integrations, **options)
    x, y = (g.ravel() for g in np.meshgrid([60.3, 128.0, 190.6], [55.1, 130.4, 200.0]))
    return exposure, tools.star_field(exposure, x, y, np.full(9, flux))


# in the reddest band the sky fills the well in about a hundred seconds: small sub-arrays are read in time
@pytest.mark.parametrize(
    ("mode", "split"), [(("miri.f1500w", 12, 3, 2e3), 150.0), (("miri.f2100w", 20, 2, 5e3), 600.0)]
)
def test_sub_arrays_and_integrations(tmp_path, tools, mode, split):
    exposure, catalog = subarray_exposure(tools, *mode)
    stages = {"detector1": "rate", "image2": "cal"}
    seen = reduce(tools, tmp_path, exposure, catalog, stages=stages)
    check_rate(tmp_path, seen, split=split)
    with fits.open(seen.product(tmp_path, "cal")) as hdus:
        head = hdus["SCI"].header
        assert head["BUNIT"] == "MJy/sr"
        assert head["PHOTMJSR"] == pytest.approx(photmjsr(exposure.filter))
        use = (hdus["DQ"].data & DQ.DO_NOT_USE) == 0
        data = hdus["SCI"].data[use].astype(float)
    assert data.sum() == pytest.approx(seen.light[use].sum(), rel=2e-3)


def test_what_resets_do_is_taken_off(tmp_path, tools):
    exposure, catalog = subarray_exposure(tools, "miri.f770w", 40, 3, 1e3)
    detector = Detector.miri_imager(ResetAnomaly(), FirstFrame(), LastFrame())
    extra, stages = ("--reset-anomaly", "--skip-first", "1"), {"detector1": "rate"}
    options = {"stages": stages, "extra": extra, "detector": detector}
    seen = reduce(tools, tmp_path, exposure, catalog, **options)
    with fits.open(seen.product(tmp_path, "rate")) as hdus:
        for step in ("S_RESET", "S_RSCD", "S_LASTFR"):
            assert hdus[0].header[step] == "COMPLETE"
    check_rate(tmp_path, seen, split=30.0)
    # the native reduction leaves out the same groups and comes to the same rates
    rate, error, dq, truth = rate_of(tmp_path, seen)
    native = Reducer(reset_anomaly=ResetAnomaly()).fit_ramp(Ramp.read(seen.uncal))
    own = native.data[field_mask(subarray="SUB256")]
    both = (dq == 0) & (native.flags[field_mask(subarray="SUB256")] == 0)
    assert np.std((own - rate)[both] / error[both]) < 0.2
    assert own[both].sum() == pytest.approx(truth[both].sum(), rel=5e-3)
