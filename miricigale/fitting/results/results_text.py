"""Descriptions of results of a fit: their repr, and what a notebook shows."""

import html

import numpy as np

#: Objects that a notebook shows.
_SHOWN = 20


def representation(results):
    """Return the repr of `~miricigale.fitting.FitResults`."""
    bands = f"{len(results.filters)} bands"
    calibration = results.meta.get("fit", {}).get("calibration")
    if calibration:
        bands += f", errors and priors of {calibration}"
    if results.isscalar:
        key = np.asarray(results.ids).item()
        flags = ""
        if results.flags:
            flags = f", {results.flags}"
        text = f"chi2 {results.chi2:.4g} in {results.n_bands} of {bands}{flags}"
        return f"<FitResults of {key!r}, {text}>"
    good = int(np.count_nonzero(results.fitted))
    n = len(results)
    return f"<FitResults of {n} object{'s' * (n != 1)}, {good} fitted, {bands}>"


def html_representation(results):
    """Return the repr of results and the table of their first objects as HTML."""
    table = results._several()[:_SHOWN].to_table()._repr_html_()
    shown_text = ""
    if not (results.isscalar or len(results) <= _SHOWN):
        shown_text = f", the first {_SHOWN}"
    return f"<p>{html.escape(repr(results))}{shown_text}</p>{table}"
