"""Tables of the parts of a model's light, finer than its grid, and derived quantities that follow from them."""

import threading
from collections import OrderedDict

import astropy.units as u
import numpy as np

from miricigale.fitting import _core
from miricigale.fitting.grid.part_tables import (
    MAX_MODELS,
    PartAxes,
    combinations,
    empty_part,
    finer_redshifts,
    log_columns,
    logarithms,
    make_part,
    part_columns,
    with_columns,
)
from miricigale.sed.grid_cache import grid_key, is_own
from miricigale.sed.light_parts import (
    FORMED_COLUMNS,
    LightParts,
    part_parameters,
    quantities_of_parts,
)
from miricigale.utils.content_hash import content_sha256
from miricigale.utils.options import check_that
from miricigale.utils.values import value_class

#: Part of a parameter's first step at which dust that may be absent is evaluated in place of 0.
_TRACE_OF_DUST = 1e-3
#: Relative error of masses formed in the last 10 and 100 Myr.
_COLUMN_TOLERANCE = 0.01
#: Part of the stars formed, for each Gyr, that is negligible.
_NEGLIGIBLE_FORMED = 0.01
#: Redshifts at which axes are refined.
_N_LINE_REDSHIFTS = 5
#: Largest step of the tables in ln(1 + z): lines, breaks and features of dust cross the edges of bands. Cells of
#: the redshifts of surveys are divided by three.
REDSHIFT_STEP = 0.02 / 3
#: Bursts differ by less than this along an axis that has no effect on them.
_NO_EFFECT = 1e-6
#: Largest number of tables kept for further fitters of a process (some 50 MB each), the last used at the end.
_MAX_STORED_TABLES = 2
_stored_tables = OrderedDict()
_lock = threading.Lock()


@value_class
class ModelGalaxies:
    """Derived quantities of galaxies from columns of their parts; see `LightParts`."""

    stars: tuple
    burst: tuple
    dust: tuple
    n_sums: int
    constant_age: float
    reference_row: int

    def quantities(self, light, values):
        """Derive quantities for one solar mass formed from values (n, n_parameters): dict of name to array."""
        n = len(values)
        if light.mixing < 0:
            share = np.zeros(n)
        else:
            share = values[:, light.mixing]
        if light.age < 0:
            age = np.full(n, self.constant_age)
        else:
            age = values[:, light.age]
        starlight = part_columns(self.stars, values)
        starlight *= (1.0 - share)[:, None]
        if self.burst.table.shape[1]:
            starlight += share[:, None] * part_columns(self.burst, values)
        absorbed = starlight[:, -1].copy()
        if light.amount >= 0:
            absorbed *= -np.expm1(-_core.SATURATION * values[:, light.amount])
        if light.excess >= 0:
            absorbed *= values[:, light.excess]
        dust = np.zeros((n, self.n_sums))
        if self.dust.table.shape[1]:
            dust = part_columns(self.dust, values)
        quantities = quantities_of_parts(starlight, absorbed, dust, age, self.reference_row)
        if light.by_dust:
            quantities["reference"] = absorbed
        return quantities


