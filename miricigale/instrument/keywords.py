"""What the header of a file of the pipeline says: what was exposed, and what was done to it."""

import re

from astropy.io import fits

from miricigale.filters.band_names import band_label
from miricigale.utils.exceptions import data_error
from miricigale.utils.options import check_data
from miricigale.utils.package_tables import declared

#: Read-out patterns by the names that they had before the launch.
READOUT_NAMES = {"FAST": "FASTR1", "SLOW": "SLOWR1"}

#: Values of EXP_TYPE of images of the sky and of calibration lamps; ground tests state none.
IMAGE_KINDS = (
    "MIR_IMAGE", "MIR_DARKIMG", "MIR_DARKALL", "MIR_FLATIMAGE", "MIR_FLATIMAGE-EXT", "ANY", "N/A", "",
)  # fmt: skip

#: Where the light is blocked there is no filter.
_NO_FILTER = ("", "OPAQUE", "N/A", "ANY")

_DECLARED = declared("miricigale.instrument", "keywords.toml")
#: Keywords of FITS itself, those that a product does not take over, world coordinates, and those in SCI of JWST.
_KEPT, _DROPPED, _WCS, _SCIENCE = (re.compile("|".join(p)) for p in _DECLARED["patterns"].values())

#: Values of FILTER that disperse the light.
_DISPERSERS = ("P750L", "FLENS")

#: Steps of the JWST pipeline by the keywords that record them.
STEPS = _DECLARED["steps"]


def steps_done(header):
    """
    Return the steps that a file has behind it.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        Of the primary extension.

    Returns
    -------
    steps : frozenset of str
        Names of `STEPS` whose keyword says COMPLETE.

    Examples
    --------
    >>> from astropy.io.fits import Header
    >>> from miricigale.instrument import steps_done
    >>> sorted(
    ...     steps_done(
    ...         Header(
    ...             {"S_DARK": "COMPLETE", "S_LINEAR": "COMPLETE", "S_JUMP": "SKIPPED"}
    ...         )
    ...     )
    ... )
    ['dark', 'linearity']
    """
    done = []
    for keyword, step in STEPS.items():
        if keyword_text(header.get, keyword) == "COMPLETE":
            done.append(step)
    return frozenset(done)


def keyword_text(get, keyword):
    """Return the value of a keyword (``get(keyword)``) as text in upper case; empty without one."""
    return str(get(keyword) or "").strip().upper()


def joined_header(hdus, name="SCI"):
    """
    Return the keywords of a file.

    Parameters
    ----------
    hdus : `~astropy.io.fits.HDUList`
        The file.
    name : str, optional
        Of an extension, which need not be there.

    Returns
    -------
    header : `~astropy.io.fits.Header`
        Those of the primary header, and of the extension what it lacks, but for the layout of the file.

    Examples
    --------
    >>> from astropy.io import fits
    >>> from miricigale.instrument import joined_header
    >>> primary = fits.PrimaryHDU()
    >>> primary.header["FILTER"] = "F770W"
    >>> science = fits.ImageHDU(name="SCI")
    >>> science.header["BUNIT"] = "MJy/sr"
    >>> header = joined_header(fits.HDUList([primary, science]))
    >>> header["FILTER"], header["BUNIT"]
    ('F770W', 'MJy/sr')
    """
    header = hdus[0].header.copy(strip=True)
    if name in hdus:
        science = hdus[name].header.copy(strip=True)
    else:
        science = fits.Header()
    for layout in ("BSCALE", "BZERO", "EXTNAME", "EXTVER", "EXTEND", "NEXTEND"):
        header.remove(layout, ignore_missing=True)
        science.remove(layout, ignore_missing=True)
    for card in science.cards:
        if card.keyword not in ("", "COMMENT", "HISTORY", *header):
            header.append(card)
    return header


def header_text(header, key):
    """Return a keyword of a header as text without blanks around it; empty where it is not there."""
    return str(header.get(key, "")).strip()


