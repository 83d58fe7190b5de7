"""Parameters as components declare them."""

import math

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.utils.exceptions import argument_error, units_error
from miricigale.utils.missing_values import without_mask
from miricigale.utils.options import check_that


class Parameter:
    """
    One parameter of a component: unit, default, bounds and doc, declared in a class body.

    The fitter, the configuration and the docs read the same declaration. On a class the
    attribute is the `Parameter`, on an instance its default value (a float in the unit),
    which the constructor of the component may change.

    Parameters
    ----------
    default : float
        In ``unit``.
    bounds : tuple of float
        Smallest and largest value allowed, in ``unit``, both included.
    doc : str
        One sentence that says what it is.
    unit : `~astropy.units.Unit` or str, optional
        Unit; dimensionless if not given.
    logarithms : tuple of float, optional
        Bare numbers between these are refused: they are logarithms rather than values. A quantity is what it
        says.
    absent_at_zero : bool, optional
        Whether 0 means that what the parameter measures is not there (no burst, no dust, no AGN), so that
        other parameters of it have no effect. The prior of a fit then has a finite weight at 0 itself.
    label : bool, optional
        Whether values are labels of what a library has, with no models between them.

    Raises
    ------
    ValueError
        If the default is outside the bounds.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.sed import Parameter
    >>> age = Parameter(1.0, (0.001, 13.7), "Age of the galaxy.", unit="Gyr")
    >>> age.check(300 * u.Myr)
    0.3
    """

    def __init__(
        self,
        default,
        bounds,
        doc,
        *,
        unit="",
        logarithms=None,
        absent_at_zero=False,
        label=False,
    ):
        self.unit = u.Unit(unit)
        self.logarithms = logarithms
        self.default = float(default)
        self.bounds = (float(bounds[0]), float(bounds[1]))
        self.doc = str(doc)
        self.absent_at_zero = bool(absent_at_zero)
        self.label = bool(label)
        self.name = ""
        self.check(self.default)

    def __set_name__(self, owner, name):
        self.name = name

    @property
    def description(self):
        """What it is: ``doc``, by the name that astropy has for it."""
        return self.doc

    def __get__(self, instance, owner=None):
        if instance is None:
            return self
        return instance.__dict__.get(self.name, self.default)

    def __set__(self, instance, value):
        msg = f"parameter {self.name!r} is set when the component is made"
        raise AttributeError(msg)

    def replace(self, default, name=None):
        """Copy with another default, and another name if one is given."""
        new = Parameter(
            default,
            self.bounds,
            self.doc,
            unit=self.unit,
            logarithms=self.logarithms,
            absent_at_zero=self.absent_at_zero,
            label=self.label,
        )
        new.name = name or self.name
        return new

    def check(self, value):
        """
        Convert a value to a float in the unit and check the bounds.

        Parameters
        ----------
        value : float, `~astropy.units.Quantity` or str
            A bare number is taken in the declared unit; text is a quantity, such as ``"300 Myr"``.

        Raises
        ------
        `~astropy.units.UnitsError`
            If the unit cannot be converted.
        ValueError
            If it is not one finite number inside the bounds, or a logarithm.
        """
        if isinstance(value, str):
            value = self._read(value)
        number = self.convert(value)
        check_that(np.ndim(number) == 0, self.name, "one number", f"shape {np.shape(number)}")
        if number is np.ma.masked or np.asarray(number).dtype.kind not in "iuf":
            raise argument_error(self.name, "one number", repr(value))
        number = float(number)
        low, high = self.bounds
        if not (math.isfinite(number) and low <= number <= high):
            raise argument_error(self.name, f"from {low} to {high} {self.unit}".rstrip(), number)
        return number

    def array(self, values):
        """
        Convert several values to an array in the unit; masked ones are NaN.

        Parameters
        ----------
        values : array_like, `~astropy.table.Column` or `~astropy.units.Quantity`, shape (n,)
            Bare numbers are taken in the declared unit.

        Returns
        -------
        array : `~numpy.ndarray` of float, shape (n,)

        Raises
        ------
        `~astropy.units.UnitsError`
            If the unit cannot be converted.
        ValueError
            If they are not real numbers, or have more than one dimension.
        """
        if isinstance(values, (list, tuple)) and any(hasattr(v, "unit") for v in values):
            values = self._quantity(values, "a mixture")
        values, mask = without_mask(values)
        converted = self.convert(values)
        array = np.atleast_1d(np.asarray(np.ma.getdata(converted)))
        check_that(array.ndim == 1, self.name, "of one dimension", f"shape {array.shape}")
        check_that(array.dtype.kind in "iuf", self.name, "numbers", f"values of type {array.dtype}")
        out = array.astype(float)
        if mask is not None:
            out[np.broadcast_to(mask, out.shape)] = np.nan
        return out

    def convert(self, value):
        """Convert a number, array or quantity to plain numbers in the unit."""
        if not hasattr(value, "unit") or value.unit is None:
            self._refuse_logarithms(value)
            return value
        if isinstance(value, u.LogQuantity):
            value = value.physical
        return self._quantity(value, value.unit).to_value(self.unit)

    def _read(self, text):
        """Return the quantity that text is; numbers without a unit in quotes are slips."""
        try:
            value = u.Quantity(text)
        except TypeError:
            value = None
        if value is None or value.unit == u.dimensionless_unscaled:
            raise argument_error(self.name, "one number", repr(text))
        return value

    def _refuse_logarithms(self, value):
        """Refuse bare numbers that are logarithms rather than values."""
        data = np.ma.getdata(value)
        if self.logarithms is None or np.asarray(data).dtype.kind not in "iuf":
            return
        low, high = self.logarithms
        suspects = np.atleast_1d(data)
        suspects = suspects[(suspects > low) & (suspects < high)]
        if suspects.size:
            unit = self.unit.to_string()
            wanted = f"in {unit}, not its logarithm: 10**{suspects[0]:g} or, if it is so small, a quantity"
            raise argument_error(self.name, wanted, f"{suspects[0]:g}")

    def _quantity(self, value, unit):
        try:
            return u.Quantity(value).to(self.unit)
        except (u.UnitConversionError, TypeError, ValueError):
            if self.unit != u.dimensionless_unscaled:
                wanted = self.unit
            else:
                wanted = "a number"
            raise units_error(self.name, f"convertible to {wanted}", unit) from None

    def __repr__(self):
        if self.unit != u.dimensionless_unscaled:
            unit = f" {self.unit}"
        else:
            unit = ""
        return f"<Parameter {self.name!r} {self.default}{unit}, {self.bounds}: {self.doc}>"


def default_values(parameters):
    """Return the default of each `Parameter`, in its unit, by name."""
    return {name: parameter.default for name, parameter in parameters.items()}


def parameter_table(parameters):
    """Tabulate parameters, a dict by name; see `SEDModel.to_table`."""
    rows = []
    for name, parameter in parameters.items():
        low, high = parameter.bounds
        row = {"name": name, "default": parameter.default, "low": low, "high": high}
        row |= {"unit": str(parameter.unit), "description": parameter.description}
        rows.append(row)
    return QTable(rows=rows)


#: Parameters of a model that are of none of its components.
MODEL_PARAMETERS = {
    "redshift": Parameter(1.0, (0.0, 20.0), "Redshift."),
    # a mass formed of 3 to 20 suns is the logarithm of one
    "mass": Parameter(
        1e10, (0.0, 1e16), "Mass of all stars ever formed.", unit="Msun", logarithms=(3.0, 20.0)
    ),
    "dust_excess": Parameter(
        1.0,
        (0.0, 1e6),
        "Dust luminosity over the power that attenuation takes; 1 is energy balance.",
    ),
}
for _name, _parameter in MODEL_PARAMETERS.items():
    _parameter.name = _name
