"""Effects on the accumulated charge, in electrons."""

import dataclasses

import numpy as np
from scipy import ndimage

from miricigale.detector._core.charge import add_latent, add_poisson, couple_neighbors
from miricigale.detector._core.readout import clip_well
from miricigale.detector.effects.base import Effect, check_amounts, check_share
from miricigale.instrument import DQ, bad_pixel_mask
from miricigale.utils.exceptions import argument_error
from miricigale.utils.units import TIME, scalar


@dataclasses.dataclass(frozen=True)
class Dark(Effect):
    """
    Dark current, with its Poisson noise.

    Parameters
    ----------
    current : float, optional
        Electrons per second; that of the detector's properties if not given.

    Examples
    --------
    >>> import numpy as np
    >>> import astropy.units as u
    >>> from miricigale import Detector, Exposure
    >>> exposure = Exposure("F770W", n_groups=10, subarray="SUB64", pointing="53 -27")
    >>> sky = np.full(exposure.shape, 5.0) * u.MJy / u.sr
    >>> from miricigale.detector import Dark
    >>> charge = Detector.miri_imager(Dark(current=100.0)).collect(
    ...     0 * sky, exposure, seed=1
    ... )
    >>> print(f"{np.nanmedian(charge.mean):.1f} electrons per second")
    100.0 electrons per second
    """

    current: float | None = None

    def __post_init__(self):
        check_amounts(current=self.current)

    def apply(self, ramp, block):
        """Add the dark charge."""
        mean = np.full(ramp.shape[2:], self._rate(block.properties) * block.group_time)
        add_poisson(ramp, mean, block.key, block.rows.start)
        return ramp

    def expected(self, array, block):
        """Add the dark current."""
        return array + self._rate(block.properties)

    def _rate(self, properties):
        if self.current is None:
            return properties.dark_current
        return self.current


@dataclasses.dataclass(frozen=True)
class InterpixelCapacitance(Effect):
    """
    Coupling of a pixel's voltage to its eight neighbors.

    Left out where the image's ``psf_includes`` holds ``"ipc"``.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.detector import Block, InterpixelCapacitance
    >>> from miricigale.instrument import Exposure, miri_detector
    >>> exposure = Exposure("F770W", n_groups=5, subarray="SUB64")
    >>> block = Block(exposure, miri_detector(), slice(0, 3), None, None, None)
    >>> rate = np.zeros((3, 3))
    >>> rate[1, 1] = 100.0
    >>> InterpixelCapacitance().expected(rate, block).round(1)
    array([[ 1.3,  2.4,  1.3],
           [ 3.3, 83.4,  3.3],
           [ 1.3,  2.4,  1.3]])
    """

    halo = 1
    included_as = "ipc"

    def apply(self, ramp, block):
        """Couple the accumulated charge of neighbors."""
        kernel = np.asarray(block.properties.ipc_kernel, np.float32)
        couple_neighbors(ramp, kernel)
        return ramp

    def expected(self, array, block):
        """Couple the rates of neighbors."""
        kernel = np.asarray(block.properties.ipc_kernel)
        return ndimage.correlate(array, kernel, mode="nearest")


