"""PSFs on the pixels of images that are still to come."""

import dataclasses
import os

import numpy as np
from photutils.psf import GriddedPSFModel

from miricigale.instrument.sky_axes import grid_angle
from miricigale.photometry.fit.exposure_kernels import are_exposures
from miricigale.photometry.images.arrays import pixel_scale
from miricigale.photometry.images.mosaics import as_mosaic
from miricigale.psf import InstrumentPSF, MatchingKernel, checked_psf, from_photutils, read_psf
from miricigale.psf.files import states_pixel
from miricigale.psf.kernel_inputs import named_psf
from miricigale.utils.exceptions import argument_error
from miricigale.utils.files import split_extension
from miricigale.utils.options import check_that
from miricigale.utils.units import ANGLE


def is_sampled(psf):
    """Whether a PSF is an array, a model or a file without the size of its pixels."""
    if isinstance(psf, (InstrumentPSF, GriddedPSFModel)):
        return False
    if isinstance(psf, (str, os.PathLike)):
        return os.path.isfile(split_extension(psf)[0]) and not states_pixel(psf)
    return isinstance(psf, np.ndarray) or hasattr(psf, "param_names") or hasattr(psf, "array")


@dataclasses.dataclass(frozen=True)
class SampledPSFs:
    """
    PSFs of which one at least is on the pixels of an image that is not known yet.

    Parameters
    ----------
    psf : `~numpy.ndarray`, model of photutils or other
        Of the image that is measured.
    highres_psf : `~numpy.ndarray`, model of photutils or other, optional
        Of the high-resolution image.
    filter : str, optional
        Filter of the image that is measured, with whose model its PSF is compared.
    """

    psf: object
    highres_psf: object = None
    filter: str | None = None

    def __repr__(self):
        return "PSFs on the pixels of the images"

    def kernel(self, image, highres):
        """
        Make the kernel on the pixels of images.

        Parameters
        ----------
        image, highres : `~astropy.nddata.CCDData`, path-like or None
            The image that is measured and the high-resolution image.

        Returns
        -------
        kernel : `~miricigale.psf.MatchingKernel`

        Raises
        ------
        ValueError
            If there is no image that a PSF could be on the pixels of.
        """
        if are_exposures(image):
            wanted = "a PSF that states its pixels for exposures, such as (psf, 0.11 * u.arcsec)"
            raise argument_error("psf", wanted, type(self.psf).__name__)
        image = as_mosaic(image, "image")
        psf = compared_psf(_on_pixels(self.psf, image), self.filter)
        if self.highres_psf is None:
            return marked_kernel(MatchingKernel.identity(psf))
        wanted = "given to measure() where 'highres_psf' does not state its pixels"
        sampled = is_sampled(self.highres_psf)
        check_that(highres is not None or not sampled, "highres", wanted, "None")
        if highres is None:
            return marked_kernel(MatchingKernel.from_psfs(self.highres_psf, psf))
        highres = as_mosaic(highres, "highres")
        kernel = MatchingKernel.from_psfs(
            _on_pixels(self.highres_psf, highres),
            psf,
            pixel_scale=pixel_scale(highres.wcs) * ANGLE,
            grid_angle=grid_angle(highres.wcs, highres.shape),
        )
        return marked_kernel(kernel)


def marked_kernel(kernel):
    """Note in the meta of a kernel that its PSF was taken to hold all of the light, for a warning."""
    if kernel.meta.get("energy") == 1.0:
        kernel.meta["total_assumed"] = True
    return kernel


def compared_psf(psf, filter):
    """Compare a PSF with the model of a filter, which has the light beyond its grid; see `checked_psf`."""
    if filter is None:
        return psf
    return checked_psf(named_psf(psf), filter)


def _on_pixels(psf, image):
    """Return a PSF on the pixels of an image, in the direction of its axes, if it does not state its own."""
    if not is_sampled(psf):
        return psf
    scale = pixel_scale(image.wcs) * ANGLE
    angle = grid_angle(image.wcs, image.shape)
    if isinstance(psf, (str, os.PathLike)):
        return read_psf(psf, pixel_scale=scale, frame="sky", angle=angle)
    return from_photutils(psf, pixel_scale=scale, frame="sky", angle=angle)
