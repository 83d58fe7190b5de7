"""What a reduction returns."""

import dataclasses

import numpy as np
from astropy.io.fits import Header
from astropy.nddata import CCDData

from miricigale.detector import Ramp
from miricigale.detector.level1b import keywords
from miricigale.instrument import Image, ImageFacts, kept_keywords
from miricigale.reduction.images.files import ImageFile
from miricigale.reduction.images.image_writer import write_image
from miricigale.reduction.images.images import exposure_values, flagged_image
from miricigale.reduction.ramps.slopes import shares_charge
from miricigale.reduction.references.detector_model import history_of
from miricigale.reduction.sky.background import Background
from miricigale.utils.interactive import Interactive
from miricigale.utils.meta import provenance
from miricigale.utils.units import RATE
from miricigale.utils.values import value_class


@value_class
class ReductionResult(Interactive):
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
    subtracted : `~numpy.ndarray`
        On the mosaic, all that was subtracted from it and from the exposures: the plane BKG.
    notes : tuple of str
        What could not be done.
    variances : dict of str to `~numpy.ndarray`
        Parts of the variance of the mosaic, as of `Mosaic`, where they are known of each exposure.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale import Detector, Exposure, Reducer
    >>> from miricigale.scene import Scene
    >>> first = Exposure("F770W", n_groups=20, subarray="SUB64", pointing="53 -27")
    >>> star = {"id": [1], "ra": [53], "dec": [-27], "profile": ["point"]}
    >>> star["F770W"] = [500] * u.uJy
    >>> def exposed(exposure):
    ...     scene = Scene(star, exposure, background="low")
    ...     return Detector.miri_imager().collect(scene, seed=1)
    >>> result = Reducer().run(
    ...     [exposed(dither) for dither in first.dithered("ceers", 3)]
    ... )
    >>> result
    <ReductionResult miri.f770w: 3 dithers, mosaic 96 x 121>
    >>> path = result.write("mosaic.fits")  # doctest: +SKIP
    """

    _parts = ("mosaic",)

    rates: tuple
    images: tuple
    backgrounds: tuple
    mosaic: CCDData
    weight: np.ndarray
    n_images: np.ndarray
    mosaic_background: Background
    subtracted: np.ndarray
    notes: tuple = ()
    variances: dict = dataclasses.field(default_factory=dict)

    @property
    def filter(self):
        """Name of the filter."""
        return ImageFacts.of(self.mosaic).filter

    def __repr__(self):
        ny, nx = self.mosaic.shape
        return f"<ReductionResult {self.filter}: {len(self.images)} dithers, mosaic {ny} x {nx}>"

    def _facts(self):
        levels = [f"{background.level.mean():.4g}" for background in self.backgrounds]
        return {
            "filter": self.filter,
            "dithers": len(self.images),
            "mosaic": f"{self.mosaic.shape} pixels, {self.mosaic.unit}",
            "backgrounds": f"{', '.join(levels)} MJy/sr",
            "notes": "; ".join(self.notes) or "none",
        }

    def plot(self, ax=None, **kwargs):
        """Draw the mosaic, as `~miricigale.instrument.Image.plot`."""
        return self.mosaic.plot(ax=ax, **kwargs)

    def write(self, path, *, overwrite=False):
        """
        Write the mosaic with its planes ERR, DQ, WHT, CON (number of exposures) and BKG, and its variances.

        Parameters
        ----------
        path : path-like
            A FITS file.
        overwrite : bool, optional
            Whether a file of that name is replaced.

        Returns
        -------
        path : `pathlib.Path`

        Raises
        ------
        OSError
            If the file exists and ``overwrite`` is False.
        """
        mosaic = Image(self.mosaic, copy=False)
        mosaic.meta = {**self.mosaic.meta, "notes": list(self.notes)}
        planes = {"WHT": self.weight, "CON": self.n_images, "BKG": self.subtracted}
        planes |= self.variances
        return write_image(mosaic, path, planes=planes, overwrite=overwrite)


def rate_image(reducer, ramp, maps, fit):
    """
    Return the slopes of a ramp as an image.

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
    corrected = ipc and reducer.backend == "native"
    meta = provenance(
        **exposure_values(ramp.exposure),
        n_jumps=len(fit.jumps),
        settling_groups=fit.settling,
        ipc=ipc,
        noise_correction=fit.noise_correction(reducer.detector.ipc_kernel) if corrected else 1.0,
        **history_of(reducer, ramp, maps).meta(),
    )
    if None not in (ramp.exposure.filter, ramp.exposure.pointing) or ramp.observed:
        is_ramp = isinstance(ramp, Ramp)
        meta["keywords"] = kept_keywords(ramp.header if is_ramp else keywords(ramp.exposure))
    rate = flagged_image(
        fit.rate, RATE, error=fit.error, flags=fit.flags, wcs=ramp.exposure.wcs, meta=meta
    )
    planes = {"VAR_POISSON": fit.var_poisson, "VAR_RNOISE": fit.var_read}
    return ImageFile(rate, planes, Header())
