"""Factorised flux tables of a grid of models: what the grid fitter eats."""

import json
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.io import fits
from astropy.table import QTable

from miricigale.utils.exceptions import DataError, argument_error
from miricigale.utils.files import open_fits, writing
from miricigale.utils.units import frozen_array

__all__ = ["ModelGrid"]

_FORMAT = "miricigale-modelgrid-2"
_TABLES = (
    "galaxy_parameters",
    "agn_parameters",
    "galaxy_properties",
    "galaxy_shape",
    "agn_properties",
)
_ARRAYS = {
    "redshift": ("", float),
    "galaxy": ("uJy / solMass", float),
    "agn": ("uJy / W", float),
    "dust_luminosity": ("W / solMass", float),
    "frac_agn": ("", float),
    "allowed": ("", bool),
    "agn_multiplicity": ("", np.int64),
}


@dataclass(frozen=True, eq=False, repr=False)
class ModelGrid:
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
    agn : `~numpy.ndarray`, shape (nz, nA, nb)
        Fluxes of the AGN in uJy for each watt of AGN power. nA may be 0.
    dust_luminosity : `~numpy.ndarray`, shape (nG,)
        Luminosity that the AGN fraction refers to, in W for each solar mass formed: the
        dust luminosity of the galaxy in the definition ``"dust"``, its 3-1000 um light in
        the definition ``"3-1000um"`` (``meta["frac_agn_definition"]``); AGN power is the
        same quantity of the AGN.
    frac_agn : `~numpy.ndarray`, shape (nf,)
        AGN fractions in [0, 1), ascending.
    allowed : `~numpy.ndarray` of bool, shape (nz, nG)
        Whether the galaxy is younger than the universe at that redshift.
    galaxy_parameters, agn_parameters : `~astropy.table.QTable`, nG and nA rows
        Parameter values of every galaxy and AGN model.
    galaxy_properties : `~astropy.table.QTable`, nG rows
        Derived quantities for each solar mass formed (``stellar_mass``, ``sfr``,
        ``sfr_10myr``, ``sfr_100myr``, ``dust_luminosity``, ...).
    agn_properties : `~astropy.table.QTable`, nA rows
        Derived quantities for each watt of AGN power (``accretion_power``, ``l_6um``,
        ...).
    galaxy_shape : `~astropy.table.QTable`, nG rows, optional
        Derived quantities of the galaxy that do not scale with mass (``a_v``, ``beta``,
        ``age_light``, colours, ...).
    agn_multiplicity : `~numpy.ndarray` of int, shape (nA,)
        How many identical models of the grid each row stands for: without polar dust
        the temperatures of that dust make no difference, and are evaluated once.
    meta : dict, optional
        Provenance: libraries, citations, cosmology, definitions.

    Raises
    ------
    ValueError
        If shapes, order or ranges do not agree.
    """

    filters: tuple
    redshift: np.ndarray
    galaxy: np.ndarray
    agn: np.ndarray
    dust_luminosity: np.ndarray
    frac_agn: np.ndarray
    allowed: np.ndarray
    galaxy_parameters: QTable
    agn_parameters: QTable
    galaxy_properties: QTable
    agn_properties: QTable
    agn_multiplicity: np.ndarray
    meta: dict = field(default_factory=dict)
    galaxy_shape: QTable | None = None

    def __post_init__(self):
        object.__setattr__(self, "filters", tuple(str(name) for name in self.filters))
        object.__setattr__(self, "meta", dict(self.meta))
        if self.galaxy_shape is None:
            object.__setattr__(self, "galaxy_shape", QTable())
        for name, (_, dtype) in _ARRAYS.items():
            object.__setattr__(self, name, frozen_array(getattr(self, name), dtype))
        n_z, n_b = self.redshift.size, len(self.filters)
        n_g, n_a = self.dust_luminosity.size, self.agn_multiplicity.size
        shapes = {
            "redshift": (n_z,),
            "galaxy": (n_z, n_g, n_b),
            "agn": (n_z, n_a, n_b),
            "dust_luminosity": (n_g,),
            "frac_agn": (self.frac_agn.size,),
            "allowed": (n_z, n_g),
            "agn_multiplicity": (n_a,),
        }
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise argument_error(name, f"of shape {shape}", f"{getattr(self, name).shape}")
        for name in _TABLES:
            rows = n_g if name.startswith("galaxy") else n_a
            table = getattr(self, name)
            if len(table) != rows and not (name == "galaxy_shape" and not table.colnames):
                raise argument_error(name, f"a table of {rows} rows", f"{len(table)} rows")
        if len(set(self.filters)) != n_b or n_b == 0:
            raise argument_error("filters", "one or more different names", f"{self.filters}")
        if n_z == 0 or n_g == 0:
            raise argument_error("galaxy", "of at least one redshift and model", f"({n_z}, {n_g})")
        if np.any(np.diff(self.redshift) <= 0) or not np.all(self.redshift >= 0):
            raise argument_error("redshift", "ascending and >= 0", f"{self.redshift}")
        f = self.frac_agn
        if f.size == 0 or np.any(np.diff(f) <= 0) or not (f[0] >= 0 and f[-1] < 1):
            raise argument_error("frac_agn", "ascending values in [0, 1)", f"{f}")
        if n_a == 0 and not (f.size == 1 and f[0] == 0):
            raise argument_error("frac_agn", "[0] for a grid without AGN", f"{f}")
        if n_a and self.agn_multiplicity.min() < 1:
            raise argument_error("agn_multiplicity", ">= 1", f"{self.agn_multiplicity.min()}")
        for name in ("galaxy", "agn", "dust_luminosity"):
            if not np.all(np.isfinite(getattr(self, name))):
                raise argument_error(name, "finite", "NaN or infinite values")

    @property
    def n_galaxies(self):
        """Number of galaxy models nG."""
        return self.dust_luminosity.size

    @property
    def n_agn(self):
        """Number of AGN models nA (0: a grid without AGN)."""
        return self.agn_multiplicity.size

    @cached_property
    def n_models(self):
        """
        Number of models of the grid, identical ones counted as often as they occur.

        The product of all axes, as other codes count it; `n_allowed` leaves out galaxies
        older than the universe.
        """
        return int(self.redshift.size * self.n_galaxies * self._agn_count)

    @cached_property
    def n_allowed(self):
        """Number of models with galaxies younger than the universe."""
        return int(np.count_nonzero(self.allowed) * self._agn_count)

    @property
    def _agn_count(self):
        return self.frac_agn.size * int(self.agn_multiplicity.sum()) if self.n_agn else 1

    def flux(self, z, galaxy, agn=0, frac=0):
        """
        Fluxes of single models by index.

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

    def write(self, path, *, overwrite=False):
        """
        Write the grid to a FITS file.

        Parameters
        ----------
        path : path-like
            The file.
        overwrite : bool, optional
            Whether a file that is there is replaced.
        """
        header = fits.Header({"FORMAT": _FORMAT})
        hdus = [fits.PrimaryHDU(header=header)]
        described = {
            table: {
                c: getattr(self, table)[c].info.description for c in getattr(self, table).colnames
            }
            for table in _TABLES
        }
        text = {"filters": list(self.filters), "meta": self.meta, "descriptions": described}
        hdus.append(_text_hdu(json.dumps(text, default=str)))
        for name, (unit, dtype) in _ARRAYS.items():
            array = getattr(self, name)
            if array.size == 0:
                continue
            hdu = fits.ImageHDU(array.astype(np.uint8) if dtype is bool else array, name=name)
            if unit:
                hdu.header["BUNIT"] = unit
            hdus.append(hdu)
        for name in _TABLES:
            hdu = fits.table_to_hdu(_plain(getattr(self, name)))
            hdu.name = name
            hdus.append(hdu)
        with writing(path):
            fits.HDUList(hdus).writeto(Path(path), overwrite=overwrite, output_verify="exception")

    @classmethod
    def read(cls, path):
        """
        Read a grid that `write` made.

        Raises
        ------
        `~miricigale.utils.exceptions.DataError`
            If the file is missing, something else or truncated.
        """
        try:
            with open_fits(path, wanted="a model grid", memmap=False) as hdus:
                if hdus[0].header.get("FORMAT") != _FORMAT:
                    msg = f"{path} is not a model grid (no FORMAT = {_FORMAT!r} in its header)"
                    raise DataError(msg)
                text = json.loads(bytes(np.asarray(hdus["TEXT"].data)).decode())
                values = {name: hdus[name].data for name in _ARRAYS if name in hdus}
                tables = {
                    name: _restore(QTable.read(hdus[name]), text["descriptions"][name])
                    for name in _TABLES
                }
        except (KeyError, ValueError, TypeError) as err:
            msg = f"{path} is not a complete model grid: {err}"
            raise DataError(msg) from err
        missing = [n for n in _ARRAYS if n not in values and n not in ("agn", "agn_multiplicity")]
        if missing:
            msg = f"{path} is not a complete model grid: no {', '.join(missing)}"
            raise DataError(msg)
        for table in tables.values():
            table.meta.clear()
        n_z, n_b = len(values["redshift"]), len(text["filters"])
        values.setdefault("agn", np.zeros((n_z, 0, n_b)))
        values.setdefault("agn_multiplicity", np.zeros(0, int))
        try:
            return cls(tuple(text["filters"]), **values, **tables, meta=text["meta"])
        except ValueError as err:
            msg = f"{path} is not a sound model grid: {err}"
            raise DataError(msg) from err

    def __repr__(self):
        return (
            f"<ModelGrid {self.redshift.size} redshifts x {self.n_galaxies} galaxies x "
            f"{self.n_agn} AGN x {self.frac_agn.size} fractions, {len(self.filters)} bands, "
            f"{self.n_models:,} models>"
        )


def _text_hdu(text):
    data = np.frombuffer(text.encode(), dtype=np.uint8)
    return fits.ImageHDU(data, name="TEXT")


def _restore(table, descriptions):
    """Columns are quantities again, pure numbers too, and say what they are."""
    for name, description in descriptions.items():
        column = table[name]
        if not hasattr(column, "to_value"):
            table[name] = u.Quantity(np.asarray(column, dtype=float))
        table[name].info.description = description
    return table


def _plain(table):
    """Copy a table without meta, whose long lists FITS headers cannot hold."""
    out = QTable(table, copy=False)
    out.meta = {}
    return out
