"""Extinction by dust of the Milky Way: a component, how much it is in bands, tables freed from it."""

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.filters import FilterSet
from miricigale.filters.spectra import spectrum_arrays
from miricigale.sed.component import Component, register
from miricigale.sed.parameter import Parameter
from miricigale.utils.caching import cached
from miricigale.utils.exceptions import argument_error, units_error
from miricigale.utils.missing_values import floats, mask_of
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.package_tables import declared
from miricigale.utils.tables import error_column, require_columns
from miricigale.utils.units import FNU, own_unit

#: Laws of extinction with R_V, as `dust_extinction` names them, and whom to cite.
LAWS = declared("miricigale.sed", "extinction.toml")["laws"]

#: What is done with bands that reach beyond the long end of a law.
BEYOND = ("refuse", "transparent")

_MAG = -0.4 * np.log(10.0)
_STEPS = 8192  # in ln(lambda): straight lines between them are good to 1e-5 of the extinction
_R_V = (2.0, 6.0)  # the widest of the laws
_RESOLUTION = 600.0  # of the grid in a band: good to 2e-5 of the extinction
_ROWS = 1024  # rows worked out at once
_KEY = "galactic_extinction"


def _law(law):
    """Return the class of a law."""
    check_that(law in LAWS, "law", f"one of {', '.join(LAWS)}", repr(law))
    from dust_extinction import parameter_averages

    return getattr(parameter_averages, law)


def coverage(law):
    """Return the shortest and longest wavelength of a law in um."""
    low, high = _law(law).x_range
    return 1.0 / high, 1.0 / low


def _outside(law, r_v):
    """Say why a law has no such R_V, or None."""
    low, high = _law(law).Rv_range
    if low <= r_v <= high:
        return None
    return f"'r_v' must be from {low} to {high} for the law {law}, got {r_v}"


@cached(maxsize=64)
def _table(law, r_v):
    """Return the ln(first wavelength), steps per unit of ln, and A(lambda) / E(B-V) at the steps."""
    import astropy.units as u

    low, high = coverage(law)
    wave = np.geomspace(low, high, _STEPS)
    # the last digit of 1 / (1 / x) must not lie outside
    wave[0] = low
    wave[-1] = high
    k = r_v * np.asarray(_law(law)(Rv=r_v)(1.0 / wave / u.um), dtype=float)
    k.flags.writeable = False
    return np.log(low), (_STEPS - 1) / np.log(high / low), k


def extinction_curve(wave, law="G23", r_v=3.1):
    """
    Return the extinction for one magnitude of color excess, A(lambda) / E(B-V), at wavelengths in um.

    NaN outside the `coverage` of the law. Interpolated in a table of 8192 steps in ln(lambda).

    Raises
    ------
    ValueError
        If there is no such law, or none with such an R_V.
    """
    sentence = _outside(law, r_v)
    if sentence:
        raise ValueError(sentence)
    start, scale, k = _table(law, float(r_v))
    place = (np.log(wave) - start) * scale
    # rounding at the ends
    inside = (place > -1e-6) & (place < k.size - 1 + 1e-6)
    step = np.clip(place, 0.0, k.size - 1.0)
    node = np.minimum(step.astype(int), k.size - 2)
    part = step - node
    return np.where(inside, k[node] * (1.0 - part) + k[node + 1] * part, np.nan)


def check_bands(filters, law, beyond="refuse"):
    """Refuse bands over which a law is not defined; see `GalacticExtinction.check_bands`."""
    check_that(beyond in BEYOND, "beyond", f"one of {', '.join(BEYOND)}", repr(beyond))
    low, high = coverage(law)
    out = []
    for band in FilterSet(filters):
        first, last = band.wave.value[[0, -1]]
        top = high
        if beyond == "transparent":
            top = max(high, 1.01 * last)
        try:
            band.weights(np.array([low, top]))
        except ValueError:
            out.append(f"{band.name} ({first:.4g}-{last:.4g} um)")
    if out:
        msg = (
            f"the extinction law {law} is defined from {low:.4g} to {high:.4g} um and not over "
            f"the bands {', '.join(out)}"
        )
        if beyond == "refuse":
            msg += "; G23 reaches from 0.0912 to 32 um" if law != "G23" else ""
            msg += "; beyond='transparent' takes what is beyond the long end as free of extinction"
        raise ValueError(msg)


