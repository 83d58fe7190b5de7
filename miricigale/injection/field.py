"""The field into which sources are injected: what its user measures, without and with them."""

import functools

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.injection.light import light_on_file
from miricigale.injection.photon_noise import photon_noise
from miricigale.injection.population import fitted_shapes
from miricigale.instrument.sky_axes import grid_angle
from miricigale.photometry import ForcedPhotometer, detect_sources
from miricigale.photometry.commands.file_inputs import Pixels
from miricigale.photometry.commands.kernel_files import image_psf
from miricigale.photometry.detection.catalogs import joined_sky
from miricigale.photometry.fit.result_table import new_ids
from miricigale.photometry.images.arrays import nearest_values, pixel_scale
from miricigale.photometry.images.repeated_pixels import own_pixels
from miricigale.psf import make_psf, psf_image, rotate_psf
from miricigale.utils.arrays import quiet_division
from miricigale.utils.exceptions import argument_error
from miricigale.utils.tables import match_sky
from miricigale.utils.units import ANGLE, FNU
from miricigale.utils.values import value_class


@value_class
class Measured:
    """What a user's photometry gives for the sources of a field, and for those that were injected."""

    table: QTable  # The user's table.
    result: object  # `~miricigale.photometry.ForcedPhotometryResult`
    image: object  # `~astropy.nddata.CCDData`: what was measured.
    #: Row of the result of each injected source; -1 for those that the prior does not show.
    rows: np.ndarray


