"""Kernels of exposures that are fitted together: one, or a field of them, for each exposure."""

import functools

import astropy.units as u
import numpy as np
from astropy.io import fits

from miricigale.instrument import ImageFacts, aperture, subarrays
from miricigale.instrument.sky_axes import grid_angle
from miricigale.photometry.images.arrays import pixel_scale
from miricigale.psf import (
    KernelField,
    MatchingKernel,
    filter_psf,
    imager_kernels,
    instrument_psf,
    rotate_psf,
)
from miricigale.psf.distorted import moved_kernels
from miricigale.psf.miri import MIRI_FILTERS
from miricigale.utils.exceptions import argument_error
from miricigale.utils.options import check_that
from miricigale.utils.units import ANGLE
from miricigale.utils.values import value_class

#: Difference of rolls (deg) below which exposures share their kernels.
_SAME_ROLL = 0.05


def are_exposures(image):
    """Return whether an image stands for several exposures: a list, but not that of the HDUs of one file."""
    return isinstance(image, (list, tuple)) and not isinstance(image, fits.HDUList)


@value_class
class ExposureKernels:
    """
    Kernels from one high-resolution image to several exposures, in their order.

    Parameters
    ----------
    kernels : sequence of `~miricigale.psf.MatchingKernel` or `~miricigale.psf.KernelField`
        On the same pixels, with their PSFs.

    Raises
    ------
    ValueError
        If there is none, one is something else or has no PSFs, or they differ in form.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.photometry import ExposureKernels, ForcedPhotometer
    >>> from miricigale.psf import MatchingKernel, gaussian_psf
    >>> form = {"pixel_scale": 0.06 * u.arcsec, "fov": 3 * u.arcsec}
    >>> sharp = gaussian_psf(0.2 * u.arcsec, **form)
    >>> wide = [gaussian_psf(width * u.arcsec, **form) for width in (0.5, 0.6)]
    >>> kernels = ExposureKernels([MatchingKernel.from_psfs(sharp, one) for one in wide])
    >>> len(kernels)
    2
    >>> photometer = ForcedPhotometer(kernels)
    """

    kernels: tuple

    def __post_init__(self):
        kernels = tuple(self.kernels)
        object.__setattr__(self, "kernels", kernels)
        wanted = "a MatchingKernel or a KernelField for each exposure"
        check_that(kernels, "kernel", wanted, "none")
        for kernel in kernels:
            if not isinstance(kernel, (MatchingKernel, KernelField)):
                raise argument_error("kernel", wanted, type(kernel).__name__)
            mean = mean_kernel(kernel)
            if mean.source is None or mean.target is None:
                raise argument_error("kernel", "kernels with their PSFs", "one without")

    @classmethod
    def from_images(cls, images, highres, highres_psf=None, *, n_psfs=9, **options):
        """
        Make the kernels of MIRI exposures from the model PSFs of their places and rolls.

        Parameters
        ----------
        images : sequence of `~astropy.nddata.CCDData`
            Exposures (``_cal``), whose meta has ``filter``, and if they are there ``pa_aper`` (deg; otherwise by
            the coordinates, to 0.3 deg) and ``subarray`` (otherwise by the shape).
        highres : `~astropy.nddata.CCDData`
            The high-resolution image, on whose pixels the kernels are.
        highres_psf : `~photutils.psf.ImagePSF`, optional
            Its PSF, on the sky; by default the model of its filter.
        n_psfs : int, optional
            Places on the array (see `~miricigale.psf.imager_kernels`).
        **options
            Those of `~miricigale.psf.miri_psf`.

        Returns
        -------
        kernels : `ExposureKernels`
            Exposures whose rolls differ by less than 0.05 deg share their kernels.

        Raises
        ------
        ValueError, KeyError
            If an exposure states no filter or one without a model, or there is no such sub-array.
        """
        scale = pixel_scale(highres.wcs) * ANGLE
        turn = grid_angle(highres.wcs, highres.shape)
        sharp = _sharp_psf(highres, highres_psf, scale, turn)
        roll_fields = []
        kernels = []
        for k, image in enumerate(images):
            # exposures of one filter, sub-array and roll have the same kernels, but for their places
            facts = ImageFacts.of(image)
            wanted = "exposures of one of the imager's filters"
            is_imager = facts.filter in MIRI_FILTERS
            check_that(is_imager, f"images[{k}]", wanted, facts.filter)
            pa = exposure_roll(image)
            alike = {"filter": facts.filter, "subarray": _subarray(image, facts.subarray)}
            for made_for, other_pa, wcs, field in roll_fields:
                if made_for == alike and abs((other_pa - pa + 180) % 360 - 180) < _SAME_ROLL:
                    kernels.append(moved_kernels(field, wcs, image.wcs))
                    break
            else:
                field = imager_kernels(
                    sharp, wcs=image.wcs, pa=pa * u.deg, pixel_scale=scale, grid_angle=turn,
                    n_psfs=n_psfs, **alike, **options,
                )  # fmt: skip
                roll_fields.append((alike, pa, image.wcs, field))
                kernels.append(field)
        return cls(kernels)

    def __len__(self):
        return len(self.kernels)

    def __repr__(self):
        return f"<ExposureKernels for {len(self)} exposures, {self.mean!r}>"

    @functools.cached_property
    def mean(self):
        """The mean `~miricigale.psf.MatchingKernel`."""
        return MatchingKernel.blend(list(map(mean_kernel, self.kernels)))


def mean_kernel(kernel):
    """Return the kernel itself, or the mean of a field of kernels."""
    if isinstance(kernel, KernelField):
        return kernel.mean
    return kernel


def exposure_roll(image):
    """Return the position angle (deg) of the detector's +y, as stated, or that of the coordinates."""
    pa_aper = image.meta.get("pa_aper")
    if pa_aper is None:
        # headers of files have that of an option
        pa_aper = getattr(image, "pa_aper", None)
    if pa_aper is not None and np.size(pa_aper) == 1:
        return float(np.ravel(u.Quantity(pa_aper, u.deg).value)[0])
    return float(grid_angle(image.wcs, image.shape).to_value(u.deg))


def _subarray(image, stated_name):
    """Name of the sub-array: as stated, or that of the shape."""
    if stated_name is not None:
        return stated_name
    for name in subarrays():
        if aperture(name).shape == image.shape:
            return name
    shapes = {name: aperture(name).shape for name in subarrays()}
    raise argument_error(
        "images", f"of one of the shapes {shapes}, or with 'subarray'", image.shape
    )


def _sharp_psf(highres, psf, scale, turn):
    """Return the PSF of the high-resolution image on its axes."""
    if psf is not None:
        psf = instrument_psf(psf, "highres_psf")
        return rotate_psf(psf, grid_angle=turn)
    pa_aper = highres.meta.get("pa_aper")
    pa = None if pa_aper is None else u.Quantity(pa_aper, u.deg)
    name = ImageFacts.of(highres).filter
    check_that(
        name is not None, "highres", "one whose meta has its filter (or 'highres_psf')", None
    )
    return filter_psf(name, pixel_scale=scale, pa=pa, grid_angle=turn)
