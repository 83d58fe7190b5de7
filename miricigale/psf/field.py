"""PSFs over the field, as photutils' gridded models."""

import numpy as np

from miricigale.instrument import aperture, imager_columns
from miricigale.psf.miri import miri_psf
from miricigale.psf.model import SHARED, InstrumentPSF, PSFGrid
from miricigale.psf.resample import alike
from miricigale.utils.exceptions import argument_error
from miricigale.utils.missing_values import floats
from miricigale.utils.named_values import without
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.positions import middle_pixel


@takes_other_keywords
def psf_grid(psfs, positions):
    """
    Put PSFs of different places in one gridded model.

    Parameters
    ----------
    psfs : sequence of `~photutils.psf.ImagePSF`
        Centered on their middle cell, alike in shape, oversampling, frame, angle and effects.
    positions : array_like, shape (n, 2)
        Where on the image they hold, 0-based pixels x, y; all points of a rectangular grid
        of at least 2 x 2.

    Returns
    -------
    grid : `PSFGrid`
        Bilinear between the positions, constant beyond them.

    Raises
    ------
    ValueError
        If the PSFs differ, or the positions are no rectangular grid.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.psf import gaussian_psf, psf_at, psf_grid
    >>> form = {"pixel_scale": 0.1 * u.arcsec, "fov": 2 * u.arcsec}
    >>> psfs = [gaussian_psf(width * u.arcsec, **form) for width in (0.3, 0.3, 0.4, 0.4)]
    >>> grid = psf_grid(psfs, [(0, 0), (0, 100), (100, 0), (100, 100)])
    >>> print(f"{psf_at(grid, 50, 20).fwhm:.3f}")
    0.331 arcsec
    """
    psfs = alike(psfs, ("oversampling", "frame", "angle", "includes"))
    try:
        positions = floats(positions)
    except (TypeError, ValueError):
        raise argument_error("positions", "pairs of numbers (x, y)", repr(positions)) from None
    if positions.ndim != 2 or positions.shape != (len(psfs), 2):
        raise argument_error("positions", f"of shape ({len(psfs)}, 2)", positions.shape)
    columns = np.unique(positions[:, 0])
    rows = np.unique(positions[:, 1])
    points = np.unique(positions, axis=0)
    n = columns.size * rows.size
    if min(columns.size, rows.size) < 2 or not len(psfs) == len(points) == n:
        raise argument_error("positions", "each point of a rectangular grid", positions.tolist())
    for i, psf in enumerate(psfs):
        good = np.allclose(psf.origin, middle_pixel(psf.data.shape))
        check_that(good, "psfs", "centered on the middle", f"{psf.origin} (psfs[{i}])")
    return PSFGrid(psfs, positions)


@takes_other_keywords(options_of=(miri_psf,))
def miri_psf_grid(filter, *, n_psfs=9, subarray="FULL", **options):
    """
    Return the PSFs of the MIRI imager over the field.

    What varies from place to place: the pixel, by the distortion of the SIAF (its sides,
    0.107 to 0.1114 arcsec, its turn by -0.7 to 0.5 deg, its shear), and the center of the
    cruciform, which shifts by up to 1.6 pixels toward the middle of the array. The wavefront
    does not vary.

    Parameters
    ----------
    filter : str or `~miricigale.filters.Filter`
        One of the nine imaging filters.
    n_psfs : int, optional
        How many, a square number of at least 4; they stand on an even grid that reaches the
        edges of the sub-array (of the imager's part of it, see
        `~miricigale.instrument.imager_columns`).
    subarray : str, optional
        One of `~miricigale.instrument.subarrays`, in whose pixels the positions are.
    **options
        Those of `~miricigale.psf.miri_psf`.

    Returns
    -------
    grid : `PSFGrid`
        `~miricigale.scene.Scene` takes it for its PSF.

    Raises
    ------
    ValueError
        If ``n_psfs`` is no square number of at least 4.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.psf import miri_psf_grid
    >>> grid = miri_psf_grid("miri.f1500w", n_psfs=4, fov=3 * u.arcsec, oversampling=2)
    >>> grid.data.shape
    (4, 55, 55)
    """
    side = 0
    if n_psfs >= 4:
        side = round(n_psfs**0.5)
    check_that(side**2 == n_psfs, "n_psfs", "a square number of at least 4", n_psfs)
    part = aperture(subarray)
    ny, nx = part.shape
    first, last = (int(np.clip(c - part.origin[0], 0, nx)) for c in imager_columns())
    if last - first < 2:
        first, last = 0, nx  # SUB64 and SUB128 lie outside the imager's own field
    columns = np.linspace(first, last - 1, side)
    positions = [(x, y) for y in np.linspace(0, ny - 1, side) for x in columns]
    psfs = [miri_psf(filter, position=tuple(p), subarray=subarray, **options) for p in positions]
    return psf_grid(psfs, positions)


