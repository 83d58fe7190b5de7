"""Charge of cosmic rays."""

import dataclasses

import numpy as np

from miricigale.detector._core.charge import add_cosmic_rays, cosmic_ray_deposits
from miricigale.detector.effects.base import Effect, check_amounts, check_share


@dataclasses.dataclass(frozen=True)
class CosmicRays(Effect):
    """
    Hits by cosmic rays: straight tracks through a layer, leakage, showers if asked for.

    Particles arrive isotropically, so that the cosine of the angle of incidence is
    distributed as 2 cos; a track crosses thickness x tan(angle) of the detector plane and
    sets charge free in proportion to its length in the layer. The charge per length is
    log-normal. With the defaults half of the hits leave more than 5000 electrons, 1 % more
    than 10^5. Of each pixel's charge the share ``leakage`` goes to each of its four
    neighbors (this stands in for `InterpixelCapacitance`, which acts before).

    Parameters
    ----------
    flux : float, optional
        Hits per um^2 and s; that of the detector's properties if not given (4.9e-8 at
        solar minimum times 1.7).
    thickness : float, optional
        Thickness of the sensitive layer in um.
    yield_median : float, optional
        Median electrons per um of path.
    yield_dex : float, optional
        Scatter of that yield in dex.
    track_max : float, optional
        Longest track in pixels; longer ones are cut there.
    leakage : float, optional
        Share of the charge that goes to each of the four neighbors.
    shower_fraction : float, optional
        Share of hits that come with a shower, a faint Gaussian cloud; 0 for none.
    shower_above : float, optional
        Electrons that a hit leaves at least, if it is to come with a shower: those of MIRI follow
        large hits.
    shower_charge : float, optional
        Median charge of a shower in electrons.
    shower_sigma : float, optional
        Its Gaussian width in pixels; painted to three times that.

    Examples
    --------
    >>> import numpy as np
    >>> import astropy.units as u
    >>> from miricigale import Detector, Exposure
    >>> exposure = Exposure("F770W", n_groups=10, subarray="SUB64", pointing="53 -27")
    >>> sky = np.full(exposure.shape, 5.0) * u.MJy / u.sr
    >>> from miricigale.detector import CosmicRays
    >>> quiet, active = (
    ...     Detector.miri_imager(CosmicRays(flux=flux)).collect(sky, exposure, seed=1)
    ...     for flux in (0.0, 1e-6)
    ... )
    >>> len(quiet.hit_electrons), len(active.hit_electrons)
    (0, 5)
    """

    flux: float | None = None
    thickness: float = 35.0
    yield_median: float = 100.0
    yield_dex: float = 0.5
    track_max: float = 16.0
    leakage: float = 0.03
    shower_fraction: float = 0.0
    shower_charge: float = 3e5
    shower_sigma: float = 15.0
    shower_above: float = 0.0

    def __post_init__(self):
        for name in ("flux", "yield_median", "yield_dex", "shower_charge", "shower_above"):
            check_amounts(**{name: getattr(self, name)})
        check_amounts(above_zero=True, thickness=self.thickness, shower_sigma=self.shower_sigma)
        check_share("leakage", self.leakage, 0.2)
        check_share("shower_fraction", self.shower_fraction)
        check_share("track_max", self.track_max, 200)

    def apply(self, ramp, block):
        """Add the charge of the hits."""
        add_cosmic_rays(ramp, *self._arguments(block))
        return ramp

    def hits(self, block):
        """
        List the charge of the hits that `apply` adds.

        Parameters
        ----------
        block : `Block`
            Where and when; its flags give the shape alone.

        Returns
        -------
        places : `~numpy.ndarray` of int32, shape (3, n)
            Group, counted through all integrations, row of the detector and column of each
            deposit, in the order of the groups.
        electrons : `~numpy.ndarray`, shape (n,)
            A pixel may have several in one group.
        """
        key, first, n_rows, settings = self._arguments(block)
        places, electrons = cosmic_ray_deposits(key, first, n_rows, block.ramp_shape, settings)
        places[1] += first
        return places, electrons

    def _arguments(self, block):
        """Return the arguments of the kernels."""
        properties = block.properties
        if self.flux is None:
            flux = properties.cosmic_ray_flux
        else:
            flux = self.flux
        pitch = properties.pixel_pitch
        hits_per_row = flux * pitch**2 * block.ramp_shape[3] * block.total_time
        track = self.thickness / pitch, self.yield_median * pitch, self.yield_dex * np.log(10.0)
        shower = self.shower_fraction, self.shower_charge, self.shower_sigma, self.shower_above
        settings = (hits_per_row, *track, self.track_max, self.leakage, *shower)
        return block.key, block.rows.start, block.exposure.shape[0], tuple(map(float, settings))
