"""Tables of parts of models' light, between whose nodes these are interpolated, and how their axes are refined."""

import itertools

import numpy as np

from miricigale.fitting import _core
from miricigale.utils.values import value_class

#: Powers of a parameter, 1 or parts by 2, that may be its scale; those below 0 with the sign changed.
_POWERS = (1.0, 0.5, 0.125, -0.5, -1.0)
#: Fluxes below this part of a model's brightest band are interpolated as if they were it.
_DARK = 1e-12
#: Fluxes below this part of it do not count when a table is refined.
_FAINT = 1e-3
#: Smallest number whose logarithm is interpolated.
LEAST = 1e-290
#: Largest relative error of the interpolation along one axis for 95 % of fluxes.
TOLERANCE = 0.005
#: Largest number of models of one table.
MAX_MODELS = 9216
#: Number of lines along which an axis is refined.
_N_LINES = 24
#: Largest number of times that a cell is halved.
_MAX_HALVINGS = 6


def logarithms(flux, columns, redshift):
    """Return ln of fluxes (n, nz, nb) times z^2, and of columns (n, k), as one table (n, nz, nb + k)."""
    n_bands = flux.shape[2]
    table = np.empty(flux.shape[:2] + (n_bands + columns.shape[1],))
    # large tables: worked out where they stay
    log_flux = table[..., :n_bands]
    top = flux.max(axis=-1, keepdims=True, initial=0.0)
    np.maximum(flux, np.maximum(_DARK * top, LEAST), out=log_flux)
    np.log(log_flux, out=log_flux)
    log_flux += 2.0 * np.log(np.maximum(redshift, 1e-6))[None, :, None]
    table[..., n_bands:] = log_columns(columns)[:, None]
    return table


def log_columns(columns):
    """Return ln of columns, of numbers that are not positive that of the least."""
    return np.log(np.maximum(columns, LEAST))


def combinations(axes):
    """List all combinations of values of axes, the last one fastest: list of dicts."""
    rows = itertools.product(*axes.values())
    return [dict(zip(axes, map(float, row), strict=True)) for row in rows]


def to_scale(value, power):
    """Transform values to the scale of their axis: sign(p) v^p."""
    if power == 1.0:
        return np.asarray(value, float)
    return np.sign(power) * np.power(value, power)


def from_scale(value, power):
    """Transform values back from the scale of their axis."""
    if power == 1.0:
        return value
    return np.power(np.sign(power) * value, 1.0 / power)


def _possible_powers(values):
    """List the scales that an axis of these values may have."""
    if len(values) < 3 or values[0] < 0:
        return (1.0,)
    if values[0] == 0:
        return tuple(power for power in _POWERS if power > 0)
    return _POWERS


def _bend(table, x):
    """Measure how far middle nodes along the first axis are off lines between their neighbors, on average."""
    bend = 0.0
    for i in range(1, len(x) - 1):
        t = (x[i] - x[i - 1]) / (x[i + 1] - x[i - 1])
        off = table[i] - (1.0 - t) * table[i - 1] - t * table[i + 1]
        # models that do not exist are NaN
        off = off[np.isfinite(off)]
        if off.size:
            bend += np.abs(off).mean()
    return bend


def straightest_power(values, table):
    """Find the power whose scale makes a table, first axis along the values, straightest."""
    powers = _possible_powers(values)
    bends = [_bend(table, to_scale(values, power)) for power in powers]
    return powers[int(np.argmin(bends))]


def make_part(names, axes, powers, table, redshift, place, model=None):
    """
    Make the `_core.Part` of a table of logarithms (n_models, nz, n_columns).

    ``axes`` and ``powers`` are values and scales by name; ``place`` says where each name stands among the
    parameters; ``model`` are the models of all combinations, all in order if it is None.
    """
    size = np.array([len(axes[name]) for name in names], np.int64)
    scaled = np.zeros((len(names), max(size, default=1)))
    for i, name in enumerate(names):
        scaled[i, : size[i]] = to_scale(axes[name], powers[name])
    if model is None:
        model = np.arange(len(table))
    table, offset = _single(table)
    return _core.Part(
        table=table,
        offset=offset,
        unit=_units(offset),
        log_z=np.log1p(np.asarray(redshift, float)),
        model=np.ascontiguousarray(model, np.int64).ravel(),
        axis=np.array([place[name] for name in names], np.int64),
        size=size,
        scaled=scaled,
        power=np.array([powers[name] for name in names], float),
    )