@dataclasses.dataclass(frozen=True)
class Persistence(Effect):
    """
    Charge that previous exposures left and that comes free later, with Poisson noise.

    A pixel that was filled at the rate R collects, a time t after that exposure,
    ``R sum_k amplitudes[k] exp(-t / times[k])`` more electrons per second. Resets do not
    stop it: time runs through all integrations and the reset frames between them.
    Without ``previous`` nothing happens. What is remembered was measured behind the interpixel
    capacitance, so that the effect stands after it. Pixels that were saturated collect less of
    everything by the share ``deficit exp(-t / deficit_time)``.

    Parameters
    ----------
    amplitudes : tuple of float, optional
        Share of the former rate right after the end of the exposure. The published fact is
        that latent images are below 1 %; the defaults add up to 0.8 %, the split into a
        quick and a slow part is of our own.
    times : tuple of float, optional
        Time in s over which each part falls by a factor e; of our own (minutes).
    deficit, deficit_time : float, optional
        Share of the charge that pixels lose right after saturation, none by default, and the time in s in
        which it falls by a factor e. Published for F2100W are 1.69 +- 0.10 % after 11.6 minutes and a tenth
        after 5.16 hours: 0.0184 and 8070 s.

    References
    ----------
    JWST User Documentation, MIRI detector performance, table 1 (latent images below 1 %);
    Rieke et al. 2015, PASP 127, 665; Vasan et al. 2025, arXiv:2512.15477 (deficit).

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.detector import Persistence
    >>> from miricigale.instrument import Exposure
    >>> exposure = Exposure("F770W", n_groups=4, subarray="SUB64")
    >>> released = Persistence().released(exposure, gap=30 * u.s)
    >>> (1e3 * released / exposure.group_time.value).round(2)
    array([[4.01, 4.01, 4.  , 3.99]])
    """

    amplitudes: tuple = (0.006, 0.002)
    times: tuple = (30.0, 300.0)
    deficit: float = 0.0
    deficit_time: float = 8070.0

    def __post_init__(self):
        check_share("deficit", self.deficit)
        check_amounts(above_zero=True, deficit_time=self.deficit_time)
        for name in ("amplitudes", "times"):
            values = tuple(map(float, np.atleast_1d(getattr(self, name))))
            object.__setattr__(self, name, values)
        if not self.amplitudes or len(self.amplitudes) != len(self.times):
            got = f"{len(self.amplitudes)} and {len(self.times)}"
            raise argument_error("amplitudes, times", "of one length, at least one each", got)
        for amplitude, time in zip(self.amplitudes, self.times, strict=True):
            check_share("amplitudes", amplitude)
            check_amounts(above_zero=True, times=time)

    def released(self, exposure, gap):
        """
        Return the charge that comes free in each group for a former rate of one electron per second.

        Parameters
        ----------
        exposure : `~miricigale.instrument.Exposure`
            The exposure that suffers.
        gap : `~astropy.units.Quantity`
            Time between the two.

        Returns
        -------
        charge : `~numpy.ndarray`, shape (n_int, n_group)
            In electrons; the integral of the decay over the time of each group.
        """
        frame = exposure.frame_time.to_value(TIME)
        step = exposure.group_time.to_value(TIME)
        integration = exposure.integration_time.to_value(TIME) + frame
        start = scalar(gap, TIME, "gap") + integration * np.arange(exposure.n_integrations)
        start = start[:, None] + step * np.arange(exposure.n_groups)
        return sum(
            a * t * np.exp(-start / t) * -np.expm1(-step / t)
            for a, t in zip(self.amplitudes, self.times, strict=True)
        )

    def _remaining_share(self, block):
        """Share of its charge that each pixel keeps, in each integration of a block, (n_int, 1, n_row, n_col)."""
        exposure = block.exposure
        number = block.ramp_shape[0]
        share = 1.0
        duration = (exposure.integration_time + exposure.frame_time).to_value(TIME)
        middle = duration * exposure.n_integrations * (np.arange(number) + 0.5) / number
        for latent in block.previous:
            # hours, while an integration lasts minutes
            lost = self.deficit * np.exp(-(latent.gap.to_value(TIME) + middle) / self.deficit_time)
            share = share * (1 - np.multiply.outer(lost, latent.saturated[None, block.rows]))
        return share

    def apply(self, ramp, block):
        """Add the charge that comes free, and take the deficit off."""
        if not block.previous:
            return ramp
        if self.deficit:
            ramp *= self._remaining_share(block)
        rates, released = self._released_rates(block)
        if released.shape[1:] != block.ramp_shape[:2]:
            # all groups as one
            released = released.sum(axis=(1, 2), keepdims=True)
        add_latent(ramp, rates, released, block.key, block.rows.start)
        return ramp

    def expected(self, array, block):
        """Add the mean rate over all groups, where previous exposures are given."""
        if not block.previous:
            return array
        if self.deficit:
            array = array * self._remaining_share(block).mean(axis=(0, 1))
        rates, released = self._released_rates(block)
        return array + np.tensordot(released.sum(axis=(1, 2)), rates, 1) / block.total_time

    def _released_rates(self, block):
        """Former rates of the rows of a block, and what comes free of one of 1, for each exposure before."""
        rates = np.stack([latent.rate.value[block.rows] for latent in block.previous])
        return rates, np.stack(
            [self.released(block.exposure, exposed.gap) for exposed in block.previous]
        )


