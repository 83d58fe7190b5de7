"""X-ray bands of a grid: corona of the AGN by alpha_ox, binaries and hot gas of the galaxy."""

import dataclasses
from typing import NamedTuple

import astropy.constants as const
import astropy.units as u
import numpy as np

from miricigale.filters import Filter
from miricigale.sed.cosmology import distance
from miricigale.sed.grid_spectra import row_values
from miricigale.sed.xray import check_band
from miricigale.utils.exceptions import argument_error
from miricigale.utils.options import check_that
from miricigale.utils.tables import described_table
from miricigale.utils.units import is_ascending, positive, to_array
from miricigale.utils.values import value_class

#: Slopes between 2500 A and 2 keV, the values of X-CIGALE.
ALPHA_OX = tuple(np.round(np.arange(-1.9, -1.05, 0.1), 1))
_PER_DEX = 0.3838  # alpha_ox over log(L_nu(2 keV) / L_nu(2500 A))
_TWO = 2.0  # keV
_ANGLE = 30.0  # deg, at which alpha_ox is defined
_BLUE = 0.25  # um
_LIGHT = const.c.to_value(u.m / u.s)
_PER_KEV = (u.keV / const.h).to_value(u.Hz)
_MICROJANSKY = 1e-32  # W / m2 / Hz
#: Exponential cutoff of binaries and, as low as its temperature, of hot gas, and the gas's photon index; keV.
_CUT_BINARIES = 100.0
_CUT_GAS = 1.0
_INDEX_GAS = 1.0
_HARD = (2.0, 10.0)
_SOFT = (0.5, 2.0)
#: Mineo et al. 2012: hot gas in 0.5-2 keV for each Msun/yr, W.
_GAS = 8.3e31
#: Fragos et al. 2013, as fitted by Mezcua et al. 2018: log L(2-10 keV) in W, of low-mass binaries for 1e10 Msun in
#: powers of the log of the age in Gyr, of high-mass binaries for 1 Msun/yr in powers of Z.
_LOW_MASS = (33.276, -1.503, -0.423, 0.425, 0.136)
_HIGH_MASS = (33.28, -62.12, 569.44, -1833.80, 1968.33)
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(64)
#: Energies in keV between which `Source.spectrum` is drawn, those of X-CIGALE.
SPAN = (0.25, 1200.0)


class Source(NamedTuple):
    """What shines as E^(1 - index) exp(-E / cutoff): powers in W between two energies in keV."""

    power: np.ndarray
    index: float
    cutoff: float
    band: tuple

    def spectrum(self, energy):
        """Return the L_E in W/keV."""
        shape = _shape(energy, self.index, self.cutoff)
        return self.power * shape / _energy(self.band, self.index, self.cutoff)

    def dimming(self, band, redshift, far):
        """Return the F_nu in uJy, the mean of an observed band (keV), over the power; distances in m."""
        low, high = band
        share = [
            _energy((low * (1 + z), high * (1 + z)), self.index, self.cutoff) for z in redshift
        ]
        share = np.array(share) / _energy(self.band, self.index, self.cutoff)
        return share / (4.0 * np.pi * far**2 * (high - low) * _PER_KEV * _MICROJANSKY)


@value_class
class XRays:
    """Options of `with_xray_bands`, and the sources that they make."""

    photon_index: float = 1.8
    cutoff: u.Quantity = 300 * u.keV
    angle_coefficients: tuple = (0.5, 0.0)
    lmxb: float = 0.0
    hmxb: float = 0.0
    lmxb_index: float = 1.56
    hmxb_index: float = 2.0

    def galaxy(self, rate, mass, age, metallicity):
        """Return the sources of galaxies by name, of SFR in Msun/yr, surviving mass in Msun, age in Gyr and Z."""
        low = 1e-10 * mass * 10.0 ** (np.polyval(_LOW_MASS[::-1], np.log10(age)) + self.lmxb)
        high = rate * 10.0 ** (np.polyval(_HIGH_MASS[::-1], metallicity) + self.hmxb)
        return {
            "lmxb": Source(low, self.lmxb_index, _CUT_BINARIES, _HARD),
            "hmxb": Source(high, self.hmxb_index, _CUT_BINARIES, _HARD),
            "hotgas": Source(_GAS * rate, _INDEX_GAS, _CUT_GAS, _SOFT),
        }

    def corona(self, disk, alpha_ox, inclination):
        """Return the corona of disks of L_nu in W/Hz at 2500 A and 30 deg, as seen at inclinations in deg."""
        cut = positive(self.cutoff, u.keV, "cutoff")
        a1, a2 = self.angle_coefficients
        mu = np.cos(np.radians([np.broadcast_to(_ANGLE, np.shape(inclination)), inclination]))
        at_30, at_angle = a1 * mu + a2 * mu**2 + 1.0 - a1 - a2
        # L_E at 2 keV, whose integral over the spectrum's shape is the power
        at_two = 10.0 ** (alpha_ox / _PER_DEX) * disk * at_angle / at_30 * _PER_KEV
        shape = _energy(_HARD, self.photon_index, cut) / _shape(_TWO, self.photon_index, cut)
        return Source(at_two * shape, self.photon_index, cut, _HARD)


