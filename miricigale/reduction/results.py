"""What a reduction returns."""

import dataclasses

import numpy as np
from astropy.nddata import CCDData

from miricigale.instrument import ImageFacts
from miricigale.reduction.background import Background

__all__ = ["ReductionResult"]


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
