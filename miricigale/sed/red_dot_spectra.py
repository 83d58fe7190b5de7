"""Spectra of little red dots: an envelope of dense gas that shines as a black body, in a young galaxy."""

from itertools import product

import astropy.units as u
import numpy as np

from miricigale.sed.presets import red_dot_axes
from miricigale.sed.spectrum import SED
from miricigale.utils.options import check_names, check_that
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
#: Flux of H alpha over that of H beta (de Graaff et al. 2025: 5.7, 8.8 and 12.0 at 16, 50 and 84 %).
_DECREMENT = 9.0
#: Equivalent width of both [O III] lines over the galaxy alone (Endsley et al. 2023: 780 A of [O III] and H beta
#: at z = 6.5-8), of which 0.75 are the line at 5008 A.
_OIII_WIDTH = 0.08  # um
_OIII_SHARES = (0.75, 0.25)
#: Full widths of the lines at half maximum: those of the envelope, and of the galaxy.
_BROAD = 2000.0  # km / s
_NARROW = 500.0  # km / s
_KM_S = 299792.458  # speed of light
#: Of hot dust.
_HOT = 1200.0  # K

#: Parameters: unit, value by default, and least value.
_PARAMETERS = {
    "uv_slope": (u.one, -1.7, -5.0),
    "uv_to_optical": (u.one, 0.2, 0.0),
    "temperature": (u.K, 4300.0, 1000.0),
    "balmer_depth": (u.one, 1.0, 0.0),
    "halpha_width": (u.AA, 800.0, 0.0),
    "hot_dust": (u.one, 0.0, 0.0),
}


def _wavelengths():
    """Rest wavelengths in um: finely where bands of surveys are, and over the lines."""
    across = np.linspace(-0.02, 0.02, 61)
    lines = [line * (1.0 + across) for line in (_H_ALPHA, _H_BETA) + _OIII]
    optical = np.geomspace(_LYMAN, 1.5, 1200)
    jumps = np.array([_LYMAN, _BALMER])
    both_sides = np.concatenate([jumps * (1.0 - 1e-5), jumps * (1.0 + 1e-5)])
    return np.unique(
        np.concatenate([np.geomspace(0.005, 300.0, 800), optical, both_sides] + list(lines))
    )


_WAVE_UM = _wavelengths()


def red_dot(**parameters):
    r"""
    Spectrum of a little red dot.

    Two parts whose shapes are simple and whose numbers are published:

    - An *envelope* of dense gas, optically thick: Planck's law of a ``temperature`` (de Graaff et al. 2025,
      arXiv:2511.21820, find 3500, 4300 and 5500 K at 16, 50 and 84 % of 116 spectra), times
      exp(-``balmer_depth`` (wave / 0.3646 um)^3) below the Balmer limit, the absorption by hydrogen in its second
      level, where Setton et al. 2024 (arXiv:2411.03424) find that spectra turn. H alpha of an equivalent width
      ``halpha_width`` (430, 760 and 1180 A of the same spectra), H beta a ninth of it (8.8 in the median).
    - A *galaxy* of young stars, or scattered light: F_lambda ~ wave^``uv_slope`` (-1.9, -1.4 and -0.9 of the same
      spectra), whose F_nu does not rise beyond 0.5 um; [O III] of 800 A over it alone, as in galaxies at z = 7
      (Endsley et al. 2023, MNRAS 524, 2312).

    *Hot dust* of 1200 K may add to the infrared: there is little in single sources (Setton et al. 2025,
    arXiv:2503.02059), and some in the mean (Delvecchio et al. 2025, arXiv:2509.07100). No light below 0.0912 um.

    Parameters
    ----------
    uv_slope : float, optional
        Slope of F_lambda of the galaxy; -1.7.
    uv_to_optical : float, optional
        F_nu of the galaxy at 0.25 um over that of the envelope at 0.51 um, without lines; 0.2.
    temperature : `~astropy.units.Quantity`, optional
        Of the envelope; 4300 K.
    balmer_depth : float, optional
        Optical depth of the envelope at the Balmer limit; 1.
    halpha_width : `~astropy.units.Quantity`, optional
        Equivalent width of H alpha over the envelope, at rest; 800 Angstrom.
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
        If a value is not one finite number, or below its least: a temperature of 1000 K, a slope of -5, 0.
    `~astropy.units.UnitsError`
        If one has the wrong unit.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.sed import red_dot
    >>> sed = red_dot(temperature=5000 * u.K, uv_to_optical=0.1)
    >>> sed.fnu_at([0.25, 0.36, 0.51, 1.0] * u.um).round(2)
    <Quantity [0.12, 0.21, 1.12, 2.35] uJy>
    """
    check_names(parameters, "parameter of a red dot", _PARAMETERS)
    numbers = {}
    quantities = {}
    for name, (unit, default, minimum) in _PARAMETERS.items():
        value = parameters.get(name, default * unit)
        number = to_array(value, unit, name, ndim=0, finite=True).item()
        wanted = f"at least {minimum:g} {unit}".strip()
        check_that(number >= minimum, name, wanted, f"{number:g}")
        numbers[name] = number
        quantities[name] = number * unit
    fnu = _envelope(numbers) + _galaxy(numbers)
    fnu[_WAVE_UM <= _LYMAN] = 0.0
    return SED(_WAVE_UM * WAVE, fnu * FNU, meta={"parameters": quantities})


