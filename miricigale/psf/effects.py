"""What a detector does to the image of a point source: pixels, capacitance, cruciform, blur."""

import math

import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2

from miricigale.filters.band_names import find_filter
from miricigale.psf import _core
from miricigale.psf.optics import jwst_constants
from miricigale.utils.options import check_choice
from miricigale.utils.other_keywords import takes_other_keywords

#: Effects that a PSF may include, in the order in which they act.
EFFECTS = ("jitter", "cruciform", "pixel", "ipc")

#: Length over which the cruciform falls by e, in pixels.
_FOLDING = 25.0

#: Offset of the cross from the source, pixels, against the column or row in the full
#: frame: broken lines through stpsf's nodes, which were read off stars in flight.
_SHIFT_X = ((0.0, 357.0, 1031.0), (1.5, 0.5, -0.9))
_SHIFT_Y = ((0.0, 511.0, 1031.0), (1.6, 0.0, -1.6))

#: Factors on the amplitudes that in-flight images ask for: all scattered light over stpsf's cross.
_IN_FLIGHT = {"miri.f560w": 2.0}

#: Share of the scattered light that is diffuse in flight: a deep image's cross is 1.0-1.3 times
#: stpsf's, the rest a halo around the source.
_HALO = {"miri.f560w": 0.35}

#: Integral of 1 / r over the unit square around r = 0.
_CENTRAL_CELL = 4 * math.log(1 + math.sqrt(2))


def _amplitude(filter_name, calibration):
    """Return the light scattered along each axis per pixel of distance, beyond the inner radius."""
    check_choice(calibration, "calibration", ("flight", "stpsf"))
    # the tabulated kernel holds at an oversampling of 4: one pixel is 4 cells of A / 4^2
    amplitude = jwst_constants()["cruciform"].get(filter_name, 0.0) / 4
    return amplitude * (_IN_FLIGHT.get(filter_name, 1.0) if calibration == "flight" else 1.0)


def _profile(distance, filter_name, calibration):
    inner = jwst_constants()["cruciform_inner_radius"]
    profile = _amplitude(filter_name, calibration) * np.exp(-distance / _FOLDING)
    # the mean of both sides on the step itself, so that sampled sums equal the integral
    return profile * (0.75 + 0.25 * np.sign(distance - inner))


@takes_other_keywords
def cruciform_fraction(filter_name, *, calibration="flight"):
    """
    Return the light that the detector scatters out of the image's core, into the cross and its halo.

    Parameters
    ----------
    filter_name : str
        Any name of the filter, such as ``"F560W"``.
    calibration : {"flight", "stpsf"}, optional
        See `cruciform`.

    Returns
    -------
    fraction : float
        Scattered over scattered plus direct light; zero for filters without a cruciform.

    Examples
    --------
    >>> from miricigale.psf import cruciform_fraction
    >>> for name in ("F560W", "F770W", "F2100W"):
    ...     print(f"{name} {cruciform_fraction(name):.3f}")
    F560W 0.153
    F770W 0.055
    F2100W 0.000
    """
    filter_name = find_filter(filter_name) or filter_name
    inner = jwst_constants()["cruciform_inner_radius"]
    outside = math.exp(-inner / _FOLDING)
    integral = 2 * _FOLDING * (0.5 * (1 - outside) + outside)
    arms = 2 * _amplitude(filter_name, calibration) * integral
    return arms / (1 + arms)


def halo_share(filter_name, *, calibration):
    """
    Share of the scattered light that is in a diffuse halo instead of the cross.

    Parameters
    ----------
    filter_name, calibration
        See `cruciform`.

    Returns
    -------
    share : float
        Zero for stpsf's calibration, and for filters of which no deep image has been compared.
    """
    if calibration == "flight":
        return _HALO.get(filter_name, 0.0)
    return 0.0


def cruciform_shift(x, y):
    """
    Return the offset of the cruciform's center from the source, which leads to the array's middle.

    At 0-based pixels x, y of the full frame: the offset of the arm along the columns in x and of that along
    the rows in y, pixels; nothing at about (598, 511).

    References
    ----------
    stpsf (STScI), ``detectors.py``, from effective PSFs at F560W.
    """
    return float(np.interp(x, *_SHIFT_X)), float(np.interp(y, *_SHIFT_Y))


def _shifted(image, shift, axis):
    """Shift by a fraction of cells, linearly: sum and centroid are kept but for the edge."""
    whole_cells = math.floor(shift)
    part = shift - whole_cells
    result = np.zeros_like(image)
    for step, weight in ((whole_cells, 1 - part), (whole_cells + 1, part)):
        n = image.shape[axis] - abs(step)
        if weight == 0 or n <= 0:
            continue
        source = [slice(None)] * 2
        target = [slice(None)] * 2
        source[axis] = slice(max(0, -step), max(0, -step) + n)
        target[axis] = slice(max(0, step), max(0, step) + n)
        result[tuple(target)] += weight * image[tuple(source)]
    return result


