import os
import sys
import types
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from numpy.testing import assert_allclose

from helpers.errors import refuses
from miricigale.psf import encircled_energy, miri_psf, psf_at, stpsf_grid, stpsf_psf
from miricigale.utils.exceptions import DataError


def perfect(monkeypatch):
    """Make the optics of stpsf perfect."""
    stpsf = pytest.importorskip("stpsf")
    facts = {"pupilopd": None, "include_si_wfe": False, "include_ote_field_dependence": False}

    def make(original=stpsf.MIRI):
        instrument = original()
        for name, value in facts.items():
            setattr(instrument, name, value)
        return instrument

    monkeypatch.setattr(stpsf, "MIRI", make)


@pytest.fixture
def data(tmp_path, monkeypatch):
    """
    Perfect optics with the data of STPSF_PATH.

    Those of an older version without wavefronts do for perfect optics: stpsf asks for a
    version and for the name of a wavefront, and reads none.
    """
    perfect(monkeypatch)
    source = Path(os.environ["STPSF_PATH"])
    if any((source / "MIRI" / "OPD").glob("OPD*.fits*")):
        return
    (tmp_path / "MIRI" / "OPD").mkdir(parents=True)
    for folder in (source, source / "MIRI", source / "MIRI" / "OPD"):
        for item in folder.iterdir():
            if item.name not in ("MIRI", "OPD", "version.txt"):
                (tmp_path / item.relative_to(source)).symlink_to(item)
    (tmp_path / "version.txt").write_text("2.1.0\n")
    (tmp_path / "MIRI" / "OPD" / "OPD_RevW_ote_for_MIRI_predicted.fits.gz").touch()
    monkeypatch.setenv("STPSF_PATH", str(tmp_path))


def test_says_what_is_missing(monkeypatch):
    def refuse():
        msg = "STPSF data package has version 1.5.0, but 2.1.0 is needed.\nSee ..."
        raise OSError(msg)

    monkeypatch.delenv("STPSF_PATH", raising=False)
    refuses("STPSF_PATH", stpsf_psf, "miri.f770w", error=DataError)
    refuses("'n_psfs' must be a square number, got 3", stpsf_grid, "miri.f770w", n_psfs=3)
    monkeypatch.setenv("STPSF_PATH", "/nowhere")
    monkeypatch.setitem(sys.modules, "stpsf", None)
    refuses(r"miricigale\[stpsf\]", stpsf_psf, "miri.f770w", error=ImportError)
    monkeypatch.setitem(sys.modules, "stpsf", types.SimpleNamespace(MIRI=refuse))
    match = r"cannot use the data of STPSF_PATH: .* 2\.1\.0 is needed\.$"
    refuses(match, stpsf_psf, "miri.f770w", error=DataError)


def test_one_psf_is_that_of_its_place(monkeypatch):
    """stpsf takes the place from the instrument, if it is not to take the middle of the detector."""

    class MIRI:
        detector_position = (515, 511)

        def psf_grid(self, *, num_psfs, single_psf_centered, oversample, fov_pixels, **_):
            assert num_psfs == 1
            place = (515, 511) if single_psf_centered else self.detector_position
            data = np.zeros((1, oversample * fov_pixels, oversample * fov_pixels))
            data[:, data.shape[1] // 2, data.shape[2] // 2] = place[0]
            return types.SimpleNamespace(data=data, grid_xypos=[place])

    monkeypatch.setenv("STPSF_PATH", "/somewhere")
    monkeypatch.setitem(sys.modules, "stpsf", types.SimpleNamespace(MIRI=MIRI))
    one = stpsf_psf("miri.f770w", x=200, y=800, fov=2 * u.arcsec)
    assert one.data.max() == 200
    assert one.position == (200, 800)
    assert stpsf_grid("miri.f770w", fov=2 * u.arcsec).data.max() == 515


@pytest.mark.skipif("STPSF_PATH" not in os.environ, reason="needs STPSF_PATH and stpsf")
@pytest.mark.filterwarnings("ignore")
@pytest.mark.usefixtures("data")
@pytest.mark.parametrize("name", ["miri.f1000w", "miri.f2100w"])
def test_ours_is_like_stpsf(name):
    theirs = stpsf_psf(name, fov=9 * u.arcsec)
    ours = miri_psf(name, wavefront_error=0 * u.nm, fov=9 * u.arcsec, calibration="stpsf")
    assert theirs.fwhm.value == pytest.approx(ours.fwhm.value, rel=0.01)
    radii = [0.2, 0.5, 1.0, 2.5] * u.arcsec
    assert_allclose(encircled_energy(ours, radii), encircled_energy(theirs, radii), atol=0.017)
    # orientation: the mirror image is much less alike in the wings
    r = 2.0 / 0.1109
    t = np.radians(np.arange(0, 360, 2.0))
    a, b, mirrored = (
        p.evaluate(s * r * np.cos(t), r * np.sin(t), 1.0, 0.0, 0.0)
        for p, s in ((theirs, 1), (ours, 1), (ours, -1))
    )
    assert np.corrcoef(a, b)[0, 1] > 0.95
    assert np.corrcoef(a, mirrored)[0, 1] < 0.9


@pytest.mark.slow
@pytest.mark.skipif("STPSF_PATH" not in os.environ, reason="needs STPSF_PATH and stpsf")
@pytest.mark.filterwarnings("ignore")
@pytest.mark.usefixtures("data")
def test_corners_of_the_array_are_like_stpsf():
    """Distortion and the lean of the cruciform: far nearer to stpsf than one PSF for all."""
    kind = {"fov": 8 * u.arcsec}
    grid = stpsf_grid("miri.f560w", n_psfs=4, **kind)
    assert grid.frame == "detector"
    assert list(grid.includes) == ["jitter", "cruciform", "pixel", "ipc"]
    kind |= {"wavefront_error": 0 * u.nm, "calibration": "stpsf"}
    one = miri_psf("miri.f560w", **kind)
    y, x = np.mgrid[-30:31, -30:31] * 1.0
    wings = np.hypot(x, y) > 4
    for place in grid.grid_xypos:
        here = miri_psf("miri.f560w", position=tuple(place), **kind)
        theirs, ours, same = (
            p.evaluate(x, y, 1.0, 0.0, 0.0)[wings] for p in (psf_at(grid, *place), here, one)
        )
        # stpsf's sums wander by 3 % over the array
        theirs, ours, same = (v / v.sum() for v in (theirs, ours, same))
        assert np.std(ours - theirs) < 0.5 * np.std(same - theirs)
