"""What can be wrong with a measured flux."""

import numpy as np
import scipy.ndimage
import scipy.spatial

from miricigale.utils.tables import Flags

__all__ = ["POOR_CHI2", "ForcedFlags", "unexplained_neighbours"]

#: Template-weighted chi^2 from which a fit is poor, in units of the noise's variance.
POOR_CHI2 = 2.0

#: Least signal-to-noise of light that no template explains, its least share of the model below it and
#: of a neighbour's flux, and its distance to sources in full widths at half maximum: the least to any,
#: and the largest to one that is flagged.
_LEFT_SNR, _LEFT_SHARE, _LEFT_DISTANCE, _LEFT_REACH = 5.0, 0.1, 0.7, 2.0


class ForcedFlags(Flags):
    """
    Flags of forced photometry, added up bit by bit.

    A flux is NaN where ``NO_DATA`` or ``DEGENERATE`` is set, and usable otherwise.
    """

    #: More than a tenth of the template's light falls off the image.
    EDGE = 1
    #: More than a tenth of the template's light falls on masked pixels.
    MASKED = 2
    #: Too little of the template's light falls on usable pixels: not measured.
    NO_DATA = 4
    #: Blending makes the error more than twice that of the source alone.
    BLENDED = 8
    #: The template is the same as another one's: not measured, the other has the light.
    DEGENERATE = 16
    #: The template is a point source because the catalogue position has no segment.
    NO_SEGMENT = 32
    #: The template is a point source because the segment is too noisy.
    NOISY_SEGMENT = 64
    #: The template is a point source because another source owns the segment.
    SHARED_SEGMENT = 128
    #: Residuals below the template are more than noise (chi2 above 2, and above twice the measured noise).
    POOR_FIT = 256
    #: Light that no template explains (5 sigma, a tenth of the flux) is within two widths of the PSF.
    UNEXPLAINED_NEIGHBOUR = 512


def unexplained_neighbours(residual, model, inverse_sigma, width, xy, flux):
    """
    Find sources next to light that is not in the catalogue.

    Parameters
    ----------
    residual, model : `~numpy.ndarray`, shape (ny, nx)
        What the fit left and what it took, light per pixel.
    inverse_sigma : `~numpy.ndarray`, shape (ny, nx)
        Inverse of the noise, zero for pixels that do not count.
    width : float
        Rms width of a Gaussian like the PSF, in pixels.
    xy : `~numpy.ndarray`, shape (n, 2)
        Positions of all sources.
    flux : `~numpy.ndarray`, shape (n,)
        Their fluxes; NaN where not measured.

    Returns
    -------
    found : bool `~numpy.ndarray`, shape (n,)
        Whether a positive peak of the residual is within two full widths at half maximum, and
        as a point source has more than a tenth of the flux.

    Notes
    -----
    Peaks are those of the residual filtered with a Gaussian, above 5 sigma (measured on the filtered
    image itself), above a tenth of the model filtered likewise, and farther than 0.7 full widths at
    half maximum from all sources (nearer ones show in chi2). A peak whose mirror image through the
    nearest source has more than half as much light is that source's own.
    """
    found = np.zeros(len(xy), bool)
    placed = np.flatnonzero(np.isfinite(xy).all(axis=1))
    weight = inverse_sigma**2
    if len(placed) == 0 or not weight.any():
        return found

    def smooth(image, sigma):
        return scipy.ndimage.gaussian_filter(image, sigma, mode="constant")

    # fluxes of point sources by least squares, as if each stood alone
    power = smooth(weight, width / np.sqrt(2)) / (4 * np.pi * width**2)
    usable = power > 0.25 * np.median(power[weight > 0])
    safe = np.where(usable, power, np.inf)
    light = smooth(residual * weight, width) / safe
    snr = light * np.sqrt(power)
    middle = np.median(snr[usable])
    noise = 1.4826 * np.median(np.abs(snr[usable] - middle))
    taken = smooth(model * weight, width) / safe
    size = 2 * int(np.ceil(width)) + 1
    peak = usable & (snr > _LEFT_SNR * noise) & (light > _LEFT_SHARE * taken)
    peak &= snr == scipy.ndimage.maximum_filter(snr, size, mode="constant")
    y, x = np.nonzero(peak)
    full_width = 2.0 * np.sqrt(2.0 * np.log(2.0)) * width
    tree = scipy.spatial.KDTree(xy[placed])
    for one in np.stack([x, y], axis=1):
        distance, nearest = tree.query(one)
        flux_left = light[one[1], one[0]]
        # a template that is too narrow leaves as much on the other side of the source
        i, j = np.rint(2 * xy[placed[nearest]] - one).astype(int)[::-1]
        inside = 0 <= i < light.shape[0] and 0 <= j < light.shape[1]
        if distance < _LEFT_DISTANCE * full_width or (inside and light[i, j] > 0.5 * flux_left):
            continue
        near = placed[tree.query_ball_point(one, _LEFT_REACH * full_width)]
        found[near] |= flux_left > _LEFT_SHARE * flux[near]
    return found
