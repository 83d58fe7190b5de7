"""Sersic profiles: closed forms and pixel-integrated images."""

import numpy as np
import scipy

from miricigale.utils.missing_values import floats
from miricigale.utils.options import check_that

_IN_STAMP = 0.995  # of the light lies within the isophote that a stamp holds
#: Indices that the images are made and tested for.
SERSIC_INDEX_RANGE = (0.2, 10.0)


def sersic_faults(radius, index, ratio, angle):
    """
    Find what is wrong with the numbers of Sersic profiles.

    Parameters
    ----------
    radius, index, ratio, angle : `~numpy.ndarray`, shape (n,)
        Half-light radii, indices, axis ratios and position angles; NaN where one is missing.

    Returns
    -------
    faults : dict of str to `~numpy.ndarray` of bool, shape (n,)
        By the name of the column of a catalog: which radii are not positive, indices outside `SERSIC_INDEX_RANGE`,
        axis ratios outside (0, 1], and angles not finite of profiles that are not round.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.profiles.sersic import sersic_faults
    >>> radius, index = np.array([0.3, 0.0]), np.array([np.nan, 4.0])
    >>> sersic_faults(radius, index, ratio=np.ones(2), angle=np.zeros(2))["half_light_radius"]
    array([False,  True])
    """
    low, high = SERSIC_INDEX_RANGE
    return {
        "half_light_radius": ~(np.isfinite(radius) & (radius > 0)),
        "sersic_index": ~((index >= low) & (index <= high)),
        "axis_ratio": ~((ratio > 0) & (ratio <= 1)),
        "position_angle": ~np.isfinite(angle) & (ratio != 1),
    }


def describe_faults(faults, sersic):
    """
    Say how many Sersic profiles are drawn as points, and why; an empty text if none is.

    Parameters
    ----------
    faults : dict of str to `~numpy.ndarray` of bool, shape (n,)
        As of `sersic_faults`.
    sersic : `~numpy.ndarray` of bool, shape (n,)
        Which rows are Sersic profiles.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.profiles.sersic import describe_faults
    >>> faults = {"half_light_radius": np.array([True, False]), "axis_ratio": np.zeros(2, bool)}
    >>> describe_faults(faults, np.ones(2, bool))
    '1 of 2 Sersic profiles are drawn as points: half_light_radius is missing or not positive in 1'
    """
    low, high = SERSIC_INDEX_RANGE
    wrong = {
        "half_light_radius": "not positive",
        "sersic_index": f"outside {low:g} to {high:g}",
        "axis_ratio": "not in (0, 1]",
        "position_angle": "not finite",
    }
    drawn_as_point = np.any(list(faults.values()), axis=0) & sersic
    if not drawn_as_point.any():
        return ""
    reasons = []
    for name, rows in faults.items():
        n = np.count_nonzero(rows & sersic)
        if n:
            reasons.append(f"{name} is missing or {wrong[name]} in {n}")
    n_points = np.count_nonzero(drawn_as_point)
    n_sersic = np.count_nonzero(sersic)
    return f"{n_points} of {n_sersic} Sersic profiles are drawn as points: {', '.join(reasons)}"


def sersic_bn(n):
    """
    The constant b_n that makes R_e enclose half the light.

    Parameters
    ----------
    n : array-like
        Sersic index, positive.

    Returns
    -------
    bn : `~numpy.ndarray` or float
        Exact solution of gamma(2 n, b_n) = Gamma(2 n) / 2.

    References
    ----------
    Ciotti & Bertin 1999, A&A 352, 447; Graham & Driver 2005, PASA 22, 118, eq. 1.

    Examples
    --------
    >>> from miricigale.profiles import sersic_bn
    >>> float(sersic_bn(4.0))
    7.6692494425008
    """
    return scipy.special.gammaincinv(2.0 * floats(n), 0.5)[()]


