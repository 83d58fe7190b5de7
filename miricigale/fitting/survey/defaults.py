"""What is fitted where nothing else is said: models of real galaxies, their grid and their calibration."""

from collections.abc import Mapping

import numpy as np

from miricigale.filters import FilterSet, find_filter
from miricigale.sed import ModelGrid, SEDModel
from miricigale.sed.presets import GRIDS, grid_axes
from miricigale.utils.caching import cached
from miricigale.utils.exceptions import FitWarning, argument_error, warn
from miricigale.utils.options import check_that

#: For a calibration: that of the models.
DEFAULT = "default"
#: Axes without which the galaxies of a survey are all alike.
_OF_GALAXIES = ("tau", "age", "ebv")


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
    axes : dict, str or None
        As given; a dict without a model has the other axes of the grid ``"survey"`` too.
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
        if isinstance(axes, Mapping):
            # nodes of some parameters of the default grid
            axes = model.named_axes() | dict(axes)
    return model, filters, axes


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
    calibrated_as : str or None
        Name of the grid whose calibration by default it has: its own, or that of a grid with other redshifts.

    Raises
    ------
    ValueError
        If no axes were given for a model that has none of its own, or the name is that of another chain.
    """
    if isinstance(model, ModelGrid):
        chain = (model.preset, model.n_agn > 0)
        name = _name_of(model.axes, *chain)
        return axes, name, _calibrated_as(name, model.axes, *chain)
    if not isinstance(model, SEDModel):
        return axes, None, None
    if axes is None:
        return model.named_axes(axes), model.preset, model.preset
    if isinstance(axes, str):
        return model.named_axes(axes), axes, axes
    chain = (model.preset, model.has_agn)
    name = _name_of(axes, *chain)
    return axes, name, _calibrated_as(name, axes, *chain)


def _name_of(axes, preset, has_agn):
    """Name of the grid with some axes of the model of a preset; None if it is none of ours."""
    for name, (preset_of_grid, _) in GRIDS.items():
        if preset_of_grid == preset and _are_same(axes, grid_axes(name, agn=has_agn)):
            return name
    return None


def _calibrated_as(name, axes, preset, has_agn):
    """
    Name of the grid whose calibration by default is that of a grid; None if there is none.

    Errors of models by rest wavelength, and priors of parameters, hold at any redshifts: the grid ``"survey"`` may
    have others.
    """
    if name is not None or preset != "survey" or not isinstance(axes, Mapping):
        return name
    own = grid_axes("survey", agn=has_agn)
    if "redshift" in axes and _are_same({**axes, "redshift": own["redshift"]}, own):
        return "survey"
    return None


def warn_of_changed_axes(axes):
    """Warn that a calibration by default is none, of axes of the survey's grid that were changed."""
    own = grid_axes("survey", agn=True)
    own["redshift"] = axes.get("redshift", own["redshift"])
    changed = [name for name in axes if name not in own or not _same_values(axes, own, name)]
    msg = (
        f"'axes' have other values than the grid 'survey' has for {', '.join(changed)}: there is no "
        "calibration, errors of models are 10 % of the flux and all nodes are equally likely; "
        "calibration=SurveyCalibration.survey() has the survey's, calibration=None takes none"
    )
    warn(msg, FitWarning)


def warn_of_few_models(model, axes, grid):
    """Warn of axes for the models of a survey without those of age, star formation or dust."""
    if model.preset != "survey" or not isinstance(axes, Mapping):
        return
    missing = [name for name in _OF_GALAXIES if name not in axes]
    if missing:
        values = ", ".join(f"{name}={model.defaults[name]:g}" for name in missing)
        msg = (
            f"'axes' make a grid of {grid.n_models:,} models, whose galaxies all have {values}; "
            "axes=SEDModel.survey_axes() | {...} has the other axes of the survey too"
        )
        warn(msg, FitWarning)


def _are_same(axes, grid_axes_of_name):
    """Whether axes are those of a named grid."""
    if not isinstance(axes, dict) or axes.keys() != grid_axes_of_name.keys():
        return False
    return all(_same_values(axes, grid_axes_of_name, name) for name in grid_axes_of_name)


def _same_values(axes, other_axes, name):
    return np.array_equal(np.asarray(axes[name]), other_axes[name])


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
