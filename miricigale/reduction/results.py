"""What a reduction returns."""

import dataclasses

import numpy as np
from astropy.io.fits import Header
from astropy.nddata import CCDData

from miricigale.instrument import ImageFacts
from miricigale.reduction.assumed import history_of
from miricigale.reduction.background import Background
from miricigale.reduction.files import ImageFile
from miricigale.reduction.images import exposure_values, image
from miricigale.reduction.slopes import shares_charge
from miricigale.utils.meta import provenance
from miricigale.utils.units import RATE


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class ReductionResult:
    """
    What the reduction of one filter's dithers gave.

    Parameters
    ----------
    rates : tuple of `~astropy.nddata.CCDData`
        Slopes, DN/s; of the exposures that were not calibrated before.
    images : tuple of `~astropy.nddata.CCDData`
        Calibrated, background subtracted, outliers masked; MJy/sr.
    backgrounds : tuple of `Background`
        What was subtracted from each.
    mosaic : `~astropy.nddata.CCDData`
        MJy/sr.
    weight : `~numpy.ndarray`, shape (ny, nx)
        Weight (inverse variance) of the mosaic.
    n_images : `~numpy.ndarray`, shape (ny, nx)
        Number of dithers at each pixel of the mosaic.
    mosaic_background : `Background`
        What was subtracted from the mosaic in the second pass.
    notes : tuple of str
        What could not be done.
    """

    rates: tuple
    images: tuple
    backgrounds: tuple
    mosaic: CCDData
    weight: np.ndarray
    n_images: np.ndarray
    mosaic_background: Background
    notes: tuple = ()

    @property
    def filter(self):
        """Name of the filter."""
        return ImageFacts.of(self.mosaic).filter

    def __repr__(self):
        ny, nx = self.mosaic.shape
        return f"<ReductionResult {self.filter}: {len(self.images)} dithers, mosaic {ny} x {nx}>"


def rate_image(reducer, ramp, maps, fit):
    """
    The slopes of a ramp as an image.

    Parameters
    ----------
    reducer : `~miricigale.reduction.Reducer`
        Settings.
    ramp : `~miricigale.detector.Ramp` or `~miricigale.detector.Charge`
        What was fitted.
    maps : `~miricigale.reduction.DetectorMaps`
        What the detector was taken for.
    fit : `~miricigale.reduction.RampFit`
        The slopes.

    Returns
    -------
    rate : `~miricigale.reduction.ImageFile`
        In DN/s, with the planes of the variances.
    """
    ipc = shares_charge(reducer, ramp)
    # errors of the pipeline are those of pixels that share nothing
    own = ipc and reducer.backend == "native"
    meta = provenance(
        **exposure_values(ramp.exposure),
        n_jumps=len(fit.jumps),
        ipc=ipc,
        noise_correction=fit.noise_correction(reducer.detector.ipc_kernel) if own else 1.0,
        gain=float(np.median(maps.gain)),
        **history_of(reducer, ramp, maps),
    )
    rate = image(fit.rate, RATE, error=fit.error, flags=fit.flags, wcs=ramp.exposure.wcs, meta=meta)
    planes = {"VAR_POISSON": fit.var_poisson, "VAR_RNOISE": fit.var_read}
    return ImageFile(rate, planes, Header())