def _diffuse(image, profile):
    """Scatter light evenly in all directions: as far as in the four arms of a ``profile`` by cells."""
    n = image.shape[0]
    size = next_fast_len(2 * n, real=True)
    axis = np.minimum(np.arange(size), size - np.arange(size))
    radius = np.hypot(axis[:, None], axis)
    kernel = np.interp(radius, np.arange(profile.size), profile)
    radius[0, 0] = 1 / _CENTRAL_CELL
    kernel *= 4 / (2 * np.pi * radius)
    # no arm is longer than the image is wide, so that nothing comes around
    kernel[:, axis >= n] = 0.0
    kernel[axis >= n] = 0.0
    spectrum = rfft2(image, (size, size)) * rfft2(kernel)
    return irfft2(spectrum, (size, size))[:n, :n]


def cruciform(image, filter_name, *, oversampling, calibration="flight", shift=(0.0, 0.0)):
    """
    Scatter light along rows and columns, as the detector does at short wavelengths.

    An exponential cross of folding length 25 pixels, half as strong within 12 pixels;
    the sum over the infinite plane is conserved.

    Parameters
    ----------
    image : `~numpy.ndarray`, shape (n, n)
        Oversampled image of a point source, detector axes.
    filter_name, oversampling
        Such as ``"miri.f770w"``; cells per pixel.
    calibration : {"flight", "stpsf"}, optional
        stpsf's amplitudes, or those with the factor 2 that in-flight F560W images want, and a part of the
        light (`halo_share`) that goes evenly in all directions, as far as in the arms.
    shift : tuple of float, optional
        Offset of the cross in x, y in pixels (see `cruciform_shift`).

    References
    ----------
    Gaspar et al. 2021, PASP 133, 014504; stpsf (STScI), ``detectors.py``.
    """
    fraction = cruciform_fraction(filter_name, calibration=calibration)
    if fraction == 0:
        return image
    distance = np.arange(math.ceil(math.sqrt(2) * max(image.shape)) + 1) / oversampling
    kernel = _profile(distance, filter_name, calibration) / oversampling
    columns = _core.line_scatter(image, kernel, 0)
    rows = _core.line_scatter(image, kernel, 1)
    if any(shift):
        columns = _shifted(columns, shift[0] * oversampling, 1)
        rows = _shifted(rows, shift[1] * oversampling, 0)
    scattered = columns + rows
    halo = halo_share(filter_name, calibration=calibration)
    if halo > 0:
        scattered = (1 - halo) * scattered + halo * _diffuse(image, kernel)
    return (image + scattered) * (1 - fraction)


def detector_response(image, *, oversampling, pixel=True, ipc=None, jitter=0.0, boxes=()):
    """
    Convolve an oversampled image with jitter, the pixel and the interpixel capacitance in one transform.

    ``ipc`` are couplings along x, along y and diagonal, ``jitter`` is a standard deviation per axis in pixels,
    ``boxes`` are widths in pixels of further square boxes (drops, output pixels).
    """
    if pixel:
        widths = list(boxes) + [1.0]
    else:
        widths = list(boxes)
    extent = sum(widths) + 5 * jitter + (1 if ipc is not None else 0)
    margin = math.ceil(extent * oversampling) + 1
    shape = [next_fast_len(size + 2 * margin, real=True) for size in image.shape]
    # frequencies in cycles per pixel
    py = np.fft.fftfreq(shape[0])[:, None] * oversampling
    px = np.fft.rfftfreq(shape[1]) * oversampling
    transfer = np.ones((py.size, px.size))
    for width in widths:
        transfer *= np.sinc(px * width) * np.sinc(py * width)
    if ipc is not None:
        # what its neighbors get of a pixel's charge the pixel loses
        along_x, along_y, diagonal = ipc
        cx = np.cos(2 * np.pi * px)
        cy = np.cos(2 * np.pi * py)
        kept_charge = 1.0 - 2 * along_x - 2 * along_y - 4 * diagonal
        transfer *= kept_charge + 2 * along_x * cx + 2 * along_y * cy + 4 * diagonal * cx * cy
    if jitter > 0:
        transfer *= np.exp(-2.0 * (math.pi * jitter) ** 2 * (px**2 + py**2))
    ny, nx = image.shape
    return irfft2(rfft2(image, shape) * transfer, shape)[:ny, :nx]
