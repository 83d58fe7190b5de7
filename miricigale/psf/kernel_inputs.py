"""What a matching kernel is made of, on one grid: centered, turned, normalized, or refused."""

import logging
import os

import astropy.units as u
import numpy as np
from photutils.psf import GriddedPSFModel, ImagePSF
from scipy.signal import fftconvolve

from miricigale.filters import Filter
from miricigale.psf import _core
from miricigale.psf.model import from_photutils, instrument_psf, make_psf
from miricigale.psf.resample import average_psf, centered_psf, psf_image, psf_mosaic, rotate_psf
from miricigale.psf.wiener import checked_square, gaussian_gain
from miricigale.utils.exceptions import PSFWarning, argument_error, warn
from miricigale.utils.files import is_path, split_extension
from miricigale.utils.options import check_that
from miricigale.utils.units import ANGLE, scalar

_log = logging.getLogger(__name__)


def named_psf(psf):
    """Return the PSF of a file, of the name of a filter or of a pair with its pixel; anything else itself."""
    if isinstance(psf, tuple) and len(psf) == 2 and is_path(psf[0]):
        from miricigale.psf.files import read_psf

        return read_psf(psf[0], pixel_scale=psf[1])
    if isinstance(psf, tuple):
        return instrument_psf(psf)
    if isinstance(psf, os.PathLike) or (is_path(psf) and os.path.isfile(split_extension(psf)[0])):
        from miricigale.psf.files import read_psf

        return read_psf(psf)
    if isinstance(psf, (str, Filter)):
        from miricigale.psf.by_filter import exposure_psf

        return exposure_psf(psf)
    return psf


def psf_pair(
    hi, lo, scale, *, angles, grid_angle=0.0 * u.deg, resampling=None, extent=None, normalize=None
):
    """
    The sharp PSF, of unit sum, and the wide one, of what it holds or of unit sum, on the pixels of an image.

    Two arrays, (n, n), n odd, centered, and ``energy``, ``held`` and ``centering`` of the kernel's meta.
    Parameters are those of `~miricigale.psf.MatchingKernel.from_psfs`, ``scale`` the pixel in arcsec,
    ``angles`` those of the two.
    """
    inputs = {"hi": hi, "lo": lo}
    psfs = {}
    centering = {}
    for name, psf in inputs.items():
        wanted = "an ImagePSF or an array (psf_at gives the PSF of a grid at a position)"
        check_that(not isinstance(psf, GriddedPSFModel), name, wanted, type(psf).__name__)
        if hasattr(psf, "param_names") and not isinstance(psf, ImagePSF):
            inputs[name] = from_photutils(psf, pixel_scale=scale * ANGLE, angle=grid_angle)
    arrays = {k: np.shape(v) for k, v in inputs.items() if not isinstance(v, ImagePSF)}
    check_that(len(set(arrays.values())) <= 1, "hi, lo", "arrays of the same shape", arrays)
    for (name, psf), angle in zip(inputs.items(), angles, strict=True):
        if name in arrays:
            psf = _from_array(psf, name, scale, angle, grid_angle, normalize)
        psfs[name], centering[name] = centered_psf(psf, 0.01 * scale, name)
    # pixels whose centers lie on the arrays; a PSF that is resampled reaches to its edge
    half = min((psfs[k].half_width - 0.5 * scale for k in arrays), default=psfs["lo"].half_width)
    n = 2 * int(half / scale + 1e-6) + 1
    if extent is not None:
        wanted = 2 * int(scalar(extent, ANGLE, "extent") / scale / 2) + 1
        text = f"from 5 pixels to the {n * scale:.4g} arcsec of the PSFs"
        check_that(5 <= wanted <= n, "extent", text, extent)
        n = wanted
    images = []
    for (name, psf), angle in zip(psfs.items(), angles, strict=True):
        images.append(
            _on_grid(psf, name, angle, grid_angle, scale, n, resampling if name == "lo" else None)
        )
    held = [float(image.sum()) for image in images]
    if normalize is None:
        # templates are of unit sum through the sharp PSF, whatever that holds
        normalize = not psfs["lo"].total_known
        missing = {name: max(0.0, _missing(psf)) for name, psf in psfs.items()}
        if normalize and max(missing.values()) > 0.01:
            text = ", ".join(f"{value:.3f} of '{name}'" for name, value in missing.items())
            text = f"light beyond the PSFs' grids, by their own sums and wings: {text}. The kernel "
            text += "is normalized to 1: fluxes lack what lies beyond. Give the light that a grid holds, "
            text += "enclosed=0.95 of make_psf or read_psf; or the filter, whose model says it, "
            text += "filter='F770W' of ForcedPhotometer or checked_psf; or normalize=True of "
            text += "MatchingKernel.from_psfs, if fluxes should lack it"
            warn(text, PSFWarning)
    energy = 1.0
    if not normalize:
        energy = held[1]
    mended = {"energy": energy, "held": held, "centering": centering}
    return images[0] / held[0], images[1] * (energy / held[1]), mended


