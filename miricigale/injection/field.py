"""The field into which sources are injected: what its user measures, without and with them."""

import dataclasses
import functools

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.injection.light import light_on_image, psf_on_pixels
from miricigale.injection.population import fitted_shapes
from miricigale.instrument.sky_axes import grid_angle
from miricigale.photometry import ForcedPhotometer, detect_sources
from miricigale.photometry.arrays import nearest_values, pixel_scale
from miricigale.photometry.catalogs import joined_sky
from miricigale.photometry.file_inputs import Pixels
from miricigale.photometry.kernel_files import image_psf
from miricigale.photometry.packaging import new_ids
from miricigale.psf import make_psf, psf_image, rotate_psf
from miricigale.utils.exceptions import argument_error
from miricigale.utils.tables import match_sky
from miricigale.utils.units import ANGLE, FNU


@dataclasses.dataclass(frozen=True, eq=False)
class Measured:
    """What a user's photometry gives for the sources of a field, and for those that were injected."""

    table: QTable  # The user's table.
    result: object  # `~miricigale.photometry.ForcedPhotometryResult`
    image: object  # `~astropy.nddata.CCDData`: what was measured.
    #: Row of the result of each injected source; -1 for those that the prior does not show.
    rows: np.ndarray


def recovered_rows(positions, fluxes, known, known_fluxes, sky, flux, radius):
    """
    Say which detection is which injected source.

    Parameters
    ----------
    positions, fluxes
        Detections on the image with the sources: `~astropy.coordinates.SkyCoord`, and `~numpy.ndarray` in uJy.
    known, known_fluxes
        The same on the image without them.
    sky, flux
        The same of the injected sources.
    radius : `~astropy.units.Quantity`
        Largest distance of a match.

    Returns
    -------
    rows : int `~numpy.ndarray`, shape (n,)
        Row of the detection of each injected source, -1 if it was not recovered: without a detection within the
        radius, or hidden by a brighter source that was there before.
    """
    rows, _ = match_sky(positions, sky, radius=radius)
    if len(known) and len(sky):
        nearest, apart, _ = sky.match_to_catalog_sky(known)
        hidden = (apart < radius) & (known_fluxes[nearest] > flux)
        rows = np.where(hidden, -1, rows)
    return rows


