"""Priors of the parameters of a grid, in weights of the nodes, and what is known of redshifts."""

from dataclasses import replace

import astropy.units as u
import numpy as np
from scipy.integrate import cumulative_trapezoid

from miricigale.fitting.data.likelihood import FitFlags
from miricigale.fitting.posterior.posterior import cell_edges
from miricigale.fitting.posterior.quantities import column_values
from miricigale.sed import COMPONENTS
from miricigale.utils.arrays import quiet_division
from miricigale.utils.caching import cached
from miricigale.utils.exceptions import argument_error
from miricigale.utils.missing_values import floats, own_mask, without_mask
from miricigale.utils.options import check_choice, check_names, check_that
from miricigale.utils.random import stream
from miricigale.utils.units import are_not_negative, is_ascending, is_number, own_unit, to_array
from miricigale.utils.values import value_class

#: Power of the redshift in `magnitude_prior`.
_POWER = 0.90
#: Redshift of its peak at magnitude 24.
_PEAK = 0.62
#: Change of that redshift with each magnitude.
_SLOPE = 0.066
#: Points of the Gauss-Legendre rule by which a density is integrated over a cell.
_CELL_POINTS = 16


@value_class
class GridAxis:
    """
    One parameter of a grid.

    Parameters
    ----------
    name : str
        Name of the parameter.
    values : `~numpy.ndarray`, shape (n,)
        Its values, ascending.
    unit : `~astropy.units.Unit`
        Their unit.
    kind : {"redshift", "frac_agn", "galaxy", "agn"}
        What the parameter belongs to.
    weights : `~numpy.ndarray`, shape (n,)
        Prior of the values; sums to 1.
    share : `~numpy.ndarray` or None, shape (n, n_models)
        Part of every galaxy or AGN model that belongs to each value: one of a kind, or, where
        the parameter has no effect, as the prior has it.
    bounds : tuple of float
        Limits that the outermost cells do not pass.
    """

    name: str
    values: np.ndarray
    unit: object
    kind: str
    weights: np.ndarray
    share: np.ndarray | None = None
    bounds: tuple = (-np.inf, np.inf)

    def __repr__(self):
        first, last = self.values[[0, -1]]
        unit = f" {self.unit}".rstrip()
        return f"<GridAxis {self.name}: {self.values.size} values from {first:g} to {last:g}{unit}>"

    def __len__(self):
        return self.values.size

    def __getitem__(self, key):
        return self.values[key]

    def __array__(self, dtype=None, copy=None):
        return np.array(self.values, dtype=dtype, copy=copy)

    @property
    def absent_at_zero(self):
        """Whether the first of several values is 0 and means that what the parameter measures is not there."""
        return bool(self.values.size > 1 and self.values[0] == 0) and self._declared_as(
            "absent_at_zero"
        )

    @property
    def label(self):
        """Whether values are labels of what a library has, with nothing between them."""
        return self.values.size > 1 and self._declared_as("label")

    def _declared_as(self, attribute):
        return _declared(tuple(COMPONENTS.names()), self.name, attribute)

    @property
    def ranges(self):
        """First and number of the cells of each thing that posteriors between nodes tell apart: list of pairs."""
        n = self.values.size
        if self.label:
            return [(i, 1) for i in range(n)]
        if self.absent_at_zero:
            return [(0, 1), (1, n - 1)]
        return [(0, n)]

    def cells(self, bounds=(-np.inf, np.inf)):
        """
        Return lowest and highest values of the cells where the posterior has weight: two arrays, shape (n,).

        Those of a label, and of a component that is absent, are the value itself; the first cell of what is
        present begins at 0. The outermost are those of `~miricigale.fitting.posterior.posterior.cell_edges` with
        these bounds.
        """
        edges = cell_edges(self.values, bounds)
        low = edges[:-1].copy()
        high = edges[1:].copy()
        if self.label:
            return self.values.copy(), self.values.copy()
        if self.absent_at_zero:
            low[:2] = 0.0
            high[0] = 0.0
        return low, high

    def values_of_models(self, model, ids, seed):
        """
        Look up the value of each model; where a model stands for several values, draw from their prior.

        Parameters
        ----------
        model : `~numpy.ndarray` of int, shape (n, n_draws)
            Galaxy or AGN model of every draw; negative for none.
        ids : sequence, shape (n,)
            Ids of the objects, each with random numbers of its own.
        seed : int
            Seed of the draws.

        Returns
        -------
        values : `~numpy.ndarray`, shape (n, n_draws)
            NaN without a model.
        """
        share = self.share
        # the value of each model, or the first of several that it stands for
        out = self.values[np.argmax(share, axis=0)][model]
        has_several = np.count_nonzero(share > 0, axis=0) > 1
        is_shared = has_several[model] & (model >= 0)
        total = np.cumsum(share, axis=0)
        for i in np.flatnonzero(is_shared.any(axis=1)):
            rng = stream(seed, "samples", self.name, str(ids[i]))
            draw = rng.random(model.shape[1])[is_shared[i]]
            # cumulative prior over the values that the model stands for
            cdf = total[:, model[i][is_shared[i]]]
            out[i, is_shared[i]] = self.values[np.sum(draw * cdf[-1] >= cdf, axis=0)]
        return np.where(model >= 0, out, np.nan)

    def cell_of(self, values):
        """Find the cells of `cells` in which values lie, the outermost for those beyond: indices."""
        values = np.asarray(values, dtype=float)
        if self.label:
            return np.abs(values[..., None] - self.values).argmin(axis=-1)
        middle = 0.5 * (self.values[1:] + self.values[:-1])
        if not self.absent_at_zero:
            return np.searchsorted(middle, values)
        present = 1 + np.searchsorted(middle[1:], values)
        return np.where(values > 0, present, 0)