def with_xray_bands(grid, model, bands, *, alpha_ox=ALPHA_OX, **options):
    r"""
    Add X-ray bands to a grid, so that a fit takes X-ray fluxes like all others.

    The corona shines as :math:`E^{1-\Gamma} e^{-E/E_c}` with :math:`L_\nu(2\,\mathrm{keV}) =
    10^{\alpha_\mathrm{ox} / 0.3838} L_\nu(2500\,\mathrm{A})`, the disk being that without dust, seen at 30 deg;
    ``alpha_ox`` becomes a parameter of the AGN. Low-mass binaries go with mass and age, high-mass binaries with
    star-formation rate and metallicity, hot gas with the star-formation rate. Nothing absorbs: fluxes must be
    corrected for absorption.

    Parameters
    ----------
    grid : `ModelGrid`
        The grid, of any bands.
    model : `SEDModel`
        The model that made it.
    bands : dict of str to `~astropy.units.Quantity`, shape (2,)
        Lowest and highest observed energy by the name of the band, whose flux is the energy flux over the width in
        frequency.
    alpha_ox : array_like, optional
        Ascending slopes.
    photon_index, lmxb_index, hmxb_index : float, optional
        Gamma of the corona (1.8) and of low-mass (1.56) and high-mass binaries (2).
    cutoff : `~astropy.units.Quantity`, optional
        Energy of the corona's cutoff, 300 keV; the binaries' is 100 keV.
    angle_coefficients : tuple of float, optional
        a1 and a2 (0.5 and 0) of the corona seen at an inclination i, a1 cos i + a2 cos^2 i + 1 - a1 - a2 of that
        at 0.
    lmxb, hmxb : float, optional
        Dex by which the binaries are brighter than usual.

    Returns
    -------
    grid : `ModelGrid`
        With the bands at the end, a row of AGN for each ``alpha_ox``, and the properties ``l_2500`` (disk at 2500
        A and 30 deg, W/Hz) and ``l_2_10kev`` (corona as seen, W) of the AGN, each for a watt of its power.

    Raises
    ------
    ValueError
        If a band is not two ascending positive energies, or its name is taken, ``alpha_ox`` does not ascend, the
        cutoff is not positive, or the grid has X-ray bands already or no galaxies of a model.
    `~astropy.units.UnitsError`
        If a unit is missing.

    References
    ----------
    Yang et al. 2020, MNRAS 491, 740; Yang et al. 2022, ApJ 927, 192 (X-CIGALE); Mezcua et al. 2018, MNRAS 478,
    2576; Mineo et al. 2012, MNRAS 426, 1870; Just et al. 2007, ApJ 665, 1004.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale import SEDModel
    >>> from miricigale.sed import with_xray_bands
    >>> model = SEDModel.yang2021(libraries="bundled")
    >>> axes = {"redshift": [1.0], "frac_agn": [0.0, 0.5]}
    >>> grid = model.grid(axes, ["miri.f770w"], cache=False)
    >>> with_xray_bands(grid, model, {"chandra_hard": [2, 7] * u.keV}).filters
    ('miri.f770w', 'chandra_hard')
    """
    energies = {name: check_band(band, f"bands[{name!r}]") for name, band in bands.items()}
    clashing = set(energies) & set(grid.filters)
    if clashing or not energies:
        raise argument_error("bands", f"new ones beside {list(grid.filters)}", f"{list(bands)}")
    if "age_mass" not in grid.galaxy_shape.colnames or "alpha_ox" in grid.agn_parameters.colnames:
        got = f"{grid.galaxy_shape.colnames} and {grid.agn_parameters.colnames}"
        raise argument_error("grid", "one of a model with ages, and without X-rays yet", got)
    slopes = to_array(alpha_ox, u.dimensionless_unscaled, "alpha_ox", ndim=1, finite=True)
    check_that(is_ascending(slopes), "alpha_ox", "ascending values", slopes)
    xrays = XRays(**options)
    z = grid.redshift
    far = distance(grid.redshift, model.cosmology)

    def observed(*sources):
        """Return the fluxes in uJy, (nz, n, n_bands)."""
        ends = energies.values()
        fluxes = [[s.dimming(two, z, far)[:, None] * s.power for s in sources] for two in ends]
        return np.moveaxis(np.sum(fluxes, axis=1), 0, -1)

    galaxies = xrays.galaxy(
        grid.galaxy_properties["sfr_100myr"].to_value(1 / u.yr),
        grid.galaxy_properties["stellar_mass"].to_value(u.one),
        grid.galaxy_shape["age_mass"].to_value(u.Gyr),
        u.Quantity(grid.galaxy_parameters["metallicity"]).value,
    )
    galaxy = np.concatenate([grid.galaxy, observed(*galaxies.values())], axis=2)
    new = {"galaxy": galaxy, "agn": None}
    if grid.n_agn:
        disk, inclination = _disks(grid, model)
        corona = xrays.corona(disk[:, None], slopes, inclination[:, None])
        corona = corona._replace(power=corona.power.ravel())
        agn = np.repeat(grid.agn, slopes.size, axis=1)
        new["agn"] = np.concatenate([agn, observed(corona)], axis=2)
        new |= _agn_rows(grid, slopes, disk, corona.power)
    return dataclasses.replace(grid, filters=(*grid.filters, *energies), **new)


