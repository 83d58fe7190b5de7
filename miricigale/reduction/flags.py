"""Why a pixel of a reduced image is masked or worse than its neighbours."""

from miricigale.utils.tables import Flags

__all__ = ["MASKED", "PixelFlags"]


class PixelFlags(Flags):
    """
    Bits of the ``flags`` plane (uint32) of reduced images.

    SATURATED, JUMP and JUMP_NEIGHBOUR say that a slope stands on fewer groups; all others
    say why a pixel is masked.
    """

    GOOD = 0
    #: Does not work, by the ramp's own flags.
    BAD_PIXEL = 1
    #: Sees no light.
    REFERENCE = 2
    #: Groups from the first saturated one on are left out.
    SATURATED = 4
    #: Saturated so early that no difference of groups is left.
    FULLY_SATURATED = 8
    #: Split at one or more jumps.
    JUMP = 16
    #: Split where a neighbour had a large jump.
    JUMP_NEIGHBOUR = 32
    #: No slope, for whatever reason.
    NO_SLOPE = 64
    #: Behind the coronagraph masks.
    OUTSIDE_FIELD = 128
    #: Cosmic ray found on the slope image.
    COSMIC_RAY = 256
    #: Far below the background.
    NEGATIVE = 512
    #: Disagrees with the other dithers.
    OUTLIER = 1024
    #: Nothing was exposed here (mosaics).
    NO_DATA = 2048


#: Flags of pixels that are masked.
MASKED = (
    PixelFlags.BAD_PIXEL
    | PixelFlags.REFERENCE
    | PixelFlags.FULLY_SATURATED
    | PixelFlags.NO_SLOPE
    | PixelFlags.OUTSIDE_FIELD
    | PixelFlags.COSMIC_RAY
    | PixelFlags.NEGATIVE
    | PixelFlags.OUTLIER
    | PixelFlags.NO_DATA
)
