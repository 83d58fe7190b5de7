"""Lines and continuum of the gas that young stars ionize."""

import functools

import numpy as np

from miricigale.refdata.tables import read_images
from miricigale.sed import _core
from miricigale.sed.component import Component, register
from miricigale.sed.parameter import Parameter
from miricigale.utils.caching import cached
from miricigale.utils.exceptions import file_errors
from miricigale.utils.files import cached_by_file, open_fits
from miricigale.utils.units import frozen_array
from miricigale.utils.values import value_class

_KM_S = 1e-9 * _core.LIGHT  # speed of light
_WIDTH = Parameter(300.0, (1.0, 3000.0), "Full width of the lines at half maximum.", unit="km / s")
_WIDTH.name = "line_width"


@value_class
class NebularTable:
    """
    Emission of HII regions for each ionizing photon per second.

    Attributes
    ----------
    metallicity, log_u : `~numpy.ndarray`, shape (n_model,)
        Of the gas; log U is that at its inner edge.
    age : `~numpy.ndarray`, shape (n_age,)
        Ages in Myr of the stars that ionize.
    wave : `~numpy.ndarray`, shape (n_wave,)
        Wavelengths of the continuum in um.
    continuum : `~numpy.ndarray`, shape (n_model, n_age, n_wave)
        W/um.
    names : tuple of str
        Names of the lines.
    line_wave : `~numpy.ndarray`, shape (n_line,)
        Their wavelengths in vacuum in um.
    lines : `~numpy.ndarray`, shape (n_model, n_age, n_line)
        W.
    """

    metallicity: np.ndarray
    log_u: np.ndarray
    age: np.ndarray
    wave: np.ndarray
    continuum: np.ndarray
    names: tuple
    line_wave: np.ndarray
    lines: np.ndarray

    def models(self, metallicity):
        """Return the numbers of the models of a metallicity, ascending in log U; empty if it is not there."""
        return np.flatnonzero(np.abs(self.metallicity / metallicity - 1.0) <= 1e-3)

    @cached(maxsize=64)
    def emission(self, metallicity, log_u):
        """
        Return the continuum and lines one after the other, shape (n_age, n_wave + n_line), linear in log U
        between logarithms, of values that `Nebular.invalid` accepts.
        """
        models = self.models(metallicity)
        cell, t = _core.cells(self.log_u[models], log_u)
        low, high = (
            np.concatenate([self.continuum[m], self.lines[m]], axis=1)
            for m in models[cell : cell + 2]
        )
        # powers, not exp(log): exact at the nodes, and 0 where both are
        out = low ** (1.0 - t) * high**t
        out.flags.writeable = False
        return out


@cached_by_file(maxsize=2)
def load_nebular(path):
    """Read a `NebularTable` that ``tools/make_nebular.py`` made; other files are refused."""
    wanted = "a table of nebular emission"
    names = ("metallicity", "log_u", "age", "wave", "continuum", "lines")
    images = [name.replace("_", "") for name in names]
    arrays = dict(zip(names, read_images(path, images, wanted=wanted).values(), strict=True))
    with file_errors(path, f"is not {wanted}"), open_fits(path, wanted=wanted) as hdus:
        rows = hdus["LINE_LIST"].data
        names = tuple(str(name).strip() for name in rows["NAME"])
        arrays["line_wave"] = frozen_array(rows["WAVE"])
    return NebularTable(names=names, **arrays)


