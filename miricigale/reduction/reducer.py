"""The `Reducer`: ramps in, calibrated images and mosaics out."""

import dataclasses
import warnings

import numpy as np

from miricigale.detector import (
    Charge,
    FirstFrame,
    InterpixelCapacitance,
    LastFrame,
    Ramp,
    ResetAnomaly,
)
from miricigale.instrument import DQ, DetectorProperties, ImageFacts, miri_detector, mosaic_wcs
from miricigale.reduction.background import estimate_background, subtract_background
from miricigale.reduction.calibration import calibrate
from miricigale.reduction.drawn import draw_groups
from miricigale.reduction.images import (
    check_images,
    check_overlap,
    exposure_values,
    image,
    seen_wcs,
)
from miricigale.reduction.mosaic import (
    drizzle_images,
    pixel_map,
    reject_outliers,
    weight_map,
)
from miricigale.reduction.rampfit import fit_groups, reference_drift
from miricigale.reduction.results import ReductionResult
from miricigale.utils.exceptions import MiricigaleWarning, argument_error
from miricigale.utils.meta import provenance
from miricigale.utils.parallel import thread_count
from miricigale.utils.progress import progress
from miricigale.utils.units import ANGLE, RATE, to_array

__all__ = ["BACKENDS", "Reducer"]

#: Known backends.
BACKENDS = ("native",)

