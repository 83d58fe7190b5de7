"""Star-formation histories, in steps of 1 Myr."""

import hashlib

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.sed import _core
from miricigale.sed.component import Component, register
from miricigale.sed.parameter import Parameter, default_values
from miricigale.utils.exceptions import argument_error
from miricigale.utils.missing_values import own_mask
from miricigale.utils.options import check_that
from miricigale.utils.tables import as_table
from miricigale.utils.units import is_ascending, to_array

_RATE = u.Msun / u.yr


class StarFormationHistory(Component):
    """
    Base: `history` gives rates that form one solar mass.

    Examples
    --------
    >>> from miricigale.sed.components import ConstantSFH
    >>> sfh = ConstantSFH(age=0.5)
    >>> sfh.steps({"age": 0.5}), sfh.role
    (500, 'sfh')
    """

    role = "sfh"
    age = Parameter(
        1.0, (0.001, 13.7), "Time since the first stars formed; rounded to 1 Myr.", unit="Gyr"
    )

    def steps(self, values):
        """Number of steps of 1 Myr."""
        return max(1, round(values["age"] * 1e3))

    def history(self, values):
        """
        Star-formation rate.

        Returns
        -------
        rate : `~numpy.ndarray`, shape (n_steps,)
            In Msun/yr for one solar mass formed, oldest step first.
        """
        raise NotImplementedError


class BurstHistory(StarFormationHistory):
    """Base: histories that may end in an exponential burst."""

    linear = "f_burst"
    tau = Parameter(1.0, (0.001, 100.0), "E-folding time.", unit="Gyr")
    f_burst = Parameter(0.0, (0.0, 0.99), "Mass fraction made in the burst.", absent_at_zero=True)
    age_burst = Parameter(0.02, (0.001, 5.0), "Time since the burst began.", unit="Gyr")
    tau_burst = Parameter(0.05, (0.001, 100.0), "E-folding time of the burst.", unit="Gyr")

    def _numbers(self, values):
        """Return the arguments of the functions in `_core`, times in Myr."""
        return (
            self.steps(values),
            values["tau"] * 1e3,
            values["f_burst"],
            max(1, round(values["age_burst"] * 1e3)),
            values["tau_burst"] * 1e3,
        )

    def invalid(self, values):
        if values["f_burst"] > 0.0 and values["age_burst"] > values["age"]:
            return f"'age_burst' must not exceed 'age', got {values['age_burst']:g} Gyr"
        return None


@register
class DelayedSFH(BurstHistory):
    """
    Delayed exponential history, with an optional recent burst.

    ``SFR_t = t exp(-t / tau) / tau^2`` for t = 0, 1, ... age - 1 Myr, and an exponential burst
    in the last ``age_burst`` that makes the fraction ``f_burst`` of all stars.

    Examples
    --------
    >>> from miricigale.sed.components import DelayedSFH
    >>> sfh = DelayedSFH(tau=0.5, age=2.0)
    >>> values = {name: par.default for name, par in sfh.parameters.items()}
    >>> rate = sfh.history(values)
    >>> print(f"the rate peaks at {rate.argmax()} of {rate.size} Myr")
    the rate peaks at 500 of 2000 Myr
    """

    name = "delayed"
    reference = "Boquien et al. 2019, A&A 622, A103, eq. 3"

    def history(self, values):
        return _core.delayed_history(*self._numbers(values))


@register
class DoubleExponentialSFH(BurstHistory):
    """
    Two exponentials: the main history and a recent burst (``sfh2exp`` of CIGALE).

    ``SFR_t = exp(-t / tau)`` for t = 0, 1, ... age - 1 Myr, rising where ``tau`` is negative,
    and an exponential burst in the last ``age_burst`` that makes the fraction ``f_burst`` of
    all stars.

    Examples
    --------
    >>> from miricigale.sed.components import DoubleExponentialSFH
    >>> sfh = DoubleExponentialSFH(tau=3.0, f_burst=0.1, age_burst=0.1)
    >>> values = {name: par.default for name, par in sfh.parameters.items()}
    >>> rate = sfh.history(values)
    >>> print(f"the burst raises the rate {rate[-100] / rate[-101]:.1f} times")
    the burst raises the rate 3.9 times
    """

    name = "double_exponential"
    reference = "Boquien et al. 2019, A&A 622, A103, sect. 3.1.1"
    tau = Parameter(
        6.0,
        (-100.0, 100.0),
        "E-folding time of the main history; negative: the rate rises; not within 1 Myr of 0.",
        unit="Gyr",
    )
    f_burst = Parameter(0.01, (0.0, 0.99), "Mass fraction made in the burst.", absent_at_zero=True)

    def history(self, values):
        return _core.double_exponential_history(*self._numbers(values))

    def invalid(self, values):
        if abs(values["tau"]) < 0.001:
            return f"'tau' must be 0.001 Gyr or more, or -0.001 or less, got {values['tau']:g}"
        return super().invalid(values)


