"""What sky and sources fill the wells, and when."""

import astropy.units as u
import numpy as np
from astropy.table import QTable
from scipy.ndimage import maximum_filter, minimum_filter

from miricigale.instrument import Exposure, electron_rate, miri_detector
from miricigale.utils.arrays import finite_values, is_inside, quiet_division
from miricigale.utils.exceptions import argument_error
from miricigale.utils.missing_values import floats
from miricigale.utils.named_values import attributes
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.tables import require_columns
from miricigale.utils.values import value_class

#: Share of the full well above which the sky is reported.
SKY_FRACTION = 0.6

#: Group of a pixel that is never full.
NEVER = 2**31 - 1

#: Side of the square of pixels around a source's own in which its brightest is looked for.
_SIDE = 3


@value_class
class SaturationForecast:
    """
    What an exposure fills, made by `~miricigale.detector.Detector.forecast`; it never changes.

    Groups are counted from 1, as in n_groups.

    Parameters
    ----------
    exposure : `~miricigale.instrument.Exposure`
        What is exposed.
    sky_rate : `~astropy.units.Quantity`
        Electrons per second of the median pixel, dark current included.
    sky_fraction : float
        Of the full well that it fills by the last group of an integration.
    sky_group : int
        Group in which it is full, were there so many.
    n_pixels : int
        Pixels that are full by the last group; bad and reference pixels do not count.
    sources : `~astropy.table.QTable`
        One row for each source on the image: ``id``, ``x``, ``y``; ``peak_rate``
        (electrons per second of its brightest pixel, everything in it included);
        ``peak_fraction`` of the well by the last group; ``saturated``, whether it is full
        by then; ``group``, in which it first is (0 if it is not).

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import Table
    >>> from miricigale.depth import SaturationForecast
    >>> from miricigale.instrument import Exposure
    >>> rate = np.full((20, 20), 50.0)
    >>> rate[10, 10] = 5000.0
    >>> star = Table({"id": [7], "x": [10.0], "y": [10.0]})
    >>> exposure = Exposure("F770W", n_groups=50)
    >>> forecast = SaturationForecast.from_rate(rate, exposure, 2e5, star)
    >>> forecast.n_pixels, forecast.sources["group"].tolist()
    (1, [15])
    """

    exposure: Exposure
    sky_rate: u.Quantity
    sky_fraction: float
    sky_group: int
    n_pixels: int
    sources: QTable

    @classmethod
    def from_rate(cls, rate, exposure, limit, sources=None):
        """
        Return the forecast from the rate of charge of every pixel.

        Parameters
        ----------
        rate : `~numpy.ndarray`, shape (ny, nx)
            Electrons per second; masked or NaN where a pixel does not count.
        exposure : `~miricigale.instrument.Exposure`
            What is exposed.
        limit : float
            The well in electrons.
        sources : `~astropy.table.Table`, optional
            With ``id`` and pixel positions ``x``, ``y``.

        Returns
        -------
        forecast : `SaturationForecast`
        """
        rate = floats(rate)
        step = exposure.group_time.to_value(u.s)
        group = saturation_group(rate, limit, step)
        good = finite_values(rate)
        sky = np.nan
        if good.size:
            sky = float(np.median(good))
        return cls(
            exposure,
            sky * u.electron / u.s,
            _filled(sky, exposure, limit),
            int(saturation_group(sky, limit, step)),
            int(np.count_nonzero(group <= exposure.n_groups)),
            _sources(sources, rate, group, limit, exposure),
        )

    @property
    def saturated(self):
        """Rows of ``sources`` that saturate, the brightest first."""
        rows = self.sources[self.sources["saturated"]]
        return rows[np.argsort(-rows["peak_rate"].value, kind="stable")]

    @property
    def sky_too_bright(self):
        """Whether the sky fills more than 60 % of the well."""
        return self.sky_fraction > SKY_FRACTION

    def describe(self):
        """
        Return one line of text, for a log.

        Returns
        -------
        text : str
        """
        e = self.exposure
        rows = self.saturated
        text = (
            f"{e.filter} dither {e.dither} ({e.readout} {e.subarray}, {e.n_integrations} x "
            f"{e.n_groups} groups): sky fills {100 * self.sky_fraction:.0f} % of the well; "
            f"saturated: {self.n_pixels} pixel(s), {len(rows)} source(s)"
        )
        if len(rows):
            text += f", the first in group {rows['group'].min()}"
        return text

    def __repr__(self):
        return f"<SaturationForecast {self.describe()}>"


@takes_other_keywords
def saturation_forecast(exposure, *, background=None, detector=None):
    """
    Tell how full the sky and the dark current make the wells by the end of an integration.

    Parameters
    ----------
    exposure : `~miricigale.instrument.Exposure`
        What is exposed.
    background : `~astropy.units.Quantity`, optional
        Surface brightness; the low background of the filter if not given. An array (an
        image of sources and sky, say) gives an array.
    detector : `~miricigale.instrument.DetectorProperties`, optional
        `~miricigale.instrument.miri_detector` if not given.

    Returns
    -------
    fraction : float or `~numpy.ndarray`
        Of the full well; above 0.6 little of the well is left for sources.

    Examples
    --------
    >>> from miricigale.depth import saturation_forecast
    >>> from miricigale.instrument import Exposure
    >>> for name in ("F770W", "F2100W"):
    ...     print(f"{name} {saturation_forecast(Exposure(name, n_groups=60)):.2f}")
    F770W 0.04
    F2100W 1.58
    """
    if detector is None:
        detector = miri_detector()
    rate = electron_rate(exposure.filter, background, detector=detector, subarray=exposure.subarray)
    fraction = _filled(rate, exposure, detector.full_well)
    if np.ndim(fraction) == 0:
        return float(fraction)
    return fraction


