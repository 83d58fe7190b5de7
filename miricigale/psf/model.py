"""PSFs as photutils models that say what they are: scale, frame, angle, what they include."""

import dataclasses

import astropy.units as u
import numpy as np
from photutils.psf import GriddedPSFModel, ImagePSF

from miricigale.psf import _core
from miricigale.utils.exceptions import argument_error
from miricigale.utils.files import open_fits
from miricigale.utils.units import ANGLE, to_array

__all__ = ["FRAMES", "PSFInfo", "from_photutils", "make_psf", "psf_info", "read_psf"]

#: Where a PSF's axes may stand: on the detector (angle on the sky not yet known) or the sky.
FRAMES = ("detector", "sky")

#: Radii in arcsec at which every PSF's meta gives the encircled energy.
_RADII = (0.25, 0.5, 1.0, 1.5, 2.5, 5.0, 10.0)


@dataclasses.dataclass(frozen=True, eq=False)
class PSFInfo:
    """
    What a PSF's data and meta say, checked.

    Parameters
    ----------
    data : `~numpy.ndarray`, shape (ny, nx)
        Oversampled PSF; the sum over the infinite plane is ``oversampling**2``.
    oversampling : int
        Cells per pixel.
    pixel_scale : float
        Pixel in arcsec.
    origin : tuple of float
        Cell x, y of the PSF's centre.
    frame : str
        ``"detector"`` or ``"sky"``.
    angle : float
        Position angle of +y in deg, east of north; of no meaning on the detector.
    includes : tuple of str
        Effects that the PSF holds.
    meta : dict
        All of the PSF's meta.
    """

    data: np.ndarray
    oversampling: int
    pixel_scale: float
    origin: tuple
    frame: str
    angle: float
    includes: tuple
    meta: dict

    @property
    def cell(self):
        """Side of a cell in arcsec."""
        return self.pixel_scale / self.oversampling

    @property
    def enclosed(self):
        """Fraction of the light on the whole grid."""
        return float(self.data.sum()) / self.oversampling**2

    @property
    def half_width(self):
        """Distance from the centre to the nearest edge in arcsec."""
        ny, nx = self.data.shape
        x, y = self.origin
        return (min(x, nx - 1 - x, y, ny - 1 - y) + 0.5) * self.cell


def psf_info(psf, argument="psf"):
    """
    Read off a PSF what the package needs to know of it.

    Parameters
    ----------
    psf : `~photutils.psf.ImagePSF`
        A PSF made by this package (`make_psf` gives any array the meta it needs).
    argument : str, optional
        The argument's name for messages.

    Returns
    -------
    info : `PSFInfo`

    Raises
    ------
    TypeError
        If it is no `~photutils.psf.ImagePSF`.
    ValueError
        If its scale or frame is unknown, or its oversampling differs between the axes.
    """
    if not isinstance(psf, ImagePSF):
        msg = f"'{argument}' must be a photutils ImagePSF, got {type(psf).__name__}"
        raise TypeError(msg)
    missing = [key for key in ("pixel_scale", "frame") if key not in psf.meta]
    if missing:
        wanted = f"a PSF whose meta has {missing} (see miricigale.psf.from_photutils)"
        raise argument_error(argument, wanted, f"meta with {sorted(psf.meta)}")
    oversampling = np.atleast_1d(psf.oversampling)
    if np.any(oversampling != oversampling[0]):
        raise argument_error(argument, "oversampled alike in x and y", oversampling.tolist())
    if psf.meta["frame"] not in FRAMES:
        wanted = f"a PSF whose frame is one of {FRAMES}"
        raise argument_error(argument, wanted, repr(psf.meta["frame"]))
    return PSFInfo(
        data=np.asarray(psf.data),
        oversampling=int(oversampling[0]),
        pixel_scale=float(psf.meta["pixel_scale"]),
        origin=(float(psf.origin[0]), float(psf.origin[1])),
        frame=psf.meta["frame"],
        angle=float(psf.meta.get("angle", 0.0)),
        includes=tuple(psf.meta.get("includes", ())),
        meta=dict(psf.meta),
    )