class PriorField:
    """
    A field that is measured on a high-resolution prior.

    Parameters
    ----------
    inputs : `~miricigale.photometry.file_inputs.Inputs`
        What the user measures: one image, the prior and all options.
    n_threads : int, optional
        Threads; they change nothing.
    """

    has_prior = True

    def __init__(self, inputs, n_threads=None):
        self.inputs, self.n_threads = inputs, n_threads
        (self.band,) = inputs.bands
        self.prior_band = inputs.highres.header.filter

    @functools.cached_property
    def photometers(self):
        """What measures the image, by band."""
        photometers = self.inputs.photometers(self.n_threads)
        if photometers[self.band].bare:
            wanted = "given with their PSFs, which injected sources are drawn with"
            raise argument_error("kernel", wanted, "a kernel without 'highres_psf'")
        return photometers

    def psfs(self, result):
        """
        PSFs of the image and of the prior, as stars have corrected them.

        Parameters
        ----------
        result : `~miricigale.photometry.ForcedPhotometryResult`
            The user's.

        Returns
        -------
        psf, prior_psf : `~miricigale.psf.InstrumentPSF`
        """
        kernel = self.photometers[self.band].mean_kernel
        if result.psf_stars is not None:
            kernel = result.psf_stars.kernel
            kernel = getattr(kernel, "mean", kernel)
        header = self.inputs.highres.header
        form = {"pixel_scale": kernel.pixel_scale, "frame": "sky"}
        form["angle"] = grid_angle(header.wcs, header.shape)
        target, source = (np.asarray(one) for one in (kernel.target, kernel.source))
        return (
            make_psf(target, enclosed=min(1.0, float(target.sum())), **form),
            make_psf(source, enclosed=min(1.0, float(source.sum())), **form),
        )

    def usable(self, image, prior):
        """Pixels of the image that have data, in the prior too: bool, (ny, nx)."""
        good = ~np.asarray(image.mask, bool)
        y, x = np.nonzero(good)
        xy = np.stack(prior.wcs.world_to_pixel(image.wcs.pixel_to_world(x, y)), axis=-1)
        on_prior, _ = nearest_values(~np.asarray(prior.mask, bool), xy)
        good[y[~on_prior], x[~on_prior]] = False
        return good

    def measure(self, sources=None, psfs=None, known=None, image_file=None):
        """
        Measure the field as its user does.

        Parameters
        ----------
        sources : `~astropy.table.QTable`, optional
            What is injected: ``sky``, ``profile``, shapes, ``flux`` and ``prior_flux``; nothing by default.
        psfs : (psf, prior_psf), optional
            Of `psfs`, for the sources.
        known : `~astropy.table.QTable`, optional
            ``sky`` and ``flux`` of what is detected on the prior without them.
        image_file : `~miricigale.photometry.MosaicFile`, optional
            An image that shows the sources already; theirs is the light on the prior alone then.

        Returns
        -------
        measured : `Measured`
        pixels : `~miricigale.photometry.file_inputs.Pixels`
        segments, catalog
            Of the prior, as the user's photometry takes them.
        """
        inputs = self.inputs
        n = 0 if sources is None else len(sources)
        light = prior_light = None
        if n and image_file is None:
            light = self._light(inputs.images[0], sources, sources["flux"], psfs[0])
        if n:
            prior_light = self._light(inputs.highres, sources, sources["prior_flux"], psfs[1])
        file = inputs.images[0] if image_file is None else image_file
        pixels = Pixels(inputs.highres.read(prior_light), [], {self.band: file.read(light)})
        segments, catalog = inputs.find_sources(pixels, inputs.catalog)
        detected = inputs.segmentation is None and inputs.catalog is None
        if n and not detected:
            segments, catalog = self._with_sources(pixels, segments, catalog, sources)
        measurement = inputs.measure(pixels, self.photometers, segments, catalog)
        rows = np.arange(len(catalog) - n, len(catalog))
        if n and detected:
            prior_fluxes = sources["prior_flux"].to_value(FNU)
            fluxes = np.asarray(catalog["flux"].to_value(FNU))
            known_fluxes = np.asarray(known["flux"].to_value(FNU))
            # as far as a position of the prior may be off and still be the source's
            radius = measurement.results[self.band].psf_fwhm / 2
            where = catalog["sky"], fluxes, known["sky"], known_fluxes
            rows = recovered_rows(*where, sources["sky"], prior_fluxes, radius)
        result = measurement.results[self.band]
        found = Measured(measurement.table, result, pixels.images[self.band], rows)
        return found, pixels, segments, catalog

    def _light(self, file, sources, flux, psf):
        header = file.header
        own = psf_on_pixels(psf, header.wcs, header.shape)
        return light_on_image(sources, flux, header.wcs, header.shape, own, self.n_threads)

    def _with_sources(self, pixels, segments, catalog, sources):
        """Segments and catalog with the injected sources: their segments are those that detection finds."""
        rows = QTable({"id": new_ids(np.asarray(catalog["id"]), len(sources))})
        rows["sky"] = sources["sky"]
        places = np.stack(pixels.prior.wcs.world_to_pixel(sources["sky"]), axis=-1)
        if self.inputs.segmentation is None:
            # the map is one of the prior with the sources
            rows["label"], _ = nearest_values(segments, places)
        else:
            own, _ = detect_sources(pixels.prior)
            segments, rows["label"] = joined_segments(segments, own.data, places)
        both = QTable({"id": np.concatenate([np.asarray(catalog["id"]), rows["id"]])})
        both["sky"] = joined_sky([catalog["sky"], rows["sky"]])
        both["label"] = np.concatenate([np.asarray(catalog["label"], int), rows["label"]])
        return segments, both

    def shapes(self, pixels, segments, catalog, psfs):
        """Fitted profiles of the sources (`~miricigale.injection.population.fitted_shapes`)."""
        psf = self.photometers[self.band].mean_kernel.source
        return fitted_shapes(pixels.prior, segments, catalog, psf, self.n_threads)


def joined_segments(segments, own, places):
    """
    Add the segments of injected sources to a map.

    Parameters
    ----------
    segments : int `~numpy.ndarray`, shape (ny, nx)
        The user's map.
    own : int `~numpy.ndarray`, shape (ny, nx)
        Segments of a detection on the image with the sources.
    places : `~numpy.ndarray`, shape (n, 2)
        Pixel positions of the sources.

    Returns
    -------
    segments : int `~numpy.ndarray`, shape (ny, nx)
        A copy with new labels; pixels of other sources stay theirs.
    labels : int `~numpy.ndarray`, shape (n,)
        Those of the sources; 0 without a segment, or on that of another source.
    """
    segments = segments.copy()
    first = int(segments.max()) + 1
    here, _ = nearest_values(segments, places)
    theirs, _ = nearest_values(own, places)
    labels = np.zeros(len(places), int)
    for k in np.flatnonzero((here == 0) & (theirs > 0)):
        labels[k] = first + k
        segments[(own == theirs[k]) & (segments == 0)] = labels[k]
    return segments, labels