def sersic_enclosed_fraction(radius, n):
    """
    Light within an (elliptical) radius.

    Parameters
    ----------
    radius : array-like
        Radius along the major axis in units of the half-light radius.
    n : array-like
        Sersic index.

    Returns
    -------
    fraction : `~numpy.ndarray` or float
        Enclosed over total light.

    References
    ----------
    Graham & Driver 2005, PASA 22, 118, eq. 2.

    Examples
    --------
    >>> from miricigale.profiles import sersic_enclosed_fraction
    >>> sersic_enclosed_fraction([1.0, 10.0], 4.0)
    array([0.5      , 0.9614859])
    """
    n = floats(n)
    x = floats(radius)
    return scipy.special.gammainc(2 * n, sersic_bn(n) * x ** (1 / n))[()]


def sersic_radius(fraction, n):
    """
    Radius (over the half-light radius) that encloses a fraction; inverse of `sersic_enclosed_fraction`.

    Examples
    --------
    >>> from miricigale.profiles import sersic_radius
    >>> sersic_radius([0.5, 0.9], 4.0).round(3)
    array([1.   , 5.549])
    """
    n = floats(n)
    x = scipy.special.gammaincinv(2 * n, floats(fraction))
    return ((x / sersic_bn(n)) ** n)[()]


def light_table(n):
    """
    Table of the enclosed light that the numerical core reads.

    Parameters
    ----------
    n : array-like, shape (N,)
        Sersic indices.

    Returns
    -------
    table : `~numpy.ndarray`, shape (N, 5, TABLE_SIZE)
        Enclosed fraction and its derivative, first radial moment and its derivative, second
        derivative of the enclosed fraction, at even steps of ln(R / R_e).
    """
    from miricigale.profiles import _core

    n = np.atleast_1d(floats(n))[:, None]
    bn = sersic_bn(n)
    log_r = _core.TABLE_START + _core.TABLE_STEP * np.arange(_core.TABLE_SIZE)[None]
    z = bn * np.exp(log_r / n)
    # dF / d ln R
    density = np.exp(2 * n * np.log(bn) - scipy.special.gammaln(2 * n) + 2 * log_r - z) / n
    fraction = scipy.special.gammainc(2 * n, z)
    scale = scipy.special.gammaln(3 * n) - scipy.special.gammaln(2 * n) - n * np.log(bn)
    moment = np.exp(scale) * scipy.special.gammainc(3 * n, z)
    bend = density * (2 - z / n)
    return np.stack([fraction, density, moment, density * np.exp(log_r), bend], axis=1)


def parameter_rows(*, x, y, total_flux, r_eff, n, axis_ratio, theta):
    """
    Parameters of the numerical core.

    Parameters are arrays of equal length: positions and radii in cells, theta in radians.

    Returns
    -------
    rows : `~numpy.ndarray`, shape (N, 13)
        Columns as in ``_core.PARAMETERS``.
    """
    values = (x, y, total_flux, r_eff, n, axis_ratio, theta)
    values = np.broadcast_arrays(*(np.atleast_1d(floats(v)) for v in values))
    x, y, total_flux, r_eff, n, axis_ratio, theta = values
    bn = sersic_bn(n)
    minor = axis_ratio * r_eff
    log_norm = 2 * n * np.log(bn) - scipy.special.gammaln(2 * n)
    intensity = total_flux * np.exp(log_norm) / (2 * np.pi * n * r_eff * minor)
    xx = np.cos(theta) / r_eff
    xy = np.sin(theta) / r_eff
    yx = -np.sin(theta) / minor
    yy = np.cos(theta) / minor
    a = xx**2 + yx**2
    b = xx * xy + yx * yy
    c = xy**2 + yy**2
    return np.stack([x, y, total_flux, intensity, xx, xy, yx, yy, a, b, c, 0.5 / n, bn], axis=-1)


def _check(total_flux, r_eff, n, axis_ratio):
    check_that(np.isfinite(total_flux), "total_flux", "finite", total_flux)
    check_that(np.isfinite(r_eff) and r_eff > 0, "r_eff", "positive", r_eff)
    low, high = SERSIC_INDEX_RANGE
    check_that(low <= n <= high, "n", f"within {low} and {high}", n)
    check_that(0 < axis_ratio <= 1, "axis_ratio", "above 0 and at most 1", axis_ratio)


