"""The units of arrays inside the package, and conversions to them at the public methods."""

import functools
import re
import warnings

import astropy.units as u
import numpy as np

from miricigale.utils.arrays import quiet_division
from miricigale.utils.exceptions import argument_error, units_error
from miricigale.utils.missing_values import without_mask
from miricigale.utils.named_values import field_values
from miricigale.utils.options import check_that

#: Units declared once; every array inside the package is in one of these.
WAVE = u.um
FNU = u.uJy
FLAM = u.erg / u.s / u.cm**2 / u.AA
LUMINOSITY = u.W
MASS = u.Msun
SURFACE_BRIGHTNESS = u.MJy / u.sr
DN = u.adu
TIME = u.s
RATE = u.adu / u.s
ANGLE = u.arcsec
_FLUX_DENSITY = FNU.physical_type

#: Flux density of AB magnitude 0, and with it the unit of the SDSS and the Legacy Surveys.
_MAGGY = 3630.780547701013 * u.Jy
_MAGGY_NAMES = {
    "maggy": 1.0, "maggies": 1.0, "mgy": 1.0, "mggy": 1.0,
    "nanomaggy": 1e-9, "nanomaggies": 1e-9, "nmgy": 1e-9, "nanomgy": 1e-9, "nmggy": 1e-9, "nanomaggie": 1e-9,
    "micromaggy": 1e-6, "micromaggies": 1e-6,
}  # fmt: skip
#: Spellings of Jansky that leave no choice, in lower case ("mjy" may be millijansky or megajansky).
_JANSKY_NAMES = {
    "jy": u.Jy, "jansky": u.Jy, "janskys": u.Jy,
    "millijy": u.mJy, "millijansky": u.mJy, "millijanskys": u.mJy,
    "ujy": u.uJy, "mujy": u.uJy, "microjy": u.uJy, "microjansky": u.uJy, "microjanskys": u.uJy,
    "\u00b5jy": u.uJy, "\u03bcjy": u.uJy, "micro-jansky": u.uJy, "micro-jy": u.uJy,
    "njy": u.nJy, "nanojy": u.nJy, "nanojansky": u.nJy, "nanojanskys": u.nJy,
}  # fmt: skip
#: Degrees and hours of right ascension by the names of headers and of VizieR, in lower case without blanks.
_ANGLE_NAMES = {
    "deg": u.deg, "degs": u.deg, "degree": u.deg, "degrees": u.deg, "deg.": u.deg, "d:m:s": u.deg,
    "h": u.hourangle, "hr": u.hourangle, "hrs": u.hourangle, "hour": u.hourangle, "hours": u.hourangle,
    "h:m:s": u.hourangle, "hourangle": u.hourangle,
}  # fmt: skip
#: Names of AB magnitudes as a unit, in lower case without blanks.
_AB_NAMES = ("abmag", "mag(ab)", "ab", "mag_ab", "magab", "ab_mag", "abmags")


def with_adu(unit):
    """
    Return a unit of counts or rates with adu for DN, which astropy takes for another unit.

    Parameters
    ----------
    unit : `~astropy.units.UnitBase`
        Of an image.

    Returns
    -------
    unit : `~astropy.units.UnitBase`
        Itself, if it is none of DN or DN/s.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.utils.units import with_adu
    >>> with_adu(u.DN / u.s)
    Unit("adu / s")
    """
    for counts, replacement in ((u.DN, DN), (u.DN / u.s, RATE)):
        if isinstance(unit, u.UnitBase) and unit.is_equivalent(counts):
            factor = unit.to(counts)
            if factor == 1:
                return replacement
            return u.Unit(factor * replacement)
    return unit


def header_unit(unit):
    """
    Return the text of a unit for ``BUNIT`` of a header: DN for adu, as jwst calls counts.

    Parameters
    ----------
    unit : `~astropy.units.UnitBase`
        Of an image. Units that the standard of FITS does not have are written as astropy reads them.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.utils.units import header_unit
    >>> header_unit(u.adu / u.s), header_unit(u.DN / u.s), header_unit(u.MJy / u.sr)
    ('DN/s', 'DN/s', 'MJy sr-1')
    >>> header_unit(u.electron / u.s)
    'electron / s'
    """
    if with_adu(unit) == RATE:
        return "DN/s"
    if with_adu(unit) == DN:
        return "DN"
    try:
        return unit.to_string("fits")
    except ValueError:
        return unit.to_string()


