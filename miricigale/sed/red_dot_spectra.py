"""Spectra of little red dots: an envelope of dense gas that shines as a black body, in a young galaxy."""

from itertools import product

import astropy.units as u
import numpy as np
from scipy.integrate import cumulative_trapezoid

from miricigale.sed.cells import edges_around
from miricigale.sed.presets import red_dot_axes
from miricigale.sed.spectrum import SED
from miricigale.utils.missing_values import floats
from miricigale.utils.named_values import without
from miricigale.utils.options import check_names, check_that, check_type
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.units import FNU, WAVE, to_array

#: Planck's h c / k in um K.
_SECOND_RADIATION = 14387.77
#: Limits of the Lyman and Balmer series in um.
_LYMAN = 0.0912
_BALMER = 0.3646
#: Where the galaxy's share and the dust's are measured, and beyond what its F_nu does not rise any more, in um.
_UV = 0.25
_OPTICAL = 0.51
_NEAR = 1.0
_MIDDLE = 3.0
_FLAT = 0.5
#: Vacuum wavelengths of the lines in um.
_H_ALPHA = 0.65646
_H_BETA = 0.48627
_OIII = (0.50082, 0.49603)
#: Parts of the light of [O III] at 5008 and 4960 A.
_OIII_SHARES = (0.75, 0.25)
#: Full widths of the lines at half maximum: those of the envelope, and of the galaxy.
_BROAD = 2000.0  # km / s
_NARROW = 500.0  # km / s
_KM_S = 299792.458  # speed of light
#: Of hot dust.
_HOT = 1200.0  # K

#: Parameters: unit, value by default, least and largest value.
_PARAMETERS = {
    "uv_slope": (u.one, -1.7, -5.0, np.inf),
    "uv_to_optical": (u.one, 0.2, 0.0, np.inf),
    "temperature": (u.K, 4300.0, 1000.0, np.inf),
    "balmer_depth": (u.one, 1.0, 0.0, np.inf),
    "covering": (u.one, 1.0, 0.0, 1.0),
    "halpha_width": (u.AA, 800.0, 0.0, np.inf),
    "balmer_decrement": (u.one, 9.0, 1.0, np.inf),
    "oiii_width": (u.AA, 800.0, 0.0, np.inf),
    "hot_dust": (u.one, 0.0, 0.0, np.inf),
}
#: Those of a black body that an atmosphere has itself.
_OF_BLACK_BODY = ("temperature", "balmer_depth", "covering")


def _wavelengths():
    """Return the rest wavelengths in um: finely where bands of surveys are, and over the lines."""
    across = np.linspace(-0.02, 0.02, 61)
    lines = [line * (1.0 + across) for line in (_H_ALPHA, _H_BETA) + _OIII]
    optical = np.geomspace(_LYMAN, 1.5, 1200)
    jumps = np.array([_LYMAN, _BALMER])
    both_sides = np.concatenate([jumps * (1.0 - 1e-5), jumps * (1.0 + 1e-5)])
    return np.unique(
        np.concatenate([np.geomspace(0.005, 300.0, 800), optical, both_sides] + list(lines))
    )


_WAVE_UM = _wavelengths()


