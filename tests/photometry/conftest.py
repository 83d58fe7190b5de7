"""Scenes of Gaussian sources, whose images are known in closed form at any resolution."""

import types

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, StdDevUncertainty
from astropy.table import QTable

from miricigale.instrument import north_up_wcs, pixel_area_map
from miricigale.psf import MatchingKernel

CENTER = SkyCoord(53.1, -27.8, unit="deg")
SR = (1 * u.arcsec**2).to_value(u.sr)
FINE, HI, LO = 0.06, 0.09, 0.25  # pixel and widths (rms) of the two PSFs, arcsec


def gaussian(dx, dy, sigma):
    return np.exp(-0.5 * (dx**2 + dy**2) / sigma**2) / (2 * np.pi * sigma**2)


def offsets(sky, wcs, y, x):
    """Offsets (arcsec) of pixels from a position in the tangent plane."""
    at = wcs.pixel_to_world(x, y)
    dx, dy = sky.spherical_offsets_to(at)
    return dx.to_value(u.arcsec), dy.to_value(u.arcsec)


def render(sky, flux, sigma, wcs, shape, reach=8.0):
    """Image (MJy/sr) of Gaussians of total ``flux`` (uJy) and rms ``sigma`` (arcsec), at pixel centres."""
    image = np.zeros(shape)
    x, y = wcs.world_to_pixel(sky)
    scale = np.sqrt(np.median(pixel_area_map(wcs, shape)) / SR)
    for k, width in enumerate(np.broadcast_to(sigma, len(sky))):
        half = int(reach * width / scale) + 2
        y0, y1 = np.clip([int(y[k]) - half, int(y[k]) + half], 0, shape[0])
        x0, x1 = np.clip([int(x[k]) - half, int(x[k]) + half], 0, shape[1])
        if y1 > y0 and x1 > x0:
            yy, xx = np.mgrid[y0:y1, x0:x1]
            dx, dy = offsets(sky[k], wcs, yy, xx)
            image[y0:y1, x0:x1] += flux[k] * 1e-12 / SR * gaussian(dx, dy, width)
    return image


def as_ccd(image, wcs, sigma, **kwargs):
    noise = StdDevUncertainty(np.full(image.shape, float(sigma)))
    return CCDData(image, unit="MJy/sr", wcs=wcs, uncertainty=noise, **kwargs)


def gaussian_kernel(n=67):
    x = (np.arange(n) - n // 2) * FINE
    hi, lo = (gaussian(x[:, None], x[None], s) * FINE**2 for s in (HI, LO))
    return MatchingKernel.from_psfs(hi, lo, pixel_scale=FINE * u.arcsec)


def positions(rng, n, half):
    """Positions in a square of half side ``half`` arcsec."""
    dx, dy = rng.uniform(-half, half, (2, n)) * u.arcsec
    return CENTER.spherical_offsets_by(dx, dy)


@pytest.fixture(scope="session")
def tools():
    return types.SimpleNamespace(
        CENTER=CENTER, SR=SR, FINE=FINE, HI=HI, LO=LO, render=render, as_ccd=as_ccd,
        positions=positions, kernel=gaussian_kernel(),
    )  # fmt: skip


@pytest.fixture(scope="session")
def field(tools):
    """Sixty point sources on a mosaic of 0.11 arcsec, without noise."""
    rng = np.random.default_rng(4)
    sky = positions(rng, 60, 12.0)
    flux = 10 ** rng.uniform(0, 2, 60)
    wcs = north_up_wcs(CENTER, 0.11 * u.arcsec, (260, 260))
    image = as_ccd(render(sky, flux, LO, wcs, (260, 260)), wcs, 0.01)
    catalog = QTable({"id": np.arange(100, 160), "sky": sky})
    return types.SimpleNamespace(image=image, catalog=catalog, flux=flux, wcs=wcs, sky=sky)
