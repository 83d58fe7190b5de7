"""PSFs as photutils models that say what they are: scale, frame, angle, what they include."""

import dataclasses
import warnings

import astropy.units as u
import numpy as np
from astropy.wcs import WCS
from photutils.psf import GriddedPSFModel, ImagePSF

from miricigale.psf import _core
from miricigale.utils.exceptions import MiricigaleWarning, argument_error
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
    def total_known(self):
        """Whether the sum is known to be the fraction of all light, not only claimed."""
        return self.meta.get("normalization") == "total"

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


def make_psf(
    data,
    *,
    pixel_scale,
    oversampling=1,
    frame,
    angle=0.0 * u.deg,
    includes=(),
    origin=None,
    enclosed=None,
    **meta,
):
    """
    Make an `~photutils.psf.ImagePSF` whose meta says all that the package needs.

    Parameters
    ----------
    data : `~numpy.ndarray`, shape (ny, nx)
        Oversampled PSF, normalised so that the sum over the infinite plane would be
        ``oversampling**2``: the sum of ``data`` is that times the fraction of the light
        that the grid holds. A sum of 1 on an oversampled grid is brought to that.
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
    enclosed : float, optional
        Fraction of the light that the grid holds: the data, of any positive sum, are scaled
        to it. Without it the sum itself is taken for that fraction, and a kernel made with
        the PSF has unit sum (see `~miricigale.psf.MatchingKernel.from_psfs`).
    **meta
        Further entries of the meta.

    Returns
    -------
    psf : `~photutils.psf.ImagePSF`
        Its meta has ``pixel_scale`` (arcsec), ``oversampling``, ``frame``, ``angle``
        (deg), ``includes``, ``fwhm`` (arcsec), ``enclosed`` (fraction of the light on the
        grid), ``normalization`` (``"total"`` if that fraction is known, ``"grid"`` if it is
        no more than the sum that came), ``eef_radius`` (arcsec) and ``eef``.

    Raises
    ------
    ValueError
        If the data are not a finite 2D array that holds light, a name is unknown, or the
        sum claims more light beyond the grid than the profile at its edge allows.

    Warns
    -----
    `~miricigale.utils.exceptions.MiricigaleWarning`
        If an oversampled PSF of unit sum is scaled.
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
    total, cells = float(data.sum()), oversampling**2
    if enclosed is not None:
        if not 0 < enclosed <= 1:
            raise argument_error("enclosed", "above 0 and at most 1", enclosed)
        data *= enclosed * cells / total
        meta["normalization"] = "total"
    elif "normalization" not in meta and oversampling > 1 and 0.8 < total < 1.04:
        # taken literally it would hold a quarter of the light or less
        text = f"'data' sums to {total:.4g} with {oversampling} x {oversampling} cells per pixel: "
        text += f"multiplied by {cells} (a PSF sums to {cells} over the infinite plane)"
        warnings.warn(text, MiricigaleWarning, stacklevel=2)
        data *= cells
    enclosed = float(data.sum()) / cells
    # stpsf's sums reach 1.03 at the corners of the array, where its distortion adds light
    if enclosed > 1.04:
        wanted = f"normalised to {cells} over the infinite plane (or 'enclosed' given)"
        raise argument_error("data", wanted, f"a sum of {data.sum():.6g}")
    psf = ImagePSF(data, oversampling=int(oversampling), origin=origin)
    x, y = (float(v) for v in psf.origin)
    cell = scale / oversampling
    limit = (min(x, data.shape[1] - 1 - x, y, data.shape[0] - 1 - y) + 0.5) * cell
    radii = [r for r in _RADII if r < limit]
    sums = _core.radial_sums(data, x, y, np.array([*radii, limit / 2, limit]) / cell) / cells
    eef, outer = sums[:-2], sums[-1] - sums[-2]
    meta.setdefault("normalization", "grid")
    # in wings as r**-3 as much light lies beyond a radius as between it and its half
    if meta["normalization"] == "grid" and 1 - enclosed > max(0.15, 5 * outer):
        wanted = "a PSF whose sum is the fraction of light it holds (or 'enclosed' given)"
        got = f"a sum of {total:.4g}, though only {outer:.2g} lie in the outer half of the grid"
        raise argument_error("data", wanted, got)
    psf.meta.update(meta)
    psf.meta.update(
        pixel_scale=scale,
        oversampling=int(oversampling),
        frame=frame,
        angle=float(to_array(angle, u.deg, "angle", finite=True)) if frame == "sky" else 0.0,
        includes=list(includes),
        fwhm=_core.half_maximum_width(data, x, y) * cell,
        enclosed=enclosed,
        eef_radius=radii,
        eef=[float(v) for v in eef],
    )
    return psf


def from_photutils(
    model,
    *,
    pixel_scale,
    frame,
    angle=0.0 * u.deg,
    includes=(),
    enclosed=None,
    x=None,
    y=None,
):
    """
    Take over a PSF from photutils (or from stpsf, which writes the gridded form).

    Parameters
    ----------
    model : `~photutils.psf.ImagePSF` or `~photutils.psf.GriddedPSFModel`
        Normalised as photutils asks: sum ``oversampling**2`` over the infinite plane.
    pixel_scale, frame, angle, includes, enclosed
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
        enclosed=enclosed,
    )


