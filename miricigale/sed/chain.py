"""The chain of components worked out on one grid of rest wavelengths: arrays only."""

import functools
from dataclasses import dataclass

import numpy as np

from miricigale.sed import _core
from miricigale.sed.component import ROLES

__all__ = ["Attenuated", "Chain", "Galaxy", "Stars"]

INFRARED = (3.0, 1000.0)  # um
SIX = 6.0  # um


@dataclass(frozen=True, eq=False)
class Stars:
    """Stellar light for one solar mass formed: L_lambda in W/um, masses and rates."""

    young: np.ndarray
    old: np.ndarray
    stellar_mass: float
    sfr: float
    sfr_10myr: float
    sfr_100myr: float


@dataclass(frozen=True, eq=False)
class Attenuated:
    """Starlight behind dust, L_lambda in W/um, and the power in W that the dust took."""

    light: np.ndarray
    intrinsic: np.ndarray
    absorbed: float


@dataclass(frozen=True, eq=False)
class Galaxy:
    """A galaxy without its nucleus, for one solar mass formed."""

    stars: Stars
    starlight: Attenuated
    dust: np.ndarray
    dust_luminosity: float

    @property
    def light(self):
        """L_lambda of stars and dust in W/um."""
        return self.starlight.light + self.dust


class Chain:
    """
    Components in order, on the union of their nodes.

    Parameters
    ----------
    components : dict of str to `~miricigale.sed.Component`
        By role.

    Attributes
    ----------
    wave : `~numpy.ndarray`, shape (n_wave,)
        Rest wavelengths in um.
    """

    def __init__(self, components):
        self.by_role = {role: components.get(role) for role in ROLES}
        parts = [c.nodes() for c in components.values() if len(c.nodes())]
        wave = _core.merge_nodes([*parts, [SIX, *INFRARED]])
        wave.flags.writeable = False
        self.wave = wave
        self._to_lnu = wave**2 / _core.LIGHT
        low, high = np.searchsorted(wave, np.array(INFRARED) * (1 - 1e-9))
        self._infrared = slice(int(low), int(high) + 1)
        self._six = int(np.searchsorted(wave, SIX * (1 - 1e-9)))
        self._stellar_hat = _core.hat_matrix(np.asarray(components["stellar"].nodes()), wave)
        self._keys = {
            role: tuple(part.parameters) if part else () for role, part in self.by_role.items()
        }
        self._factors = functools.lru_cache(maxsize=64)(self._make_factors)
        self._stars = functools.lru_cache(maxsize=64)(self._make_stars)
        self._starlight = functools.lru_cache(maxsize=256)(self._make_starlight)
        self._dust = functools.lru_cache(maxsize=256)(self._make_dust)
        self._agn = functools.lru_cache(maxsize=256)(self._make_agn)

    # values of the parameters of some roles, as a key for the caches
    def key(self, values, *roles):
        """Values of all parameters of these roles, as a tuple."""
        return tuple(values[name] for role in roles for name in self._keys[role])

    def _dict(self, key, *roles):
        names = [name for role in roles for name in self._keys[role]]
        return dict(zip(names, key, strict=True))

    def _make_stars(self, key):
        values = self._dict(key, "sfh", "stellar")
        history = self.by_role["sfh"].history(values)
        stellar = self.by_role["stellar"]
        _, spectra, living = stellar.table(values["metallicity"])
        young, old = stellar.age_weights(history, values["metallicity"])
        return Stars(
            young=self._stellar_hat @ (young @ spectra),
            old=self._stellar_hat @ (old @ spectra),
            stellar_mass=float((young + old) @ living),
            sfr=float(history[-1]),
            sfr_10myr=float(history[-10:].mean()),
            sfr_100myr=float(history[-100:].mean()),
        )

    def stars(self, values):
        """`Stars` for a dict of values."""
        return self._stars(self.key(values, "sfh", "stellar"))

    def _make_factors(self, key):
        return self.by_role["attenuation"].factors(self.wave, self._dict(key, "attenuation"))

    def _make_starlight(self, star_key, key):
        stars = self._stars(star_key)
        intrinsic = stars.young + stars.old
        if self.by_role["attenuation"] is None:
            return Attenuated(intrinsic, intrinsic, 0.0)
        young, old = self._factors(key)
        light = stars.young * young + stars.old * old
        return Attenuated(light, intrinsic, float(np.trapezoid(intrinsic - light, self.wave)))

    def starlight(self, values):
        """`Attenuated` starlight for a dict of values."""
        return self._starlight(self.key(values, "sfh", "stellar"), self.key(values, "attenuation"))

    def _make_dust(self, key):
        template = self.by_role["dust"].template(self.wave, **self._dict(key, "dust"))
        # one watt on this grid too, where the step at the first node is a slope
        return template / np.trapezoid(template, self.wave)

    def dust(self, values):
        """Dust spectrum in W/um for one watt; zeros without a dust component."""
        if self.by_role["dust"] is None:
            return np.zeros(self.wave.size)
        return self._dust(self.key(values, "dust"))

    def galaxy(self, values):
        """`Galaxy` for a dict of values."""
        starlight = self.starlight(values)
        dust = starlight.absorbed * self.dust(values)
        return Galaxy(self.stars(values), starlight, dust, starlight.absorbed)

    def _make_agn(self, key):
        return self.by_role["agn"].templates(self.wave, self._dict(key, "agn"))

    def agn(self, values):
        """`~miricigale.sed.components.AGNTemplates` for a dict of values, whatever its fraction."""
        agn = self.by_role["agn"]
        changed = values | {"frac_agn": 0.0}
        for name in agn.inert(values):
            changed[name] = agn.parameters[name].default
        return self._agn(self.key(changed, "agn"))

    def transmission(self, redshift):
        """Transmission of the intergalactic medium at every rest wavelength."""
        igm = self.by_role["igm"]
        if igm is None:
            return np.ones(self.wave.size)
        return igm.transmission(self.wave * (1.0 + redshift), redshift)

    def infrared(self, spectrum):
        """Integral over 3-1000 um of L_lambda, along the last axis."""
        part = self._infrared
        return np.trapezoid(spectrum[..., part], self.wave[part], axis=-1)

    def six_micron(self, spectrum):
        """Power nu L_nu at 6 um."""
        return spectrum[..., self._six] * SIX

    def lnu(self, spectrum):
        """L_nu in W/Hz from L_lambda in W/um."""
        return spectrum * self._to_lnu
