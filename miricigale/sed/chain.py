"""The chain of components worked out on one grid of rest wavelengths: arrays only."""

import itertools

import numpy as np
from scipy.sparse import csr_array

from miricigale.filters import FilterSet
from miricigale.sed import _core
from miricigale.sed.component import ROLES
from miricigale.utils.caching import cached
from miricigale.utils.named_values import subset
from miricigale.utils.package_tables import declared
from miricigale.utils.values import value_class

#: Version of the numbers that follow from the components: raised when the chain, the derived
#: quantities or the grids change, so that grids kept on the disk are made anew.
VERSION = 1

INFRARED = (3.0, 1000.0)  # um
SIX = 6.0  # um
VISUAL = 0.55  # um, where A_V and the light-weighted age are taken
_DECLARED = declared("miricigale.sed", "derived.toml")
#: The ten windows of Calzetti, Kinney & Storchi-Bergmann 1994, table 2 (um).
UV_WINDOWS = tuple(map(tuple, _DECLARED["uv_windows"]))
#: Bands of the rest-frame colors, and these: name to the two bands.
COLOR_BANDS = _DECLARED["color_bands"]
COLORS = _DECLARED["colors"]

#: Roles whose parameters together shape stars with their gas, those of a galaxy, and those of what lies between
#: the source and us.
STELLAR = ("sfh", "stellar", "nebular")
GALAXY_ROLES = STELLAR + ("attenuation", "dust")
SKY = ("igm", "foreground")
MAX_HISTORIES = 128  # stars of so many histories, those made last, are kept
#: Results that each of these methods of `Chain` keeps.
MAX_KEPT = 256
_KEEPING = "names _hat _populations _glow factors dust agn_templates sky_transmission"
_OF_STARS = "dust_power stellar_mass sfr sfr_10myr sfr_100myr age_mass age_light"


@value_class
class Stars:
    """
    Light of stars of n histories and of the gas they ionize, for one solar mass formed.

    Spectra, shape (n, n_wave), are L_lambda in W/um; ``nebular_young`` and ``nebular_old`` are the
    gas's part of ``young`` and ``old``; the others have shape (n,): ``dust_power`` in W is what dust
    takes of the ionizing light; ``visual`` is L_lambda at 0.55 um; ages are in Gyr, rates in Msun/yr,
    masses in Msun.
    """

    young: np.ndarray
    old: np.ndarray
    nebular_young: np.ndarray | None
    nebular_old: np.ndarray | None
    dust_power: np.ndarray
    visual: np.ndarray
    stellar_mass: np.ndarray
    sfr: np.ndarray
    sfr_10myr: np.ndarray
    sfr_100myr: np.ndarray
    age_mass: np.ndarray
    age_light: np.ndarray


