"""Factorised flux tables of a grid of models, as the grid fitter takes them."""

import functools
import re
from dataclasses import KW_ONLY, field

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.utils.exceptions import argument_error
from miricigale.utils.file_formats import read_write, register
from miricigale.utils.named_values import attributes, subset
from miricigale.utils.options import check_shape, check_that
from miricigale.utils.store import open_parts, write_parts
from miricigale.utils.units import Frozen, frozen_array, is_ascending
from miricigale.utils.values import value_class

_SPAN = re.compile(r"(\d+(?:\.\d+)?)-(\d+(?:\.\d+)?)um")

#: Layouts of files; in the second the facts that decide stood in the meta.
_LAYOUT = "miricigale-modelgrid-3"
_TABLES = (
    "galaxy_parameters",
    "agn_parameters",
    "galaxy_properties",
    "galaxy_shape",
    "agn_properties",
)
#: Those that may have no columns.
_MAY_LACK = ("galaxy_properties", "galaxy_shape")
#: Unit, type and axes of the arrays: redshift z, galaxy g, AGN a, fraction f, band b.
_ARRAYS = {
    "redshift": (u.one, float, "z"),
    "galaxy": (u.uJy / u.Msun, float, "zgb"),
    "agn": (u.uJy / u.W, float, "zab"),
    "dust_luminosity": (u.W / u.Msun, float, "g"),
    "frac_agn": (u.one, float, "f"),
    "allowed": (u.one, bool, "zg"),
    "agn_multiplicity": (u.one, np.int64, "a"),
}
_FACTS = ("axes", "inert", "bounds", "frac_agn_definition", "recipe")


def fraction_span(definition):
    """
    Return the range of wavelengths in um of whose light an AGN fraction is a share; None for ``"dust"``.

    ``definition`` is ``"dust"`` or a range such as ``"3-1000um"`` or ``"5-20um"`` in 0.1-1000 um; anything else
    is a ValueError.
    """
    if definition == "dust":
        return None
    match = _SPAN.fullmatch(str(definition))
    if match:
        low, high = map(float, match.groups())
        if 0.1 <= low < high <= 1000.0:
            return (low, high)
    wanted = "one of 'dust' and ranges in 0.1-1000 um such as '3-1000um'"
    raise argument_error("frac_agn_definition", wanted, repr(definition))


