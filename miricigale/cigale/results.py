"""Results in CIGALE's columns."""

from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.table import QTable, Table

from miricigale.cigale.names import cigale_names, unit_of
from miricigale.filters.band_names import cigale_band, filter_of_band
from miricigale.fitting import FitFlags
from miricigale.utils.exceptions import data_error
from miricigale.utils.files import replacing
from miricigale.utils.options import check_names
from miricigale.utils.table_files import read_table
from miricigale.utils.tables import error_column

_CHI2 = ("best.chi_square", "best.reduced_chi_square")


def write_cigale_results(results, path, *, variables=None, overwrite=False):
    """
    Write results as CIGALE does, in ``results.fits`` or ``results.txt``.

    Parameters
    ----------
    results : `~miricigale.fitting.FitResults`
        Results of a fit.
    path : path-like
        The file; a text table if it ends in ``.txt``, else FITS.
    variables : iterable of str, optional
        For which of CIGALE's quantities there are columns ``bayes.X`` and ``bayes.X_err``; all
        that we have by default.
    overwrite : bool, optional
        Whether a file that is there is replaced.

    Raises
    ------
    KeyError
        If a variable is not known.
    OSError
        If the file is there and ``overwrite`` is not given.

    Notes
    -----
    Bands have the names of ``results.meta["cigale"]``, or CIGALE's present ones, and ours where there is none;
    ``left_out``, ``replaced`` and ``differs`` of ``results.meta["cigale"]`` (`CigaleSetup.describe`) and the
    meaning of the flags stand as comments in the header, or in lines with ``#`` above a text table.

    The columns are ``id``; ``flags`` (`~miricigale.fitting.FitFlags`); ``bayes.X`` and ``bayes.X_err``,
    posterior means and standard deviations; those of the bands' fluxes; ``best.chi_square`` and
    ``best.reduced_chi_square`` (by the number of bands less one); ``best.X``, quantities of the best model, also
    of parameters that have one value; ``best.<band>``. Units are CIGALE's: Myr, Msun, Msun/yr, W, mag, nm, deg,
    mJy.

    Examples
    --------
    >>> from miricigale import BayesFitter, ErrorModel, SEDModel
    >>> bands = ["acs.f814w", "wfc3.f160w", "irac.ch1", "miri.f770w"]
    >>> model = SEDModel.yang2021(agn=False)
    >>> truth = {"id": ["a", "b"], "redshift": [0.5, 1.0], "age": [1.0, 3.0], "mass": [1e10, 1e10]}
    >>> errors = ErrorModel.from_depths(dict.fromkeys(bands, 29.0))
    >>> photometry = errors.perturb(model.fluxes(truth, bands), seed=1)
    >>> axes = {"redshift": [0.4, 0.5, 0.9, 1.0, 1.1], "age": [1.0, 3.0], "ebv": [0.1, 0.3]}
    >>> fitter = BayesFitter(model, bands, axes=axes)
    >>> from tempfile import TemporaryDirectory
    >>> from miricigale.cigale import read_cigale_results, write_cigale_results
    >>> with TemporaryDirectory() as folder:
    ...     write_cigale_results(fitter.fit(photometry), f"{folder}/results.fits")
    ...     table = read_cigale_results(f"{folder}/results.fits")
    >>> table["bayes.stellar.m_star"].unit
    Unit("solMass")
    """
    note = results.meta.get("cigale", {})
    columns = _columns(results, cigale_names(note.get("modules")), variables)
    table = Table()
    table["id"] = np.array(results.ids)
    table["flags"] = np.array(results.flags)
    for name, (mean, std, _, unit) in columns.items():
        if mean is not None:
            table[f"bayes.{name}"] = u.Quantity(mean, unit)
            table[f"bayes.{name}_err"] = u.Quantity(std, unit)
    bands = note.get("bands", {})
    written = {name: bands.get(name, cigale_band(name)) for name in results.filters}
    fluxes = results.predict()
    for name, band in written.items():
        table[f"bayes.{band}"] = fluxes[name].to(u.mJy)
        table[f"bayes.{band}_err"] = fluxes[error_column(name)].to(u.mJy)
    table[_CHI2[0]] = np.array(results.chi2)
    table[_CHI2[1]] = np.array(results.reduced_chi2)
    for name, (_, _, best, unit) in columns.items():
        table[f"best.{name}"] = u.Quantity(best, unit)
    for name, band in written.items():
        table[f"best.{band}"] = fluxes[f"{name}_best"].to(u.mJy)
    table.meta["comments"] = [*described(note), f"flags: {FitFlags.describe()}"]
    text = Path(path).suffix.lower() == ".txt"
    if text:
        form = {"format": "ascii.fixed_width", "delimiter": None}
    else:
        form = {"format": "fits"}
    with replacing(path, overwrite=overwrite) as partial:
        table.write(partial, **form)


def described(note):
    """Lines that say what of a run of CIGALE is left out, replaced or different, by lists under these names."""
    for name in ("left_out", "replaced", "differs"):
        if note.get(name):
            yield f"{name.replace('_', ' ')}: {'; '.join(note[name])}"


def _columns(results, names, variables):
    """Return CIGALE's name to mean, standard deviation (None if not wanted), best value and unit."""
    constants = dict(results.constants)
    gas = [part.gas for part in getattr(results.model, "components", ()) if part.role == "nebular"]
    if gas != ["free"]:
        # the gas has the metallicity of the stars
        constants.pop("metallicity_gas", None)
    columns = {}
    zero = np.where(results.fitted, 0.0, np.nan)
    for ours, (theirs, unit, factor) in names.items():
        if ours in results.best:
            # a redshift at one node of a grid is yet of each object
            best = np.asarray(results.best[ours]) * factor
        elif ours in constants:
            best = np.where(results.fitted, constants[ours] * factor, np.nan)
        else:
            continue
        mean = best
        std = zero
        if ours in results.parameters:
            mean = results.mean(ours).value * factor
            std = results.std(ours).value * factor
        columns[theirs] = (mean, std, best, unit)
    wanted = variables
    if variables is None:
        wanted = columns
    check_names(wanted, "quantity of the results", columns)
    for name in columns.keys() - set(wanted):
        _, _, best, unit = columns[name]
        columns[name] = (None, None, best, unit)
    return dict(sorted(columns.items()))


def read_cigale_results(path):
    """
    Read ``results.fits`` or ``results.txt``, CIGALE's own or those of `write_cigale_results`.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    table : `~astropy.table.QTable`
        CIGALE's columns, with units where the file has them or the name is known.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file is missing or something else.

    Examples
    --------
    >>> from miricigale.cigale import read_cigale_results
    >>> table = read_cigale_results("out/results.fits")  # doctest: +SKIP
    >>> table["id", "bayes.stellar.m_star", "best.reduced_chi_square"]  # doctest: +SKIP
    """
    table = read_table(path, wanted="results of CIGALE", cls=Table)
    missing = [name for name in ("id",) + _CHI2 if name not in table.colnames]
    if missing:
        raise data_error(path, f"is no table of CIGALE's results: no column {', '.join(missing)}")
    for name in table.colnames:
        column = table[name]
        if column.unit is None and name.startswith(("bayes.", "best.")) and name not in _CHI2:
            column.unit = _unit(name)
    return QTable(table)


def _unit(column):
    name = column.partition(".")[2]
    for text in (name, name.removesuffix("_err")):
        unit = unit_of(text) or (u.mJy if filter_of_band(text) is not None else None)
        if unit is not None:
            return unit
    return None