def recovered_rows(positions, former, former_fluxes, sky, flux, radius):
    """
    Say which detection is which injected source.

    Parameters
    ----------
    positions : `~astropy.coordinates.SkyCoord`
        Of detections on the image with the sources.
    former, former_fluxes
        Positions and fluxes (`~numpy.ndarray`, uJy) of detections on the image without them.
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
    if len(former) and len(sky):
        nearest, separation, _ = sky.match_to_catalog_sky(former)
        hidden = (separation < radius) & (former_fluxes[nearest] > flux)
        rows = np.where(hidden, -1, rows)
    return rows


def check_psfs(photometer):
    """Refuse a `~miricigale.photometry.ForcedPhotometer` of which the PSFs of image and prior are not known."""
    if photometer.bare:
        wanted = "given with their PSFs, which injected sources are drawn with"
        raise argument_error("kernel", wanted, "a kernel without 'highres_psf'")


def field_psfs(photometer, header, result):
    """
    Return the PSFs of an image and of its prior, as stars have corrected them.

    Parameters
    ----------
    photometer : `~miricigale.photometry.ForcedPhotometer`
        What measured the image.
    header : `~miricigale.photometry.images.mosaic_headers.MosaicHeader`
        Of the prior.
    result : `~miricigale.photometry.ForcedPhotometryResult`
        What it measured.

    Returns
    -------
    psf, prior_psf : `~miricigale.psf.InstrumentPSF`
    """
    kernel = photometer.mean_kernel
    if result.psf_stars is not None:
        kernel = result.psf_stars.kernel
        kernel = getattr(kernel, "mean", kernel)
    form = {"pixel_scale": kernel.pixel_scale, "frame": "sky"}
    form["angle"] = grid_angle(header.wcs, header.shape)
    target = np.asarray(kernel.target)
    source = np.asarray(kernel.source)
    return (
        make_psf(target, enclosed=min(1.0, float(target.sum())), **form),
        make_psf(source, enclosed=min(1.0, float(source.sum())), **form),
    )


class PriorField:
    """
    A field that is measured on a high-resolution prior.

    Parameters
    ----------
    inputs : `~miricigale.photometry.commands.file_inputs.Inputs`
        What the user measures: one image, the prior and all options.
    n_threads : int, optional
        Threads; they change nothing.
    """

    has_prior = True

    def __init__(self, inputs, n_threads=None):
        self.inputs = inputs
        self.n_threads = n_threads
        self.file = inputs.images[0]
        (self.band,) = inputs.bands
        self.prior_band = inputs.highres.header.filter

    @functools.cached_property
    def photometers(self):
        """What measures the image, by band."""
        photometers = self.inputs.photometers(self.n_threads)
        check_psfs(photometers[self.band])
        return photometers

    def psfs(self, result):
        """
        Return the PSFs of the image and of the prior, as stars have corrected them.

        Parameters
        ----------
        result : `~miricigale.photometry.ForcedPhotometryResult`
            The user's.

        Returns
        -------
        psf, prior_psf : `~miricigale.psf.InstrumentPSF`
        """
        return field_psfs(self.photometers[self.band], self.inputs.highres.header, result)

    def usable(self, image, prior):
        """Return the pixels of the image that have data, in the prior too: bool, (ny, nx)."""
        good = ~np.asarray(image.mask, bool)
        y, x = np.nonzero(good)
        xy = np.stack(prior.wcs.world_to_pixel(image.wcs.pixel_to_world(x, y)), axis=-1)
        on_prior, _ = nearest_values(~np.asarray(prior.mask, bool), xy)
        good[y[~on_prior], x[~on_prior]] = False
        return good

    @functools.cached_property
    def photon_noise(self):
        """Photon noise of light in the image, `~miricigale.injection.photon_noise.PhotonNoise`."""
        return photon_noise(self.file)

    def measure(self, sources=None, psfs=None, former=None, image_file=None, photons=None):
        """
        Measure the field as its user does.

        Parameters
        ----------
        sources : `~astropy.table.QTable`, optional
            What is injected: ``sky``, ``profile``, shapes, ``flux`` and ``prior_flux``; nothing by default.
        psfs : (psf, prior_psf), optional
            Of `psfs`, for the sources.
        former : `~astropy.table.QTable`, optional
            ``sky`` and ``flux`` of what is detected on the prior without them.
        image_file : `~miricigale.photometry.MosaicFile`, optional
            An image that shows the sources already; light is drawn on the prior alone then.
        photons : dict, optional
            ``covariance`` and ``rng`` of the photon noise of light in the image
            (`~miricigale.injection.photon_noise.PhotonNoise.add`); none by default, and none in the prior.

        Returns
        -------
        measured : `Measured`
        pixels : `~miricigale.photometry.commands.file_inputs.Pixels`
        segments, catalog
            Of the prior, as the user's photometry takes them.
        """
        inputs = self.inputs
        n = 0
        if sources is not None:
            n = len(sources)
        prior_light = None
        if n:
            prior_light = light_on_file(
                inputs.highres, sources, sources["prior_flux"], psfs[1], self.n_threads
            )
        image = image_with_sources(self, sources, psfs, photons, image_file)
        pixels = Pixels(inputs.highres.read(prior_light), [], {self.band: image})
        segments, catalog = inputs.find_sources(pixels, inputs.catalog)
        detected = inputs.segmentation is None and inputs.catalog is None
        if n and not detected:
            segments, catalog = self._with_sources(pixels, segments, catalog, sources)
        measurement = inputs.measure(pixels, self.photometers, segments, catalog)
        rows = np.arange(len(catalog) - n, len(catalog))
        if n and detected:
            # as far as a position of the prior may be off and still be the source's
            radius = measurement.results[self.band].psf_fwhm / 2
            rows = recovered_rows(
                catalog["sky"],
                former["sky"],
                np.asarray(former["flux"].to_value(FNU)),
                sources["sky"],
                sources["prior_flux"].to_value(FNU),
                radius,
            )
        result = measurement.results[self.band]
        image = own_pixels(pixels.images[self.band])
        measured = Measured(measurement.table, result, image, rows)
        return measured, pixels, segments, catalog

    def _with_sources(self, pixels, segments, catalog, sources):
        """Segments and catalog with the injected sources: their segments are those that detection finds."""
        rows = QTable({"id": new_ids(np.asarray(catalog["id"]), len(sources))})
        rows["sky"] = sources["sky"]
        places = np.stack(pixels.prior.wcs.world_to_pixel(sources["sky"]), axis=-1)
        if self.inputs.segmentation is None:
            # the map is one of the prior with the sources
            rows["label"], _ = nearest_values(segments, places)
        else:
            detection, _ = detect_sources(pixels.prior)
            segments, rows["label"] = joined_segments(segments, detection.data, places)
        joined = QTable({"id": np.concatenate([np.asarray(catalog["id"]), rows["id"]])})
        joined["sky"] = joined_sky([catalog["sky"], rows["sky"]])
        joined["label"] = np.concatenate([np.asarray(catalog["label"], int), rows["label"]])
        return segments, joined

    def shapes(self, pixels, segments, catalog):
        """Return the fitted profiles of the sources (`~miricigale.injection.population.fitted_shapes`)."""
        psf = self.photometers[self.band].mean_kernel.source
        return fitted_shapes(pixels.prior, segments, catalog, psf, self.n_threads)


def image_with_sources(field, sources, psfs, photons, image_file=None):
    """
    Read the image of a field with the light of sources and its photon noise.

    Parameters
    ----------
    field : `PriorField` or `ImageField`
        The field.
    sources, psfs, photons, image_file
        As for `PriorField.measure`.

    Returns
    -------
    image : `~astropy.nddata.CCDData`
        In MJy/sr; its variance grows by that of the photon noise where its errors have such noise.
    """
    if image_file is not None:
        return image_file.read()
    if sources is None or not len(sources):
        return field.file.read()
    light = light_on_file(field.file, sources, sources["flux"], psfs[0], field.n_threads)
    added_variance = None
    if photons is not None:
        light, added_variance = field.photon_noise.add(light, **photons)
    return field.file.read(light, added_variance)


def joined_segments(segments, detected, places):
    """
    Add the segments of injected sources to a map.

    Parameters
    ----------
    segments : int `~numpy.ndarray`, shape (ny, nx)
        The user's map.
    detected : int `~numpy.ndarray`, shape (ny, nx)
        Segments of a detection on the image with the sources.
    places : `~numpy.ndarray`, shape (n, 2)
        Pixel positions of the sources.

    Returns
    -------
    segments : int `~numpy.ndarray`, shape (ny, nx)
        A copy with new labels; pixels of other sources keep theirs.
    labels : int `~numpy.ndarray`, shape (n,)
        Those of the sources; 0 without a segment, or on that of another source, injected or not.
    """
    segments = segments.copy()
    first = int(segments.max()) + 1
    present, _ = nearest_values(segments, places)
    labels_found, _ = nearest_values(detected, places)
    labels = np.zeros(len(places), int)
    for k in np.flatnonzero((present == 0) & (labels_found > 0)):
        new_pixels = (detected == labels_found[k]) & (segments == 0)
        # of two sources in one segment the first has it
        if new_pixels.any():
            labels[k] = first + k
            segments[new_pixels] = labels[k]
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
        Of `~miricigale.photometry.ForcedPhotometer`, with the defaults of files for those that are not given.
    n_threads : int, optional
        Threads; they change nothing.
    """

    has_prior = False
    prior_band = None

    def __init__(self, file, preset, options, n_threads=None):
        self.file = file
        self.preset = preset
        self.n_threads = n_threads
        self.options = {"background_order": 0, "second_pass": None, **options}
        self.band = file.header.filter

    @functools.cached_property
    def psf(self):
        """The PSF of the image, `~miricigale.psf.InstrumentPSF`."""
        psf = image_psf(self.file)
        if psf is None:
            raise argument_error(
                "psf", f"given, for there is no model PSF for {self.file.path}", None
            )
        return psf

    @functools.cached_property
    def photometer(self):
        """What measures the image, `~miricigale.photometry.ForcedPhotometer`."""
        return ForcedPhotometer(
            psf=self.psf, template="sersic", n_threads=self.n_threads, **self.options
        )

    def psfs(self, result):
        """Return the PSF of the image, and None."""
        return self.psf, None

    def usable(self, image, prior):
        """Return the pixels of the image that have data: bool, (ny, nx)."""
        return ~np.asarray(image.mask, bool)

    @functools.cached_property
    def photon_noise(self):
        """Photon noise of light in the image, `~miricigale.injection.photon_noise.PhotonNoise`."""
        return photon_noise(self.file)

    def measure(self, sources=None, psfs=None, former=None, image_file=None, photons=None):
        """As `PriorField.measure`; ``former`` are the sources of the field with their shapes."""
        n = 0
        if sources is not None:
            n = len(sources)
        image = own_pixels(image_with_sources(self, sources, psfs, photons, image_file))
        segments = None
        if former is None:
            segmentation, catalog = detect_sources(image, preset=self.preset)
            segments = segmentation.data
            former = self._shapes(image, segments, catalog)
        catalog = with_shapes(former, sources)
        result = self.photometer.measure(image, catalog=catalog)
        rows = np.arange(len(catalog) - n, len(catalog))
        measured = Measured(result.to_table(self.band), result, image, rows)
        return measured, Pixels(None, [], {self.band: image}), segments, former

    def _shapes(self, image, segments, catalog):
        scale = pixel_scale(image.wcs)
        rotated = rotate_psf(self.psf, grid_angle=grid_angle(image.wcs, image.shape))
        n = 2 * int(self.psf.half_width / scale) + 1
        psf = psf_image(rotated, pixel_scale=scale * ANGLE, shape=n)
        return fitted_shapes(image, segments, catalog, psf, self.n_threads)

    def shapes(self, pixels, segments, catalog):
        """Return the fitted profiles of the sources, which are the catalog."""
        return catalog