def _missing(psf):
    """Return the light beyond the grid: what the sum leaves, or where it leaves nothing what wings say."""
    claimed = 1 - psf.enclosed
    if psf.total_known or claimed > 0.01:
        return claimed
    edge = psf.half_width / psf.cell
    x, y = psf.origin
    sums = _core.radial_sums(psf.data, x, y, np.array([0.5, 0.75, 1.0]) * edge)
    inner, middle, outer = sums / float(psf.data.sum())
    # wings that fall as r**-3 hold half as much in the outer ring as in the inner one, and three
    # times as much beyond it; those of a Gaussian or a steep Moffat fall faster
    ring = outer - middle
    return max(claimed, 3 * ring if ring > 0.35 * (middle - inner) else 0.0)


def _from_array(array, name, scale, angle, grid_angle, normalize):
    """Return an array on the image's pixels as a PSF."""
    array = checked_square(array, name, odd=False)
    total = array.sum()
    wanted = "a PSF whose sum is the fraction of light it holds (or 'normalize' True)"
    check_that(0 < total < (np.inf if normalize else 1.02), name, wanted, f"a sum of {total:.6g}")
    frame = "detector"
    if angle is None:
        frame = "sky"
    try:
        return make_psf(
            array, pixel_scale=scale * ANGLE, frame=frame, angle=grid_angle,
            enclosed=1.0 if normalize else None,
        )  # fmt: skip
    except ValueError as err:
        raise ValueError(str(err).replace("'data'", f"'{name}'")) from None


def _on_grid(psf, name, angle, grid_angle, scale, n, resampling):
    """Return one PSF on n x n pixels of the image, its sum the enclosed fraction."""
    if psf.frame == "detector" and angle is None:
        wanted = "the position angle of the detector's +y (the PSF is in the detector frame)"
        check_that(psf.pa_aper is not None, name + "_angle", wanted, "None")
        angle = psf.pa_aper
        _log.info("'%s' is turned by the %.4f deg of its header", name, angle.value)
    if resampling:
        psf = psf_mosaic(psf, scale * ANGLE, angle, grid_angle=grid_angle)
    else:
        angles = [None]
        if angle is not None:
            angles = list(np.atleast_1d(angle))
        try:
            rotated = [
                rotate_psf(psf, angle_of_roll, grid_angle=grid_angle) for angle_of_roll in angles
            ]
        except ValueError as err:
            raise ValueError(str(err).replace("'angle'", f"'{name}_angle'")) from None
        if len(rotated) > 1:
            psf = average_psf(rotated)
        else:
            psf = rotated[0]
    return psf_image(psf, pixel_scale=scale * ANGLE, shape=n)


def ready_arrays(array, scale, **psfs):
    """
    Return a kernel that came ready, of unit sum, its PSFs that are not None, of unit sum, and what it summed to.

    Parameters are those of `~miricigale.psf.MatchingKernel.from_array`, ``scale`` the pixel in arcsec. There is a
    target also if only the source is given.
    """
    array = checked_square(array, "array")
    total = float(array.sum())
    check_that(0.9 <= total <= 1.1, "array", "a kernel whose sum is 1", f"a sum of {total:.6g}")
    array = array / total
    texts = []
    if abs(total - 1) > 1e-3:
        texts = [f"summed to {total:.4f} and was brought to 1"]
    c = array.shape[0] // 2
    x, y, _ = _core.core_moments(array)
    if not np.hypot(x - c, y - c) < 0.1:
        texts.append(f"stands ({x - c:.2f}, {y - c:.2f}) pixels off the center")
    for text in texts:
        warn(f"the matching kernel {text}", PSFWarning)
    images = {}
    for name, psf in psfs.items():
        if isinstance(psf, ImagePSF):
            psf = psf_image(psf, pixel_scale=scale * ANGLE, shape=array.shape)
        if psf is not None:
            psf = checked_square(psf, name)
            if psf.shape != array.shape or not psf.sum() > 0:
                wanted = f"a PSF of the kernel's shape {array.shape}"
                raise argument_error(name, wanted, f"{psf.shape} with a sum of {psf.sum():.4g}")
            images[name] = psf / psf.sum()
    if "source" in images and "target" not in images:
        images["target"] = fftconvolve(images["source"], array, mode="same")
    elif len(images) == 2:
        # refuses a pair in the wrong order
        gaussian_gain(images["source"], images["target"], "source, target")
    return array, images, total