def _single(table):
    """
    Convert a table to single precision, (nz, n_models, n_columns), with an offset of each column taken from it.

    Places of an object lie at few redshifts: models of one redshift next to each other fit in a cache.
    """
    offset = np.zeros(table.shape[-1])
    if table.size:
        offset = 0.5 * (table.min(axis=(0, 1)) + table.max(axis=(0, 1)))
    n_models, n_z, n_columns = table.shape
    single = np.empty((n_z, n_models, n_columns), np.float32)
    np.subtract(np.moveaxis(table, 0, 1), offset, out=single, casting="same_kind")
    return single, offset


def _units(offset):
    """Return the exponentials of offsets of columns, infinite of those that are no logarithms."""
    with np.errstate(over="ignore"):
        return np.exp(offset)


def empty_part(n_columns):
    """Make a `_core.Part` without models."""
    return make_part((), {}, {}, np.zeros((0, 1, n_columns)), np.zeros(1), {})


def with_columns(part, table):
    """Return a `_core.Part` of the same models with columns (n_models, k) that do not depend on redshift."""
    table, offset = _single(np.asarray(table, float)[:, None])
    return part._replace(table=table, offset=offset, unit=_units(offset), log_z=np.zeros(1))


def part_columns(part, values):
    """Interpolate columns of a part that do not depend on redshift, (n, n_columns)."""
    return _interpolated(_core.interpolate_exponentials, part, values)


def log_part_columns(part, values):
    """Interpolate columns of a part as they are in its table: logarithms, (n, n_columns)."""
    return _interpolated(_core.interpolate_columns, part, values)


def _interpolated(kernel, part, values):
    """Interpolate columns of a part by a kernel, (n, n_columns)."""
    n = len(values)
    out = np.empty((n, part.table.shape[2]))
    work = _core.make_work(values.shape[1], part.table.shape[2])
    kernel(part, values, np.zeros(n), work, out)
    return out


@value_class
class PartAxes:
    """
    One part of a model's light on a product of axes.

    Parameters
    ----------
    axes : dict of str to `~numpy.ndarray`
        Values of the grid by name.
    evaluate : callable
        Function of `LightParts` and rows that returns ln of fluxes and columns, (n, nz, n_columns).
    refuses : callable
        Function of the name of an axis and a row: whether the row is in no library.
    max_models : int
        Most combinations, if there are no more to begin with.
    tolerance : float
        Error that is good enough.
    powers : dict of str to float, optional
        Scales of the axes; those on which the part is straightest if they are not given.
    """

    axes: dict
    evaluate: object
    refuses: object
    max_models: int = MAX_MODELS
    tolerance: float = TOLERANCE
    powers: dict | None = None

    def refined(self, light):
        """
        Halve cells of axes where that helps most for its size; return values of axes and powers of their scales.

        This ends when the interpolation is good along each of them, or there are as many combinations as a table
        may have.
        """
        axes = {name: _RefinedAxis(self, name, light) for name in self.axes}
        n_combinations = np.prod([len(values) for values in self.axes.values()])
        max_models = max(self.max_models, n_combinations)
        open_axes = set(axes)
        while open_axes:
            name = max(sorted(open_axes), key=lambda name: axes[name].urgency)
            axis = axes[name]
            sizes = {parameter: len(axes[parameter].values) for parameter in axes}
            sizes[name] += axis.n_splits
            too_many = np.prod(list(sizes.values())) > max_models
            if axis.error <= self.tolerance or too_many:
                open_axes.remove(name)
            else:
                axis.split()
        values = {name: axis.values for name, axis in axes.items()}
        return values, {name: axis.power for name, axis in axes.items()}


