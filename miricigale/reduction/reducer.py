"""The `Reducer`: ramps in, calibrated images and mosaics out."""

import dataclasses
from dataclasses import field

from astropy.nddata import CCDData

from miricigale.detector import Charge, Ramp, ResetAnomaly
from miricigale.instrument import (
    DetectorProperties,
    ExposureHistory,
    ImageFacts,
    as_wcs,
    miri_detector,
)
from miricigale.reduction.combine.combine import combine, drizzle, subtract_dithers
from miricigale.reduction.images.files import as_exposure, exposure_list
from miricigale.reduction.images.images import own_grid, with_data
from miricigale.reduction.images.repeats import ExposureRecord
from miricigale.reduction.ramps.slopes import fit_slopes
from miricigale.reduction.references.calibration import calibrate
from miricigale.reduction.references.detector_model import brightness_of, maps_of
from miricigale.reduction.references.reference_cache import ReferenceCache
from miricigale.reduction.references.references import ReferenceFiles
from miricigale.reduction.references.settings import (
    BACKENDS,
    KINDS,
    NEEDED,
    BackgroundSettings,
    MosaicSettings,
    RampSettings,
)
from miricigale.reduction.results import rate_image
from miricigale.reduction.sky.background import estimate_background, remove_background, subtractable
from miricigale.reduction.sky.sky_flat import flattened
from miricigale.reduction.sky.stripes import remove_stripes
from miricigale.utils.exceptions import argument_error
from miricigale.utils.interactive import Interactive
from miricigale.utils.named_values import field_values
from miricigale.utils.options import (
    check_choice,
    check_kind,
    check_least,
    check_positive,
    check_that,
    check_type,
)
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.parallel import thread_count
from miricigale.utils.progress import progress
from miricigale.utils.units import ANGLE, RATE, SURFACE_BRIGHTNESS, positive

# pixels of mosaics, MIRI's
_SCALE = 0.11 * ANGLE