class ModelTables:
    """Tables of the parts of a model, refined; see `InterpolatedModels.of_model`."""

    def __init__(self, model, filters, constants, axes, place, redshift):
        self.model = model
        self.filters = filters
        self.axes = axes
        self.place = place
        self.redshift = np.asarray(redshift, float)
        free_values = {name: axis.values for name, axis in axes.items()}
        self.constants = {
            name: value for name, value in constants.items() if name not in free_values
        }
        self.names = {}
        for part, names in part_parameters(model).items():
            self.names[part] = {name: free_values[name] for name in names if name in free_values}
        self.mixing = model.component("sfh").linear
        if self.mixing not in self.names["starlight"]:
            self.mixing = ""
        self.amount = self._amount_of_dust()

    def light_at(self, redshift):
        """Make `LightParts` at redshifts."""
        return LightParts(self.model, self.filters, redshift, self.constants)

    def _amount_of_dust(self):
        """Find the axis of starlight whose value 0 is no dust; "" if there is none."""
        axes = self.names["starlight"]
        light = self.light_at(self.redshift[:1])
        for name, values in axes.items():
            if values[0] != 0.0 or len(values) < 2:
                continue
            row = {parameter: float(nodes[-1]) for parameter, nodes in axes.items()}
            absorbed = light.starlight([row | {name: 0.0}, row]).columns[:, -1]
            if absorbed[0] == 0.0 and absorbed[1] > 0.0:
                return name
        return ""

    def check(self, grid):
        """Refuse a model that did not make the grid."""
        rng = np.random.default_rng(1)
        galaxies = rng.choice(grid.n_galaxies, min(grid.n_galaxies, 20), replace=False)
        z = self.redshift[:: max(len(self.redshift) // 2, 1)]
        table = grid.galaxy_parameters[galaxies]
        rows = [dict(zip(table.colnames, map(_number, row), strict=True)) for row in table]
        light = self.light_at(z)
        index = np.searchsorted(self.redshift, z)
        starlight = light.starlight(rows)
        dust = light.dust(rows)
        power = starlight.columns[:, -1] * [row.get("dust_excess", 1.0) for row in rows]
        flux = starlight.flux + power[:, None, None] * dust.flux
        is_same = _nearly_equal(flux, np.moveaxis(grid.galaxy[index][:, galaxies], 0, 1))
        reference = power
        if self.model.frac_agn_definition != "dust":
            dust_reference = dust.columns[:, self.model.chain.reference_row]
            reference = starlight.columns[:, self._reference_column] + power * dust_reference
        is_same = is_same and _nearly_equal(reference, grid.dust_luminosity[galaxies])
        if grid.n_agn:
            templates = rng.choice(grid.n_agn, min(grid.n_agn, 5), replace=False)
            table = grid.agn_parameters[templates]
            rows = [dict(zip(table.colnames, map(_number, row), strict=True)) for row in table]
            expected = np.moveaxis(grid.agn[index][:, templates], 0, 1)
            is_same = (
                is_same and self.model.has_agn and _nearly_equal(light.agn(rows).flux, expected)
            )
        check_that(
            is_same, "finer", "the model that made the grid", "one with other fluxes at its nodes"
        )

    def _refuses(self, name, row):
        """Tell whether a component that a parameter concerns refuses the values of a row."""
        values = self.model.defaults | self.constants | row
        for component in self.model.components:
            concerned = name in component.parameters or name in component.others
            if component.refuses and concerned and component.invalid(values):
                return True
        return False

    # ------------------------------------------------------------------------- parts

    def _starlight_logs(self, light, rows):
        """Return ln of fluxes, of what AGN fractions may refer to, and of the dust's power over its saturation."""
        return self._starlight_tables(*self._starlight(light, rows), light.redshift)[0]

    def _starlight_tables(self, flux, columns, ratio, redshift):
        """Compute the logarithms that fluxes follow from, and those of columns, the last the dust's power."""
        reference = columns[:, self._reference_column]
        logs = logarithms(flux, np.column_stack([reference, ratio]), redshift)
        columns = np.column_stack([columns[:, :-1], ratio])
        return logs, log_columns(columns)

    @property
    def _reference_column(self):
        n = len(self.model.chain.functionals)
        return -1 - n + self.model.chain.reference_row % n

    def _starlight(self, light, rows, share=0.0):
        """Evaluate fluxes, columns, and the dust's power over its saturation, at a mass fraction of the burst."""
        if self.mixing:
            rows = [row | {self.mixing: share} for row in rows]
        table = light.starlight(rows)
        excess = self.constants.get("dust_excess", 1.0)
        power = excess * table.columns[:, -1]
        if not self.amount:
            return table.flux, table.columns, power
        amounts = np.array([row[self.amount] for row in rows])
        without = np.flatnonzero(amounts == 0.0)
        if without.size:
            # the limit of the ratio
            little = _TRACE_OF_DUST * float(self.names["starlight"][self.amount][1])
            amounts[without] = little
            dusty_rows = [rows[i] | {self.amount: little} for i in without]
            power[without] = excess * light.absorbed(dusty_rows)
        return table.flux, table.columns, power / -np.expm1(-_core.SATURATION * amounts)

    def _dust_logs(self, light, rows):
        table = light.dust(rows)
        reference = table.columns[:, [self.model.chain.reference_row]]
        return logarithms(table.flux, reference, light.redshift)

    def _agn_logs(self, light, rows):
        flux = light.agn(rows).flux
        return logarithms(flux, np.zeros((len(rows), 0)), light.redshift)

    def _refined_part(self, name, evaluate, light, lines):
        """
        Make the table of a part on axes that are refined where the interpolation needs it.

        Returned are the `_core.Part`, values of its axes, powers of their scales, and all combinations of values.
        """
        axes = {n: values for n, values in self.names[name].items() if n != self.mixing}
        axes, powers = PartAxes(axes, evaluate, self._refuses).refined(lines)
        rows = combinations(axes)
        logs = evaluate(light, rows)
        part = make_part(tuple(axes), axes, powers, logs, light.redshift, self.place)
        return part, axes, powers, rows

    def tables(self):
        """
        Return `_core.Light`, derived quantities of galaxies, and properties of AGN.

        A process keeps the last two: fits of the same models and bands, such as a calibration and the fit after
        it, share them. No caller may change the arrays. They are not marked read-only, because numba would compile
        the kernels once more for read-only arrays.
        """
        if not is_own(self.model):
            return self._evaluated()
        key = self._key()
        with _lock:
            tables = _stored_tables.pop(key, None)
        if tables is None:
            tables = self._evaluated()
        with _lock:
            _stored_tables[key] = tables
            while len(_stored_tables) > _MAX_STORED_TABLES:
                _stored_tables.popitem(last=False)
        return tables

    def _key(self):
        """Compute a checksum of all that tables depend on."""
        axes = {
            name: [axis.kind, np.asarray(axis.values, float)] for name, axis in self.axes.items()
        }
        content = [self.constants, axes, list(self.place), self.redshift, REDSHIFT_STEP]
        return grid_key(self.model, {}, self.filters), content_sha256(content)

    def _evaluated(self):
        n_lines = min(_N_LINE_REDSHIFTS, len(self.redshift))
        picked = np.linspace(0, len(self.redshift) - 1, n_lines + 2)[1:-1]
        lines = self.light_at(self.redshift[np.unique(np.rint(picked).astype(int))])
        chain = self.model.chain
        n_bands = len(self.filters)
        n_sums = len(chain.functionals)

        light = self.light_at(finer_redshifts(self.redshift, REDSHIFT_STEP))
        stars, axes, powers, _ = self._refined_part("starlight", self._starlight_logs, light, lines)
        star_columns = self._star_columns(axes, powers, lines)
        burst = empty_part(n_bands + 2)
        burst_columns = empty_part(star_columns.table.shape[2])
        if self.mixing:
            burst, burst_columns = self._burst(light, axes, powers)
        dust = empty_part(n_bands + 1)
        dust_columns = empty_part(n_sums)
        if self.model.component("dust") is not None:
            dust, _, _, rows = self._refined_part("dust", self._dust_logs, light, lines)
            dust_columns = with_columns(dust, log_columns(lines.dust(rows).columns))
        agn = empty_part(n_bands)
        agn_columns = empty_part(0)
        if any(axis.kind == "frac_agn" for axis in self.axes.values()):
            agn, _, _, rows = self._refined_part("agn", self._agn_logs, light, lines)
            agn_columns = with_columns(agn, log_columns(lines.agn(rows).columns))
        place = self.place
        universe = self.model.cosmology.age(light.redshift).to_value(u.Gyr)
        # of a type with the ages of grids: kernels are compiled once
        universe = np.ascontiguousarray(universe)
        parts = _core.Light(
            stars=stars,
            burst=burst,
            dust=dust,
            agn=agn,
            mixing=place.get(self.mixing, -1),
            amount=place.get(self.amount, -1),
            excess=place.get("dust_excess", -1),
            age=place.get("age", -1),
            youth=universe,
            by_dust=self.model.frac_agn_definition == "dust",
        )
        galaxies = ModelGalaxies(
            stars=star_columns,
            burst=burst_columns,
            dust=dust_columns,
            n_sums=n_sums,
            constant_age=float(lines.values["age"]),
            reference_row=chain.reference_row,
        )
        return parts, galaxies, agn_columns

    def _star_columns(self, axes, powers, lines):
        """
        Make the table of the columns of starlight.

        Star-formation rates have a kink where galaxies are as old as the span of their mean: axes are refined once
        more for them, which costs little without redshifts and bands.
        """
        light = self.light_at(lines.redshift[:1])

        def formed(light, rows):
            columns = self._starlight(light, rows)[1]
            logs_formed = [
                np.log(columns[:, [j]] + _NEGLIGIBLE_FORMED * s) for j, s in FORMED_COLUMNS.items()
            ]
            # in place of fluxes
            return np.concatenate(logs_formed, axis=1)[:, None]

        part = PartAxes(axes, formed, self._refuses, 2 * MAX_MODELS, _COLUMN_TOLERANCE, powers)
        axes, powers = part.refined(light)
        starlight = self._starlight(light, combinations(axes))
        _, columns = self._starlight_tables(*starlight, light.redshift)
        return make_part(tuple(axes), axes, powers, columns[:, None], [0.0], self.place)

    def _burst(self, light, axes, powers):
        """Make tables of the burst alone, from two of its mass fractions."""
        top = self.model.parameters[self.mixing].bounds[1]
        effective = self._axes_of_burst(axes, top)
        fixed = {name: float(values[-1]) for name, values in axes.items() if name not in effective}
        rows = [fixed | row for row in combinations(effective)]

        # light mixes linearly: with_share = (1 - top) without_burst + top burst
        def burst_alone(with_share, without_burst):
            return np.maximum((with_share - (1.0 - top) * without_burst) / top, 0.0)

        with_burst = self._starlight(light, rows, top)
        without = self._starlight(light, rows)
        flux, columns, ratio = map(burst_alone, with_burst, without)
        logs, columns = self._starlight_tables(flux, columns, ratio, light.redshift)
        names = tuple(effective)
        burst = make_part(names, effective, powers, logs, light.redshift, self.place)
        return burst, with_columns(burst, columns)

    def _axes_of_burst(self, axes, top):
        """Find the axes that have an effect on a burst alone."""
        rng = np.random.default_rng(2)
        light = self.light_at(self.redshift[:1])
        effective = {}
        for name, values in axes.items():
            row = {parameter: float(rng.choice(nodes)) for parameter, nodes in axes.items()}
            rows = [row | {name: float(value)} for value in values]
            flux = self._starlight(light, rows, top)[0]
            flux = flux - (1.0 - top) * self._starlight(light, rows)[0]
            change = np.abs(flux - flux[-1:]).max()
            if change > _NO_EFFECT * np.abs(flux).max():
                effective[name] = values
        return effective


def _nearly_equal(values, expected):
    """Tell whether arrays agree, to a part of the largest value along the last axis."""
    if values.shape != expected.shape:
        return False
    return bool(np.all(np.abs(values - expected) <= 1e-6 * expected.max(axis=-1, keepdims=True)))


def _number(value):
    return float(getattr(value, "value", value))
