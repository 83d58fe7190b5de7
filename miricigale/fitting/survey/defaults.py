"""What is fitted where nothing else is said: models of real galaxies, their grid and their calibration."""

import numpy as np

from miricigale.filters import FilterSet, find_filter
from miricigale.sed import ModelGrid, SEDModel
from miricigale.sed.presets import GRIDS, grid_axes
from miricigale.utils.caching import cached
from miricigale.utils.exceptions import argument_error
from miricigale.utils.options import check_that

#: For a calibration: that of the models.
DEFAULT = "default"


def models_and_bands(model, filters, axes):
    """
    Find the models and bands that arguments of `~miricigale.fitting.BayesFitter` stand for.

    Parameters
    ----------
    model : `~miricigale.sed.ModelGrid`, `~miricigale.sed.SEDModel`, list of str, `FilterSet` or None
        Bands alone are taken as ``filters``.
    filters : list of str, `FilterSet` or None
        Bands.
    axes : dict, str or None
        Parameters to values, or the name of a grid.

    Returns
    -------
    model : object
        As given, or `SEDModel.for_axes` where only bands or nothing was given.
    filters : list of str, `FilterSet` or None
        Bands.
    """
    if isinstance(model, (list, tuple, FilterSet)):
        check_that(filters is None, "filters", "left out where 'model' is a list of bands", filters)
        filters = model
        model = None
    if filters is not None and not isinstance(filters, (str, FilterSet)):
        filters = list(filters)
        if not all(isinstance(name, str) for name in filters):
            # curves of one's own among names
            filters = FilterSet(filters)
    if model is None:
        grid_name = "survey"
        if isinstance(axes, str):
            grid_name = axes
        model = SEDModel.for_axes(grid_name)
    return model, filters


def own_curves(filters):
    """Select the filters of a `FilterSet` that are not those of the library: tuple of `Filter`."""
    if not isinstance(filters, FilterSet):
        return ()
    return tuple(band for band in filters if find_filter(band.name) is None)


def axes_of(model, axes):
    """
    Find the axes of a grid of a model, and the name of the grid; a grid that was made has the name of its axes.

    Parameters
    ----------
    model : object
        `~miricigale.sed.SEDModel` or `~miricigale.sed.ModelGrid`, or anything else, whose ``axes`` are left alone.
    axes : dict, str or None
        Parameters to values, or the name of a grid of `~miricigale.sed.presets.GRIDS`; None for the model's own.

    Returns
    -------
    axes : dict or None
        Parameters to values.
    name : str or None
        Name of the grid; None if they are of no grid of ours.

    Raises
    ------
    ValueError
        If no axes were given for a model that has none of its own, or the name is that of another chain.
    """
    if isinstance(model, ModelGrid):
        return axes, _name_of(model.axes, model.preset, model.n_agn > 0)
    if not isinstance(model, SEDModel):
        return axes, None
    if axes is None:
        return model.named_axes(axes), model.preset
    if isinstance(axes, str):
        return model.named_axes(axes), axes
    return axes, _name_of(axes, model.preset, model.has_agn)


def _name_of(axes, preset, has_agn):
    """Name of the grid with some axes of the model of a preset; None if it is none of ours."""
    for name, (preset_of_grid, _) in GRIDS.items():
        if preset_of_grid == preset and _are_same(axes, grid_axes(name, agn=has_agn)):
            return name
    return None


def _are_same(axes, grid_axes_of_name):
    """Whether axes are those of a named grid."""
    if not isinstance(axes, dict) or axes.keys() != grid_axes_of_name.keys():
        return False
    return all(
        np.array_equal(np.asarray(axes[name]), values) for name, values in grid_axes_of_name.items()
    )


@cached(copies=True)
def _survey_calibration(bands):
    """Return `SurveyCalibration.survey` for bands (tuple of str) of a catalog that was not measured."""
    # it is measured by fits, whose modules are made of this one
    from miricigale.fitting.survey.survey import SurveyCalibration

    calibration = SurveyCalibration.survey()
    if bands:
        return calibration.with_prior_errors(bands)
    return calibration


def default_calibration(grid, model_error, template_error, *, bands):
    """
    Choose the calibration of a named grid where none was given.

    Parameters
    ----------
    grid : str or None
        Name of the grid.
    model_error : float, dict or None
        Errors of the models that were given, which take its place.
    template_error : `TemplateError` or None
        The same, by rest wavelength.
    bands : list of str, `FilterSet` or None
        Bands of the catalog, which get the errors of the prior, for MIRI 3.3 times those of the catalog and 15 %
        of the flux (`~miricigale.fitting.calibrate_bands` measures them). Without them errors are those of the
        catalog.

    Returns
    -------
    calibration : `~miricigale.fitting.SurveyCalibration` or None
        That of `SurveyCalibration.survey` for the grid ``"survey"``; it was measured to 8 um at rest, and would
        give far-infrared bands no weight.
    """
    if grid != "survey" or model_error is not None or template_error is not None:
        return None
    if bands is None:
        return _survey_calibration(())
    if not isinstance(bands, FilterSet):
        bands = FilterSet.from_names(bands)
    return _survey_calibration(tuple(bands.names))


def chosen_calibration(calibration, grid, model_error, template_error=None, *, bands=None):
    """
    Return the calibration that was given, or `default_calibration` where that is asked for.

    Raises
    ------
    ValueError
        If it is no `~miricigale.fitting.SurveyCalibration`, nor ``"default"``, nor None.
    """
    if calibration is None or hasattr(calibration, "template_error"):
        return calibration
    if not isinstance(calibration, str) or calibration != DEFAULT:
        raise argument_error(
            "calibration", f"a SurveyCalibration, {DEFAULT!r} or None", repr(calibration)
        )
    return default_calibration(grid, model_error, template_error, bands=bands)


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
