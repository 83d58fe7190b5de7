"""Bits of masks in the files of different telescopes: which pixels are not to be used."""

import numpy as np

from miricigale.instrument.dq import DQ
from miricigale.instrument.keywords import keyword_text
from miricigale.utils.exceptions import PhotometryWarning, warn

#: Instruments of JWST, of which cut-outs often lost TELESCOP.
_JWST_INSTRUMENTS = ("MIRI", "NIRCAM", "NIRISS", "NIRSPEC", "FGS")
#: Bits of HST's masks with which a pixel is still used, as AstroDrizzle's pipeline settings have them: stable
#: warm pixels (64), CTE tails (32), and the blobs of WFC3/IR (512). WFC3 Data Handbook, table 3.3; ACS Data
#: Handbook, table 3.4.
_HST_HARMLESS = {
    ("ACS", "WFC"): 32 | 64,
    ("WFC3", "UVIS"): 32 | 64,
    ("WFC3", "IR"): 64 | 512,
}
#: Planes of masks of the LSST pipelines (LSST, HSC) whose pixels are not to be used; others, such as DETECTED,
#: say what a pixel shows. Bosch et al. 2018, PASJ 70, S5, table 2.
_BAD_PLANES = ("BAD", "SAT", "CR", "EDGE", "NO_DATA", "SUSPECT", "UNMASKEDNAN")
_PLANE = "MP_"


def bad_pixels(values, header, get, path):
    """
    Return the pixels of a mask that are not to be used.

    Parameters
    ----------
    values : `~numpy.ndarray`
        Bits of each pixel.
    header : `~astropy.io.fits.Header`
        Of the extension with the mask.
    get : callable
        Value of a keyword in the header of the image or the primary header, or None.
    path : str
        File and extension, for messages.

    Returns
    -------
    bad : bool `~numpy.ndarray`
        By the planes that ``MP_`` cards name (LSST, HSC); by DO_NOT_USE for JWST; by the bits of HST, of which
        some are harmless; else where the mask is not 0.
    scheme : str
        How the bits were read.

    Warns
    -----
    `~miricigale.utils.exceptions.PhotometryWarning`
        If more than one bit is set and nothing says what the bits mean.
    """
    values = np.nan_to_num(np.asarray(values), nan=1.0).astype(np.int64)
    planes = {}
    for key in header:
        if str(key).startswith(_PLANE) and isinstance(header[key], int):
            planes[str(key).removeprefix(_PLANE)] = int(header[key])
    if planes:
        names = [name for name in _BAD_PLANES if name in planes]
        bits = sum(1 << planes[name] for name in names)
        return values & bits != 0, f"planes {', '.join(names)}"
    telescope = keyword_text(get, "TELESCOP")
    instrument = keyword_text(get, "INSTRUME")
    scheme_name = keyword_text(header.get, "DQSCHEME")
    if "JWST" in (telescope, scheme_name) or (not telescope and instrument in _JWST_INSTRUMENTS):
        return values & int(DQ.DO_NOT_USE) != 0, "bit DO_NOT_USE of JWST"
    if telescope == "HST":
        detector = keyword_text(get, "DETECTOR")
        if instrument == "WFC3" and not detector:
            # filters of the two channels have other names: F160W, F606W
            is_infrared = keyword_text(get, "FILTER").startswith(("F0", "F1", "G1"))
            detector = "UVIS"
            if is_infrared:
                detector = "IR"
        harmless = _HST_HARMLESS.get((instrument, detector), 0)
        return values & ~harmless != 0, f"bits of HST {instrument} without {harmless}"
    bad = values != 0
    if np.any(values[bad] & (values[bad] - 1)) or np.unique(values[bad]).size > 1:
        part = np.mean(bad)
        warn(
            f"{path} has bits of which nothing says what they mean (TELESCOP {telescope or 'missing'!s}, no "
            f"MP_ cards): every pixel that is not 0 is taken as bad, {part:.2%} of them",
            PhotometryWarning,
        )
    return bad, "not 0"
