"""From a catalog of photometry to fluxes, errors and flags that a fit can use, and the flags of fits."""

from dataclasses import field

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.filters import Filter
from miricigale.filters.library import SEDPY
from miricigale.filters.surveys import map_names
from miricigale.utils.arrays import nans
from miricigale.utils.exceptions import argument_error
from miricigale.utils.missing_values import first_word, own_mask
from miricigale.utils.named_values import attributes
from miricigale.utils.object_rows import ObjectRows, PerObject
from miricigale.utils.options import check_that
from miricigale.utils.tables import (
    Flags,
    check_units,
    columns_among,
    error_column,
    read_ids,
    require_columns,
)
from miricigale.utils.units import FNU, flux_unit, own_unit, to_array
from miricigale.utils.values import value_class

#: S/N of the best model in all bands together below which an object is flagged.
LOW_SIGNAL = 3.0
#: What a warning of fits that are not converged begins with, after their number.
NOT_CONVERGED_TEXT = "fits are not converged"
#: Largest limit of the reduced chi2 above which an object is flagged.
HIGH_CHI2 = 100.0
#: Most columns that a message lists.
_MAX_LISTED = 6
#: Stellar mass in solar masses below which an object is flagged.
LOW_MASS = 3e6
#: Smallest error in units of the flux: below it chi2 in double precision has no digits left.
_MIN_RELATIVE_ERROR = 1e-6
#: Smallest error in uJy; the squares of smaller ones underflow.
_MIN_ERROR = 1e-60
#: Largest flux and error in uJy; the squares of larger ones overflow.
_MAX_FLUX = 1e60
#: Fluxes that are all 0 become negative by this part of their error; see `FitData.of_engine`.
_DARK = 1e-8
#: Sum of squared S/N that counts as 0: smaller numbers have fewer digits, or none.
_NO_SIGNAL = 1e-280
#: What follows the name of a band in columns of fluxes of nuclei: as of forced photometry, and another one.
NUCLEUS_SUFFIXES = ("_flux_point", "_nucleus")
_TRUE = ("true", "t", "1", "1.0")
_FALSE = ("false", "f", "0", "0.0", "-0.0", "")
_KINDS = {"U": "text", "S": "text", "b": "true and false", "c": "complex numbers"}


class FitFlags(Flags):
    """
    Flags of a fitted catalog; `FitFlags.UNFITTED` is the sum of those that prevent a fit.

    Examples
    --------
    >>> from miricigale.fitting import FitFlags
    >>> FitFlags(16384 | 32768)
    <FitFlags.LOW_SIGNAL|ONE_NODE: 49152>
    >>> FitFlags.UNFITTED & FitFlags.ALL_LIMITS     # such a row has no result
    <FitFlags.ALL_LIMITS: 4096>
    """

    NO_BAND = 1, "No usable band."
    FEW_BANDS = 2, "Fewer usable bands, upper limits among them, than asked for."
    BAD_ERROR = (
        4,
        (
            "A flux whose error is zero, negative, not finite or beyond 1e-60 to 1e60 uJy; the "
            "band is left out."
        ),
    )
    NO_REDSHIFT = (
        8,
        (
            "A fixed redshift was asked for and is missing, not finite or not positive; or the "
            "density of ``redshift_prior`` is missing, not finite or 0 throughout."
        ),
    )
    REDSHIFT_OUTSIDE = 16, "The fixed redshift has no redshift of the grid within the tolerance."
    DUPLICATE_ID = 32, "The id occurred before; only its first row is fitted."
    HIGH_CHI2 = (
        64,
        (
            "No model fits: the reduced chi2 of the best is above that of nearly all of the "
            "sample (by three standard deviations of its logarithm; above 10 without 50 others), "
            "and larger than errors make it."
        ),
    )
    NO_SIGNAL = (
        128,
        (
            "No model has a positive scale, the fluxes being zero or negative: the posterior is "
            "the prior."
        ),
    )
    REDSHIFT_EDGE = (
        256,
        "More than one per cent of the posterior lies on the first or last redshift.",
    )
    NO_MODEL = 512, "No model is left by the age of the universe and the priors."
    BAD_FLUX = 1024, "A flux that is infinite or beyond 1e60 uJy; the band is left out."
    FEW_FOR_PARAMETERS = (
        2048,
        (
            "Fewer than three fluxes of 2 sigma or more (two if the redshift is known), or than "
            "free parameters if these are fewer: but for mass, redshift and a color the posterior "
            "is the prior. Limits are not counted."
        ),
    )
    ALL_LIMITS = 4096, "Upper limits and no flux: any model that is faint enough fits."
    NO_LIKELIHOOD = (
        8192,
        'With ``compat="cigale"``: the best chi2 is so high that every likelihood vanishes.',
    )
    LOW_SIGNAL = (
        16384,
        "The best model has S/N below 3 over all bands: take masses and luminosities from samples.",
    )
    ONE_NODE = (
        32768,
        (
            "Of nodes alone (``interpolate=0``): more than 95 % of the posterior lies on one "
            "galaxy model at one redshift."
        ),
    )
    OFF_RELATION = (
        65536,
        (
            "Less than 1 % of the posterior keeps ``max_dev_alpha_ox`` of CIGALE's module xray: "
            "the result is without it."
        ),
    )
    LOW_MASS = (
        131072,
        (
            "The median stellar mass is below 3e6 solar masses at a redshift that was fitted, as "
            "of few sources that a survey detects: rather another redshift, a star, or a little "
            "red dot."
        ),
    )
    NOT_CONVERGED = (
        262144,
        (
            "The posterior between nodes is not converged: the effective number of models that "
            "``interpolate`` asks for was not reached, in all or in a redshift peak or kind of "
            "model with more than 2 % of the weight, or a percentile is uncertain by more than a "
            "tenth of its 68 % interval."
        ),
    )
    BAND_OFF = (
        524288,
        (
            "One band is off, that of the column ``band_off``: its residual to the best model is "
            "above 4 errors and makes 40 % of chi2 or more. Look at that flux before you trust "
            "the fit, or fit without it."
        ),
    )
    OTHER_CLASS = (
        1048576,
        (
            "In a table of classes: the class is not the first one, that of galaxies. The "
            "redshift is that of the class; masses and all else that is of galaxies are of the "
            "fit as one, at its redshift, ``redshift_p50_galaxy``."
        ),
    )
    NUCLEUS_LEFT_OUT = (
        2097152,
        (
            "The flux of a nucleus was left out: its error or correlation cannot be used, or the "
            "band has no total flux."
        ),
    )
    UNFITTED = 1 | 2 | 8 | 16 | 32 | 512 | 4096 | 8192, "Bits with which a row has no result."


