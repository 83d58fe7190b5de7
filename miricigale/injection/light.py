"""Light of sources on the pixels of an image."""

import warnings

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.instrument.sky_axes import grid_angle
from miricigale.photometry.images.arrays import pixel_scale
from miricigale.photometry.images.repeated_pixels import own_pixels
from miricigale.psf import make_psf, psf_image, rotate_psf
from miricigale.scene import Scene
from miricigale.utils.arrays import nans
from miricigale.utils.exceptions import PhotometryWarning
from miricigale.utils.units import ANGLE

#: Cells within the width (FWHM) of a PSF.
_CELLS = 6


def psf_on_pixels(psf, wcs, shape):
    """
    Return a PSF on the sky in cells that divide the pixels of an image.

    Parameters
    ----------
    psf : `~miricigale.psf.InstrumentPSF`
        In the frame of the sky, with the image's pixel in it.
    wcs : `~astropy.wcs.WCS`
        The image.
    shape : (int, int)
        Its shape.

    Returns
    -------
    psf : `~miricigale.psf.InstrumentPSF`
        In the orientation of the image, of the same light.
    """
    scale = pixel_scale(wcs)
    angle = grid_angle(wcs, shape)
    oversampling = max(2, int(np.ceil(_CELLS * scale / psf.fwhm.to_value(ANGLE))))
    cell = scale / oversampling
    n = 2 * int(psf.half_width / cell) + 1
    rotated = rotate_psf(psf, grid_angle=angle)
    data = psf_image(rotated, pixel_scale=cell * ANGLE, shape=n)
    data *= psf.enclosed / data.sum()
    return make_psf(
        data * oversampling**2,
        pixel_scale=scale * ANGLE,
        frame="sky",
        oversampling=oversampling,
        angle=angle.to_value(u.deg) * u.deg,
    )


def light_on_image(sources, flux, wcs, shape, psf, n_threads=None):
    """
    Return the surface brightness of sources on an image.

    Parameters
    ----------
    sources : `~astropy.table.QTable`
        ``sky``, ``profile`` and shapes.
    flux : `~astropy.units.Quantity`, shape (n,)
        Their fluxes.
    wcs, shape
        The image.
    psf : `~miricigale.psf.InstrumentPSF`
        Of `psf_on_pixels`, or in the axes of the detector.
    n_threads : int, optional
        Threads; the light does not depend on them.

    Returns
    -------
    light : `~numpy.ndarray`, shape (ny, nx)
        MJy/sr, without noise.
    """
    if not len(sources):
        return np.zeros(shape)
    names = ["sky", "profile", "half_light_radius", "sersic_index", "axis_ratio", "position_angle"]
    rows = QTable(sources[names], copy=True)
    rows["id"] = np.arange(1, len(rows) + 1)
    rows["redshift"] = nans(len(rows))
    # light has no color here
    band = "miri.f770w"
    if psf.filter is not None:
        band = psf.filter
    rows[band] = flux
    wcs = wcs.deepcopy()
    wcs.pixel_shape = shape[::-1]
    scene = Scene(rows, filter=band, wcs=wcs, psf=psf, n_threads=n_threads)
    return np.asarray(scene.render().data)


def light_on_file(file, sources, flux, psf, n_threads=None):
    """
    Return the surface brightness of sources on the pixels of a file.

    Parameters
    ----------
    file : `~miricigale.photometry.MosaicFile`
        The image. Where each of its pixels is there several times, the light is too.
    sources, flux, n_threads
        As for `light_on_image`.
    psf : `~miricigale.psf.InstrumentPSF`
        In the frame of the sky.

    Returns
    -------
    light : `~numpy.ndarray`, shape (ny, nx)
        MJy/sr, without noise.
    """
    with warnings.catch_warnings():
        # those of the image are given where it is measured
        warnings.simplefilter("ignore", PhotometryWarning)
        image = own_pixels(file.read())
    cells = psf_on_pixels(psf, image.wcs, image.shape)
    light = light_on_image(sources, flux, image.wcs, image.shape, cells, n_threads)
    n = image.meta.get("repeated_pixels", 1)
    if n == 1:
        return light
    header = file.header
    # the middle of the first of the repeated pixels, in those of the file
    middle = np.array(header.wcs.world_to_pixel(image.wcs.pixel_to_world(0, 0)))
    x, y = np.rint(middle - (n - 1) / 2).astype(int)
    file_light = np.zeros(header.shape)
    file_light[y : y + n * light.shape[0], x : x + n * light.shape[1]] = np.kron(
        light, np.ones((n, n))
    )
    return file_light
