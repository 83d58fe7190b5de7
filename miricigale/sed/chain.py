"""The chain of components worked out on one grid of rest wavelengths: arrays only."""

import functools
from dataclasses import dataclass

import numpy as np

from miricigale.filters import FilterSet
from miricigale.sed import _core
from miricigale.sed.component import ROLES

__all__ = ["COLOURS", "Attenuated", "Chain", "Galaxy", "Stars"]

#: Version of the numbers that follow from the components: raised when the chain, the derived
#: quantities or the grids change, so that grids kept on the disk are made anew.
VERSION = 1

INFRARED = (3.0, 1000.0)  # um
SIX = 6.0  # um
VISUAL = 0.55  # um, where A_V and the light-weighted age are taken
#: The ten windows of Calzetti, Kinney & Storchi-Bergmann 1994, table 2 (um).
UV_WINDOWS = (
    (0.1268, 0.1284),
    (0.1309, 0.1316),
    (0.1342, 0.1371),
    (0.1407, 0.1515),
    (0.1562, 0.1583),
    (0.1677, 0.1740),
    (0.1760, 0.1833),
    (0.1866, 0.1890),
    (0.1930, 0.1950),
    (0.2400, 0.2580),
)
#: Bands of the rest-frame colours.
COLOUR_BANDS = {
    "nuv": "sedpy.galex_NUV",
    "u": "sedpy.bessell_U",
    "v": "sedpy.bessell_V",
    "r": "sedpy.sdss_r0",
    "j": "sedpy.twomass_J",
}
#: Rest-frame colours: name to the two bands.
COLOURS = {"nuv_r": ("nuv", "r"), "u_v": ("u", "v"), "v_j": ("v", "j")}


@dataclass(frozen=True, eq=False)
class Stars:
    """
    Light of stars and of the gas they ionise, for one solar mass formed.

    Spectra are L_lambda in W/um; ``nebular_young`` and ``nebular_old`` are the gas's part
    of ``young`` and ``old``; ``dust_power`` in W is what dust takes of the ionising light;
    ages are in Gyr, rates in Msun/yr, masses in Msun.
    """

    young: np.ndarray
    old: np.ndarray
    nebular_young: np.ndarray | None
    nebular_old: np.ndarray | None
    dust_power: float
    stellar_mass: float
    sfr: float
    sfr_10myr: float
    sfr_100myr: float
    age_mass: float
    age_light: float


@dataclass(frozen=True, eq=False)
class Attenuated:
    """Starlight behind dust, L_lambda in W/um, and the power in W that the dust took."""

    light: np.ndarray
    intrinsic: np.ndarray
    nebular: np.ndarray | None
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


