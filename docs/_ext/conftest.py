"""Sphinx's extensions need Sphinx, which tests do without: pytest does not import them."""

collect_ignore_glob = ["*.py"]
