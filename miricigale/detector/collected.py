"""What the pixels of an exposure collect in its whole time: what rates are drawn from."""

import numpy as np

from miricigale.detector.effects.base import Timed
from miricigale.detector.effects.readout import Bias, Nonlinearity, ReadNoise
from miricigale.detector.effects.reset import FirstFrame, LastFrame, ResetAnomaly
from miricigale.instrument import DetectorProperties, Exposure, ExposureHistory
from miricigale.utils.values import value_class


@value_class
class Charge(Timed):
    """
    What the pixels of one exposure collect, and how it is read.

    It stands for a `Ramp` where no group is needed: `~miricigale.reduction.Reducer.fit_ramp`
    draws from it the slopes that it would fit to the ramp. `Detector.collect` makes it.

    Parameters
    ----------
    exposure : `~miricigale.instrument.Exposure`
        What was exposed.
    mean : `~numpy.ndarray`, shape (ny, nx)
        Expected electrons per second, without hits; NaN where a pixel sees no light.
    electrons : `~numpy.ndarray`, shape (ny, nx)
        Electrons collected in all groups of all integrations, without hits.
    hits : `~numpy.ndarray` of int32, shape (3, n)
        Group (counted through all integrations), row and column of each deposit of a cosmic
        ray; those of a pixel are in the order of the groups, and may be several in one.
    hit_electrons : `~numpy.ndarray`, shape (n,)
        Their charge in electrons.
    pixel_dq : `~numpy.ndarray` of uint32, shape (ny, nx)
        Flags of pixels, bits as in `~miricigale.instrument.DQ`.
    effects : tuple of `Effect`
        What acted on the light, acts on the charge and on its read-out, in order.
    properties : `~miricigale.instrument.DetectorProperties`
        Of the detector.
    seed : int
        Of what the read-out draws.
    meta : dict
        Where it came from.

    Examples
    --------
    >>> import numpy as np
    >>> import astropy.units as u
    >>> from miricigale import Detector, Exposure
    >>> exposure = Exposure("F770W", n_groups=10, subarray="SUB64", pointing="53 -27")
    >>> sky = np.full(exposure.shape, 5.0) * u.MJy / u.sr
    >>> charge = Detector.miri_imager().collect(sky, exposure, seed=1)
    >>> print(f"{np.nanmedian(charge.mean):.1f} electrons per second")
    56.8 electrons per second
    """

    exposure: Exposure
    mean: np.ndarray
    electrons: np.ndarray
    hits: np.ndarray
    hit_electrons: np.ndarray
    pixel_dq: np.ndarray
    effects: tuple
    properties: DetectorProperties
    seed: int
    meta: dict

    def shows(self, kind):
        """Tell whether an effect acted, as for `Ramp.shows`."""
        return self._effect(kind) is not None

    @property
    def history(self):
        """The package's Detector collected it, and nothing was done to it since."""
        return ExposureHistory(origin="simulated")

    @property
    def read_variance(self):
        """Variance of one read in DN squared: read noise and rounding."""
        effect = self._effect(ReadNoise)
        sigma = 0.0
        if effect is not None:
            sigma = effect.deviation(self.properties)
        return sigma**2 + 1 / 12

    @property
    def level(self):
        """Level of an empty pixel in each group, DN, the mean over the integrations, (n_group,)."""
        shape = (self.exposure.n_integrations, self.exposure.n_groups)
        level = np.zeros(shape)
        if (bias := self._effect(Bias)) is not None:
            level += bias.mean(self.properties)
        if (anomaly := self._effect(ResetAnomaly)) is not None:
            level += anomaly.offsets(*shape)
        for kind, group in ((FirstFrame, 0), (LastFrame, -1)):
            if (effect := self._effect(kind)) is not None:
                level[:, group] += effect.offset
        return level.mean(axis=0)

    def measured(self, electrons):
        """Return the DN above the level that charges read."""
        dn = np.asarray(electrons, float) / self.properties.gain
        effect = self._effect(Nonlinearity)
        if effect is None:
            return dn
        return effect.response(dn, self.properties)

    def limit(self, dn):
        """Return the charge in electrons that reads ``dn`` above the level, or at which the pixel is full."""
        effect = self._effect(Nonlinearity)
        linear = dn
        if effect is not None:
            linear = float(effect.linear_dn(dn, self.properties))
        full = min(effect.limit(self.properties) for effect in self.effects)
        return min(self.properties.gain * linear, full)

    def _effect(self, kind):
        return next((effect for effect in self.effects if isinstance(effect, kind)), None)

    def __repr__(self):
        e = self.exposure
        ny, nx = self.mean.shape
        return (
            f"<Charge {e.filter}: {e.n_integrations} integration(s) x {e.n_groups} groups, "
            f"{ny} x {nx} pixels, {len(self.hit_electrons)} deposits of cosmic rays>"
        )
