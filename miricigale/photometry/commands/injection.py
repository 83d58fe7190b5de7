"""Calibration of errors by injection: sources of known flux, measured as all others are."""

import collections

import numpy as np
import scipy.ndimage
from astropy.nddata import overlap_slices
from astropy.table import QTable, vstack
from photutils.segmentation import SegmentationImage

from miricigale.instrument import epoch_of
from miricigale.photometry.detection.catalogs import joined_sky
from miricigale.photometry.detection.detection import bright_centroids
from miricigale.photometry.errors.error_calibration import ErrorCalibration
from miricigale.photometry.fit.forced import ForcedPhotometer
from miricigale.photometry.images.arrays import (
    draw_places,
    image_arrays,
    nearest_values,
    pixel_scale,
    pixels_to_sky,
    sky_to_pixels,
)
from miricigale.photometry.images.flags import ForcedFlags
from miricigale.photometry.images.mosaics import as_mosaic
from miricigale.photometry.shapes.shape_models import ShapeModels
from miricigale.photometry.shapes.shapes import Shape, center_change
from miricigale.photometry.templates.sources import SourceTemplates
from miricigale.utils.exceptions import argument_error
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.positions import at_epoch
from miricigale.utils.progress import progress
from miricigale.utils.random import check_seed, stream
from miricigale.utils.units import FNU, SURFACE_BRIGHTNESS, check_count

#: Radius (fine pixels) of a profile that is as good as a point.
_POINT = 0.05

#: Least distance of two injected sources in widths of the PSF (FWHM).
_APART = 4.0

#: Injected fluxes, over the median error of sources by noise: uniform in the logarithm between these.
_SNR_RANGE = (1.0, 100.0)

#: Flags with which a source may still be copied.
_HARMLESS = ForcedFlags.BLENDED | ForcedFlags.POOR_FIT | ForcedFlags.UNEXPLAINED_NEIGHBOR

#: Half-width (fine pixels) of the stamps that are injected into the prior, least and most.
_HALF = 16
_MOST = 96


