"""A celestial WCS as text, to the last digit: for files and pickles."""

import json

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS

from miricigale.utils.exceptions import argument_error


def _exact(has_cd):
    """Names of the numbers of a WCS that a header rounds."""
    return ("crpix", "crval", "cd") if has_cd else ("crpix", "crval", "cdelt", "pc")


def grid_text(wcs):
    """
    A WCS as text.

    Parameters
    ----------
    wcs : `~astropy.wcs.WCS`
        Celestial, of two axes.

    Returns
    -------
    text : str
        JSON: its header, and all digits of what a header rounds.

    Raises
    ------
    ValueError
        If a header cannot hold it, such as one with lookup tables.
    """
    exact = {name: getattr(wcs.wcs, name).tolist() for name in _exact(wcs.wcs.has_cd())}
    cards = wcs.to_header(relax=True).cards
    header = {c.keyword: c.value for c in cards if c.keyword not in ("COMMENT", "HISTORY", "")}
    text = json.dumps({"header": header, **exact})
    x = y = np.array([0.0, 1000.0])
    again = text_grid(text).pixel_to_world_values(x, y)
    if not np.allclose(again, wcs.pixel_to_world_values(x, y), rtol=0, atol=1e-9):
        raise argument_error("wcs", "one that a FITS header can hold", f"{wcs!r}")
    return text


def text_grid(text):
    """
    The WCS that `grid_text` wrote.

    Parameters
    ----------
    text : str
        The text.

    Returns
    -------
    wcs : `~astropy.wcs.WCS`
    """
    state = json.loads(text)
    wcs = WCS(fits.Header(state["header"]))
    has_cd = "cd" in state
    if has_cd:
        # the header has PC and CDELT instead
        del wcs.wcs.pc
    for name in _exact(has_cd):
        setattr(wcs.wcs, name, state[name])
    wcs.wcs.set()
    return wcs
