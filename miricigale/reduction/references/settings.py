"""Settings of the steps of a `Reducer`: how ramps are fitted, backgrounds estimated and mosaics made."""

import dataclasses

import astropy.units as u

from miricigale.detector.effects.reset import ResetAnomaly
from miricigale.instrument import DetectorProperties
from miricigale.utils.named_values import attributes
from miricigale.utils.options import check_choice, check_least, check_positive, check_that
from miricigale.utils.units import ANGLE, positive

#: Known backends.
BACKENDS = ("native", "jwst")


@dataclasses.dataclass(frozen=True, kw_only=True)
class RampSettings:
    """
    How ramps are fitted, beyond the options of `Reducer` itself.

    Parameters
    ----------
    neighbor_threshold : float or None, optional
        Sigma above which a jump is cut in the four neighbors too, without what leaked into it (`fit_groups`).
    shower_threshold : float or None, optional
        Sigma above which the smoothed light around very large jumps is cut, the showers of cosmic
        rays (`fit_groups`); None for none.
    reference_correction : bool, "channels" or None, optional
        Whether the mean of the reference columns is subtracted, group by group; ``"channels"``
        for means of the four channels and of odd and even rows, as in the official pipeline
        (`reference_channels`), which leave the first group unchanged. None: the
        mean in simulated ramps, and in others what the pipeline does, ``"channels"`` in full frames
        and nothing in sub-arrays.
    ipc : bool or None, optional
        Whether neighbors share their charge, which lowers the photon noise of a pixel
        (and correlates it) and blurs the flat field. None: as the ramp says, False where
        it does not: a measured gain and flat field include it.

    Raises
    ------
    ValueError
        If an option is out of range.

    Examples
    --------
    >>> from miricigale.reduction import RampSettings, Reducer
    >>> Reducer(ramps=RampSettings(shower_threshold=5)).ramps.neighbor_threshold
    5.0
    """

    neighbor_threshold: float | None = 5.0
    shower_threshold: float | None = None
    reference_correction: bool | str | None = None
    ipc: bool | None = None

    def __post_init__(self):
        for name in ("neighbor_threshold", "shower_threshold"):
            check_positive(getattr(self, name), name, optional=True)
        choices = (True, False, "channels", None)
        check_choice(self.reference_correction, "reference_correction", choices)


@dataclasses.dataclass(frozen=True)
class BackgroundSettings:
    """
    How the background of an image is estimated, and which pixels below it are masked.

    Parameters
    ----------
    method : {"masked", "sep", "dithers", "none"}, optional
        From the image's own sky, with the sources masked (`estimate_background`); by the plain mesh of sep, as in
        Yang et al. 2021 (with ``box=32``); in `Reducer.run`, `Reducer.combine` and `Reducer.subtract_dithers`,
        from the other dithers (`dither_backgrounds`); or none, which leaves light as wide as the image in.
    box, filter_size : int, optional
        Boxes in pixels, median filter in boxes.
    plane : bool, optional
        Whether a plane or parabola is subtracted before the boxes are measured.
    negative_threshold : float or None, optional
        Pixels more than this many sigma below the background are masked; None for none.
    negative_noise : {"larger", "background"}, optional
        Which noise gives that sigma (`remove_background`).
    stripes : bool, optional
        Whether stripes of rows and columns are taken off each exposure first (`remove_stripes`).
    sky_flat : float or None, optional
        Days within which exposures make each other's sky flat, by which they are divided when they are combined
        (`sky_flats`); None for none.

    Raises
    ------
    ValueError
        If an option is out of range.

    Examples
    --------
    >>> from miricigale.reduction import BackgroundSettings, Reducer
    >>> plain = BackgroundSettings("sep", box=32, negative_noise="background")
    >>> Reducer(background=plain).background.box
    32
    """

    method: str = "masked"
    _: dataclasses.KW_ONLY
    box: int = 64
    filter_size: int = 3
    plane: bool = True
    negative_threshold: float | None = 10.0
    negative_noise: str = "larger"
    stripes: bool = False
    sky_flat: float | None = None

    def __post_init__(self):
        check_choice(self.method, "method", ("masked", "sep", "dithers", "none"))
        check_least(self.box, "box", 4, whole=True)
        check_least(self.filter_size, "filter_size", 1, whole=True)
        check_positive(self.negative_threshold, "negative_threshold", optional=True)
        check_choice(self.negative_noise, "negative_noise", ("larger", "background"))
        check_positive(self.sky_flat, "sky_flat", optional=True)

    @property
    def mesh(self):
        """Options of `estimate_background`: those of single images, also where dithers follow."""
        method = "masked"
        if self.method != "dithers":
            method = self.method
        names = ("box", "filter_size", "plane")
        return {"method": method, **attributes(self, names)}

    @property
    def negative(self):
        """Options of `remove_background`."""
        names = ("negative_threshold", "negative_noise")
        return attributes(self, names)


@dataclasses.dataclass(frozen=True, kw_only=True)
class MosaicSettings:
    """
    How the images of a filter are combined.

    Parameters
    ----------
    match_sky : bool, optional
        Whether constants by which the levels of dithers differ where they overlap are subtracted before
        they are compared and combined (`match_levels`).
    outlier_threshold : float or None, optional
        Sigma for the comparison of three or more dithers; None for none.
    pixfrac : float, optional
        Side of the drizzle's drops in input pixels.
    pixel_scale : `~astropy.units.Quantity`, optional
        Pixel of mosaics without a WCS of their own; 0.11 arcsec, MIRI's, if not given.

    Raises
    ------
    ValueError
        If an option is out of range.

    Examples
    --------
    >>> from miricigale.reduction import MosaicSettings, Reducer
    >>> Reducer(
    ...     mosaics=MosaicSettings(pixfrac=0.8, outlier_threshold=4)
    ... ).mosaics.pixfrac
    0.8
    """

    match_sky: bool = True
    outlier_threshold: float | None = 5.0
    pixfrac: float = 1.0
    pixel_scale: u.Quantity | None = None

    def __post_init__(self):
        if self.pixel_scale is not None:
            positive(self.pixel_scale, ANGLE, "pixel_scale")
        check_positive(self.outlier_threshold, "outlier_threshold", optional=True)
        check_that(0 < self.pixfrac <= 1, "pixfrac", "above 0 and at most 1", self.pixfrac)


#: Classes of the options that are objects.
KINDS = {
    "reset_anomaly": ResetAnomaly, "ramps": RampSettings, "background": BackgroundSettings,
    "mosaics": MosaicSettings, "properties": DetectorProperties,
}  # fmt: skip
#: Settings without which nothing can be done.
NEEDED = ("ramps", "background", "mosaics")