@takes_other_keywords
def saturation_time(filter, *, background=None, detector=None):
    """
    Return the time in which the sky and the dark current fill the well.

    Parameters are those of `saturation_forecast`, with the filter for the exposure.

    Returns
    -------
    time : `~astropy.units.Quantity`
        In s.

    Examples
    --------
    >>> from miricigale.depth import saturation_time
    >>> print(f"{saturation_time('F770W'):.0f}, {saturation_time('F2550W'):.0f}")
    3722 s, 57 s
    """
    if detector is None:
        detector = miri_detector()
    # an exposure has one
    filter = getattr(filter, "filter", filter)
    return detector.full_well / electron_rate(filter, background, detector=detector) * u.s


def _filled(rate, exposure, limit):
    """Share of a well that a rate fills by the last group of an integration."""
    return rate * exposure.integration_time.to_value(u.s) / limit


def saturation_group(rate, limit, step):
    """
    Group, from 1, by which a constant rate fills the well: the ceiling of limit / (rate step).

    ``rate`` is in electrons per second, ``limit`` the well in electrons, ``step`` the time of a
    group in s; `NEVER` where nothing fills it. Non-linearity plays no part: the well is one of
    charge.
    """
    rate = floats(rate)
    with quiet_division():
        # a rate that fills it exactly does so in that group, whatever the rounding
        group = np.ceil(limit / (rate * step) * (1 - 1e-12))
    usable = np.isfinite(group) & (rate > 0) & (group < NEVER)
    return np.where(usable, np.maximum(group, 1), NEVER).astype(np.int64)


def _sources(sources, rate, group, limit, exposure):
    """Return the table of sources on the image."""
    if sources is None:
        sources = QTable({"id": np.zeros(0, int), "x": np.zeros(0), "y": np.zeros(0)})
    require_columns(sources, ("id", "x", "y"), "sources")
    x = floats(sources["x"])
    y = floats(sources["y"])
    on = is_inside(x, y, rate.shape)
    table = QTable({name: sources[name][on] for name in ("id", "x", "y")})
    column = np.rint(x[on]).astype(int)
    row = np.rint(y[on]).astype(int)
    brightest = maximum_filter(np.nan_to_num(rate), _SIDE, mode="nearest")
    peak = np.maximum(brightest[row, column], 0.0)
    first = minimum_filter(group, _SIDE, mode="nearest")[row, column]
    table["peak_rate"] = peak * u.electron / u.s
    table["peak_fraction"] = _filled(peak, exposure, limit)
    table["saturated"] = first <= exposure.n_groups
    table["group"] = np.where(table["saturated"], first, 0)
    return table


@takes_other_keywords
def forecast_table(forecasts):
    """
    Return the forecasts of several exposures side by side.

    Parameters
    ----------
    forecasts : iterable of `SaturationForecast`
        One for each exposure.

    Returns
    -------
    table : `~astropy.table.QTable`
        One row each: the exposure (``filter``, ``dither``, ``readout``, ``subarray``,
        ``n_groups``, ``n_integrations``, ``group_time``), ``sky_fraction`` of the full well
        by the last group, ``sky_group`` in which it would be full, ``n_pixels`` and
        ``n_sources`` that saturate, the ``first_group`` in which a source does (0: none) and
        their ``ids``, the brightest first, separated by blanks.

    Raises
    ------
    ValueError
        If there are none.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import Table
    >>> from miricigale.depth import SaturationForecast, forecast_table
    >>> from miricigale.instrument import Exposure
    >>> rate = np.full((20, 20), 50.0)
    >>> rate[10, 10] = 5000.0
    >>> star = Table({"id": [7], "x": [10.0], "y": [10.0]})
    >>> exposure = Exposure("F770W", n_groups=50)
    >>> forecast = SaturationForecast.from_rate(rate, exposure, 2e5, star)
    >>> table = forecast_table([forecast])
    >>> print(table["filter", "n_groups", "n_pixels", "n_sources", "first_group"])
      filter   n_groups n_pixels n_sources first_group
    ---------- -------- -------- --------- -----------
    miri.f770w       50        1         1          15
    """
    forecasts = list(forecasts)
    check_that(forecasts, "forecasts", "at least one forecast", "none")
    for forecast in forecasts:
        if not isinstance(forecast, SaturationForecast):
            raise argument_error("forecasts", "made of SaturationForecast", repr(forecast))
    rows = []
    for forecast in forecasts:
        sources = forecast.saturated
        first_group = 0
        if len(sources):
            first_group = int(sources["group"].min())
        names = (
            "filter",
            "dither",
            "readout",
            "subarray",
            "n_groups",
            "n_integrations",
            "group_time",
        )
        row = attributes(forecast.exposure, names)
        row |= attributes(forecast, ("sky_fraction", "sky_group", "n_pixels"))
        row |= {"n_sources": len(sources), "first_group": first_group}
        row["ids"] = " ".join(map(str, sources["id"]))
        rows.append(row)
    table = QTable(rows)
    table["sky_fraction"].info.description = "of the full well by the last group"
    return table
