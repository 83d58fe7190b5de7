"""PSFs as photutils models that know their pixel, their axes and what they include."""

import functools

import astropy.units as u
import numpy as np
from astropy.io import fits
from astropy.nddata import NDData
from photutils.psf import GriddedPSFModel, ImagePSF

from miricigale.psf import _core
from miricigale.psf.any_psf import as_psf, stated_part
from miricigale.utils.arrays import centered, check_light
from miricigale.utils.exceptions import PSFWarning, argument_error, warn
from miricigale.utils.file_formats import read_write
from miricigale.utils.files import write_fits
from miricigale.utils.missing_values import floats
from miricigale.utils.named_values import attributes
from miricigale.utils.options import check_that, check_type
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.units import ANGLE, check_count, positive, scalar, to_array

#: Where a PSF's axes may stand: on the detector (angle on the sky not yet known) or the sky.
FRAMES = ("detector", "sky")

#: Parameters of an `InstrumentPSF` besides its data.
_FACTS = ("pixel_scale", "frame", "oversampling", "origin", "angle", "includes", "filter")
_FACTS += ("total_known", "position", "subarray", "pa_aper")

#: What the PSFs of a `PSFGrid` have in common.
SHARED = ("frame", "angle", "includes", "filter", "total_known", "subarray")