def _agn_rows(grid, slopes, disk, hard):
    """Return what a grid says of its AGN, each of them repeated for every slope."""
    rows = np.repeat(np.arange(grid.n_agn), slopes.size)
    parameters = grid.agn_parameters[rows]
    properties = grid.agn_properties[rows]
    of_disk = "L_nu of the disk at 2500 A, without dust at 30 deg, W/Hz for each W of AGN power"
    of_corona = "2-10 keV luminosity of the AGN, unabsorbed, W for each W of AGN power"
    slope = np.tile(slopes, grid.n_agn) * u.one, "slope from 2500 A to 2 keV"
    parameters.update(described_table({"alpha_ox": slope}))
    light = {"l_2500": (disk[rows] / u.Hz, of_disk), "l_2_10kev": (hard * u.one, of_corona)}
    properties.update(described_table(light))
    return {
        "agn_parameters": parameters,
        "agn_properties": properties,
        "agn_multiplicity": grid.agn_multiplicity[rows],
        "inert": tuple(grid.inert[row] for row in rows),
        "axes": grid.axes | {"alpha_ox": slopes},
    }


def _disks(grid, model):
    """Return the L_nu at 2500 A and 30 deg, W/Hz for each W of AGN power, and inclinations in deg."""
    rows = [row_values(model, grid.agn_parameters, k) for k in range(grid.n_agn)]
    agn = model.component("agn")
    light = np.array([disk_2500(model.chain, agn, row) for row in rows])
    inclination = np.array([row["inclination"] for row in rows])
    return light * grid.agn_properties["accretion_power"].value, inclination


def disk_2500(chain, agn, values):
    """L_nu of a disk at 2500 A seen at 30 deg, without dust, in W/Hz for each watt of accretion power."""
    face_on = agn.torus_spectra(chain.wave, values | {"inclination": 0.0}).face_on
    mu = np.cos(np.radians(_ANGLE))
    # the disk shines as cos i (1 + 2 cos i) / 3; accretion power is 7/18 of the face-on integral
    light = np.interp(_BLUE, chain.wave, face_on) / (7.0 / 18.0 * (chain.weights @ face_on))
    return light * mu * (1.0 + 2.0 * mu) / 3.0 * _BLUE**2 * 1e-6 / _LIGHT


def xray_filter(name, band):
    """Return a `~miricigale.filters.Filter` of an X-ray band, for drawings: flat between two energies."""
    low, high = check_band(band, "band")
    wave = (const.h * const.c / ([high, low] * u.keV)).to(u.um)
    return Filter(wave, np.ones(2), name=name)


def _shape(energy, index, cut):
    return energy ** (1.0 - index) * np.exp(-energy / cut)


def _energy(band, index, cut):
    """Return the integral of E^(1 - Gamma) exp(-E / cut) over the energies of a band."""
    low, high = band
    middle = 0.5 * np.log(high * low)
    half = 0.5 * np.log(high / low)
    energy = np.exp(middle + half * _NODES)
    return half * np.sum(_WEIGHTS * energy * _shape(energy, index, cut))