@cached(maxsize=1024)
def _declared(components, name, attribute):
    """Whether a component declares the parameter of this name with an attribute that is true."""
    declared = [COMPONENTS.get(component).declared().get(name) for component in components]
    return any(getattr(parameter, attribute, False) for parameter in declared)


@value_class
class GridPriors:
    """Axes with priors, and the prior weights of galaxies, AGN models, fractions and redshifts."""

    axes: dict
    galaxy: np.ndarray
    agn: np.ndarray
    frac: np.ndarray
    redshift: np.ndarray


def grid_priors(grid, priors=None, *, prior_f="grid"):
    """
    Compute the prior weights of a model grid: `GridPriors`.

    ``priors`` and ``prior_f`` are given as for `~miricigale.fitting.BayesFitter`; the latter counts if
    the former do not name the AGN fraction.

    Raises
    ------
    KeyError
        If a name is not a parameter of the grid that has several values.
    ValueError
        If weights are no numbers, or are negative, not finite or all zero.
    """
    got = type(priors).__name__
    check_that(priors is None or isinstance(priors, dict), "priors", "a dict of parameters", got)
    priors = dict(priors or {})
    check_choice(prior_f, "prior_f", ("grid", "uniform"))
    axes = {}
    z = grid.redshift
    f = grid.frac_agn
    axes["redshift"] = _axis("redshift", z, 1, "redshift", priors, bounds=(0.0, np.inf))
    if grid.agn_multiplicity.size:
        if prior_f == "uniform" and "frac_agn" not in priors:
            priors["frac_agn"] = np.diff(cell_edges(f, (0.0, 1.0)))
        axes["frac_agn"] = _axis("frac_agn", f, 1, "frac_agn", priors, bounds=(0.0, 1.0))
    bounds = grid.bounds
    galaxy = np.ones(grid.dust_luminosity.size)
    for name in grid.galaxy_parameters.colnames:
        galaxy *= _add_axis(axes, name, grid.galaxy_parameters[name], "galaxy", priors, bounds)
    agn = np.ones(grid.agn_multiplicity.size)
    if agn.size:
        multiplicity = grid.agn_multiplicity.astype(float)
        inert = _inert(grid)
        for name in grid.agn_parameters.colnames:
            rows, nodes = inert.get(name, (None, None))
            column = grid.agn_parameters[name]
            agn *= _add_axis(axes, name, column, "agn", priors, bounds, rows, nodes)
            if rows is not None:
                multiplicity[rows] /= len(nodes)
        agn *= multiplicity
    check_names(sorted(priors), "grid parameter", axes)
    if not galaxy.sum() > 0 or (agn.size and not agn.sum() > 0):
        raise argument_error("priors", "positive for at least one model", "0 for all")
    if agn.size:
        frac = axes["frac_agn"].weights
    else:
        frac = np.ones(1)
    return GridPriors(axes, galaxy, agn, frac, axes["redshift"].weights)


