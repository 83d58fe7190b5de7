"""Pages about components: one for each, with what the component declares and a figure."""

import re
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

from miricigale.refdata import resource
from miricigale.sed import COMPONENTS, DERIVED

DOCS = Path(__file__).parents[2] / "docs"
PAGES = DOCS / "method" / "sed"

pytestmark = pytest.mark.skipif(not PAGES.is_dir(), reason="needs the folder docs/method/sed")


@pytest.mark.parametrize("name", COMPONENTS.names())
def test_every_component_has_a_page(name):
    page = PAGES / f"{name}.rst"
    assert page.is_file(), f"no page docs/method/sed/{name}.rst"
    assert re.search(rf"^\.\. sed-component:: {name}$", page.read_text(), flags=re.MULTILINE)
    index = (PAGES / "index.rst").read_text()
    entry = rf"^   (?:{name}|.+ <{name}>)$"
    assert re.search(entry, index, flags=re.MULTILINE), f"{name} is not in the index"


@pytest.mark.parametrize("name", COMPONENTS.names())
def test_the_figure_of_a_component_shows_what_its_parameters_do(name, monkeypatch):
    monkeypatch.syspath_prepend(str(DOCS / "_ext"))
    from component_figure import draw, panels_of

    data = COMPONENTS.get(name).resource
    brought = name == "sfh_table" or (data and resource(data).kind == "user")
    panels = panels_of(name)
    assert (not panels) == bool(brought)
    if brought:
        return
    figure = draw(name)
    for ax, values in zip(figure.axes, panels.values(), strict=True):
        curves = [tuple(map(tuple, line.get_xydata())) for line in ax.lines]
        assert len(set(curves)) == len(values)
        assert len(ax.get_legend().get_texts()) == len(values)
    plt.close(figure)


def build(folder, text):
    """Build one page; warnings are errors."""
    source = folder / "source"
    (source / "method").mkdir(parents=True)
    (source / "conf.py").write_text(
        f"import sys\nsys.path.insert(0, {str(DOCS / '_ext')!r})\n"
        "extensions = ['sed_component']\nplot_formats = ['png']\n"
    )
    (source / "method" / "data.rst").write_text(":orphan:\n\nData\n====\n")
    (source / "index.rst").write_text(text)
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "text"]
    command += [str(source), str(folder / "out")]
    done = subprocess.run(command, capture_output=True, text=True)
    page = folder / "out" / "index.txt"
    return done, " ".join(page.read_text().split()) if page.exists() else ""


def test_the_directive_shows_what_every_component_declares(tmp_path):
    pytest.importorskip("sphinx")
    block = "{0}\n------------------------\n\n.. sed-component:: {0}\n"
    blocks = [block.format(name) for name in COMPONENTS.names()]
    done, page = build(tmp_path, "\n".join(["Title\n=====\n", *blocks, ".. sed-derived::\n"]))
    assert done.returncode == 0, done.stderr
    for name in COMPONENTS.names():
        cls = COMPONENTS.get(name)
        assert f'Name: "{name}", "{cls.__name__}"' in page
        for par in cls.declared().values():
            assert f'"{par.name}"' in page
        for values in cls.all_options().values():
            assert all(f'"{value}"' in page for value in values)
        if cls.resource:
            added = f'"miricigale data add {cls.resource} PATH"' in page
            assert added == (resource(cls.resource).kind == "user")

    assert all(f'"{name}"' in page for name in DERIVED)
    figures = {path.name for path in (tmp_path / "out" / "plot_directive").glob("*[0-9].png")}
    assert len(figures) == page.count("for some values of its parameters, the others") > 15


def test_an_unknown_component_fails_the_build(tmp_path):
    pytest.importorskip("sphinx")
    done, _ = build(tmp_path, "Title\n=====\n\n.. sed-component:: nonsense\n")
    assert done.returncode != 0
    assert "no component 'nonsense'; known: " in done.stderr
