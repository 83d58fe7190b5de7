"""What is exposed in each band: times, depths, noise, saturation, and the clock on the wall."""

import dataclasses
import functools
from operator import attrgetter

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from scipy.optimize import brentq

from miricigale.depth import (
    saturation_flux,
    saturation_forecast,
    saturation_time,
    scaled_limit,
    sensitivity,
)
from miricigale.instrument import Exposure, frame_time, frames_per_group, miri_detector, psf_fwhm
from miricigale.photometry import ErrorModel
from miricigale.reduction import imager_response
from miricigale.utils.caching import cached
from miricigale.utils.exceptions import ConfigError
from miricigale.utils.named_values import attributes
from miricigale.utils.values import value_class
from miricigale.workflow.background import band_background
from miricigale.workflow.options import of_option

#: The plan needs no direction; an `Exposure` has one.
_ANYWHERE = {"pointing": SkyCoord(0 * u.deg, 0 * u.deg), "roll": 0 * u.deg}


@value_class
class BandPlan:
    """
    The exposures of one band, and the errors that they give.

    Parameters
    ----------
    exposure : `~miricigale.instrument.Exposure`
        One dither; its direction does not count.
    n_dithers : int
        Their number.
    background : `~astropy.units.Quantity`
        Of sky and telescope, MJy/sr.
    noise : `~miricigale.planning.config.NoiseSection`
        Kind of the errors.
    detector : `~miricigale.instrument.DetectorProperties`, optional
        With the response of a day; `~miricigale.instrument.miri_detector` if not given.

    Examples
    --------
    >>> from miricigale.planning import Planner, load_plan
    >>> exposures = {"bands": ["miri.f770w"], "time": 900, "dithers": 4}
    >>> planner = Planner(load_plan(overrides={"exposures": exposures}))
    >>> plan = planner.band_plans()["miri.f770w"]
    >>> print(f"{plan.time:.0f}, 5 sigma at {plan.limit:.2f}")
    899 s, 5 sigma at 25.44 mag(AB)
    """

    exposure: Exposure
    n_dithers: int
    background: u.Quantity
    noise: object
    detector: object = None

    filter = property(attrgetter("exposure.filter"), doc="Name of the band.")

    @property
    def time(self):
        """Time in which light is gathered, all dithers, s."""
        return self.n_dithers * self.exposure.exposure_time

    @property
    def sky_fraction(self):
        """Share of the well that the sky fills by the end of an integration."""
        return saturation_forecast(self.exposure, **self._light)

    @property
    def _light(self):
        return {"background": self.background, "detector": self.detector}

    @property
    def _noise(self):
        options = {"n_dithers": self.n_dithers, "residual": self.noise.residual or None}
        return self._light | options

    @functools.cached_property
    def limit(self):
        """5-sigma AB limit of point sources, by `~miricigale.depth.sensitivity`."""
        names = ("n_groups", "readout", "subarray")
        options = attributes(self.exposure, names) | self._noise
        limit = sensitivity(self.filter, self.time, n_sigma=5, excess=self.noise.excess, **options)
        return limit.to(u.ABmag)

    @property
    def limit_used(self):
        """5-sigma AB limit of point sources by the errors that are drawn."""
        return np.round(self.errors().limiting_magnitude(self.filter), 2)

    def numbers(self):
        """
        Return the time, frames, filling of the well and limits, as a row of a table.

        ``limit_etc`` is the exposure time calculator's limit (low background), scaled by the root of the time.
        """
        return {
            "filter": self.filter,
            "time": np.round(self.time.to(u.s), 1),
            "groups": self.exposure.n_groups,
            "integrations": self.exposure.n_integrations,
            "dithers": self.n_dithers,
            "background": np.round(self.background, 2),
            "sky_in_well": round(float(self.sky_fraction), 3),
            "limit_etc": np.round(scaled_limit(self.filter, self.time).to(u.ABmag), 2),
            "limit": np.round(self.limit, 2),
        }

    @functools.cached_property
    def saturation(self):
        """AB magnitude at which a point source saturates."""
        return saturation_flux(self.exposure, **self._light).to(u.ABmag)

    def good_groups(self, flux, size=0.0 * u.arcsec):
        """
        Return the groups of an integration before the brightest pixel of a source is full.

        Parameters
        ----------
        flux : `~astropy.units.Quantity`
            Total fluxes.
        size : `~astropy.units.Quantity`, optional
            As in `errors`; it and the PSF count as Gaussians.

        Returns
        -------
        n_groups : int or `~numpy.ndarray` of int
            All of the exposure's where it is not full by the last; below 2 there is no slope.
        """
        wide = 1 + (size / psf_fwhm(self.filter)).to_value(u.dimensionless_unscaled) ** 2
        light = (flux / self.saturation.to(u.uJy)).to_value(u.dimensionless_unscaled) / wide
        filled = self.sky_fraction + (1 - self.sky_fraction) * light
        n = self.exposure.n_groups
        # a source without a flux fills nothing
        return np.clip(np.ceil(np.nan_to_num(n / filled, nan=np.inf)) - 1, 0, n).astype(int)

    def cut(self, n_groups):
        """Return this plan with so many groups of each integration: what is left of one that saturates."""
        return dataclasses.replace(self, exposure=self.exposure.replace(n_groups=int(n_groups)))

    def errors(self, size=0.0 * u.arcsec):
        """
        Return the errors of the fluxes.

        Parameters
        ----------
        size : `~astropy.units.Quantity`, optional
            Full width at half maximum of the sources before the PSF.

        Returns
        -------
        errors : `~miricigale.photometry.ErrorModel`
        """
        return ErrorModel.from_exposure(
            self.filter,
            self.time,
            **self._noise,
            size=size,
            n_integrations=self.n_dithers * self.exposure.n_integrations,
            frame_time=self.exposure.frame_time,
            n_frames=self.exposure.n_frames,
            subarray=self.exposure.subarray,
            fractional=self.noise.fractional,
            excess=self.noise.excess,
        )