def half_maximum_width(data, x, y):
    """
    Full width at half maximum of the azimuthal mean around a point, in cells.

    Parameters
    ----------
    data : `~numpy.ndarray`, shape (ny, nx)
    x, y : float
        Centre in cells.

    Returns
    -------
    width : float
        NaN where the profile does not fall to a half.
    """
    limit = min(x, data.shape[1] - 1 - x, y, data.shape[0] - 1 - y)
    angles = np.arange(48) * (2 * np.pi / 48)
    for reach in (16.0, 64.0, limit):
        radii = np.arange(0.0, min(reach, limit), 0.25)
        rows = y + radii[:, None] * np.sin(angles)
        columns = x + radii[:, None] * np.cos(angles)
        profile = interpolate(data, columns, rows).mean(axis=1)
        below = np.flatnonzero(profile < 0.5 * profile[0])
        if below.size:
            k = below[0]
            part = (profile[k - 1] - 0.5 * profile[0]) / (profile[k - 1] - profile[k])
            return 2 * (radii[k - 1] + part * 0.25)
    return float("nan")


def interpolate(data, x, y):
    """
    Cubic-spline values of an image at positions in cells, zero outside of it.

    The image is cut to what the positions need (and 12 cells, over which a spline
    forgets the cut).
    """
    from scipy.ndimage import map_coordinates

    ny, nx = data.shape
    x0, x1 = max(0, int(np.floor(x.min())) - 12), min(nx, int(np.ceil(x.max())) + 13)
    y0, y1 = max(0, int(np.floor(y.min())) - 12), min(ny, int(np.ceil(y.max())) + 13)
    if x1 <= x0 or y1 <= y0:
        return np.zeros(np.broadcast(x, y).shape)
    x, y = np.broadcast_arrays(x, y)
    # cells on the very edge belong to the image: 'constant' alone would taper half a cell
    values = map_coordinates(
        np.asarray(data[y0:y1, x0:x1], dtype=float), (y - y0, x - x0), order=3, mode="nearest"
    )
    inside = (x > -0.5) & (x < nx - 0.5) & (y > -0.5) & (y < ny - 0.5)
    return np.where(inside, values, 0.0)


def make_psf(
    data,
    *,
    pixel_scale,
    oversampling=1,
    frame,
    angle=0.0 * u.deg,
    includes=(),
    origin=None,
    **meta,
):
    """
    Make an `~photutils.psf.ImagePSF` whose meta says all that the package needs.

    Parameters
    ----------
    data : `~numpy.ndarray`, shape (ny, nx)
        Oversampled PSF, normalised so that the sum over the infinite plane would be
        ``oversampling**2``: the sum of ``data`` is that times the fraction of the light
        that the grid holds.
    pixel_scale : `~astropy.units.Quantity`
        Side of a pixel (not of a cell).
    oversampling : int, optional
        Cells per pixel.
    frame : {"detector", "sky"}
        Whether the axes are the detector's, whose angle on the sky is open, or stand on
        the sky with +y at ``angle`` (and +x west of it).
    angle : `~astropy.units.Quantity`, optional
        Position angle of +y, east of north, in the sky frame.
    includes : iterable of str, optional
        Effects that the PSF holds: ``"pixel"``, ``"ipc"``, ``"cruciform"``, ``"jitter"``,
        ``"drizzle"``.
    origin : tuple of float, optional
        Cell x, y of the centre; the middle if not given.
    **meta
        Further entries of the meta.

    Returns
    -------
    psf : `~photutils.psf.ImagePSF`
        Its meta has ``pixel_scale`` (arcsec), ``oversampling``, ``frame``, ``angle``
        (deg), ``includes``, ``fwhm`` (arcsec), ``enclosed`` (fraction of the light on the
        grid), ``eef_radius`` (arcsec) and ``eef``.

    Raises
    ------
    ValueError
        If the data are not a finite 2D array that holds light, or a name is unknown.
    """
    data = np.array(data, dtype=float)
    if data.ndim != 2 or not np.all(np.isfinite(data)) or not data.sum() > 0:
        raise argument_error("data", "a finite 2D array with a positive sum", f"{data.shape}")
    if frame not in FRAMES:
        raise argument_error("frame", f"one of {FRAMES}", repr(frame))
    if int(oversampling) != oversampling or oversampling < 1:
        raise argument_error("oversampling", "a positive integer", oversampling)
    scale = float(to_array(pixel_scale, ANGLE, "pixel_scale"))
    if not scale > 0:
        raise argument_error("pixel_scale", "positive", pixel_scale)
    enclosed = float(data.sum()) / oversampling**2
    # stpsf's sums reach 1.03 at the corners of the array, where its distortion adds light
    if enclosed > 1.04:
        wanted = f"normalised to {oversampling**2} over the infinite plane"
        raise argument_error("data", wanted, f"a sum of {data.sum():.6g}")
    psf = ImagePSF(data, oversampling=int(oversampling), origin=origin)
    x, y = (float(v) for v in psf.origin)
    cell = scale / oversampling
    limit = (min(x, data.shape[1] - 1 - x, y, data.shape[0] - 1 - y) + 0.5) * cell
    radii = [r for r in _RADII if r < limit]
    eef = _core.radial_sums(data, x, y, np.array(radii) / cell) / oversampling**2
    psf.meta.update(meta)
    psf.meta.update(
        pixel_scale=scale,
        oversampling=int(oversampling),
        frame=frame,
        angle=float(to_array(angle, u.deg, "angle", finite=True)) if frame == "sky" else 0.0,
        includes=list(includes),
        fwhm=half_maximum_width(data, x, y) * cell,
        enclosed=enclosed,
        eef_radius=radii,
        eef=[float(v) for v in eef],
    )
    return psf


