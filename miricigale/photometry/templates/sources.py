"""Templates of sources from a high-resolution image: made once, used for every band."""

import dataclasses
from typing import ClassVar

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import Table
from photutils.psf import ImagePSF
from photutils.segmentation import SegmentationImage

from miricigale.instrument import as_wcs, epoch_of
from miricigale.photometry.detection.catalogs import (
    OPTIONAL,
    catalog_sources,
    joined_sky,
    sersic_rows,
)
from miricigale.photometry.detection.cutouts import Cutout, own_segments, saturated_cores
from miricigale.photometry.detection.prior_catalog import check_labels, read_catalog
from miricigale.photometry.images.arrays import (
    image_arrays,
    nearest_values,
    pixel_scale,
    same_grid,
    sky_to_pixels,
)
from miricigale.photometry.images.fits_images import grid_text, text_grid
from miricigale.photometry.images.flags import ForcedFlags
from miricigale.photometry.images.sky_noise import warn_of_sky
from miricigale.photometry.shapes.shapes import not_fitted
from miricigale.photometry.shapes.template_choice import cutouts
from miricigale.profiles import ellipse_to_pixels, sersic_stamp
from miricigale.utils.arrays import nans
from miricigale.utils.exceptions import argument_error
from miricigale.utils.file_formats import read_write
from miricigale.utils.meta import provenance
from miricigale.utils.missing_values import floats
from miricigale.utils.options import check_choice, check_shape, check_that
from miricigale.utils.parallel import single_threaded, threads
from miricigale.utils.tables import unique_ids
from miricigale.utils.units import ANGLE
from miricigale.utils.values import value_class

#: Arrays with a row for each source, and least signal-to-noise of a segment whose shape is looked at.
_ROWS = ("id", "sersic", "flags", "snr", "fitted")
_MIN_SNR = 5.0


