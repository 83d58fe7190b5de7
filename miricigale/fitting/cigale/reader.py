"""Reading ``pcigale.ini``, and the whole of a run of CIGALE."""

import warnings
from pathlib import Path

import numpy as np

from miricigale.fitting.cigale.bands import filter_of_band, is_line
from miricigale.fitting.cigale.ini import parse_ini
from miricigale.fitting.cigale.modules import read_modules
from miricigale.fitting.cigale.names import known_property
from miricigale.fitting.cigale.setup import CigaleSetup
from miricigale.utils.exceptions import ConfigError, DataError, MiricigaleWarning, argument_error
from miricigale.utils.tables import error_column

__all__ = ["fit_cigale", "read_pcigale_ini"]


def read_pcigale_ini(path, *, libraries="best", names=None, strict=False):
    """
    Read the configuration of a run of CIGALE.

    Parameters
    ----------
    path : path-like
        ``pcigale.ini`` of CIGALE 2018 to 2022, with a grid of parameters for the analysis
        ``pdf_analysis``.
    libraries : {"best", "bundled"}, optional
        Whether libraries that are registered (`miricigale.sed`) are used, or the bundled tables
        alone.
    names : dict of str to str, optional
        Filters of bands that are not known, or otherwise known: CIGALE's name to ours.
    strict : bool, optional
        Whether anything that is left out or replaced is an error, not a warning.

    Returns
    -------
    setup : `CigaleSetup`

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file cannot be read.
    `~miricigale.utils.exceptions.ConfigError`
        If a value cannot be read, nothing can be fitted, or with ``strict``, something would be
        left out or replaced.

    Warns
    -----
    `~miricigale.utils.exceptions.MiricigaleWarning`
        Of all that is left out, replaced or different, in one message.
    """
    path = Path(path)
    if libraries not in ("best", "bundled"):
        raise argument_error("libraries", "'best' or 'bundled'", repr(libraries))
    config = parse_ini(path)
    analysis = config.get("analysis_params", {})
    if "sed_modules" not in config or not isinstance(config.get("sed_modules_params"), dict):
        msg = f"{path} is no configuration of CIGALE: no sed_modules, or no [sed_modules_params]"
        raise DataError(msg)
    if config.get("parameters_file"):
        msg = f"{path}: lists of models (parameters_file) are not read, grids are"
        raise ConfigError(msg)
    try:
        chain = read_modules(
            _list(config["sed_modules"]),
            config["sed_modules_params"],
            folder=path.parent,
            libraries=libraries,
        )
        names = dict(names or {})
        columns = _list(config.get("bands", []))
        bands, lost = _bands(columns, names)
        wanted = _list(analysis.get("bands", []))
        predicted, _ = _bands([b for b in wanted if b not in bands.values()], names)
        settings = _settings(config, analysis)
    except ConfigError as err:
        msg = f"{path}: {err}"
        raise ConfigError(msg) from err
    if not bands:
        msg = f"{path}: no band is known here, of {', '.join(lost) or 'none'}"
        raise ConfigError(msg)
    variables = _list(analysis.get("variables", []))
    without = [name for name in variables if not known_property(name, chain.modules)]
    left_out = [
        *(f"module {x}" if "." not in x and " " not in x else x for x in chain.left_out),
        *(f"band {x}" for x in lost),
        *(f"variable {x}" for x in without),
        *(f"property {x}" for x in _list(config.get("properties", [])) if not x.endswith("_err")),
    ]
    data_file = config.get("data_file") or None
    differs = []
    if settings["limits"] and _limit_flag(analysis) == "noscaling":
        differs.append("lim_flag noscaling: upper limits act on the scale too, as with full")
    setup = CigaleSetup(
        path=path,
        data_file=None if data_file is None else path.parent / data_file,
        components=tuple(chain.components),
        parameters=chain.axes,
        redshift=chain.redshift,
        modules=chain.modules,
        frac_agn_definition=chain.definition,
        bands=bands,
        predicted={name: band for name, band in predicted.items() if name not in bands},
        columns=tuple(c for c in columns if c.removesuffix("_err") in bands.values()),
        variables=tuple(name for name in variables if name not in without),
        left_out=tuple(left_out),
        replaced=tuple(chain.replaced),
        differs=(*chain.differs, *differs),
        names=names,
        **settings,
    )
    text = setup.describe()
    if strict and (setup.left_out or setup.replaced):
        msg = f"{path}:\n{text}"
        raise ConfigError(msg)
    if text:
        warnings.warn(f"{path}:\n{text}", MiricigaleWarning, stacklevel=2)
    return setup