@takes_other_keywords
def red_dot(*, atmosphere=None, **parameters):
    r"""
    Return the spectrum of a little red dot.

    Two parts whose shapes are simple and whose numbers are published:

    - An *envelope* of dense gas, optically thick: Planck's law of a ``temperature`` (de Graaff et al. 2025,
      arXiv:2511.21820, find 3500, 4300 and 5500 K at 16, 50 and 84 % of 116 spectra), times
      exp(-``balmer_depth`` (wave / 0.3646 um)^3) below the Balmer limit, the absorption by hydrogen in its second
      level, where Setton et al. 2024 (arXiv:2411.03424) find that spectra turn; gas in front of a part of the
      light, the ``covering``, absorbs that part (Inayoshi & Maiolino 2025, ApJL 980, L27). H alpha has an
      equivalent width ``halpha_width`` (430, 760 and 1180 A of the same spectra) and the flux of H beta times the
      ``balmer_decrement`` (5.7, 8.8 and 12).
    - A *galaxy* of young stars, or scattered light: F_lambda ~ wave^``uv_slope`` (-1.9, -1.4 and -0.9 of the same
      spectra), whose F_nu does not rise beyond 0.5 um; [O III] of an equivalent width ``oiii_width`` over it
      alone (Endsley et al. 2023, MNRAS 524, 2312, find 780 A with H beta at z = 6.5 to 8).

    *Hot dust* of 1200 K may add to the infrared: there is little in single sources (Setton et al. 2025,
    arXiv:2503.02059), and some in the mean (Delvecchio et al. 2025, arXiv:2509.07100). No light below 0.0912 um.

    Parameters
    ----------
    atmosphere : `SED`, optional
        Spectrum of the envelope by wavelength at rest, in place of the black body with its absorption, such as one
        of a library of optically thick atmospheres (Liu et al. 2026, arXiv:2603.02317). Beyond its end
        F_nu ~ wave^-2, before its beginning it is dark.
    uv_slope : float, optional
        Slope of F_lambda of the galaxy; -1.7.
    uv_to_optical : float, optional
        F_nu of the galaxy at 0.25 um over that of the envelope at 0.51 um, without lines; 0.2.
    temperature : `~astropy.units.Quantity`, optional
        Of the envelope; 4300 K.
    balmer_depth : float, optional
        Optical depth of the absorbing gas at the Balmer limit; 1.
    covering : float, optional
        Part of the envelope's light that this gas covers, 0 to 1; 1.
    halpha_width : `~astropy.units.Quantity`, optional
        Equivalent width of H alpha over the envelope, at rest; 800 Angstrom.
    balmer_decrement : float, optional
        Flux of H alpha over that of H beta; 9.
    oiii_width : `~astropy.units.Quantity`, optional
        Equivalent width of both [O III] lines over the galaxy, at rest; 800 Angstrom.
    hot_dust : float, optional
        F_nu of hot dust at 3 um over that of the envelope at 1 um; 0.

    Returns
    -------
    sed : `SED`
        By wavelength at rest, 0.005 to 300 um, 1 uJy of the envelope at 0.51 um, with ``parameters``.

    Raises
    ------
    KeyError
        If there is no such parameter.
    ValueError
        If a value is not one finite number, or outside its limits (a temperature from 1000 K, a slope from -5, a
        decrement from 1, a covering up to 1, others from 0), if there are parameters of a black body besides an
        atmosphere, or that has no light at 0.51 um.
    `~astropy.units.UnitsError`
        If one has the wrong unit.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.sed import red_dot
    >>> wave = [0.25, 0.36, 0.51, 1.0] * u.um
    >>> red_dot(temperature=5000 * u.K, uv_to_optical=0.1).fnu_at(wave).round(2)
    <Quantity [0.12, 0.21, 1.12, 2.35] uJy>
    >>> red_dot(temperature=5000 * u.K, uv_to_optical=0.1, covering=0.5).fnu_at(wave).round(2)
    <Quantity [0.12, 0.3 , 1.12, 2.35] uJy>
    """
    check_names(parameters, "parameter of a red dot", _PARAMETERS)
    numbers = {}
    quantities = {}
    for name, (unit, default, minimum, maximum) in _PARAMETERS.items():
        if atmosphere is not None and name in _OF_BLACK_BODY:
            check_that(name not in parameters, name, "left out with an atmosphere", "a value")
            continue
        value = parameters.get(name, default * unit)
        number = to_array(value, unit, name, ndim=0, finite=True).item()
        if np.isfinite(maximum):
            wanted = f"{minimum:g} to {maximum:g} {unit}".strip()
        else:
            wanted = f"at least {minimum:g} {unit}".strip()
        check_that(minimum <= number <= maximum, name, wanted, f"{number:g}")
        numbers[name] = number
        quantities[name] = number * unit
    if atmosphere is None:
        continuum = _black_body(numbers)
    else:
        continuum = _photosphere(atmosphere)
    fnu = _envelope(continuum, numbers) + _galaxy(numbers)
    fnu[_WAVE_UM <= _LYMAN] = 0.0
    return SED(_WAVE_UM * WAVE, fnu * FNU, meta={"parameters": quantities})


@takes_other_keywords
def red_dots(axes=None, *, atmospheres=None):
    """
    Return the spectra of little red dots of all values of some axes, for `template_grid` at redshifts.

    Parameters
    ----------
    axes : dict of str to array_like, optional
        Values of parameters of `red_dot`, in their units (K, Angstrom); others have the value by default. Those of
        `red_dot_axes` by default; their redshifts are for `template_grid`.
    atmospheres : dict of str to `SED`, optional
        Spectra of envelopes by name (see `red_dot`), as `read_spectra` reads them, in place of black bodies. They
        are numbered by the parameter ``atmosphere``, from 0 on. The default ``axes`` are then those of
        `red_dot_axes` that are not of black bodies.

    Returns
    -------
    spectra : dict of str to `SED`
        By their values; 1944 of them by default.

    Raises
    ------
    KeyError, ValueError
        See `red_dot`; also if ``atmospheres`` is empty.

    Examples
    --------
    >>> from miricigale.sed import red_dot_axes, red_dots, template_grid
    >>> z = red_dot_axes()["redshift"]
    >>> template_grid(red_dots(), ["nircam.f150w", "nircam.f444w"], redshift=z)
    <ModelGrid 66 redshifts x 1944 galaxies x 0 AGN x 1 fractions, 2 bands, 128,304 models>
    """
    if atmospheres is not None:
        check_that(len(atmospheres) > 0, "atmospheres", "one or more spectra by name", "none")
    if axes is None:
        axes = red_dot_axes()
        if atmospheres is not None:
            axes = without(axes, _OF_BLACK_BODY)
    else:
        axes = dict(axes)
    axes.pop("redshift", None)
    check_names(axes, "parameter of a red dot", _PARAMETERS)
    values = [np.atleast_1d(floats(axis)).tolist() for axis in axes.values()]
    out = {}
    for point in product(*values):
        chosen = dict(zip(axes, point, strict=True))
        name = ", ".join(f"{key} {value:g}" for key, value in chosen.items())
        parameters = {key: value * _PARAMETERS[key][0] for key, value in chosen.items()}
        if atmospheres is None:
            out[name] = red_dot(**parameters)
            continue
        for number, (label, atmosphere) in enumerate(atmospheres.items()):
            sed = red_dot(atmosphere=atmosphere, **parameters)
            numbered = {"atmosphere": number * u.one} | sed.parameters
            out[f"{label}, {name}"] = sed.replace(meta=sed.meta | {"parameters": numbered})
    return out


