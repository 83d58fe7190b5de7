"""Pulls on scenes that GalSim draws, over many draws of the noise of prior and image (extra ``galsim``)."""

import astropy.units as u
import numpy as np
import pytest

from miricigale.instrument import north_up_wcs, pixel_area_map
from miricigale.photometry import ErrorSettings, ForcedPhotometer, detect_sources
from miricigale.psf import MatchingKernel

galsim = pytest.importorskip("galsim", reason="needs galsim: pip install miricigale[galsim]")

pytestmark = pytest.mark.slow

FINE, COARSE, DRAWS = 0.06, 0.11, 30
PRIOR_NOISE, NOISE = 0.004, 0.01
SIDE = 15.0


def moffat(width):
    return galsim.Moffat(beta=3.5, fwhm=width, trunc=3.0)


def images(tools, sources):
    """Prior and image without noise, each pixel's flux, and their coordinates."""
    found = []
    for psf, scale, column in ((moffat(0.18), FINE, "high"), (moffat(0.35), COARSE, "flux")):
        n = int(SIDE / scale)
        wcs = north_up_wcs(tools.CENTER, scale * u.arcsec, (n, n))
        picture = galsim.ImageD(n, n, scale=scale, xmin=0, ymin=0)
        for x, y, one in zip(*wcs.world_to_pixel(sources["sky"]), sources["rows"], strict=True):
            profile = psf
            if one["radius"]:
                light = galsim.Sersic(one["n"], half_light_radius=one["radius"])
                profile = galsim.Convolve(light.shear(g1=one["g1"], g2=one["g2"]), psf)
            place = galsim.PositionD(float(x), float(y))
            (profile * one[column]).drawImage(image=picture, center=place, add_to_image=True)
        found.append((picture.array, wcs))
    return found


@pytest.fixture(scope="module")
def pulls(tools):
    """Pulls of 25 sources, two in five of them blended, with and without the templates' errors."""
    rng = np.random.default_rng(6)
    dx, dy = tools.lattice(rng, 4, 3.4, 0.2)
    dx, dy = np.append(dx, dx[:8] + 0.65), np.append(dy, dy[:8] - 0.35)
    rows = []
    for k in range(24):
        radius = 0.0 if k % 5 == 0 else rng.uniform(0.1, 0.35)
        high = rng.uniform(9, 40) * PRIOR_NOISE * 30 * np.hypot(1.2 * radius, 0.17)
        rows.append(
            {"radius": radius, "n": rng.uniform(0.6, 3.0), "g1": rng.uniform(-0.3, 0.3),
             "g2": rng.uniform(-0.3, 0.3), "high": high, "flux": high * 10 ** rng.uniform(-0.4, 0.8)}
        )  # fmt: skip
    sky = tools.places(dx, dy)
    flux = np.array([one["flux"] for one in rows])
    scenes = images(tools, {"sky": sky, "rows": rows})
    # PSFs have the response of the images' own pixels
    boxes = (galsim.Pixel(scale) for scale in (FINE, COARSE))
    lights = (galsim.Convolve(moffat(w), one) for w, one in zip((0.18, 0.35), boxes, strict=True))
    form = {"nx": 101, "ny": 101, "scale": FINE, "method": "no_pixel"}
    psfs = (one.drawImage(**form).array.astype(float) for one in lights)
    kernel = MatchingKernel.from_psfs(*psfs, pixel_scale=FINE * u.arcsec)
    errors = ErrorSettings(correlated_noise=False, psf_error=0.0)
    photometer = ForcedPhotometer(kernel, errors=errors)
    found = np.full((2, DRAWS, 24), np.nan)
    for draw in range(DRAWS):
        noisy = []
        for (light, wcs), noise in zip(scenes, (PRIOR_NOISE, NOISE), strict=True):
            area = np.median(pixel_area_map(wcs, light.shape)) * 1e12
            data = light + rng.normal(0, noise, light.shape)
            noisy.append(tools.as_ccd(data / area, wcs, noise / area))
        segments, seen = detect_sources(noisy[0])
        index, distance, _ = sky.match_to_catalog_sky(seen["sky"])
        alone = np.bincount(index, minlength=len(seen))[index] == 1
        ok = (distance < 0.2 * u.arcsec) & alone
        result = photometer.measure(noisy[1], noisy[0], segments, seen)
        off = result.flux.value[index] - flux
        for k, error in enumerate((result.flux_err, result.flux_err_noise)):
            found[k, draw] = np.where(ok, off / error.value[index], np.nan)
    return found


def spread(values):
    values = values[np.isfinite(values)]
    return 1.4826 * np.median(np.abs(values - np.median(values))), np.std(values)


def test_errors_cover_what_templates_do(pulls):
    every, noise = pulls
    assert np.isfinite(every).sum() > 0.6 * every.size
    mad, std = spread(every)
    assert 0.88 < mad < 1.12
    assert 0.85 < std < 1.4
    # without the templates' errors they would be further off
    assert spread(noise)[1] > 1.1 * std
    blended = np.arange(24) % 16 < 8
    for which in (blended, ~blended):
        mad, std = spread(every[:, which])
        assert 0.85 < mad < 1.2
        assert std < 1.5