@register
class ConstantSFH(StarFormationHistory):
    """
    Constant star-formation rate.

    Examples
    --------
    >>> from miricigale.sed.components import ConstantSFH
    >>> rate = ConstantSFH().history({"age": 0.1})  # Msun/yr for one solar mass
    >>> rate.size, round(float(rate[0]) * 1e8, 3)
    (100, 1.0)
    """

    name = "constant"
    reference = "Kennicutt 1998, ARA&A 36, 189"

    def history(self, values):
        steps = self.steps(values)
        return np.full(steps, 1e-6 / steps)


@register
class TableSFH(StarFormationHistory):
    """
    Any history, from a table.

    Each row begins a bin of time in which the rate is constant: it lasts until the next row,
    the last one as long as the one before it. With rows of 1 Myr these are the steps; other
    bins are integrated onto steps of 1 Myr, so that the mass is conserved. Rates are taken
    relative to one another: the stars formed until ``age`` are one solar mass.

    Parameters
    ----------
    table : `~astropy.table.Table` or path-like
        Column ``time`` and one or more columns of rates, with units; or a file of it that
        `astropy.table.Table.read` understands.
    path : path-like, optional
        The file, where there is no ``table`` (for configurations).
    **defaults
        As for `~miricigale.sed.Component`; ``age`` is the table's length if it is not given.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file cannot be read.
    ValueError
        If times do not ascend, or a value is negative, masked or not finite.
    `~astropy.units.UnitsError`
        If a column has no unit or a wrong one.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropy.table import QTable
    >>> from miricigale.sed.components import TableSFH
    >>> rates = [1.0, 5.0, 0.5] * u.Msun / u.yr
    >>> sfh = TableSFH(QTable({"time": [0, 200, 300] * u.Myr, "sfr": rates}))
    >>> sfh.age, sfh.history({"age": 0.4, "sfh_index": 0}).size  # Gyr, steps
    (0.4, 400)
    """

    name = "sfh_table"
    reference = "Boquien et al. 2019, A&A 622, A103, sect. 3.1.1"
    sfh_index = Parameter(0, (0, 9999), "Which column of rates, counted from 0.", label=True)
    age = Parameter(
        1.0,
        (0.001, 13.7),
        "Time of observation since the first row; rounded to 1 Myr; default: the table's end.",
        unit="Gyr",
    )

    def __init__(self, table=None, *, path=None, **defaults):
        if (table is None) == (path is None):
            raise argument_error("table", "a table or a path, one of them", "both or none")
        table = QTable(as_table(path if table is None else table, "table"), copy=False)
        edges, rates = _bins(table)
        self._columns = tuple(name for name in table.colnames if name != "time")
        self._sha256 = hashlib.sha256(edges.tobytes() + rates.tobytes()).hexdigest()
        self._rates = np.array([_core.table_history(edges, rate) for rate in rates])
        self._rates.flags.writeable = False
        length = self._rates.shape[1] / 1e3
        super().__init__(**{"age": length} | defaults)
        why = self.invalid(default_values(self.parameters))
        if why:
            raise ValueError(why)

    @property
    def settings(self):
        return {"columns": self._columns, "sha256": self._sha256}

    def history(self, values):
        rate = self._rates[int(values["sfh_index"]), : self.steps(values)]
        return rate * (1e-6 / rate.sum())

    def invalid(self, values):
        index = values["sfh_index"]
        n = len(self._rates)
        if index != int(index) or index >= n:
            return f"'sfh_index' must be a whole number below {n}, got {index:g}"
        steps = self.steps(values)
        if steps > self._rates.shape[1]:
            end = self._rates.shape[1] / 1e3
            return f"'age' must not exceed the end of the table, {end:g} Gyr, got {values['age']:g}"
        if not np.any(self._rates[int(index), :steps]):
            return f"'age' must be after the first stars of the table, got {values['age']:g} Gyr"
        return None


def _bins(table):
    """Return the edges of the bins in Myr and rates in Msun/yr, shape (n_column, n_bin), checked."""
    names = [name for name in table.colnames if name != "time"]
    wanted = "with a column 'time' and one or more columns of rates"
    check_that("time" in table.colnames and names, "table", wanted, table.colnames)
    check_that(len(table) >= 2, "table", "of two rows or more", len(table))
    time = _column(table, "time", u.Myr)
    check_that(is_ascending(time), "time", "ascending", "times that do not ascend")
    rates = np.array([_column(table, name, _RATE) for name in names])
    for name, rate in zip(names, rates, strict=True):
        check_that(not np.any(rate < 0), name, "rates of 0 or more", f"{rate.min():g}")
        check_that(np.any(rate > 0), name, "a history that forms stars", "zeros")
    return np.append(time, 2 * time[-1] - time[-2]), rates


def _column(table, name, unit):
    column = table[name]
    if np.any(own_mask(column)):
        raise argument_error(name, "without masked values", f"{np.sum(column.mask)} masked")
    return to_array(column, unit, name, ndim=1, finite=True)