class InstrumentPSF(ImagePSF):
    """
    A PSF of an instrument or a mosaic, with what must be known of it to use it.

    `make_psf` makes one from any array, normalized and checked; those of the instruments are
    made by `miri_psf`, `nircam_psf` and `hst_psf`.

    Parameters
    ----------
    data : `~numpy.ndarray`, shape (ny, nx)
        Oversampled PSF; the sum over the infinite plane is ``oversampling**2``.
    pixel_scale : `~astropy.units.Quantity`
        Side of a pixel (not of a cell).
    frame : {"detector", "sky"}
        Whether the axes are the detector's, whose angle on the sky is open, or stand on
        the sky with +y at ``angle`` (and +x west of it).
    oversampling : int, optional
        Cells per pixel.
    origin : tuple of float, optional
        Cell x, y of the center; the middle if not given.
    angle : `~astropy.units.Quantity`, optional
        Position angle of +y, east of north; 0 in the detector frame, where it has no meaning.
    includes : iterable of str, optional
        Effects that the PSF holds: ``"pixel"``, ``"ipc"``, ``"cruciform"``, ``"jitter"``,
        ``"drizzle"``.
    filter : str, optional
        Name of the filter.
    total_known : bool, optional
        Whether the sum of the data is known to be the fraction of all light on the grid, or is no
        more than what came.
    position : tuple of float, optional
        Place x, y on the array, in 0-based pixels of ``subarray``.
    subarray : str, optional
        Sub-array in whose pixels ``position`` is.
    pa_aper : `~astropy.units.Quantity`, optional
        Position angle of the detector's +y axis where the PSF was taken.
    meta : dict, optional
        Provenance: nothing is decided by it.

    Raises
    ------
    ValueError
        If the frame is unknown, or the pixel or the oversampling is not positive.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from miricigale.psf import InstrumentPSF
    >>> y, x = np.mgrid[-20:21, -20:21]
    >>> data = np.exp(-0.5 * (x**2 + y**2) / 9) / (2 * np.pi * 9)
    >>> psf = InstrumentPSF(data, pixel_scale=0.06 * u.arcsec, frame="sky")
    >>> print(f"{psf.fwhm:.3f}, {psf.enclosed:.3f} of the light on the grid")
    0.424 arcsec, 1.000 of the light on the grid
    """

    io_module = "miricigale.psf.files"
    read, write = read_write("a PSF and all that is known of it")

    def __init__(
        self,
        data,
        *,
        pixel_scale,
        frame,
        oversampling=1,
        origin=None,
        angle=0.0 * u.deg,
        includes=(),
        filter=None,
        total_known=False,
        position=None,
        subarray=None,
        pa_aper=None,
        meta=None,
    ):
        check_that(frame in FRAMES, "frame", f"one of {FRAMES}", repr(frame))
        cells = check_count(oversampling, "oversampling")
        scale = positive(pixel_scale, ANGLE, "pixel_scale")
        if hasattr(data, "mask"):
            # masked pixels are refused as NaN is
            data = floats(data)
        super().__init__(data, oversampling=cells, origin=origin, meta=dict(meta or {}))
        turn = 0.0
        if frame == "sky":
            turn = scalar(angle, u.deg, "angle")
        self.pixel_scale = scale * ANGLE
        self.frame = frame
        self.angle = turn * u.deg
        self.includes = tuple(includes)
        self.filter = filter
        self.total_known = bool(total_known)
        self.pa_aper = pa_aper
        if position is None:
            self.position = None
        else:
            self.position = tuple(map(float, position))
        self.subarray = subarray

    def __repr__(self):
        ny, nx = self.data.shape
        cells = f"{ny} x {nx} cells of {self.cell:.4g} arcsec"
        name = ""
        if self.filter:
            name = f"{self.filter}, "
        held = ""
        if self.includes:
            held = f", with {', '.join(self.includes)}"
        return f"<InstrumentPSF {name}{cells}, frame of the {self.frame}{held}>"

    def encircled_energy(self, radius):
        """
        Return the fraction of all light within radii; see `~miricigale.psf.encircled_energy`.

        Parameters
        ----------
        radius : `~astropy.units.Quantity`
            Of any shape.

        Returns
        -------
        fraction : `~numpy.ndarray` or float
        """
        return enclosed_light(self, self.data, radius)

    def replace(self, data=None, *, meta=None, **changes):
        """
        Return the same PSF with some of its parameters changed.

        Parameters
        ----------
        data : `~numpy.ndarray`, optional
            New data.
        meta : dict, optional
            What is added to the meta.
        **changes
            Other parameters of `InstrumentPSF`.

        Returns
        -------
        psf : `InstrumentPSF`
        """
        facts = {**self.facts, **changes, "meta": {**self.meta, **(meta or {})}}
        return InstrumentPSF(self.data if data is None else data, **facts)

    def plot(self, ax=None, **kwargs):
        """
        Draw the cells of the PSF, scaled by asinh.

        Parameters
        ----------
        ax : `~matplotlib.axes.Axes`, optional
            Where; the current axes by default.
        **kwargs
            Passed to `~matplotlib.axes.Axes.imshow`.

        Returns
        -------
        ax : `~matplotlib.axes.Axes`
        """
        from miricigale.plotting.axes import plain_text
        from miricigale.plotting.scene import plot_scene

        return plot_scene(self.data, ax=ax, label=plain_text(self.filter or "PSF"), **kwargs)

    @property
    def facts(self):
        """The parameters with which it was made, without data and meta (dict)."""
        facts = attributes(self, _FACTS)
        return {**facts, "oversampling": self.n_cells, "origin": tuple(map(float, self.origin))}

    @property
    def n_cells(self):
        """Cells along a side of a pixel (int)."""
        return int(self.oversampling[0])

    @property
    def cell(self):
        """Side of a cell in arcsec (float)."""
        return self.pixel_scale.value / self.n_cells

    @property
    def enclosed(self):
        """Fraction of the light on the whole grid."""
        return float(self.data.sum()) / self.n_cells**2

    @property
    def half_width(self):
        """Distance from the center to the nearest edge in arcsec (float)."""
        return _half_width(self.data, self.origin) * self.cell

    @functools.cached_property
    def fwhm(self):
        """Full width at half maximum of the azimuthal mean."""
        x, y = self.origin
        return _core.half_maximum_width(self.data, x, y) * self.cell * ANGLE