@value_class
class FitData(ObjectRows):
    """
    Photometry in arrays, which slices like `~miricigale.fitting.FitResults`.

    Parameters
    ----------
    ids : `~numpy.ndarray`, shape (n,)
        Ids of the objects, as they came.
    flux, flux_err : `~numpy.ndarray`, shape (n, nb)
        Measured fluxes and errors in uJy; NaN where there is none.
    sigma : `~numpy.ndarray`, shape (n, nb)
        Errors with the model error added in quadrature, of upper limits their own errors;
        infinite in bands not used.
    limit : `~numpy.ndarray` of bool, shape (n, nb)
        Which of the bands used are upper limits.
    flags : `~numpy.ndarray` of int, shape (n,)
        `FitFlags`.
    redshift : `~numpy.ndarray`, shape (n,), optional
        Known redshifts; NaN where one is missing.
    nuclei : `~numpy.ndarray`, shape (n, n_nuclei, 4), optional
        Fluxes of nuclei, as of `~miricigale.fitting.data.nuclei.read_nuclei`.
    """

    ids: PerObject
    flux: PerObject
    flux_err: PerObject
    sigma: PerObject
    limit: PerObject
    flags: PerObject
    redshift: PerObject = None
    nuclei: PerObject = None

    @property
    def used(self):
        """Which bands are used, shape (n, nb)."""
        return np.isfinite(self.sigma)

    @property
    def measured(self):
        """Which bands are used and no upper limits, shape (n, nb)."""
        return self.used & ~self.limit

    @property
    def columns(self):
        """Keywords of `~miricigale.fitting.FitResults` that are taken from the photometry."""
        fields = ("ids", "flux", "flux_err", "sigma", "limit")
        return attributes(self, fields) | {"n_bands": self.used.sum(axis=1)}

    def of_engine(self, log_prior):
        """
        Return the keywords of `~miricigale.fitting.grid.grid.GridEngine.fit`, fluxes in uJy.

        ``log_prior``, shape (n, nz), is ln of the prior of each redshift of the grid.
        """
        flux = np.nan_to_num(self.flux)
        measured = self.measured
        limit = self.limit
        signal = np.divide(flux, self.sigma, out=np.zeros(flux.shape), where=measured)
        # The engine compares the directions of flux vectors, and a vector of zeros has none. Just below
        # zero the best scale of every model is 0 as well, and chi2 is larger by 1e-16 for each band.
        dark = measured & (np.sum(signal * signal, axis=1) < _NO_SIGNAL)[:, None]
        flux = np.where(dark, -_DARK * self.sigma, flux)
        keywords = {
            "flux": flux,
            "sigma": np.where(limit, np.inf, self.sigma),
            "log_prior": log_prior,
        }
        if np.any(limit):
            keywords["limit"] = flux
            keywords["limit_sigma"] = np.where(limit, self.sigma, np.inf)
        return keywords