@dataclasses.dataclass(frozen=True)
class BadPixels(Effect):
    """
    Pixels that do not work, as the instrument's mask has them.

    Every second bad pixel (by row plus column) is dead: it collects nothing. The others are hot:
    they collect more dark current. Both are flagged DO_NOT_USE.

    Parameters
    ----------
    hot_current : float, optional
        Additional dark current of hot pixels in electrons per second.

    Examples
    --------
    >>> import numpy as np
    >>> import astropy.units as u
    >>> from miricigale import Detector, Exposure
    >>> exposure = Exposure("F770W", n_groups=10, subarray="SUB64", pointing="53 -27")
    >>> sky = np.full(exposure.shape, 5.0) * u.MJy / u.sr
    >>> from miricigale.detector import BadPixels
    >>> from miricigale.instrument import DQ
    >>> ramp = Detector.miri_imager(BadPixels(hot_current=500.0)).expose(
    ...     sky, exposure, seed=1
    ... )
    >>> print(np.count_nonzero(ramp.pixel_dq & int(DQ.HOT)), "hot pixel")
    1 hot pixel
    """

    hot_current: float = 300.0

    def __post_init__(self):
        check_amounts(hot_current=self.hot_current)

    def apply(self, ramp, block):
        """Empty the dead pixels and heat the hot ones."""
        dead, hot = self._pixels(block)
        ramp[:, :, dead] = 0.0
        mean = np.where(hot, self.hot_current * block.group_time, 0.0)
        add_poisson(ramp, mean, block.key, block.rows.start)
        block.pixel_dq[dead] |= np.uint32(DQ.DEAD | DQ.DO_NOT_USE)
        block.pixel_dq[hot] |= np.uint32(DQ.HOT | DQ.DO_NOT_USE)
        return ramp

    def expected(self, array, block):
        """NaN: whatever they collect is no signal."""
        dead, hot = self._pixels(block)
        return np.where(dead | hot, np.nan, array)

    def _pixels(self, block):
        bad = bad_pixel_mask(subarray=block.exposure.subarray)[block.rows]
        dead = np.zeros_like(bad)
        y, x = np.nonzero(bad)
        dead[y, x] = (y + block.rows.start + x) % 2 == 0
        return dead, bad & ~dead


@dataclasses.dataclass(frozen=True)
class ReferencePixels(Effect):
    """
    Columns at both sides of the full frame that see no light and collect no charge.

    They share bias, drift and read noise with the others, and are flagged
    REFERENCE_PIXEL and NON_SCIENCE.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from miricigale import Detector, Exposure
    >>> from miricigale.instrument import DQ
    >>> exposure = Exposure("F770W", n_groups=3, subarray="SUB128", pointing="53 -27")
    >>> sky = np.full(exposure.shape, 5.0) * u.MJy / u.sr
    >>> ramp = Detector.miri_imager().expose(sky, exposure, seed=1)
    >>> print(np.count_nonzero(ramp.pixel_dq[0] & int(DQ.REFERENCE_PIXEL)), "columns")
    4 columns
    """

    def apply(self, ramp, block):
        """Empty the reference columns."""
        ramp[:, :, block.reference] = 0.0
        block.pixel_dq[block.reference] |= np.uint32(DQ.REFERENCE_PIXEL | DQ.NON_SCIENCE)
        return ramp

    def expected(self, array, block):
        """NaN: they are no part of the image."""
        return np.where(block.reference, np.nan, array)


@dataclasses.dataclass(frozen=True)
class Saturation(Effect):
    """
    Charge stops at the full well; the groups from there on are flagged SATURATED.

    Parameters
    ----------
    full_well : float, optional
        In electrons; that of the detector's properties if not given.

    Examples
    --------
    >>> from miricigale.detector import Saturation
    >>> from miricigale.instrument import miri_detector
    >>> print(f"{Saturation().limit(miri_detector()):.0f} electrons")
    210000 electrons
    >>> Saturation(full_well=1e5)
    Saturation(full_well=100000.0)
    """

    full_well: float | None = None

    def __post_init__(self):
        check_amounts(above_zero=True, full_well=self.full_well)

    def apply(self, ramp, block):
        """Clip the charge and flag it."""
        well = self.limit(block.properties)
        clip_well(ramp, well, block.group_dq, np.uint8(DQ.SATURATED))
        return ramp

    def limit(self, properties):
        """Return the full well in electrons."""
        return float(properties.full_well if self.full_well is None else self.full_well)