def flux_unit(unit):
    """
    Return the unit that a name of a flux density means beyond those of astropy.

    Parameters
    ----------
    unit : `~astropy.units.Unit` or str
        ``"nanomaggies"``, ``"nmgy"``, ``"maggies"`` (AB, 3631 Jy for 1) and ``u.mgy`` are units of flux density,
        ``"ABmag"``, ``"mag(AB)"``, ``"AB mag"`` AB magnitudes. Of Jansky any spelling that leaves no choice is
        taken, such as ``"UJY"`` or ``"microjansky"``, in round brackets or not; square ones are logarithms in
        tables of CDS. A number may stand before a unit, ``"1e-29 erg/s/cm2/Hz"``, as the FITS standard forbids.

    Returns
    -------
    unit : `~astropy.units.UnitBase` or `~astropy.units.FunctionUnitBase` or None
        None for anything else.

    Examples
    --------
    >>> from miricigale.utils.units import flux_unit
    >>> flux_unit("nanomaggies")
    Unit("3.63078 uJy")
    >>> flux_unit("AB mag")
    Unit("mag(AB)")
    """
    text = re.sub(r"\s+", "", str(unit)).lower()
    text = re.sub(r"^\((.*)\)$", r"\1", text)
    if text in _JANSKY_NAMES:
        return _JANSKY_NAMES[text]
    if text in _AB_NAMES:
        return u.ABmag
    if text in _MAGGY_NAMES:
        return u.Unit(_MAGGY_NAMES[text] * _MAGGY.to(u.uJy))
    if isinstance(unit, u.UnitBase) and u.mgy in unit.bases and unit.is_equivalent(u.mgy):
        return u.Unit(unit.to(u.mgy) * _MAGGY.to(u.uJy))
    if isinstance(unit, (str, u.UnrecognizedUnit)):
        return _scaled_unit(str(unit))
    return None


def _scaled_unit(text):
    """Unit of flux density after a number; None for anything else."""
    if not re.match(r"\s*\d", text):
        return None
    with warnings.catch_warnings():
        # of several slashes
        warnings.simplefilter("ignore", u.UnitsWarning)
        try:
            unit = u.Unit(text)
        except (TypeError, ValueError):
            return None
    if isinstance(unit, u.UnitBase) and unit.is_equivalent(FNU):
        return unit
    return None


def angle_unit(unit):
    """
    Return the unit of an angle on the sky that a name means, beyond those of astropy.

    Parameters
    ----------
    unit : `~astropy.units.Unit` or str
        Such as ``"degrees"``, ``"[deg]"`` or, of right ascensions, ``"h"``.

    Returns
    -------
    unit : `~astropy.units.UnitBase`
        The unit itself for any other name.
    """
    text = re.sub(r"[\s\"'\[\]]+", "", str(unit)).lower()
    return _ANGLE_NAMES.get(text, unit)


