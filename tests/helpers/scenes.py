"""Sources on a tangent plane through a Gaussian PSF."""

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable
from astropy.wcs import WCS, Sip
from photutils.psf import ImagePSF

from helpers.light import pixel_gaussian
from miricigale.instrument import pixel_area_map
from miricigale.psf import InstrumentPSF
from miricigale.scene import Scene

FILTER = "miri.f770w"
CENTER = SkyCoord(53.13440 * u.deg, -27.83444 * u.deg)


def tan_wcs(shape=(90, 100), scale=0.11, pa=0.0, parity=-1):
    """TAN with +y at position angle ``pa``; parity -1 is the sky as seen (east left)."""
    ny, nx = shape
    cos, sin = np.cos(np.radians(pa)), np.sin(np.radians(pa))
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crval = [CENTER.ra.deg, CENTER.dec.deg]
    wcs.wcs.crpix = [(nx + 1) / 2, (ny + 1) / 2]
    # columns: east, north of a step in x and in y
    wcs.wcs.cd = scale / 3600 * np.array([[parity * cos, sin], [-parity * sin, cos]])
    wcs.pixel_shape = (nx, ny)
    wcs.wcs.set()
    return wcs


def gaussian_psf(sigma=0.85, oversampling=4, half=9, **facts):
    grid = pixel_gaussian(2 * half * oversampling + 1, half * oversampling, sigma, 1 / oversampling)
    data = np.outer(grid, grid)
    if not facts:
        return ImagePSF(data, oversampling=oversampling)
    facts = {"pixel_scale": 0.11 * u.arcsec, "frame": "detector", **facts}
    return InstrumentPSF(data, oversampling=oversampling, **facts)


def catalog_at(sky, **columns):
    """A catalog of points at positions; ``columns`` (values or one value for all) replace or add columns."""
    columns = {
        "id": np.arange(1, len(sky) + 1), "sky": sky, "redshift": 1.0, "profile": "point",
        "half_light_radius": 0.0 * u.arcsec, "sersic_index": 1.0, "axis_ratio": 1.0,
        "position_angle": 0.0 * u.deg, **columns,
    }  # fmt: skip
    table = QTable()
    for name, value in columns.items():
        table[name] = value if name == "sky" else np.broadcast_to(value, len(sky), subok=True)
    return table


def make_catalog(wcs, x, y, *, flux=10.0, profile="point", **columns):
    """A catalog of sources at given pixels."""
    x, y = np.broadcast_arrays(np.atleast_1d(np.asarray(x, float)), np.atleast_1d(y))
    given = {
        "profile": profile,
        "half_light_radius": columns.get("radius", 0.3) * u.arcsec,
        "sersic_index": columns.get("index", 1.0),
        "axis_ratio": columns.get("ratio", 1.0),
        "position_angle": columns.get("angle", 0.0) * u.deg,
        FILTER: np.asarray(flux, float) * u.uJy,
    }
    return catalog_at(SkyCoord(*wcs.all_pix2world(x, y, 0), unit="deg"), **given)


def make_scene(catalog, wcs, psf, **options):
    """The scene of a catalog of `make_catalog`."""
    return Scene(catalog, filter=FILTER, wcs=wcs, psf=psf, **options)


def light(scene):
    """Light in each pixel (uJy), background included."""
    image = scene.render()
    return image.data * pixel_area_map(scene.wcs, image.shape) * 1e12


def moments(image):
    """Center x, y and the matrix of second moments."""
    y, x = np.indices(image.shape)
    total = image.sum()
    x0, y0 = np.sum(image * x) / total, np.sum(image * y) / total
    x, y = x - x0, y - y0
    return x0, y0, np.array([[np.sum(image * p * q) / total for p in (x, y)] for q in (x, y)])


def distorted_wcs():
    """0.15 pixel per pixel at 50 pixels from the center."""
    wcs = tan_wcs(pa=20.0)
    a, b = np.zeros((3, 3)), np.zeros((3, 3))
    a[2, 0], b[1, 1] = 1.5e-3, -8e-4
    wcs.wcs.ctype = ["RA---TAN-SIP", "DEC--TAN-SIP"]
    wcs.sip = Sip(a, b, None, None, wcs.wcs.crpix)
    wcs.wcs.set()
    return wcs