def _add_axis(axes, name, column, kind, priors, bounds, rows=None, nodes=None):
    """Add the axis of a table's column; return the prior factor of each model."""
    unit = own_unit(column) or 1
    column = column_values(column)
    if nodes is None:
        # means of equal values may differ in the last digit
        values, rows_of = np.unique(np.char.mod("%.12g", column).astype(float), return_inverse=True)
        column = values[rows_of]
    else:
        values = np.unique(nodes)
    if values.size == 1 and name not in priors:
        return np.ones(column.size)
    low, high = bounds.get(name, (-np.inf, np.inf))
    # a node on the limit, but for its last digit, is inside
    inside = (min(low, values[0]), max(high, values[-1]))
    axis = _axis(name, values, unit, kind, priors, inside)
    share = (column[None, :] == values[:, None]).astype(float)
    # weight of the value of each model, over that of equal weights
    factor = axis.weights @ share * values.size
    if rows is not None:
        share[:, rows] = axis.weights[:, None]
        factor[rows] = values.size
    axes[name] = replace(axis, share=share)
    return factor


def _axis(name, values, unit, kind, priors, bounds):
    prior = priors.get(name)
    argument = f"priors[{name!r}]"
    if prior is None:
        weights = np.ones(values.size)
    elif isinstance(prior, str):
        wanted = "a function, an array or 'log' (with values above 0)"
        check_that(prior == "log" and np.all(values > 0), argument, wanted, repr(prior))
        # flat in the logarithm from the first value to the last
        edges = cell_edges(values, (values[0], values[-1]))
        if values.size > 1:
            weights = np.diff(np.log(edges))
        else:
            weights = np.ones(1)
    elif isinstance(prior, tuple) and (len(prior) == 3 or values.size != len(prior) == 2):
        weights = cell_integrals(_span(prior, argument), values, argument)
    elif callable(prior) or hasattr(prior, "pdf"):
        weights = cell_integrals(prior, values, argument)
    else:
        weights = to_array(prior, u.dimensionless_unscaled, argument)
    wanted = f"{values.size} weights, for {name} = {values}"
    check_that(weights.shape == values.shape, argument, wanted, f"shape {weights.shape}")
    good = are_not_negative(weights) and weights.sum() > 0
    check_that(good, argument, "finite, >= 0 and not all 0", weights)
    return GridAxis(name, values, unit, kind, weights / weights.sum(), None, bounds)


def _span(prior, argument):
    """Return the distribution of ``(low, high)`` or ``(low, high, "log")``."""
    from scipy import stats

    low, high, *scale = prior
    wanted = "(low, high) or (low, high, 'log'), two numbers in order (with 'log' above 0)"
    is_span = is_number(low) and is_number(high) and low < high
    is_log = scale == ["log"]
    check_that(is_span and (not scale or (is_log and low > 0)), argument, wanted, prior)
    if is_log:
        return stats.loguniform(low, high)
    return stats.uniform(low, high - low)


def cell_integrals(prior, values, argument):
    """
    Integrate a density over the cells of ascending nodes.

    Parameters
    ----------
    prior : callable or object with ``pdf``
        Density of one value, not normalized; of a distribution of `scipy.stats` its ``cdf`` is taken.
    values : `~numpy.ndarray`, shape (n,)
        The nodes. Cells reach half way to the neighbors; the first begins and the last ends at its node, so that
        the prior is that of a sampler between these bounds.
    argument : str
        What the prior is called in messages.

    Returns
    -------
    weights : `~numpy.ndarray`, shape (n,)
        The density at a single node, which has no cell.

    Raises
    ------
    ValueError
        If the density gives no numbers.
    """
    density = getattr(prior, "pdf", prior)
    if values.size == 1:
        return to_array([density(float(values[0]))], u.dimensionless_unscaled, argument)
    edges = cell_edges(values, (values[0], values[-1]))
    if hasattr(prior, "pdf") and hasattr(prior, "cdf"):
        return np.diff(to_array(prior.cdf(edges), u.dimensionless_unscaled, argument))
    # inside of each cell: a density may end, or be infinite, at an edge
    nodes, weights = np.polynomial.legendre.leggauss(_CELL_POINTS)
    half = 0.5 * np.diff(edges)
    points = edges[:-1, None] + half[:, None] * (1.0 + nodes)
    heights = [density(value) for value in points.ravel().tolist()]
    heights = to_array(heights, u.dimensionless_unscaled, argument)
    wanted = f"one number for each value of {argument}"
    check_that(heights.shape == (points.size,), argument, wanted, f"shape {heights.shape}")
    return half * (heights.reshape(points.shape) @ weights)


def _inert(grid):
    """Find the rows in which a parameter has no effect, and all values of its axis: by name."""
    inert_rows = {}
    for row, names in enumerate(grid.inert):
        for name in names:
            nodes = np.unique(grid.axes.get(name, []))
            if nodes.size > 1:
                inert_rows.setdefault(name, ([], nodes))[0].append(row)
    return inert_rows


