"""Forced photometry as Yang et al. 2021 did it, to show what the package's own method gains."""

import dataclasses

import astropy.units as u
import numpy as np
from astropy.wcs.utils import pixel_to_pixel

from miricigale.photometry.fit.corrections import aperture_correction
from miricigale.photometry.fit.forced import ForcedPhotometer
from miricigale.photometry.fit.settings import ErrorSettings
from miricigale.photometry.templates.sources import SourceTemplates
from miricigale.psf import MatchingKernel
from miricigale.utils.exceptions import argument_error
from miricigale.utils.options import check_that

#: The grid of images and templates, and the width of the PSF stamps.
_PIXEL = 0.06 * u.arcsec
_STAMP = 3.0 * u.arcsec


class Yang2021Photometer:
    """
    Measure sources with T-PHOT's templates, the paper's kernels and its two corrections.

    Parameters
    ----------
    source, target : `~photutils.psf.ImagePSF`
        PSF of the high-resolution image, and of the mosaic that is measured. Both must state what
        fraction of all light they hold (as those of the package do), and be in the frame of the sky
        (`~miricigale.psf.rotate_psf`).
    scaling : float, optional
        The paper's f_scaling, by which the image is multiplied before it is measured: of
        `~miricigale.photometry.flux_scaling` on bright point sources.
    n_threads : int, optional
        Number of threads; by default one for each processor.

    Attributes
    ----------
    kernel : `~miricigale.psf.MatchingKernel`
        Between the two PSFs cut to 3 x 3 arcsec and normalized, with mu = 0.03 on 0.06 arcsec.
    scaling : float
        As given.
    aperture : float
        The paper's f_aper, by which fluxes are multiplied: 1 / (light of the target within 1.5 arcsec).

    Raises
    ------
    ValueError
        If the scaling is not positive, or the target holds less than 1.5 arcsec.

    Notes
    -----
    What differs from `~miricigale.photometry.ForcedPhotometer` with its own settings: templates are the
    bare segments, without the light outside of them, whatever their signal-to-noise (sources whose segment has
    no positive light are points); the noise of the high-resolution image and errors of the PSF count
    nowhere; kernels are as above; the image is on pixels of 0.06 arcsec, on which the noise is
    correlated, and errors take it as white. No background is fitted: the light of bright sources beyond the
    stamps is left in the image, which a warning may take for one. The equations are those of the package (all
    sources at once), not T-PHOT's cells; T-PHOT's second pass, in which kernels are shifted locally, is not here.

    References
    ----------
    Yang et al. 2021, ApJ 908, 144, sections 3.2 to 3.4; Merlin et al. 2015, A&A 582, A15 (T-PHOT).

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.photometry import Yang2021Photometer
    >>> from miricigale.psf import gaussian_psf
    >>> form = {"pixel_scale": 0.06 * u.arcsec, "fov": 4 * u.arcsec}
    >>> sharp, wide = (gaussian_psf(width * u.arcsec, **form) for width in (0.2, 1.6))
    >>> paper = Yang2021Photometer(sharp, wide, scaling=0.99)
    >>> print(f"f_aper = {paper.aperture:.3f}, kernel of sum {paper.kernel.array.sum():.2f}")
    f_aper = 1.096, kernel of sum 1.00
    """

    def __init__(self, source, target, *, scaling=1.0, n_threads=None):
        check_that(np.isfinite(scaling) and scaling > 0, "scaling", "positive", scaling)
        self.kernel = MatchingKernel.from_psfs(
            source,
            target,
            pixel_scale=_PIXEL,
            regularization="yang2021",
            extent=_STAMP,
            normalize=True,
        )
        self.scaling = float(scaling)
        self.aperture = aperture_correction(target, _STAMP / 2)
        self._photometer = ForcedPhotometer(
            self.kernel,
            # errors are those of the image's noise alone
            errors=ErrorSettings(correlated_noise=False, size_scatter=None, psf_error=0.0),
            n_threads=n_threads,
        )
        self._n_threads = n_threads

    def __repr__(self):
        factors = f"scaling={self.scaling:.4f}, aperture={self.aperture:.4f}"
        return f"<Yang2021Photometer {factors}, {self.kernel!r}>"

    def measure(self, image, highres, segmentation, catalog):
        """
        Measure all sources of a catalog.

        Parameters
        ----------
        image : `~astropy.nddata.CCDData`
            The mosaic, background subtracted, on the pixels of ``highres``.
        highres, segmentation, catalog
            As of `ForcedPhotometer.measure`.

        Returns
        -------
        result : `ForcedPhotometryResult`
            Fluxes and errors are total ones, after both corrections. Its images are those of the
            scaled mosaic.

        Raises
        ------
        ValueError
            If the image is not on the pixels of ``highres`` (of the same or another extent).
        """
        _require_same_pixels(image, highres)
        templates = SourceTemplates.from_images(
            highres,
            segmentation,
            catalog,
            psf=self.kernel.source,
            template="cutout",
            wings=False,
            n_threads=self._n_threads,
        )
        # T-PHOT takes templates as they are: nothing is taken off for their noise
        light = [None] * len(templates)
        for k, cutout in enumerate(templates.light):
            if cutout is not None:
                light[k] = dataclasses.replace(cutout, noise=0.0)
        templates = dataclasses.replace(templates, light=light)
        scaled = image.multiply(self.scaling, handle_meta="first_found")
        result = self._photometer.measure(scaled, templates=templates)
        # no components, no fluxes that must be positive
        names = ("flux", "flux_err", "flux_err_noise", "flux_err_template", "flux_err_psf")
        totals = {name: getattr(result, name) * self.aperture for name in names}
        totals["covariance"] = result.covariance * self.aperture**2
        meta = {"method": "yang2021", "f_scaling": self.scaling, "f_aper": self.aperture}
        return dataclasses.replace(result, **totals, meta=result.meta | meta)


def _require_same_pixels(image, highres):
    """Check that pixels of two images coincide, up to a whole number of them."""
    ny, nx = image.shape
    x = np.array([0.0, nx - 1.0, 0.0])
    y = np.array([0.0, 0.0, ny - 1.0])
    # three corners fix a linear map
    offsets = np.stack(pixel_to_pixel(image.wcs, highres.wcs, x, y)) - [x, y]
    whole_pixels = np.rint(offsets[:, :1])
    if not np.all(np.abs(offsets - whole_pixels) < 0.02):
        wanted = "on the pixels of 'highres', up to a shift of whole ones"
        raise argument_error("image", wanted, f"offsets of {np.round(offsets, 2).tolist()} pixels")
