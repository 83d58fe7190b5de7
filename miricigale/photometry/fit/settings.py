"""Settings of forced photometry: what its errors are made of, and what is kept in memory."""

import dataclasses

from miricigale.utils.options import check_that


@dataclasses.dataclass(frozen=True)
class ErrorSettings:
    """
    What the errors of fluxes are made of.

    Parameters
    ----------
    correlated_noise : bool, optional
        Whether the noise's autocorrelation is measured on source-free pixels and goes into
        the errors; otherwise the image's uncertainty is taken as white noise. With fewer than 400 pixels
        it is what the mosaic states (``meta["noise_correction"]``), if it does.
    size_scatter : float or None, optional
        Templates fitted to the high-resolution image (``"auto"`` and ``"cutout"`` with ``wings``) may
        change as far as their fit leaves them open, and in size by this standard deviation of ln size,
        since galaxies are not of one size in all bands. None takes them without error. Shapes that a
        catalog states always are.
    psf_error : float, optional
        Error of a point source's flux, as a fraction, by that of the image's PSF: about 0.8 of the
        fractional error of its width. By default that of the kernel's encircled energy, for templates
        that are images, and none for the others, which need the kernel's target only.

    Raises
    ------
    ValueError
        If a fraction is not at least 0 and below 1.

    Examples
    --------
    >>> from miricigale.photometry import ErrorSettings
    >>> ErrorSettings(psf_error=0.02)
    ErrorSettings(correlated_noise=True, size_scatter=0.1, psf_error=0.02)
    """

    correlated_noise: bool = True
    size_scatter: float | None = 0.1
    psf_error: float | None = None

    def __post_init__(self):
        for name in ("size_scatter", "psf_error"):
            value = getattr(self, name)
            check_that(value is None or 0 <= value < 1, name, "at least 0 and below 1", value)


@dataclasses.dataclass(frozen=True)
class MemorySettings:
    """
    What is kept in memory during a fit; it changes nothing in the result.

    Parameters
    ----------
    max_bytes : float, optional
        Memory for templates; beyond it they are made anew for each pass.

    Examples
    --------
    >>> from miricigale.photometry import MemorySettings
    >>> MemorySettings(max_bytes=4e9)
    MemorySettings(max_bytes=4000000000.0)
    """

    max_bytes: float = 1.5e9