@value_class
class PhotometryReader:
    """
    How a fit takes fluxes and errors from catalogs.

    Parameters
    ----------
    bands : tuple of str
        Bands of the models, each a column of the arrays.
    filters : tuple of str or None
        Bands to fit; those that a catalog has by default.
    model_error, error_floor : dict of str to float
        Part of the flux that is added to its error in quadrature, and least error as a part of the
        flux, by filter.
    n_bands_min : int
        Objects with fewer usable bands are flagged.
    zero_point, error_factor : dict of str to float, optional
        What fluxes and errors of a filter are multiplied by, and errors besides; 1 by default.
    added_later : tuple of str, optional
        Filters whose part of the flux is added to the errors by
        `~miricigale.fitting.grid.relative_errors.RelativeErrors`.
    """

    bands: tuple
    filters: tuple | None
    model_error: dict
    error_floor: dict
    n_bands_min: int
    zero_point: dict = field(default_factory=dict)
    error_factor: dict = field(default_factory=dict)
    added_later: tuple = ()

    def fitted(self, table):
        """List the bands of a catalog that are fitted: tuple of str."""
        require_columns(table, [], "photometry")
        if self.filters is not None:
            return self.filters
        return tuple(columns_among(table, self.bands))

    def read(self, table, repeated=None):
        """
        Take fluxes and errors from a table.

        Parameters
        ----------
        table : `~astropy.table.QTable`
            As for `~miricigale.fitting.BayesFitter.fit`; masked values are missing bands too. No
            error, of a limit or with all that is added to it, counts as less than 1e-6 of the flux,
            and those beyond 1e-60 to 1e60 uJy are of no use.
        repeated : `~numpy.ndarray` of bool, shape (n,), optional
            Rows whose id is known from earlier parts of the catalog.

        Returns
        -------
        data : `FitData`

        Raises
        ------
        ValueError
            If a column is missing or holds no numbers, one of limits holds something else than true
            and false, or an id is masked.
        `~astropy.units.UnitsError`
            If a flux has no unit of flux density.
        """
        filters = self.fitted(table)
        require_columns(table, ["id"], "photometry")
        check_fluxes(table, filters)
        n = len(table)
        shape = (n, len(self.bands))
        flux = nans(shape)
        flux_err = nans(shape)
        sigma = np.full(shape, np.inf)
        limit = np.zeros(shape, dtype=bool)
        flags = np.zeros(n, dtype=int)
        for name in filters:
            column = self.bands.index(name)
            floor = self.error_floor[name]
            zero_point = self.zero_point.get(name, 1.0)
            band_flux = zero_point * flux_column(table, name)
            band_err = (
                zero_point
                * self.error_factor.get(name, 1.0)
                * flux_column(table, error_column(name))
            )
            has_flux = np.abs(band_flux) < _MAX_FLUX
            has_error = (band_err > _MIN_ERROR) & (band_err < _MAX_FLUX)
            flags[~np.isnan(band_flux) & ~has_flux] |= FitFlags.BAD_FLUX
            # a flux without error is a missing band; an error that cannot be used is flagged
            flags[has_flux & ~has_error & ~np.isnan(band_err)] |= FitFlags.BAD_ERROR
            usable = has_flux & has_error
            flux[:, column] = band_flux
            flux_err[:, column] = band_err
            abs_flux = np.abs(np.where(usable, band_flux, 0.0))
            own_err = np.where(usable, band_err, 1.0)
            model_error = self.model_error[name]
            if name in self.added_later:
                model_error = 0.0
            total_err = np.hypot(np.maximum(own_err, floor * abs_flux), model_error * abs_flux)
            limit[:, column] = usable & limits(table, name)
            total_err = np.maximum(
                np.where(limit[:, column], own_err, total_err), _MIN_RELATIVE_ERROR * abs_flux
            )
            sigma[:, column] = np.where(usable, total_err, np.inf)
        # flags of whole objects
        n_bands = np.isfinite(sigma).sum(axis=1)
        flags[(n_bands > 0) & (n_bands == limit.sum(axis=1))] |= FitFlags.ALL_LIMITS
        flags[n_bands == 0] |= FitFlags.NO_BAND
        flags[(n_bands > 0) & (n_bands < self.n_bands_min)] |= FitFlags.FEW_BANDS
        ids = read_ids(table)
        # of several rows with an id the first is fitted
        first_of_id = np.zeros(n, dtype=bool)
        first_of_id[np.unique(ids, return_index=True)[1]] = True
        is_duplicate = ~first_of_id
        if repeated is not None:
            is_duplicate |= repeated
        flags[is_duplicate] |= FitFlags.DUPLICATE_ID
        return FitData(ids, flux, flux_err, sigma, limit, flags)