@value_class
class ModelGrid(Frozen):
    """
    Band fluxes of a grid of galaxy and AGN models, kept as two factors.

    The model flux of redshift z, galaxy g, AGN k and AGN fraction f is ::

        flux = s * (galaxy[z, g] + c_f * dust_luminosity[g] * agn[z, k]),  c_f = f / (1 - f)

    with s the stellar mass formed in solar masses; the full table of products is never
    made.

    Parameters
    ----------
    filters : tuple of str
        Names of the nb bands.
    redshift : `~numpy.ndarray`, shape (nz,)
        Redshifts, ascending.
    galaxy : `~numpy.ndarray`, shape (nz, nG, nb)
        Fluxes of the galaxy (stars, nebulae, dust) in uJy for each solar mass formed.
    agn : `~numpy.ndarray`, shape (nz, nA, nb), optional
        Fluxes of the AGN in uJy for each watt of AGN power; by default there is no AGN: nA is 0.
    dust_luminosity : `~numpy.ndarray`, shape (nG,)
        Luminosity that the AGN fraction refers to, in W for each solar mass formed: the
        dust luminosity of the galaxy in the definition ``"dust"``, its 3-1000 um light in
        the definition ``"3-1000um"``, or that of another range; AGN power is the same quantity of the AGN.
    frac_agn : `~numpy.ndarray`, shape (nf,)
        AGN fractions in [0, 1), ascending.
    allowed : `~numpy.ndarray` of bool, shape (nz, nG)
        Whether the galaxy is younger than the universe at that redshift.
    galaxy_parameters, agn_parameters : `~astropy.table.QTable`, nG and nA rows
        Parameter values of every galaxy and AGN model.
    galaxy_properties : `~astropy.table.QTable`, nG rows, or without columns
        Derived quantities for each solar mass formed (``stellar_mass``, ``sfr``,
        ``sfr_10myr``, ``sfr_100myr``, ``dust_luminosity``, ...).
    agn_properties : `~astropy.table.QTable`, nA rows
        Derived quantities for each watt of AGN power (``accretion_power``, ``l_6um``,
        ...).
    galaxy_shape : `~astropy.table.QTable`, nG rows, optional
        Derived quantities of the galaxy that do not scale with mass (``a_v``, ``beta``,
        ``age_light``, colors, ...).
    agn_multiplicity : `~numpy.ndarray` of int, shape (nA,)
        How many identical models of the grid each row stands for: without polar dust
        the temperatures of that dust make no difference, and are evaluated once.
    meta : dict, optional
        Provenance, for people: libraries, citations, cosmology.
    axes : dict of str to `~numpy.ndarray`, optional
        Values of the axes that the grid was made with, in the units of the parameters.
    inert : tuple of tuple of str, length nA, optional
        Parameters that make no difference to each AGN model; its row in ``agn_parameters`` holds
        the mean of the values that were merged.
    bounds : dict of str to tuple of float, optional
        Smallest and largest value that the model allows for its parameters, in their units.
    frac_agn_definition : {"dust", "3-1000um"} or str, optional
        What the AGN fraction is a fraction of; see ``dust_luminosity`` and `fraction_span`.
    recipe : dict, optional
        `SEDModel.recipe` of the model that made the grid; empty if that is unknown.
    preset : str, optional
        `SEDModel.preset` of that model.

    Raises
    ------
    ValueError
        If shapes, order or ranges do not agree.

    Examples
    --------
    >>> from miricigale import SEDModel
    >>> model = SEDModel.yang2021(libraries="bundled")
    >>> axes = {"redshift": [0.5, 1.0], "age": [1.0, 3.0], "frac_agn": [0.0, 0.5]}
    >>> grid = model.grid(axes, ["miri.f770w", "miri.f1500w"], cache=False)
    >>> grid
    <ModelGrid 2 redshifts x 2 galaxies x 1 AGN x 2 fractions, 2 bands, 8 models>
    >>> (1e10 * grid.flux(z=1, galaxy=0, agn=0, frac=1)).round(2)  # uJy for 1e10 Msun formed
    array([ 21.95, 135.24])
    """

    filters: tuple
    _: KW_ONLY
    redshift: np.ndarray
    galaxy: np.ndarray
    dust_luminosity: np.ndarray
    allowed: np.ndarray
    galaxy_parameters: QTable
    agn: np.ndarray | None = None
    frac_agn: np.ndarray = (0.0,)
    agn_multiplicity: np.ndarray = ()
    agn_parameters: QTable = field(default_factory=QTable)
    agn_properties: QTable = field(default_factory=QTable)
    galaxy_properties: QTable = field(default_factory=QTable)
    galaxy_shape: QTable = field(default_factory=QTable)
    meta: dict = field(default_factory=dict)
    axes: dict = field(default_factory=dict)
    inert: tuple = ()
    bounds: dict = field(default_factory=dict)
    frac_agn_definition: str = "dust"
    recipe: dict = field(default_factory=dict)
    preset: str | None = None

    io_module = __name__

    def __post_init__(self):
        self._freeze()
        self._check_shapes()
        self._check_values()

    def _freeze(self):
        """Put read-only copies of what was given into the place of it."""
        new = {"filters": tuple(map(str, self.filters)), "meta": dict(self.meta)}
        new["recipe"] = dict(self.recipe)
        arrays = {}
        for name, values in self.axes.items():
            arrays[name] = frozen_array(values, float)
        new["axes"] = arrays
        limits = {}
        for name, (low, high) in self.bounds.items():
            limits[name] = (float(low), float(high))
        new["bounds"] = limits
        if self.agn is None:
            new["agn"] = np.zeros((len(self.redshift), 0, len(self.filters)))
        self.__dict__.update(new)
        for name, (_, dtype, _) in _ARRAYS.items():
            self.__dict__[name] = frozen_array(getattr(self, name), dtype)
        self.__dict__["inert"] = tuple(map(tuple, self.inert)) or ((),) * self.n_agn

    def _check_shapes(self):
        """Refuse arrays and tables that are not of one number of redshifts, models, fractions and bands."""
        n_z = self.redshift.size
        n_b = len(self.filters)
        n_g = self.n_galaxies
        n_a = self.n_agn
        wanted = f"names for each of {n_a} AGN models"
        check_that(len(self.inert) == n_a, "inert", wanted, len(self.inert))
        sizes = {"z": n_z, "g": n_g, "a": n_a, "f": self.frac_agn.size, "b": n_b}
        for name, (_, _, letters) in _ARRAYS.items():
            shape = tuple(sizes[letter] for letter in letters)
            check_shape(getattr(self, name), shape, name)
        for name in _TABLES:
            if name.startswith("galaxy"):
                rows = n_g
            else:
                rows = n_a
            table = getattr(self, name)
            if len(table) != rows and (table.colnames or name not in _MAY_LACK):
                raise argument_error(name, f"a table of {rows} rows", f"{len(table)} rows")
        if len(set(self.filters)) != n_b or n_b == 0:
            raise argument_error("filters", "one or more different names", f"{self.filters}")
        check_that(n_z and n_g, "galaxy", "of at least one redshift and model", f"({n_z}, {n_g})")

    def _check_values(self):
        """Refuse axes that do not ascend or leave their range, and numbers that are not finite."""
        fraction_span(self.frac_agn_definition)
        z = self.redshift
        f = self.frac_agn
        n_alike = self.agn_multiplicity
        check_that(is_ascending(z) and z[0] >= 0, "redshift", "ascending and >= 0", z)
        check_that(
            is_ascending(f) and f[0] >= 0 and f[-1] < 1, "frac_agn", "ascending values in [0, 1)", f
        )
        check_that(self.n_agn or f.tolist() == [0.0], "frac_agn", "[0] for a grid without AGN", f)
        check_that(np.all(n_alike >= 1), "agn_multiplicity", ">= 1", n_alike)
        for name in ("galaxy", "agn", "dust_luminosity"):
            check_that(
                np.all(np.isfinite(getattr(self, name))), name, "finite", "NaN or infinite values"
            )

    @property
    def n_galaxies(self):
        """Number of galaxy models nG."""
        return self.dust_luminosity.size

    @property
    def n_agn(self):
        """Number of AGN models nA (0: a grid without AGN)."""
        return self.agn_multiplicity.size

    @functools.cached_property
    def n_models(self):
        """
        Number of models of the grid, identical ones counted as often as they occur.

        The product of all axes, as other codes count it; `n_allowed` leaves out galaxies
        older than the universe.
        """
        return int(self.redshift.size * self.n_galaxies * self._agn_count)

    @functools.cached_property
    def n_allowed(self):
        """Number of models with galaxies younger than the universe."""
        return int(np.count_nonzero(self.allowed) * self._agn_count)

    @property
    def _agn_count(self):
        if self.n_agn:
            return self.frac_agn.size * int(self.agn_multiplicity.sum())
        return 1

    def flux(self, z, galaxy, agn=0, frac=0):
        """
        Return the fluxes of single models by index.

        Parameters
        ----------
        z, galaxy, agn, frac : int or array of int
            Indices of redshift, galaxy model, AGN model and AGN fraction; they broadcast.

        Returns
        -------
        flux : `~numpy.ndarray`, shape (..., nb)
            Fluxes in uJy for each solar mass formed.
        """
        out = self.galaxy[z, galaxy]
        if self.n_agn:
            f = self.frac_agn[frac]
            power = np.asarray(f / (1.0 - f) * self.dust_luminosity[galaxy])
            out = out + power[..., np.newaxis] * self.agn[z, agn]
        return out

    read, write = read_write("a grid")

    def __repr__(self):
        return (
            f"<ModelGrid {self.redshift.size} redshifts x {self.n_galaxies} galaxies x {self.n_agn} AGN x "
            f"{self.frac_agn.size} fractions, {len(self.filters)} bands, {self.n_models:,} models>"
        )


