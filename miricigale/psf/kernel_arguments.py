"""Kernels of whatever a user has for one."""

import astropy.units as u
import numpy as np
from astropy.nddata import NDData
from astropy.wcs.utils import proj_plane_pixel_scales

from miricigale.psf.kernel_field import KernelField
from miricigale.psf.kernels import MatchingKernel
from miricigale.utils.exceptions import argument_error
from miricigale.utils.files import is_path
from miricigale.utils.other_keywords import takes_other_keywords


@takes_other_keywords
def as_kernel(kernel):
    """
    Return the kernel of anything that is one.

    Parameters
    ----------
    kernel : `MatchingKernel`, `KernelField`, path-like, pair or `~astropy.nddata.NDData`
        A kernel, its file, an array with its pixel scale (``(array, 0.03 * u.arcsec)``), or an image with world
        coordinates.

    Returns
    -------
    kernel : `MatchingKernel` or `KernelField`
        An array is taken as by `MatchingKernel.from_array`.

    Raises
    ------
    ValueError
        If it is nothing of these; the message says what is missing.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropy.convolution import Gaussian2DKernel
    >>> from miricigale.psf import as_kernel
    >>> kernel = as_kernel((Gaussian2DKernel(3).array, 0.03 * u.arcsec))
    >>> kernel.pixel_scale
    <Quantity 0.03 arcsec>
    """
    if isinstance(kernel, (MatchingKernel, KernelField)):
        return kernel
    if is_path(kernel):
        from miricigale.psf.kernel_io import read_kernel

        return read_kernel(kernel)
    if isinstance(kernel, NDData) and kernel.wcs is not None:
        scale = np.sqrt(np.prod(proj_plane_pixel_scales(kernel.wcs.celestial))) * u.deg
        return MatchingKernel.from_array(np.asarray(kernel.data), pixel_scale=scale)
    if isinstance(kernel, (tuple, list)) and len(kernel) == 2:
        array, scale = kernel
        # kernels of astropy hold their array
        array = np.asarray(getattr(array, "array", array))
        return MatchingKernel.from_array(array, pixel_scale=scale)
    raise argument_error(
        "kernel",
        "a MatchingKernel, a KernelField, a file, or an array with its pixel scale, such as "
        "(array, 0.03 * u.arcsec) (or give 'psf')",
        type(kernel).__name__,
    )