@value_class(kw_only=True)
class SourceTemplates:
    """
    The sources of a catalog and the light of each, before it is brought to an image.

    It does not depend on the image that is measured: made once from a high-resolution image it
    serves every band (`ForcedPhotometer.measure`, `measure_bands`). Made by `from_images`,
    `from_catalog` or `from_arrays`; those of different kinds are put together by `concatenate`.

    Attributes
    ----------
    id : `~numpy.ndarray`, shape (n,)
        Ids, each there once.
    sky : `~astropy.coordinates.SkyCoord`, shape (n,)
        Positions (ICRS).
    light : tuple of `~miricigale.photometry.detection.cutouts.Cutout` or None
        Light of each source on the pixels of ``wcs``; None for points and for ``sersic``.
    sersic : `~numpy.ndarray`, shape (n, 4)
        Profiles that are not on pixels: half-light radius (arcsec), Sersic index, axis ratio and
        position angle (rad); NaN for all others.
    flags : int `~numpy.ndarray`, shape (n,)
        See `ForcedFlags`: why a source is a point.
    snr : `~numpy.ndarray`, shape (n,)
        Signal-to-noise of the segments; NaN without one.
    fitted : `~numpy.ndarray` of `~miricigale.photometry.shapes.shapes.FITTED`, shape (n,)
        The profiles that were fitted to the sources and how well they are known, x and y on the grid;
        NaN for templates that are taken without error.
    wcs : `~astropy.wcs.WCS` or None
        The grid of ``light``, whose pixels are those of the matching kernels; None where no
        source needs one.
    psf : `~numpy.ndarray`, shape (k, k), or None
        PSF of the high-resolution image, of unit sum.
    flux : `~numpy.ndarray`, shape (n,), or None
        The catalog's fluxes, in any unit, by which crowded sources are found.
    components : int `~numpy.ndarray`, shape (n,), or None
        1, or 2 for sources that are fitted with a point on top of their template.
    meta : dict
        Settings and provenance.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropy.coordinates import SkyCoord
    >>> from astropy.table import QTable
    >>> from miricigale.photometry import SourceTemplates
    >>> sky = SkyCoord([53.10, 53.11], [-27.8, -27.8], unit="deg")
    >>> sources = QTable({"id": [1, 2], "sky": sky, "profile": ["sersic", "point"]})
    >>> sources["half_light_radius"] = [0.3, 0.0] * u.arcsec
    >>> sources["sersic_index"], sources["axis_ratio"] = [1.5, 1.0], [0.7, 1.0]
    >>> sources["position_angle"] = [30, 0] * u.deg
    >>> SourceTemplates.from_catalog(sources, template="sersic")
    <SourceTemplates 2 sources: 1 point, 1 sersic>
    """

    io_module: ClassVar[str] = "miricigale.photometry.fit.files"
    read, write = read_write("the templates, bit for bit,")

    id: np.ndarray
    sky: SkyCoord
    light: tuple
    sersic: np.ndarray | None = None
    flags: np.ndarray | None = None
    snr: np.ndarray | None = None
    fitted: np.ndarray | None = None
    wcs: object = None
    psf: np.ndarray | None = None
    flux: np.ndarray | None = None
    components: np.ndarray | None = None
    meta: dict = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        n = len(self.id)
        object.__setattr__(self, "light", tuple(self.light))
        unique_ids(self.id, "id")
        # values of columns that are not given
        nothing = {
            "sersic": nans((n, 4)), "flags": np.zeros(n, int), "snr": nans(n),
            "fitted": not_fitted(n),
        }  # fmt: skip
        shapes = dict.fromkeys(_ROWS + OPTIONAL, (n,)) | {"sersic": (n, 4)}
        for name in (*_ROWS, *OPTIONAL, "psf"):
            value = getattr(self, name)
            value = nothing.get(name) if value is None else np.array(value)
            if value is None:
                continue
            if name in shapes:
                check_shape(value, shapes[name], name)
            value.flags.writeable = False
            object.__setattr__(self, name, value)
        if len(self.light) != n or len(self.sky) != n:
            lengths = f"{len(self.sky)} and {len(self.light)}"
            raise argument_error("sky, light", f"{n} each, as many as ids", lengths)
        if self.wcs is None and self.light.count(None) < n:
            raise argument_error("wcs", "the grid that the light is on", "None")

    @classmethod
    def from_images(
        cls, highres, segmentation, catalog, *, psf, template="auto", wings=True, n_threads=None
    ):
        """
        Look at the sources of a catalog on a high-resolution image.

        Parameters
        ----------
        highres : `~astropy.nddata.CCDData`
            The image, in units of surface brightness, background subtracted, with WCS,
            uncertainty and mask.
        segmentation : `~photutils.segmentation.SegmentationImage` or array
            Segments of ``highres``.
        catalog : `~astropy.table.QTable`
            Column ``sky``, and if there are ``id`` (1, 2, ... otherwise), ``label`` (the
            segment; by default that at the position), ``flux`` (by which crowded sources are found; the
            measured fluxes otherwise) and ``components`` (1, or 2 for a point on top of the template).
        psf : `~numpy.ndarray` or `~photutils.psf.ImagePSF`
            PSF of ``highres``: an array on its pixels, odd, square and centered, or one of the
            package's PSFs on the sky. For kernels that is their ``source``.
        template : {"auto", "cutout"}, optional
            ``"auto"`` decides for each source whether it is a point, a Sersic profile or what the
            image shows, if the signal-to-noise of its segment is at least 5; ``"cutout"`` takes the image
            wherever there is a segment.
        wings : bool, optional
            Whether cutouts are carried on beyond their core by a profile; otherwise they are the
            segments as they are.
        n_threads : int, optional
            Number of threads; by default one for each processor. It changes nothing in the
            result.

        Returns
        -------
        templates : `SourceTemplates`

        Raises
        ------
        ValueError, TypeError, `~astropy.units.UnitsError`
            If an input does not fit; the message says which.
        """
        check_choice(template, "template", ("auto", "cutout"))
        columns = catalog_sources(catalog, epoch_of(highres))
        fine = image_arrays(highres, "highres", np.float32, fitted=True)
        segments = _segments(segmentation, fine.flux.shape)
        scale = pixel_scale(highres.wcs)
        psf = _psf_array(psf, scale)
        xy = sky_to_pixels(columns["sky"], highres.wcs)
        warn_of_sky(fine, segments)
        label, _ = nearest_values(segments, xy)
        if "label" in catalog.colnames:
            check_labels(np.asarray(catalog["label"]), label, "catalog['label']")
            label = catalog["label"]
        label, flags = own_segments(segments, label, xy)
        width = 1 / np.sqrt(psf.max() / psf.sum())
        full, flat = saturated_cores(fine.flux, fine.usable, segments, label, xy, width)
        flags[full] |= ForcedFlags.SATURATED
        data = fine.flux
        variance = fine.sigma
        del fine
        variance *= variance
        variance[flat] = np.inf
        min_snr = _MIN_SNR if template == "auto" else 0.0
        with threads(n_threads) as executor, single_threaded():
            light, choice_flags, snr, fitted = cutouts(
                data, variance, psf, scale, segments, label, xy,
                select=template == "auto", wings=wings,
                min_snr=min_snr, executor=executor,
            )  # fmt: skip
        return cls(
            **columns, light=light, flags=flags | choice_flags, snr=snr, fitted=fitted, wcs=highres.wcs, psf=psf,
            meta=provenance(template=template, min_snr=_MIN_SNR, wings=bool(wings)),
        )  # fmt: skip

    @classmethod
    def from_catalog(cls, catalog, *, template="psf", wcs=None):
        """
        Make templates from a catalog alone: points, or the Sersic profiles that it states.

        Parameters
        ----------
        catalog : `~astropy.table.QTable`, path-like or other
            As for `from_images`, or with positions as `ForcedPhotometer.measure` takes them. For profiles with
            ``half_light_radius``, ``sersic_index``, ``axis_ratio`` and ``position_angle``, and if there is one
            ``profile``: rows in which it is not ``"sersic"`` are points.
        template : {"psf", "sersic"}, optional
            Which of the two.
        wcs : `~astropy.wcs.WCS`, `~astropy.io.fits.Header` or image, optional
            A grid on which profiles are drawn; by default one that is north up about the
            middle of each image that is measured.

        Returns
        -------
        templates : `SourceTemplates`

        Raises
        ------
        ValueError, TypeError, `~astropy.units.UnitsError`
            If an input does not fit; the message says which.

        Warns
        -----
        `~miricigale.utils.exceptions.CatalogWarning`
            If profiles are points, because a number of them is missing or of no profile: how many, by column.
        """
        check_choice(template, "template", ("psf", "sersic"))
        has_positions = isinstance(catalog, Table) and "sky" in catalog.colnames
        if not has_positions:
            catalog = read_catalog(catalog, wcs)
        columns = catalog_sources(catalog)
        rows = None
        if template == "sersic":
            rows = sersic_rows(catalog)
        if wcs is not None:
            wcs = as_wcs(wcs)
        points = (None,) * len(columns["id"])
        meta = provenance(template=template)
        return cls(**columns, light=points, sersic=rows, wcs=wcs, meta=meta)

    @classmethod
    def from_arrays(cls, arrays, corners, catalog, *, wcs, convolved=True):
        """
        Take pictures of the sources that others made.

        Parameters
        ----------
        arrays : sequence of `~numpy.ndarray` or None
            Light of each source on the grid, of any total; None for a point.
        corners : int array_like, shape (n, 2)
            Pixel (y, x) of the grid, from 0, on which the first pixel of each array lies.
        catalog : `~astropy.table.QTable`
            As for `from_images`, without labels.
        wcs : `~astropy.wcs.WCS`, `~astropy.io.fits.Header` or image
            The grid, whose pixels are those of the matching kernels.
        convolved : bool or array_like of bool, shape (n,), optional
            Whether arrays show the sources through the high-resolution PSF (as that image does)
            or as they are, integrated over the pixels.

        Returns
        -------
        templates : `SourceTemplates`

        Raises
        ------
        ValueError, TypeError
            If an array has no positive total or values that are not finite, or numbers differ.
        """
        columns = catalog_sources(catalog)
        n = len(columns["id"])
        arrays = list(arrays)
        corners = np.asarray(corners)
        if len(arrays) != n or corners.shape != (n, 2) or corners.dtype.kind not in "iu":
            got = f"{len(arrays)} arrays, corners {corners.dtype} of shape {corners.shape}"
            raise argument_error("arrays, corners", f"{n} each, as many as sources", got)
        convolved = np.broadcast_to(np.asarray(convolved, bool), n)
        light = [None] * n
        for k, array in enumerate(arrays):
            if array is None:
                continue
            data = floats(array)
            total = data.sum() if data.ndim == 2 else np.nan
            wanted = "two-dimensional, finite and of positive total"
            got = f"shape {data.shape} and total {total} of source {columns['id'][k]}"
            check_that(np.isfinite(total) and total > 0, "arrays", wanted, got)
            corner = tuple(corners[k].tolist())
            light[k] = Cutout(data / total, corner, convolved=bool(convolved[k]))
        return cls(**columns, light=light, wcs=as_wcs(wcs), meta=provenance(template="arrays"))

    @classmethod
    def concatenate(cls, parts):
        """
        Put templates of several kinds together, such as galaxies and stars.

        Parameters
        ----------
        parts : sequence of `SourceTemplates`
            On one grid, or without any; no id may be in two. Two sources may be at one position,
            such as a galaxy and a point in its middle.

        Returns
        -------
        templates : `SourceTemplates`
            Without ``flux`` and ``components`` unless all parts have them; ``meta`` is that of the
            first part.

        Raises
        ------
        ValueError
            If there is no part, grids differ, or an id is there twice.
        """
        parts = list(parts)
        check_that(parts, "parts", "at least one SourceTemplates", "none")
        wcs = None
        psf = None
        light = ()
        names = []
        for part in parts:
            if wcs is None:
                wcs = part.wcs
            elif part.wcs is not None and not same_grid(part.wcs, wcs):
                raise argument_error("parts", "on one grid", "different ones")
            if psf is None:
                psf = part.psf
            light += part.light
            names.append(str(part.meta.get("template")))
        # columns that all parts have
        rows = {}
        for name in _ROWS + OPTIONAL:
            values = [getattr(part, name) for part in parts]
            if all(column is not None for column in values):
                rows[name] = np.concatenate(values)
        # numbers of divided galaxies are those of their part
        part_number = np.repeat(np.arange(len(parts)), list(map(len, parts)))
        number = rows["fitted"]["galaxy"]
        number += np.where(number > 0, part_number * number.max(initial=0.0), 0.0)
        return cls(
            **rows,
            sky=joined_sky([part.sky for part in parts]),
            light=light,
            wcs=wcs,
            psf=psf,
            meta={**parts[0].meta, "template": ", ".join(dict.fromkeys(names))},
        )

    def __len__(self):
        return len(self.id)

    def __getitem__(self, rows):
        """Return some of the sources, by a slice, a mask or an array of row numbers."""
        rows = np.atleast_1d(np.arange(len(self))[rows])
        columns = {"sky": self.sky[rows]}
        for name in _ROWS + OPTIONAL:
            values = getattr(self, name)
            if values is not None:
                columns[name] = values[rows]
        return dataclasses.replace(self, light=[self.light[k] for k in rows], **columns)

    def __repr__(self):
        kinds, counts = np.unique(self.kind, return_counts=True)
        text = f"SourceTemplates {len(self)} sources"
        if len(self):
            text += ": " + ", ".join(map("{} {}".format, counts, kinds))
        return f"<{text}>"

    @property
    def kind(self):
        """``"point"``, ``"sersic"`` or ``"cutout"``, shape (n,)."""
        kinds = np.full(len(self), "point", "U6")
        kinds[np.isfinite(self.sersic[:, 0])] = "sersic"
        for k, cutout in enumerate(self.light):
            if cutout is not None:
                kinds[k] = cutout.kind
        return kinds

    def drawn(self, grid, xy):
        """
        Draw the light of all sources on a grid, Sersic profiles of the catalog among them.

        Parameters
        ----------
        grid : `~astropy.wcs.WCS`
            The grid, which must be ``wcs`` if that is not None.
        xy : `~numpy.ndarray`, shape (n, 2)
            Positions of the sources on it.

        Returns
        -------
        light : list of `~miricigale.photometry.detection.cutouts.Cutout` or None
            None for points.
        """
        light = list(self.light)
        rows = np.flatnonzero(np.isfinite(self.sersic[:, 0]))
        if not len(rows):
            return light
        jacobian = _pixels_per_arcsec(self.sky[rows[0]], grid)
        for k in rows:
            radius, index, ratio, angle = self.sersic[k]
            r_eff, q, theta = ellipse_to_pixels(
                jacobian, radius=radius, axis_ratio=ratio, position_angle=angle
            )
            # cut at the isophote of 99.5 % of the light
            stamp, origin = sersic_stamp(
                x=xy[k, 0], y=xy[k, 1], r_eff=float(r_eff), n=index, axis_ratio=float(q),
                theta=float(theta),
            )  # fmt: skip
            light[k] = Cutout(stamp, origin, convolved=False)
        return light

    def __getstate__(self):
        state = dict(self.__dict__)
        if self.wcs is not None:
            # a WCS pickles through a header, which rounds its numbers
            state["wcs"] = grid_text(self.wcs)
        return state

    def __setstate__(self, state):
        self.__dict__.update(state)
        if state["wcs"] is not None:
            self.__dict__["wcs"] = text_grid(state["wcs"])


