"""The text of ``pcigale.ini``: sections and values by configobj, ranges and expressions here."""

import ast
import math
import operator
from pathlib import Path

import numpy as np

from miricigale.utils.exceptions import config_error, data_error
from miricigale.utils.named_values import attributes
from miricigale.utils.options import check_that
from miricigale.utils.package_tables import declared

_DECLARED = declared("miricigale.cigale", "pcigale.toml")
#: Values of ``lim_flag``, those of older versions too.
LIMIT_FLAGS = _DECLARED["limit_flags"]
#: No parameter has more values than this.
_MAX_VALUES = 100_000


def parse_ini(path):
    """
    Read a configuration file of CIGALE: key to value, section to dict, as deep as they are nested.

    Values of modules are a str, or a list of str where commas part them; the others have the types of
    CIGALE's specification. A file that cannot be read is a `DataError`, a setting of a wrong type or
    value a `ConfigError`.
    """
    # the library that CIGALE itself uses; astropy bundles a copy
    from astropy.extern.configobj import configobj, validate

    spec = _DECLARED["specification"].format(limits=", ".join(LIMIT_FLAGS)).splitlines()
    try:
        if not Path(path).is_file():
            msg = "no such file"
            raise OSError(msg)
        config = configobj.ConfigObj(
            str(path), configspec=spec, encoding="utf-8", interpolation=False
        )
    except (OSError, UnicodeError, configobj.ConfigObjError) as err:
        raise data_error(path, f"cannot be read as a configuration of CIGALE: {err}") from None
    analysis = config.get("analysis_params", {})
    sections = config.get("sed_modules_params"), analysis
    if "sed_modules" not in config or not all(isinstance(part, dict) for part in sections):
        raise data_error(
            path, "is no configuration of CIGALE: no sed_modules, or no [sed_modules_params]"
        )
    for section in (config, analysis):
        for key in [key for key, value in section.items() if value == ""]:
            del section[key]
    validity = config.validate(validate.Validator(), preserve_errors=True)
    for sections, key, error in configobj.flatten_errors(config, validity):
        key = ".".join(sections + [str(key)])
        raise config_error(path, f"is wrong at {key}: {error or 'missing'}")
    return config.dict()


def parse_values(value, name):
    """
    Return the numbers of a parameter, ascending: array of shape (n,); ``name`` is for messages.

    ``value`` is numbers; ``range start stop step``, which includes ``stop``; or ``eval`` and an
    expression of numbers, lists and the functions of numpy in `FUNCTIONS`. Nothing is executed: the
    expression is taken apart, and anything else in it, or a value that is there twice, is a ValueError.
    """
    items = value
    if isinstance(value, str):
        items = [value]
    # an expression without quotes was split at its commas
    text = ", ".join(items)
    try:
        if text.startswith("eval "):
            with np.errstate(all="raise"):
                numbers = _value(ast.parse(text[5:].strip(), mode="eval").body)
        elif text.startswith("range "):
            start, stop, step = map(float, text[6:].split())
            # both ends are included
            numbers = _arange(start, stop + step, step)
        else:
            numbers = np.array([float(item) for item in items])
        numbers = np.atleast_1d(numbers).astype(float)
    except (ValueError, TypeError, ArithmeticError, SyntaxError, RecursionError) as err:
        msg = f"{name} = {text} cannot be read as numbers: {err}"
        raise ValueError(msg) from None
    good = numbers.ndim == 1 and numbers.size and np.all(np.isfinite(numbers))
    check_that(good, name, "a list of finite numbers", value)
    unique = np.unique(numbers)
    check_that(unique.size == numbers.size, name, "of different values", value)
    return unique


def _arange(*args):
    start = 0.0
    step = 1.0
    if len(args) == 1:
        (stop,) = args
    elif len(args) == 2:
        start, stop = args
    else:
        start, stop, step = args
    # one too many would come from rounding, where (stop - start) / step is whole
    number = math.ceil((stop - start) / step - 1e-9)
    return start + step * np.arange(_count(max(number, 0)))


def _count(number):
    good = number == int(number) and 0 <= number <= _MAX_VALUES
    check_that(good, "number of values", f"from 0 to {_MAX_VALUES}", f"{number:g}")
    return int(number)


def _spaced(function):
    def values(start, stop, num=50, **options):
        names = ["base", "endpoint"]
        check_that(options.keys() <= set(names), "arguments", f"of {names}", sorted(options))
        return function(float(start), float(stop), _count(num), **options)

    return values


def _round(values, decimals=0):
    return np.round(values, int(decimals))


#: What an expression may call, after ``np.``.
FUNCTIONS = attributes(np, ("append", "concatenate", "exp", "log", "log10"))
FUNCTIONS |= {name: _spaced(getattr(np, name)) for name in ("geomspace", "linspace", "logspace")}
FUNCTIONS |= {"arange": _arange, "array": np.atleast_1d, "sqrt": np.sqrt}
FUNCTIONS |= {"round": _round, "around": _round}
_BUILTINS = {"round": _round, "list": np.atleast_1d, "range": _arange}
_OPERATORS = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: lambda a, b: np.float64(a) ** b if np.ndim(a) == 0 else a**b,
}


def _value(node):
    match node:
        case ast.Constant(value=int() | float() | bool() as value):
            if isinstance(value, bool):
                return value
            return float(value)
        case ast.List() | ast.Tuple():
            items = [_value(x) for x in node.elts]
            if all(np.ndim(x) == 0 for x in items):
                return np.array(items)
            return items
        case ast.UnaryOp(op=ast.USub()):
            return -_value(node.operand)
        case ast.UnaryOp(op=ast.UAdd()):
            return _value(node.operand)
        case ast.BinOp() if type(node.op) in _OPERATORS:
            return _OPERATORS[type(node.op)](_value(node.left), _value(node.right))
        case ast.Call(func=ast.Attribute(value=ast.Name(id="np" | "numpy"), attr=name)):
            function = FUNCTIONS.get(name)
        case ast.Call(func=ast.Name(id=name)):
            function = _BUILTINS.get(name)
        case ast.Attribute(value=ast.Name(id="np" | "numpy"), attr="pi"):
            return math.pi
        case _:
            function = None
    if function is None:
        msg = f"{ast.unparse(node)!r} is not read; known: {', '.join(FUNCTIONS)}"
        raise ValueError(msg)
    options = {x.arg: _value(x.value) for x in node.keywords}
    return function(*map(_value, node.args), **options)