def flux_columns(bands):
    """List the columns of the fluxes of bands and their errors: list of str."""
    columns = []
    for band in bands:
        columns += [band, error_column(band)]
    return columns


def check_fluxes(table, bands, user_names=None):
    """
    Check that a catalog has fluxes and errors of bands, which are numbers in units of flux densities.

    Parameters
    ----------
    table : `~astropy.table.Table`
        With fluxes by band and errors ``<band>_err``.
    bands : iterable of str
        Bands to check.
    user_names : dict, optional
        What the user calls columns, by the names of the table; messages have these.

    Raises
    ------
    ValueError
        If a column is missing, or holds no numbers.
    `~astropy.units.UnitsError`
        If columns have no unit of flux density.
    """
    user_names = user_names or {}
    labels = {name: user_names.get(name, name) for name in table.colnames}
    without_unit = []
    missing = []
    for band in bands:
        for name in (band, error_column(band)):
            if name in table.colnames:
                _check_numbers(table[name], labels[name])
                if own_unit(table[name]) is None:
                    without_unit.append(labels[name])
            elif name == band:
                missing.append(band)
            else:
                missing.append(error_column(labels.get(band, band)))
    got = f"columns {list(labels.values())}"
    wanted = f"a table with the columns {missing}"
    maps = map_names(list(labels.values()), own_names=False)
    if maps:
        wanted += f", or, of a catalog of the survey, read by {maps}"
    check_that(not missing, "photometry", wanted, got)
    if without_unit:
        columns = "column"
        if len(without_unit) > 1:
            columns = "columns"
        names = ", ".join(map(repr, without_unit[:_MAX_LISTED]))
        if len(without_unit) > _MAX_LISTED:
            names += f" and {len(without_unit) - _MAX_LISTED} more"
        msg = f"'photometry' {columns} {names} must be convertible to {FNU}, got no unit: give one, as unit='uJy' "
        msg += "(or 'ABmag', 'mJy') in Python or --flux-unit uJy on the command line"
        if maps:
            msg += f"; a catalog of the survey has its own unit, which {maps} knows"
        raise u.UnitsError(msg)
    units = dict.fromkeys(flux_columns(bands), FNU)
    check_units(table, units, "photometry", user_names=labels)


def _check_numbers(column, label):
    """Refuse a column of fluxes without real numbers, or with several in a row."""
    column = getattr(column, "unmasked", column)
    kind = getattr(column, "dtype", np.dtype(float)).kind
    if kind not in "fiuO":
        got = _KINDS.get(kind, str(column.dtype))
        row = None
        if kind in "US":
            row = first_word(np.ma.getdata(column))
        if row is not None:
            got += f", {column[row]!s:.40} in row {row} (from 0)"
        raise argument_error("photometry", f"a table with numbers in column {label!r}", got)
    shape = np.shape(column)
    wanted = f"a table with a number in each row of column {label!r}"
    check_that(len(shape) == 1, "photometry", wanted, f"shape {shape}")


def table_of_fluxes(ids, bands, flux, flux_err, limit):
    """Make the photometry to fit of arrays (n, n_bands), fluxes and errors in uJy: a `~astropy.table.QTable`."""
    table = QTable({"id": ids})
    for i, band in enumerate(bands):
        table[band] = flux[:, i] * FNU
        table[error_column(band)] = flux_err[:, i] * FNU
        table[f"{band}_limit"] = limit[:, i]
    return table


def unused_bands(table, filters):
    """
    List the bands of a catalog that are not fitted (``filters``), in the order of the columns.

    A column is a band if it has an error ``<name>_err`` and both are in a unit of flux
    density, or if its name is that of a filter.
    """
    columns = set(table.colnames)

    def measured(name):
        pair = (name, error_column(name))
        return columns.issuperset(pair) and all(_is_flux(table[column]) for column in pair)

    candidates = []
    for name in table.colnames:
        if name not in filters and not is_nucleus(name):
            candidates.append(name)
    return [name for name in candidates if is_filter(name) or measured(name)]


def is_nucleus(name):
    """Whether a column is called as fluxes of nuclei are."""
    return name.endswith(NUCLEUS_SUFFIXES)


