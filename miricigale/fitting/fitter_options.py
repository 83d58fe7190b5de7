"""Checks of the options of a fitter, before anything is made of them."""

from miricigale.fitting.data.likelihood import filter_names
from miricigale.fitting.data.settings import GridSettings, SamplerSettings
from miricigale.utils.exceptions import argument_error
from miricigale.utils.options import check_that


def chosen_settings(engine, settings):
    """
    Return the settings of an engine: given ones, or those by default.

    Parameters
    ----------
    engine : str or callable
        ``"grid"`` or a sampler.
    settings : `GridSettings`, `SamplerSettings` or None
        As given by the user.

    Raises
    ------
    ValueError
        If they are those of another engine.
    """
    kind = SamplerSettings
    if engine == "grid":
        kind = GridSettings
    settings = settings or kind()
    wanted = f"{kind.__name__} with engine={engine!r}"
    check_that(isinstance(settings, kind), "settings", wanted, type(settings).__name__)
    return settings


def fitted_names(engine, filters, settings):
    """
    Return the names of the filters to fit; None if a grid is fitted in the bands that it has.

    Raises
    ------
    ValueError
        If there are none, or a name stands twice, among those that a sampler predicts too.
    """
    if filters is None and engine == "grid":
        return None
    names = filter_names("filters", filters or ())
    all_names = list(names)
    if engine != "grid":
        all_names += list(filter_names("predict", settings.predict))
    is_unique = len(set(all_names)) == len(all_names)
    check_that(names and is_unique, "filters", "different names, at least one", f"{all_names}")
    return names


def check_scale_error(scale_error, compat):
    """Raise a `ValueError` if ``scale_error`` is none, or contradicts the conventions of CIGALE."""
    if scale_error not in (None, True, False) or (compat and scale_error):
        wanted = "True, False or None"
        if compat:
            wanted = "False with compat='cigale'"
        raise argument_error("scale_error", wanted, repr(scale_error))
