"""Sphinx configuration."""

import importlib.metadata
import os

from sphinx_astropy.conf.v2 import *  # noqa: F403
from sphinx_astropy.conf.v2 import exclude_patterns, extensions

project = "miricigale"
author = "The miricigale developers"
copyright = f"2026, {author}"
release = importlib.metadata.version("miricigale")
version = ".".join(release.split(".")[:2])

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
    "navigation_with_keys": False,
    "navigation_depth": 3,
    "show_nav_level": 1,
    "show_toc_level": 2,
}
