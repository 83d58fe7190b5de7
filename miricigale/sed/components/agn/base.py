"""What every nucleus has: disk, torus and polar dust."""

import functools
from dataclasses import dataclass

import numpy as np

from miricigale.sed import _core
from miricigale.sed._core import DISK_MEAN
from miricigale.sed.component import Component
from miricigale.sed.parameter import Parameter
from miricigale.utils.exceptions import argument_error

__all__ = ["AGN", "DISK_MEAN", "AGNTemplates", "TorusSpectra"]


@dataclass(frozen=True, eq=False)
class TorusSpectra:
    """
    What a torus library says for one set of parameters, in W/um on a common scale.

    Parameters
    ----------
    face_on : `~numpy.ndarray`
        The disk without obscuration, seen from above.
    disk : `~numpy.ndarray`
        Disk light seen at the inclination, direct and scattered.
    dust : `~numpy.ndarray`
        Dust emission seen at the inclination.
    """

    face_on: np.ndarray
    disk: np.ndarray
    dust: np.ndarray


@dataclass(frozen=True, eq=False)
class AGNTemplates:
    """
    Spectra for one watt of AGN dust emission (torus + polar), in W/um.

    Parameters
    ----------
    disk, torus, polar : `~numpy.ndarray`
        The parts as seen; torus + polar integrate to 1 W.
    accretion_power : float
        Luminosity of the disk over all directions, in W for each W of dust emission.
    """

    disk: np.ndarray
    torus: np.ndarray
    polar: np.ndarray
    accretion_power: float

    @property
    def total(self):
        """Sum of the parts."""
        return self.disk + self.torus + self.polar


class AGN(Component):
    """
    Base of nuclei with a torus and polar dust; a subclass gives `torus_spectra`.

    Polar dust (option ``polar_law``: ``smc``, ``calzetti`` or ``gaskell``) dims the disk where the
    line of sight misses the torus (i <= 90 deg - opening angle). What it takes from the disk
    over its cone, (7/18 - sin^2 oa / 6 - 2 sin^3 oa / 9) int disk (1 - 10^(-0.4 k E)), it sends
    out evenly as a modified blackbody, (1 - exp(-(200 um / lambda)^beta)) B_lambda(T); torus
    and polar emission together are then scaled to 1 W (Yang et al. 2020, MNRAS 491, 740).

    The disk (option ``disk``) is a power law between breaks; ``disk_slope`` changes its slope
    in the optical and keeps its power. The torus's emission does not follow such changes.
    """

    role = "agn"
    options = {"polar_law": _core.POLAR_LAWS, "disk": tuple(_core.DISKS)}
    frac_agn = Parameter(
        default=0.0, bounds=(0.0, 0.999999), doc="AGN fraction, in the model's definition."
    )
    inclination = Parameter(
        default=70.0, bounds=(0.0, 90.0), unit="deg", doc="Angle between axis and line of sight."
    )
    opening_angle = Parameter(
        default=40.0, bounds=(10.0, 80.0), unit="deg",
        doc="Angle between the equator and the edge of the torus.",
    )  # fmt: skip
    disk_slope = Parameter(
        default=0.0, bounds=(-1.0, 1.0),
        doc="Added to the disk's optical slope, L_lambda ~ lambda^(-1.5 + disk_slope).",
    )  # fmt: skip
    ebv_polar = Parameter(
        default=0.1, bounds=(0.0, 3.0), unit="mag", doc="Colour excess of the polar dust."
    )
    temperature_polar = Parameter(
        default=100.0, bounds=(20.0, 1500.0), unit="K", doc="Temperature of the polar dust."
    )
    emissivity_polar = Parameter(
        default=1.6, bounds=(0.5, 3.0), doc="Emissivity index of the polar dust."
    )

    def torus_spectra(self, wave, values):
        """
        Disk and torus of the library.

        Parameters
        ----------
        wave : `~numpy.ndarray`
            Rest wavelengths in um.
        values : dict
            Values of all parameters of the component.

        Returns
        -------
        spectra : `TorusSpectra`
        """
        raise NotImplementedError

    def templates(self, wave, values):
        """
        Spectra for one watt of dust emission.

        Parameters
        ----------
        wave : `~numpy.ndarray`
            Rest wavelengths in um, ascending, from the disk's beginning to where dust is dark.
        values : dict
            Values of all parameters of the component.

        Returns
        -------
        templates : `AGNTemplates`

        Raises
        ------
        ValueError
            If the wavelengths hold no dust emission.
        """
        base = self.torus_spectra(wave, values)
        opening = values["opening_angle"]
        parts, power, total = _core.add_polar(
            _polar_grid(wave.tobytes(), self.polar_law), base.face_on, base.disk, base.dust,
            float(values["ebv_polar"]), float(values["temperature_polar"]),
            float(values["emissivity_polar"]), _core.polar_share(opening),
            values["inclination"] <= 90.0 - opening,
        )  # fmt: skip
        if not total > 0.0:
            raise argument_error("wave", "a grid that holds the dust emission", _span(wave))
        return AGNTemplates(parts[0], parts[1], parts[2], power)

    def inert(self, values):
        polar = values["ebv_polar"] == 0.0
        return ("temperature_polar", "emissivity_polar") if polar else ()


@functools.lru_cache(maxsize=16)
def _polar_grid(wave_bytes, law):
    return _core.polar_grid(np.frombuffer(wave_bytes), law)


def _span(wave):
    return f"{wave.size} points from {wave[0]:g} to {wave[-1]:g} um"