def _planck(temperature, wave):
    """Return Planck's law of F_nu at wavelengths in um, but for a factor."""
    x = _SECOND_RADIATION / (temperature * wave)
    # below 0.0912 um it would overflow
    return wave**-3.0 / np.expm1(np.minimum(x, 600.0))


def _line(center, width):
    """Gaussian line of a flux of 1 in F_lambda um, of a full width at half maximum in km/s: shape (n_wave,)."""
    sigma = center * width / _KM_S / (2.0 * np.sqrt(2.0 * np.log(2.0)))
    return np.exp(-0.5 * ((_WAVE_UM - center) / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma)


def _black_body(values):
    """Return the F_nu of the envelope as a black body that hydrogen absorbs, 1 at 0.51 um."""
    depth = values["balmer_depth"] * (_WAVE_UM / _BALMER) ** 3
    transmission = 1.0 - values["covering"] * -np.expm1(-np.where(_WAVE_UM < _BALMER, depth, 0.0))
    planck = _planck(values["temperature"], _WAVE_UM)
    return planck / _planck(values["temperature"], _OPTICAL) * transmission


def _photosphere(atmosphere):
    """Return the F_nu of the envelope as a spectrum, 1 at 0.51 um: means around the points of `_WAVE_UM`."""
    check_type(atmosphere, "atmosphere", SED, "an SED")
    wave = atmosphere.rest_wavelength.to_value(WAVE)
    fnu = atmosphere.fnu.to_value(FNU)
    # 1 % in wavelength, over lines
    in_window = np.abs(wave / _OPTICAL - 1.0) < 0.005
    check_that(in_window.any(), "atmosphere", "with points near 0.51 um", atmosphere)
    optical = fnu[in_window].mean()
    check_that(optical > 0, "atmosphere", "with light at 0.51 um", f"{optical:g} uJy")
    # libraries have narrow absorption lines, which are finer than the points
    edges = edges_around(_WAVE_UM)
    fine = np.union1d(wave, edges)
    light = np.interp(fine, wave, fnu, left=0.0)
    far = fine > wave[-1]
    light[far] = fnu[-1] * (wave[-1] / fine[far]) ** 2
    integral = cumulative_trapezoid(light, fine, initial=0.0)
    means = np.diff(np.interp(edges, fine, integral)) / np.diff(edges)
    return means / optical


def _envelope(continuum, values):
    """Return the F_nu of the envelope with its lines and the hot dust, of its continuum at `_WAVE_UM`."""
    # F_lambda of the continuum under H alpha, in F_nu / wave^2
    under = np.interp(_H_ALPHA, _WAVE_UM, continuum) / _H_ALPHA**2
    flux = under * (values["halpha_width"] * u.AA).to_value(WAVE)
    lines = flux * _line(_H_ALPHA, _BROAD)
    lines += flux / values["balmer_decrement"] * _line(_H_BETA, _BROAD)
    dust = _planck(_HOT, _WAVE_UM) / _planck(_HOT, _MIDDLE)
    dust *= values["hot_dust"] * np.interp(_NEAR, _WAVE_UM, continuum)
    return continuum + lines * _WAVE_UM**2 + dust


def _galaxy(values):
    """Return the F_nu of the galaxy with its lines."""
    slope = values["uv_slope"] + 2.0
    fnu = values["uv_to_optical"] * (np.minimum(_WAVE_UM, _FLAT) / _UV) ** slope
    fnu *= np.maximum(_WAVE_UM / _FLAT, 1.0) ** min(slope, 0.0)
    lines = np.zeros(_WAVE_UM.size)
    for center, share in zip(_OIII, _OIII_SHARES, strict=True):
        under = np.interp(center, _WAVE_UM, fnu) / center**2
        flux = under * (values["oiii_width"] * u.AA).to_value(WAVE)
        lines += share * flux * _line(center, _NARROW)
    return fnu + lines * _WAVE_UM**2
