"""Sphinx configuration."""

import doctest
import importlib.metadata
import os
import re
import subprocess
import sys
from pathlib import Path

from sphinx_astropy.conf.v2 import *  # noqa: F403
from sphinx_astropy.conf.v2 import exclude_patterns, extensions

project = "miricigale"
author = "The miricigale developers"
copyright = f"2026, {author}"
release = importlib.metadata.version("miricigale")
version = ".".join(release.split(".")[:2])

# the directive of the pages about components
sys.path.insert(0, str(Path(__file__).parent / "_ext"))

# what these pages do not use
extensions = [
    name
    for name in extensions
    if name
    not in (
        "matplotlib.sphinxext.plot_directive",
        "sphinx.ext.inheritance_diagram",
        "sphinx.ext.todo",
        "sphinx_astropy.ext.changelog_links",
        "sphinx_astropy.ext.generate_config",
    )
]
extensions.append("sed_component")
exclude_patterns = [*exclude_patterns, "changes/*"]

# links to other packages are made where the pages are published; elsewhere no network is needed
if os.environ.get("READTHEDOCS") == "True":
    intersphinx_mapping = {
        "python": ("https://docs.python.org/3/", None),
        "numpy": ("https://numpy.org/doc/stable/", None),
        "scipy": ("https://docs.scipy.org/doc/scipy/", None),
        "matplotlib": ("https://matplotlib.org/stable/", None),
        "astropy": ("https://docs.astropy.org/en/stable/", None),
        "photutils": ("https://photutils.readthedocs.io/en/stable/", None),
        "synphot": ("https://synphot.readthedocs.io/en/latest/", None),
    }
else:
    intersphinx_mapping = {}

default_role = "py:obj"
rst_epilog = ""
automodapi_toctreedirnm = "reference/api"
autodoc_typehints = "none"
# signatures show defaults as they are written
autodoc_preserve_defaults = True

html_title = f"miricigale {version}"
html_last_updated_fmt = None
html_copy_source = False
html_show_sourcelink = False
html_sidebars = {
    name: [] for name in ("index", "install", "quickstart", "dataflow", "tutorials/*", "changes")
}
html_theme_options = {
    "header_links_before_dropdown": 8,
    "icon_links": [],
    "navbar_persistent": ["search-button"],
    "navigation_with_keys": False,
    "navigation_depth": 3,
    "show_nav_level": 1,
    "show_toc_level": 2,
}


def draw_figures(app):
    """Run the tutorial, saving the current figure wherever the page has an image of it."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    page = Path(app.srcdir) / "tutorials" / "by_hand.rst"
    folder = Path(app.srcdir) / "_build" / "figures"
    folder.mkdir(parents=True, exist_ok=True)
    image = r"^\.\. image:: /_build/figures/(\S+)$"
    pieces = re.split(image, page.read_text(encoding="utf-8"), flags=re.MULTILINE)
    codes, names = pieces[0::2], pieces[1::2]
    paths = [folder / name for name in names]
    if all(path.exists() and path.stat().st_mtime > page.stat().st_mtime for path in paths):
        return
    namespace = {}
    for code, path in zip(codes, paths, strict=False):
        for example in doctest.DocTestParser().get_examples(code):
            exec(compile(example.source, page.name, "exec"), namespace)
        plt.gcf().savefig(path, dpi=110, bbox_inches="tight")
        plt.close("all")


def draft_changes(app):
    """Join the fragments of the next release, as towncrier will, for the page of changes."""
    command = [sys.executable, "-m", "towncrier", "build", "--draft"]
    command += ["--version", version, "--date", "unreleased"]
    text = subprocess.run(
        command, cwd=Path(app.srcdir).parent, check=True, stdout=subprocess.PIPE, text=True
    ).stdout
    path = Path(app.srcdir) / "_build" / "unreleased.rst"
    path.parent.mkdir(exist_ok=True)
    path.write_text(text, encoding="utf-8")


def setup(app):
    """Add what these pages need to Sphinx."""
    app.connect("builder-inited", draw_figures)
    app.connect("builder-inited", draft_changes)
