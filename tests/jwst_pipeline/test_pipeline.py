"""
The official pipeline (jwst, from PyPI) reduces what Scene and Detector made, to the truth.

Its references are made of our own detector's constants by ``tools/make_crds.py``; its steps
stand at their defaults, except for those named in ``run_stage.py``.
"""

import itertools
import warnings

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS
from numpy.testing import assert_allclose
from photutils.aperture import CircularAnnulus, CircularAperture, aperture_photometry
from photutils.centroids import centroid_2dg, centroid_sources
from photutils.psf import ImagePSF, PSFPhotometry

from miricigale.instrument import (
    DQ,
    bad_pixel_mask,
    field_mask,
    flat_field,
    photmjsr,
    pixel_area_map,
)
from miricigale.psf import encircled_energy, miri_psf

pytest.importorskip("jwst", reason="needs the official pipeline: pip install miricigale[jwst]")
pytestmark = pytest.mark.slow

FILTER = "miri.f770w"
RADIUS, SKY = 10.0, (18.0, 24.0)

#: Set by the pipeline's comparison of the dithers; no bit of the detector.
OUTLIER = 16


def images(path):
    with fits.open(path) as hdus:
        names = ("SCI", "ERR", "DQ")
        return [hdus[name].data.astype(float if name != "DQ" else np.uint32) for name in names]


def aperture_share(psf, pixel):
    """Share of a star's light in the aperture, less what the wings put into its sky."""
    held = encircled_energy(psf, np.array([RADIUS, *SKY]) * pixel)
    wings = (held[2] - held[1]) / (SKY[1] ** 2 - SKY[0] ** 2)
    return held[0] - wings * RADIUS**2


def aperture_light(image, x, y):
    """Sum over each aperture, less the mean of its sky."""
    positions = np.stack([x, y], axis=1)
    aperture, ring = CircularAperture(positions, RADIUS), CircularAnnulus(positions, *SKY)
    inner, outer = (aperture_photometry(image, a)["aperture_sum"].value for a in (aperture, ring))
    return inner - outer * aperture.area / ring.area


@pytest.fixture(scope="module")
def psf():
    return miri_psf(FILTER)


@pytest.fixture(scope="module")
def rates(folder, observations, detector1):
    """Rate, true rate, error and flags of all pixels that see the sky, four exposures."""
    rows = []
    for each in observations:
        rate, error, dq = images(each.product(folder, "rate"))
        truth = each.light * flat_field(FILTER) / photmjsr(FILTER)
        rows.append([part[field_mask()] for part in (rate, truth, error, dq)])
    return [np.concatenate(part) for part in zip(*rows, strict=True)]


def test_no_stage_needs_a_network_or_much_memory(detector1, image2, image3):
    for needed in (detector1, image2, image3):
        assert needed["attempts"] == []
        assert needed["peak_mb"] < 4000


def test_detector1_gives_the_rate(rates):
    rate, truth, _, dq = rates
    clean = dq == 0
    # the sky, wings and cores of stars: from 14 to 400 DN/s, up to a third of the full well
    edges = [0, 16, 30, 100, 1000]
    for low, high in itertools.pairwise(edges):
        these = clean & (truth >= low) & (truth < high)
        assert np.count_nonzero(these) > 500
        assert rate[these].sum() == pytest.approx(truth[these].sum(), rel=5e-3)
    # each of the sky's pixels is good to 4 %: the mean of millions shows far less than 0.5 %
    sky = clean & (truth < 16)
    assert rate[sky].sum() == pytest.approx(truth[sky].sum(), rel=5e-4)


def test_detector1_knows_its_errors(rates):
    rate, truth, error, dq = rates
    clean = dq == 0
    pull = (rate[clean] - truth[clean]) / error[clean]
    assert 0.95 < np.std(pull) < 1.1
    assert abs(np.mean(pull)) < 0.03
    # normal, too: undetected cosmic rays would be a tail
    assert np.mean(np.abs(pull) > 4.5) < 1e-4


def test_detector1_flags_what_the_detector_spoilt(rates):
    dq = rates[3]
    bad = np.tile(bad_pixel_mask()[field_mask()], 4)
    assert np.all(dq[bad] & DQ.DO_NOT_USE)
    assert not np.any(dq[~bad] & DQ.DO_NOT_USE)
    # about 8.3e-8 hits per um2 and s times 625 um2 times 55 s is 0.3 % of the pixels, each
    # hit on a track of a few and its neighbors
    hit = np.mean((dq[~bad] & DQ.JUMP_DET) > 0)
    assert 0.005 < hit < 0.1