def grid_weights(grid, x, y):
    """
    Return the weights with which the PSFs of a grid make up the PSF at positions.

    Parameters
    ----------
    grid : `~photutils.psf.GriddedPSFModel`
        PSFs over the field.
    x, y : array_like, shape (N,)
        Positions in pixels; beyond the grid the nearest point of it counts.

    Returns
    -------
    weights : `~numpy.ndarray`, shape (N, n_psfs)
        Bilinear, at most four of a row not zero; each row has the sum 1. The columns are in
        the order of ``grid.data``.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.psf import gaussian_psf, grid_weights, psf_grid
    >>> form = {"pixel_scale": 0.1 * u.arcsec, "fov": 2 * u.arcsec}
    >>> psfs = [gaussian_psf(width * u.arcsec, **form) for width in (0.3, 0.3, 0.4, 0.4)]
    >>> grid = psf_grid(psfs, [(0, 0), (0, 100), (100, 0), (100, 100)])
    >>> grid_weights(grid, [50], [0])
    array([[0.5, 0.5, 0. , 0. ]])
    """
    x, y = np.broadcast_arrays(np.atleast_1d(floats(x)), floats(y))
    positions = np.asarray(grid.grid_xypos, dtype=float)
    if len(positions) == 1:
        return np.ones((x.size, 1))
    hats = []
    for values, grid_nodes in ((x, positions[:, 0]), (y, positions[:, 1])):
        nodes = np.unique(grid_nodes)
        hats_of_axis = []
        for node in grid_nodes:
            hats_of_axis.append(np.interp(values, nodes, (nodes == node).astype(float)))
        hats.append(hats_of_axis)
    return (np.array(hats[0]) * np.array(hats[1])).T


@takes_other_keywords
def psf_at(grid, x, y):
    """
    Return the PSF of a grid at a position.

    Parameters
    ----------
    grid : `PSFGrid`
        As made by `psf_grid`. Other gridded models know neither pixel nor frame: see
        `~miricigale.psf.from_photutils`.
    x, y : float
        Position in pixels.

    Returns
    -------
    psf : `InstrumentPSF`
        With its own ``pixel_scale`` and ``position``.

    Raises
    ------
    TypeError
        If it is something else, such as a gridded model of photutils' own.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.psf import miri_psf_grid, psf_at
    >>> grid = miri_psf_grid("F1500W", n_psfs=4, fov=3 * u.arcsec, oversampling=2)
    >>> print(f"{psf_at(grid, 359, 0).pixel_scale:.4f}")
    0.1092 arcsec
    """
    if not isinstance(grid, PSFGrid):
        got = type(grid).__name__
        msg = f"'grid' must be a PSFGrid (see miricigale.psf.from_photutils for others), got {got}"
        raise TypeError(msg)
    weights = grid_weights(grid, float(x), float(y))[0]
    grid_keys = ("oversampling", "grid_xypos", "grid_shape")
    meta = {}
    for name in SHARED:
        meta[name] = getattr(grid, name)
    return InstrumentPSF(
        np.tensordot(weights, np.asarray(grid.data), axes=1),
        pixel_scale=weights @ grid.pixel_scales,
        oversampling=int(grid.oversampling[0]),
        position=(x, y),
        meta=without(grid.meta, grid_keys),
        **meta,
    )
