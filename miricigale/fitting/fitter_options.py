"""Checks of the options of a fitter, before anything is made of them."""

from collections.abc import Mapping

from miricigale.fitting.data.likelihood import filter_names, is_filter
from miricigale.fitting.data.nuclei import WHOLE
from miricigale.fitting.data.settings import GridSettings, SamplerSettings
from miricigale.fitting.survey.band_errors import long_instruments
from miricigale.utils.exceptions import argument_error
from miricigale.utils.options import check_that, check_type


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
    check_type(settings, "settings", kind, f"{kind.__name__} with engine={engine!r}")
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


def check_nuclei(nuclei, engine):
    """Raise a `ValueError` if ``nuclei`` is none, or asked of a sampler."""
    is_choice = isinstance(nuclei, bool) or nuclei == WHOLE
    check_that(is_choice, "nuclei", f"True or False, or {WHOLE!r}", repr(nuclei))
    check_that(engine == "grid" or not nuclei, "nuclei", "False with a sampler", repr(nuclei))


def check_priors(priors):
    """Raise a `ValueError` if ``priors`` is neither None nor a dict."""
    if priors is not None:
        check_type(priors, "priors", Mapping, "a dict of parameter name to prior")


def errors_of_expected_flux(bands, error_part):
    """
    Choose the bands in which errors of a calibration are a part of the expected flux, not of the measured one.

    They are those of instruments whose starlight the other bands predict, as MIRI
    (`miricigale.fitting.grid.relative_errors`).

    Parameters
    ----------
    bands : tuple of str
        All bands of the models.
    error_part : dict of str to float
        Errors as parts of the flux by band.

    Returns
    -------
    part : dict of str to float
        Those of these bands above 0.
    """
    part = {}
    for group in long_instruments([band for band in bands if is_filter(band)]):
        for band in group:
            if error_part[band] > 0:
                part[band] = error_part[band]
    return part