@register
class GalacticExtinction(Component):
    """
    Extinction by dust of the Milky Way.

    A(lambda) = ``ebv_galactic`` R_V [A(lambda) / A(V)], with A(lambda) / A(V) of one of the laws of
    the package dust_extinction (Gordon 2024, JOSS 9, 7023). Nothing is extrapolated: outside the
    `coverage` of the law the transmission is 1, and `check_bands` refuses bands that reach there.

    Parameters
    ----------
    law : {"G23", "F99", "F19", "F04", "M14", "O94", "CCM89"}
        The law. Only G23 (0.0912-32 um) covers the mid-infrared; the others end at 3.33 um.
    beyond : {"refuse", "transparent"}
        What `check_bands` says of bands beyond the long end of the law: refused, or taken as free
        of extinction. Bands beyond the short end are always refused.
    **defaults
        New defaults of parameters.

    Raises
    ------
    ValueError
        If the law is not defined for the default of ``r_v``.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.sed import GalacticExtinction
    >>> dust = GalacticExtinction()
    >>> light = dust.transmission(np.array([0.55, 7.7]), {"ebv_galactic": 0.1, "r_v": 3.1})
    >>> (-2.5 * np.log10(light)).round(3)  # magnitudes
    array([0.31 , 0.009])
    """

    name = "galactic_extinction"
    role = "foreground"
    reference = (
        "Gordon et al. 2023, ApJ 950, 86 (G23) or that of the law; Gordon 2024, JOSS 9, 7023"
    )
    packages = ("dust_extinction",)
    options = {"law": tuple(LAWS), "beyond": BEYOND}
    ebv_galactic = Parameter(0.0, (0.0, 5.0), "Color excess of the Milky Way's dust.", unit="mag")
    r_v = Parameter(3.1, _R_V, "A(V) / E(B-V) of the Milky Way's dust.")

    def __init__(self, **defaults):
        super().__init__(**defaults)
        sentence = _outside(self.law, self.r_v)
        if sentence:
            raise ValueError(sentence)

    def transmission(self, wave, values):
        """
        Return the transmission of what lies in front of all, whatever the redshift.

        Parameters
        ----------
        wave : `~numpy.ndarray`, shape (n,)
            Observed wavelengths in um.
        values : dict
            Values of the parameters.

        Returns
        -------
        transmission : `~numpy.ndarray`, shape (n,)
            From 0 to 1.
        """
        ebv = values["ebv_galactic"]
        if ebv == 0.0:
            return np.ones(np.shape(wave))
        k = extinction_curve(wave, self.law, values["r_v"])
        return np.exp(_MAG * ebv * np.where(np.isnan(k), 0.0, k))

    def check_bands(self, filters):
        """
        Check that the law is defined over bands.

        Parameters
        ----------
        filters : `~miricigale.filters.FilterSet` or iterable of str
            The bands.

        Raises
        ------
        ValueError
            If more than 1e-4 of a band lies outside; the message names law, range and bands.
        """
        check_bands(filters, self.law, self.beyond)

    def invalid(self, values):
        """Say that the law has no such R_V."""
        return _outside(self.law, values["r_v"])


def _color_excess(ebv):
    """Return the color excesses in mag as an array of one dimension, and whether it was one number."""
    flat = GalacticExtinction.ebv_galactic.replace(0.0, name="ebv").array(ebv)
    wrong = np.flatnonzero(~(np.isfinite(flat) & (flat >= 0)))
    if wrong.size:
        examples = ", ".join(map(str, wrong[:10])) + (", ..." if wrong.size > 10 else "")
        got = f"something else in {wrong.size} of {flat.size} rows: {examples}"
        raise argument_error("ebv", "finite and not negative", got)
    return flat, np.ndim(ebv) == 0


def _band_grid(band, low, high, sed):
    """Return the wavelengths in um where the law is defined, weights of the light there, their whole sum."""
    first, last = band.wave.value[[0, -1]]
    wave = np.geomspace(first, last, max(int(_RESOLUTION * np.log(last / first)), 2) + 1)
    wave[0] = first
    wave[-1] = last
    if sed is not None:
        wave = np.union1d(wave, sed[0][(sed[0] > first) & (sed[0] < last)])
    weights = band.weights(wave)
    if sed is not None:
        weights = weights * np.interp(wave, *sed)
    check_that(weights.sum() > 0, "sed", f"of positive flux in {band.name}", weights.sum())
    inside = (weights != 0) & (wave >= low) & (wave <= high)
    return wave[inside], weights[inside], weights.sum()