def distinct(items):
    """Return the different items in the order of their first appearance, and which of them each one is."""
    row_of_value = {}
    index = [row_of_value.setdefault(item, len(row_of_value)) for item in items]
    return list(row_of_value), np.array(index, dtype=np.int64)


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
        marks = (SIX, VISUAL) + INFRARED + tuple(span)
        parts = [c.nodes() for c in components.values() if len(c.nodes())]
        limit = _core.LYMAN_LIMIT * np.array([1 - 1e-5, 1 + 1e-5])
        windows = np.ravel(UV_WINDOWS)
        wave = _core.merge_nodes(parts + [marks, limit, windows])
        wave.flags.writeable = False
        self.wave = wave
        self.inverse_step = 1.0 / np.diff(wave)
        self.weights = _core.trapezoid_weights(wave)
        self.to_lnu = wave**2 / _core.LIGHT
        self._hard = int(np.searchsorted(wave, _core.LYMAN_LIMIT))  # these ionize hydrogen
        self.at = {x: int(np.searchsorted(wave, x * (1 - 1e-9))) for x in marks}
        self.functionals = self._functionals()
        self.reference_row = 0
        if tuple(span) != INFRARED:
            self.functionals = np.concatenate([self.functionals, [self._light_in(span)]])
            self.reference_row = -1
        self._sparse_functionals = csr_array(self.functionals)
        self._names = {
            role: tuple(part.parameters) if part else () for role, part in self.by_role.items()
        }
        self._kept = ({}, None)
        # what was made last is kept, by its arguments, as long as the chain lives
        for name in _KEEPING.split():
            setattr(self, name, cached(getattr(self, name), maxsize=MAX_KEPT))

    def __repr__(self):
        components = [type(part).__name__ for part in self.by_role.values() if part is not None]
        return f"<Chain of {', '.join(components)}>"

    def _functionals(self):
        wave = self.wave
        n = self.wave.size
        infrared = self._light_in(INFRARED)
        visual = np.zeros(n)
        visual[self.at[VISUAL]] = 1.0
        windows = np.zeros((len(UV_WINDOWS), n))
        for row, (low, high) in zip(windows, UV_WINDOWS, strict=True):
            first, last = np.searchsorted(wave, [low * (1 - 1e-9), high * (1 + 1e-9)])
            row[first:last] = _core.trapezoid_weights(wave[first:last]) / (high - low)
        bands = FilterSet.from_names(list(COLOR_BANDS.values())).weights(wave) * self.to_lnu
        return np.concatenate([[infrared, visual], windows, bands])

    def _light_in(self, span):
        """Return the weights of the integral of L_lambda over a range of wavelengths."""
        weights = np.zeros(self.wave.size)
        part = slice(self.at[span[0]], self.at[span[1]] + 1)
        weights[part] = _core.trapezoid_weights(self.wave[part])
        return weights

    def names(self, roles):
        """Return the names of the parameters of a role, or of several."""
        if isinstance(roles, str):
            return self._names[roles]
        return tuple(itertools.chain.from_iterable(map(self._names.get, roles)))

    def key(self, values, roles):
        """Return the values of all parameters of a role, or of several, as a tuple."""
        return tuple(map(values.get, self.names(roles)))

    def keys(self, rows, roles):
        """Return the `key` of each of some rows, dicts of all parameters."""
        return [self.key(row, roles) for row in rows]

    def _dict(self, key, roles):
        """Return the values of a `key` by the names of the parameters."""
        return dict(zip(self.names(roles), key, strict=True))

    # ------------------------------------------------------------------ stars

    def _hat(self, role):
        """Return the matrix that interpolates spectra at a component's nodes on our grid."""
        return _core.hat_matrix(np.asarray(self.by_role[role].nodes()), self.wave)

    def _populations(self, metallicity):
        """Ages, spectra on our grid, surviving mass of one metallicity, and photons by age of the gas's table."""
        stellar = self.by_role["stellar"]
        nebular = self.by_role["nebular"]
        age, spectra, surviving = stellar.table(metallicity)
        spectra = np.ascontiguousarray(
            (self._hat("stellar") @ np.asarray(spectra, dtype=float).T).T
        )
        if nebular:
            photons = np.diag(stellar.ionizing(metallicity))
        else:
            photons = ()
        photons = [_core.photons_by_age(age, row, nebular.table.age) for row in photons]
        return age, spectra, surviving, np.array(photons)

    def _glow(self, key):
        """Light of the gas on our grid for one photon, by a key of the stellar roles without history."""
        spectra = self.by_role["nebular"].by_photon(self._dict(key, STELLAR[1:]))
        return np.ascontiguousarray((self._hat("nebular") @ spectra.T).T)

    def stars(self, keys):
        """
        Return the `Stars` of the different histories among keys, and which of them each key has.

        Sums are made row by row: what a history gives does not depend on what is asked for with it.
        """
        place, stars = self._kept
        if not all(key in place for key in keys):
            different, rows = distinct(keys)
            stars = self._make_stars([self._dict(key, STELLAR) for key in different])
            if len(different) <= MAX_HISTORIES:  # those that follow may share them
                self._kept = ({key: row for row, key in enumerate(different)}, stars)
            return stars, rows
        return stars, np.array([place[key] for key in keys], dtype=np.int64)

    def _make_stars(self, values):
        sfh = self.by_role["sfh"]
        stellar = self.by_role["stellar"]
        nebular = self.by_role["nebular"]
        n = len(values)
        light = np.zeros((2, n, self.wave.size))
        if nebular is None:
            gas = None
        else:
            gas = np.zeros_like(light)
        out = {name: np.zeros(n) for name in _OF_STARS.split()}
        histories = [sfh.history(v) for v in values]
        keys, kind = distinct([self.key(v, STELLAR[1:]) for v in values])
        for i, key in enumerate(keys):
            rows = np.flatnonzero(kind == i)
            v = self._dict(key, STELLAR[1:])
            age, spectra, surviving, ionizing = self._populations(v["metallicity"])
            parts = [histories[row] for row in rows]
            flat = np.append(np.concatenate(parts), 0.0)
            end = np.cumsum(list(map(len, parts)))
            weights = stellar.masses(flat, end, v)
            out["sfr"][rows] = flat[end - 1]
            for last in (10, 100):
                steps = np.minimum(np.diff(end, prepend=0), last)
                ends = np.column_stack([end - steps, end]).ravel()
                out[f"sfr_{last}myr"][rows] = np.add.reduceat(flat, ends)[::2] / steps
            over_histories = weights.sum(axis=0)
            bright = over_histories * spectra[:, self.at[VISUAL]]
            total = np.where(bright.any(axis=1), bright.sum(axis=1), np.nan)
            out["age_light"][rows] = (bright * age).sum(axis=1) / total * 1e-3
            out["age_mass"][rows] = (
                (over_histories * age).sum(axis=1) / over_histories.sum(axis=1) * 1e-3
            )
            out["stellar_mass"][rows] = (over_histories * surviving).sum(axis=1)
            for part, shares in enumerate(weights):
                light[part, rows] = _core.weighted_sums(shares, spectra)
                if gas is not None:
                    hard = light[part, rows, : self._hard] * self.weights[: self._hard]
                    out["dust_power"][rows] += v["f_dust"] * hard.sum(axis=1)
                    light[part, rows, : self._hard] *= v["f_esc"]
                    photons = _core.weighted_sums(shares, ionizing)
                    gas[part, rows] = _core.weighted_sums(photons, self._glow(key))
        if gas is None:
            gas = (None, None)
        else:
            light += gas
        visual = light[:, :, self.at[VISUAL]].sum(axis=0)
        return Stars(light[0], light[1], gas[0], gas[1], visual=visual, **out)

    # ------------------------------------------------------- attenuation and dust

    def factors(self, key):
        """Return the transmissions for young stars, old stars and gas; None for gas that is as the stars."""
        attenuation = self.by_role["attenuation"]
        values = self._dict(key, "attenuation")
        if attenuation is None:
            no_dimming = np.ones(self.wave.size)
            return no_dimming, no_dimming, None
        if self.by_role["nebular"]:
            gas = attenuation.gas_factor(self.wave, values)
        else:
            gas = None
        young, old = attenuation.factors(self.wave, values)
        return young, old, gas

    def attenuated(self, stars, rows, keys, dust_keys=None, out=None):
        """
        Return the starlight of n galaxies behind dust, and the power that dust took.

        Parameters
        ----------
        stars : `Stars`
        rows : `~numpy.ndarray` of int, shape (n,)
            Which of the stars each galaxy has.
        keys, dust_keys : sequence of tuple
            Keys of ``attenuation``, and of ``dust`` if its light is to be added.
        out : `~numpy.ndarray`, shape (n, n_wave), optional
            To be filled.

        Returns
        -------
        light, absorbed : `~numpy.ndarray`, shape (n, n_wave) and (n,)
            L_lambda in W/um, and W.
        """
        n = len(rows)
        none = np.zeros((0, self.wave.size))
        block = slice(int(rows.min()), int(rows.max()) + 1)
        different, dim = distinct(keys)
        dust = np.zeros((1, self.wave.size))
        dusty = np.zeros(n, dtype=np.int64)
        if dust_keys is not None:
            dust_keys, dusty = distinct(dust_keys)
            dust = self.dusts(dust_keys)
        parts = [stars.young[block], stars.old[block], none]
        young_factor, old_factor, gas = zip(*map(self.factors, different), strict=True)
        dims = [np.array(young_factor), np.array(old_factor), none]
        if gas[0] is not None:
            young = stars.nebular_young[block]
            old = stars.nebular_old[block]
            parts = [parts[0] - young, parts[1] - old, young + old]
            dims[2] = np.array(gas)
        if out is None:
            out = np.empty((n, self.wave.size))
        absorbed = np.empty(n)
        _core.mix_light(
            self.weights, *parts, rows - block.start, *dims, dim, stars.dust_power[block], dust, dusty,
            out, absorbed
        )  # fmt: skip
        return out, absorbed

    def dusts(self, keys):
        """Return the dust spectra in W/um for one watt, by keys of ``dust``; zeros without the component."""
        component = self.by_role["dust"]
        if component is None:
            return np.zeros((len(keys), self.wave.size))
        columns = dict(zip(self.names("dust"), np.array(keys).T, strict=True))
        spectra = np.ascontiguousarray((self._hat("dust") @ component.spectra(columns).T).T)
        # one watt on this grid too, where the step at the first node is a slope
        spectra /= (spectra * self.weights).sum(axis=1, keepdims=True)
        return spectra

    def dust(self, key):
        """Return one of `dusts`."""
        return self.dusts([key])[0]

    # ------------------------------------------------------------- AGN and the sky

    def agn_key(self, values):
        """Return the values of the AGN's parameters, those without effect at their defaults."""
        agn = self.by_role["agn"]
        changed = values | {"frac_agn": 0.0}
        for name in agn.inert(changed):
            changed[name] = agn.parameters[name].default
        return self.key(changed, "agn")

    def agn_templates(self, key):
        """Return the `~miricigale.sed.components.AGNTemplates` by a key of `agn_key`."""
        return self.by_role["agn"].templates(self.wave, self._dict(key, "agn"))

    def agn(self, values):
        """Return the `~miricigale.sed.components.AGNTemplates` for a dict of values, whatever its fraction."""
        return self.agn_templates(self.agn_key(values))

    def sky_transmission(self, redshift, key, first=0, last=None):
        """
        Return the transmission between the source and us, by the key of ``igm`` and ``foreground``.

        Given at the rest wavelengths from number ``first`` to ``last``, that one not included.
        """
        observed = self.wave[first:last] * (1.0 + redshift)
        values = self._dict(key, SKY)
        igm = self.by_role["igm"]
        foreground = self.by_role["foreground"]
        out = np.ones(observed.size)
        if igm is not None:
            igm_values = subset(values, self.names("igm"))
            out = igm.transmission(observed, redshift, **igm_values)
        if foreground is not None:
            out = out * foreground.transmission(observed, values)
        return out

    def sky(self, values):
        """Return the transmission between the source and us at every rest wavelength, for a dict of values."""
        return self.sky_transmission(values["redshift"], self.key(values, SKY))

    # --------------------------------------------------------------- derived values

    def reference(self, spectrum):
        """Return the integral of L_lambda over the range that AGN fractions refer to, along the last axis."""
        return spectrum @ self.functionals[self.reference_row]

    def functional_sums(self, spectra):
        """Return the sums over spectra L_lambda, (n, n_wave), with ``functionals``: (n, n_functional)."""
        # most weights are 0; and threads of the linear algebra would cost more than they gain
        return (self._sparse_functionals @ np.ascontiguousarray(spectra.T)).T

    def lnu(self, spectrum):
        """Return the L_nu in W/Hz from L_lambda in W/um."""
        return spectrum * self.to_lnu