class PSFGrid(GriddedPSFModel):
    """
    PSFs of several places of a field; `psf_grid` makes one with checks.

    Parameters
    ----------
    psfs : sequence of `InstrumentPSF`
        Alike in all but data, pixel and position.
    positions : `~numpy.ndarray`, shape (n, 2)
        Where they hold, 0-based pixels x, y.

    Attributes
    ----------
    frame, angle, includes, filter, total_known, subarray
        As for `InstrumentPSF`.
    pixel_scale : `~astropy.units.Quantity`
        Mean of the pixels.
    pixel_scales : `~astropy.units.Quantity`, shape (n,)
        Those of the PSFs, in the order of ``data``.
    meta : dict
        That of the first PSF.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.psf import miri_psf_grid
    >>> grid = miri_psf_grid("F1500W", n_psfs=4, fov=3 * u.arcsec, oversampling=2)
    >>> grid.grid_xypos.tolist()
    [[359.0, 0.0], [1026.0, 0.0], [359.0, 1023.0], [1026.0, 1023.0]]
    """

    def __init__(self, psfs, positions):
        # photutils' own order: by y, then by x
        order = np.lexsort(np.transpose(positions))
        first = psfs[0]
        meta = {**first.meta, "oversampling": first.n_cells}
        meta["grid_xypos"] = [tuple(map(float, positions[k])) for k in order]
        super().__init__(NDData(np.stack([psfs[k].data for k in order]), meta=meta))
        for name in SHARED:
            setattr(self, name, getattr(first, name))
        self.pixel_scales = u.Quantity([psfs[k].pixel_scale for k in order])
        self.pixel_scale = self.pixel_scales.mean()

    def write_stdpsf(self, path, *, overwrite=False):
        """
        Write the grid as STDPSF, which ``photutils.psf.GriddedPSFModel.read(path, format="stdpsf")`` reads.

        Pixel, frame and what the PSFs include are in the header (PIXELSCL, FRAME), where that reader does not
        look.

        Parameters
        ----------
        path : path-like
            The FITS file.
        overwrite : bool, optional
            Whether a file that is there is replaced.

        Raises
        ------
        ValueError
            If there are not 4 cells in a pixel, which the format takes for granted, or the positions are no full
            grid, are no whole pixels, or as many as those of an instrument with several chips (36, 56, 90, 200).
        OSError
            If the file is there and ``overwrite`` is not set.
        """
        cells = np.unique(self.oversampling).tolist()
        check_that(cells == [4], "oversampling", "4 for STDPSF", cells)
        x, y = np.transpose(self.grid_xypos)
        columns = np.unique(x)
        rows = np.unique(y)
        whole_pixels = np.all(columns == np.round(columns)) and np.all(rows == np.round(rows))
        full = columns.size * rows.size == x.size and max(columns.size, rows.size) < 100
        got = f"{x.size} positions at {columns.size} x and {rows.size} y"
        check_that(
            full and whole_pixels, "positions", "a full grid of whole pixels for STDPSF", got
        )
        # photutils takes these numbers for several chips
        check_that(
            x.size not in (36, 56, 90, 200), "positions", "of another number for STDPSF", got
        )
        header = fits.Header({"NXPSFS": columns.size, "NYPSFS": rows.size})
        # 1-based pixels
        for key, values in (("IPSFX", columns), ("JPSFY", rows)):
            for i, value in enumerate(values.tolist()):
                header[f"{key}{i + 1:02d}"] = int(value) + 1
        header["PIXELSCL"] = (self.pixel_scale.to_value(ANGLE) / 4, "arcsec per cell")
        header["FRAME"] = (str(self.frame), "frame of the axes")
        if self.filter is not None:
            header["FILTER"] = str(self.filter)
        write_fits([fits.PrimaryHDU(np.asarray(self.data), header)], path, overwrite=overwrite)


