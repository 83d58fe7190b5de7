"""Joint posteriors of two parameters, from the joint sums of the grid engine."""

import numpy as np

from miricigale.utils.exceptions import argument_error, unknown_name

__all__ = ["check_pairs", "joint_names", "joint_tables"]

#: Letters of the engine's joint sums: redshift and fraction before galaxy, galaxy before torus.
_LETTERS = {"redshift": "z", "frac_agn": "f", "galaxy": "g", "agn": "k"}
#: The pair that every fit has.
_ALWAYS = {"redshift", "frac_agn"}


def check_pairs(pairs, axes, constant, derived, wanted):
    """
    Check pairs of parameters.

    Parameters
    ----------
    pairs : list of tuple of str or None
        Pairs of parameters.
    axes : dict of str to `~miricigale.fitting.priors.GridAxis`
        Parameters that have a posterior.
    constant, derived : iterable of str
        Names of parameters with one value, and of derived quantities.
    wanted : str
        What is asked for in place of derived quantities, for the message.

    Returns
    -------
    pairs : tuple of tuple of str
        Each once, whatever its order; without redshift and AGN fraction, which every fit has.

    Raises
    ------
    KeyError
        If a name is unknown.
    ValueError
        If these are no pairs, both are one parameter, or one has a single value or is a derived
        quantity.
    """
    if isinstance(pairs, (str, dict)) or not np.iterable(() if pairs is None else pairs):
        raise argument_error("pairs", "a list of pairs of parameter names", repr(pairs))
    out = {}
    for pair in () if pairs is None else pairs:
        names = () if isinstance(pair, (str, dict)) or not np.iterable(pair) else tuple(pair)
        if len(names) != 2 or not all(isinstance(name, str) for name in names):
            raise argument_error("pairs", "a list of pairs of parameter names", f"{pair!r} in it")
        for name in names:
            if name in derived:
                raise argument_error("pairs", wanted, repr(name))
            if name in constant or (name in axes and axes[name].values.size == 1):
                several = "of parameters with several values"
                raise argument_error("pairs", several, f"{name!r}, which has one")
            if name not in axes:
                raise unknown_name("parameter for 'pairs'", name, axes)
        names = tuple(map(str, names))
        if names[0] == names[1]:
            raise argument_error("pairs", "of two different parameters", f"{names}")
        if set(names) != _ALWAYS and names[::-1] not in out:
            out[names] = None
    return tuple(out)


def joint_names(pairs, axes):
    """Joint sums of the engine that pairs need: tuple of str, sorted."""
    names = {_letters(axes[x], axes[y])[0] for x, y in pairs}
    return tuple(sorted(name for name in names if name[0] != name[1]))


def _letters(a, b):
    """Two letters of a pair of axes in the order of the engine, and whether that is another."""
    order = "".join(_LETTERS.values())
    name = _LETTERS[a.kind] + _LETTERS[b.kind]
    turned = order.index(name[0]) > order.index(name[1])
    return (name[::-1] if turned else name), turned


def joint_tables(out, pairs, axes):
    """
    Sum joint posteriors of models up to those of parameters.

    A galaxy or torus model has one value of each of its parameters, or is shared by their values
    as the prior has it (a torus without polar dust by all temperatures of it). The prior being a
    product over parameters, two that share the same model are independent within it, and the
    product of their shares is exact.

    Parameters
    ----------
    out : `~miricigale.fitting.engines.output.GridOutput`
        What the engine found for n objects, with the sums that `joint_names` names.
    pairs : tuple of tuple of str
        See `check_pairs`.
    axes : dict of str to `~miricigale.fitting.priors.GridAxis`
        Parameters of the fit, with their shares.

    Returns
    -------
    tables : dict of tuple of str to `~numpy.ndarray`, shape (n, nx, ny)
        Each sums to 1; NaN for objects that were not fitted.
    """
    tables, folded = {}, {}
    for x, y in pairs:
        a, b = axes[x], axes[y]
        letters, turned = _letters(a, b)
        if turned:
            a, b = b, a
        if letters[0] == letters[1]:
            table = _shared(out.galaxy if letters == "gg" else out.agn, a.share, b.share)
        else:
            # several pairs may need the same sum over the second models
            if (letters, b.name) not in folded:
                folded[letters, b.name] = _fold(out.joint[letters], b.share)
            table = folded[letters, b.name]
            if a.share is not None:
                table = _fold(table.swapaxes(1, 2), a.share).swapaxes(1, 2)
        if turned:
            table = table.swapaxes(1, 2)
        table = np.array(table, order="C")
        table[np.isnan(out.chi2)] = np.nan
        tables[x, y] = table
    return tables


def _fold(table, share):
    """Sum the last axis, of models, up to the values of a parameter: (..., m) to (..., n)."""
    out = np.empty((*table.shape[:-1], len(share)))
    for value, part in enumerate(share):
        models = np.flatnonzero(part)
        # in memory order: the last digits must not depend on how many rows there are
        rows = np.ascontiguousarray(np.take(table, models, axis=-1))
        out[..., value] = (rows * part[models]).sum(axis=-1)
    return out


def _shared(posterior, a_share, b_share):
    """Joint posterior of two parameters of the same models, of shape (n, n_models)."""
    out = np.empty((len(posterior), len(a_share), len(b_share)))
    for value, part in enumerate(a_share):
        models = np.flatnonzero(part)
        rows = np.take(posterior, models, axis=1) * part[models]
        out[:, value] = _fold(rows, b_share[:, models])
    return out