def _list(value):
    items = value if isinstance(value, list) else [value]
    return [item.strip() for item in items if item.strip()]


def _bands(columns, names):
    """Filters to bands, and bands without a filter."""
    bands, lost = {}, []
    for band in dict.fromkeys(c.removesuffix("_err") for c in columns):
        name = None if is_line(band) else names.get(band, filter_of_band(band))
        if name is None:
            lost.append(band)
        elif name in bands:
            msg = f"the bands {bands[name]} and {band} are both the filter {name}"
            raise ConfigError(msg)
        elif band not in columns:
            msg = f"{error_column(band)} is among the bands, and {band} is not"
            raise ConfigError(msg)
        else:
            bands[name] = band
    return bands, lost


_TRUE, _FALSE = ("true", "yes", "on", "1"), ("false", "no", "off", "0", "")


def _flag(value, name):
    text = str(value).strip().lower()
    if text not in (*_TRUE, *_FALSE):
        msg = f"{name} must be True or False, got {value!r}"
        raise ConfigError(msg)
    return text in _TRUE


def _number(section, key, default, kind):
    value = section.get(key, "") or default
    try:
        return kind(value)
    except (TypeError, ValueError):
        msg = f"{key} must be a number, got {value!r}"
        raise ConfigError(msg) from None


def _limit_flag(analysis):
    """What the fit does with upper limits: full, noscaling or none."""
    limits = str(analysis.get("lim_flag", "none")).strip().lower()
    if limits not in ("full", "noscaling", "none"):
        limits = "full" if _flag(limits, "lim_flag") else "none"
    return limits


def _settings(config, analysis):
    error = _number(config, "additionalerror", 0.1, float)
    if not error >= 0:
        msg = f"additionalerror must be >= 0, got {error:g}"
        raise ConfigError(msg)
    return {
        "additional_error": error,
        "limits": _limit_flag(analysis) != "none",
        "redshift_decimals": _number(analysis, "redshift_decimals", 2, int),
        "mock": _flag(analysis.get("mock_flag", ""), "mock_flag"),
        "cores": _number(config, "cores", 1, int),
    }


def fit_cigale(ini, *, output=None, libraries="best", names=None, strict=False, **options):
    """
    Do what a run of CIGALE does: read configuration and catalogue, fit, write.

    Parameters
    ----------
    ini : path-like or `CigaleSetup`
        ``pcigale.ini``, or what `read_pcigale_ini` made of it.
    output : path-like, optional
        File of results in CIGALE's columns (``results.fits`` or ``.txt``), replaced if it is
        there.
    libraries, names, strict : optional
        As for `read_pcigale_ini`; no use for a `CigaleSetup`.
    **options
        Passed to `CigaleSetup.fit`.

    Returns
    -------
    results : `~miricigale.fitting.FitResults`

    Examples
    --------
    >>> from miricigale.fitting import fit_cigale
    >>> results = fit_cigale("pcigale.ini", output="results.fits")  # doctest: +SKIP
    """
    setup = ini
    if not isinstance(ini, CigaleSetup):
        setup = read_pcigale_ini(ini, libraries=libraries, names=names, strict=strict)
    photometry = setup.catalog(strict=strict)
    if "distance" in photometry.colnames and np.any(np.isfinite(photometry["distance"])):
        msg = f"{setup.data_file}: distances are not used, those of the redshifts are"
        warnings.warn(msg, MiricigaleWarning, stacklevel=2)
    results = setup.fit(photometry, **options)
    if output is not None:
        setup.write_results(results, output, overwrite=True)
    return results
