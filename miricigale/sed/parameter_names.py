"""Names of parameters: ours, those of CIGALE and other programs, and the logarithm of the mass."""

from collections import Counter
from collections.abc import Mapping

import astropy.units as u
import numpy as np
from astropy.table import QTable, Table

from miricigale.sed.component import COMPONENTS
from miricigale.utils.caching import cached
from miricigale.utils.exceptions import argument_error, units_error
from miricigale.utils.named_values import first_value
from miricigale.utils.options import check_names, check_that
from miricigale.utils.package_tables import declared
from miricigale.utils.units import own_unit

#: Names of parameters that are usual elsewhere, with ours; and those that have other meanings in tables.
_OTHER_NAMES = {"z": "redshift", "fracAGN": "frac_agn"}
_OTHER_ARGUMENTS = {
    "zred": "redshift",
    "f_agn": "frac_agn",
    "fagn": "frac_agn",
    "agn_fraction": "frac_agn",
    "E_BV": "ebv",
    "ebmv": "ebv",
    "E_BVs_young": "ebv",
    "E_BVs_old_factor": "ebv_factor",
    "mass_formed": "mass",
}
#: Mass of living stars, in place of the mass formed that models have as their parameter.
LIVING_MASS = "stellar_mass"
#: Names of the logarithm of a mass in lower case.
_LOG_MASSES = ("log_mass", "logmass", "lmass", "log_m", "massformed", "log_massformed")


def by_our_names(values, parameters=(), *, short=False):
    """
    Return the values of parameters by our names, with the mass for its logarithm.

    Parameters
    ----------
    values : dict or `~astropy.table.Table`
        By parameter. A usual name of elsewhere, such as ``z``, counts where ours is not there, and one of CIGALE
        (``sfh.tau_main``), whose numbers without a unit are in CIGALE's.
    parameters : iterable of str, optional
        Our names of the parameters that there are.
    short : bool, optional
        Whether CIGALE's names count without their module too (``tau_main``).

    Raises
    ------
    `~astropy.units.UnitsError`
        See `plain_mass`.
    """
    names = values.colnames if isinstance(values, Table) else list(values)
    usual_names = _OTHER_NAMES
    if short:
        usual_names = _OTHER_NAMES | _OTHER_ARGUMENTS
    foreign_names = {}
    for theirs, ours in usual_names.items():
        if theirs not in parameters:
            foreign_names[theirs] = (ours, "")
    our_names = (*parameters, LIVING_MASS)
    for theirs, meaning in _cigale_parameters(our_names, short=short).items():
        if theirs not in parameters:
            foreign_names.setdefault(theirs, meaning)
    out = values.copy()
    for theirs in [name for name in names if name in foreign_names]:
        ours, unit = foreign_names[theirs]
        if ours in names:
            continue
        value = out[theirs]
        if unit and own_unit(value) is None:
            value = u.Quantity(value, unit)
        out[ours] = value
        del out[theirs]
    return plain_mass(out)


@cached
def _cigale_parameters(our_names, short):
    """Find our name and CIGALE's unit of CIGALE's parameters that are among ours: dict by CIGALE's name."""
    tables = declared("miricigale.cigale", "names.toml")
    meanings = {}
    for ours, (theirs, unit) in tables["quantities"].items():
        if ours not in our_names:
            continue
        names = [theirs]
        for of_module in tables["modules"].values():
            if ours in of_module:
                names.append(of_module[ours])
        meanings |= dict.fromkeys(names, (ours, unit))
    if not short:
        return meanings
    counts = Counter(name.partition(".")[2] for name in meanings)
    without_module = {}
    for name, meaning in meanings.items():
        short_name = name.partition(".")[2]
        # such as the temperature of both kinds of dust
        if counts[short_name] == 1:
            without_module[short_name] = meaning
    return meanings | without_module


def check_parameters(names, model):
    """
    Refuse the first of some names that is no parameter of a model.

    Raises
    ------
    KeyError
        Whose message says which components have such a parameter, and what stands in their place in the model; or
        what to write in place of a name of other programs; or lists the parameters.
    """
    known_names = [*model.parameters, LIVING_MASS]
    for name in names:
        if name in known_names:
            continue
        sentences = declared("miricigale.sed", "parameter_hints.toml")["sentences"]
        by_lower_case = {label.lower(): sentence for label, sentence in sentences.items()}
        sentence = sentences.get(name, by_lower_case.get(name.lower()))
        if sentence is not None:
            msg = f"no parameter {name!r}; {sentence}"
            raise KeyError(msg)
        ours, owners = _components_with(name)
        if owners:
            raise _parameter_of_others(name, ours, owners, model)
        check_names([name], "parameter", known_names)


def _components_with(name):
    """Return our name of a parameter, or of CIGALE's with or without module, and the components that have it."""
    owners = {}
    for component in COMPONENTS.names():
        for ours in COMPONENTS.get(component).declared():
            owners.setdefault(ours, []).append(component)
    if name in owners:
        return name, owners[name]
    ours, _ = _cigale_parameters(tuple(owners), short=True).get(name, (name, ""))
    return ours, owners.get(ours, [])