def instrument_psf(psf, argument="psf"):
    """
    Check that a PSF states its pixel and frame.

    Parameters
    ----------
    psf : `InstrumentPSF` or tuple
        One of photutils' own, or an array, does not: `from_photutils` takes it with what it lacks, and so does
        a pair of it and its pixel, ``(psf, 0.11 * u.arcsec)``, on the sky and north up.
    argument : str, optional
        The argument's name for messages.

    Returns
    -------
    psf : `InstrumentPSF`
        The same, or that of the pair.

    Raises
    ------
    ValueError
        If it is something else.

    Examples
    --------
    >>> from photutils.psf import ImagePSF
    >>> import numpy as np
    >>> from miricigale.psf import instrument_psf
    >>> instrument_psf(ImagePSF(np.ones((5, 5))))
    Traceback (most recent call last):
    ...
    ValueError: 'psf' must be a PSF on pixels of known size, ..., got ImagePSF
    """
    if isinstance(psf, tuple) and len(psf) == 2:
        values, pixel_scale = psf
        return from_photutils(values, pixel_scale)
    wanted = (
        "a PSF on pixels of known size, such as one of miricigale.psf.from_photutils and make_psf, or "
        "(psf, 0.11 * u.arcsec)"
    )
    check_type(psf, argument, InstrumentPSF, wanted)
    return psf


@takes_other_keywords(options_of=(InstrumentPSF,))
def make_psf(data, pixel_scale, *, frame="sky", oversampling=1, enclosed=None, **facts):
    """
    Make a PSF of an array, normalized and checked.

    Parameters
    ----------
    data : `~numpy.ndarray`, shape (ny, nx)
        Oversampled PSF, normalized so that the sum over the infinite plane would be
        ``oversampling**2``: the sum of ``data`` is that times the fraction of the light
        that the grid holds. A sum of 1 on an oversampled grid is brought to that.
    pixel_scale, frame, oversampling
        As for `InstrumentPSF`.
    enclosed : float, optional
        Fraction of the light that the grid holds: the data, of any positive sum, are scaled
        to it. Without it the sum itself is taken for that fraction, and a kernel made with
        the PSF has unit sum (see `~miricigale.psf.MatchingKernel.from_psfs`).
    **facts
        Further parameters of `InstrumentPSF`: ``origin``, ``angle``, ``includes``, ``filter``,
        ``total_known``, ``position``, ``subarray``, ``pa_aper`` and ``meta``.

    Returns
    -------
    psf : `InstrumentPSF`

    Raises
    ------
    ValueError
        If the data are not a finite 2D array that holds light, a parameter is out of range, or the
        sum claims more light beyond the grid than the profile at its edge allows.

    Warns
    -----
    `~miricigale.utils.exceptions.PSFWarning`
        If an oversampled PSF of unit sum is scaled.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from miricigale.psf import make_psf
    >>> y, x = np.mgrid[-20:21, -20:21]
    >>> stamp = np.exp(-0.5 * (x**2 + y**2) / 9)
    >>> psf = make_psf(stamp, pixel_scale=0.06 * u.arcsec, enclosed=0.95)
    >>> print(f"{psf.fwhm:.3f}, {psf.enclosed:.2f}")
    0.424 arcsec, 0.95
    """
    data = np.array(floats(data))
    check_light(data)
    total = float(data.sum())
    factor = 1.0
    if enclosed is not None:
        check_that(0 < enclosed <= 1, "enclosed", "above 0 and at most 1", enclosed)
        factor = enclosed * oversampling**2 / total
        facts["total_known"] = True
    elif not facts.get("total_known") and oversampling > 1 and 0.8 < total < 1.04:
        # taken literally it would hold a quarter of the light or less
        factor = oversampling**2
        text = f"'data' sums to {total:.4g} with {oversampling} x {oversampling} cells per pixel: "
        text += f"multiplied by {factor} (a PSF sums to {factor} over the infinite plane)"
        warn(text, PSFWarning)
    data *= factor
    psf = InstrumentPSF(
        data, pixel_scale=pixel_scale, frame=frame, oversampling=oversampling, **facts
    )
    # stpsf's sums reach 1.03 at the corners of the array, where its distortion adds light
    wanted = f"normalized to {psf.n_cells**2} over the infinite plane (or 'enclosed' given)"
    check_that(psf.enclosed <= 1.04, "data", wanted, f"a sum of {data.sum():.6g}")
    if not psf.total_known:
        limit = _half_width(data, psf.origin)
        x, y = psf.origin
        sums = _core.radial_sums(data, x, y, np.array([limit / 2, limit])) / psf.n_cells**2
        # in wings as r**-3 as much light lies beyond a radius as between it and its half
        outer = sums[1] - sums[0]
        wanted = "a PSF whose sum is the fraction of light it holds (or 'enclosed' given)"
        got = f"a sum of {total:.4g}, though only {outer:.2g} lie in the outer half of the grid"
        check_that(1 - psf.enclosed <= max(0.15, 5 * outer), "data", wanted, got)
    return psf