@register
class Nebular(Component):
    """
    HII regions computed with Cloudy, for each ionizing photon.

    Every population lights its gas in proportion to its hydrogen-ionizing photons, with the
    spectrum that its age gives; lines are Gaussians. Grains are not in the gas: its light
    meets dust in the chain, as starlight does.

    Parameters
    ----------
    line_width : float or `~astropy.units.Quantity`, optional
        Full width of the lines at half maximum, in km/s. It decides where the nodes are, so
        it is fixed when the component is made.
    gas : {"stellar", "free"}, optional
        Whether the gas has the metallicity of the stars or its own, ``metallicity_gas``.
    **defaults
        New defaults of parameters.

    Raises
    ------
    ValueError
        If a value is outside its bounds or not one of the option's.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.sed.components import Nebular
    >>> gas = Nebular(log_u=-2.5)
    >>> values = {name: par.default for name, par in gas.parameters.items()} | {"metallicity": 0.02}
    >>> one = np.ones(1)  # a population of 3 Myr with 1e53 ionizing photons per second
    >>> lines = gas.lines(3.0 * one, one, 1e53 * one, values)
    >>> print(f"H-alpha over H-beta {lines['H-alpha'] / lines['H-beta']:.2f}")
    H-alpha over H-beta 2.82
    """

    name = "nebular"
    role = "nebular"
    reference = (
        "Ferland et al. 2017, RMxAA 53, 385 (Cloudy); Inoue 2011, MNRAS 415, 2920 (escape and dust)"
    )
    resource = "nebular.cloudy"
    options = {"gas": ("stellar", "free")}
    others = ("metallicity",)
    log_u = Parameter(
        -2.0,
        (-4.0, 0.0),
        "Ionization parameter U at the inner edge of the gas, in log; to -3 at Z = 0.05.",
    )
    metallicity_gas = Parameter(
        0.02,
        (0.0001, 0.05),
        "Metallicity of the gas if gas='free': 0.0001, 0.0004, 0.004, 0.008, 0.02 or 0.05.",
        label=True,
    )
    f_esc = Parameter(0.0, (0.0, 1.0), "Share of ionizing photons that leave the galaxy.")
    f_dust = Parameter(0.0, (0.0, 1.0), "Share of ionizing photons that dust absorbs.")

    def __init__(self, *, line_width=_WIDTH.default, **defaults):
        super().__init__(**defaults)
        self.line_width = _WIDTH.check(line_width)

    @property
    def settings(self):
        return super().settings | {"line_width": self.line_width}

    @property
    def table(self):
        """The `NebularTable`."""
        return load_nebular(self.path)

    @functools.cached_property
    def _drawn(self):
        table = self.table
        nodes, operator = _core.line_operator(table.wave, table.line_wave, self.line_width / _KM_S)
        nodes.flags.writeable = False
        return nodes, operator

    def nodes(self):
        return self._drawn[0]

    def _metallicity(self, values):
        return values["metallicity" if self.gas == "stellar" else "metallicity_gas"]

    def invalid(self, values):
        f_esc = values["f_esc"]
        f_dust = values["f_dust"]
        if f_esc + f_dust > 1.0 + 1e-12:
            return f"'f_esc' and 'f_dust' must not exceed 1 together, got {f_esc:g} and {f_dust:g}"
        table = self.table
        wanted = self._metallicity(values)
        models = table.models(wanted)
        if not models.size:
            available = ", ".join(f"{z:g}" for z in np.unique(table.metallicity))
            if self.gas == "free":
                return f"'metallicity_gas' must be one of {available}, got {wanted:g}"
            return (
                f"'metallicity' must be one of {available} for the gas to have it, got {wanted:g};"
                " give the gas its own with gas='free'"
            )
        low, high = table.log_u[models[[0, -1]]]
        if not low <= values["log_u"] <= high:
            return (
                f"'log_u' must be from {low:g} to {high:g} where the gas has metallicity"
                f" {wanted:g}, got {values['log_u']:g}"
            )
        return None

    def by_photon(self, values):
        """
        Return the light for each ionizing photon per second of stars of the ages of `table`.

        Parameters
        ----------
        values : dict
            Values of all parameters, the metallicity of the stars among them.

        Returns
        -------
        spectra : `~numpy.ndarray`, shape (n_age, n_node)
            L_lambda in W/um at `nodes`.
        """
        share = _core.absorbed_share(values["f_esc"], values["f_dust"])
        emission = self.table.emission(self._metallicity(values), values["log_u"])
        return share * (self._drawn[1] @ emission.T).T

    def _emission(self, age, weights, ionizing, values):
        """Return the continuum in W/um and lines in W, one after the other."""
        table = self.table
        share = _core.absorbed_share(values["f_esc"], values["f_dust"])
        photons = _core.photons_by_age(age, share * weights * ionizing, table.age)
        return photons @ table.emission(self._metallicity(values), values["log_u"])

    def spectra(self, age, weights, ionizing, values):
        """
        Return the light of the gas around some stars.

        Parameters
        ----------
        age : `~numpy.ndarray`, shape (n_age,)
            Ages of the stellar table in Myr.
        weights : `~numpy.ndarray`, shape (n_age,)
            Solar masses formed of each.
        ionizing : `~numpy.ndarray`, shape (n_age,)
            Hydrogen-ionizing photons per second for each solar mass formed.
        values : dict
            Values of all parameters, those of the stars among them.

        Returns
        -------
        spectrum : `~numpy.ndarray`, shape (n_node,)
            L_lambda in W/um at `nodes`.
        """
        return self._drawn[1] @ self._emission(age, weights, ionizing, values)

    def parts(self, age, weights, ionizing, values):
        """
        Return the continuum and lines of `spectra`, which are their sum: two arrays of its shape.

        Parameters are those of `spectra`.
        """
        emission = self._emission(age, weights, ionizing, values)
        n = self.table.wave.size
        continuum, lines = np.zeros((2, emission.size))
        continuum[:n] = emission[:n]
        lines[n:] = emission[n:]
        return self._drawn[1] @ continuum, self._drawn[1] @ lines

    def lines(self, age, weights, ionizing, values):
        """
        Return the luminosities of the lines before any dust: dict of W by name.

        Parameters are those of `spectra`.
        """
        emission = self._emission(age, weights, ionizing, values)[self.table.wave.size :]
        return dict(zip(self.table.names, emission.tolist(), strict=True))
