"""Data-quality bits, with the values that JWST gives them, and their legend in files."""

import numpy as np

from miricigale.utils.exceptions import DataError
from miricigale.utils.tables import Flags


class DQ(Flags):
    """
    Why a pixel is not used, or is worse than its neighbors.

    The lower 32 bits are those of JWST, all of which have a meaning there; conditions that JWST
    does not distinguish have the bits above them. Flags of images are int64; ``pixel_dq`` of
    ramps (uint32) and ``group_dq`` (uint8) hold the lower bits. A pixel of an image is masked
    where DO_NOT_USE is set; the other bits say why, or that a slope stands on fewer groups.

    References
    ----------
    JWST pipeline documentation, data quality flags (``stdatamodels.jwst.datamodels.dqflags``).
    """

    GOOD = 0
    DO_NOT_USE = 2**0
    #: Groups from the first saturated one on are left out.
    SATURATED = 2**1
    #: A ramp that is split at one or more jumps.
    JUMP_DET = 2**2
    DROPOUT = 2**3
    #: Disagrees with the other dithers.
    OUTLIER = 2**4
    PERSISTENCE = 2**5
    AD_FLOOR = 2**6
    CHARGELOSS = 2**7
    UNRELIABLE_ERROR = 2**8
    #: Sees no sky: reference pixels, those behind the coronagraph masks, mosaics without data.
    NON_SCIENCE = 2**9
    DEAD = 2**10
    HOT = 2**11
    WARM = 2**12
    LOW_QE = 2**13
    RC = 2**14
    TELEGRAPH = 2**15
    NONLINEAR = 2**16
    BAD_REF_PIXEL = 2**17
    NO_FLAT_FIELD = 2**18
    NO_GAIN_VALUE = 2**19
    NO_LIN_CORR = 2**20
    NO_SAT_CHECK = 2**21
    UNRELIABLE_BIAS = 2**22
    UNRELIABLE_DARK = 2**23
    UNRELIABLE_SLOPE = 2**24
    UNRELIABLE_FLAT = 2**25
    OPEN = 2**26
    ADJ_OPEN = 2**27
    FLUX_ESTIMATED = 2**28
    MSA_FAILED_OPEN = 2**29
    OTHER_BAD_PIXEL = 2**30
    REFERENCE_PIXEL = 2**31
    #: Split where a neighbor had a large jump.
    JUMP_NEIGHBOR = 2**32
    #: No slope: saturated from the start, or not fitted.
    NO_SLOPE = 2**33
    #: Cosmic ray found on the slope image.
    COSMIC_RAY = 2**34
    #: Far below the background.
    NEGATIVE = 2**35


#: What the bits of planes without a legend mean, lowest first: files of earlier versions.
_WITHOUT_LEGEND = (
    DQ.DO_NOT_USE,
    DQ.REFERENCE_PIXEL | DQ.NON_SCIENCE | DQ.DO_NOT_USE,
    DQ.SATURATED,
    DQ.SATURATED | DQ.NO_SLOPE | DQ.DO_NOT_USE,
    DQ.JUMP_DET,
    DQ.JUMP_DET | DQ.JUMP_NEIGHBOR,
    DQ.NO_SLOPE | DQ.DO_NOT_USE,
    DQ.NON_SCIENCE | DQ.DO_NOT_USE,
    DQ.COSMIC_RAY | DQ.DO_NOT_USE,
    DQ.NEGATIVE | DQ.DO_NOT_USE,
    DQ.OUTLIER | DQ.DO_NOT_USE,
    DQ.NON_SCIENCE | DQ.DO_NOT_USE,
)


def dq_legend():
    """
    Return header cards with the meaning of the bits of a plane.

    Returns
    -------
    header : `~astropy.io.fits.Header`
        ``DQSCHEME`` = ``'JWST'``, and the name of each bit n in ``DQBITn``.
    """
    from astropy.io import fits

    header = fits.Header()
    header["DQSCHEME"] = ("JWST", "values of the bits; above 31 our own")
    for flag in DQ:
        if flag:
            header[f"DQBIT{flag.value.bit_length() - 1}"] = flag.name
    return header


def dq_planes(flags):
    """
    Split flags into the planes that files hold.

    Parameters
    ----------
    flags : `~numpy.ndarray` of int64
        Bits as in `DQ`.

    Yields
    ------
    name : str
        ``DQ``, the 32 bits that JWST has; then ``DQ_OWN``, those above, if any is set.
    plane : `~numpy.ndarray` of uint32 or uint8
    header : `~astropy.io.fits.Header`
    """
    from astropy.io import fits

    flags = np.asarray(flags).astype(np.int64)
    yield "DQ", (flags & 0xFFFFFFFF).astype(np.uint32), dq_legend()
    if np.any(flags >> 32):
        header = fits.Header([("DQSHIFT", 32, "bit n of this plane is bit n + 32 of the legend")])
        yield "DQ_OWN", (flags >> 32).astype(np.uint8), header


def with_own_bits(flags, hdus):
    """Flags of a plane DQ with the bits above 31 that a file has in ``DQ_OWN``."""
    if "DQ_OWN" not in hdus:
        return flags
    return flags | (np.asarray(hdus["DQ_OWN"].data).astype(np.int64) << 32)


def read_dq(hdu):
    """
    Read a plane of flags that this package wrote.

    Parameters
    ----------
    hdu : `~astropy.io.fits.ImageHDU`
        With the cards of `dq_legend`. A plane without them is one of an earlier version, whose
        bits had other values: they are translated.

    Returns
    -------
    flags : `~numpy.ndarray` of int64
        Bits as in `DQ`.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the legend is another one, or there is none and bits are set that earlier versions
        did not have.
    """
    flags = np.asarray(hdu.data).astype(np.int64)
    scheme = hdu.header.get("DQSCHEME")
    if scheme == "JWST":
        return flags
    if scheme is not None or np.any(flags >> len(_WITHOUT_LEGEND)):
        msg = f"extension {hdu.name} holds flags of another kind (DQSCHEME {scheme})"
        raise DataError(msg)
    out = np.zeros_like(flags)
    for bit, meaning in enumerate(_WITHOUT_LEGEND):
        out[(flags >> bit) & 1 != 0] |= int(meaning)
    return out
