"""
Models between the nodes of a grid, interpolated from the nodes around them.

Logarithms of fluxes and of what is derived from models are parabolas through three nodes of each parameter, with
products of the steps along two, on a scale of the parameter on which they are nearly straight. That of flux
times z^2, without the distance at low redshift, is linear in ln(1 + z) between two redshifts. AGN fraction and
mass enter in closed form. Nothing is said of what lies beyond the outermost nodes.
"""

from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from astropy.table import QTable

from miricigale.fitting import _core
from miricigale.fitting.priors import grid_priors
from miricigale.fitting.quantities import Quantities
from miricigale.sed import ModelFlags
from miricigale.utils.options import check_that
from miricigale.utils.units import MASS

#: Powers of a parameter, 1 or parts by 2, that may be its scale; those below 0 with the sign changed.
_POWERS = (1.0, 0.5, 0.125, -0.5, -1.0)
#: Fluxes below this part of a model's brightest band are interpolated as if they were it.
_DARK = 1e-12
#: Fluxes below this part of it are not compared with the chain.
_FAINT = 1e-6
#: Least of what is interpolated in the logarithm.
_TINY = 1e-290
#: Largest ln of a number.
_LARGE = 690.0
#: Most times that a finer grid is made.
_ROUNDS = 3
#: Errors count up to this: fluxes that change by more between nodes are faint.
_MOST = 0.1
#: Rms error of interpolated ln flux along an axis of a finer grid, and most galaxies or AGN at all redshifts.
_TOLERANCE, _LARGEST = 0.005, 1 << 20


