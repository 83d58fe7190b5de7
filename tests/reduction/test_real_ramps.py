"""
Ramps of a ground test beside what the official pipeline (jwst 0.17.0) made of them.

Its steps were firstframe, lastframe, linearity, ipc, rscd, jump and ramp_fit, without reset, dark and
refpix. Its linearity reference (0024) cannot be had; what that polynomial of raw DN did here is its
derivative, which is measured on the second integration, by the ratio of slopes at 11000 to 12700 DN,
and predicts the others. Its ipc step couples neighbors by 0.032 (rows) and 0.027 (columns).
"""

import numpy as np
import pytest
from astropy.io import fits
from scipy.ndimage import convolve

from helpers.references import write_reference
from miricigale.detector import Ramp
from miricigale.instrument import DQ
from miricigale.reduction import RampSettings, Reducer, ReferenceFiles
from miricigale.utils.exceptions import MiricigaleWarning

STEM = "real/ramps/MIRI_5582_89_S_20180308-010230_SCE1_pipe"
COUPLING = np.array([[0, 0.0272, 0], [0.0319, 1 - 2 * 0.0272 - 2 * 0.0319, 0.0319], [0, 0.0272, 0]])


def slopes(ramp, number, first, last):
    """Least squares with equal weights."""
    time = ramp.group_time * np.arange(first, last)
    lever = time - time.mean()
    lever /= np.sum(lever * time)
    values = np.tensordot(lever, ramp.data[number, first:last].astype(float), axes=(0, 0))
    return convolve(values, COUPLING)


@pytest.fixture(scope="module")
def ramp(data_file):
    return Ramp.read(data_file(f"{STEM}.fits.gz"))


@pytest.fixture(scope="module")
def pipeline(data_file):
    """Rates of the pipeline, and which are good: no flag, not at the edge where light is coupled in."""
    with fits.open(data_file(f"{STEM}_rateints.fits.gz")) as hdus:
        rates = hdus["SCI"].data.astype(float)
        good = hdus["DQ"].data == 0
    good[:, :, :5] = good[:, :, -1] = False
    good[:, 0] = good[:, -1] = False
    return rates, good


@pytest.fixture(scope="module")
def derivative(ramp, pipeline):
    """Of the pipeline's linearity at the level of each pixel: a + b raw DN, from integration 2."""
    rates, good = pipeline
    slope = slopes(ramp, 1, 3, 49)[good[1]]
    level = ramp.data[1, 3:49].mean(axis=0)[good[1]]
    solution = np.linalg.lstsq(np.array([slope, slope * level]).T, rates[1][good[1]], rcond=None)
    return solution[0]


def test_groups_that_settle_are_said(ramp, pipeline):
    """They are a third to a half of the slopes: only 5 to 15 % are left without the first three groups."""
    rates, good = pipeline
    reducer = Reducer(references="none")
    with pytest.warns(MiricigaleWarning) as found:
        rate = reducer.fit_ramp(ramp)
    said = [str(w.message) for w in found if "still settle" in str(w.message)]
    # the first integration settles longest, by tens of DN
    assert len(said) == 1
    assert "the first 9 groups still settle after the reset, by -3" in said[0]
    assert rate.meta["settling_groups"] == 9
    assert np.all(rate.flags[~rate.mask] & int(DQ.FLUX_ESTIMATED))
    with pytest.warns(MiricigaleWarning):
        parts = reducer.fit_integrations(ramp)
    assert [part.meta["settling_groups"] for part in parts] == [9, 4, 1, 1, 5]
    ratio = [
        np.median(p.data[g]) / np.median(r[g]) for p, r, g in zip(parts, rates, good, strict=True)
    ]
    assert 1.15 < min(ratio[1:]) < max(ratio[1:]) < 1.5
    with pytest.warns(MiricigaleWarning) as found:
        later = reducer.replace(skip_first=9).fit_ramp(ramp)
    assert not any("still settle" in str(w.message) for w in found)
    assert not np.any(later.flags & int(DQ.FLUX_ESTIMATED))


@pytest.mark.filterwarnings("ignore:the first . groups still settle")
def test_later_integrations_have_the_slopes_of_the_pipeline(ramp, pipeline, derivative, tmp_path):
    rates, good = pipeline
    coefficients = np.zeros((3, 64, 72))
    coefficients[1], coefficients[2] = derivative[0], derivative[1] / 2
    path = tmp_path / "linearity.fits"
    linearity = write_reference(path, "linearity", ramp.exposure, coefficients)
    known = {"linearity": linearity, "gain": 5.5, "read_noise": "measured"}
    references = ReferenceFiles(**known, incomplete=True)
    # groups 4 to 49, as firstframe, rscd and lastframe left them
    # only jumps above 10 sigma cut their neighbors there
    ramps = RampSettings(neighbor_threshold=10)
    reducer = Reducer(references=references, skip_first=3, ramps=ramps)
    with pytest.warns(MiricigaleWarning, match="mask, saturation, dark: these steps are left out"):
        found = reducer.fit_integrations(ramp)
    for number in (1, 2, 3, 4):
        use = good[number] & ~found[number].mask
        theirs = np.median(rates[number][use])
        assert np.median(found[number].data[use]) == pytest.approx(theirs, rel=0.03)
        coupled = convolve(np.nan_to_num(found[number].data), COUPLING)[use]
        assert np.corrcoef(coupled, rates[number][use])[0, 1] > 0.97
        # both are estimates of the same slopes from the same counts
        error = np.median(found[number].uncertainty.array[use])
        assert np.std(coupled - rates[number][use]) < 0.5 * error
    # without any reference they are larger by what the linearity does
    with pytest.warns(MiricigaleWarning, match="mask, saturation, linearity, dark"):
        plain = Reducer(references="none", skip_first=3).fit_integrations(ramp)
    ratio = [
        np.median(p.data[g]) / np.median(f.data[g])
        for p, f, g in zip(plain, found, good, strict=True)
    ]
    expected = 1 / (derivative[0] + derivative[1] * 11800)
    assert np.mean(ratio[1:]) == pytest.approx(expected, abs=0.06)
