"""Numbers from posteriors on the nodes of axes: moments, percentiles, cells, joint posteriors."""

import re
from dataclasses import replace

import numpy as np

from miricigale.fitting._core import percentile_places
from miricigale.fitting.data.likelihood import FitFlags
from miricigale.utils.arrays import middles, nans
from miricigale.utils.exceptions import argument_error
from miricigale.utils.interactive import WithTable
from miricigale.utils.missing_values import floats
from miricigale.utils.object_rows import ObjectRows
from miricigale.utils.options import check_names, check_that
from miricigale.utils.package_tables import column_texts, declared

#: Letters of the engine's joint sums: redshift and fraction before galaxy, galaxy before AGN model.
_LETTERS = {"redshift": "z", "frac_agn": "f", "galaxy": "g", "agn": "k"}
#: Bins of the distribution of a derived quantity in draws.
_N_BINS = 30
#: The pair that every fit has.
_ALWAYS = {"redshift", "frac_agn"}


def cell_edges(values, bounds=(-np.inf, np.inf)):
    """
    Compute the edges of the cells around ascending nodes: shape (n,) to (n + 1,).

    Half way between the nodes; the outermost cells are symmetric about their nodes, as far as the
    bounds allow. A single node has a cell of no width.
    """
    values = np.asarray(values, dtype=float)
    if values.size == 1:
        return np.array([values[0], values[0]])
    middle = middles(values)
    first = max(2.0 * values[0] - middle[0], bounds[0])
    last = min(2.0 * values[-1] - middle[-1], bounds[1])
    return np.concatenate([[first], middle, [last]])


def moments(values, pdf):
    """Compute mean and standard deviation, shape (...), for weights (..., n) of nodes (n,) that sum to 1."""
    # a matrix product's last digit would depend on how many rows there are
    mean = np.sum(pdf * values, axis=-1)
    # about the mean, so that narrow posteriors do not lose digits
    deviation = values - mean[..., None]
    return mean, np.sqrt(np.sum(pdf * deviation * deviation, axis=-1))


def check_levels(levels):
    """
    Check levels of percentiles: an array of numbers between 0 and 1; those above 1, such as 16, are percent.

    A `ValueError` if one is neither, or both kinds are there.
    """
    levels = np.atleast_1d(floats(levels))
    check_that(levels.ndim == 1, "levels", "a number or a list of numbers", f"shape {levels.shape}")
    if levels.size and np.all((levels > 1) & (levels < 100)):
        # 1 is left out: it may be 1 or 100 percent
        levels = levels / 100.0
    wanted = "all between 0 and 1, or percentages above 1 and below 100"
    is_percent = levels > 1
    if is_percent.any() and np.all((levels > 0) & (levels < 100)):
        # 0.1 beside 99.9 is a percentage, but 0.5 beside 84 need not be one
        parts = ", ".join(f"{level / 100:.6g}" for level in levels)
        wanted += f": of numbers on both sides of 1 take parts, [{parts}] for percentages"
    check_that(np.all((levels > 0) & (levels < 1)), "levels", wanted, levels)
    return levels


def cell_percentiles(values, pdf, levels, bounds=(-np.inf, np.inf)):
    """
    Compute percentiles from the cumulative distribution, linear within each cell of `cell_edges`.

    Levels in (0, 1), shape (k,), of m objects whose nodes have the weights ``pdf``, shape (m, n):
    shape (m, k). Rows of NaN give NaN.
    """
    edges = cell_edges(values, bounds)
    levels = np.asarray(levels, dtype=float)
    out = nans((pdf.shape[0], levels.size))
    good = np.flatnonzero(np.isfinite(pdf).all(axis=1) & (pdf.sum(axis=1) > 0))
    place = np.empty((good.size, levels.size))
    percentile_places(pdf[good], levels, place)
    cell = np.minimum(place.astype(int), pdf.shape[1] - 1)
    out[good] = edges[cell] + (place - cell) * (edges[cell + 1] - edges[cell])
    return out


def cell_shares(values, pdf, low, high, bounds):
    """
    Integrate distributions that are linear within each cell of `cell_edges` from ``low`` to ``high``.

    Nodes (k,), their weights (m, k), limits (m,): shape (m,). Rows of NaN give NaN.
    """
    edges = cell_edges(values, bounds)
    # cumulative distribution at the edges, linear between them
    upto = np.pad(np.cumsum(pdf, axis=1), ((0, 0), (1, 0)))
    ends = [
        np.interp(at, edges, row) for row, at in zip(upto, np.stack([low, high], 1), strict=True)
    ]
    with np.errstate(invalid="ignore"):
        return np.diff(np.reshape(ends, (-1, 2)), axis=1)[:, 0] / upto[:, -1]


