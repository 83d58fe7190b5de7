"""What the header of a file of the pipeline says: what was exposed, and what was done to it."""

import re

from astropy.io import fits

from miricigale.utils.exceptions import data_error

#: Read-out patterns by the names that they had before the launch.
READOUT_NAMES = {"FAST": "FASTR1", "SLOW": "SLOWR1"}

#: Where the light is blocked there is no filter.
_NO_FILTER = ("", "OPAQUE", "N/A", "ANY")

#: Keywords of FITS itself.
_KEPT = re.compile(r"(?!COMMENT|HISTORY)[A-Z0-9_-]{1,8}")

#: Keywords that a product does not take over.
_DROPPED = re.compile(r"META|CHECKSUM|DATASUM|DQ(SCHEME|BIT\d+)|EXTVER|EXTEND|NEXTEND")

#: World coordinates of FITS.
_WCS = re.compile(
    r"WCSAXES|RADESYS|EQUINOX|LONPOLE|LATPOLE|CROTA\d|C(TYPE|UNIT|RPIX|RVAL|DELT)\d|(CD|PC)\d_\d"
    r"|[AB]P?_(ORDER|\d_\d)"
)

#: Keywords that JWST has in the extension SCI.
_SCIENCE = re.compile(
    r"(MJD|TDB)-(BEG|AVG|MID|END)|XPOSURE|TELAPSE|REFFRAME|EPH_T(IME|YPE)|JWST_D?[XYZ]|OBSGEO.*|MT_(AV)?(RA|DEC)"
    r"|PA_(APER|V3)|(RA|DEC)_V1|V[23]_REF|VPARITY|V3I_YANG|(RA|DEC|ROLL)_REF|VA_SCALE|VELOSYS|S_REGION|BUNIT"
    r"|PHOT(MJSR|UJA2)|PIXAR_(SR|A2)|SPECSYS|SPORDER|SRCTYPE|DISPAXIS"
)

#: Steps of the JWST pipeline by the keywords that record them.
STEPS = {
    "S_DQINIT": "dq_init", "S_SATURA": "saturation", "S_IPC": "ipc", "S_FRSTFR": "firstframe",
    "S_LASTFR": "lastframe", "S_SUPERB": "superbias", "S_RESET": "reset", "S_LINEAR": "linearity",
    "S_RSCD": "rscd", "S_DARK": "dark", "S_REFPIX": "refpix", "S_JUMP": "jump", "S_GANSCL": "gain_scale",
    "S_RAMP": "ramp_fit", "S_FLAT": "flat", "S_BKDSUB": "background", "S_PHOTOM": "photom",
    "S_SKYMAT": "skymatch", "S_OUTLIR": "outlier", "S_RESAMP": "resample",
}  # fmt: skip


def steps_done(header):
    """
    Steps that a file has behind it.

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
    return frozenset(
        step
        for keyword, step in STEPS.items()
        if str(header.get(keyword, "")).strip().upper() == "COMPLETE"
    )


def joined_header(hdus, name="SCI"):
    """
    Keywords of a file.

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
    science = hdus[name].header.copy(strip=True) if name in hdus else fits.Header()
    for layout in ("BSCALE", "BZERO", "EXTNAME", "EXTVER", "EXTEND", "NEXTEND"):
        header.remove(layout, ignore_missing=True)
        science.remove(layout, ignore_missing=True)
    for card in science.cards:
        if card.keyword not in ("", "COMMENT", "HISTORY", *header):
            header.append(card)
    return header


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
        Values of EXP_TYPE; any if not given.
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
    kind, detector = str(header.get("EXP_TYPE", "")).strip(), header.get("DETECTOR", "MIRIMAGE")
    instrument = header.get("INSTRUME", "MIRI" if own is not None or "DETECTOR" in header else None)
    if (instrument, detector) != ("MIRI", "MIRIMAGE") or (kinds and kind not in kinds):
        types = f", EXP_TYPE {' or '.join(kinds[:3])}" if kinds else ""
        wanted = f"must be an exposure of the MIRI imager (INSTRUME MIRI, DETECTOR MIRIMAGE{types})"
        raise data_error(path, f"{wanted}, got {instrument} {detector} {kind}".rstrip())
    stated, recorded = str(header.get("FILTER", "")).strip(), (own or {}).get("filter")
    bands = {name.rpartition(".")[2].upper() for name in (stated, recorded) if name}
    if len(bands) > 1:
        what = f"FILTER is {stated} in the header and {recorded} in the package's record"
        raise data_error(path, f"contradicts itself: {what}")


def exposure_keywords(header):
    """
    What was exposed, in the names of this package.

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
    name, pattern, part = (
        str(header.get(key, "")).strip() for key in ("FILTER", "READPATT", "SUBARRAY")
    )
    return (
        None if name in _NO_FILTER else f"miri.{name.lower()}",
        READOUT_NAMES.get(pattern, pattern) or None,
        part or None,
        max(int(header.get("PATT_NUM", 1)), 1) - 1,
    )


def kept_keywords(header):
    """
    Keywords of a file that its products keep: all but its layout and the package's own record.

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
    return {
        card.keyword: [card.value, card.comment]
        for card in header.copy(strip=True).cards
        if _KEPT.fullmatch(card.keyword) and not _DROPPED.fullmatch(card.keyword)
    }


def placed_keywords(kept, *, wcs=True):
    """
    Headers of keywords, in the extensions in which JWST has them.

    Parameters
    ----------
    kept : dict of str to list
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
    for name, (value, comment) in kept.items():
        # a card has 80 characters
        longest = max(0, 65 - max(20, len(str(value)) + 2))
        sky = _WCS.fullmatch(name) is not None
        if wcs or not sky:
            parts[sky or _SCIENCE.fullmatch(name) is not None][name] = value, comment[:longest]
    return parts