@takes_other_keywords
def calibrate_errors(
    photometer,
    image,
    highres=None,
    segmentation=None,
    catalog=None,
    *,
    n_trials=10,
    n_sources=None,
    seed=None,
    progress_bar=False,
):
    """
    Measure by injection how much the errors of forced photometry are off.

    Copies of the prior's own sources (points and fitted profiles, with their segments) are put at random
    places into the prior and, with other fluxes, into the image; all is measured anew together with the
    sources that are there, and with as many empty places. The scatter of measured less true flux over the
    error gives the factor by which errors must be multiplied.

    Parameters
    ----------
    photometer : `ForcedPhotometer`
        What measures, of any template but ``"sersic"``; its threads are used.
    image, highres, segmentation, catalog
        As for `ForcedPhotometer.measure`. Without ``highres`` points are injected into the image alone.
        None of them is changed.
    n_trials : int, optional
        How often the image is measured.
    n_sources : int, optional
        Sources injected in each trial, and empty places; by default a seventh of the sources in the
        catalog, at least ten. Fewer if there is no free place for so many.
    seed : int or `~numpy.random.Generator`, optional
        The same seed gives the same result.
    progress_bar : bool, optional
        Whether a progress bar is shown.

    Returns
    -------
    calibration : `ErrorCalibration`

    Raises
    ------
    ValueError, TypeError
        If an input does not fit, no source can be copied or no place is free.

    Notes
    -----
    Injected galaxies have the shapes of the fits, so that what no profile describes (arms, clumps) is not in the
    scatter; their positions are those that detection finds.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropy.coordinates import SkyCoord
    >>> from astropy.nddata import CCDData, StdDevUncertainty
    >>> from miricigale.instrument import north_up_wcs
    >>> from miricigale.photometry import ForcedPhotometer, calibrate_errors
    >>> from miricigale.psf import gaussian_psf
    >>> psf = gaussian_psf(0.4 * u.arcsec, pixel_scale=0.1 * u.arcsec, fov=4 * u.arcsec)
    >>> sky = SkyCoord([53.1], [-27.8], unit="deg")
    >>> wcs = north_up_wcs(sky[0], 0.1 * u.arcsec, (61, 61))
    >>> noise, error = np.random.default_rng(1).normal(0, 0.5, (61, 61)), np.full((61, 61), 0.5)
    >>> image = CCDData(noise, unit="MJy / sr", wcs=wcs, uncertainty=StdDevUncertainty(error))
    >>> options = {"catalog": sky, "n_trials": 8, "n_sources": 5, "seed": 1}
    >>> calibration = calibrate_errors(ForcedPhotometer(psf=psf), image, **options)
    >>> calibration.bins["factor"].info.format = ".1f"
    >>> print(calibration.bins["n", "factor"])
     n  factor
    --- ------
     40    0.9
     40    1.1
    """
    if not isinstance(photometer, ForcedPhotometer) or photometer.template == "sersic":
        wanted = "a ForcedPhotometer whose template is 'auto', 'cutout' or 'psf'"
        raise argument_error("photometer", wanted, repr(photometer))
    n_trials = check_count(n_trials, "n_trials")
    image = as_mosaic(image, "image")
    highres, segmentation, catalog = photometer._prior(image, highres, segmentation, catalog)
    seed = check_seed(seed)
    if n_sources is None:
        n_sources = max(10, len(catalog) // 7)
    n_sources = check_count(n_sources, "n_sources")
    field = _Field(photometer, image, highres, segmentation, catalog)
    tables = []
    for trial in progress(range(n_trials), show=progress_bar, desc="inject"):
        tables.append(field.trial(n_sources, stream(seed, "injection", trial)))
        tables[-1]["trial"] = trial
    sources = vstack(tables, metadata_conflicts="silent")
    return ErrorCalibration.from_sources(sources, seed=seed)


#: A source of the prior that is copied: fine profile, its light, and its segment about its middle.
_Donor = collections.namedtuple("_Donor", "parameters light mask corner point")
#: Sources that were injected: catalog, light, fluxes and kinds; the prior with them.
_Injected = collections.namedtuple("_Injected", "catalog light flux kind highres labels")


class _Field:
    """The images, the sources that are copied, and free places."""

    def __init__(self, photometer, image, highres, segmentation, catalog):
        self.photometer = photometer
        self.image = image
        self.highres = highres
        self.base = photometer.measure(image, highres, segmentation, catalog)
        error = self.base.flux_err_noise.value
        if not np.isfinite(error).any():
            raise argument_error("catalog", "sources of which some are measured", "none that is")
        self.error = np.nanmedian(error)
        self.arrays = image_arrays(image, "image")
        place = image if highres is None else highres
        self.sky = at_epoch(catalog["sky"], epoch_of(place), "catalog")
        self.fwhm = self.base.psf_fwhm.value
        self.labels = self.own_labels = None
        self.donors = []
        if highres is None or segmentation is None or photometer.template == "psf":
            return
        if isinstance(segmentation, SegmentationImage):
            segmentation = segmentation.data
        self.labels = np.array(segmentation)
        self.fine = image_arrays(highres, "highres")
        # of kernels of several places the mean
        source = photometer.mean_kernel.source
        self.models = ShapeModels(source / source.sum())
        templates = SourceTemplates.from_images(highres, segmentation, catalog, psf=source)
        if "label" in catalog.colnames:
            self.own_labels = np.asarray(catalog["label"], int)
        else:
            xy = sky_to_pixels(catalog["sky"], highres.wcs)
            self.own_labels, _ = nearest_values(self.labels, xy)
        # sources without a flag that matters can be copied
        places = scipy.ndimage.find_objects(self.labels)
        usable = (self.base.flags & ~int(_HARMLESS) == 0) & (templates.flags == 0)
        kinds = templates.kind
        for k in np.flatnonzero(usable):
            donor = self._donor(templates.fitted[k], kinds[k], self.own_labels[k], places)
            if donor is not None:
                self.donors.append(donor)
        wanted = "with sources that are points or profiles, to be copied"
        check_that(self.donors, "highres", wanted, "none")

    def _donor(self, fitted, kind, label, places):
        """Return what is copied of a source; None if it is no profile, or has no light."""
        if kind == "cutout" or np.isnan(fitted["point"]) or not 0 < label <= len(places):
            return None
        place = places[label - 1]
        if place is None:
            return None
        parameters = np.array(fitted["parameters"])
        if kind == "point":
            parameters[2] = np.log(_POINT)
            parameters[3:] = 0.0
        mask = self.labels[place] == label
        corner = np.array([place[1].start, place[0].start])
        image = self.models.profiles(mask.shape, parameters - center_change(corner))[0]
        model = np.where(mask & self.fine.usable[place], image, 0.0)
        power = np.sum(model**2)
        if not power > 0:
            return None
        # the light that fits best to the pixels of the segment
        light = np.sum(model * self.fine.flux[place]) / power
        if not light > 0:
            return None
        return _Donor(parameters, float(light), mask, corner, kind == "point")

    def trial(self, n, rng):
        """Inject sources and measure them: a table of true and measured fluxes."""
        # apart from each other, in pixels of the image
        separation = _APART * self.fwhm / pixel_scale(self.image.wcs)
        at = draw_places(self.arrays.usable, 2 * n, separation, rng)
        check_that(len(at) >= 2, "image", "large enough for sources", "none")
        # every other place stays empty
        full = at[::2]
        empty = at[1::2]
        low, high = np.log(_SNR_RANGE)
        flux = self.error * np.exp(rng.uniform(low, high, len(full)))
        if self.donors:
            new = self._galaxies(full, flux, rng)
        else:
            new = self._points(full, flux)
        # sources are injected, and all is measured as before
        light = self.photometer.render(self.image, new.light, new.flux * FNU)
        image = _with_light(self.image, light)
        empty_sky = pixels_to_sky(empty, self.image.wcs).transform_to(self.sky.frame)
        catalog = QTable({"sky": joined_sky([self.sky, new.catalog["sky"], empty_sky])})
        if self.own_labels is not None:
            catalog["label"] = np.concatenate(
                [self.own_labels, new.catalog["label"], np.zeros(len(empty), int)]
            )
        result = self.photometer.measure(image, new.highres, new.labels, catalog)
        table = QTable({"kind": np.append(new.kind, np.full(len(empty), "empty", "U6"))})
        table["flux_true"] = np.append(new.flux, np.zeros(len(empty))) * FNU
        # those that were injected, and the empty places
        rows = np.arange(len(self.sky), len(catalog))
        for name in ("flux", "flux_err", "flux_err_noise", "flags", "template", "template_snr"):
            table[name] = getattr(result, name)[rows]
        table["sky"] = catalog["sky"][rows].icrs
        return table

    def _points(self, at, flux):
        """Inject points, which the prior does not show."""
        sky = pixels_to_sky(at, self.image.wcs).transform_to(self.sky.frame)
        catalog = QTable({"sky": sky})
        light = SourceTemplates.from_catalog(catalog)
        kind = np.full(len(at), "point", "U6")
        return _Injected(catalog, light, flux, kind, self.highres, self.labels)

    def _galaxies(self, at, flux, rng):
        """Inject copies of the prior's sources, with their segments."""
        wcs = self.highres.wcs
        places = sky_to_pixels(pixels_to_sky(at, self.image.wcs), wcs)
        data = np.zeros(self.labels.shape)
        labels = self.labels.copy()
        first = self.labels.max() + 1
        rows = []
        light = []
        for (x, y), total in zip(places, flux, strict=True):
            donor = self.donors[rng.integers(len(self.donors))]
            # whole pixels, so that the segment is moved as it is
            shift = np.rint([x, y] - donor.parameters[:2]).astype(int)
            corner = donor.corner + shift
            h, w = donor.mask.shape
            cut = np.s_[corner[1] : corner[1] + h, corner[0] : corner[0] + w]
            labels_there = labels[cut]
            if corner.min() < 0 or labels_there.shape != (h, w) or not self.fine.usable[cut].all():
                continue
            # another source there would own the light
            if np.any(labels_there[donor.mask] != 0):
                continue
            shape = Shape(donor.light, donor.parameters + center_change(shift), 0.0, None)
            self._paint(data, shape)
            labels[cut][donor.mask] = first + len(rows)
            rows.append((total, donor.point, corner + (np.array([w, h]) - 1) / 2))
            light.append(shape.drawn(1.0, max(self.models.reach, 2 * shape.axes[0])))
        check_that(rows, "image", "large enough for sources", "none")
        flux = np.array([total for total, _, _ in rows])
        is_point = np.array([is_point for _, is_point, _ in rows])
        middle = np.array([middle for _, _, middle in rows])
        # positions are those that detection would find
        new_labels = np.maximum(labels - (first - 1), 0)
        x, y = bright_centroids(self.fine.flux + data, new_labels, middle.T)
        catalog = QTable({"sky": wcs.pixel_to_world(x, y).transform_to(self.sky.frame)})
        catalog["label"] = first + np.arange(len(rows))
        kinds = np.where(is_point, "point", "galaxy")
        truth = SourceTemplates(
            id=np.arange(len(rows)), sky=catalog["sky"].icrs, light=light, wcs=wcs
        )  # fmt: skip
        highres = _with_light(self.highres, data / self.fine.area * SURFACE_BRIGHTNESS)
        return _Injected(catalog, truth, flux, kinds, highres, labels)

    def _paint(self, image, shape):
        """Add a profile, seen through the sharp PSF, to an image."""
        half = int(np.clip(np.ceil(8 * shape.axes[0]), _HALF, _MOST))
        x, y = np.rint(shape.parameters[:2]).astype(int)
        moved = shape.parameters - [x - half, y - half, 0, 0, 0, 0]
        stamp = shape.flux * self.models.profiles((2 * half + 1,) * 2, moved)[0]
        inside, source = overlap_slices(image.shape, stamp.shape, (y, x))
        image[inside] += stamp[source]


def _with_light(image, light):
    """Copy an image with light (a quantity) added to it, whose noise is not known."""
    changed = image.copy()
    changed.data = image.data + light.to_value(image.unit)
    return changed