def with_shapes(former, sources):
    """Return a catalog of Sersic profiles and points: those of the field, and after them what is injected."""
    tables = [former]
    ids = np.asarray(former["id"])
    if sources is not None:
        tables.append(sources)
        ids = np.concatenate([ids, new_ids(ids, len(sources))])
    rows = QTable({"id": ids})
    rows["sky"] = joined_sky([table["sky"] for table in tables])
    rows["profile"] = np.concatenate([np.asarray(table["profile"]) for table in tables])
    for name, unit in (
        ("half_light_radius", ANGLE),
        ("sersic_index", None),
        ("axis_ratio", None),
        ("position_angle", u.deg),
    ):
        values = [np.asarray(u.Quantity(table[name]).value) for table in tables]
        rows[name] = np.concatenate(values) * (1 if unit is None else unit)
    return rows


def image_field(file, inputs, preset, options, n_threads):
    """Return the field of an image: a `PriorField` where there is a prior, or an `ImageField`."""
    if inputs is not None:
        return PriorField(inputs, n_threads)
    return ImageField(file, preset, options, n_threads)


def over_noise(model, xy):
    """Light of a model (a `~astropy.nddata.CCDData`) over the noise of its pixels, shape (n,); NaN outside."""
    values, inside = nearest_values(np.asarray(model.data, float), xy)
    noise, _ = nearest_values(np.asarray(model.uncertainty.array, float), xy)
    with quiet_division():
        return np.where(inside, values / noise, np.nan)
