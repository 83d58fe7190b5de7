"""What the pixels of an image are in MJy/sr: units in headers, zero points, keywords."""

import contextlib
import re
import warnings

import astropy.units as u
import numpy as np

from miricigale.utils.options import check_data, check_that
from miricigale.utils.units import SURFACE_BRIGHTNESS, ab_quantity, flux_unit

#: Names of count rates in headers that are no units of astropy.
_COUNTS = (
    (r"\bcps\b", "ct/s"),
    (r"\belectrons?\b|\be-(?=[/ ]|$)|\be(?=/)", "electron"),
    (r"\bcounts?\b", "ct"),
    (r"\badu\b", "adu"),
    (r"\bdn\b", "DN"),
    (r"(?<=/)\s*s(?:ec(?:onds?)?)?\b", "s"),
)

#: Areas in units of brightness as headers write them, in lower case.
_AREAS = {
    "pixel": u.one, "pix": u.one, "pixels": u.one, "px": u.one,
    "arcsec2": u.arcsec**2, "arcsec^2": u.arcsec**2, "arcsec**2": u.arcsec**2, "sqarcsec": u.arcsec**2,
    "sr": u.sr, "str": u.sr, "ster": u.sr, "steradian": u.sr,
}  # fmt: skip

#: What counts may be.
_BASES = (u.electron, u.ct, u.adu, u.DN, u.ph)


def parsed_unit(text):
    """
    Parse the unit in a header, such as ``10.0*nanoJansky`` or ``ELECTRONS/S``.

    Without pixels, as values are of one; None if it means none.
    """
    if not text:
        return None
    # nanomaggies, which astropy ties to no flux
    flux = flux_unit(text)
    if isinstance(flux, u.UnitBase):
        return flux
    # JY/PIXEL, microJy/arcsec2
    numerator, _, denominator = text.partition("/")
    flux = flux_unit(numerator)
    area = _AREAS.get(denominator.strip().lower())
    if isinstance(flux, u.UnitBase) and area is not None:
        return flux / area
    replaced = text
    for pattern, name in _COUNTS:
        replaced = re.sub(pattern, name, replaced, flags=re.IGNORECASE)
    # S alone would be siemens
    for name in (replaced, text):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", u.UnitsWarning)
            with contextlib.suppress(TypeError, ValueError):
                unit = u.Unit(name)
                pixels = dict(zip(unit.bases, unit.powers, strict=True)).get(u.pix, 0)
                return unit / u.pix**pixels
    return None


def calibration(path, text, zero_point, keywords):
    """
    Calibrate one unit of a pixel's value in MJy/sr, or in MJy for fluxes in pixels, and say by what.

    Parameters
    ----------
    path, text
        The file, for messages; unit of the pixels, which may be empty.
    zero_point : float, `~astropy.units.Quantity` or None
        AB magnitude of one count.
    keywords : dict
        Values of PHOTMJSR, PHOTFLAM, PHOTPLAM and EXPTIME, or None.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If there is no unit, or one that cannot be calibrated.
    ValueError
        If a zero point is given for fluxes, or is not finite.
    """
    # a unit of brightness or flux needs no calibration
    unit = parsed_unit(text)
    if unit is not None and not unit.is_equivalent(u.dimensionless_unscaled):
        for target in (SURFACE_BRIGHTNESS, u.MJy):
            if unit.is_equivalent(target):
                wanted = f"left out for {path}, whose unit is {unit}"
                check_that(zero_point is None, "zero_point", wanted, zero_point)
                return unit.to(target) * target, f"unit {unit}"
    if zero_point is not None:
        zero = ab_quantity(zero_point).to(u.ABmag)
        check_that(np.isfinite(zero), "zero_point", "a finite AB magnitude", zero_point)
        return zero.to(u.MJy), f"zero point {zero.value:g} AB"
    problem = (
        f"must state the unit of its pixels ('unit' or 'zero_point'); what it states is {text!r}"
    )
    check_data(unit is not None and not unit.is_equivalent(u.dimensionless_unscaled), path, problem)
    time = 1.0
    note = ""
    if _count_base(unit) is not None:
        time = keywords["EXPTIME"]
        problem = "no rate, and its header no EXPTIME: counts need 'zero_point'"
        check_data(time and time > 0, path, f"has pixels in {unit}, {problem}")
        unit = unit / u.s
        note = f", EXPTIME {time:g} s"
    base = _count_base(unit * u.s)
    problem = "and wanted is a surface brightness, a flux, counts or a rate of counts"
    check_data(base is not None, path, f"has pixels in {unit}, {problem}")
    # counts over the exposure time are a rate
    scale = unit.to(base / u.s) / time
    # exactly one calibration of count rates must be there
    calibrations = _header_calibrations(keywords)
    problem = (
        "has both PHOTMJSR and PHOTFLAM" if calibrations else "has neither PHOTMJSR nor PHOTFLAM"
    )
    check_data(
        len(calibrations) == 1,
        path,
        f"has pixels in {unit}, its header {problem}: give 'zero_point'",
    )
    name, factor = calibrations[0]
    return factor * scale, name + note


def _count_base(unit):
    """Return the unit of counts that a unit is equivalent to, or None."""
    for base in _BASES:
        if unit.is_equivalent(base):
            return base
    return None


def _header_calibrations(keywords):
    """Return the brightness or flux of one count a second, by each calibration that a header has."""
    calibrations = []
    value = keywords["PHOTMJSR"]
    if value:
        calibrations.append((f"PHOTMJSR {value:.6g}", float(value) * SURFACE_BRIGHTNESS))
    value = keywords["PHOTFLAM"]
    pivot = keywords["PHOTPLAM"]
    if value and pivot:
        flam = float(value) * u.erg / (u.s * u.cm**2 * u.AA)
        flux = flam.to(u.MJy, u.spectral_density(float(pivot) * u.AA))
        calibrations.append((f"PHOTFLAM {value:.6g}, PHOTPLAM {pivot:.6g}", flux))
    return calibrations
