"""What forced photometry returns."""

import dataclasses
import functools
from typing import ClassVar

import astropy.units as u
import numpy as np
import scipy.ndimage
import scipy.sparse
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, StdDevUncertainty
from astropy.stats import gaussian_sigma_to_fwhm
from astropy.table import QTable
from scipy.special import ndtr, ndtri

from miricigale.evaluation.match import associate
from miricigale.instrument import pixel_area_map
from miricigale.instrument.image import Image
from miricigale.photometry.detection.prior_catalog import read_catalog
from miricigale.photometry.fit.offsets import OffsetMap
from miricigale.photometry.images.arrays import pixel_scale
from miricigale.photometry.images.fields import SmoothField
from miricigale.photometry.images.flags import ForcedFlags
from miricigale.photometry.templates.normal_equations import correlated_draws
from miricigale.utils.arrays import nans, quotient
from miricigale.utils.exceptions import argument_error, units_error
from miricigale.utils.file_formats import read_write
from miricigale.utils.flag_arrays import FlagField
from miricigale.utils.interactive import Tabular
from miricigale.utils.missing_values import floats
from miricigale.utils.named_values import field_names
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.package_tables import column_texts
from miricigale.utils.random import check_seed
from miricigale.utils.region_files import circles, write_circles
from miricigale.utils.tables import described_table
from miricigale.utils.units import ANGLE, FNU, SURFACE_BRIGHTNESS, check_count, is_number, positive
from miricigale.utils.values import value_class

#: Columns of which a band's name takes the place of flux.
_FLUXES = ("flux", "flux_err", "flux_err_noise", "flux_err_template", "flux_err_psf")


def band_column(key, band):
    """Return a column's name in a table of a band, if one is given: ``<band>_flags`` for ``flags``."""
    if band is None or key in ("id", "sky"):
        return key
    if key in _FLUXES:
        return key.replace("flux", band, 1)
    return f"{band}_{key}"


@takes_other_keywords
def crowded(sky, flux, *, radius=2 * u.arcsec):
    """
    Find sources that have a neighbor which is bright enough to matter.

    Parameters
    ----------
    sky : `~astropy.coordinates.SkyCoord`, shape (n,)
        Positions.
    flux : array_like or `~astropy.units.Quantity`, shape (n,)
        Fluxes.
    radius : `~astropy.units.Quantity`, optional
        How near a neighbor is.

    Returns
    -------
    crowded : bool `~numpy.ndarray`, shape (n,)
        Whether a neighbor is brighter than the source's magnitude + 1. A source whose flux is not positive is
        crowded by any positive neighbor, one whose
        position is not known by none.

    References
    ----------
    Yang et al. 2021, ApJ 908, 144, section 4.1.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropy.coordinates import SkyCoord
    >>> from miricigale.photometry import crowded
    >>> sky = SkyCoord([53.1, 53.1003, 53.2], [-27.8] * 3, unit="deg")
    >>> crowded(sky, [1.0, 9.0, 5.0] * u.uJy)
    array([ True, False, False])
    """
    is_crowded = np.zeros(len(sky), bool)
    placed = np.flatnonzero(np.isfinite(sky.spherical.lon) & np.isfinite(sky.spherical.lat))
    if len(placed) > 1:
        flux = floats(flux)
        i, j, _, _ = sky[placed].search_around_sky(sky[placed], radius)
        i = placed[i]
        j = placed[j]
        # one magnitude fainter
        limit = np.maximum(flux[i], 0.0) * 10**-0.4
        is_crowded[i[(i != j) & (flux[j] > limit)]] = True
    return is_crowded


