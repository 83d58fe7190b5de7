"""The dialect of ``pcigale.ini``: nested sections, lists, and the two forms of ranges."""

import ast
import math
import operator
from pathlib import Path

import numpy as np

from miricigale.utils.exceptions import DataError

__all__ = ["parse_ini", "parse_values"]

#: No parameter has more values than this.
_MAX_VALUES = 100_000


def parse_ini(path):
    """
    Read a configuration file of CIGALE.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    sections : dict
        Key to value, section to dict, as deep as they are nested. A value is a str, or a list
        of str where commas part it; values of ``eval`` and ``range`` stay whole.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file is missing or a line is none of section, ``key = value``, comment.
    """
    path = Path(path)
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as err:
        why = "no such file" if isinstance(err, FileNotFoundError) else err
        msg = f"{path} cannot be read as a configuration of CIGALE: {why}"
        raise DataError(msg) from None
    root = {}
    stack = [root]
    for number, line in enumerate(lines, 1):
        text = line.strip()
        if not text or text.startswith("#"):
            continue
        try:
            if text.startswith("["):
                _open_section(stack, text)
                continue
            key, sign, value = text.partition("=")
            key = key.strip().strip("'\"")
            if not sign or not key:
                msg = "neither a section nor 'key = value'"
                raise ValueError(msg)
            if key in stack[-1]:
                msg = f"{key!r} is there twice"
                raise ValueError(msg)
            stack[-1][key] = _split(value.strip())
        except ValueError as err:
            msg = f"{path}, line {number}: {err}"
            raise DataError(msg) from None
    return root


def _open_section(stack, text):
    depth = len(text) - len(text.lstrip("["))
    name, end, rest = text[depth:].partition("]" * depth)
    name, rest = name.strip(), rest.strip()
    if not name or not end or "]" in name or (rest and not rest.startswith("#")):
        msg = f"{text!r} is no section"
        raise ValueError(msg)
    if depth > len(stack):
        msg = f"section {name!r} is nested too deep"
        raise ValueError(msg)
    del stack[depth:]
    if name in stack[-1]:
        msg = f"section {name!r} is there twice"
        raise ValueError(msg)
    stack[-1][name] = {}
    stack.append(stack[-1][name])


def _split(text):
    """Value of a line: a str, or a list of str."""
    if text.startswith(('"""', "'''")):
        msg = "values of several lines (triple quotes) are not read"
        raise ValueError(msg)
    if text.startswith(("eval ", "range ")):
        return text.partition("#")[0].strip()
    items, item, quote, commas, quoted = [], "", "", 0, False
    for char in text:
        if quote:
            if char == quote:
                quote = ""
            else:
                item += char
        elif char in "\"'" and not item.strip():
            quote, item, quoted = char, "", True
        elif char == "#":
            break
        elif char == ",":
            items.append(item if quoted else item.strip())
            item, quoted, commas = "", False, commas + 1
        elif not (quoted and char.isspace()):
            item += char
    if quote:
        msg = f"the quote {quote} is not closed"
        raise ValueError(msg)
    item = item if quoted else item.strip()
    if not commas:
        return item
    if item or quoted:
        items.append(item)
    return [x for x in items if x]


def parse_values(value, name):
    """
    Numbers of a parameter.

    Parameters
    ----------
    value : str or list of str
        Numbers; ``range start stop step``, which includes ``stop``; or ``eval`` and an
        expression of numbers, lists and the functions of numpy in `FUNCTIONS`. Nothing is
        executed: the expression is taken apart, and anything else in it is refused.
    name : str
        Name of the parameter, for messages.

    Returns
    -------
    values : `~numpy.ndarray`, shape (n,)
        Ascending.

    Raises
    ------
    ValueError
        If it is something else, or a value is there twice.
    """
    try:
        if isinstance(value, str) and value.startswith("eval "):
            numbers = np.atleast_1d(_evaluate(value[5:].strip()))
        elif isinstance(value, str) and value.startswith("range "):
            numbers = _range(value[6:])
        else:
            items = [value] if isinstance(value, str) else value
            numbers = np.array([float(item) for item in items])
        numbers = np.asarray(numbers, dtype=float)
    except (ValueError, TypeError, ArithmeticError, SyntaxError, RecursionError) as err:
        text = value if isinstance(value, str) else ", ".join(value)
        msg = f"{name} = {text} cannot be read as numbers: {err}"
        raise ValueError(msg) from None
    if numbers.ndim != 1 or not numbers.size or not np.all(np.isfinite(numbers)):
        msg = f"{name} must be a list of finite numbers, got {value}"
        raise ValueError(msg)
    unique = np.unique(numbers)
    if unique.size < numbers.size:
        msg = f"{name} has a value twice: {value}"
        raise ValueError(msg)
    return unique