def test_image2_has_our_world_coordinates(folder, observations, image2):
    datamodels = pytest.importorskip("stdatamodels.jwst.datamodels")
    for each in observations:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with datamodels.open(each.product(folder, "cal")) as model:
                sky = each.truth["sky"]
                x, y = model.meta.wcs.world_to_pixel_values(sky.ra.deg, sky.dec.deg)
        assert_allclose(x, each.truth["x"], atol=1e-3)
        assert_allclose(y, each.truth["y"], atol=1e-3)


def test_image2_gives_surface_brightness_positions_and_fluxes(folder, observations, image2, psf):
    # photutils makes a spline of the whole array for each star: the middle is enough
    middle = tuple(slice(n // 2 - 40, n // 2 + 41) for n in psf.data.shape)
    core = ImagePSF(psf.data[middle], oversampling=psf.oversampling)
    for each in observations:
        path = each.product(folder, "cal")
        data, error, dq = images(path)
        header = fits.getheader(path, "SCI")
        assert header["BUNIT"] == "MJy/sr"
        assert header["PHOTMJSR"] == pytest.approx(photmjsr(FILTER))
        # flat field and sky are gone with the noise: all pixels together
        use = (dq & DQ.DO_NOT_USE == 0) & field_mask()
        assert data[use].sum() == pytest.approx(each.light[use].sum(), rel=2e-3)
        # brightness times the local area is light: the calibration file's map says which
        area = header["PIXAR_SR"] * fits.getdata(path, "AREA")
        assert_allclose(area, pixel_area_map(each.exposure.wcs, each.exposure.shape), rtol=1e-5)
        unusable = ~use | ~np.isfinite(data)
        light = np.where(unusable, 0.0, data - each.sky) * area * 1e12
        truth = each.truth
        start = Table({"x": truth["x"], "y": truth["y"], "flux": truth["flux_total"].value})
        error = np.where(unusable, np.inf, error * area * 1e12)
        measure = PSFPhotometry(core, (9, 9))
        fit = measure(light, error=error, mask=unusable, init_params=start)
        assert np.all(np.hypot(fit["x_fit"] - truth["x"], fit["y_fit"] - truth["y"]) < 0.03)
        ratio = fit["flux_fit"] / truth["flux_total"].value
        assert np.mean(ratio) == pytest.approx(1, abs=5e-3)


@pytest.fixture(scope="module")
def mosaic(folder, image3):
    path = folder / "mosaic_i2d.fits"
    with fits.open(path) as hdus, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        header = hdus["SCI"].header
        return hdus["SCI"].data.astype(float), WCS(header), header["PIXAR_SR"] * u.sr


def test_image3_puts_the_stars_in_their_places(observations, mosaic):
    data, wcs, _ = mosaic
    x, y = wcs.world_to_pixel(observations[0].truth["sky"])
    filled = np.nan_to_num(data, nan=np.nanmedian(data)) - np.nanmedian(data)
    x_fit, y_fit = centroid_sources(filled, x, y, box_size=7, centroid_func=centroid_2dg)
    assert np.all(np.hypot(x_fit - x, y_fit - y) < 0.03)
    assert abs(np.mean(x_fit - x)) < 3e-3
    assert abs(np.mean(y_fit - y)) < 3e-3


def core_taken_for_outlier(folder, observations):
    """Stars of whose cores the pipeline's outlier detection has thrown a pixel away."""
    hit = np.zeros(len(observations[0].truth), bool)
    for each in observations:
        (path,) = folder.glob(each.uncal.name.replace("uncal.fits", "*_crf.fits"))
        outlier = (images(path)[2] & OUTLIER) > 0
        core = CircularAperture(np.stack([each.truth["x"], each.truth["y"]], axis=1), 3)
        hit |= aperture_photometry(outlier.astype(float), core)["aperture_sum"].value > 0
    return hit


def test_image3_conserves_the_fluxes(folder, observations, mosaic, psf):
    data, wcs, area = mosaic
    x, y = wcs.world_to_pixel(observations[0].truth["sky"])
    filled = np.nan_to_num(data, nan=np.nanmedian(data))
    flux = aperture_light(filled, x, y) * area.value * 1e12
    flux /= aperture_share(psf, np.sqrt(area).to(u.arcsec))
    ratio = flux / observations[0].truth["flux_total"].value
    spoilt = core_taken_for_outlier(folder, observations)
    assert np.mean(spoilt) < 0.05
    assert_allclose(ratio[~spoilt], 1, atol=0.01)
    assert_allclose(ratio[spoilt], 1, atol=0.03)
    assert np.mean(ratio) == pytest.approx(1, abs=2e-3)