def known_redshifts(photometry, redshift, *, zero=False):
    """
    Read the redshifts of a catalog: a column by its name, one value, or one for each object.

    NaN where one is missing, masked, not finite or not positive. With ``zero``, of a grid that has this node (at
    10 pc, for objects with distances of their own), 0 is a redshift. A `ValueError` is raised for a column that
    is not there, another shape, and one value for all that is no redshift.
    """
    n = len(photometry)
    if isinstance(redshift, str):
        wanted = f"a column among {photometry.colnames}"
        check_that(redshift in photometry.colnames, "redshift", wanted, repr(redshift))
        redshift = photometry[redshift]
    values = _unmasked(redshift, "redshift")
    check_that(values.shape in ((), (n,)), "redshift", f"{n} values", f"shape {values.shape}")
    good = np.isfinite(values) & ((values > 0) | (zero & (values == 0)))
    if values.ndim == 0 and not good:
        wanted = "above 0 (for a near galaxy the redshift of its distance: 0.001 for 4.3 Mpc)"
        raise argument_error("redshift", wanted, values)
    return np.broadcast_to(np.where(good, values, np.nan), (n,)).copy()


def magnitude_prior(magnitude, redshift=None):
    """
    Compute the density of redshift of galaxies of a magnitude, for ``redshift_prior`` of `BayesFitter.fit`.

    z^a exp(-(z / z_m)^a) with its peak at z_m = 0.62 + 0.066 (m - 24) and a = 0.90, the form of Benitez 2000
    (ApJ 536, 571, eq. 24), without types. The numbers are the fit of greatest likelihood to the 2302 sources of
    CEERS of S/N above 3 in F160W, magnitude 20 to 28, whose redshifts Lisiecki et al. 2025 published; it is broad,
    with 16 and 84 % at redshift 0.5 and 2.6 at magnitude 24.5.

    Parameters
    ----------
    magnitude : `~astropy.units.Quantity`, shape (n,)
        AB magnitudes in F160W, or fluxes; where it is not finite the prior is that of magnitude 24.
    redshift : array_like, shape (n_z,), optional
        Redshifts at which the density is given: 0 to 15 by default.

    Returns
    -------
    redshift : `~numpy.ndarray`, shape (n_z,)
        The redshifts.
    density : `~numpy.ndarray`, shape (n, n_z)
        Densities that integrate to 1.

    Raises
    ------
    `~astropy.units.UnitsError`
        If magnitudes have no unit.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.fitting import magnitude_prior
    >>> z, density = magnitude_prior([21.0, 26.0] * u.ABmag)
    >>> z[density.argmax(axis=1)].round(1)
    array([0.4, 0.8])
    """
    unmasked, mask = without_mask(magnitude)
    with quiet_division():
        values = u.Quantity(unmasked, subok=True).to(u.ABmag).value
    if mask is None:
        values = np.asarray(values, dtype=float)
    else:
        values = np.where(mask, np.nan, values)
    faintness = np.atleast_1d(values) - 24.0
    if redshift is None:
        z = np.linspace(0.0, 15.0, 751)
    else:
        z = floats(redshift)
    # bright galaxies are not all at 0
    peak = np.maximum(
        _PEAK + _SLOPE * np.where(np.isfinite(faintness), faintness, 0.0), 0.1 * _PEAK
    )
    # Benitez 2000, eq. 24, with the same power in both factors
    density = z**_POWER * np.exp(-((z / peak[:, None]) ** _POWER))
    return z, density / np.trapezoid(density, z, axis=1)[:, None]


def read_density(redshift_prior, n):
    """
    Check densities of redshift for n objects: (redshifts, shape (n_z,), densities).

    Densities have the shape (n_z,), for all, or (n, n_z); straight lines join them, and they are 0
    outside. Masked ones are NaN. A `ValueError` is raised for shapes that do not agree, redshifts that do
    not ascend or are masked, and densities that are negative or infinite.
    """
    wanted = "(redshifts of shape (n_z,), densities of shape (n_z,) or (n, n_z))"
    if not (isinstance(redshift_prior, tuple) and len(redshift_prior) == 2):
        raise argument_error("redshift_prior", wanted, type(redshift_prior).__name__)
    nodes = _unmasked(redshift_prior[0], "redshift_prior[0]")
    density = _unmasked(redshift_prior[1], "redshift_prior[1]")
    if nodes.ndim != 1 or nodes.size < 2 or density.shape not in (nodes.shape, (n, nodes.size)):
        raise argument_error("redshift_prior", wanted, f"shapes {nodes.shape} and {density.shape}")
    check_that(
        is_ascending(nodes) and nodes[0] >= 0, "redshift_prior[0]", ">= 0 and ascending", nodes
    )
    if np.any(density < 0) or np.any(np.isinf(density)):
        raise argument_error("redshift_prior[1]", "finite and not negative", "others")
    return nodes, density


