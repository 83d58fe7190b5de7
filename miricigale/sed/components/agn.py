"""Active nuclei: accretion disk, dusty torus and polar dust."""

import numpy as np

from miricigale.refdata.libraries.skirtor import SKIRTOR_AXES
from miricigale.refdata.libraries.table import open_library
from miricigale.sed import _core
from miricigale.sed.component import Component, register
from miricigale.sed.parameter import Parameter
from miricigale.utils.caching import cached
from miricigale.utils.exceptions import argument_error
from miricigale.utils.files import cached_by_file
from miricigale.utils.units import frozen_array
from miricigale.utils.values import value_class

#: Law ``smc`` with the extinction of grains in its place below 0.1 um.
_GRAINS = "smc_wd01"
_GRAINS_BELOW = 0.1  # um

# beyond 25 um the library has a wavelength for each 0.06 dex, too few for straight lines
_SPARSE = 25.0
_FINE_STEP = 0.025  # in ln(lambda)


@value_class
class TorusSpectra:
    """
    What a torus library says for one set of parameters, in W/um on a common scale.

    Parameters
    ----------
    face_on : `~numpy.ndarray`
        The disk without obscuration, seen from above.
    disk : `~numpy.ndarray`
        Disk light seen at the inclination, direct and scattered.
    dust : `~numpy.ndarray`
        Dust emission seen at the inclination.

    Examples
    --------
    >>> from miricigale.sed.components import ParametricTorus
    >>> torus = ParametricTorus(inclination=30.0)
    >>> values = {name: par.default for name, par in torus.parameters.items()}
    >>> spectra = torus.torus_spectra(torus.nodes(), values)
    >>> round(float(spectra.disk.max() / spectra.face_on.max()), 2)  # seen at 30 deg
    0.8
    """

    face_on: np.ndarray
    disk: np.ndarray
    dust: np.ndarray


@value_class
class AGNTemplates:
    """
    Spectra for one watt of AGN dust emission (torus + polar), in W/um.

    Parameters
    ----------
    disk, torus, polar : `~numpy.ndarray`
        The parts as seen; torus + polar integrate to 1 W.
    accretion_power : float
        Luminosity of the disk over all directions, in W for each W of dust emission.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.sed.components import ParametricTorus
    >>> torus = ParametricTorus()
    >>> values = {name: par.default for name, par in torus.parameters.items()}
    >>> parts = torus.templates(torus.nodes(), values)
    >>> round(float(np.trapezoid(parts.torus + parts.polar, torus.nodes())), 4)  # W
    1.0
    """

    disk: np.ndarray
    torus: np.ndarray
    polar: np.ndarray
    accretion_power: float

    @property
    def total(self):
        """Sum of the parts."""
        return self.disk + self.torus + self.polar


