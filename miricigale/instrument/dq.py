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

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.instrument import DQ
    >>> DQ.names(5)
    ['do_not_use', 'jump_det']
    >>> int(DQ.JUMP_DET)
    4
    >>> flags = np.array([0, 4, 5])
    >>> (flags & int(DQ.DO_NOT_USE)) != 0
    array([False, False,  True])
    """

    GOOD = 0
    DO_NOT_USE = 2**0, "Must not be used."
    SATURATED = 2**1, "Groups from the first saturated one on are left out."
    JUMP_DET = 2**2, "A ramp that is split at one or more jumps."
    DROPOUT = 2**3, "Data lost in transmission."
    OUTLIER = 2**4, "Disagrees with the other dithers."
    PERSISTENCE = 2**5, "High persistence."
    AD_FLOOR = 2**6, "At or below the floor of the A/D converter."
    CHARGELOSS = 2**7, "Charge has migrated to neighbors."
    UNRELIABLE_ERROR = 2**8, "The error may be larger than stated."
    NON_SCIENCE = (
        2**9,
        "Sees no sky: reference pixels, those behind the coronagraph masks, mosaics without data.",
    )
    DEAD = 2**10, "Dead pixel."
    HOT = 2**11, "Hot pixel."
    WARM = 2**12, "Warm pixel."
    LOW_QE = 2**13, "Low quantum efficiency."
    RC = 2**14, "RC pixel: the signal decays between reads."
    TELEGRAPH = 2**15, "Telegraph pixel: the signal jumps between two levels."
    NONLINEAR = 2**16, "Highly non-linear pixel."
    BAD_REF_PIXEL = 2**17, "Reference pixel that cannot be used."
    NO_FLAT_FIELD = 2**18, "Flat field is not known."
    NO_GAIN_VALUE = 2**19, "Gain is not known."
    NO_LIN_CORR = 2**20, "Linearity correction is not available."
    NO_SAT_CHECK = 2**21, "Saturation level is not known."
    UNRELIABLE_BIAS = 2**22, "Large variance of the bias."
    UNRELIABLE_DARK = 2**23, "Large variance of the dark current."
    UNRELIABLE_SLOPE = 2**24, "Large variance of the slope."
    UNRELIABLE_FLAT = 2**25, "Large variance of the flat field."
    OPEN = 2**26, "Open pixel: its charge goes to its neighbors."
    ADJ_OPEN = 2**27, "Next to an open pixel."
    FLUX_ESTIMATED = 2**28, "Flux estimated because data are missing or bad."
    MSA_FAILED_OPEN = 2**29, "Light from a shutter of NIRSpec that failed open."
    OTHER_BAD_PIXEL = 2**30, "Any other bad pixel."
    REFERENCE_PIXEL = 2**31, "Reference pixel."
    JUMP_NEIGHBOR = 2**32, "Split where a neighbor had a large jump."
    NO_SLOPE = 2**33, "No slope: saturated from the start, or not fitted."
    NEGATIVE = 2**35, "Far below the background."


def dq_legend():
    """
    Return header cards with the meaning of the bits of a plane.

    Returns
    -------
    header : `~astropy.io.fits.Header`
        ``DQSCHEME`` = ``'JWST'``, and the name of each bit n in ``DQBITn``.

    Examples
    --------
    >>> from miricigale.instrument import dq_legend
    >>> header = dq_legend()
    >>> header["DQBIT2"]
    'JUMP_DET'
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

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.instrument import DQ, dq_planes
    >>> flags = np.array([[0, int(DQ.JUMP_DET | DQ.JUMP_NEIGHBOR)]])
    >>> [(name, plane.tolist()) for name, plane, header in dq_planes(flags)]
    [('DQ', [[0, 4]]), ('DQ_OWN', [[0, 1]])]
    """
    from astropy.io import fits

    flags = np.asarray(flags).astype(np.int64)
    yield "DQ", (flags & 0xFFFFFFFF).astype(np.uint32), dq_legend()
    if np.any(flags >> 32):
        header = fits.Header([("DQSHIFT", 32, "bit n of this plane is bit n + 32 of the legend")])
        yield "DQ_OWN", (flags >> 32).astype(np.uint8), header


def with_own_bits(flags, hdus):
    """
    Return the flags of a plane DQ with the bits above 31 that a file has in ``DQ_OWN``.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.io import fits
    >>> from miricigale.instrument import DQ, dq_planes, with_own_bits
    >>> flags = np.array([[int(DQ.JUMP_DET | DQ.JUMP_NEIGHBOR)]])
    >>> hdus = [fits.PrimaryHDU()]
    >>> hdus += [
    ...     fits.ImageHDU(plane, header, name=name)
    ...     for name, plane, header in dq_planes(flags)
    ... ]
    >>> joined = with_own_bits(hdus[1].data.astype(np.int64), fits.HDUList(hdus))
    >>> DQ.names(int(joined[0, 0]))
    ['jump_det', 'jump_neighbor']
    """
    if "DQ_OWN" not in hdus:
        return flags
    return flags | (np.asarray(hdus["DQ_OWN"].data).astype(np.int64) << 32)


def read_dq(hdu):
    """
    Read a plane of flags that this package wrote.

    Parameters
    ----------
    hdu : `~astropy.io.fits.ImageHDU`
        With the cards of `dq_legend`.

    Returns
    -------
    flags : `~numpy.ndarray` of int64
        Bits as in `DQ`.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If it has no legend, or another one.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.io import fits
    >>> from miricigale.instrument import DQ, dq_planes, read_dq
    >>> name, plane, header = next(
    ...     dq_planes(np.array([[0, int(DQ.DO_NOT_USE | DQ.HOT)]]))
    ... )
    >>> flags = read_dq(fits.ImageHDU(plane, header, name=name))
    >>> DQ.names(int(flags[0, 1]))
    ['do_not_use', 'hot']
    """
    scheme = hdu.header.get("DQSCHEME")
    if scheme != "JWST":
        msg = f"extension {hdu.name} holds flags of another kind (DQSCHEME {scheme})"
        raise DataError(msg)
    return np.asarray(hdu.data).astype(np.int64)
