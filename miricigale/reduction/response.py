"""Response of the imager by date and sub-array."""

from astropy.time import Time

from miricigale.instrument import imager_filters, subarrays
from miricigale.reduction.reference_maps import on_day, photom_row
from miricigale.utils.exceptions import argument_error

#: Signal over that in the full frame: Gordon et al. 2025, AJ 169, 6, as in the script that makes their photom
#: references (STScI-MIRI/ImagingFluxCal, create_photom_reffile.py).
_PARTS = {"FULL": 1.0, "BRIGHTSKY": 1.005, "SUB256": 0.98, "SUB128": 1.0, "SUB64": 0.966}


def imager_response(photom=None, *, date=None):
    """
    Count rates by filter and sub-array on a day, over those of the full frame at the start of the mission.

    Parameters
    ----------
    photom : path-like, optional
        A photom reference of CRDS (``jwst_miri_photom_*.fits``) with the coefficients of the loss; without it
        the response is that of the sub-arrays alone.
    date : `~astropy.time.Time` or str, optional
        Day, such as ``"2026-11-26"``; needed with ``photom``.

    Returns
    -------
    response : tuple of (str, str, float)
        Filter, sub-array, and factor, for ``DetectorProperties(response=...)``.

    Raises
    ------
    ValueError
        If only one of ``photom`` and ``date`` is given.
    `~miricigale.utils.exceptions.DataError`
        If the file is no such reference, or lacks a filter or sub-array.

    Notes
    -----
    The loss is the conversion on the first day of the coefficients (t0) over that on ``date``; it is as the
    pipeline has it: exponential, linear and power-law tables multiplied. The package has no coefficients of its
    own. F2550W lost about 21 % in the first year, shorter bands less.

    References
    ----------
    Gordon et al. 2025, AJ, 169, 6.

    Examples
    --------
    >>> from miricigale.depth import sensitivity
    >>> from miricigale.instrument import miri_detector
    >>> from miricigale.reduction import imager_response
    >>> response = imager_response("jwst_miri_photom.fits", date="2026-11-26")  # doctest: +SKIP
    >>> detector = miri_detector().replace(response=response)  # doctest: +SKIP
    >>> print(sensitivity("F2550W", detector=detector))  # doctest: +SKIP
    >>> miri_detector().replace(response=imager_response()).relative_response("miri.f770w", "SUB64")
    0.966
    """
    if bool(photom) != bool(date):
        raise argument_error("photom, date", "both given, or neither", f"{photom!r}, {date!r}")
    if not photom:
        return tuple((name, *row) for name in imager_filters() for row in _PARTS.items())
    day, found = Time(date).mjd, []
    for name in imager_filters():
        conversion, times = photom_row(photom, name, "FULL")
        start = min((row["t0"] for row in times.values()), default=day)
        first = on_day(conversion, times, start)
        for part in subarrays():
            found.append((name, part, first / on_day(*photom_row(photom, name, part), day)))
    return tuple(found)