def red_dots(axes=None):
    """
    Spectra of little red dots of all values of some axes, for `template_grid` at redshifts.

    Parameters
    ----------
    axes : dict of str to array_like, optional
        Values of parameters of `red_dot`, in their units (K, Angstrom); others have the value by default. Those of
        `red_dot_axes` by default; their redshifts are for `template_grid`.

    Returns
    -------
    spectra : dict of str to `SED`
        By their values; 1296 of them by default.

    Raises
    ------
    KeyError, ValueError
        See `red_dot`.

    Examples
    --------
    >>> from miricigale.sed import red_dot_axes, red_dots, template_grid
    >>> z = red_dot_axes()["redshift"]
    >>> template_grid(red_dots(), ["nircam.f150w", "nircam.f444w"], redshift=z)
    <ModelGrid 66 redshifts x 1296 galaxies x 0 AGN x 1 fractions, 2 bands, 85,536 models>
    """
    if axes is None:
        axes = red_dot_axes()
    else:
        axes = dict(axes)
    axes.pop("redshift", None)
    check_names(axes, "parameter of a red dot", _PARAMETERS)
    values = [np.atleast_1d(np.asarray(axis, dtype=float)).tolist() for axis in axes.values()]
    out = {}
    for point in product(*values):
        chosen = dict(zip(axes, point, strict=True))
        name = ", ".join(f"{key} {value:g}" for key, value in chosen.items())
        out[name] = red_dot(**{key: value * _PARAMETERS[key][0] for key, value in chosen.items()})
    return out


def _planck(temperature, wave):
    """Planck's law of F_nu at wavelengths in um, but for a factor."""
    x = _SECOND_RADIATION / (temperature * wave)
    # below 0.0912 um it would overflow
    return wave**-3.0 / np.expm1(np.minimum(x, 600.0))


def _line(center, width):
    """Gaussian line of a flux of 1 in F_lambda um, of a full width at half maximum in km/s: shape (n_wave,)."""
    sigma = center * width / _KM_S / (2.0 * np.sqrt(2.0 * np.log(2.0)))
    return np.exp(-0.5 * ((_WAVE_UM - center) / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma)


def _envelope(values):
    """F_nu of the envelope with its lines and the hot dust, 1 at 0.51 um without lines."""
    absorbed = values["balmer_depth"] * (_WAVE_UM / _BALMER) ** 3
    scale = 1.0 / _planck(values["temperature"], _OPTICAL)
    fnu = scale * _planck(values["temperature"], _WAVE_UM)
    fnu *= np.exp(-np.where(_WAVE_UM < _BALMER, absorbed, 0.0))
    # F_lambda of the continuum under H alpha, in F_nu / wave^2
    under = scale * _planck(values["temperature"], _H_ALPHA) / _H_ALPHA**2
    flux = under * (values["halpha_width"] * u.AA).to_value(WAVE)
    lines = flux * _line(_H_ALPHA, _BROAD) + flux / _DECREMENT * _line(_H_BETA, _BROAD)
    dust = _planck(_HOT, _WAVE_UM) / _planck(_HOT, _MIDDLE)
    dust *= values["hot_dust"] * scale * _planck(values["temperature"], _NEAR)
    return fnu + lines * _WAVE_UM**2 + dust


def _galaxy(values):
    """F_nu of the galaxy with its lines."""
    slope = values["uv_slope"] + 2.0
    fnu = values["uv_to_optical"] * (np.minimum(_WAVE_UM, _FLAT) / _UV) ** slope
    fnu *= np.maximum(_WAVE_UM / _FLAT, 1.0) ** min(slope, 0.0)
    lines = np.zeros(_WAVE_UM.size)
    for center, share in zip(_OIII, _OIII_SHARES, strict=True):
        under = np.interp(center, _WAVE_UM, fnu) / center**2
        lines += share * _OIII_WIDTH * under * _line(center, _NARROW)
    return fnu + lines * _WAVE_UM**2