def _write(grid, path, *, overwrite=False):
    tables = attributes(grid, _TABLES)
    text = attributes(grid, ("filters", "meta", "preset") + _FACTS)
    text["descriptions"] = {
        name: {column: table[column].info.description for column in table.colnames}
        for name, table in tables.items()
    }
    arrays = {}
    for name, (unit, *_) in _ARRAYS.items():
        array = getattr(grid, name)
        if unit == u.one:
            arrays[name] = array
        else:
            arrays[name] = u.Quantity(array, unit, copy=False)
    write_parts(path, _LAYOUT, text=text, arrays=arrays, tables=tables, overwrite=overwrite)


def _read(path):
    with open_parts(path, (_LAYOUT,), wanted="model grid data") as parts:
        text = parts.text
        # FITS cannot hold arrays without elements, those of AGN
        arrays = {n: parts.array(n) for n in _ARRAYS if n in parts}
        tables = {name: parts.table(name, QTable) for name in _TABLES}
        for name, table in tables.items():
            for column, description in text["descriptions"][name].items():
                # pure numbers are quantities again, too
                table[column] = u.Quantity(table[column], dtype=float)
                table[column].info.description = description
        facts = subset(text, ("meta",) + _FACTS)
        # files of earlier versions do not say it
        facts["preset"] = text.get("preset")
        return ModelGrid(tuple(text["filters"]), **arrays, **tables, **facts)


register(ModelGrid, read=_read, write=_write)
