"""From the sky to the pixels of an image: positions and the local linear map."""

import numpy as np

from miricigale.instrument.sky_axes import pixel_to_radec, radec_axes


def local_jacobian(wcs, x, y):
    """
    Return the local linear map from the sky to the pixels at positions ``x``, ``y``, (N,).

    Shape (N, 2, 2), in pixels per arcsec: ``[dx, dy] = jacobian @ [east, north]``.
    """

    def world(dx, dy):
        return np.asarray(pixel_to_radec(wcs, x + dx, y + dy))

    _, dec = world(0, 0)
    columns = []
    for step in ((0.5, 0.0), (0.0, 0.5)):
        d_ra, d_dec = world(*step) - world(-step[0], -step[1])
        d_ra = (d_ra + 180.0) % 360.0 - 180.0
        columns.append(3600.0 * np.stack([d_ra * np.cos(np.radians(dec)), d_dec], axis=-1))
    return np.linalg.inv(np.stack(columns, axis=-1))


def pixel_positions(wcs, sky, shape):
    """
    Return the pixels of a SkyCoord, by the distortion where it is defined and linear far from the image.

    Returns x, y (NaN on the other side of the sky), and which of them lie within half an image of
    the image, whose ``shape`` is (ny, nx).
    """
    ny, nx = shape
    ra = sky.icrs.ra.deg
    dec = sky.icrs.dec.deg
    world = np.array(radec_axes(wcs, ra, dec))
    x, y = np.asarray(wcs.wcs_world2pix(world[0], world[1], 0), dtype=float)
    is_near = (x > -0.5 * nx) & (x < 1.5 * nx) & (y > -0.5 * ny) & (y < 1.5 * ny)
    if np.any(is_near):
        lon, lat = world[:, is_near]
        x[is_near], y[is_near] = wcs.all_world2pix(lon, lat, 0, quiet=True)
    return x, y, is_near
