"""How bright a point source may be: the one that fills a well."""

import astropy.units as u

from miricigale.depth.noise import ExposureNoise
from miricigale.instrument import Exposure
from miricigale.psf import MIRI_PIXEL_SCALE, miri_psf, psf_image
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords


@takes_other_keywords
def saturation_flux(exposure, *, background=None, psf=None, detector=None):
    """
    Return the flux of the point source whose brightest pixel is full at the end of an integration.

    Parameters
    ----------
    exposure : `~miricigale.instrument.Exposure`
        What is exposed.
    background : `~astropy.units.Quantity`, optional
        Surface brightness; the low background of the filter if not given.
    psf : `~photutils.psf.ImagePSF`, optional
        With the pixel in it; `~miricigale.psf.miri_psf` if not given. The source is in the middle of
        a pixel.
    detector : `~miricigale.instrument.DetectorProperties`, optional
        `~miricigale.instrument.miri_detector` if not given.

    Returns
    -------
    flux : `~astropy.units.Quantity`
        In uJy; 0 if the sky alone fills the well.

    Raises
    ------
    ValueError
        If it is no exposure.

    Examples
    --------
    >>> from miricigale.depth import saturation_flux
    >>> from miricigale.instrument import Exposure
    >>> exposure = Exposure("F770W", n_groups=30)
    >>> print(f"{saturation_flux(exposure).to('mJy'):.1f}")
    0.6 mJy
    """
    wanted = "an Exposure, such as Exposure('F770W', n_groups=30)"
    check_that(isinstance(exposure, Exposure), "exposure", wanted, repr(exposure))
    noise = ExposureNoise(
        filter=exposure.filter,
        background=background,
        n_groups=exposure.n_groups,
        group_time=exposure.group_time.to_value(u.s),
        n_ramps=1,
        detector=detector,
        subarray=exposure.subarray,
    )
    if psf is None:
        psf = miri_psf(exposure.filter)
    peak = float(psf_image(psf, pixel_scale=MIRI_PIXEL_SCALE, shape=(3, 3))[1, 1])
    free_rate = noise.detector.full_well / exposure.integration_time.to_value(u.s) - noise.rate
    return max(free_rate, 0.0) / (noise.electrons * peak) * u.uJy
