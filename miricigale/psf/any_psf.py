"""PSFs of whatever a user has for one: models of photutils and astropy, kernels, arrays."""

import numpy as np
from photutils.psf import GriddedPSFModel, ImagePSF

from miricigale.utils.exceptions import argument_error
from miricigale.utils.missing_values import floats
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords

#: Sum of a PSF from which on it was normalized on its grid, and says nothing of the light beyond.
UNIT_SUM = 0.995
#: Sum of an array below which it does not say the part of the light either, but is an image in any unit.
_LEAST_PART = 0.85


@takes_other_keywords
def as_psf(psf, argument="psf"):
    """
    Return the PSF of whatever a user has for one.

    Parameters
    ----------
    psf : `~photutils.psf.ImagePSF`, `~photutils.psf.GriddedPSFModel`, model, kernel or array
        PSFs are returned as they are. Of a functional model of photutils or astropy (with ``x_0``, ``y_0`` and
        ``flux``) its values about the center are taken, four to a pixel; an array or an astropy kernel has one
        value for each pixel of the image that it is for.
    argument : str, optional
        The argument's name for messages.

    Returns
    -------
    psf : `~photutils.psf.ImagePSF` or `~photutils.psf.GriddedPSFModel`
        Of unit sum if it was made of something else.

    Raises
    ------
    ValueError
        If it is nothing of these, or holds no light.

    Examples
    --------
    >>> from photutils.psf import GaussianPSF
    >>> from miricigale.psf import as_psf
    >>> psf = as_psf(GaussianPSF(x_fwhm=3, y_fwhm=3))
    >>> psf.oversampling.tolist()
    [4, 4]
    """
    if isinstance(psf, (ImagePSF, GriddedPSFModel)):
        return psf
    cells = 1
    if {"x_0", "y_0", "flux"} <= set(getattr(psf, "param_names", ())):
        # copies of the model: the parameters of a model of photutils are the user's
        cells = 4
        model = psf.copy()
        model.x_0 = 0.0
        model.y_0 = 0.0
        model.flux = 1.0
        reach = max(5.0, *np.abs(np.ravel(model.bounding_box.bounding_box())))
        axis = np.arange(-np.ceil(reach * cells), np.ceil(reach * cells) + 1) / cells
        data = model(*np.meshgrid(axis, axis))
    else:
        values = getattr(psf, "array", psf)
        data = np.asarray(values)
        if hasattr(values, "mask"):
            # masked pixels are refused below
            data = floats(values)
    wanted = "a PSF or model of photutils, an astropy kernel or a 2D array"
    check_that(data.ndim == 2 and data.dtype.kind in "iuf", argument, wanted, type(psf).__name__)
    data = data.astype(float)
    if not np.all(np.isfinite(data)) or not data.sum() > 0:
        raise argument_error(argument, "finite, with a positive sum", f"a sum of {data.sum()}")
    if min(data.shape) < 4:
        # photutils interpolates between four values at least
        data = np.pad(data, 2)
    return ImagePSF(data * (cells**2 / data.sum()), oversampling=cells)


def stated_part(values):
    """
    Return the part of the light that an array or kernel states by its sum; 1 if its sum states none.

    The same as of a file, whose sum `make_psf` takes for it.
    """
    array = getattr(values, "array", values)
    if isinstance(values, (ImagePSF, GriddedPSFModel)) or not isinstance(array, np.ndarray):
        return 1.0
    total = float(np.sum(floats(array)))
    if _LEAST_PART <= total < UNIT_SUM:
        return total
    return 1.0