@takes_other_keywords
@dataclasses.dataclass(frozen=True, kw_only=True)
class Reducer(Interactive):
    """
    Settings of the reduction; every method leaves them as they are.

    Parameters
    ----------
    backend : {"native", "jwst"}, optional
        Which code fits the ramps: this package, or the steps of the official pipeline (``jwst``, an extra of the
        installation) with the same references. The other settings, calibration, background
        and mosaic are the same.
    jump_threshold : float or None, optional
        Sigma above which a jump is cut out of a ramp; None for no jump detection.
    skip_first, skip_last : int or None, optional
        Groups left out at the start and end of each integration. None: one each (if there are more than
        three or two groups, as in the official pipeline) in ramps of the observatory, except
        where flags of groups mark them, and in simulated ramps on which
        `~miricigale.detector.FirstFrame` or `~miricigale.detector.LastFrame` acted; else none.
    reset_anomaly : `~miricigale.detector.ResetAnomaly`, optional
        The settling after a reset, which is subtracted from the groups; none if not given.
    ramps : `RampSettings`, optional
        How ramps are fitted.
    background : `BackgroundSettings`, str or bool, optional
        How backgrounds are estimated, the method alone (``"dithers"``), or whether they are.
    mosaics : `MosaicSettings`, optional
        How images are combined.
    references : ReferenceFiles, ReferenceCache, "none" or "simulated", optional
        Reference data of the detector. `ReferenceFiles` names the files, `ReferenceCache` finds
        them for each exposure by its header, ``"none"`` does without: slopes in DN/s with
        measured noise. None, or ``"simulated"`` whatever the ramp's metadata say: the constants of
        the package's own detector, which hold for ramps that its `~miricigale.detector.Detector`
        made. Other ramps are refused without references.
    properties : `~miricigale.instrument.DetectorProperties`, optional
        The simulated detector; `~miricigale.instrument.miri_detector` if not given, and
        ramps of any other are refused then.
    n_threads : int, optional
        Threads of the ramp fit; as many as there are processors if not given. The result does not depend on it.

    Raises
    ------
    ValueError
        If the backend is not known or an option is out of range.

    Examples
    --------
    >>> from miricigale.reduction import Reducer
    >>> Reducer(jump_threshold=4.5)
    <Reducer native, jump_threshold=4.5>
    """

    backend: str = "native"
    jump_threshold: float | None = 5.0
    skip_first: int | None = None
    skip_last: int | None = None
    reset_anomaly: ResetAnomaly | None = None
    ramps: RampSettings = field(default_factory=RampSettings)
    background: BackgroundSettings = field(default_factory=BackgroundSettings)
    mosaics: MosaicSettings = field(default_factory=MosaicSettings)
    references: object = None
    properties: DetectorProperties | None = None
    n_threads: int | None = None

    def __post_init__(self):
        check_choice(self.backend, "backend", BACKENDS)
        if isinstance(self.background, (str, bool)):
            object.__setattr__(self, "background", _background_settings(self.background))
        check_positive(self.jump_threshold, "jump_threshold", optional=True)
        for name in ("skip_first", "skip_last"):
            if getattr(self, name) is not None:
                check_least(getattr(self, name), name, 0, whole=True)
        for name, kind in KINDS.items():
            value = getattr(self, name)
            check_that(value is not None or name not in NEEDED, name, f"a {kind.__name__}", "None")
            check_kind(value, name, kind)
        thread_count(self.n_threads)
        is_reference_set = isinstance(self.references, (ReferenceFiles, ReferenceCache))
        if not is_reference_set and self.references not in (None, "none", "simulated"):
            wanted = "ReferenceFiles, a ReferenceCache, 'none', 'simulated' or None"
            raise argument_error("references", wanted, repr(self.references))

    replace = dataclasses.replace

    def __repr__(self):
        parts = [f"<Reducer {self.backend}"]
        for item in dataclasses.fields(self)[1:]:
            factory = item.default_factory
            if factory is dataclasses.MISSING:
                default = item.default
            else:
                default = factory()
            value = repr(getattr(self, item.name))
            # what is not by default; settings of many values by their name alone
            if value != repr(default):
                parts.append(f"{item.name}={value}" if len(value) < 40 else f"own {item.name}")
        return f"{', '.join(parts)}>"

    def _facts(self):
        return field_values(self)

    @property
    def detector(self):
        """The simulated detector, whose constants its ramps are reduced with."""
        if self.properties is None:
            return miri_detector()
        return self.properties

    def fit_groups(self, ramp, *, progress_bar=False):
        """
        Fit the ramps of an exposure, with every plane of the result.

        Parameters
        ----------
        ramp, progress_bar
            As for `fit_ramp`.

        Returns
        -------
        fit : `RampFit`
            Slope (DN/s), Poisson and read variance, groups used, jumps, flags.

        Raises
        ------
        ValueError
            If it is no ramp, or fewer than two groups are left.
        """
        ramp = as_exposure(ramp)
        return fit_slopes(self, ramp, maps_of(self, ramp), progress_bar)

    def fit_ramp(self, ramp, *, planes=False, progress_bar=False):
        """
        Fit the ramps of an exposure.

        Parameters
        ----------
        ramp : `~miricigale.detector.Ramp`, `~miricigale.detector.Charge` or path-like
            Counts in DN, or their file; or what was collected, whose slopes are drawn.
        planes : bool, optional
            Whether the two parts of the variance are given too.
        progress_bar : bool, optional
            Whether a progress bar is shown.

        Returns
        -------
        rate : `~astropy.nddata.CCDData` or `ImageFile`
            Slope in DN/s with standard deviation, mask, ``flags`` (`DQ`) and WCS;
            masked pixels without a slope are NaN. The meta dictionary has the exposure in
            plain values, and ``noise_correction``: by how much the sum over many pixels is
            noisier than their errors in quadrature, because neighbors share charge. With
            ``planes`` it is the ``image`` of an `ImageFile`, whose ``planes`` are ``VAR_POISSON``
            and ``VAR_RNOISE``, (DN/s)^2: what `write_image` writes as a ``_rate``.
        """
        ramp = as_exposure(ramp)
        maps = maps_of(self, ramp)
        rate = rate_image(self, ramp, maps, fit_slopes(self, ramp, maps, progress_bar))
        if planes:
            return rate
        return rate.image

    def fit_integrations(self, ramp, *, planes=False, progress_bar=False):
        """
        Fit the ramps of each integration alone.

        Parameters
        ----------
        ramp : `~miricigale.detector.Ramp` or path-like
            Counts in DN, or their file.
        planes, progress_bar : bool, optional
            As for `fit_ramp`.

        Returns
        -------
        rates : list of `~astropy.nddata.CCDData` or of `ImageFile`
            As `fit_ramp` returns them, one for each integration; the references are those of
            the exposure. `write_image` makes a ``_rateints`` of the list.
        """
        ramp = as_exposure(ramp)
        check_type(ramp, "ramp", Ramp, "a Ramp")
        maps = maps_of(self, ramp)
        rates = []
        for number in progress(range(ramp.shape[0]), show=progress_bar, desc="integrations"):
            part = ramp.integration(number)
            part_maps = maps.integration(number)
            fit = fit_slopes(self, part, part_maps, first=number)
            rate = rate_image(self, part, part_maps, fit)
            rate.image.meta["integration"] = number
            rates.append(rate)
        if planes:
            return rates
        return [rate.image for rate in rates]

    def calibrate(self, rate):
        """
        Turn slopes into surface brightness.

        Dark subtraction, flat field, photometric conversion and mask of the field. The background stays.

        Parameters
        ----------
        rate : `~astropy.nddata.CCDData` or path-like
            DN/s, from `fit_ramp` (its meta dictionary names filter and sub-array), or its file. An image that
            the pipeline calibrated is calibrated again: its PHOTMJSR says by what it was multiplied, whatever
            that version knew of the loss of response with time.

        Returns
        -------
        cal : `~astropy.nddata.CCDData`
            MJy/sr.
        """
        rate = as_exposure(rate)
        facts = ImageFacts.of(rate)
        for key in ("filter", "subarray"):
            check_that(
                getattr(facts, key) is not None, "rate", f"an image whose meta has {key!r}", "none"
            )
        if ExposureHistory.of(rate).done("photom"):
            if not (before := rate.meta.get("photmjsr")):
                raise argument_error("rate", "slopes, or an image with its PHOTMJSR", "neither")
            rate = with_data(rate, rate.data / before, factor=1 / before, unit=RATE)
        brightness, references = brightness_of(self, rate)
        cal = calibrate(rate, subarray=facts.subarray, **brightness)
        cal.meta.update(references)
        return cal

    def subtract_background(self, image):
        """
        Subtract the background and mask pixels far below it.

        A level that is not known is not taken off: the sky stays in the image
        (`~miricigale.reduction.BackgroundFlags`).

        Parameters
        ----------
        image : `~astropy.nddata.CCDData` or path-like
            A calibrated image or a mosaic, or its file.

        Returns
        -------
        image : `~astropy.nddata.CCDData`
            MJy/sr, without its background.
        background : `Background`
            What was taken off, a level of 0 if it is not known.
        """
        image = as_exposure(image)
        background = subtractable(estimate_background(image, **self.background.mesh))
        return remove_background(image, background, **self.background.negative), background

    def subtract_dithers(self, images, *, wcs=None):
        """
        Subtract from each image the background of its dithers.

        Parameters
        ----------
        images : list of `~astropy.nddata.CCDData`
            Calibrated and with their background, three or more of one filter (`dither_backgrounds`).
        wcs : `~astropy.wcs.WCS`, optional
            Grid on which sources to be masked are searched for; that of `run` if not given.

        Returns
        -------
        images : list of `~astropy.nddata.CCDData`
            MJy/sr, background subtracted.
        backgrounds : list of `Background`
            What was taken off each.
        """
        return subtract_dithers(self, list(images), wcs=wcs)

    def mosaic(self, images, wcs=None, *, pixel_scale=None):
        """
        Drizzle images onto one grid.

        Parameters
        ----------
        images : iterable of `~astropy.nddata.CCDData`
            Calibrated, background-subtracted images. Outliers are masked first, if there
            are three or more images and that was not done before.
        wcs : `~astropy.wcs.WCS`, `~astropy.io.fits.Header` or image, optional
            Of the output, with ``pixel_shape``; by default as of `run`.
        pixel_scale : `~astropy.units.Quantity`, optional
            Of the output without ``wcs``; that of the settings by default.

        Returns
        -------
        mosaic : `~astropy.nddata.CCDData`
            Surface brightness with standard deviation, WCS and a mask where there is no
            data (and NaN there). The meta dictionary has ``n_exposures``,
            ``exposure_time`` (s, sum), ``pa_aper`` (deg, list) and ``noise_correction``,
            that of the inputs times that of the drizzle (`noise_correction`).

        Raises
        ------
        ValueError
            If the images are not surface brightness of one filter, or the grid has no shape
            or lies elsewhere on the sky.
        """
        images = [as_exposure(image) for image in exposure_list(images)]
        if wcs is None:
            wcs = own_grid(images, self.mosaic_scale(pixel_scale))
        else:
            wcs = as_wcs(wcs)
        return self.drizzle(images, wcs)[0].image

    def drizzle(self, images, wcs):
        """
        Drizzle images onto one grid, with every plane of the result.

        Parameters
        ----------
        images : iterable of `~astropy.nddata.CCDData`
            As for `mosaic`.
        wcs : `~astropy.wcs.WCS`
            Of the output, with ``pixel_shape``.

        Returns
        -------
        mosaic : `Mosaic`
            Surface brightness (MJy/sr), weights, number of images of each pixel.
        images : list of `~astropy.nddata.CCDData`
            The inputs with outliers masked.
        """
        return drizzle(self.mosaics, images, wcs)

    def reduce(self, exposure):
        """
        Reduce one exposure, from whatever stage it has.

        Parameters
        ----------
        exposure : Ramp, Charge, `~astropy.nddata.CCDData` or path-like
            A ramp, a rate, an image in MJy/sr, or a file or data model of ``jwst`` with one of them
            (`open_exposure`).

        Returns
        -------
        rate : `~astropy.nddata.CCDData` or None
            None if the exposure was calibrated before; given a photom reference (`ReferenceFiles`) it is
            calibrated again, unless it was resampled.
        image : `~astropy.nddata.CCDData`
            MJy/sr, background subtracted.
        background : `Background`
        """
        exposure = as_exposure(exposure)
        if isinstance(exposure, (Ramp, Charge)):
            exposure = self.fit_ramp(exposure)
        check_type(exposure, "exposure", CCDData, "a Ramp, a Charge, CCDData or a path")
        rate = None
        if exposure.unit.is_equivalent(RATE):
            rate = exposure
        elif not exposure.unit.is_equivalent(SURFACE_BRIGHTNESS):
            raise argument_error("exposure", f"in {RATE} or {SURFACE_BRIGHTNESS}", exposure.unit)
        files = self.references
        history = ExposureHistory.of(exposure)
        has_photom = isinstance(files, ReferenceFiles) and files.photom is not None
        recalibrates = has_photom and history.done("photom") and "resample" not in history.steps
        if rate is not None or recalibrates:
            exposure = self.calibrate(exposure)
        if self.background.stripes and "resample" not in history.steps:
            exposure = remove_stripes(exposure)
        return rate, *self.subtract_background(exposure)

    @takes_other_keywords
    def run(self, ramps, *, wcs=None, pixel_scale=None, align=None, progress_bar=None):
        """
        Reduce the dithers of one filter.

        Parameters
        ----------
        ramps : str, Ramp or iterable of Ramp, Charge, `~astropy.nddata.CCDData` or path-like
            Exposures at any stage, as `reduce` takes them; one of them, or a pattern of files
            (``"*_uncal.fits"``), too. One at a time is held if this is a generator, or paths. For files of
            several filters see `miricigale.reduction.reduce_files`.
        wcs : `~astropy.wcs.WCS`, optional
            Of the mosaic; by default the smallest north-up grid that holds
            every unmasked pixel of the dithers.
        pixel_scale : `~astropy.units.Quantity`, optional
            Of that grid, if ``wcs`` is not given.
        align : `~astropy.coordinates.SkyCoord`, "dithers" or "visits", optional
            Positions of a catalog to which the images are aligned (`align_images`), or to each other, the images
            of a visit together with ``"visits"``; not at all by default.
        progress_bar : bool, optional
            Whether a progress bar is shown; by default in interactive sessions, after some seconds.

        Returns
        -------
        result : `ReductionResult`
            ``notes`` says what could not be done, such as the rejection of outliers in a single
            dither.

        Raises
        ------
        ValueError
            If there are no ramps, of more than one filter, or one of them twice.
        """
        pixel_scale = self.mosaic_scale(pixel_scale)
        rates = []
        images = []
        backgrounds = []
        name = None
        record = ExposureRecord()
        exposures = progress(exposure_list(ramps), show=progress_bar, desc="reduce")
        for number, ramp in enumerate(exposures, start=1):
            ramp = as_exposure(ramp)
            record.check(f"exposure {number}", ramp)
            rate, subtracted, background = self.reduce(ramp)
            del ramp
            band = ImageFacts.of(subtracted).filter
            if name is None:
                name = band
            check_that(band == name, "ramps", f"of one filter ({name})", band)
            if rate is not None:
                rates.append(rate)
            images.append(subtracted)
            backgrounds.append(background)
        check_that(images, "ramps", "at least one ramp", "none")
        return self.combine(
            images, backgrounds, rates=rates, wcs=wcs, pixel_scale=pixel_scale, align=align
        )

    __call__ = run

    def combine(
        self, images, backgrounds, *, rates=(), wcs=None, pixel_scale=None, align=None, planes=()
    ):
        """
        Put the images of one filter together.

        Parameters
        ----------
        images : list of `~astropy.nddata.CCDData`
            Calibrated, background subtracted.
        backgrounds : list of `Background`
            What was subtracted.
        rates : list of `~astropy.nddata.CCDData`, optional
            What they come from, for the result.
        wcs, pixel_scale, align : optional
            As for `run`.
        planes : list of dict of str to `~numpy.ndarray`, optional
            Those of the `ImageFile` of each image: the parts of its variance go to the mosaic.

        Returns
        -------
        result : `ReductionResult`

        Raises
        ------
        ValueError
            If there are no images.
        """
        if self.background.sky_flat is not None and len(images) == len(backgrounds):
            images, backgrounds = flattened(self, images, backgrounds)
        pixel_scale = self.mosaic_scale(pixel_scale)
        return combine(self, images, backgrounds, rates, wcs, pixel_scale, align, planes)

    def mosaic_scale(self, pixel_scale=None):
        """
        Return the pixel of mosaics without a WCS of their own, arcsec.

        Parameters
        ----------
        pixel_scale : `~astropy.units.Quantity`, optional
            What a call asks for; the setting by default.

        Returns
        -------
        pixel_scale : `~astropy.units.Quantity`
            In arcsec: what was asked for, else that of the settings, else 0.11, MIRI's.

        Raises
        ------
        `~astropy.units.UnitsError`, ValueError
            If it is no angle above 0.
        """
        if pixel_scale is None:
            pixel_scale = self.mosaics.pixel_scale
        if pixel_scale is None:
            return _SCALE
        return positive(pixel_scale, ANGLE, "pixel_scale") * ANGLE


def _background_settings(background):
    """Return the settings of a method by its name, the default ones (True), or those of none (False)."""
    if background is True:
        return BackgroundSettings()
    if background is False:
        return BackgroundSettings("none")
    return BackgroundSettings(background)
