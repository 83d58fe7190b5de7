"""Pages to look things up in have every flag and column."""

import ast
import importlib.util
import inspect
import pkgutil
import re
import textwrap
from pathlib import Path

import pytest

import miricigale
from miricigale.utils.tables import Flags

DOCS = Path(__file__).parents[1] / "docs"
OPTIONAL = ("_stpsf", "_jwst", "__main__")


def load(name):
    spec = importlib.util.spec_from_file_location(name, DOCS / "_ext" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


lookup = load("lookup")


def blocks(page, directive):
    """Contents of the directives of a page."""
    text = (DOCS / page).read_text(encoding="utf-8")
    found = re.findall(rf"^\.\. {directive}::.*\n((?:\n|   .*\n)+)", text, re.MULTILINE)
    return [textwrap.dedent(block).strip("\n") for block in found]


def test_every_class_of_flags_is_on_its_page():
    for module in pkgutil.walk_packages(miricigale.__path__, "miricigale."):
        if not module.name.endswith(OPTIONAL):
            importlib.import_module(module.name)
    text = (DOCS / "flags.rst").read_text(encoding="utf-8")
    shown = [path.rpartition(".") for path in re.findall(r"\.\. flag-table:: (\S+)", text)]
    classes = [getattr(importlib.import_module(module), name) for module, _, name in shown]
    packaged = [one for one in Flags.__subclasses__() if one.__module__.startswith("miricigale.")]
    assert {one.__qualname__ for one in classes} == {one.__qualname__ for one in packaged}


def test_every_flag_has_a_meaning():
    for one in Flags.__subclasses__():
        if not one.__module__.startswith("miricigale."):
            continue
        texts = {value: text for value, (_, text) in one.meanings().items()}
        assert [one(value) for value, text in texts.items() if not text] == []
        assert [text for _, _, text in lookup.flag_rows(one) if not text.endswith(".")] == []
        assert inspect.getdoc(one)


def test_columns_of_tables_have_a_meaning():
    names, found = {}, {}
    for block in blocks("columns.rst", "column-table"):
        rows = lookup.column_rows(lookup.run_block(block, names))
        assert [name for name, _, text in rows if not text] == []
        found |= {name: text for name, _, text in rows}
    assert {"flux_err_template", "redshift_p50", "mass_logmean", "<band>_true"} <= set(found)


def pattern(node, names):
    """Regular expression of the text that an expression makes; anything where it is not literal."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return re.sub(r"%(\\?-?[\d.]*[a-z])", ".+?", re.escape(node.value).replace("%%", "%"))
    if isinstance(node, ast.JoinedStr):
        return "".join(
            pattern(one, names) if isinstance(one, ast.Constant) else ".*?" for one in node.values
        )
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        given = [pattern(one, names) for one in node.args]
        if node.func.id == "argument_error" and len(given) == 3:
            return f"'{given[0]}' must be {given[1]}, got {given[2]}"
        if node.func.id == "check_that" and len(given) == 4:
            return f"'{given[1]}' must be {given[2]}, got {given[3]}"
        if node.func.id in ("data_error", "config_error") and len(given) == 2:
            return " ".join(given)
        if node.func.id == "unknown_name" and len(given) == 3:
            return f"no {given[0]} '.+?'; (known: |the nearest of \\d+ are )"
    return names.get(node.id, ".+?") if isinstance(node, ast.Name) else ".+?"


def texts(source):
    """Regular expressions of the longer texts of a module."""
    for scope in ast.walk(ast.parse(source)):
        names = {}
        if not isinstance(scope, ast.FunctionDef):
            continue
        nodes = list(ast.walk(scope))
        for node in nodes:
            if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
                names[node.targets[0].id] = pattern(node.value, names)
        for node in nodes:
            if isinstance(node, ast.JoinedStr | ast.Constant | ast.Call):
                text = pattern(node, names)
                yield re.sub(r"(\\? )+", " +", text)


def letters(text):
    return len(re.sub(r"\W|_", "", text))


@pytest.mark.slow
def test_messages_of_troubleshooting_are_those_of_the_code():
    pages = [path.name for path in sorted(DOCS.glob("troubleshooting*.rst"))]
    every = [one for page in pages for one in blocks(page, "code-block")]
    messages = [" ".join(one.split()) for one in every]
    assert len(messages) >= 25
    missing = {message.removeprefix("text ") for message in messages}
    # a text of few letters fits anything
    least = {message: letters(message) / 3 for message in missing}
    seen = set()
    for path in Path(miricigale.__file__).parent.rglob("*.py"):
        of_module = set(texts(path.read_text(encoding="utf-8"))) - seen
        seen |= of_module
        for text in of_module:
            n_letters = letters(text)
            # patterns are slow to make: of few texts all words are in a message
            word = re.search(r"\w{4,}|$", text)[0]
            near = [one for one in missing if n_letters > least[one] and word in one]
            missing.difference_update(one for one in near if re.search(text, one))
    assert sorted(missing) == []