def _parameter_of_others(name, ours, owners, model):
    """Make the `KeyError` of a parameter that other components have than those of the model."""
    own_name = ""
    if ours != name:
        own_name = f" (here {ours!r})"
    roles = {COMPONENTS.metadata(owner)["role"] for owner in owners}
    in_place = []
    for component in model.components:
        if component.role in roles:
            names = ", ".join(component.parameters) or "no parameters"
            in_place.append(f"{component.name} ({names})")
    in_model = "no such component"
    if in_place:
        in_model = " and ".join(in_place)
    msg = f"no parameter {name!r} in this model: it is of {' and '.join(owners)}{own_name}; "
    msg += f"the model has {in_model}"
    return KeyError(msg)


def named_first(values, filters, named, argument):
    """
    Sort what is given of values and bands: values by name are in place of others, and bands alone may stand first.

    Parameters
    ----------
    values, filters : object or None
        The first two arguments, as they are given.
    named : dict of str to object
        Values by name.
    argument : str
        What ``values`` are called in messages.

    Returns
    -------
    values, filters : object or None
    """
    if not named:
        return values, filters
    if filters is None:
        filters, values = values, None
    # an option that is spelled wrong stands among the values too
    check_that(
        values is None, argument, f"left out beside values by name ({', '.join(named)})", "both"
    )
    return named, filters


def merged(values, named, available):
    """
    Return parameters that are given in a dict and by name.

    Parameters
    ----------
    values : dict or None
        Values by name.
    named : dict of str to object
        Those of keywords, none of which may be among ``values``.
    available : collection of str
        Parameters of the model, for messages.

    Raises
    ------
    ValueError
        If ``values`` is no dict; of a table the message has the call that takes its columns.
    """
    if values is None:
        return named
    if not isinstance(values, Mapping):
        raise argument_error(
            "values", "a dict of parameters by name", _columns_in_words(values, available)
        )
    twice = sorted(set(values) & set(named))
    check_that(not twice, "values", "without those given by keyword", twice)
    return dict(values) | named


def _columns_in_words(values, available):
    """Say what is no dict of parameters; of a table, the call that takes its columns."""
    columns = getattr(values, "colnames", getattr(values, "columns", None))
    if columns is None:
        return repr(values)
    names = [name for name in columns if name in available]
    columns = ", ".join(f"{name}=table[{name!r}]" for name in names)
    return f"a {type(values).__name__}: evaluate({columns}) takes its columns"


def parameter_table(parameters):
    """Return the table of a row for each model, of numbers or arrays of one shape by parameter."""
    values = {}
    for name, value in parameters.items():
        # numbers without a unit are in that of the parameter; a list may hold quantities
        quantity = u.Quantity(value)
        if quantity.unit == u.dimensionless_unscaled:
            quantity = quantity.value
        values[name] = quantity
    try:
        shape = np.broadcast_shapes((1,), *(value.shape for value in values.values()))
    except ValueError:
        shapes = ", ".join(f"{name} {value.shape}" for name, value in values.items())
        raise argument_error("parameters", "of one shape", shapes) from None
    check_that(len(shape) == 1, "parameters", "numbers or arrays of one dimension", shape)
    return QTable(
        {name: np.broadcast_to(value, shape, subok=True) for name, value in values.items()}
    )


def plain_mass(values):
    """
    Return the values of parameters by name in which a logarithm of the mass is the mass.

    Parameters
    ----------
    values : dict or `~astropy.table.Table`
        By parameter; ``log_mass`` and the like are log10 of the mass in solar masses, and left alone where there
        is a mass.

    Raises
    ------
    `~astropy.units.UnitsError`
        If the logarithm has a unit.
    """
    names = values.colnames if isinstance(values, Table) else list(values)
    logs = [name for name in names if name.lower() in _LOG_MASSES]
    if not logs or "mass" in names:
        return values
    out = values.copy()
    name = logs[0]
    unit = own_unit(out[name])
    if unit == u.dex(u.Msun):
        out["mass"] = out[name]
    else:
        if unit not in (None, u.dimensionless_unscaled):
            raise units_error(name, "in dex(Msun) or without unit", unit)
        exponent = np.ma.filled(np.ma.asarray(out[name], dtype=float), np.nan)
        out["mass"] = 10.0**exponent * u.Msun
    del out[name]
    return out


def single_models(parameters):
    """Yield the parameters of each model, of parameters some of which are arrays of one length."""
    arrays = {name: value for name, value in parameters.items() if np.ndim(value) == 1}
    lengths = {name: len(value) for name, value in arrays.items()}
    got = ", ".join(f"{length} of {name!r}" for name, length in lengths.items())
    check_that(len(set(lengths.values())) == 1, "parameters", "arrays of one length", got)
    n_models = first_value(lengths)
    for row in range(n_models):
        yield parameters | {name: value[row] for name, value in arrays.items()}