class _RefinedAxis:
    """
    One axis of a part, whose cells can be halved where the interpolation along it is worst.

    Parameters
    ----------
    part : `PartAxes`
    name : str
    light : `~miricigale.sed.light_parts.LightParts`
        At a few redshifts.

    Attributes
    ----------
    values : `~numpy.ndarray`
        Nodes.
    power : float
        That of the scale on which the part is straightest.
    error : float
        Largest error in the middle of a cell that can be halved.
    n_splits : int
        Number of cells that `split` halves.
    """

    def __init__(self, part, name, light):
        self.part = part
        self.name = name
        self.light = light
        self.values = np.asarray(part.axes[name], float)
        self.power = 1.0
        self.error = 0.0
        self.n_splits = 0
        if len(self.values) == 1:
            return
        rng = np.random.default_rng(1)
        lines = set()
        for _ in range(_N_LINES):
            line = [
                (parameter, float(rng.choice(nodes)))
                for parameter, nodes in part.axes.items()
                if parameter != name
            ]
            lines.add(tuple(line))
        self._lines = [dict(line) for line in sorted(lines)]
        self._table = self._evaluate(self.values)
        # how often a cell was halved, by its lower end
        self._halvings = dict.fromkeys(self.values[:-1].tolist(), 0)
        self._measure()

    @property
    def urgency(self):
        """Mean error of all cells over how much larger, in its logarithm, the table becomes by the splits."""
        if self.n_splits == 0:
            return 0.0
        return self._mean_error / np.log1p(self.n_splits / len(self.values))

    def _evaluate(self, nodes):
        """Evaluate logarithms at nodes of all lines: (n_nodes, n_lines, nz, n_columns)."""
        rows = [line | {self.name: float(node)} for node in nodes for line in self._lines]
        logs = self.part.evaluate(self.light, rows)
        return logs.reshape(len(nodes), len(self._lines), *logs.shape[1:])

    def _measure(self):
        """Measure errors in the middles of the cells that can be halved."""
        if self.part.powers is None:
            self.power = straightest_power(self.values, self._table)
        else:
            self.power = self.part.powers[self.name]
        x = to_scale(self.values, self.power)
        middles = from_scale(0.5 * (x[1:] + x[:-1]), self.power)
        usable = []
        for low, middle in zip(self.values[:-1].tolist(), middles.tolist(), strict=True):
            in_library = True
            for line in self._lines:
                refused = self.part.refuses(self.name, line | {self.name: middle})
                in_library = in_library and not refused
            usable.append(in_library and self._halvings[low] < _MAX_HALVINGS)
        usable = np.array(usable)
        self.error = 0.0
        self.n_splits = 0
        if not usable.any():
            return
        self._low = self.values[:-1][usable]
        self._middles = middles[usable]
        self._at_middles = self._evaluate(self._middles)
        errors = self._errors()
        self.error = errors.max()
        self._mean_error = errors.sum() / (len(self.values) - 1)
        self._splits = errors > max(self.part.tolerance, 0.5 * self.error)
        self.n_splits = int(self._splits.sum())

    def split(self):
        """Halve the cells with the largest errors."""
        middles = self._middles[self._splits]
        for low, middle in zip(self._low[self._splits], middles, strict=True):
            self._halvings[float(low)] += 1
            self._halvings[float(middle)] = self._halvings[float(low)]
        values = np.concatenate([self.values, middles])
        table = np.concatenate([self._table, self._at_middles[self._splits]])
        order = np.argsort(values)
        self.values = values[order]
        self._table = table[order]
        self._measure()

    def _errors(self):
        """Compute the 95th percentile of the relative errors in each of the middles."""
        n_lines, n_z, n_columns = self._table.shape[1:]
        n_bands = min(self.light.n_bands, n_columns)
        redshift = self.light.redshift
        # all lines and columns are columns of one table along the axis
        table = np.moveaxis(self._table, 2, 1).reshape(len(self.values), n_z, -1)
        axis = {self.name: self.values}
        power = {self.name: self.power}
        part = make_part((self.name,), axis, power, table, redshift, {self.name: 0})
        work = _core.make_work(1, table.shape[2])
        errors = np.empty(len(self._middles))
        out = np.empty((n_z, table.shape[2]))
        for i, middle in enumerate(self._middles):
            places = np.full((n_z, 1), middle)
            _core.interpolate_columns(part, places, redshift, work, out)
            exact = np.moveaxis(self._at_middles[i], 1, 0)
            error = np.abs(np.expm1(out.reshape(n_z, n_lines, n_columns) - exact))
            fluxes = exact[..., :n_bands]
            bright = fluxes > fluxes.max(axis=-1, keepdims=True) + np.log(_FAINT)
            errors[i] = np.percentile(error[..., :n_bands][bright], 95)
            for column in range(n_bands, n_columns):
                errors[i] = max(errors[i], np.percentile(error[..., column], 95))
        return errors


def finer_redshifts(redshift, step):
    """Divide cells of redshifts until no step in ln(1 + z) is larger."""
    log_z = np.log1p(np.asarray(redshift, float))
    nodes = [log_z[:1]]
    for low, high in itertools.pairwise(log_z):
        n = int(np.ceil((high - low) / step - 1e-6))
        nodes.append(np.linspace(low, high, n + 1)[1:])
    return np.expm1(np.concatenate(nodes))
