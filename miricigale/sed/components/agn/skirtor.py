"""The SKIRTOR library of clumpy tori."""

import functools
import os

import numpy as np

from miricigale.refdata.libraries.skirtor import SKIRTOR_AXES
from miricigale.refdata.libraries.table import open_library
from miricigale.sed import _core
from miricigale.sed.component import register
from miricigale.sed.components.agn.base import AGN, TorusSpectra
from miricigale.sed.parameter import Parameter

__all__ = ["Skirtor2016"]


@register
class Skirtor2016(AGN):
    """
    Clumpy two-phase tori, SKIRTOR, as the user registered them (``torus.skirtor2016``).

    The dust spectrum is the library's, straight between its 132 wavelengths, zero outside.
    Disk light at the inclination is the chosen disk times direct plus scattered light over
    that at inclination 0, both the library's: the disk changes and what the torus does to it
    stays (as in CIGALE 2020). The chosen disk has the power that the library's has at
    inclination 0, from which ``accretion_power`` follows.

    Parameters of the torus take the library's values only; `missing` names those without.
    """

    name = "skirtor2016"
    reference = "Stalevski et al. 2012, MNRAS 420, 2756; 2016, MNRAS 458, 2288"
    resource = "torus.skirtor2016"
    tau97 = Parameter(
        default=7.0, bounds=(3.0, 11.0),
        doc="Optical depth at 9.7 um along the equator: 3, 5, 7, 9 or 11.",
    )  # fmt: skip
    p = Parameter(
        default=1.0, bounds=(0.0, 1.5), doc="Slope of density with radius: 0, 0.5, 1 or 1.5."
    )
    q = Parameter(
        default=1.0, bounds=(0.0, 1.5), doc="Slope of density with angle: 0, 0.5, 1 or 1.5."
    )
    radius_ratio = Parameter(
        default=20.0, bounds=(10.0, 30.0),
        doc="Outer over inner radius of the torus: 10, 20 or 30.",
    )  # fmt: skip

    @property
    def table(self):
        """The library: `~miricigale.refdata.libraries.LibraryTable`, read from disk as needed."""
        return open_library(self.path, self.resource)

    def missing(self, **values):
        """
        Axes on which the library has not these values.

        Parameters
        ----------
        **values : float or sequence of float
            Values of axes of the library, in the parameters' units; other names are ignored.

        Returns
        -------
        missing : dict of str to tuple of float
            Name of the axis to the values that the library has; empty if it has them all.
        """
        return _missing(self.table, values)

    def covers(self, **values):
        """Whether the library has these values of its axes, as for `missing`: bool."""
        return not self.missing(**values)

    def invalid(self, values):
        path = self.path
        axes = tuple([float(values[name]) for name in SKIRTOR_AXES])
        return _refusal(path, os.stat(path).st_mtime_ns, axes)

    def nodes(self):
        return _core.merge_nodes([self.table.wave, _core.disk_nodes(self.disk, number=161)])

    def torus_spectra(self, wave, values):
        axes = tuple([float(values[name]) for name in SKIRTOR_AXES])
        disk = (self.disk, float(values["disk_slope"]))
        path = self.path
        return _torus(path, os.stat(path).st_mtime_ns, wave.tobytes(), disk, axes)


@functools.lru_cache(maxsize=8)
def _values(table):
    return {name: tuple(table.values_of(name).tolist()) for name in table.axes}


def _missing(table, values):
    return {
        name: there
        for name, there in _values(table).items()
        if name in values
        and not all(np.isclose(v, there, 1e-6, 0.0).any() for v in np.atleast_1d(values[name]))
    }


# a library that is registered anew has another time of modification


@functools.lru_cache(maxsize=4096)
def _refusal(path, modified, axes):
    del modified
    values = dict(zip(SKIRTOR_AXES, axes, strict=True))
    parts = [
        f"'{name}' must be one of {', '.join(f'{v:g}' for v in there)}, got {values[name]:g}"
        for name, there in _missing(open_library(path, Skirtor2016.resource), values).items()
    ]
    return f"{'; '.join(parts)} (the library at {path} has no more)" if parts else None


@functools.lru_cache(maxsize=512)
def _torus(path, modified, wave_bytes, disk, axes):
    refusal = _refusal(path, modified, axes)
    if refusal is not None:
        raise ValueError(refusal)
    table = open_library(path, Skirtor2016.resource)
    values = dict(zip(SKIRTOR_AXES, axes, strict=True))
    row, above = table.row(**values), table.row(**values | {"inclination": 0.0})
    wave, (form, slope) = np.frombuffer(wave_bytes), disk
    seen, top, dust = (
        table.spectrum(name, k) for name, k in (("disk", row), ("disk", above), ("dust", row))
    )
    scale = 1.0 / np.trapezoid(dust, table.wave)
    through = np.divide(seen, top, out=np.zeros_like(top), where=top > 0.0)
    face_on = _core.disk_spectrum(wave, slope, form)
    face_on *= scale * np.trapezoid(top, table.wave) / np.trapezoid(face_on, wave)
    parts = (
        face_on,
        face_on * np.interp(wave, table.wave, through),
        np.interp(wave, table.wave, dust * scale, left=0.0, right=0.0),
    )
    for array in parts:
        array.flags.writeable = False
    return TorusSpectra(*parts)
