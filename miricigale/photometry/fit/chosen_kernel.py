"""The kernel of a photometer: given, of PSFs, or of PSFs on the pixels of images that are still to come."""

import dataclasses
import os
from collections.abc import Mapping

import numpy as np
from photutils.psf import GriddedPSFModel

from miricigale.instrument.sky_axes import grid_angle
from miricigale.photometry.fit.exposure_kernels import ExposureKernels, are_exposures
from miricigale.photometry.images.arrays import pixel_scale
from miricigale.photometry.images.mosaics import as_mosaic
from miricigale.psf import (
    InstrumentPSF,
    KernelField,
    MatchingKernel,
    as_kernel,
    checked_psf,
    from_photutils,
    instrument_psf,
    read_psf,
)
from miricigale.psf.files import states_pixel
from miricigale.psf.kernel_inputs import named_psf
from miricigale.utils.exceptions import argument_error
from miricigale.utils.files import is_path, split_extension
from miricigale.utils.options import check_that
from miricigale.utils.units import ANGLE


def chosen_kernel(kernel, psf, highres_psf, filter):
    """
    Return the kernel of a photometer, that was given or is made of PSFs.

    Parameters
    ----------
    kernel, psf, highres_psf, filter : object or None
        As for `~miricigale.photometry.ForcedPhotometer`.

    Returns
    -------
    kernel : `~miricigale.psf.MatchingKernel`, `~miricigale.psf.KernelField`, `ExposureKernels` or `SampledPSFs`

    Raises
    ------
    ValueError
        If it is not one of kernel and PSF that is given, or one of several bands.
    """
    check_one_band(kernel, "kernel")
    check_one_band(psf, "psf")
    got = "neither" if psf is None else "both"
    check_that((kernel is None) != (psf is None), "kernel, psf", "one of them given", got)
    if kernel is not None:
        kernel = _as_kernels(kernel)
        wanted = "given with 'psf', not with 'kernel'"
        check_that(highres_psf is None, "highres_psf", wanted, "a kernel too")
        check_that(filter is None, "filter", "given with 'psf'", filter)
        return kernel
    if is_sampled(psf) or is_sampled(highres_psf):
        return SampledPSFs(psf, highres_psf, filter)
    return kernel_of_psfs(psf, highres_psf, filter)


def check_one_band(value, argument):
    """Refuse images, PSFs or kernels of several bands."""
    if isinstance(value, Mapping):
        wanted = (
            "that of one band (several at once: measure_bands(images, photometers, templates) of "
            "miricigale.photometry, with a dict of images, one of ForcedPhotometer(psf=...) and "
            "SourceTemplates.from_catalog(catalog))"
        )
        raise argument_error(argument, wanted, f"a dict of {', '.join(map(str, value))}")


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
        psf = _on_pixels(self.psf, image)
        if self.highres_psf is None:
            return kernel_of_psfs(psf, None, self.filter)
        wanted = "given to measure() where 'highres_psf' does not state its pixels"
        sampled = is_sampled(self.highres_psf)
        check_that(highres is not None or not sampled, "highres", wanted, "None")
        if highres is None:
            return kernel_of_psfs(psf, self.highres_psf, self.filter)
        highres = as_mosaic(highres, "highres")
        return kernel_of_psfs(
            psf,
            _on_pixels(self.highres_psf, highres),
            self.filter,
            pixel_scale=pixel_scale(highres.wcs) * ANGLE,
            grid_angle=grid_angle(highres.wcs, highres.shape),
        )


def kernel_of_psfs(psf, highres_psf, filter, **place):
    """Make the kernel between two PSFs, or of the first alone; the model of its filter has the light beyond it."""
    if filter is not None:
        psf = checked_psf(named_psf(psf), filter)
    if highres_psf is None:
        kernel = MatchingKernel.identity(_on_sky(psf))
    else:
        kernel = MatchingKernel.from_psfs(highres_psf, psf, **place)
    # for a warning: the PSF was taken to hold all of the light
    if kernel.meta.get("energy") == 1.0:
        kernel.meta["total_assumed"] = True
    return kernel


def _on_sky(psf):
    """Return a PSF of its file, name or pair; refuse one in the detector's frame whose angle is not known."""
    psf = instrument_psf(named_psf(psf))
    if psf.frame == "detector" and psf.pa_aper is None:
        wanted = (
            "that of the image on the sky, psf_mosaic(miri_psf('F770W'), pixel_scale, exposure.pa_aper) of "
            "miricigale.psf"
        )
        raise argument_error("psf", wanted, "one in the frame of the detector")
    return psf


def _as_kernels(kernel):
    """Make the kernel of an image, or those of exposures, of anything that stands for them."""
    if isinstance(kernel, ExposureKernels):
        return kernel
    if isinstance(kernel, (list, tuple)):
        kinds = (MatchingKernel, KernelField)
        if all(isinstance(member, kinds) for member in kernel):
            return ExposureKernels(kernel)
    return as_kernel(kernel)


def is_sampled(psf):
    """Whether a PSF is an array, a model or a file without the size of its pixels."""
    if isinstance(psf, (InstrumentPSF, GriddedPSFModel)):
        return False
    if is_path(psf):
        return os.path.isfile(split_extension(psf)[0]) and not states_pixel(psf)
    return isinstance(psf, np.ndarray) or hasattr(psf, "param_names") or hasattr(psf, "array")


def _on_pixels(psf, image):
    """Return a PSF on the pixels of an image, in the direction of its axes, if it does not state its own."""
    if not is_sampled(psf):
        return psf
    scale = pixel_scale(image.wcs) * ANGLE
    angle = grid_angle(image.wcs, image.shape)
    if is_path(psf):
        return read_psf(psf, pixel_scale=scale, frame="sky", angle=angle)
    return from_photutils(psf, pixel_scale=scale, frame="sky", angle=angle)
