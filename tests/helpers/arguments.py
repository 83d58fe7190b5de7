"""Arguments of public functions, classes and methods, as their docstrings state them."""

import importlib
import inspect
import itertools
import pkgutil
import re

import miricigale

_ENTRY = re.compile(r"(\*{0,2}\w+(?:, \*{0,2}\w+)*) : (.+)")


def _section_of_parameters(doc):
    """Names and types under "Parameters" of a numpydoc docstring."""
    lines = inspect.cleandoc(doc or "").splitlines()
    types = {}
    inside = False
    for line, below in itertools.pairwise([*lines, ""]):
        if below and set(below) == {"-"}:
            inside = line in ("Parameters", "Other Parameters")
        entry = _ENTRY.fullmatch(line)
        if inside and entry:
            for name in entry[1].split(", "):
                types[name.lstrip("*")] = entry[2]
    return types


def _functions(subpackage):
    """By name: the functions, classes and public methods of a subpackage."""
    module = importlib.import_module(f"miricigale.{subpackage}")
    functions = {}
    for name in getattr(module, "__all__", ()):
        value = getattr(module, name)
        if not callable(value):
            continue
        functions[f"{subpackage}.{name}"] = value
        if not inspect.isclass(value):
            continue
        for method in dir(value):
            function = inspect.getattr_static(value, method)
            function = getattr(function, "__func__", function)
            ours = getattr(function, "__module__", None) or ""
            is_public = not method.startswith("_") or method == "__call__"
            if is_public and inspect.isfunction(function) and ours.startswith("miricigale"):
                functions[f"{subpackage}.{name}.{method}"] = function
    return functions


def documented_arguments():
    """
    Return the arguments of everything public in the package.

    Returns
    -------
    arguments : dict of str to str
        By name, as in ``"filters.Filter.weights.wave"``: the type that the docstring states.
    """
    arguments = {}
    for item in pkgutil.iter_modules(miricigale.__path__):
        if item.name.startswith("_"):
            continue
        for name, function in _functions(item.name).items():
            for argument, stated in _section_of_parameters(function.__doc__).items():
                arguments[f"{name}.{argument}"] = stated
    return arguments