class AGN(Component):
    """
    Base of nuclei with a torus and polar dust; a subclass gives `torus_spectra`.

    Polar dust (option ``polar_law``: ``smc``, ``calzetti``, ``gaskell`` or ``smc_wd01``) dims the disk where
    the line of sight misses the torus (i <= 90 deg - opening angle). What it takes from the disk
    over its cone, (7/18 - sin^2 oa / 6 - 2 sin^3 oa / 9) int disk (1 - 10^(-0.4 k E)), it sends
    out evenly as a modified blackbody, (1 - exp(-(200 um / lambda)^beta)) B_lambda(T); torus
    and polar emission together are then scaled to 1 W (Yang et al. 2020, MNRAS 491, 740).

    The disk (option ``disk``) is a power law between breaks; ``disk_slope`` changes its slope
    in the optical and keeps its power. The torus's emission does not follow such changes.

    Examples
    --------
    >>> from miricigale.sed.components import AGN
    >>> AGN.all_options()["polar_law"]
    ('smc', 'calzetti', 'gaskell', 'smc_wd01')
    >>> [name for name in AGN.declared() if name.endswith("polar")]
    ['ebv_polar', 'temperature_polar', 'emissivity_polar']
    """

    role = "agn"
    options = {"polar_law": (*_core.POLAR_LAWS, _GRAINS), "disk": tuple(_core.DISKS)}
    packages = ("dust_extinction",)
    frac_agn = Parameter(
        0.0, (0.0, 0.999999), "AGN fraction, in the model's definition.", absent_at_zero=True
    )
    inclination = Parameter(70.0, (0.0, 90.0), "Angle between axis and line of sight.", unit="deg")
    opening_angle = Parameter(
        40.0, (10.0, 80.0), "Angle between the equator and the edge of the torus.", unit="deg"
    )
    disk_slope = Parameter(
        0.0,
        (-1.0, 1.0),
        "Added to the disk's optical slope, L_lambda ~ lambda^(-1.5 + disk_slope).",
    )
    ebv_polar = Parameter(
        0.1, (0.0, 3.0), "Color excess of the polar dust.", unit="mag", absent_at_zero=True
    )
    temperature_polar = Parameter(100.0, (20.0, 1500.0), "Temperature of the polar dust.", unit="K")
    emissivity_polar = Parameter(1.6, (0.5, 3.0), "Emissivity index of the polar dust.")

    def torus_spectra(self, wave, values):
        """
        Disk and torus of the library.

        Parameters
        ----------
        wave : `~numpy.ndarray`
            Rest wavelengths in um.
        values : dict
            Values of all parameters of the component.

        Returns
        -------
        spectra : `TorusSpectra`
        """
        raise NotImplementedError

    def templates(self, wave, values):
        """
        Return the spectra for one watt of dust emission.

        Parameters
        ----------
        wave : `~numpy.ndarray`
            Rest wavelengths in um, ascending, from the disk's beginning to where dust is dark.
        values : dict
            Values of all parameters of the component.

        Returns
        -------
        templates : `AGNTemplates`

        Raises
        ------
        ValueError
            If the wavelengths hold no dust emission.
        """
        base = self.torus_spectra(wave, values)
        opening = values["opening_angle"]
        parts, power, total = _core.add_polar(
            _polar_grid(_core.wave_key(wave), self.polar_law), base.face_on, base.disk, base.dust,
            float(values["ebv_polar"]), float(values["temperature_polar"]),
            float(values["emissivity_polar"]), _core.polar_share(opening),
            values["inclination"] <= 90.0 - opening,
        )  # fmt: skip
        if not total > 0.0:
            span = f"{wave.size} points from {wave[0]:g} to {wave[-1]:g} um"
            raise argument_error("wave", "a grid that holds the dust emission", span)
        return AGNTemplates(parts[0], parts[1], parts[2], power)

    def inert(self, values):
        if values["ebv_polar"] == 0.0:
            return ("temperature_polar", "emissivity_polar")
        return ()


@cached(maxsize=16)
def _polar_grid(wave_bytes, law):
    wave = np.frombuffer(wave_bytes)
    if law != _GRAINS:
        return _core.polar_grid(wave, _core.polar_curve(wave, law))
    curve = _core.polar_curve(wave, "smc")
    short = wave < _GRAINS_BELOW
    grains = _smc_grains(np.append(wave[short], _GRAINS_BELOW))
    edge = _core.polar_curve(np.array([_GRAINS_BELOW]), "smc")[0]
    curve[short] = grains[:-1] * (edge / grains[-1])
    return _core.polar_grid(wave, curve)


def _smc_grains(wave):
    """Extinction of the SMC's grains in Weingartner & Draine 2001, any scale; constant below 0.01 um."""
    import astropy.units as u
    from dust_extinction.grain_models import WD01

    model = WD01("SMCBar")
    return np.asarray(model(np.minimum(1.0 / wave, model.x_range[1]) / u.um), dtype=float)