def trapezoid_weights(wave):
    """Weights of the trapezoid rule: ``weights @ spectrum`` is its integral."""
    weights = np.zeros(wave.size)
    weights[:-1] += 0.5 * np.diff(wave)
    weights[1:] += 0.5 * np.diff(wave)
    return weights


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
    weights : `~numpy.ndarray`, shape (n_wave,)
        Weights of the trapezoid rule on them.
    """

    def __init__(self, components):
        self.by_role = {role: components.get(role) for role in ROLES}
        parts = [c.nodes() for c in components.values() if len(c.nodes())]
        limit = _core.LYMAN_LIMIT * np.array([1 - 1e-5, 1 + 1e-5])
        windows = np.ravel(UV_WINDOWS)
        wave = _core.merge_nodes([*parts, [SIX, VISUAL, *INFRARED], limit, windows])
        wave.flags.writeable = False
        self.wave = wave
        self.log_wave = np.log(wave)
        self.weights = trapezoid_weights(wave)
        self.to_lnu = wave**2 / _core.LIGHT
        self._ionising = wave < _core.LYMAN_LIMIT
        self._at = {x: int(np.searchsorted(wave, x * (1 - 1e-9))) for x in (SIX, VISUAL, *INFRARED)}
        self._functionals()
        self._keys = {
            role: tuple(part.parameters) if part else () for role, part in self.by_role.items()
        }
        self._caches()

    def _caches(self):
        self._table = functools.lru_cache(maxsize=8)(self._make_table)
        self._factors = functools.lru_cache(maxsize=256)(self._make_factors)
        self._gas_factors = functools.lru_cache(maxsize=256)(self._make_gas_factor)
        self._stars = functools.lru_cache(maxsize=64)(self._make_stars)
        self._starlight = functools.lru_cache(maxsize=256)(self._make_starlight)
        self._dust = functools.lru_cache(maxsize=256)(self._make_dust)
        self._agn = functools.lru_cache(maxsize=256)(self._make_agn)
        self._sky = functools.lru_cache(maxsize=64)(self._make_sky)

    def _functionals(self):
        """Everything derived from a galaxy's light by a sum over wavelengths, in one matrix."""
        wave, n = self.wave, self.wave.size
        infrared = np.zeros(n)
        part = slice(self._at[INFRARED[0]], self._at[INFRARED[1]] + 1)
        infrared[part] = trapezoid_weights(wave[part])
        windows = np.zeros((len(UV_WINDOWS), n))
        for row, (low, high) in zip(windows, UV_WINDOWS, strict=True):
            first, last = np.searchsorted(wave, [low * (1 - 1e-9), high * (1 + 1e-9)])
            row[first:last] = trapezoid_weights(wave[first:last]) / (high - low)
        bands = FilterSet.from_names(list(COLOUR_BANDS.values())).weights(wave) * self.to_lnu
        visual = np.zeros((1, n))
        visual[0, self._at[VISUAL]] = 1.0
        self.functionals = np.concatenate([infrared[None], visual, windows, bands])

    # values of the parameters of some roles, as a key for the caches
    def names(self, *roles):
        """Names of the parameters of these roles."""
        return tuple(name for role in roles for name in self._keys[role])

    def key(self, values, *roles):
        """Values of all parameters of these roles, as a tuple."""
        return tuple(values[name] for name in self.names(*roles))

    def _dict(self, key, *roles):
        return dict(zip(self.names(*roles), key, strict=True))

    # ------------------------------------------------------------------ stars

    def _make_table(self, metallicity):
        """Ages, spectra on our grid, living mass and ionising photons of one metallicity."""
        stellar = self.by_role["stellar"]
        age, spectra, living = stellar.table(metallicity)
        matrix = _core.hat_matrix(np.asarray(stellar.nodes()), self.wave)
        spectra = np.ascontiguousarray((matrix @ np.asarray(spectra, dtype=float).T).T)
        ionising = stellar.ionizing(metallicity) if self.by_role["nebular"] else None
        return age, spectra, living, ionising

    @functools.cached_property
    def _nebular_hat(self):
        return _core.hat_matrix(np.asarray(self.by_role["nebular"].nodes()), self.wave)

    def _make_stars(self, key):
        return self.stars_of([key])[0]

    def stars_of(self, keys):
        """
        `Stars` of several histories at once.

        Parameters
        ----------
        keys : list of tuple
            As `key` gives them for ``sfh``, ``stellar`` and ``nebular``.
        """
        values = [self._dict(key, "sfh", "stellar", "nebular") for key in keys]
        out = [None] * len(keys)
        for metallicity in {v["metallicity"] for v in values}:
            rows = [i for i, v in enumerate(values) if v["metallicity"] == metallicity]
            for i, stars in zip(
                rows, self._stars_of_metal(metallicity, [values[i] for i in rows]), strict=True
            ):
                out[i] = stars
        return out

    def _stars_of_metal(self, metallicity, values):
        age, spectra, living, ionising = self._table(metallicity)
        sfh, stellar, nebular = (self.by_role[r] for r in ("sfh", "stellar", "nebular"))
        histories = [sfh.history(v) for v in values]
        pairs = [stellar.age_weights(h, v) for h, v in zip(histories, values, strict=True)]
        young, old = (np.array([pair[i] for pair in pairs]) for i in (0, 1))
        young_light, old_light = young @ spectra, old @ spectra
        both = young + old
        visual = spectra[:, self._at[VISUAL]]
        light = both @ visual
        age_light = (both * visual) @ age / np.where(light > 0, light, np.nan) * 1e-3
        age_mass = both @ age / both.sum(axis=1) * 1e-3
        mass = both @ living
        for i, (v, h) in enumerate(zip(values, histories, strict=True)):
            parts = [young_light[i], old_light[i]]
            gas, dusty = [None, None], 0.0
            if nebular is not None:
                hard = sum(self.weights @ (part * self._ionising) for part in parts)
                dusty = v["f_dust"] * float(hard)
                passed = np.where(self._ionising, v["f_esc"], 1.0)
                gas = [
                    self._nebular_hat @ nebular.spectra(age, w, ionising, v)
                    for w in (young[i], old[i])
                ]
                parts = [part * passed + glow for part, glow in zip(parts, gas, strict=True)]
            for part in (*parts, *(glow for glow in gas if glow is not None)):
                part.flags.writeable = False
            yield Stars(
                young=parts[0],
                old=parts[1],
                nebular_young=gas[0],
                nebular_old=gas[1],
                dust_power=dusty,
                stellar_mass=float(mass[i]),
                sfr=float(h[-1]),
                sfr_10myr=float(h[-10:].mean()),
                sfr_100myr=float(h[-100:].mean()),
                age_mass=float(age_mass[i]),
                age_light=float(age_light[i]),
            )

    def stars(self, values):
        """`Stars` for a dict of values."""
        return self._stars(self.key(values, "sfh", "stellar", "nebular"))

    # ------------------------------------------------------- attenuation and dust

    def _make_factors(self, key):
        attenuation = self.by_role["attenuation"]
        if attenuation is None:
            ones = np.ones(self.wave.size)
            return ones, ones
        return attenuation.factors(self.wave, self._dict(key, "attenuation"))

    def factors(self, key):
        """Transmissions for young and old stars, by the key of ``attenuation``."""
        return self._factors(key)

    def gas_factor(self, key):
        """Transmission for gas by the key of ``attenuation``; None if that of the stars."""
        return self._gas_factors(key)

    def _make_gas_factor(self, key):
        attenuation = self.by_role["attenuation"]
        if attenuation is None or self.by_role["nebular"] is None:
            return None
        return attenuation.gas_factor(self.wave, self._dict(key, "attenuation"))

    def _make_starlight(self, star_key, key):
        return self.attenuate(self._stars(star_key), key)

    def attenuate(self, stars, key):
        """`Attenuated` light of `Stars` behind the dust of a key of ``attenuation``."""
        young, old = self._factors(key)
        intrinsic = stars.young + stars.old
        light = stars.young * young + stars.old * old
        nebular = None
        if stars.nebular_young is not None:
            gas = self.gas_factor(key)
            nebular = stars.nebular_young * (young if gas is None else gas)
            nebular += stars.nebular_old * (old if gas is None else gas)
            if gas is not None:
                light = light - stars.nebular_young * young - stars.nebular_old * old + nebular
        absorbed = float(self.weights @ (intrinsic - light)) + stars.dust_power
        return Attenuated(light, intrinsic, nebular, absorbed)

    def starlight(self, values):
        """`Attenuated` starlight for a dict of values."""
        stars = self.key(values, "sfh", "stellar", "nebular")
        return self._starlight(stars, self.key(values, "attenuation"))

    def _make_dust(self, key):
        if self.by_role["dust"] is None:
            return np.zeros(self.wave.size)
        template = self.by_role["dust"].template(self.wave, **self._dict(key, "dust"))
        # one watt on this grid too, where the step at the first node is a slope
        template = template / (self.weights @ template)
        template.flags.writeable = False
        return template

    def dust(self, values):
        """Dust spectrum in W/um for one watt; zeros without a dust component."""
        return self._dust(self.key(values, "dust"))

    def dust_of(self, key):
        """The same by the key of ``dust``."""
        return self._dust(key)

    def galaxy(self, values):
        """`Galaxy` for a dict of values."""
        starlight = self.starlight(values)
        dust = starlight.absorbed * self.dust(values)
        return Galaxy(self.stars(values), starlight, dust, starlight.absorbed)

    # ------------------------------------------------------------- AGN and the sky

    def _make_agn(self, key):
        return self.by_role["agn"].templates(self.wave, self._dict(key, "agn"))

    def agn_key(self, values):
        """Values of the AGN's parameters, those without effect at their defaults."""
        agn = self.by_role["agn"]
        changed = values | {"frac_agn": 0.0}
        for name in agn.inert(changed):
            changed[name] = agn.parameters[name].default
        return self.key(changed, "agn")

    def agn_of(self, key):
        """`~miricigale.sed.components.AGNTemplates` by a key of `agn_key`."""
        return self._agn(key)

    def agn(self, values):
        """`~miricigale.sed.components.AGNTemplates` for a dict of values, whatever its fraction."""
        return self._agn(self.agn_key(values))

    def _make_sky(self, redshift, key):
        observed = self.wave * (1.0 + redshift)
        igm, foreground = self.by_role["igm"], self.by_role["foreground"]
        values = self._dict(key, "igm", "foreground")
        out = np.ones(self.wave.size)
        if igm is not None:
            own = {name: values[name] for name in igm.parameters}
            out = igm.transmission(observed, redshift, **own)
        if foreground is not None:
            out = out * foreground.transmission(observed, values)
        return out

    def sky(self, values):
        """Transmission between the source and us at every rest wavelength."""
        return self._sky(values["redshift"], self.key(values, "igm", "foreground"))

    def sky_of(self, redshift, key):
        """The same by redshift and the key of ``igm`` and ``foreground``."""
        return self._sky(redshift, key)

    # --------------------------------------------------------------- derived values

    def infrared(self, spectrum):
        """Integral over 3-1000 um of L_lambda, along the last axis."""
        return spectrum @ self.functionals[0]

    def six_micron(self, spectrum):
        """Power nu L_nu at 6 um."""
        return spectrum[..., self._at[SIX]] * SIX

    def visual(self, spectrum):
        """L_lambda at 0.55 um."""
        return spectrum[..., self._at[VISUAL]]

    def lnu(self, spectrum):
        """L_nu in W/Hz from L_lambda in W/um."""
        return spectrum * self.to_lnu
