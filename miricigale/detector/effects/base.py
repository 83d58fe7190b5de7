"""What all effects share: the block they act on, their streams, their base."""

import dataclasses
from operator import attrgetter

import numpy as np

from miricigale.instrument import DetectorProperties, Exposure, reference_pixel_mask
from miricigale.utils.exceptions import argument_error
from miricigale.utils.options import check_that
from miricigale.utils.random import stream
from miricigale.utils.values import value_class


class Timed:
    """Times of the exposure that something is of, as plain numbers."""

    @property
    def group_time(self):
        """Time between the groups in s."""
        return float(self.exposure.group_time.to_value("s"))

    @property
    def total_time(self):
        """Time in s during which charge is collected, in all integrations."""
        exposure = self.exposure
        return exposure.n_integrations * exposure.n_groups * exposure.group_time.to_value("s")


@value_class(repr=False)
class Block(Timed):
    """
    Where and when an effect acts: some full rows of one exposure.

    Parameters
    ----------
    exposure : `~miricigale.instrument.Exposure`
        What is exposed.
    properties : `~miricigale.instrument.DetectorProperties`
        Gain, noise, full well and the rest.
    rows : slice
        Detector rows, start and stop given.
    pixel_dq : `~numpy.ndarray` of uint32, shape (n_row, n_col)
        Flags that effects may set (`DQ`).
    group_dq : `~numpy.ndarray` of uint8, shape (n_int, n_group, n_row, n_col)
        Flags that effects may set.
    key : `~numpy.ndarray` of uint64, shape (4,)
        Key words of the random streams of this effect in this exposure.
    previous : tuple of `~miricigale.detector.Latent`, optional
        Exposures taken before, which `Persistence` remembers.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.detector import Block, Photons
    >>> from miricigale.instrument import Exposure, miri_detector
    >>> exposure = Exposure("F770W", n_groups=5, subarray="SUB64")
    >>> block = Block(exposure, miri_detector(), slice(0, 64), None, None, None)
    >>> rate = Photons(flat=False).expected(np.full((64, 72), 5.0), block)
    >>> print(f"{rate[0, 0]:.1f} electrons per second")
    57.0 electrons per second
    """

    exposure: Exposure
    properties: DetectorProperties
    rows: slice
    pixel_dq: np.ndarray
    group_dq: np.ndarray
    key: np.ndarray
    previous: tuple = ()

    def __repr__(self):
        name = type(self).__name__
        return f"<{name} of rows {self.rows.start} to {self.rows.stop}, {self.exposure!r}>"

    @property
    def reference(self):
        """True where a pixel is a reference pixel, (n_row, n_col)."""
        return reference_pixel_mask(subarray=self.exposure.subarray)[self.rows]

    ramp_shape = property(attrgetter("group_dq.shape"), doc="Shape of a ramp of this block.")


class WholeBlock(Block):
    """A block whose ramp is one group, as long as all groups of the exposure together."""

    @property
    def group_time(self):
        """Time of the one group in s."""
        return self.total_time


def key_words(*key):
    """Draw the key words of the kernels' streams from the stream of a key, uint64 (4,)."""
    return stream(*key).integers(0, 2**64 - 1, size=4, dtype=np.uint64, endpoint=True)


def stream_key(seed, exposure, name):
    """Return the key words of the streams of the effect ``name`` in an exposure, uint64 (4,)."""
    return key_words(seed, "detector", exposure.filter, exposure.dither, name)


def check_finite(**values):
    """Check that settings are finite."""
    for name, value in values.items():
        check_that(np.all(np.isfinite(value)), name, "finite", value)


def check_share(name, value, highest=1):
    """Check that a setting lies between 0 and ``highest``."""
    check_that(0 <= value <= highest, name, f"from 0 to {highest}", value)


def check_amounts(*, above_zero=False, **values):
    """Check that settings are finite and not negative; None stands for the detector's own."""
    for name, value in values.items():
        if value is None:
            continue
        if not np.isfinite(value) or value < 0 or (above_zero and value == 0):
            wanted = "finite and at least 0"
            if above_zero:
                wanted = "finite and positive"
            raise argument_error(name, wanted, value)


@dataclasses.dataclass(frozen=True)
class Effect:
    """
    Base of the effects.

    ``halo`` is how many rows beside a row an effect reads; ``included_as`` is the name
    under which an image's ``psf_includes`` may say that the effect is in it already.

    Examples
    --------
    >>> import numpy as np
    >>> from dataclasses import dataclass
    >>> from miricigale.detector import ADConversion, Detector, Effect, Photons
    >>> @dataclass(frozen=True)
    ... class Glow(Effect):
    ...     rate: float = 2.0
    ...     def apply(self, ramp, block):
    ...         time = block.group_time * (1 + np.arange(ramp.shape[1]))
    ...         return ramp + self.rate * time[:, None, None]
    >>> Detector((Photons(), Glow(rate=5.0), ADConversion())).effects[1]
    Glow(rate=5.0)
    """

    halo = 0
    included_as = None

    def record(self):
        """
        Name and settings of the effect, for files.

        Returns
        -------
        record : dict
            ``effect``, the name of the class, and the settings by name.
        """
        return {"effect": type(self).__name__, **dataclasses.asdict(self)}

    def apply(self, array, block):
        """
        Return the array as it is after the effect.

        Parameters
        ----------
        array : `~numpy.ndarray`
            Surface brightness (n_row, n_col) or ramp (n_int, n_group, n_row, n_col); may
            be changed in place.
        block : `Block`
            Where and when.

        Returns
        -------
        array : `~numpy.ndarray`
        """
        raise NotImplementedError

    def expected(self, array, block):
        """
        Return what the effect makes of the light or of the mean rate of charge.

        A forecast asks for it instead of a ramp; what an effect does not change, or only
        with mean zero, it leaves as it is.

        Parameters
        ----------
        array : `~numpy.ndarray`, shape (n_row, n_col)
            Surface brightness (MJy/sr) until `Photons`, electrons per second from there on.
        block : `Block`
            Where and when; its flags are not used.

        Returns
        -------
        array : `~numpy.ndarray`, shape (n_row, n_col)
        """
        return array

    def limit(self, properties):
        """
        Return the charge from which the effect flags a group as saturated.

        Parameters
        ----------
        properties : `~miricigale.instrument.DetectorProperties`
            Full well, gain and the rest.

        Returns
        -------
        electrons : float
            Infinite for effects that do not.
        """
        return np.inf


@dataclasses.dataclass(frozen=True)
class OtherEffect(Effect):
    """
    An effect of a ramp that was read from a file and that this package does not have.

    Parameters
    ----------
    name : str
        Name of its class.
    settings : tuple of (str, object)
        Its settings.

    Examples
    --------
    >>> from miricigale.detector import OtherEffect
    >>> OtherEffect("Glow", (("rate", 2.0),)).record()
    {'effect': 'Glow', 'rate': 2.0}
    """

    name: str
    settings: tuple = ()

    def record(self):
        """See `Effect.record`."""
        return {"effect": self.name, **dict(self.settings)}