class ImageField:
    """
    A field of an image alone: positions and shapes of all sources are known.

    Parameters
    ----------
    file : `~miricigale.photometry.MosaicFile`
        The image.
    preset : str or `~miricigale.photometry.DetectionPreset`
        How its own sources are detected.
    options : dict
        Of `~miricigale.photometry.ForcedPhotometer`.
    n_threads : int, optional
        Threads; they change nothing.
    """

    has_prior = False
    prior_band = None

    def __init__(self, file, preset, options, n_threads=None):
        self.file, self.preset, self.n_threads = file, preset, n_threads
        self.options = {"background_order": 0, **options}
        self.band = file.header.filter

    @functools.cached_property
    def psf(self):
        """The PSF of the image, `~miricigale.psf.InstrumentPSF`."""
        psf = image_psf(self.file)
        if psf is None:
            wanted = f"given, for there is no model PSF for {self.file.path}"
            raise argument_error("psf", wanted, None)
        return psf

    def psfs(self, result):
        """The PSF of the image, and None."""
        return self.psf, None

    def usable(self, image, prior):
        """Pixels of the image that have data: bool, (ny, nx)."""
        return ~np.asarray(image.mask, bool)

    def measure(self, sources=None, psfs=None, known=None, image_file=None):
        """As `PriorField.measure`; ``known`` are the sources of the field with their shapes."""
        n = 0 if sources is None else len(sources)
        light = None
        if n and image_file is None:
            header = self.file.header
            psf = psf_on_pixels(psfs[0], header.wcs, header.shape)
            where = header.wcs, header.shape, psf, self.n_threads
            light = light_on_image(sources, sources["flux"], *where)
        image = (self.file if image_file is None else image_file).read(light)
        segments = None
        if known is None:
            segmentation, catalog = detect_sources(image, preset=self.preset)
            segments = segmentation.data
            known = self._shapes(image, segments, catalog)
        catalog = with_shapes(known, sources)
        photometer = ForcedPhotometer(
            psf=self.psf, template="sersic", n_threads=self.n_threads, **self.options
        )
        result = photometer.measure(image, catalog=catalog)
        rows = np.arange(len(catalog) - n, len(catalog))
        found = Measured(result.to_table(self.band), result, image, rows)
        return found, Pixels(None, [], {self.band: image}), segments, known

    def _shapes(self, image, segments, catalog):
        header = self.file.header
        scale = pixel_scale(header.wcs)
        turned = rotate_psf(self.psf, grid_angle=grid_angle(header.wcs, header.shape))
        n = 2 * int(self.psf.half_width / scale) + 1
        psf = psf_image(turned, pixel_scale=scale * ANGLE, shape=n)
        return fitted_shapes(image, segments, catalog, psf, self.n_threads)

    def shapes(self, pixels, segments, catalog, psfs):
        """Fitted profiles of the sources, which are the catalog."""
        return catalog


def with_shapes(known, sources):
    """A catalog of Sersic profiles and points: those of the field, and after them what is injected."""
    tables = [known] if sources is None else [known, sources]
    rows = QTable()
    ids = np.asarray(known["id"])
    if sources is not None:
        ids = np.concatenate([ids, new_ids(ids, len(sources))])
    rows["id"] = ids
    rows["sky"] = joined_sky([one["sky"] for one in tables])
    rows["profile"] = np.concatenate([np.asarray(one["profile"]) for one in tables])
    for name, unit in (
        ("half_light_radius", ANGLE),
        ("sersic_index", None),
        ("axis_ratio", None),
        ("position_angle", u.deg),
    ):
        values = [np.asarray(u.Quantity(one[name]).value) for one in tables]
        rows[name] = np.concatenate(values) * (1 if unit is None else unit)
    return rows


def image_field(file, inputs, preset, options, n_threads=None):
    """The field of an image: a `PriorField` where there is a prior, or an `ImageField`."""
    if inputs is not None:
        return PriorField(inputs, n_threads)
    return ImageField(file, preset, options, n_threads)


def over_noise(model, xy):
    """Light of a model (a `~astropy.nddata.CCDData`) over the noise of its pixels, shape (n,); NaN outside."""
    values, inside = nearest_values(np.asarray(model.data, float), xy)
    noise, _ = nearest_values(np.asarray(model.uncertainty.array, float), xy)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(inside, values / noise, np.nan)
