"""What every nucleus has: disk, torus and polar dust."""

from dataclasses import dataclass

import numpy as np

from miricigale.sed import _core
from miricigale.sed.component import Component
from miricigale.sed.parameter import Parameter

__all__ = ["AGN", "DISK_MEAN", "AGNTemplates", "TorusSpectra"]

#: Mean over the sphere of cos i (1 + 2 cos i) / 3: a disk's light over its face-on value.
DISK_MEAN = 7.0 / 18.0


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

    Polar dust with an SMC law, k = 1.39 (lambda / um)^-1.2, dims the disk where the line of sight
    misses the torus (i <= 90 deg - opening angle). What it takes from the disk over its cone,
    (7/18 - sin^2 oa / 6 - 2 sin^3 oa / 9) int disk (1 - 10^(-0.4 k E)), it sends out evenly as
    a modified blackbody; torus and polar emission together are then scaled to 1 W.
    """

    role = "agn"
    frac_agn = Parameter(
        default=0.0, bounds=(0.0, 0.999), doc="AGN fraction, in the model's definition."
    )
    inclination = Parameter(
        default=70.0, bounds=(0.0, 90.0), unit="deg", doc="Angle between axis and line of sight."
    )
    opening_angle = Parameter(
        default=40.0, bounds=(10.0, 80.0), unit="deg",
        doc="Angle between the equator and the edge of the torus.",
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

        Returns
        -------
        templates : `AGNTemplates`
        """
        base = self.torus_spectra(wave, values)
        disk, polar = base.disk, np.zeros(wave.size)
        if values["ebv_polar"] > 0.0:
            law = 1.39 * wave**-1.2
            transmission = 10.0 ** (-0.4 * law * values["ebv_polar"])
            if values["inclination"] <= 90.0 - values["opening_angle"]:
                disk = disk * transmission
            s = np.sin(np.radians(values["opening_angle"]))
            share = DISK_MEAN - s**2 / 6.0 - 2.0 * s**3 / 9.0
            absorbed = share * np.trapezoid(base.face_on * (1.0 - transmission), wave)
            polar = _core.modified_blackbody(
                wave, values["temperature_polar"], values["emissivity_polar"]
            )
            polar *= absorbed / np.trapezoid(polar, wave)
        norm = 1.0 / np.trapezoid(base.dust + polar, wave)
        power = norm * DISK_MEAN * np.trapezoid(base.face_on, wave)
        return AGNTemplates(disk * norm, base.dust * norm, polar * norm, float(power))

    def inert(self, values):
        polar = values["ebv_polar"] == 0.0
        return ("temperature_polar", "emissivity_polar") if polar else ()