def background_options(config):
    """Return the arguments of `band_background`, but for the filter, and of `background_text`."""
    options = config.background
    position = None
    if options.ra >= 0:
        position = SkyCoord(options.ra * u.deg, options.dec * u.deg)
    levels = {"filters": config.exposures.bands, "levels": options.level}
    return levels | {"position": position, "date": options.date}


def _band_plan(filter, time, n_dithers, config):
    """Return the exposures of one band that last a time."""
    options = config.exposures
    background = band_background(filter, **background_options(config))
    # the time for which Exposure.from_time allows is of the low background
    brighter = saturation_time(filter) / saturation_time(filter, background=background)
    exposure = Exposure.from_time(
        filter,
        time / n_dithers,
        readout=options.readout,
        max_fill=options.max_fill / float(brighter),
        max_groups=options.max_groups,
        **_ANYWHERE,
    )
    detector = _detector(options.photom, options.date)
    return BandPlan(exposure, n_dithers, background, config.noise, detector)


@cached(maxsize=8)
def _detector(photom, date):
    """Return the imager's detector, with the response of a day where one is given."""
    response = ()
    if photom or date:
        with of_option("[exposures] photom, date:", ValueError):
            response = imager_response(photom, date=date)
    return miri_detector().replace(response=response)


def _time_to(depth, filter, n_dithers, config):
    """Return the time in which the errors of point sources reach a 5-sigma depth."""

    def excess(log_time):
        plan = _band_plan(filter, 10**log_time * u.s, n_dithers, config)
        return plan.errors().limiting_magnitude(filter).value - depth

    # two groups in each dither at least
    readout = config.exposures.readout
    low = np.log10(2.5 * n_dithers * frames_per_group(readout) * frame_time(readout).value)
    if excess(low) >= 0:
        return 10**low * u.s
    if not excess(7.0) > 0:
        msg = f"[exposures] depth = {depth} is not reached in {filter} in 10 million seconds"
        raise ConfigError(msg)
    return 10 ** brentq(excess, low, 7.0, xtol=2e-3) * u.s


def band_plans(config, *, share=1.0, bands=None):
    """
    Return the exposures of bands of a configuration.

    Parameters
    ----------
    config : `~miricigale.planning.PlanConfig`
        The configuration.
    share : float, optional
        Factor on all times.
    bands : iterable of str, optional
        MIRI bands of the configuration; all by default.

    Returns
    -------
    plans : dict of str to `BandPlan`
    """
    options = config.exposures
    plans = {}
    values = options.by_band("depth" if options.depth else "time")
    for name, value, dithers in zip(options.bands, values, options.by_band("dithers"), strict=True):
        if bands is not None and name not in bands:
            continue
        time = value * u.s
        if options.depth:
            time = _time_to(value, name, dithers, config)
        plans[name] = _band_plan(name, share * time, dithers, config)
    return plans


def wall_clock(plans, options, *, pointings=1):
    """
    Return the time that the observatory charges.

    Parameters
    ----------
    plans : iterable of `BandPlan`
        The bands of a pointing.
    options : `~miricigale.planning.config.OverheadSection`
        Times of the overheads.
    pointings : int, optional
        Pointings, each a visit.

    Returns
    -------
    time : `~astropy.units.Quantity`
        In hours.

    Examples
    --------
    >>> from miricigale.planning import Planner, load_plan, wall_clock
    >>> exposures = {"bands": ["miri.f770w"], "time": 900, "dithers": 4}
    >>> planner = Planner(load_plan(overrides={"exposures": exposures}))
    >>> plans = planner.band_plans().values()
    >>> print(f"{wall_clock(plans, planner.config.overheads, pointings=2):.2f}")
    1.72 h
    """
    seconds = 0.0
    for plan in plans:
        seconds += options.filter + options.script
        seconds += plan.n_dithers * (plan.exposure.duration.to_value(u.s) + options.exposure)
        seconds += (plan.n_dithers - 1) * options.dither
    seconds += options.guide_star + options.visit
    seconds = pointings * seconds + options.slew + (pointings - 1) * options.next_slew
    return (1 + options.observatory) * seconds / 3600 * u.h
