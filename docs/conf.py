"""Sphinx configuration."""

import importlib.metadata
import os
import shutil
import subprocess
import sys
from pathlib import Path

from sphinx_astropy.conf.v2 import *  # noqa: F403
from sphinx_astropy.conf.v2 import exclude_patterns, extensions
from sphinx_gallery.sorting import ExplicitOrder

project = "miricigale"
author = "The miricigale developers"
copyright = f"2026, {author}"
release = importlib.metadata.version("miricigale")
version = ".".join(release.split(".")[:2])

# the directive of the pages about components
sys.path.insert(0, str(Path(__file__).parent / "_ext"))

# what these pages do not use; equations are MathML, which needs no script and no network
extensions = [
    name
    for name in extensions
    if name
    not in (
        "sphinx.ext.mathjax",
        "sphinx.ext.inheritance_diagram",
        "sphinx.ext.todo",
        "sphinx_astropy.ext.changelog_links",
        "sphinx_astropy.ext.generate_config",
    )
]
extensions += [
    "flag_table",
    "mathml",
    "sed_component",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = [*exclude_patterns, "changes/*", "examples/*"]
html_static_path = ["_static"]
html_css_files = ["miricigale.css"]
html_search_scorer = str(Path(__file__).parent / "_static" / "scorer.js")
# a straight quotation mark is the sign of arcsec on these pages: only dashes and dots are replaced
smartquotes_action = "De"
html_favicon = "_static/logo.svg"

# the scripts of ``examples`` become pages with their figures, notebooks and scripts to download
# they run in a copy, where the files that they write stay
_EXAMPLES = Path(__file__).parent / "_build" / "examples"
shutil.rmtree(_EXAMPLES, ignore_errors=True)
shutil.copytree(Path(__file__).parent / "examples", _EXAMPLES)
sphinx_gallery_conf = {
    "examples_dirs": ["_build/examples/tutorials", "_build/examples/how_to"],
    "gallery_dirs": ["tutorials", "how_to"],
    "filename_pattern": r"\.py$",
    "within_subsection_order": "FileNameSortKey",
    "nested_sections": True,
    "subsection_order": ExplicitOrder(
        [
            f"_build/examples/how_to/{theme}"
            for theme in ("plan", "measure", "fit", "simulate", "reduce", "models", "run")
        ]
    ),
    "remove_config_comments": True,
    "abort_on_example_error": True,
    "show_signature": False,
    "show_memory": False,
    "min_reported_time": 1e6,
    "reference_url": {"miricigale": None},
    "doc_module": ("miricigale",),
    "backreferences_dir": None,
    "plot_gallery": os.environ.get("MIRICIGALE_GALLERY", "1") == "1",
}
# figures of the pages about methods are drawn by their code
plot_html_show_formats = False
plot_html_show_source_link = False
plot_include_source = False
plot_formats = [("png", 110)]
plot_rcparams = {"figure.figsize": (7, 4), "figure.constrained_layout.use": True}
plot_apply_rcparams = True

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
# addresses stand in ``project_urls`` of setup.cfg alone, from the first release on
_ADDRESSES = dict(
    entry.split(", ", 1)
    for entry in importlib.metadata.metadata("miricigale").get_all("Project-URL") or ()
)


def _address(label, text):
    """A link of the metadata, or that there is none yet."""
    if label in _ADDRESSES:
        return f"`{text} <{_ADDRESSES[label]}>`__"
    return f"{text} (not yet published)"


rst_epilog = f"""
.. |repository| replace:: {_address("Repository", "repository")}
.. |issues| replace:: {_address("Issues", "issues of the repository")}
"""
automodapi_toctreedirnm = "reference/api"
autodoc_typehints = "none"
# signatures show defaults as they are written
autodoc_preserve_defaults = True

html_title = f"miricigale {version}"
html_last_updated_fmt = None
html_copy_source = False
html_show_sourcelink = False
html_sidebars = {"index": []}
html_theme_options = {
    "logo": {
        "image_light": "_static/logo.svg",
        "image_dark": "_static/logo.svg",
        "text": "miricigale",
    },
    "header_links_before_dropdown": 8,
    "icon_links": [],
    "navbar_persistent": ["search-button"],
    "navigation_with_keys": False,
    "navigation_depth": 3,
    "show_nav_level": 1,
    "show_toc_level": 2,
}


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
    app.connect("builder-inited", draft_changes)