# flags of a ramp's pixels that forbid a slope
_UNUSABLE = DQ.DO_NOT_USE | DQ.NON_SCIENCE | DQ.REFERENCE_PIXEL | DQ.DEAD


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reducer:
    """
    Settings of the reduction; every method leaves them as they are.

    Parameters
    ----------
    backend : {"native"}, optional
        Who does the work.
    jump_threshold : float or None, optional
        Sigma above which a jump is cut out of a ramp; None for no jump detection.
    neighbor_threshold : float or None, optional
        Sigma above which a jump is cut in the four neighbors too.
    skip_first, skip_last : int or None, optional
        Groups left out at the start and end of each integration. None: one each where the
        ramp says that `~miricigale.detector.FirstFrame` or
        `~miricigale.detector.LastFrame` acted (and more than three or two groups are there,
        as in the official pipeline), else none. Give 1 and 1 for ramps of the observatory.
    reset_anomaly : `~miricigale.detector.ResetAnomaly`, optional
        The settling after a reset, which is taken off the groups; none if not given.
    saturation : float, optional
        Fraction of the detector's saturation from which groups are left out.
    reference_correction : bool, optional
        Whether the mean of the reference columns is taken off, group by group.
    ipc : bool or None, optional
        Whether neighbors share their charge, which lowers the photon noise of a pixel
        (and correlates it) and blurs the flat field. None: as the ramp says, True where
        it does not.
    field_only : bool, optional
        Whether pixels behind the coronagraph masks are masked.
    cosmic_rays : bool, optional
        Whether residual cosmic rays are searched on the slope image.
    cosmic_ray_sigma, cosmic_ray_contrast : float, optional
        ``sigma_clip`` and ``object_limit`` of `find_cosmic_rays`.
    box, filter_size : int, optional
        Of the background: boxes in pixels, median filter in boxes.
    negative_threshold : float or None, optional
        Pixels so many sigma below the background are masked.
    outlier_threshold : float or None, optional
        Sigma for the comparison of three or more dithers; None for none.
    pixfrac : float, optional
        Side of the drizzle's drops in input pixels.
    properties : `~miricigale.instrument.DetectorProperties`, optional
        The detector; `~miricigale.instrument.miri_detector` if not given.
    n_threads : int, optional
        Threads of the ramp fit; as many as there are processors if not given. It changes
        nothing in the result.

    Raises
    ------
    ValueError
        If the backend is not known or an option is out of range.

    Examples
    --------
    >>> from miricigale.reduction import Reducer
    >>> Reducer(jump_threshold=4.5).jump_threshold
    4.5
    """

    backend: str = "native"
    jump_threshold: float | None = 5.0
    neighbor_threshold: float | None = 10.0
    skip_first: int | None = None
    skip_last: int | None = None
    reset_anomaly: ResetAnomaly | None = None
    saturation: float = 0.98
    reference_correction: bool = True
    ipc: bool | None = None
    field_only: bool = True
    cosmic_rays: bool = True
    cosmic_ray_sigma: float = 5.0
    cosmic_ray_contrast: float = 3.0
    box: int = 32
    filter_size: int = 3
    negative_threshold: float | None = 10.0
    outlier_threshold: float | None = 5.0
    pixfrac: float = 1.0
    properties: DetectorProperties | None = None
    n_threads: int | None = None

    def __post_init__(self):
        if self.backend not in BACKENDS:
            known = " or ".join(repr(name) for name in BACKENDS)
            raise argument_error("backend", known, repr(self.backend))
        for name in (
            "jump_threshold", "neighbor_threshold", "negative_threshold", "outlier_threshold"
        ):  # fmt: skip
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise argument_error(name, "positive or None", value)
        for name in ("cosmic_ray_sigma", "cosmic_ray_contrast", "filter_size"):
            if not getattr(self, name) > 0:
                raise argument_error(name, "positive", getattr(self, name))
        for name in ("skip_first", "skip_last"):
            value = getattr(self, name)
            if value is not None and (value < 0 or int(value) != value):
                raise argument_error(name, "an integer of at least 0", value)
        if self.reset_anomaly is not None and not isinstance(self.reset_anomaly, ResetAnomaly):
            raise argument_error("reset_anomaly", "a ResetAnomaly", repr(self.reset_anomaly))
        if self.box < 4:
            raise argument_error("box", "at least 4", self.box)
        for name in ("saturation", "pixfrac"):
            if not 0 < getattr(self, name) <= 1:
                raise argument_error(name, "above 0 and at most 1", getattr(self, name))
        thread_count(self.n_threads)
        if self.properties is not None and not isinstance(self.properties, DetectorProperties):
            raise argument_error("properties", "a DetectorProperties", repr(self.properties))

    replace = dataclasses.replace

    @property
    def _detector(self):
        return miri_detector() if self.properties is None else self.properties

    def fit_groups(self, ramp, *, progress_bar=False):
        """
        Fit the ramps of an exposure, with every plane of the result.

        Parameters
        ----------
        ramp : `~miricigale.detector.Ramp` or `~miricigale.detector.Charge`
            Counts in DN; or what was collected, whose slopes are drawn.
        progress_bar : bool, optional
            Whether a progress bar is shown.

        Returns
        -------
        fit : `RampFit`
            Slope, Poisson and read variance, groups used, jumps, flags.

        Raises
        ------
        ValueError
            If it is no ramp, or fewer than two groups are left.
        """
        if not isinstance(ramp, (Ramp, Charge)):
            raise argument_error("ramp", "a Ramp or a Charge", type(ramp).__name__)
        exposure, detector = ramp.exposure, self._detector
        dq = ramp.pixel_dq.astype(np.int64)
        reference = (dq & DQ.REFERENCE_PIXEL) != 0
        usable = (dq & _UNUSABLE) == 0
        n_group = exposure.n_groups
        skip_first, skip_last = self._skipped(ramp)
        if skip_first + skip_last > n_group - 2:
            msg = f"at most {n_group - 2} groups together for {n_group} groups"
            raise argument_error("skip_first, skip_last", msg, f"{skip_first}, {skip_last}")
        factor = float(np.sum(detector.ipc_kernel**2)) if self._shares_charge(ramp) else 1.0
        bias = detector.bias + self._anomaly(ramp)
        options = {
            "group_time": float(exposure.group_time.to_value("s")),
            "gain": detector.gain,
            "read_noise": detector.read_noise,
            "linearity": detector.nonlinearity,
            "saturation": detector.bias + self.saturation * detector.saturation_dn,
            "usable": usable,
            "first_group": skip_first,
            "last_group": n_group - skip_last,
            "jump_threshold": self.jump_threshold,
            "neighbor_threshold": self.neighbor_threshold,
            "poisson_factor": factor,
        }
        if isinstance(ramp, Charge):
            fit = draw_groups(ramp, bias=bias, **options)
        else:
            if self.reference_correction:
                bias = bias + reference_drift(ramp.data, reference)
            options |= {"n_threads": self.n_threads, "progress_bar": progress_bar}
            fit = fit_groups(ramp.data, bias=bias, **options)
        fit.flags[...] |= dq
        fit.flags[~usable] |= int(DQ.DO_NOT_USE)
        return fit

    def fit_ramp(self, ramp, *, progress_bar=False):
        """
        Fit the ramps of an exposure.

        Parameters
        ----------
        ramp : `~miricigale.detector.Ramp` or `~miricigale.detector.Charge`
            Counts in DN; or what was collected, whose slopes are drawn.
        progress_bar : bool, optional
            Whether a progress bar is shown.

        Returns
        -------
        rate : `~astropy.nddata.CCDData`
            Slope in DN/s with standard deviation, mask, ``flags`` (`DQ`) and WCS;
            masked pixels without a slope are NaN. The meta dictionary has the exposure in
            plain values, and ``noise_correction``: by how much the sum over many pixels is
            noisier than their errors in quadrature, because neighbors share charge.
        """
        fit = self.fit_groups(ramp, progress_bar=progress_bar)
        ipc = self._shares_charge(ramp)
        meta = provenance(
            **exposure_values(ramp.exposure),
            n_jumps=len(fit.jumps),
            ipc=ipc,
            noise_correction=self._noise_correction(fit) if ipc else 1.0,
            gain=self._detector.gain,
        )
        return image(
            fit.rate, RATE, error=fit.error, flags=fit.flags, wcs=ramp.exposure.wcs, meta=meta
        )

    def calibrate(self, rate):
        """
        Turn slopes into surface brightness.

        Dark subtraction, flat field, photometric conversion, mask of the field and of
        residual cosmic rays. The background stays.

        Parameters
        ----------
        rate : `~astropy.nddata.CCDData`
            DN/s, from `fit_ramp` (its meta dictionary names filter and sub-array).

        Returns
        -------
        cal : `~astropy.nddata.CCDData`
            MJy/sr.
        """
        facts = ImageFacts.of(rate)
        for key in ("filter", "subarray"):
            if getattr(facts, key) is None:
                raise argument_error("rate", f"an image whose meta has {key!r}", "none")
        detector = self._detector
        options = {
            "sigma_clip": self.cosmic_ray_sigma,
            "object_limit": self.cosmic_ray_contrast,
        }
        return calibrate(
            rate,
            filter=facts.filter,
            subarray=facts.subarray,
            dark=detector.dark_current / detector.gain,
            gain=detector.gain,
            ipc_kernel=detector.ipc_kernel if facts.ipc else None,
            field_only=self.field_only,
            cosmic_rays=options if self.cosmic_rays else None,
        )

    def estimate_background(self, image):
        """Estimate the background of an image: a `Background`."""
        return estimate_background(
            image,
            box=self.box,
            filter_size=self.filter_size,
        )

    def subtract_background(self, image):
        """
        Subtract the background and mask pixels far below it.

        Parameters
        ----------
        image : `~astropy.nddata.CCDData`
            A calibrated image or a mosaic.

        Returns
        -------
        image : `~astropy.nddata.CCDData`
        background : `Background`
        """
        return subtract_background(
            image,
            box=self.box,
            filter_size=self.filter_size,
            negative_threshold=self.negative_threshold,
        )

    def mosaic(self, images, wcs, *, pixfrac=None):
        """
        Drizzle images onto one grid.

        Parameters
        ----------
        images : iterable of `~astropy.nddata.CCDData`
            Calibrated, background-subtracted images. Outliers are masked first, if there
            are three or more images and that was not done before.
        wcs : `~astropy.wcs.WCS`
            Of the output, with ``pixel_shape``.
        pixfrac : float, optional
            That of the settings if not given.

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
        return self.drizzle(images, wcs, pixfrac=pixfrac)[0].image

    def drizzle(self, images, wcs, *, pixfrac=None):
        """
        Drizzle images onto one grid, with every plane of the result.

        Parameters are those of `mosaic`.

        Returns
        -------
        mosaic : `Mosaic`
        images : list of `~astropy.nddata.CCDData`
            The inputs with outliers masked.
        """
        images = list(images)
        check_images(images, wcs)
        pixfrac = self.pixfrac if pixfrac is None else pixfrac
        weights = [weight_map(im) for im in images]
        maps = [pixel_map(im.wcs, wcs, im.shape) for im in images]
        check_overlap(maps, wcs.pixel_shape[::-1])
        judged = all(ImageFacts.of(im).n_outliers is not None for im in images)
        if self.outlier_threshold is not None and len(images) >= 3 and not judged:
            images = reject_outliers(
                images, wcs, threshold=self.outlier_threshold, weights=weights, pixel_maps=maps
            )
        result = drizzle_images(images, wcs, pixfrac=pixfrac, weights=weights, pixel_maps=maps)
        return result, images

    def run(self, ramps, *, wcs=None, pixel_scale=0.11 * ANGLE, progress_bar=False):
        """
        Reduce the dithers of one filter.

        Parameters
        ----------
        ramps : iterable of `~miricigale.detector.Ramp` or `~miricigale.detector.Charge`
            One at a time is held if this is a generator.
        wcs : `~astropy.wcs.WCS`, optional
            Of the mosaic; by default the smallest north-up grid that holds
            every unmasked pixel of the dithers.
        pixel_scale : `~astropy.units.Quantity`, optional
            Of that grid, if ``wcs`` is not given.
        progress_bar : bool, optional
            Whether a progress bar is shown.

        Returns
        -------
        result : `ReductionResult`

        Raises
        ------
        ValueError
            If there are no ramps, or of more than one filter.
        """
        to_array(pixel_scale, ANGLE, "pixel_scale", ndim=0, finite=True)
        rates, images, backgrounds, name = [], [], [], None
        for ramp in progress(ramps, show=progress_bar, desc="reduce"):
            name = ramp.exposure.filter if name is None else name
            if ramp.exposure.filter != name:
                raise argument_error("ramps", f"of one filter ({name})", ramp.exposure.filter)
            rates.append(self.fit_ramp(ramp))
            del ramp
            subtracted, background = self.subtract_background(self.calibrate(rates[-1]))
            images.append(subtracted)
            backgrounds.append(background)
        if not rates:
            raise argument_error("ramps", "at least one ramp", "none")
        if wcs is None:
            wcs = mosaic_wcs([seen_wcs(im) for im in images], pixel_scale)
        drizzled, images = self.drizzle(images, wcs)
        mosaic, mosaic_background = self.subtract_background(drizzled.image)
        # the mosaic's own level would hide those of the dithers
        mosaic.meta["mosaic_background"] = mosaic.meta.pop("background")
        if "background" in drizzled.image.meta:
            mosaic.meta["background"] = drizzled.image.meta["background"]
        return ReductionResult(
            tuple(rates),
            tuple(images),
            tuple(backgrounds),
            mosaic,
            drizzled.weight,
            drizzled.n_images,
            mosaic_background,
        )

    def _noise_correction(self, fit):
        """Noise of large areas over that of pixels that share their charge."""
        good = np.isfinite(fit.rate)
        if not good.any():
            return 1.0
        photon, read = (float(np.median(v[good])) for v in (fit.var_poisson, fit.var_read))
        shared = float(np.sum(self._detector.ipc_kernel**2))
        return float(np.sqrt((photon / shared + read) / (photon + read)))

    def _shares_charge(self, ramp):
        """Whether the charge of this ramp was coupled between neighbors."""
        if self.ipc is not None:
            return bool(self.ipc)
        return ramp.shows(InterpixelCapacitance) is not False

    def _skipped(self, ramp):
        """Groups left out at the start and the end of the integrations of a ramp."""
        n_group = ramp.exposure.n_groups
        first, last = self.skip_first, self.skip_last
        if first is None:
            first = int(bool(ramp.shows(FirstFrame)) and n_group > 3)
        if last is None:
            last = int(bool(ramp.shows(LastFrame)) and n_group > 2)
        return first, last

    def _anomaly(self, ramp):
        """Offset of each group after a reset, DN."""
        if self.reset_anomaly is not None:
            exposure = ramp.exposure
            return self.reset_anomaly.offsets(exposure.n_integrations, exposure.n_groups)
        if self.skip_first is None and ramp.shows(ResetAnomaly):
            msg = (
                "the ramp shows a reset anomaly that this Reducer leaves in: give it "
                "'reset_anomaly', or 'skip_first' groups to be left out"
            )
            warnings.warn(msg, MiricigaleWarning, stacklevel=4)
        return 0.0