def is_filter(name):
    """Whether a column is called by a filter of the library; errors of any filter of astro-sedpy are not."""
    if name in Filter.names():
        return True
    return name.startswith(SEDPY) and not name.endswith((error_column(""), "_limit"))


def _is_flux(column):
    """Whether a column has a unit of flux density."""
    unit = own_unit(column)
    try:
        return unit is not None and (flux_unit(unit) or u.Unit(unit)).is_equivalent(FNU)
    except (TypeError, ValueError):
        return False


def limits(table, name):
    """
    Find the rows whose flux in a band is an upper limit: array of bool, shape (n,).

    The column ``<name>_limit``, if it is there, is boolean, or holds 0 and 1 or ``true`` and
    ``false`` as text files do; masked and empty values are no limits. A `ValueError` is raised for a column
    that holds something else, such as the limit itself.
    """
    column = f"{name}_limit"
    if column not in table.colnames:
        return np.zeros(len(table), dtype=bool)
    values = table[column]
    mask = np.asarray(own_mask(values))
    data_values = np.asarray(getattr(values, "unmasked", np.ma.getdata(values)))
    text = np.char.strip(np.char.lower(data_values.astype(str)))
    is_true = np.isin(text, _TRUE)
    is_readable = is_true | np.isin(text, _FALSE)
    if own_unit(values) is not None:
        is_readable = is_true = np.zeros(len(table), dtype=bool)
    if data_values.shape != (len(table),) or not np.all(is_readable | mask):
        wanted = f"a table whose column {column!r} is boolean"
        first_values = ", ".join(map(str, values[:3]))
        raise argument_error("photometry", wanted, f"{first_values}, ...")
    return is_true & ~mask


def filter_names(argument, filters):
    """Return the names of a `~miricigale.filters.FilterSet` or list of names: tuple of str."""
    if isinstance(filters, str):
        raise argument_error(argument, "a list of names or a FilterSet", repr(filters))
    return tuple(getattr(filters, "names", filters))


def per_band(value, filters, name):
    """Expand a setting, given as a number or by name, to all filters: dict of str to float."""
    if isinstance(value, dict):
        parts = value
    else:
        parts = dict.fromkeys(filters, value)
    unknown = sorted(set(parts) - set(filters))
    check_that(not unknown, name, f"a dict with keys among {list(filters)}", unknown)
    # 10 % is 0.1
    unit = u.dimensionless_unscaled
    out = {f: float(to_array(parts.get(f, 0.0), unit, name, ndim=0)) for f in filters}
    if not all(np.isfinite(part) and part >= 0 for part in out.values()):
        raise argument_error(name, "finite and not negative", f"{value}")
    return out


def flux_column(table, name):
    """
    Read the fluxes of a column in uJy, NaN where masked: a new array, shape (n,).

    A `ValueError` is raised for one without real numbers, or with several in a row.
    """
    column = table[name]
    _check_numbers(column, name)
    column = getattr(column, "unmasked", column)
    array = to_array(column, FNU, name, ndim=1).copy()
    array[np.broadcast_to(np.asarray(getattr(table[name], "mask", False)), array.shape)] = np.nan
    return array


def flags_of_fits(results, measured, edge_weight):
    """
    Add the flags that follow from fits to those of results.

    ``measured`` are the bands with a flux, shape (n, nb); ``edge_weight`` is the weight of the first
    or last redshift above which an object is flagged, None where redshifts were fixed.
    """
    flags = np.array(results.flags)
    fitted = results.fitted
    pdf = results.pdf["redshift"]
    signal = np.where(measured, results.best_flux / results.sigma, 0.0)
    flags[fitted & (results.band_off != "")] |= FitFlags.BAND_OFF
    flags[fitted & ~(results.best_scale > 0)] |= FitFlags.NO_SIGNAL
    # S/N of the best model in all bands together
    faint = np.sqrt(np.sum(signal * signal, axis=1)) < LOW_SIGNAL
    flags[fitted & faint] |= FitFlags.LOW_SIGNAL
    if edge_weight is not None and pdf.shape[1] > 2:
        edge = np.maximum(pdf[:, 0], pdf[:, -1]) > edge_weight
        flags[fitted & edge] |= FitFlags.REDSHIFT_EDGE
    if edge_weight is not None and "stellar_mass" in results.quantities:
        flags[fitted & (results.median("stellar_mass").value < LOW_MASS)] |= FitFlags.LOW_MASS
    flags[~fitted & ((flags & FitFlags.UNFITTED) == 0)] |= FitFlags.NO_SIGNAL
    return flags
