"""Sphinx configuration."""

import importlib.metadata

from sphinx_astropy.conf.v2 import *  # noqa: F403
from sphinx_astropy.conf.v2 import exclude_patterns, extensions, intersphinx_mapping

project = "miricigale"
author = "The miricigale developers"
copyright = f"2026, {author}"
release = importlib.metadata.version("miricigale")
version = ".".join(release.split(".")[:2])

extensions = [e for e in extensions if e not in ("sphinx.ext.doctest",)]
exclude_patterns.extend(["_build", "changes/*", "**.ipynb_checkpoints"])

# the documentation builds without a network
intersphinx_mapping.clear()
default_role = "py:obj"
nitpicky = False
numpydoc_xref_param_type = False
numpydoc_show_class_members = False
automodapi_toctreedirnm = "reference/api"
suppress_warnings = ["intersphinx.external"]

html_theme = "pydata_sphinx_theme"
html_title = f"miricigale {version}"
html_static_path = []
html_theme_options = {"show_toc_level": 2, "navigation_with_keys": False}
templates_path = []
