"""Descriptions of a fitter in words: its repr, its facts for people, and the lines of a log."""

import numpy as np


def engine_name(fitter):
    """Return the name of a fitter's engine, or the repr of a sampler of the user's."""
    if isinstance(fitter.engine, str):
        return fitter.engine
    return repr(fitter.engine)


def representation(fitter):
    """Return the repr of a `~miricigale.fitting.BayesFitter`."""
    bands = "bands of the photometry"
    if fitter.filters is not None:
        bands = f"{len(fitter.filters)} bands"
    if fitter.waits:
        return f"<BayesFitter of {fitter.model!r}, {bands}>"
    if fitter.engine == "grid":
        return f"<BayesFitter of {fitter.grid!r}, {bands}>"
    names = ", ".join(fitter.priors)
    return f"<BayesFitter of {fitter.model!r}, {bands}, {engine_name(fitter)}, free: {names}>"


def facts(fitter):
    """Return what notebooks show of a `~miricigale.fitting.BayesFitter`: a dict of str to str."""
    if fitter.waits:
        return {
            "BayesFitter": engine_name(fitter),
            "models": repr(fitter.model),
            "bands": "of the photometry",
        }
    return {
        "BayesFitter": engine_name(fitter),
        "models": repr(fitter.grid or fitter.model),
        "bands": ", ".join(fitter.filters or fitter.bands),
        "errors and priors": errors_and_priors(fitter),
    }


def statement(fitter, unused=()):
    """
    Describe what a fitter fits in three lines: models, bands, and errors with priors.

    Parameters
    ----------
    fitter : `~miricigale.fitting.BayesFitter`
        The fitter.
    unused : iterable of str, optional
        Bands of the catalog that are not fitted.

    Returns
    -------
    lines : list of str
    """
    bands = fitter.filters or fitter.bands
    lost = ""
    if unused:
        lost = f"; not fitted: {', '.join(unused)}"
    return [
        f"models: {_models(fitter)}",
        f"bands: {len(bands)} fitted, {', '.join(bands)}{lost}",
        f"errors and priors: {errors_and_priors(fitter)}",
    ]


def _models(fitter):
    """Describe the models: the grid by its name, its size and redshifts."""
    if fitter.grid is None:
        return f"{fitter.model!r}, by {fitter.engine}"
    z = fitter.grid.redshift
    name = "a grid"
    if fitter.grid_name is not None:
        name = f"the grid {fitter.grid_name!r}"
    text = f"{name} of {fitter.grid.n_models:,} models, redshifts {z[0]:.2f} to {z[-1]:.2f}"
    if fitter.model is None:
        return text
    return f"{text}, of {fitter.model!r}"


def errors_and_priors(fitter):
    """Describe calibration, errors as parts of the flux, and priors of a fitter in a line."""
    settings = fitter.settings()
    parts = []
    if "calibration" in settings:
        parts.append(f"calibration {settings['calibration']!r}")
    if fitter.template_error is not None:
        parts.append(f"errors of the models {_span(fitter.template_error.error)} % of the flux")
    model_errors = list(settings["model_error"].values())
    if max(model_errors) > 0.0:
        parts.append(f"{_span(model_errors)} % of the flux added to errors")
    factors = list(settings.get("error_factor", {}).values())
    if factors and max(factors) > 1.0:
        parts.append(f"errors times {min(factors):.2g} to {max(factors):.2g}")
    if "outliers" in settings:
        parts.append(f"{_span(settings['outliers'].values())} % of fluxes wrong")
    names = _priors(fitter)
    if names:
        parts.append(f"priors of {', '.join(names)}")
    else:
        parts.append("all nodes equally likely")
    return "; ".join(parts)


def _span(values):
    """Format smallest and largest of some numbers in per cent; one number if they are the same."""
    low = f"{100.0 * min(values):.0f}"
    high = f"{100.0 * max(values):.0f}"
    if low == high:
        return low
    return f"{low} to {high}"


def _priors(fitter):
    """List the parameters whose prior is not flat in the nodes; all of a sampler."""
    if fitter.grid is None:
        return list(fitter.priors)
    settings = fitter.backend.given
    names = [name for name, axis in fitter.priors.axes.items() if not _is_flat(axis.weights)]
    if settings.mass_function is not None:
        names.append("mass and redshift")
    if settings.sfr_prior is not None:
        names.append("star-formation rate")
    return names


def _is_flat(weights):
    return np.ptp(weights) <= 1e-9 * np.max(weights)