@value_class(kw_only=True)
class ForcedPhotometryResult(Tabular):
    """
    Fluxes of all sources of a catalog on one image.

    Attributes
    ----------
    id : `~numpy.ndarray`, shape (n,)
        The catalog's ids, in its order.
    sky : `~astropy.coordinates.SkyCoord`, shape (n,)
        The catalog's positions.
    flux, flux_err : `~astropy.units.Quantity`, shape (n,)
        Total fluxes and errors in uJy; NaN where not measured.
    flux_err_noise, flux_err_template, flux_err_psf : `~astropy.units.Quantity`, shape (n,)
        What the errors are the quadratic sum of: the noise of the image, what is not known of the
        templates (their shapes, and the noise of the high-resolution image), and the PSF's error.
    covariance : `~scipy.sparse.csr_array`, shape (n, n)
        In uJy^2, of all three terms, for pairs whose templates overlap; rows of sources that were not
        measured are empty.
    flags : int `~numpy.ndarray`, shape (n,)
        See `ForcedFlags`.
    coverage : `~numpy.ndarray`, shape (n,)
        Fraction of the template's light on usable pixels.
    chi2 : `~numpy.ndarray`, shape (n,)
        Template-weighted mean of (residual / sigma)^2, about 1 for a good fit. Sigma is the noise and, of the
        light, the part ``meta["pixel_scatter"]`` in each pixel, which resampling causes.
    residual_fraction : `~numpy.ndarray`, shape (n,)
        Light left below the template's core over what the fit took there.
    template : str `~numpy.ndarray`, shape (n,)
        Which template was used: ``"point"``, ``"sersic"`` (a profile alone), ``"cutout"`` (the
        high-resolution image itself where it is significant), or ``"none"`` for sources
        that are not on the image.
    template_snr : `~numpy.ndarray`, shape (n,)
        Signal-to-noise of the segment of the high-resolution image; NaN without one.
    crowded : bool `~numpy.ndarray`, shape (n,)
        Whether a neighbor within 2 arcsec is brighter than the source's magnitude + 1.
    x, y : `~numpy.ndarray`, shape (n,)
        Positions on the image; NaN far outside.
    model_image, residual_image : `~astropy.nddata.CCDData`
        On the image's grid, in MJy/sr whatever unit the image had; `images_in` has them in another unit.
    noise_correlation : `~numpy.ndarray`, shape (2 m + 1, 2 m + 1), or None
        Measured covariance of the noise in units of sigma^2 by separation; None where
        the noise was taken as white.
    background, background_err : `~astropy.units.Quantity` or None
        Constant that was fitted, or the mean over the image of a background that varies, MJy/sr.
    background_field : `~miricigale.photometry.SmoothField` or None
        The background in MJy/sr as a function of the pixel, ``background_field(x, y)``.
    shift, shift_err : `~astropy.units.Quantity`, shape (2,), or None
        Shift (x, y) of the image against the catalog, in arcsec along its axes.
    offset_map : `~miricigale.photometry.OffsetMap` or None
        Such shifts as a smooth function of the position, with the sources they were measured on.
    flux_point, flux_point_err : `~astropy.units.Quantity`, shape (n,), or None
        The part of ``flux`` that is a point on top of the template; NaN for sources of one component,
        None where no second components were asked for.
    joint_covariance : `~scipy.sparse.csr_array`, shape (2 n, 2 n), or None
        In uJy^2: of all ``flux``, then of all ``flux_point``.
    new_sources : `~astropy.table.QTable` or None
        What the catalog lacks, fitted with it: ``id`` (none of the catalog's), ``sky``,
        ``x_centroid``, ``y_centroid``, ``flux``, ``flux_err``, ``snr``, ``flags``, ``coverage`` and
        ``chi2``. None without a second pass.
    psf_stars : `~miricigale.photometry.fit.stars.KernelStars` or None
        The stars that corrected the PSFs, and the corrected kernel; None where it was not asked for.
    exposures : `~miricigale.photometry.ExposureResults` or None
        Of a fit of exposures their sky levels, shifts and noise, and the model and the residual of each;
        ``model_image`` and ``residual_image`` are then weighted means of nearest pixels, for pictures, on which
        ``x`` and ``y`` are. None for one image.
    psf_fwhm : `~astropy.units.Quantity` or None
        Full width at half maximum of a Gaussian as peaked as the image's PSF, in arcsec.
    meta : dict
        Settings and provenance.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropy.coordinates import SkyCoord
    >>> from astropy.nddata import CCDData, StdDevUncertainty
    >>> from miricigale.instrument import north_up_wcs
    >>> from miricigale.photometry import ForcedPhotometer
    >>> from miricigale.psf import gaussian_psf, psf_image
    >>> psf = gaussian_psf(0.4 * u.arcsec, pixel_scale=0.1 * u.arcsec, fov=4 * u.arcsec)
    >>> sky = SkyCoord([53.1], [-27.8], unit="deg")
    >>> wcs = north_up_wcs(sky[0], 0.1 * u.arcsec, (61, 61))
    >>> light = psf_image(psf, pixel_scale=0.1 * u.arcsec, shape=61)
    >>> noise = np.random.default_rng(1).normal(0, 0.01, (61, 61))
    >>> image = CCDData(2 * light + noise, unit="uJy", wcs=wcs)
    >>> result = ForcedPhotometer(psf=psf).measure(image, sky)
    >>> result
    <ForcedPhotometryResult 1 sources, 1 measured>
    >>> print(f"{result.magnitude[0]:.2f}, signal-to-noise {result.snr[0]:.0f}")
    23.13 mag(AB), signal-to-noise 34
    >>> result.sample(3, seed=1)[:, 0].round(2)
    <Quantity [2.07, 2.03, 2.13] uJy>
    """

    io_module: ClassVar[str] = "miricigale.photometry.fit.files"
    read, write = read_write("the result (FITS), or its table (ECSV),")

    id: np.ndarray
    sky: SkyCoord
    flux: u.Quantity
    flux_err: u.Quantity
    flux_err_noise: u.Quantity
    flux_err_template: u.Quantity
    flux_err_psf: u.Quantity
    covariance: scipy.sparse.csr_array
    flags: np.ndarray
    coverage: np.ndarray
    chi2: np.ndarray
    residual_fraction: np.ndarray
    template: np.ndarray
    template_snr: np.ndarray
    crowded: np.ndarray
    x: np.ndarray
    y: np.ndarray
    model_image: CCDData
    residual_image: CCDData
    noise_correlation: np.ndarray | None = None
    background: u.Quantity | None = None
    background_err: u.Quantity | None = None
    background_field: SmoothField | None = None
    shift: u.Quantity | None = None
    shift_err: u.Quantity | None = None
    offset_map: OffsetMap | None = None
    flux_point: u.Quantity | None = None
    flux_point_err: u.Quantity | None = None
    joint_covariance: scipy.sparse.csr_array | None = None
    new_sources: QTable | None = None
    psf_stars: object = None
    exposures: object = None
    psf_fwhm: u.Quantity | None = None
    meta: dict = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        # a column refers to its table, and does not pickle
        object.__setattr__(self, "sky", self.sky.copy())
        # not views of them
        for name in field_names(self):
            value = self.__dict__[name]
            if isinstance(value, np.ndarray):
                value.flags.writeable = False

    def __len__(self):
        return len(self.id)

    def __repr__(self):
        n = int(np.count_nonzero(np.isfinite(self.flux.value)))
        return f"<ForcedPhotometryResult {len(self)} sources, {n} measured>"

    @functools.cached_property
    def snr(self):
        """Flux over its error, shape (n,)."""
        return np.asarray((self.flux / self.flux_err).value)

    @functools.cached_property
    def flux_point_corr(self):
        """
        Correlation of the errors of ``flux`` and ``flux_point``, shape (n,); None without second components.

        It is that of ``joint_covariance``, and NaN for sources of one component.
        """
        if self.joint_covariance is None:
            return None
        n = len(self)
        variance = self.joint_covariance.diagonal()
        joint = self.joint_covariance.diagonal(n)
        size = np.sqrt(variance[:n] * variance[n:])
        correlation = quotient(joint, size, np.nan)
        return np.where(np.isfinite(self.flux_point.value), correlation, np.nan)

    @functools.cached_property
    def chi2_image(self):
        """
        Goodness of fit over the image: (residual / sigma)^2, averaged over the PSF.

        A `~astropy.nddata.CCDData` without unit, on average 1 where sigma is the noise; NaN and masked where the
        image is not usable. The average is weighted with a Gaussian of the width ``psf_fwhm``, over usable pixels.
        """
        image = self.residual_image
        usable = ~image.mask
        # mean of chi^2 over usable pixels, weighted with a Gaussian
        square = np.where(usable, image.data / image.uncertainty.array, 0.0) ** 2
        width = self.psf_fwhm.to_value(ANGLE) / pixel_scale(image.wcs) / gaussian_sigma_to_fwhm
        total = scipy.ndimage.gaussian_filter(square, width, mode="constant")
        weight = scipy.ndimage.gaussian_filter(usable.astype(float), width, mode="constant")
        chi2 = np.divide(total, weight, out=nans(total.shape), where=usable)
        return Image(chi2, unit="", wcs=image.wcs, mask=~usable, meta=dict(image.meta))

    def images_in(self, unit):
        """
        Return model and residual in another unit, such as that of the image that was measured.

        Parameters
        ----------
        unit : unit-like, quantity or `~astropy.nddata.CCDData`
            A unit of surface brightness, or of the flux in a pixel (``"nJy"``, ``"uJy/pix"``); an image stands for
            its unit. Of counts, the quantity that one count is: ``0.4 * u.MJy / u.sr``.

        Returns
        -------
        model, residual : `~astropy.nddata.CCDData`
            The residual has its mask and uncertainty. Fluxes in pixels are surface brightness times the solid
            angle of each pixel.

        Raises
        ------
        `~astropy.units.UnitsError`
            If the unit is none of these.

        Examples
        --------
        >>> model, residual = result.images_in("nJy")  # doctest: +SKIP
        >>> model, residual = result.images_in(image)  # doctest: +SKIP
        """
        if isinstance(unit, CCDData):
            unit = unit.unit
        unit = u.Unit(unit)
        area = 1.0
        for pixel in (u.dimensionless_unscaled, u.pix):
            if (unit * pixel).is_equivalent(FNU):
                area = pixel_area_map(self.model_image.wcs, self.model_image.shape)
                factor = u.MJy.to(unit * pixel)
                break
        else:
            if not unit.is_equivalent(SURFACE_BRIGHTNESS):
                wanted = f"convertible to {SURFACE_BRIGHTNESS} or {FNU}"
                raise units_error("unit", wanted, unit)
            factor = SURFACE_BRIGHTNESS.to(unit)
        scale = factor * area
        images = []
        for image in (self.model_image, self.residual_image):
            uncertainty = None
            if image.uncertainty is not None:
                uncertainty = StdDevUncertainty(image.uncertainty.array * scale)
            options = {"mask": image.mask, "meta": dict(image.meta), "uncertainty": uncertainty}
            images.append(Image(image.data * scale, unit=unit, wcs=image.wcs, **options))
        return tuple(images)

    def sample(self, size, *, seed=None):
        """
        Draw fluxes from their covariance, so that those of blends vary together.

        Parameters
        ----------
        size : int
            Number of draws.
        seed : int or `~numpy.random.Generator`, optional
            The same seed gives the same draws, for a source that overlaps no other also in
            another catalog.

        Returns
        -------
        flux : `~astropy.units.Quantity`, shape (size, n)
            NaN where not measured. Draws hold all that ``covariance`` holds: the noise of the image, and the
            errors of the templates and of the PSF.

        Raises
        ------
        ValueError
            If ``size`` is not positive.
        """
        size = check_count(size, "size")
        keys = [("forced flux", key) for key in self.id.tolist()]
        draws = correlated_draws(self.covariance, keys, size, check_seed(seed))
        return (self.flux.value + draws) * FNU

    def upper_limit(self, confidence=0.95):
        """
        Calculate upper limits of the fluxes (uJy) with some confidence, given that true fluxes are not negative.

        Parameters
        ----------
        confidence : float, optional
            Between 0 and 1.

        Returns
        -------
        limit : `~astropy.units.Quantity`, shape (n,)
            In uJy: quantile of a normal distribution about the measured flux that is cut at 0, so that it is
            positive for negative fluxes too; NaN where not measured.

        Raises
        ------
        ValueError
            If the confidence is not between 0 and 1.

        References
        ----------
        Helene 1983, Nucl. Instr. Meth. 212, 319, eq. 4.
        """
        if not (is_number(confidence) and 0 < confidence < 1):
            raise argument_error("confidence", "between 0 and 1 (0.9987 for 3 sigma)", confidence)
        return self.flux - ndtri((1 - confidence) * ndtr(self.snr)) * self.flux_err

    def _row(self, key):
        """Return the row of the source of an id."""
        rows = np.flatnonzero(self.id == key)
        if not len(rows):
            msg = f"no source with the id {key!r}"
            raise KeyError(msg)
        return int(rows[0])

    def correlation(self, first, second):
        """
        Return the correlation of the errors of two sources, given by id.

        Returns
        -------
        correlation : float
            0 where their templates do not overlap, NaN if one was not measured.

        Raises
        ------
        KeyError
            If the catalog has no such id.
        """
        rows = [self._row(first), self._row(second)]
        errors = self.flux_err.value[rows]
        return float(self.covariance[rows[0], rows[1]] / np.prod(errors))

    @property
    def magnitude(self):
        """AB magnitudes, `~astropy.units.Magnitude`; NaN where the flux is not positive."""
        flux = np.where(self.flux.value > 0, self.flux.value, np.nan) * self.flux.unit
        return flux.to(u.ABmag)

    @property
    def magnitude_err(self):
        """Errors of `magnitude`, mag: 2.5 / ln 10 of the relative errors; NaN where the flux is not positive."""
        snr = np.where(self.flux.value > 0, self.snr, np.nan)
        return 2.5 / np.log(10) / snr * u.mag

    def flag_names(self):
        """Return the names of the flags of each source: a list of lists of str."""
        return [list(ForcedFlags.names(value)) for value in self.flags]

    def _facts(self):
        measured = np.isfinite(self.flux.value)
        facts = {"sources": len(self), "measured": int(measured.sum())}
        facts["above 5 sigma"] = int(np.count_nonzero(self.snr[measured] > 5))
        flags = self.flags[self.flags != 0]
        for value, (name, _) in ForcedFlags.meanings().items():
            if n := int(np.count_nonzero(flags & value)):
                facts[f"flag {name}"] = n
        return facts

    def to_table(self, name=None, *, confidence=None):
        """
        Make a table of the fluxes.

        Parameters
        ----------
        name : str, optional
            Name of the filter: columns are then called ``<name>``, ``<name>_err``,
            ``<name>_flags`` and so on, so that tables of several bands can be joined by
            ``id``. Without it they are ``flux``, ``flux_err``, ``flags``...
        confidence : float, optional
            If given, that of a column ``upper`` of upper limits (see `upper_limit`).

        Returns
        -------
        table : `~astropy.table.QTable`
            With units, descriptions, and provenance in ``meta``.
        """
        texts = column_texts("miricigale.photometry", "forced")
        columns = {}
        facts = {"flags": ForcedFlags.describe(), "confidence": confidence}
        for key, text in texts.items():
            values = getattr(self, key, None)
            if key == "upper" and confidence is not None:
                values = self.upper_limit(confidence)
            if values is not None:
                columns[band_column(key, name)] = values, text.format(**facts)
        return described_table(columns, dict(self.meta))

    def write_regions(self, path, *, radius=0.5 * u.arcsec, overwrite=False):
        """
        Write the sources as regions of DS9, circles with the ids.

        Parameters
        ----------
        path : path-like
            The file, such as ``sources.reg``. Circles are green, orange where a flag is set, and red where nothing
            was measured.
        radius : `~astropy.units.Quantity`, optional
            Of the circles.
        overwrite : bool, optional
            Whether an existing file is replaced.

        Raises
        ------
        ImportError
            If the package regions is not installed (``pip install miricigale[regions]``).
        """
        write_circles(self._kinds(), path, radius=radius, overwrite=overwrite)

    def to_regions(self, *, radius=0.5 * u.arcsec):
        """Return the circles of `write_regions` as a list of the package regions (`~regions.Regions`)."""
        return circles(self._kinds(), radius)

    def _kinds(self):
        """Tabulate ids, positions and what kind of circle each source has."""
        kind = np.where(self.flags == 0, "good", "flagged")
        kind[~np.isfinite(self.flux.value)] = "missing"
        return QTable({"id": self.id, "sky": self.sky, "kind": kind})

    def match_to_catalog(self, catalog, radius=0.5 * u.arcsec):
        """
        Find the sources in another catalog.

        Parameters
        ----------
        catalog : table in any form, path-like or `~astropy.coordinates.SkyCoord`
            As for `ForcedPhotometer.measure`.
        radius : `~astropy.units.Quantity`, optional
            How near a source of the catalog is.

        Returns
        -------
        table : `~astropy.table.QTable`
            That of `~miricigale.evaluation.associate`, the photometry being the first catalog: a row for each
            source and for each row of the catalog that has none, with what is ambiguous named.
        """
        positions = QTable({"id": self.id, "sky": self.sky})
        return associate(positions, read_catalog(catalog)["id", "sky"], radius=radius)

    def plot(self, ax=None, **kwargs):
        """
        Draw image, model and residual side by side.

        Parameters
        ----------
        ax : sequence of three `~matplotlib.axes.Axes`, optional
            Where to draw.
        **kwargs
            Passed to `~miricigale.plotting.images.plot_model_residual`.

        Returns
        -------
        ax : `~miricigale.plotting.axes.AxesArray` of three `~matplotlib.axes.Axes`
        """
        from miricigale.plotting.images import plot_model_residual

        model = self.model_image.data
        residual = self.residual_image
        kwargs = {"pixel_scale": pixel_scale(residual.wcs), "unit": str(residual.unit)} | kwargs
        return plot_model_residual(residual.data + model, model, ax=ax, **kwargs)

    def plot_source(self, key, ax=None, *, size=5 * u.arcsec, **kwargs):
        """
        Draw image, model and residual about one source.

        Parameters
        ----------
        key : object
            Id of the source.
        ax : sequence of three `~matplotlib.axes.Axes`, optional
            Where to draw.
        size : `~astropy.units.Quantity`, optional
            Side of the cutouts.
        **kwargs
            Passed to `~miricigale.plotting.images.plot_model_residual`.

        Returns
        -------
        ax : `~miricigale.plotting.axes.AxesArray` of three `~matplotlib.axes.Axes`

        Raises
        ------
        KeyError
            If the catalog has no such id.
        ValueError
            If the source is not on the image.
        """
        from miricigale.plotting.images import plot_model_residual

        row = self._row(key)
        scale = pixel_scale(self.residual_image.wcs)
        half = max(1, round(positive(size, ANGLE, "size") / scale / 2))
        ny, nx = self.residual_image.shape
        place = self.x[row], self.y[row]
        # NaN is on no image
        inside = -0.5 <= place[0] < nx - 0.5 and -0.5 <= place[1] < ny - 0.5
        check_that(inside, "key", "a source on the image", repr(key))
        x = round(float(place[0]))
        y = round(float(place[1]))
        part = np.s_[max(y - half, 0) : y + half + 1, max(x - half, 0) : x + half + 1]
        model = self.model_image.data[part]
        residual = self.residual_image.data[part]
        return plot_model_residual(residual + model, model, ax=ax, pixel_scale=scale, **kwargs)


FlagField.add_to(ForcedPhotometryResult, "flags", ForcedFlags)