@dataclass(frozen=True, eq=False)
class Kind:
    """Galaxies or AGN: their axes, the model of each combination of values, and what is interpolated."""

    names: tuple
    model: np.ndarray  # (n_1, n_2, ...), -1 where there is none
    flux: np.ndarray  # (nz, n_models, nb + 1): ln(flux z^2), and the last row
    rows: np.ndarray  # (1, n_models, n_rows): ln where lit
    lit: np.ndarray  # (n_rows,): which have a logarithm

    @classmethod
    def of_axes(cls, axes, redshift, flux, rows):
        """Of n models with fluxes (nz, n, nb) and other numbers (n_rows, n)."""
        n = flux.shape[1]
        model = np.full([a.values.size for a in axes], -1 if axes else 0)
        if axes:
            model[tuple(a.share.argmax(axis=0) for a in axes)] = np.arange(n)
            # a model without effect of a parameter stands for all its values
            many = sum(np.count_nonzero(a.share, axis=0) for a in axes) > len(axes)
            for i in np.flatnonzero(many):
                model[np.ix_(*(np.flatnonzero(a.share[:, i] > 0) for a in axes))] = i
        top = flux.max(axis=-1, keepdims=True, initial=0.0)
        flux = np.log(np.maximum(flux, np.maximum(_DARK * top, _TINY)))
        flux += _two_ln(redshift)[:, None, None]
        rows = np.array(rows, float).reshape(len(rows), n)
        lit = np.all(rows > 0, axis=1)
        with np.errstate(divide="ignore"):
            rows = np.where(lit[:, None], np.log(rows), rows)
        rows = rows.T[None].copy()
        flux = np.concatenate([flux, np.repeat(rows[:, :, -1:], len(flux), axis=0)], axis=2)
        return cls(tuple(a.name for a in axes), model, flux, rows, lit)

    def bent(self, name, x):
        """How far, on average, middle nodes of an axis are off lines between their neighbors on a scale ``x``."""
        table, out = np.moveaxis(self.model, self.names.index(name), 0).reshape(x.size, -1), 0.0
        # ln flux but for a factor, and what else is interpolated
        two = self.flux[len(self.flux) // 2, :, :-1], self.rows[0][:, self.lit]
        for k, numbers in enumerate(two):
            for i, t in enumerate((x[1:-1] - x[:-2]) / (x[2:] - x[:-2])):
                low, here, high = table[i : i + 3, (table[i : i + 3] >= 0).all(axis=0)]
                off = numbers[here] - (1.0 - t) * numbers[low] - t * numbers[high]
                out += np.abs(off if k else less_factor(off)).mean() if off.size else 0.0
        return out


@dataclass(frozen=True, eq=False)
class Nodes:
    """
    The models of a grid, for models between them; picklable.

    ``axes`` are `~miricigale.fitting.priors.GridAxis` by name, ``kinds`` has a `Kind` of galaxies, whose last row
    is what AGN fractions refer to, and one of AGN; ``allowed``, shape (nz, nG), are galaxies younger than the
    universe.
    """

    axes: dict
    quantities: Quantities
    kinds: dict
    allowed: np.ndarray

    @classmethod
    def of_grid(cls, grid, axes=None):
        """Of a `~miricigale.sed.ModelGrid`, whose axes may be known."""
        axes = grid_priors(grid).axes if axes is None else axes
        known = Quantities.of_grid(grid)
        of = known.fraction
        galaxy = [*known.galaxy_scale, known.mixed_galaxy, np.asarray(grid.dust_luminosity)]
        agn = [*known.agn_scale, known.mixed_agn]
        if of is not None:
            galaxy.insert(-1, of.galaxy)
            agn.append(of.agn)
        kinds = {}
        for kind, flux, rows in (("galaxy", grid.galaxy, galaxy), ("agn", grid.agn, agn)):
            own = [axis for axis in axes.values() if axis.kind == kind]
            kinds[kind] = Kind.of_axes(own, grid.redshift, np.asarray(flux), rows)
        axes = {name: replace(axis, share=None) for name, axis in axes.items()}
        return cls(axes, known, kinds, np.asarray(grid.allowed))

    def with_kind(self, kind, other):
        """With the models of a kind, their axes and the redshifts of others."""
        axes = {n: a for n, a in other.axes.items() if a.kind in ("redshift", kind)}
        first, kinds = other if kind == "galaxy" else self, self.kinds | {kind: other.kinds[kind]}
        return Nodes(self.axes | axes, first.quantities, kinds, first.allowed)

    @cached_property
    def kernels(self):
        """`_core.Kind` of galaxies and of AGN, by kind."""
        out = {}
        for label, kind in self.kinds.items():
            size = np.array([len(self.axes[name].values) for name in kind.names], np.int64)
            scaled, power = np.zeros((len(size), max(size, default=1))), np.ones(len(size))
            for a, name in enumerate(kind.names):
                values = self.axes[name].values
                if values.size > 2 and values[0] >= 0:
                    powers = [p for p in _POWERS if p > 0 or values[0] > 0]
                    bent = [kind.bent(name, _scaled(values, p)) for p in powers]
                    power[a] = powers[np.argmin(bent)]
                scaled[a, : values.size] = _scaled(values, power[a])
            out[label] = _core.Kind(kind.flux, kind.model.ravel(), size, scaled, power)
        return out

    @cached_property
    def log_z(self):
        """ln(1 + z) of the nodes."""
        return np.log1p(self.axes["redshift"].values)

    def numbers(self, kind, values, redshift, table=None):
        """Interpolate ln flux, or a table of the models, (1, n_models, n_rows), at values by name: (n, n_rows)."""
        own, n, n_fluxes = self.kinds[kind], len(redshift), 0
        if table is None:
            table, n_fluxes = own.flux, own.flux.shape[2] - 1
        places = np.empty((n, len(own.names)))
        for i, name in enumerate(own.names):
            places[:, i] = values.get(name, self.axes[name].values[0])
        out, work = np.empty((n, table.shape[2])), _core.make_work(len(own.names), table.shape[2])
        given = self.kernels[kind], table, self.log_z, places, np.array(redshift, float)
        _core.interpolate(*given, n_fluxes, work, out)
        return out

    def one_kind(self, kind, values, redshift):
        """Fluxes of models of a kind, shape (n, nb), and what they are interpolated with, (n,)."""
        ln, lit = self.numbers(kind, values, redshift), self.kinds[kind].lit[-1]
        more = np.exp(ln[:, -1]) if lit else np.maximum(ln[:, -1], 0.0)
        return np.exp(ln[:, :-1] - _two_ln(redshift)[:, None]), more

    def fluxes(self, values, redshift, frac):
        """Fluxes of one solar mass formed, shape (n, nb), with AGN of given fractions, and their power."""
        flux, dust = self.one_kind("galaxy", values, redshift)
        power = frac / np.maximum(1.0 - frac, 1e-12) * dust
        if np.any(frac > 0):
            flux = flux + power[:, None] * self.one_kind("agn", values, redshift)[0]
        return flux, power

    def rows(self, kind, values, redshift):
        """Rows of a kind at values by name: (n_rows, n)."""
        own = self.kinds[kind]
        out = self.numbers(kind, values, redshift, own.rows)
        return np.where(own.lit, np.exp(np.clip(out, -_LARGE, _LARGE)), np.maximum(out, 0.0)).T

    def describe(self, values, redshift, power, scale):
        """Derived quantities of models of given AGN power and scale: dict by name."""
        known, of = self.quantities, self.quantities.fraction
        n, out, galaxy = len(known.galaxy_scale), {}, self.rows("galaxy", values, redshift)
        out.update(zip(known.names, scale * galaxy[:n], strict=False))
        total = scale * galaxy[n]
        if self.kinds["agn"].flux.shape[1]:
            agn, more = self.rows("agn", values, redshift), len(known.agn_scale)
            out.update(zip(known.names[n:], scale * power * agn[:more], strict=False))
            total, n = total + scale * power * agn[more], n + more
            if of is not None:
                odds = np.divide(power, galaxy[-1], out=np.zeros(power.size), where=galaxy[-1] > 0)
                y = odds * galaxy[-2] * agn[-1]
                out[of.name] = y / (1.0 + y)
        out[known.names[n]] = total
        shape = self.numbers("galaxy", values, redshift, known.shape.values.T[None].copy())
        out.update(zip(known.shape.names, shape.T, strict=True))
        return out


def finer_grid(model, grid, filters, constants, nodes):
    """
    Nodes of a grid of the same model, with cells halved until interpolation is good to 0.5 % along each axis.

    Parameters
    ----------
    model : `~miricigale.sed.SEDModel`
        The model that made the grid.
    grid : `~miricigale.sed.ModelGrid`
    filters : list of str or `~miricigale.filters.FilterSet`
        Bands of the grid.
    constants : dict
        Parameters of the grid with one value.
    nodes : `Nodes`
        Of the grid.

    Returns
    -------
    finer : `Nodes`

    Raises
    ------
    ValueError
        If the model has other fluxes at the nodes of the grid.
    """
    axes = {name: [value] for name, value in constants.items()}
    axes |= {name: np.asarray(grid.axes.get(name, a.values)) for name, a in nodes.axes.items()}
    error = partial(_chain_rms, model, filters, constants, grid.frac_agn)
    wanted = "the model that made the grid"
    check_that(error(nodes) < 1e-3, "finer", wanted, "one with other fluxes at its nodes")
    finer, kinds = nodes, {name: a.kind for name, a in nodes.axes.items()}
    own = {
        kind: [name for name in kinds if kinds[name] in ("redshift", kind)] for kind in nodes.kinds
    }

    def size(axes, kind):
        return np.prod([len(axes[name]) for name in own[kind]])

    # large tables are left as they are: those of finer grids would take tens of seconds
    large = [own[kind] for kind in own if size(axes, kind) > _LARGEST / 4]
    halved = sorted(set().union(*own.values()).difference(*large))
    for _ in range(_ROUNDS):
        # the error along an axis is that of its own cells
        rms, halved, changed = {name: error(finer, name) for name in halved}, set(), set()
        while any(value > _TOLERANCE for value in rms.values()):
            name = max(rms, key=rms.get)
            more = axes | {name: np.sort([*axes[name], *_middles(axes[name], name)])}
            made = {kind for kind in own if name in own[kind]}
            if max(size(more, kind) for kind in made) > _LARGEST:
                del rms[name]
                continue
            # with the square of the cells; more slowly with features that cross bands, and dust that may be absent
            axes, halved, changed = more, halved | {name}, changed | made
            rms[name] *= 0.25 if made == {"galaxy"} else 0.5
        for kind in changed:
            # one kind at a time: all models of the other would be made for nothing
            others = {*own} - {kind}
            some = {n: v[:1] if kinds.get(n, kind) in others else v for n, v in axes.items()}
            finer = finer.with_kind(kind, Nodes.of_grid(model.grid(some, filters)))
    return finer


def _chain_rms(model, filters, constants, frac_agn, nodes, name=None, n=100):
    """
    Rms of interpolated ln flux, but for a factor, at random nodes, or anywhere between those of an axis.

    It is compared with the chain, and 0 where the chain has nothing between them.
    """
    rng, known = np.random.default_rng(1), model.parameters
    values = {other: rng.choice(axis.values, n) for other, axis in nodes.axes.items()}
    if name is not None:
        axis = nodes.axes[name].values
        first = rng.integers(max(axis.size - 1, 1), size=n)
        values[name] = axis[first] + rng.random(n) * (np.roll(axis, -1) - axis)[first]
    values |= {other: np.full(n, value) for other, value in constants.items()}
    table = QTable({other: value * known[other].unit for other, value in values.items()})
    table["mass"] = 1.0 * MASS
    true = model.fluxes(table, filters)
    flags = true["flags"]
    if np.any(flags & int(ModelFlags.NOT_IN_LIBRARY)) and name is not None:
        return 0.0
    frac = values.get("frac_agn", np.full(n, frac_agn[0]))
    flux = nodes.fluxes(values, values["redshift"], frac)[0]
    true = np.column_stack([true[band].value for band in true.colnames[: flux.shape[1]]])
    good = np.isfinite(true).all(axis=1)
    top = _FAINT * true[good].max(axis=1, keepdims=True)
    ratio = np.maximum(flux[good], top) / np.maximum(true[good], top)
    return np.sqrt(np.mean(np.minimum(np.abs(less_factor(np.log(ratio))), _MOST) ** 2))


def _middles(values, name):
    """Half way between the nodes of an axis."""
    if name == "redshift":
        return np.expm1(0.5 * (np.log1p(values[1:]) + np.log1p(values[:-1])))
    return 0.5 * (values[1:] + values[:-1])


def less_factor(change):
    """Changes of ln flux, shape (..., nb), but for a factor."""
    return change - np.median(change, axis=-1, keepdims=True)


def _two_ln(redshift):
    return 2.0 * np.log(np.maximum(redshift, 1e-6))


def _scaled(value, power):
    return np.sign(power) * np.power(value, power) if power != 1.0 else np.asarray(value, float)
