"""Pages of the guide about components: one for each, with what the component declares."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from miricigale.refdata import resource
from miricigale.sed import COMPONENTS, DERIVED

DOCS = Path(__file__).parents[2] / "docs"
PAGES = DOCS / "guide" / "sed"

pytestmark = pytest.mark.skipif(not PAGES.is_dir(), reason="needs the folder docs/guide/sed")


@pytest.mark.parametrize("name", COMPONENTS.names())
def test_every_component_has_a_page(name):
    page = PAGES / f"{name}.rst"
    assert page.is_file(), f"no page docs/guide/sed/{name}.rst"
    assert re.search(rf"^\.\. sed-component:: {name}$", page.read_text(), flags=re.MULTILINE)
    index = (PAGES / "index.rst").read_text()
    assert re.search(rf"^   {name}$", index, flags=re.MULTILINE), f"{name} is not in the index"


def build(folder, text):
    """Build one page; warnings are errors."""
    source = folder / "source"
    (source / "guide").mkdir(parents=True)
    (source / "conf.py").write_text(
        f"import sys\nsys.path.insert(0, {str(DOCS / '_ext')!r})\nextensions = ['sed_component']\n"
    )
    (source / "guide" / "data.rst").write_text(":orphan:\n\nData\n====\n")
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
        assert f'Component: "{name}", "{cls.__name__}"' in page
        for par in cls.declared().values():
            assert f'"{par.name}"' in page
        for values in cls.all_options().values():
            assert all(f'"{value}"' in page for value in values)
        if cls.resource:
            added = f'"miricigale data add {cls.resource} PATH"' in page
            assert added == (resource(cls.resource).kind == "user")

    assert all(f'"{name}"' in page for name in DERIVED)


def test_an_unknown_component_fails_the_build(tmp_path):
    pytest.importorskip("sphinx")
    done, _ = build(tmp_path, "Title\n=====\n\n.. sed-component:: nonsense\n")
    assert done.returncode != 0
    assert "no component 'nonsense'; known: " in done.stderr
