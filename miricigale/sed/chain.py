"""The chain of components worked out on one grid of rest wavelengths: arrays only."""

import functools
from dataclasses import dataclass

import numpy as np

from miricigale.filters import FilterSet
from miricigale.sed import _core
from miricigale.sed.component import ROLES

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
#: Bands of the rest-frame colors.
COLOR_BANDS = {
    "nuv": "sedpy.galex_NUV",
    "u": "sedpy.bessell_U",
    "v": "sedpy.bessell_V",
    "r": "sedpy.sdss_r0",
    "j": "sedpy.twomass_J",
}
#: Rest-frame colors: name to the two bands.
COLORS = {"nuv_r": ("nuv", "r"), "u_v": ("u", "v"), "v_j": ("v", "j")}

#: Roles whose parameters together shape stars with their gas, the parts of a galaxy, and what lies
#: between the source and us.
STELLAR = ("sfh", "stellar", "nebular")
GALAXY = (STELLAR, ("attenuation",), ("dust",))
SKY = ("igm", "foreground")
MAX_HISTORIES = 128  # stars of so many histories are kept
#: Results that each of these methods of `Chain` keeps.
MAX_KEPT = 256
_KEEPING = ("_populations", "factors", "dust", "agn_templates", "sky_transmission")


@dataclass(frozen=True, eq=False)
class Stars:
    """
    Light of stars and of the gas they ionize, for one solar mass formed.

    Spectra are L_lambda in W/um; ``nebular_young`` and ``nebular_old`` are the gas's part
    of ``young`` and ``old``; ``dust_power`` in W is what dust takes of the ionizing light;
    ``visual`` is L_lambda at 0.55 um; ages are in Gyr, rates in Msun/yr, masses in Msun.
    """

    young: np.ndarray
    old: np.ndarray
    nebular_young: np.ndarray | None
    nebular_old: np.ndarray | None
    dust_power: float
    visual: float
    stellar_mass: float
    sfr: float
    sfr_10myr: float
    sfr_100myr: float
    age_mass: float
    age_light: float


def distinct(items):
    """Different items in the order of their first appearance, and which of them each one is."""
    seen = {}
    index = [seen.setdefault(item, len(seen)) for item in items]
    return list(seen), np.array(index, dtype=np.int64)