def to_array(value, unit, name, *, ndim=None, finite=False, equivalencies=None):
    """
    Convert a quantity to a plain float64 array in ``unit``.

    Parameters
    ----------
    value : `~astropy.units.Quantity`
        Anything `~astropy.units.Quantity` accepts, masked or not (`miricigale.utils.missing_values.mask_of`); a
        bare number is refused unless ``unit`` is dimensionless.
    unit : `~astropy.units.Unit`
        The unit wanted.
    name : str
        The argument's name, for the error message.
    ndim : int, optional
        Required number of dimensions.
    finite : bool, optional
        Whether NaN and infinity are refused.
    equivalencies : list, optional
        Passed to `~astropy.units.Quantity.to_value`.

    Returns
    -------
    array : `~numpy.ndarray`
        Float64 values in ``unit``, NaN where they are masked; a new array or a view of the input.

    Raises
    ------
    `~astropy.units.UnitsError`
        If the unit cannot be converted or is missing.
    ValueError
        If it is no real number, the number of dimensions is wrong or a value is not finite; with ``finite`` masked
        values are not.
    """
    unit = u.Unit(unit)
    value, mask = without_mask(value)
    # not is_equivalent, which tries the equivalency of redshifts that astropy.cosmology enables
    if isinstance(own_unit(value), u.UnitBase) and unit.physical_type == _FLUX_DENSITY:
        # maggies, which astropy ties to no flux
        flux = flux_unit(value.unit)
        if flux is not None:
            value = u.Quantity(getattr(value, "value", value), flux)
    try:
        quantity = u.Quantity(value)
    except u.UnitTypeError:
        # magnitudes and other logarithms
        raise units_error(name, f"convertible to {unit}", value.unit) from None
    except (TypeError, ValueError):
        wanted = _convertible(unit, "numbers")
        got = type(value).__name__
        if isinstance(value, (str, list)):
            got = repr(value)
        raise argument_error(name, wanted, got) from None
    if quantity.dtype.kind == "c":
        raise argument_error(name, "real numbers", "complex numbers")
    is_bare = not hasattr(value, "unit") and quantity.unit == u.dimensionless_unscaled
    if is_bare and unit != u.dimensionless_unscaled:
        raise units_error(name, f"a quantity convertible to {unit}", "a bare number")
    try:
        array = np.asarray(quantity.to_value(unit, equivalencies or []), dtype=float)
    except u.UnitConversionError:
        wanted = _convertible(unit, "convertible to a number without a unit")
        raise units_error(name, wanted, own_unit(value)) from None
    if mask is not None:
        array = np.where(mask, np.nan, array)
    if ndim is not None and array.ndim != ndim:
        raise argument_error(name, f"an array of {ndim} dimension(s)", f"shape {array.shape}")
    if finite and not np.all(np.isfinite(array)):
        n_bad = int(np.count_nonzero(~np.isfinite(array)))
        masked = "masked, " * (mask is not None)
        raise argument_error(name, "finite values", f"{n_bad} that are {masked}NaN or infinite")
    return array


def _convertible(unit, number):
    """Words for a value in a unit, or for a ``number`` without one."""
    if unit == u.dimensionless_unscaled:
        return number
    return f"convertible to {unit}"


class Frozen:
    """Base of frozen dataclasses: copies and pickles go through the constructor and stay read-only."""

    def __reduce__(self):
        values = field_values(self)
        return functools.partial(type(self), **values), ()


def own_unit(value):
    """Return the unit that a value or column has; None without one."""
    return getattr(value, "unit", None)


def scalar(value, unit, name):
    """A finite quantity as a number in ``unit``, after checking that it is one (errors as `to_array`)."""
    return float(to_array(value, unit, name, ndim=0, finite=True))


def positive(value, unit, name):
    """A quantity as a number in ``unit``, after checking that it is one, above 0 (errors as `to_array`)."""
    number = scalar(value, unit, name)
    check_that(number > 0, name, "positive", value)
    return number


def is_number(value, kind=np.number):
    """Whether a value is one number, and of a kind; True and False are none."""
    array = np.asarray(value)
    return array.ndim == 0 and np.issubdtype(array.dtype, kind)


def is_ascending(values, min_size=1):
    """Whether an array has one dimension and ``min_size`` values or more, each above the last; NaN is not."""
    return values.ndim == 1 and values.size >= min_size and bool(np.all(np.diff(values) > 0))


def are_not_negative(values):
    """Whether all values of an array are finite, and 0 or more."""
    return bool(np.all(np.isfinite(values) & (values >= 0)))


def check_count(value, name, least=1):
    """Return an integer after checking that it is one, not below ``least`` (a `ValueError`)."""
    good = is_number(value, np.integer) and value >= least
    check_that(good, name, f"an integer >= {least}", repr(value))
    return int(value)


def ab_magnitude(flux):
    """AB magnitudes of flux densities, as plain numbers; NaN where they are not positive."""
    value = to_array(flux, FNU, "flux")
    with quiet_division():
        return np.where(value > 0, 23.9 - 2.5 * np.log10(value), np.nan)


def ab_quantity(value):
    """A flux or magnitude as a quantity; a bare number is an AB magnitude."""
    if isinstance(value, u.Quantity):
        return value
    return float(value) * u.ABmag


def frozen_array(value, dtype=float):
    """Copy ``value`` to a C-contiguous array of ``dtype`` that cannot be written to."""
    array = np.array(value, dtype=dtype, order="C", copy=True)
    array.flags.writeable = False
    return array


def frozen_quantity(value, unit, name, *, ndim=None, finite=False):
    """
    Copy a quantity to ``unit`` and mark it read-only.

    Parameters are those of `to_array`; the result is a `~astropy.units.Quantity`.
    """
    array = frozen_array(to_array(value, unit, name, ndim=ndim, finite=finite))
    return u.Quantity(array, unit, copy=False)