def _range(text):
    """Values from start to stop, both included, as ``numpy.arange(start, stop + step, step)``."""
    items = [float(x) for x in text.split()]
    if len(items) != 3:
        msg = "'range' takes start, stop and step"
        raise ValueError(msg)
    return _arange(items[0], items[1] + items[2], items[2])


def _arange(*args):
    start, stop, step = {1: (0.0, *args, 1.0), 2: (*args, 1.0)}.get(len(args), args)
    # one too many would come from rounding, where (stop - start) / step is whole
    number = math.ceil((stop - start) / step - 1e-9)
    return start + step * np.arange(_count(max(number, 0)))


def _count(number):
    if number != int(number) or not 0 <= number <= _MAX_VALUES:
        msg = f"{number:g} values are not from 0 to {_MAX_VALUES}"
        raise ValueError(msg)
    return int(number)


def _spaced(function):
    def made(start, stop, num=50, **options):
        if not set(options) <= {"endpoint", "base"}:
            msg = f"arguments {sorted(options)}"
            raise ValueError(msg)
        return function(float(start), float(stop), _count(num), **options)

    return made


#: What an expression may call.
FUNCTIONS = {
    "linspace": _spaced(np.linspace),
    "logspace": _spaced(np.logspace),
    "geomspace": _spaced(np.geomspace),
    "arange": _arange,
    "array": np.atleast_1d,
    "append": np.append,
    "concatenate": np.concatenate,
    "round": np.round,
    "around": np.round,
    "log10": np.log10,
    "log": np.log,
    "exp": np.exp,
    "sqrt": np.sqrt,
}
_OPERATORS = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: lambda a, b: np.float64(a) ** b if np.ndim(a) == 0 else a**b,
}


def _evaluate(text):
    with np.errstate(all="raise"):
        try:
            return _value(ast.parse(text, mode="eval").body)
        except FloatingPointError as err:
            raise ValueError(str(err)) from None


def _value(node):
    match node:
        case ast.Constant(value=int() | float() | bool() as value):
            return value if isinstance(value, bool) else float(value)
        case ast.List() | ast.Tuple():
            items = [_value(x) for x in node.elts]
            return np.array(items) if all(np.ndim(x) == 0 for x in items) else items
        case ast.UnaryOp(op=ast.USub()):
            return -_value(node.operand)
        case ast.UnaryOp(op=ast.UAdd()):
            return _value(node.operand)
        case ast.BinOp() if type(node.op) in _OPERATORS:
            return _OPERATORS[type(node.op)](_value(node.left), _value(node.right))
        case ast.Call(func=ast.Attribute(value=ast.Name(id="np" | "numpy"), attr=name)):
            function = FUNCTIONS.get(name)
        case ast.Call(func=ast.Name(id="round" | "list" | "range" as name)):
            function = {"round": np.round, "list": np.atleast_1d, "range": _arange}[name]
        case ast.Attribute(value=ast.Name(id="np" | "numpy"), attr="pi"):
            return math.pi
        case _:
            msg = f"{ast.unparse(node)!r} is not an expression that is read"
            raise ValueError(msg)
    if function is None:
        msg = f"np.{name} is not read; known: {', '.join(FUNCTIONS)}"
        raise ValueError(msg)
    options = {x.arg: _value(x.value) for x in node.keywords}
    args = [_value(x) for x in node.args]
    if name in ("round", "around") and len(args) == 2:
        args[1] = int(args[1])
    return function(*args, **options)