class Chain:
    """
    Components in order, on the union of their nodes.

    Values of all parameters of some roles, as a tuple (`key`), stand for what these components
    make; the keys of ``sfh``, ``stellar`` and ``nebular`` together are one.

    Parameters
    ----------
    components : dict of str to `~miricigale.sed.Component`
        By role.
    span : tuple of float, optional
        Range of wavelengths in um whose light AGN fractions refer to.

    Attributes
    ----------
    wave : `~numpy.ndarray`, shape (n_wave,)
        Rest wavelengths in um.
    weights : `~numpy.ndarray`, shape (n_wave,)
        Weights of the trapezoid rule on them.
    functionals : `~numpy.ndarray`, shape (n_functional, n_wave)
        Sums over a galaxy's light: of 3-1000 um, L_lambda at 0.55 um, means of the windows of
        `UV_WINDOWS`, means of `COLOR_BANDS`; of the light in ``span``, if that is another than 3-1000 um.
    reference_row : int
        Which of them is that of the light in ``span``.
    """

    def __init__(self, components, *, span=INFRARED):
        self.by_role = {role: components.get(role) for role in ROLES}
        parts = [c.nodes() for c in components.values() if len(c.nodes())]
        limit = _core.LYMAN_LIMIT * np.array([1 - 1e-5, 1 + 1e-5])
        windows = np.ravel(UV_WINDOWS)
        wave = _core.merge_nodes([*parts, [SIX, VISUAL, *INFRARED, *span], limit, windows])
        wave.flags.writeable = False
        self.wave = wave
        self.log_wave = np.log(wave)
        self.weights = _core.trapezoid_weights(wave)
        self.to_lnu = wave**2 / _core.LIGHT
        self._ionizing = wave < _core.LYMAN_LIMIT
        self.at = {
            x: int(np.searchsorted(wave, x * (1 - 1e-9))) for x in (SIX, VISUAL, *INFRARED, *span)
        }
        self.functionals, self.reference_row = self._functionals(), 0
        if tuple(span) != INFRARED:
            self.functionals = np.concatenate([self.functionals, [self._light_in(span)]])
            self.reference_row = -1
        self._names = {
            role: tuple(part.parameters) if part else () for role, part in self.by_role.items()
        }
        self._stars = {}
        # what was made last is kept, by its arguments, as long as the chain lives
        for name in _KEEPING:
            setattr(self, name, functools.lru_cache(MAX_KEPT)(getattr(self, name)))

    def _functionals(self):
        wave, n = self.wave, self.wave.size
        infrared, visual = self._light_in(INFRARED), np.zeros(n)
        visual[self.at[VISUAL]] = 1.0
        windows = np.zeros((len(UV_WINDOWS), n))
        for row, (low, high) in zip(windows, UV_WINDOWS, strict=True):
            first, last = np.searchsorted(wave, [low * (1 - 1e-9), high * (1 + 1e-9)])
            row[first:last] = _core.trapezoid_weights(wave[first:last]) / (high - low)
        bands = FilterSet.from_names(list(COLOR_BANDS.values())).weights(wave) * self.to_lnu
        return np.concatenate([[infrared, visual], windows, bands])

    def _light_in(self, span):
        """Weights of the integral of L_lambda over a range of wavelengths."""
        weights, part = np.zeros(self.wave.size), slice(self.at[span[0]], self.at[span[1]] + 1)
        weights[part] = _core.trapezoid_weights(self.wave[part])
        return weights

    def names(self, *roles):
        """Names of the parameters of these roles."""
        return tuple(name for role in roles for name in self._names[role])

    def key(self, values, *roles):
        """Values of all parameters of these roles, as a tuple."""
        return tuple(values[name] for name in self.names(*roles))

    def _dict(self, key, *roles):
        return dict(zip(self.names(*roles), key, strict=True))

    # ------------------------------------------------------------------ stars

    def _populations(self, metallicity):
        """Ages, spectra on our grid, surviving mass and ionizing photons of one metallicity."""
        stellar = self.by_role["stellar"]
        age, spectra, surviving = stellar.table(metallicity)
        matrix = _core.hat_matrix(np.asarray(stellar.nodes()), self.wave)
        spectra = np.ascontiguousarray((matrix @ np.asarray(spectra, dtype=float).T).T)
        ionizing = stellar.ionizing(metallicity) if self.by_role["nebular"] else None
        return age, spectra, surviving, ionizing

    @functools.cached_property
    def _nebular_hat(self):
        return _core.hat_matrix(np.asarray(self.by_role["nebular"].nodes()), self.wave)

    def stars(self, keys):
        """`Stars` of several histories at once, by their keys: list, the same one for the same key."""
        known = {key: self._stars[key] for key in keys if key in self._stars}
        new = [key for key in dict.fromkeys(keys) if key not in known]
        values = [self._dict(key, *STELLAR) for key in new]
        for metallicity in {v["metallicity"] for v in values}:
            rows = [i for i, v in enumerate(values) if v["metallicity"] == metallicity]
            made = self._make_stars(metallicity, [values[i] for i in rows])
            known.update(zip([new[i] for i in rows], made, strict=True))
        # histories that follow on one another share what was made last
        self._stars = dict(list((self._stars | known).items())[-MAX_HISTORIES:])
        return [known[key] for key in keys]

    def _make_stars(self, metallicity, values):
        age, spectra, surviving, ionizing = self._populations(metallicity)
        sfh, stellar, nebular = (self.by_role[r] for r in STELLAR)
        histories = [sfh.history(v) for v in values]
        pairs = [stellar.age_weights(h, v) for h, v in zip(histories, values, strict=True)]
        young, old = (np.array([pair[i] for pair in pairs]) for i in (0, 1))
        # sums row by row: what is kept does not depend on what was asked for with it
        young_light, old_light = (_core.weighted_sums(w, spectra) for w in (young, old))
        both = young + old
        bright = both * spectra[:, self.at[VISUAL]]
        light = bright.sum(axis=1)
        age_light = (bright * age).sum(axis=1) / np.where(light > 0, light, np.nan) * 1e-3
        age_mass = (both * age).sum(axis=1) / both.sum(axis=1) * 1e-3
        mass = (both * surviving).sum(axis=1)
        for i, (v, h) in enumerate(zip(values, histories, strict=True)):
            parts = [young_light[i], old_light[i]]
            gas, dusty = [None, None], 0.0
            if nebular is not None:
                hard = sum(self.weights @ (part * self._ionizing) for part in parts)
                dusty = v["f_dust"] * float(hard)
                passed = np.where(self._ionizing, v["f_esc"], 1.0)
                gas = [
                    self._nebular_hat @ nebular.spectra(age, w, ionizing, v)
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
                visual=float((parts[0] + parts[1])[self.at[VISUAL]]),
                stellar_mass=float(mass[i]),
                sfr=float(h[-1]),
                sfr_10myr=float(h[-10:].mean()),
                sfr_100myr=float(h[-100:].mean()),
                age_mass=float(age_mass[i]),
                age_light=float(age_light[i]),
            )

    # ------------------------------------------------------- attenuation and dust

    def factors(self, key):
        """Transmissions for young stars, old stars and gas; None for gas that is as the stars."""
        attenuation, values = self.by_role["attenuation"], self._dict(key, "attenuation")
        if attenuation is None:
            ones = np.ones(self.wave.size)
            return ones, ones, None
        gas = attenuation.gas_factor(self.wave, values) if self.by_role["nebular"] else None
        return *attenuation.factors(self.wave, values), gas

    def attenuated(self, stars, keys, dust_keys=None, out=None):
        """
        Starlight of n galaxies behind dust, and the power that dust took.

        Parameters
        ----------
        stars : sequence of `Stars`
        keys, dust_keys : sequence of tuple
            Keys of ``attenuation``, and of ``dust`` if its light is to be added.
        out : `~numpy.ndarray`, shape (n, n_wave), optional
            To be filled.

        Returns
        -------
        light, absorbed : `~numpy.ndarray`, shape (n, n_wave) and (n,)
            L_lambda in W/um, and W.
        """
        n, none = len(stars), np.zeros((0, self.wave.size))
        some, star = distinct(stars)
        different, dim = distinct(keys)
        dust, dusty = np.zeros((1, self.wave.size)), np.zeros(n, dtype=np.int64)
        if dust_keys is not None:
            dust_keys, dusty = distinct(dust_keys)
            dust = np.array([self.dust(key) for key in dust_keys])
        parts = [np.array([getattr(s, age) for s in some]) for age in ("young", "old")]
        *dims, gas = zip(*map(self.factors, different), strict=True)
        parts, dims = [*parts, none], [*map(np.array, dims), none]
        if gas[0] is not None:
            young, old = (
                np.array([getattr(s, f"nebular_{a}") for s in some]) for a in ("young", "old")
            )
            parts = [parts[0] - young, parts[1] - old, young + old]
            dims[2] = np.array(gas)
        extra = np.array([s.dust_power for s in some])
        out = np.empty((n, self.wave.size)) if out is None else out
        absorbed = np.empty(n)
        _core.mix_light(
            self.weights, *parts, star, *dims, dim, extra, dust, dusty, out, absorbed
        )  # fmt: skip
        return out, absorbed

    def dust(self, key):
        """Dust spectrum in W/um for one watt, by the key of ``dust``; zeros without the component."""
        if self.by_role["dust"] is None:
            return np.zeros(self.wave.size)
        template = self.by_role["dust"].template(self.wave, **self._dict(key, "dust"))
        # one watt on this grid too, where the step at the first node is a slope
        template = template / (self.weights @ template)
        template.flags.writeable = False
        return template

    # ------------------------------------------------------------- AGN and the sky

    def agn_key(self, values):
        """Values of the AGN's parameters, those without effect at their defaults."""
        agn = self.by_role["agn"]
        changed = values | {"frac_agn": 0.0}
        for name in agn.inert(changed):
            changed[name] = agn.parameters[name].default
        return self.key(changed, "agn")

    def agn_templates(self, key):
        """`~miricigale.sed.components.AGNTemplates` by a key of `agn_key`."""
        return self.by_role["agn"].templates(self.wave, self._dict(key, "agn"))

    def agn(self, values):
        """`~miricigale.sed.components.AGNTemplates` for a dict of values, whatever its fraction."""
        return self.agn_templates(self.agn_key(values))

    def sky_transmission(self, redshift, key):
        """Transmission between the source and us, by the key of ``igm`` and ``foreground``."""
        observed, values = self.wave * (1.0 + redshift), self._dict(key, *SKY)
        igm, foreground = (self.by_role[role] for role in SKY)
        out = np.ones(self.wave.size)
        if igm is not None:
            own = {name: values[name] for name in igm.parameters}
            out = igm.transmission(observed, redshift, **own)
        if foreground is not None:
            out = out * foreground.transmission(observed, values)
        return out

    def sky(self, values):
        """Transmission between the source and us at every rest wavelength, for a dict of values."""
        return self.sky_transmission(values["redshift"], self.key(values, *SKY))

    # --------------------------------------------------------------- derived values

    def reference(self, spectrum):
        """Integral of L_lambda over the range that AGN fractions refer to, along the last axis."""
        return spectrum @ self.functionals[self.reference_row]

    def lnu(self, spectrum):
        """L_nu in W/Hz from L_lambda in W/um."""
        return spectrum * self.to_lnu