def _unmasked(value, name):
    """Return numbers as an array, NaN where they are masked."""
    mask = np.asarray(own_mask(value))
    array = to_array(getattr(value, "unmasked", value), u.dimensionless_unscaled, name)
    return np.where(mask, np.nan, array)


def integrals_to(values, nodes, density, total):
    """
    Integrate a density that is linear between nodes up to values (m,), shape (..., m).

    ``total`` are the integrals up to each node.
    """
    cell = np.clip(np.searchsorted(nodes, values, side="right") - 1, 0, nodes.size - 2)
    step = values - nodes[cell]
    slope = (density[..., cell + 1] - density[..., cell]) / (nodes[cell + 1] - nodes[cell])
    return total[..., cell] + step * (density[..., cell] + 0.5 * slope * step)


def density_log_prior(redshift_prior, grid_redshift, allowed, flags):
    """
    Compute ln(prior) of the redshifts of a grid, shape (n, nz), from a density for each object.

    The prior of a redshift is the integral of the density over its cell, as a share of the whole
    density: what lies outside the grid is missing from the evidence. Only redshifts that are
    ``allowed`` have one. Densities that are masked, hold NaN or sum to 0 are flagged in ``flags``
    as ``NO_REDSHIFT``, those that leave nothing of the grid as ``NO_MODEL``.
    """
    n = flags.size
    nodes, density = read_density(redshift_prior, n)
    density = np.broadcast_to(density, (n, nodes.size))
    total = cumulative_trapezoid(density, nodes, initial=0)
    if grid_redshift.size == 1:
        edges = np.array([nodes[0], nodes[-1]])
    else:
        edges = np.clip(cell_edges(grid_redshift, (0.0, np.inf)), nodes[0], nodes[-1])
    # integral of each object's density over the cells of the grid
    weights = np.maximum(np.diff(integrals_to(edges, nodes, density, total), axis=1), 0.0)
    integral = total[:, -1:]
    is_usable = np.isfinite(integral[:, 0]) & (integral[:, 0] > 0)
    flags[~is_usable] |= FitFlags.NO_REDSHIFT
    with quiet_division():
        out = np.where(allowed & is_usable[:, None], np.log(weights / integral), -np.inf)
    flags[is_usable & ~np.isfinite(out).any(axis=1)] |= FitFlags.NO_MODEL
    return out


def fixed_log_prior(values, grid_redshift, allowed, tolerance, flags):
    """
    Compute ln(prior) of the redshifts of a grid, shape (n, nz), where they are known: 0 at the nearest.

    It is -inf elsewhere. The nearest lies within ``tolerance`` in abs(dz) / (1 + z), or half a cell.
    Redshifts that are missing, too far from the grid, or without a model are flagged in ``flags``.
    """
    n = values.size
    z = grid_redshift
    missing = np.isnan(values)
    z_or_first = np.where(missing, z[0], values)
    node = np.argmin(np.abs(np.log1p(z_or_first)[:, None] - np.log1p(z)), axis=1)
    distance = np.abs(z_or_first - z[node]) / (1.0 + z_or_first)
    if tolerance is not None:
        limit = np.full(n, tolerance)
    else:
        # in ln(1 + z), in which the nearest is: between two nodes nothing is too far from both
        distance = np.abs(np.log1p(z_or_first) - np.log1p(z[node]))
        step = np.concatenate([[0.0], np.diff(np.log1p(z)), [0.0]])
        limit = 1.001 * np.maximum(step[node], step[node + 1]) / 2.0 + 1e-6
        if z.size == 1:
            # a single redshift has no cell
            limit = np.maximum(limit, 1e-3)
    outside = ~missing & (distance > limit)
    flags[missing] |= FitFlags.NO_REDSHIFT
    flags[outside] |= FitFlags.REDSHIFT_OUTSIDE
    out = np.full((n, z.size), -np.inf)
    out[np.arange(n), node] = np.where(allowed[node], 0.0, -np.inf)
    out[missing | outside] = -np.inf
    flags[~missing & ~outside & ~np.isfinite(out).any(axis=1)] |= FitFlags.NO_MODEL
    return out