def _segments(segmentation, shape):
    if isinstance(segmentation, SegmentationImage):
        segmentation = segmentation.data
    segments = np.asarray(segmentation)
    if segments.shape != shape or segments.dtype.kind not in "iu":
        wanted = f"integers of the shape {shape} of 'highres'"
        got = segments.dtype
        raise argument_error("segmentation", wanted, f"{got} of shape {segments.shape}")
    return segments


def _psf_array(psf, scale):
    """Return a PSF on the pixels of the image, of unit sum."""
    if isinstance(psf, ImagePSF):
        from miricigale.psf import instrument_psf, psf_image

        n = 2 * int(instrument_psf(psf).half_width / scale - 0.5 + 1e-6) + 1
        psf = psf_image(psf, pixel_scale=scale * ANGLE, shape=n)
    psf = floats(psf)
    if psf.ndim != 2 or psf.shape[0] != psf.shape[1] or psf.shape[0] % 2 == 0:
        raise argument_error("psf", "an ImagePSF, or an array that is odd and square", psf.shape)
    total = psf.sum()
    if not (np.isfinite(total) and total > 0):
        raise argument_error("psf", "finite and of positive sum", f"a sum of {total}")
    return psf / total


def _pixels_per_arcsec(sky, wcs):
    """Return the Jacobian [dx, dy] = J @ [east, north] (pixels per arcsec) of a WCS at a position."""
    moved = sky.directional_offset_by([90, 0] * u.deg, 1 * u.arcsec)
    return np.array(wcs.world_to_pixel(moved)) - np.array(wcs.world_to_pixel(sky))[:, None]