@register
class Skirtor2016(AGN):
    """
    Clumpy two-phase tori, SKIRTOR, as the user registered them (``torus.skirtor2016``).

    The dust spectrum is the library's, straight between its 132 wavelengths up to 25 um, a power law
    between them beyond (as in CIGALE), zero outside.
    Disk light at the inclination is the chosen disk times direct plus scattered light over
    that at inclination 0, both the library's: the disk changes and what the torus does to it
    stays (as in CIGALE 2020). The chosen disk has the power that the library's has at
    inclination 0, from which ``accretion_power`` follows.

    Parameters of the torus take the library's values only; `missing` names those without.

    Examples
    --------
    >>> from miricigale.sed.components import Skirtor2016
    >>> torus = Skirtor2016(disk="schartmann2005", disk_slope=-0.36)
    >>> torus.settings
    {'polar_law': 'smc', 'disk': 'schartmann2005'}
    >>> torus.missing(q=[0.0, 1.0])  # doctest: +SKIP
    {'q': (0.0,)}
    """

    name = "skirtor2016"
    version = 2
    reference = "Stalevski et al. 2012, MNRAS 420, 2756; 2016, MNRAS 458, 2288"
    resource = "torus.skirtor2016"
    tau97 = Parameter(
        7.0, (3.0, 11.0), "Optical depth at 9.7 um along the equator: 3, 5, 7, 9 or 11."
    )
    p = Parameter(1.0, (0.0, 1.5), "Slope of density with radius: 0, 0.5, 1 or 1.5.")
    q = Parameter(1.0, (0.0, 1.5), "Slope of density with angle: 0, 0.5, 1 or 1.5.")
    radius_ratio = Parameter(
        20.0, (10.0, 30.0), "Outer over inner radius of the torus: 10, 20 or 30."
    )

    @property
    def table(self):
        """The library: `~miricigale.refdata.libraries.LibraryTable`, read from disk as needed."""
        return open_library(self.path, self.resource)

    def missing(self, **values):
        """Return the axes on which the library has not these values: see `LibraryTable.missing`."""
        return self.table.missing(**values)

    def invalid(self, values):
        return _refusal(self.path, tuple([float(values[name]) for name in SKIRTOR_AXES]))

    def nodes(self):
        return _core.merge_nodes([_fine(self.table.wave), _core.disk_nodes(self.disk, number=161)])

    def torus_spectra(self, wave, values):
        axes = tuple([float(values[name]) for name in SKIRTOR_AXES])
        return _torus(self.path, _core.wave_key(wave), self.disk, float(values["disk_slope"]), axes)


def _fine(wave):
    """Return the wavelengths of the library and more of them where they are sparse."""
    sparse = wave[np.searchsorted(wave, _SPARSE * (1.0 - 1e-6)) :]
    if sparse.size < 2:
        return wave
    number = np.ceil(np.diff(np.log(sparse)) / _FINE_STEP).astype(int)
    steps = zip(sparse, sparse[1:], number, strict=False)
    return _core.merge_nodes([wave, *(np.geomspace(a, b, n + 1)[1:-1] for a, b, n in steps)])


def _refined(wave, dust, fine):
    """Return a spectrum at `_fine` wavelengths: power laws between those of the library."""
    tiny = np.finfo(float).tiny
    return np.where(
        fine < _SPARSE,
        np.interp(fine, wave, dust),
        np.exp(np.interp(np.log(fine), np.log(wave), np.log(np.maximum(dust, tiny)))),
    )


@cached_by_file(maxsize=4096)
def _refusal(path, axes):
    values = dict(zip(SKIRTOR_AXES, axes, strict=True))
    parts = []
    for name, available in open_library(path, Skirtor2016.resource).missing(**values).items():
        parts.append(
            f"'{name}' must be one of {', '.join(f'{v:g}' for v in available)}, got {values[name]:g}"
        )
    if parts:
        return f"{'; '.join(parts)} (the library at {path} has no more)"
    return None


@cached_by_file(maxsize=512)
def _torus(path, wave_bytes, disk, slope, axes):
    refusal = _refusal(path, axes)
    if refusal is not None:
        raise ValueError(refusal)
    table = open_library(path, Skirtor2016.resource)
    values = dict(zip(SKIRTOR_AXES, axes, strict=True))
    row = table.row(**values)
    above = table.row(**values | {"inclination": 0.0})
    wave = np.frombuffer(wave_bytes)
    places = (("disk", row), ("disk", above), ("dust", row))
    observed, top, dust = (table.spectrum(*place) for place in places)
    fine = _fine(table.wave)
    dust = _refined(table.wave, np.asarray(dust, dtype=float), fine)
    scale = 1.0 / np.trapezoid(dust, fine)
    through = np.divide(observed, top, out=np.zeros_like(top), where=top > 0.0)
    face_on = _core.disk_spectrum(wave, slope, disk)
    face_on *= scale * np.trapezoid(top, table.wave) / np.trapezoid(face_on, wave)
    observed = face_on * np.interp(wave, table.wave, through)
    dust = np.interp(wave, fine, dust * scale, left=0.0, right=0.0)
    return TorusSpectra(*map(frozen_array, (face_on, observed, dust)))