def limits_of(text):
    """
    Read a name with a limit, such as ``"frac_agn > 0.1"``.

    Parameters
    ----------
    text : str
        A name alone, or one before ``<`` or ``>`` and a number.

    Returns
    -------
    name : str
    low, high : float or None

    Examples
    --------
    >>> limits_of("frac_agn > 0.1")
    ('frac_agn', 0.1, None)
    """
    match = re.fullmatch(r"\s*(\w+)\s*([<>])=?\s*([-+.\de]+)\s*", text)
    if not match:
        return text, None, None
    name, sign, number = match.groups()
    if sign == ">":
        return name, float(number), None
    return name, None, float(number)


def shares_between(values, levels, low, high):
    """
    Return the shares of distributions between two limits, either of which may be None.

    Parameters
    ----------
    values, levels : `~numpy.ndarray`, shape (m, k)
        Points of the cumulative distributions, which are linear between them.
    low, high : float or None
        The limits; what is at a first value of 0 is above a limit of 0.

    Returns
    -------
    shares : `~numpy.ndarray`, shape (m,)
        NaN of distributions that are NaN.
    """
    shares = np.empty(len(levels))
    for row, (x, y) in enumerate(zip(values, levels, strict=True)):
        # a cell of no width at 0 belongs to what is above 0
        below = 0.0
        if low is not None and low > x[0]:
            below = np.interp(low, x, y, left=0.0, right=1.0)
        above = 1.0
        if high is not None:
            above = np.interp(high, x, y, left=0.0, right=1.0)
        shares[row] = above - below
        if np.isnan(y).any():
            # limits beyond the values would not ask for what is not known
            shares[row] = np.nan
    return shares


def randomized_ranks(pdf, node, draw):
    """
    Draw the ranks of true values that lie on nodes, shape (m,), uniform if the posteriors are right.

    The distribution steps at every node: the rank is drawn (a uniform number for each object) from
    the step of the true node, for otherwise narrow posteriors have ranks of 0 and 1 only.
    """
    node = np.asarray(node)[:, None]
    node_weight = np.take_along_axis(pdf, node, axis=1)[:, 0]
    upto = np.take_along_axis(np.cumsum(pdf, axis=1), node, axis=1)[:, 0]
    return upto - node_weight * np.asarray(draw)


def bin_edges(values, *, log):
    """
    Compute the edges of 30 bins between the smallest and the largest value.

    They have equal widths, in the logarithm with ``log``, if all values are above 0.
    """
    low = np.nanmin(values)
    high = np.nanmax(values)
    # equal values get a narrow bin
    high = max(high, low + 1e-6 * max(abs(low), 1e-30))
    if not (log and low > 0):
        return np.linspace(low, high, _N_BINS + 1)
    edges = np.geomspace(low, high, _N_BINS + 1)
    # rounding must not leave the extreme values outside
    edges[[0, -1]] = low, high
    return edges


def check_pairs(pairs, axes, constant, derived, wanted):
    """
    Check pairs of parameters that have a posterior (``axes``).

    ``constant`` and ``derived`` are the names of parameters with one value, and of derived quantities,
    in place of which the message wants what ``wanted`` says. Returned is a tuple of pairs, each once,
    whatever its order, without redshift and AGN fraction, which every fit has. Unknown names are a
    `KeyError`, what is no pair of different parameters with several values a `ValueError`.
    """
    if pairs is None:
        pairs = ()
    of_names = "a list of pairs of parameter names"
    out = {}
    if isinstance(pairs, (str, dict)) or not np.iterable(pairs):
        raise argument_error("pairs", of_names, repr(pairs))
    for pair in pairs:
        names = ()
        if np.iterable(pair) and not isinstance(pair, (str, dict)):
            names = tuple(pair)
        if len(names) != 2 or not all(isinstance(name, str) for name in names):
            raise argument_error("pairs", of_names, f"{pair!r} in it")
        for name in names:
            check_that(name not in derived, "pairs", wanted, repr(name))
            if name in constant or (name in axes and axes[name].values.size == 1):
                expected = "of parameters with several values"
                raise argument_error("pairs", expected, f"{name!r}, which has one")
            check_names([name], "parameter for 'pairs'", axes)
        names = tuple(map(str, names))
        check_that(names[0] != names[1], "pairs", "of two different parameters", names)
        if set(names) != _ALWAYS and names[::-1] not in out:
            out[names] = None
    return tuple(out)


def joint_names(pairs, axes):
    """List the joint sums of the engine that pairs need: tuple of str, sorted."""
    names = {_letters(axes[x], axes[y])[0] for x, y in pairs}
    return tuple(sorted(name for name in names if name[0] != name[1]))


def _letters(a, b):
    """Return two letters of a pair of axes in the order of the engine, and whether that is reversed."""
    order = "".join(_LETTERS.values())
    name = _LETTERS[a.kind] + _LETTERS[b.kind]
    is_reversed = order.index(name[0]) > order.index(name[1])
    if is_reversed:
        name = name[::-1]
    return name, is_reversed


