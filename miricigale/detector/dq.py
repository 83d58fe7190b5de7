"""Data-quality bits, with the values that JWST gives them."""

from miricigale.utils.tables import Flags

__all__ = ["DQ"]


class DQ(Flags):
    """
    Bits of ``pixel_dq`` (uint32) and, the lower eight, of ``group_dq`` (uint8).

    References
    ----------
    JWST User Documentation, data quality flags (``stdatamodels.jwst.datamodels.dqflags``).
    """

    GOOD = 0
    DO_NOT_USE = 1
    SATURATED = 2
    JUMP_DET = 4
    DROPOUT = 8
    PERSISTENCE = 32
    AD_FLOOR = 64
    NON_SCIENCE = 512
    DEAD = 1024
    HOT = 2048
    REFERENCE_PIXEL = 2**31
