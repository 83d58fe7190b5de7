#!/usr/bin/env python3
"""
Keyword options (arguments with a default) of all functions, and who gives them: `list_options.py [SUBPACKAGE]`.

A call counts for every function of its name, so that the lists of callers are upper bounds. Options that only the
tests give, or nobody, are marked: they are candidates for a constant.
"""

import ast
import collections
import pathlib
import sys

ROOT = pathlib.Path(__file__).resolve().parent.parent
CALLERS = ("miricigale", "benchmarks", "tools", "tests")


def given_options(folder):
    """Names of functions by the options that calls in a folder give."""
    given = collections.defaultdict(set)
    for path in (ROOT / folder).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call):
                name = getattr(node.func, "attr", getattr(node.func, "id", None))
                for keyword in node.keywords:
                    given[keyword.arg].add(name)
    return given


def functions(body, owner=""):
    """All functions of a body with the name of their class."""
    for node in body:
        if isinstance(node, ast.ClassDef):
            yield from functions(node.body, node.name)
        elif isinstance(node, ast.FunctionDef):
            yield owner, node
            yield from functions(node.body, owner)


def options(function):
    """Names of the arguments that have a default."""
    args = function.args
    names = [arg.arg for arg in args.args[len(args.args) - len(args.defaults) :]]
    keywords = zip(args.kwonlyargs, args.kw_defaults, strict=True)
    return names + [arg.arg for arg, default in keywords if default is not None]


def main(subpackage=""):
    given = {folder: given_options(folder) for folder in CALLERS}
    pages = "".join(path.read_text() for path in sorted((ROOT / "docs").rglob("*.rst")))
    pages = pages.replace(" ", "")
    n_all = n_marked = 0
    for path in sorted((ROOT / "miricigale" / subpackage).rglob("*.py")):
        for owner, function in functions(ast.parse(path.read_text()).body):
            names = {function.name} if function.name != "__init__" else {owner, "cls", "__init__"}
            for option in options(function):
                callers = [folder for folder in CALLERS if given[folder][option] & names]
                callers += ["docs"] if f"{option}=" in pages else []
                marked = callers in ([], ["tests"])
                n_all, n_marked = n_all + 1, n_marked + marked
                where = f"{path.relative_to(ROOT / 'miricigale')}:{function.lineno}"
                name = f"{owner}.{function.name}" if owner else function.name
                print(f"{'*' if marked else ' '} {where} {name}({option}): {', '.join(callers)}")
    print(f"{n_all} options; {n_marked} that only tests or nobody gives (*)")


if __name__ == "__main__":
    main(*sys.argv[1:])