def joint_tables(out, pairs, axes):
    """
    Sum joint posteriors of models up to those of parameters: by pair, shape (n, nx, ny).

    A galaxy or AGN model has one value of each of its parameters, or is shared by their values
    as the prior has it (a torus without polar dust by all temperatures of it). The prior being a
    product over parameters, two that share the same model are independent within it, and the
    product of their shares is exact. ``out`` is what the engine found, with the sums that
    `joint_names` names.
    """
    tables = {}
    folded = {}
    for x, y in pairs:
        a = axes[x]
        b = axes[y]
        letters, is_reversed = _letters(a, b)
        if is_reversed:
            a = axes[y]
            b = axes[x]
        if letters[0] == letters[1]:
            posterior = {"gg": out.galaxy, "kk": out.agn}[letters]
            table = _shared(posterior, a.share, b.share)
        else:
            # several pairs may need the same sum over the second models
            if (letters, b.name) not in folded:
                folded[letters, b.name] = _fold(out.joint[letters], b.share)
            table = folded[letters, b.name]
            if a.share is not None:
                table = _fold(table.swapaxes(1, 2), a.share).swapaxes(1, 2)
        if is_reversed:
            table = table.swapaxes(1, 2)
        tables[x, y] = np.array(table, order="C")
        tables[x, y][np.isnan(out.chi2)] = np.nan
    return tables


def _fold(table, share):
    """Sum the last axis, of models, up to the values of a parameter: (..., m) to (..., n)."""
    out = np.empty(table.shape[:-1] + (len(share),))
    for value, part in enumerate(share):
        models = np.flatnonzero(part)
        # in memory order: the last digits must not depend on how many rows there are
        rows = np.ascontiguousarray(np.take(table, models, axis=-1))
        out[..., value] = (rows * part[models]).sum(axis=-1)
    return out


def _shared(posterior, a_share, b_share):
    """Compute the joint posterior of two parameters of the same models from theirs, shape (n, n_models)."""
    out = np.empty((len(posterior), len(a_share), len(b_share)))
    for value, part in enumerate(a_share):
        models = np.flatnonzero(part)
        rows = np.take(posterior, models, axis=1) * part[models]
        out[:, value] = _fold(rows, b_share[:, models])
    return out


def other_name(name, known):
    """
    Find the parameter or derived quantity that a name of CIGALE's or a usual one is.

    Parameters
    ----------
    name : str
        Such as ``"stellar.m_star"``, ``"bayes.sfh.sfr"``, ``"fracAGN"`` or ``"z"``.
    known : collection of str
        Those that there are, by our names.

    Returns
    -------
    name : str
        Ours, if it is one of ``known``; else the name as it was.

    Examples
    --------
    >>> from miricigale.fitting.posterior.posterior import other_name
    >>> other_name("bayes.stellar.m_star", ["mass", "stellar_mass"])
    'stellar_mass'
    """
    if name in known or not isinstance(name, str):
        return name
    bare_name = name.removeprefix("bayes.").removeprefix("best.")
    usual = column_texts("miricigale.fitting", "other_names")
    if usual.get(bare_name) in known:
        return usual[bare_name]
    tables = declared("miricigale.cigale", "names.toml")
    pairs = [(ours, theirs) for ours, (theirs, _) in tables["quantities"].items()]
    for names in tables["modules"].values():
        pairs += names.items()
    for ours, theirs in pairs:
        if theirs == bare_name and ours in known:
            return ours
    return name


class FitRows(ObjectRows, WithTable):
    """Base of what fits return: objects that may be flagged as not fitted, and the model if it is known."""

    #: Where the formats of files are registered.
    io_module = "miricigale.fitting.results.io"
    _other_name = staticmethod(other_name)

    def with_model(self, model):
        """Return a copy that knows the `~miricigale.sed.SEDModel`, for other bands and for spectra."""
        return replace(self, model=model)

    def to_pandas(self):
        """Return the table as a `pandas.DataFrame`, without units."""
        return self.to_table().to_pandas()

    def _named(self, name):
        """Return our name of a parameter or derived quantity."""
        return other_name(name, self.parameters)

    def interval(self, name, level=0.68):
        """
        Return central credible intervals.

        Parameters
        ----------
        name : str
            A parameter or derived quantity.
        level : float, optional
            Part of the posterior within, or percent of it: 0.68 and 68 are the same.

        Returns
        -------
        interval : `~astropy.units.Quantity`, shape (n, 2)
            Lower and upper ends, below and above which the same part of the posterior lies.
        """
        (level,) = check_levels([level])
        return self.percentile(name, [0.5 * (1.0 - level), 0.5 * (1.0 + level)])

    def flag_names(self):
        """List the names of the flags of each object: list of lists of str."""
        return [FitFlags.names(value) for value in np.atleast_1d(self.flags)]

    def __add__(self, other):
        return type(self).concatenate([self, other])

    def _fitted_one(self):
        """Refuse a single object that was not fitted."""
        names = ", ".join(FitFlags.names(self.flags)) or "no draws"
        got = f"{np.asarray(self.ids).item()!r} ({names})"
        check_that(self.fitted, "key", "the id of an object that was fitted", got)
        return self
