"""Ellipses carried through a local linear map, such as the distortion of a camera."""

import numpy as np

from miricigale.utils.missing_values import floats


def ellipse_to_pixels(jacobian, *, radius, axis_ratio, position_angle):
    """
    Ellipses on the sky as ellipses on the pixel grid.

    Parameters
    ----------
    jacobian : `~numpy.ndarray`, shape (..., 2, 2)
        Pixels per unit of angle, ``[dx, dy] = jacobian @ [east, north]``.
    radius : array-like
        Semi-major axes, in that unit of angle.
    axis_ratio : array-like
        Minor over major axis.
    position_angle : array-like
        Radians, east of north.

    Returns
    -------
    radius, axis_ratio, theta : `~numpy.ndarray`
        Pixels, ratio and radians from +x toward +y, in (-pi/2, pi/2].

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.profiles import ellipse_to_pixels
    >>> north_up = np.array([[-10.0, 0.0], [0.0, 10.0]])  # pixels of 0.1 arcsec, east to the left
    >>> a, ratio, theta = ellipse_to_pixels(
    ...     north_up, radius=0.5, axis_ratio=0.4, position_angle=np.radians(30.0)
    ... )
    >>> print(f"{a:.1f} pixels, ratio {ratio:.1f}, {np.degrees(theta):.0f} deg from +x")
    5.0 pixels, ratio 0.4, -60 deg from +x
    """
    direction = np.pi / 2 - floats(position_angle)
    radius = floats(radius)
    axis_ratio = floats(axis_ratio)
    jacobian = floats(jacobian)
    radius, axis_ratio, direction = np.broadcast_arrays(radius, axis_ratio, direction)
    cos = np.cos(direction)
    sin = np.sin(direction)
    # columns: the images of the two semi-axes; their outer products add up to the shape matrix
    axes = np.stack([cos, -axis_ratio * sin, sin, axis_ratio * cos], -1).reshape(cos.shape + (2, 2))
    axes = jacobian @ (axes * radius[..., None, None])
    shape = axes @ np.swapaxes(axes, -1, -2)
    a = shape[..., 0, 0]
    b = shape[..., 0, 1]
    c = shape[..., 1, 1]
    root = np.hypot(0.5 * (a - c), b)
    major2 = 0.5 * (a + c) + root
    area = np.abs(np.linalg.det(axes))  # keeps thin ellipses exact: major * minor
    major = np.sqrt(major2)
    ratio = np.divide(area, major2, out=np.ones_like(area), where=major2 > 0)
    new = 0.5 * np.arctan2(2 * b, a - c)
    return major, np.minimum(ratio, 1.0), new