def from_photutils(model, *, pixel_scale, frame, angle=0.0 * u.deg, includes=(), x=None, y=None):
    """
    Take over a PSF from photutils (or from stpsf, which writes the gridded form).

    Parameters
    ----------
    model : `~photutils.psf.ImagePSF` or `~photutils.psf.GriddedPSFModel`
        Normalised as photutils asks: sum ``oversampling**2`` over the infinite plane.
    pixel_scale, frame, angle, includes
        As for `make_psf`: photutils' models do not know them.
    x, y : float, optional
        Detector position at which a gridded model is evaluated; needed for those.

    Returns
    -------
    psf : `~photutils.psf.ImagePSF`

    Raises
    ------
    TypeError
        If the model is of another kind.
    ValueError
        If a gridded model comes without a position.
    """
    if isinstance(model, ImagePSF):
        data, origin = model.data, tuple(model.origin)
    elif isinstance(model, GriddedPSFModel):
        if x is None or y is None:
            raise argument_error("x, y", "given for a GriddedPSFModel", (x, y))
        ny, nx = model.data.shape[1:]
        step = 1.0 / np.atleast_1d(model.oversampling)
        yy = (np.arange(ny) - (ny - 1) / 2) * step[0]
        xx = (np.arange(nx) - (nx - 1) / 2) * step[-1]
        grid = np.meshgrid(xx + x, yy + y)
        data, origin = model.evaluate(*grid, 1.0, x, y), None
    else:
        msg = f"'model' must be an ImagePSF or a GriddedPSFModel, got {type(model).__name__}"
        raise TypeError(msg)
    return make_psf(
        data,
        pixel_scale=pixel_scale,
        oversampling=int(np.atleast_1d(model.oversampling)[0]),
        frame=frame,
        angle=angle,
        includes=includes,
        origin=origin,
    )


def read_psf(
    path,
    *,
    ext=0,
    plane=None,
    pixel_scale,
    oversampling=1,
    frame,
    angle=0.0 * u.deg,
    includes=(),
    enclosed=None,
):
    """
    Read a PSF from an image in any FITS file.

    Parameters
    ----------
    path : path-like
        The file.
    ext : int or str, optional
        The extension.
    plane : int, optional
        Which plane of a cube.
    pixel_scale, oversampling, frame, angle, includes
        As for `make_psf`. Headers name these differently in every file, so they are given.
    enclosed : float, optional
        Fraction of the light that the image holds; the image is scaled to it. Without it
        the image is taken as normalised already.

    Returns
    -------
    psf : `~photutils.psf.ImagePSF`

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file is missing or no FITS.
    ValueError
        If there is no 2D image there.
    """
    with open_fits(path, wanted="a PSF", output_verify="silentfix") as hdus:
        data = hdus[ext].data
        if data is not None and plane is not None:
            data = data[plane]
        if data is None or data.ndim != 2:
            got = None if data is None else f"shape {data.shape}"
            raise argument_error("path", f"a file with a 2D image in extension {ext!r}", got)
        data = np.array(data, dtype=float)
    if enclosed is not None:
        data *= enclosed * oversampling**2 / data.sum()
    return make_psf(
        data,
        pixel_scale=pixel_scale,
        oversampling=oversampling,
        frame=frame,
        angle=angle,
        includes=includes,
        file=str(path),
    )
