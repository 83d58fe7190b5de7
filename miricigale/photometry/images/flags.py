"""What can be wrong with a measured flux."""

from miricigale.utils.tables import Flags

#: Template-weighted chi^2 from which a fit is poor, in units of the noise's variance.
POOR_CHI2 = 2.0

#: Chi^2 by their priors of a template's changes from which a fit is poor (3.5 standard deviations).
POOR_STRAIN = 12.0


class ForcedFlags(Flags):
    """
    Flags of forced photometry, added up bit by bit.

    A flux is NaN where ``NO_DATA`` or ``DEGENERATE`` is set, and usable otherwise.

    Examples
    --------
    >>> from miricigale.photometry import ForcedFlags
    >>> ForcedFlags.names(96)
    ['no_segment', 'noisy_segment']
    >>> print(ForcedFlags.POOR_FIT.value, ForcedFlags.meanings()[1])
    256 ('edge', "More than a tenth of the template's light falls off the image or its footprint, or on its rim.")
    """

    EDGE = (
        1,
        "More than a tenth of the template's light falls off the image or its footprint, or on its rim.",
    )
    MASKED = 2, "More than a tenth of the template's light falls on masked pixels."
    NO_DATA = 4, "Too little of the template's light falls on usable pixels: not measured."
    BLENDED = 8, "Blending makes the error more than twice that of the source alone."
    DEGENERATE = (
        16,
        "The template is the same as another one's: not measured, the other has the light.",
    )
    NO_SEGMENT = 32, "The template is a point source because the catalog position has no segment."
    NOISY_SEGMENT = 64, "The template is a point source because the segment is too noisy."
    SHARED_SEGMENT = 128, "The template is a point source because another source owns the segment."
    POOR_FIT = (
        256,
        (
            "Residuals below the template are more than noise and resampling (chi2 above 2, and above "
            "twice the measured noise), or the template had to change by far more than the high-resolution "
            "image leaves open."
        ),
    )
    UNEXPLAINED_NEIGHBOR = (
        512,
        (
            "Light that no template explains (5 sigma, a tenth of the flux) is within two widths "
            "of the PSF."
        ),
    )
    ONE_COMPONENT = (
        1024,
        (
            "The point on the template cannot be distinguished from it, or the template was not "
            "measured: one flux only."
        ),
    )
    NOT_IN_CATALOG = 2048, "Not in the catalog: found on the residual of a first fit."
    SATURATED = (
        4096,
        (
            "The core is saturated on the high-resolution image (a hole without data, or a flat "
            "top): it is masked there, and the template follows from what is around it."
        ),
    )
    CUT = (
        8192,
        (
            "The segment reaches beyond the patch of a large mosaic: what it has there is not in "
            "the template."
        ),
    )
    SHREDDED = (
        16384,
        (
            "The segment is a piece of a larger galaxy: the template is the light of the segment and the "
            "part of the galaxy's wings that is nearest to it. The sum of the pieces is the galaxy."
        ),
    )
    CANCELING = (
        32768,
        (
            "Templates cancel: the flux is above twice the image's light below its template by 3 sigma, "
            "or negative by 5."
        ),
    )