@takes_other_keywords
def color_excess(sky, dust_map, *, scale=1.0):
    """
    Return the color excess E(B-V) at positions, by a map.

    Parameters
    ----------
    sky : `~astropy.coordinates.SkyCoord`, shape (n,)
        The positions.
    dust_map : object
        With a method ``query(sky)`` that gives numbers of shape (n,), such as the maps of the package dustmaps
        (``SFDQuery()``, ``PlanckQuery()``), which the user installs and whose data it downloads.
    scale : float, optional
        From the map's numbers to E(B-V): 0.86 for that of Schlegel, Finkbeiner & Davis (1998), as Schlafly
        & Finkbeiner (2011) found.

    Returns
    -------
    ebv : `~astropy.units.Quantity`, shape (n,)
        In mag, for `deredden` and `band_extinction`.

    Raises
    ------
    ValueError
        If the map has no number, or a negative one, at a position; the message says how many.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropy.coordinates import SkyCoord
    >>> from miricigale.sed import color_excess
    >>> class Everywhere:
    ...     def query(self, sky):
    ...         return 0.01 + 0.0 * sky.ra.deg
    >>> color_excess(SkyCoord([53.1, 53.2], [-27.8, -27.9], unit="deg"), Everywhere(), scale=0.86)
    <Quantity [0.0086, 0.0086] mag>
    """
    wanted = "a map with a method query(sky)"
    check_that(hasattr(dust_map, "query"), "dust_map", wanted, type(dust_map).__name__)
    ebv = floats(dust_map.query(sky)) * scale
    check_that(ebv.shape == sky.shape, "dust_map", f"numbers of shape {sky.shape}", ebv.shape)
    # maps take what stands behind the mask of a position
    placed = ~np.any([mask_of(sky.ra), mask_of(sky.dec)], axis=0)
    bad = np.count_nonzero(~(placed & np.isfinite(ebv) & (ebv >= 0)))
    check_that(not bad, "sky", "positions with a color excess", f"{bad} of {ebv.size} without")
    return ebv * u.mag


@takes_other_keywords
def band_extinction(filters, ebv, *, law="G23", r_v=3.1, sed=None, beyond="refuse"):
    """
    Return the Galactic extinction in bands.

    Parameters
    ----------
    filters : `~miricigale.filters.FilterSet` or iterable of str
        The bands.
    ebv : float, array_like or `~astropy.units.Quantity`, shape () or (n,)
        Color excess E(B-V) of each source; a bare number is in mag. Those of the map of Schlegel,
        Finkbeiner & Davis (1998) are to be multiplied by 0.86 (Schlafly & Finkbeiner 2011).
    law : {"G23", "F99", "F19", "F04", "M14", "O94", "CCM89"}, optional
        The law.
    r_v : float, optional
        A(V) / E(B-V).
    sed : object, optional
        Observed spectrum of the source before extinction, as for
        `~miricigale.filters.Filter.synthetic_flux`; else F_nu is constant.
    beyond : {"refuse", "transparent"}, optional
        Whether bands that reach beyond the long end of the law are refused, or taken as free of
        extinction there.

    Returns
    -------
    extinction : `~astropy.table.QTable`, n rows
        ``ebv`` and a column in mag for each band, by its name: -2.5 log10 of the photon-weighted
        mean of F_nu 10^(-0.4 A) over that of F_nu. The meta say law and R_V.

    Raises
    ------
    ValueError
        If a color excess is missing or negative (the message names the rows), the law is not
        defined for the R_V or over a band, or the spectrum does not cover a band.
    `~astropy.units.UnitsError`
        If ``ebv`` is no magnitude.

    Examples
    --------
    >>> from miricigale.sed.foreground import band_extinction
    >>> table = band_extinction(["acs.f606w", "miri.f770w"], 0.01)
    >>> table["acs.f606w"].round(3), table["miri.f770w"].round(4)
    (<Quantity [0.029] mag>, <Quantity [0.0009] mag>)
    """
    bands = FilterSet(filters)
    values, _ = _color_excess(ebv)
    check_bands(bands, law, beyond)
    low, high = coverage(law)
    points = None
    if sed is not None:
        points = spectrum_arrays(sed, bands)
        # refuses what the spectrum does not cover
        bands.weights(points[0])
    # many sources lie in one cell of a map
    different, row = np.unique(values, return_inverse=True)
    out = QTable({"ebv": values * u.mag})
    for band in bands:
        wave, weights, norm = _band_grid(band, low, high, points)
        exponent = _MAG * extinction_curve(wave, law, r_v)
        lost = np.empty(different.size)
        for start in range(0, different.size, _ROWS):
            part = different[start : start + _ROWS, None]
            # the difference from 1 keeps small extinctions exact
            lost[start : start + _ROWS] = np.expm1(part * exponent) @ weights
        # + 0 makes no extinction 0 and not -0
        out[band.name] = (-2.5 / np.log(10.0) * np.log1p(lost / norm)[row] + 0.0) * u.mag
    out.meta[_KEY] = {"law": law, "r_v": float(r_v), "beyond": beyond, "reference": LAWS[law]}
    return out