def sersic_image(shape, *, x, y, total_flux=1.0, r_eff, n, axis_ratio=1.0, theta=0.0):
    """
    A Sersic profile integrated over pixels.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the image.
    x, y : float
        Center in pixels; pixel centers are integers.
    total_flux : float, optional
        Light to infinity.
    r_eff : float
        Half-light radius along the major axis in pixels.
    n : float
        Sersic index, 0.2 to 10.
    axis_ratio : float, optional
        Minor over major axis.
    theta : float, optional
        Radians from +x toward +y.

    Returns
    -------
    image : `~numpy.ndarray`, shape ``shape``
        Light in each pixel, in the unit of ``total_flux``. What falls outside the image
        is not in it: the sum is smaller than ``total_flux``.

    Raises
    ------
    ValueError
        If a parameter is out of range.

    Notes
    -----
    The cusp is integrated: pixels near the center are exact sums over their edges of the
    closed-form enclosed light, the others one evaluation with the analytic Laplacian or
    Gauss-Legendre points.

    References
    ----------
    Sersic 1968, Atlas de Galaxias Australes; Graham & Driver 2005, PASA 22, 118.

    Examples
    --------
    >>> from miricigale.profiles import sersic_image
    >>> image = sersic_image((101, 101), x=50.2, y=49.7, r_eff=3.0, n=1.0, axis_ratio=0.5)
    >>> round(float(image.sum()), 5)
    1.0
    """
    _check(total_flux, r_eff, n, axis_ratio)
    rows = parameter_rows(
        x=x, y=y, total_flux=total_flux, r_eff=r_eff, n=n, axis_ratio=axis_ratio, theta=theta
    )
    image = np.zeros(shape)
    from miricigale.profiles import _core

    _core.sersic_cells(image, rows[0], light_table(n)[0])
    return image


def sersic_stamp(*, x, y, total_flux=1.0, r_eff, n, axis_ratio=1.0, theta=0.0, max_radius=np.inf):
    """
    A Sersic profile on the smallest stamp that holds the isophote of 99.5 % of its light.

    Parameters
    ----------
    x, y, total_flux, r_eff, n, axis_ratio, theta
        As in `sersic_image`.
    max_radius : float, optional
        Largest semi-major axis of that isophote in pixels; the light beyond is lost (the
        sum of the stamp says how much is there).

    Returns
    -------
    stamp : `~numpy.ndarray`
        Light in each pixel.
    origin : tuple of int
        Row and column of the stamp's first pixel in the frame of ``x`` and ``y``.

    Examples
    --------
    >>> from miricigale.profiles import sersic_stamp
    >>> stamp, origin = sersic_stamp(x=40.2, y=55.0, r_eff=2.0, n=1.0)
    >>> stamp.shape, origin, round(float(stamp.sum()), 3)
    ((19, 19), (46, 31), 0.998)
    """
    _check(total_flux, r_eff, n, axis_ratio)
    radius = min(r_eff * sersic_radius(_IN_STAMP, n), max_radius)
    half_x = np.hypot(radius * np.cos(theta), radius * axis_ratio * np.sin(theta))
    half_y = np.hypot(radius * np.sin(theta), radius * axis_ratio * np.cos(theta))
    x0 = int(np.floor(x - half_x + 0.5))
    x1 = int(np.ceil(x + half_x - 0.5))
    y0 = int(np.floor(y - half_y + 0.5))
    y1 = int(np.ceil(y + half_y - 0.5))
    stamp = sersic_image(
        (y1 - y0 + 1, x1 - x0 + 1),
        x=x - x0,
        y=y - y0,
        theta=theta,
        total_flux=total_flux,
        r_eff=r_eff,
        n=n,
        axis_ratio=axis_ratio,
    )
    return stamp, (y0, x0)