def header_grid(header):
    """
    What the header of a PSF or kernel states of its grid.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        World coordinates, or PIXELSCL or PIXSCALE (arcsec).

    Returns
    -------
    cell : float or None
        Side of a pixel of the file in arcsec; None if not stated.
    angle : float or None
        Position angle of +y in deg; None without world coordinates.

    Raises
    ------
    ValueError
        If the image is mirrored.
    """
    wcs = WCS(header, naxis=2, fix=False).celestial if "CTYPE1" in header else None
    if wcs is not None and wcs.has_celestial:
        (a, b), (c, d) = wcs.pixel_scale_matrix
        if a * d - b * c > 0:
            raise argument_error("path", "a file with east to the left where north is up", wcs)
        return float(np.sqrt(b * c - a * d)) * 3600, float(np.degrees(np.arctan2(b, d)))
    for key in ("PIXELSCL", "PIXSCALE"):
        if isinstance(header.get(key), (int, float)) and header[key] > 0:
            return float(header[key]), None
    return None, None


def fits_image(path, ext, plane, pixel_scale, *, wanted, oversampling=1):
    """
    An image of any FITS file and what its header states of its grid.

    Parameters
    ----------
    path, ext, plane, pixel_scale, oversampling
        As for `read_psf`.
    wanted : str
        What the file is to hold, for messages.

    Returns
    -------
    data : `~numpy.ndarray`, shape (ny, nx)
    header : `~astropy.io.fits.Header`
    pixel_scale : `~astropy.units.Quantity`
    angle : float or None
        Position angle of +y in deg.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`, ValueError
        As `read_psf`.
    """
    with open_fits(path, wanted=wanted, output_verify="silentfix") as hdus:
        data = hdus[ext].data
        if data is not None and plane is not None:
            data = data[plane]
        if data is None or data.ndim != 2:
            got = None if data is None else f"shape {data.shape}"
            raise argument_error("path", f"a file with a 2D image in extension {ext!r}", got)
        data, header = np.array(data, dtype=float), hdus[ext].header
    cell, angle = header_grid(header)
    if pixel_scale is None:
        if cell is None:
            raise argument_error("pixel_scale", "given where the header does not state it", None)
        pixel_scale = cell * oversampling * ANGLE
    elif cell is not None:
        mine = float(to_array(pixel_scale, ANGLE, "pixel_scale")) / oversampling
        if abs(mine / cell - 1) > 0.02:
            stated = f"{cell * oversampling:.4g} arcsec by the header and 'oversampling'"
            raise argument_error("pixel_scale", stated, pixel_scale)
    return data, header, pixel_scale, angle


def read_psf(
    path,
    *,
    ext=0,
    plane=None,
    pixel_scale=None,
    oversampling=1,
    frame,
    angle=None,
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
    pixel_scale, angle : `~astropy.units.Quantity`, optional
        As for `make_psf`. Where the header states them (world coordinates; PIXELSCL or
        PIXSCALE, arcsec per cell) they can be left out, and must agree with it if given.
    oversampling, frame, includes, enclosed
        As for `make_psf`.

    Returns
    -------
    psf : `~photutils.psf.ImagePSF`
        ``pa_aper`` in the meta is that of the header, for a PSF in the detector frame:
        `~miricigale.psf.MatchingKernel.from_psfs` turns by it if no angle is given.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file is missing or no FITS.
    ValueError
        If there is no 2D image there, or scale or angle are unknown or not the header's.
    """
    data, header, pixel_scale, turn = fits_image(
        path, ext, plane, pixel_scale, wanted="a PSF", oversampling=oversampling
    )
    meta = {"file": str(path)}
    if frame == "detector" and isinstance(header.get("PA_APER"), (int, float)):
        meta["pa_aper"] = float(header["PA_APER"])
    if frame == "sky" and turn is not None:
        given = turn if angle is None else float(to_array(angle, u.deg, "angle", finite=True))
        if abs((given - turn + 180) % 360 - 180) > 0.5:
            raise argument_error("angle", f"the header's, {turn:.4g} deg", angle)
        angle = given * u.deg
    return make_psf(
        data,
        pixel_scale=pixel_scale,
        oversampling=oversampling,
        frame=frame,
        angle=0.0 * u.deg if angle is None else angle,
        includes=includes,
        enclosed=enclosed,
        **meta,
    )