@takes_other_keywords
def deredden(photometry, ebv, filters, *, law="G23", r_v=3.1, sed=None, beyond="refuse"):
    """
    Free a table of band fluxes from Galactic extinction.

    Parameters
    ----------
    photometry : `~astropy.table.Table`, n rows
        With a column of flux density for each band, in any linear unit; those of their errors,
        ``<band>_err``, where they are there. Missing fluxes are NaN or masked and stay so.
    ebv : float, array_like or `~astropy.units.Quantity`, shape () or (n,)
        Color excess; see `band_extinction`.
    filters : `~miricigale.filters.FilterSet` or iterable of str
        The bands to be corrected.
    law, r_v, sed, beyond
        As for `band_extinction`.

    Returns
    -------
    photometry : `~astropy.table.Table`
        A copy whose fluxes and errors are multiplied by 10^(0.4 A). The meta say law and R_V.

    Raises
    ------
    ValueError
        If a band or a color excess is missing (the message names the rows), if there are not as
        many as rows, or if the meta say that the table is corrected already.
    `~astropy.units.UnitsError`
        If a flux or an error is in magnitudes or in no unit.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropy.table import QTable
    >>> from miricigale.sed import deredden
    >>> table = QTable({"acs.f606w": [1.0, 2.0] * u.uJy})
    >>> deredden(table, [0.01, 0.1] * u.mag, ["acs.f606w"])["acs.f606w"].round(3)
    <Quantity [1.027, 2.612] uJy>
    """
    bands = FilterSet(filters)
    require_columns(photometry, bands.names, "photometry")
    got = f"one whose meta say {_KEY}: {photometry.meta.get(_KEY)}"
    check_that(_KEY not in photometry.meta, "photometry", "a table not corrected yet", got)
    values, scalar = _color_excess(ebv)
    got = f"{values.size} for {len(photometry)} rows"
    check_that(
        scalar or values.size == len(photometry), "ebv", "one number or one for each row", got
    )
    table = band_extinction(bands, values, law=law, r_v=r_v, sed=sed, beyond=beyond)
    out = photometry.copy()
    for name in bands.names:
        factor = 10.0 ** (0.4 * table[name].value)
        if scalar:
            factor = factor[0]
        for column in (name, error_column(name)):
            if column not in out.colnames:
                continue
            unit = own_unit(out[column])
            linear = isinstance(unit, u.UnitBase) and (
                unit.is_equivalent(FNU, u.spectral_density(1 * u.um)) or unit.is_equivalent(u.mgy)
            )
            if not linear:
                raise units_error("photometry", "in a linear unit of flux", unit, column=column)
            if out[column].ndim != 1 or out[column].dtype.kind not in "fiu":
                raise argument_error("photometry", "one number in each row", f"column {column!r}")
            info = out[column].info
            described = info.description, info.format
            out[column] = out[column] * factor
            out[column].info.description, out[column].info.format = described
    out.meta[_KEY] = dict(table.meta[_KEY])
    return out