def check_imager(path, header, *, kinds=None, own=None):
    """
    Refuse files of other instruments, detectors and kinds of exposures, or that contradict their own record.

    Parameters
    ----------
    path : path-like
        Of the file, for messages.
    header : mapping
        As `joined_header` makes it.
    kinds : tuple of str, optional
        Values of EXP_TYPE; those of images if not given: no target acquisitions, coronagraphs or spectra.
    own : dict, optional
        The package's record of the exposure, if the file has one.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If a keyword says otherwise, or neither INSTRUME nor DETECTOR is there.

    Examples
    --------
    >>> from astropy.io.fits import Header
    >>> from miricigale.instrument import check_imager
    >>> check_imager("a_rate.fits", Header({"DETECTOR": "MIRIMAGE"}))
    """
    if kinds is None:
        kinds = IMAGE_KINDS
    kind = header_text(header, "EXP_TYPE")
    detector = header.get("DETECTOR", "MIRIMAGE")
    instrument = header.get("INSTRUME", "MIRI" if own is not None or "DETECTOR" in header else None)
    if (instrument, detector) != ("MIRI", "MIRIMAGE") or kind not in kinds:
        types = f"EXP_TYPE {' or '.join(kinds[:3])}"
        wanted = (
            f"must be an exposure of the MIRI imager (INSTRUME MIRI, DETECTOR MIRIMAGE, {types})"
        )
        raise data_error(path, f"{wanted}, got {instrument} {detector} {kind}".rstrip())
    filter_name = header_text(header, "FILTER")
    if filter_name in _DISPERSERS:
        wanted = "must be an exposure of the MIRI imager through a filter"
        raise data_error(path, f"{wanted}, got the prism {filter_name}")
    recorded = (own or {}).get("filter")
    bands = {band_label(name) for name in (filter_name, recorded) if name}
    problem = f"FILTER is {filter_name} in the header and {recorded} in the package's record"
    check_data(len(bands) <= 1, path, f"contradicts itself: {problem}")


def exposure_keywords(header):
    """
    Return what was exposed, in the names of this package.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        As `joined_header` makes it.

    Returns
    -------
    filter, readout, subarray : str or None
        None where the header says nothing; without a filter also where the light was blocked.
    dither : int
        Position in the pattern of dithers, from 0.

    Examples
    --------
    >>> from astropy.io.fits import Header
    >>> from miricigale.instrument import exposure_keywords
    >>> header = Header(
    ...     {"FILTER": "F770W", "READPATT": "FASTR1", "SUBARRAY": "FULL", "PATT_NUM": 2}
    ... )
    >>> exposure_keywords(header)
    ('miri.f770w', 'FASTR1', 'FULL', 1)
    """
    name = header_text(header, "FILTER")
    pattern = header_text(header, "READPATT")
    part = header_text(header, "SUBARRAY")
    return (
        None if name in _NO_FILTER else f"miri.{name.lower()}",
        READOUT_NAMES.get(pattern, pattern) or None,
        part or None,
        max(int(header.get("PATT_NUM", 1)), 1) - 1,
    )


def kept_keywords(header):
    """
    Return the keywords of a file that its products keep: all but its layout and the package's own record.

    Parameters
    ----------
    header : `~astropy.io.fits.Header`
        As `joined_header` makes it.

    Returns
    -------
    kept : dict of str to list
        Value and comment by keyword.

    Examples
    --------
    >>> from astropy.io.fits import Header
    >>> from miricigale.instrument import kept_keywords
    >>> kept_keywords(Header({"PROGRAM": "01345", "META": "{}", "NAXIS": 2}))
    {'PROGRAM': ['01345', '']}
    """
    out = {}
    for card in header.copy(strip=True).cards:
        if _KEPT.fullmatch(card.keyword) and not _DROPPED.fullmatch(card.keyword):
            out[card.keyword] = [card.value, card.comment]
    return out


def placed_keywords(keywords, *, wcs=True):
    """
    Return the headers of keywords, in the extensions in which JWST has them.

    Parameters
    ----------
    keywords : dict of str to list
        Of `kept_keywords`.
    wcs : bool, optional
        Whether world coordinates are among them.

    Returns
    -------
    primary, science : `~astropy.io.fits.Header`

    Examples
    --------
    >>> from miricigale.instrument import placed_keywords
    >>> primary, science = placed_keywords({"PROGRAM": ["01345", ""], "VPARITY": [-1, ""]})
    >>> list(primary), list(science)
    (['PROGRAM'], ['VPARITY'])
    """
    parts = fits.Header(), fits.Header()
    for name, (value, comment) in keywords.items():
        # a card has 80 characters
        longest = max(0, 65 - max(20, len(str(value)) + 2))
        sky = _WCS.fullmatch(name) is not None
        if wcs or not sky:
            parts[sky or _SCIENCE.fullmatch(name) is not None][name] = value, comment[:longest]
    return parts