@takes_other_keywords(options_of=(make_psf,))
def from_photutils(model, pixel_scale, *, x=None, y=None, **options):
    """
    Take over a PSF from photutils (or from stpsf, which writes the gridded form).

    Parameters
    ----------
    model : `~photutils.psf.ImagePSF`, `~photutils.psf.GriddedPSFModel` or what `as_psf` takes
        Normalized as photutils asks: sum ``oversampling**2`` over the infinite plane. An array or kernel whose
        sum is 0.85 to 0.995 holds that part of the light; of any other sum it is normalized to 1.
    pixel_scale : `~astropy.units.Quantity`
        Pixel of the image that it is for.
    x, y : float, optional
        Detector position at which a gridded model is evaluated; needed for those.
    **options
        What photutils' models do not know: ``frame`` and the other options of `make_psf`.

    Returns
    -------
    psf : `InstrumentPSF`

    Raises
    ------
    ValueError
        If the model is of another kind, or a gridded model comes without a position.

    Examples
    --------
    >>> import astropy.units as u
    >>> from photutils.psf import GaussianPSF
    >>> from miricigale.psf import from_photutils
    >>> psf = from_photutils(GaussianPSF(x_fwhm=3, y_fwhm=3), pixel_scale=0.1 * u.arcsec)
    >>> print(f"{psf.fwhm:.3f}")
    0.300 arcsec
    """
    part = stated_part(model)
    model = as_psf(model, "model")
    oversampling = np.atleast_1d(model.oversampling)
    if np.any(oversampling != oversampling[0]):
        raise argument_error("model", "oversampled alike in x and y", oversampling.tolist())
    cells = int(oversampling[0])
    if isinstance(model, ImagePSF):
        data = model.data * part
        options["origin"] = tuple(model.origin)
    else:
        check_that(x is not None and y is not None, "x, y", "given for a GriddedPSFModel", (x, y))
        yy, xx = (centered(n) * (1.0 / cells) for n in model.data.shape[1:])
        data = model.evaluate(*np.meshgrid(xx + x, yy + y), 1.0, x, y)
    return make_psf(data, pixel_scale, oversampling=cells, **options)


def _half_width(data, origin):
    """Return the cells from the center to the nearest edge."""
    x, y = map(float, origin)
    return min(x, data.shape[1] - 1 - x, y, data.shape[0] - 1 - y) + 0.5


def enclosed_light(psf, data, radius):
    """
    Return the light of an image on the cells of a PSF inside circles around its center.

    Parameters
    ----------
    psf : `InstrumentPSF`
        Says where the center is, and how large cells are.
    data : `~numpy.ndarray`, shape (ny, nx)
        Image.
    radius : `~astropy.units.Quantity`
        Scalar or array of radii.

    Returns
    -------
    light : float or `~numpy.ndarray`
        Of all light, as of ``data``.

    Raises
    ------
    ValueError
        If a radius is negative or its circle leaves the grid.
    """
    radii = to_array(radius, ANGLE, "radius", finite=True)
    if np.any(radii < 0) or np.any(radii > psf.half_width):
        wanted = f"between 0 and the half width of the PSF, {psf.half_width:.4g} arcsec"
        raise argument_error("radius", wanted, radius)
    flat = np.ascontiguousarray(radii.ravel() / psf.cell)
    x, y = psf.origin
    sums = _core.radial_sums(data, x, y, flat) / psf.n_cells**2
    if radii.ndim == 0:
        return float(sums[0])
    return sums.reshape(radii.shape)
