"""What a search of filters is for: part of a name, or a wavelength."""

import re

import astropy.units as u

from miricigale.utils.units import WAVE, to_array


def searched_wavelength(text):
    """
    Return the wavelength that a search is for.

    Parameters
    ----------
    text : str or `~astropy.units.Quantity`
        A wavelength, or part of a name.

    Returns
    -------
    wave : float or None
        In um; None for part of a name.

    Raises
    ------
    `~astropy.units.UnitsError`
        If a quantity is no wavelength.
    """
    if isinstance(text, str):
        # a word without number may be a unit too
        if not re.match(r"\s*[\d.]+\s*[A-Za-zµ]", text):
            return None
        # an A alone is no ampere here
        text = re.sub(r"([\d.]\s*)A$", r"\1AA", text)
    try:
        wave = u.Quantity(text)
    except (TypeError, ValueError):
        return None
    return to_array(wave, WAVE, "text", ndim=0, finite=True)
