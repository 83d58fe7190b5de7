"""Kernels that bring an image to the resolution of another."""

import dataclasses
import functools
from typing import ClassVar

import astropy.units as u
import numpy as np
from astropy.nddata import CCDData
from scipy.signal import fftconvolve

from miricigale.instrument.image import Image
from miricigale.psf.kernel_arrays import blended, convolved
from miricigale.psf.kernel_inputs import named_psf, psf_pair, ready_arrays
from miricigale.psf.model import instrument_psf
from miricigale.psf.wiener import checked_square, choose, energy_error, energy_radii, wiener
from miricigale.utils.exceptions import argument_error
from miricigale.utils.file_formats import read_write
from miricigale.utils.interactive import Interactive
from miricigale.utils.missing_values import floats
from miricigale.utils.options import check_choice, check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.units import ANGLE, frozen_array, positive, scalar, to_array
from miricigale.utils.values import value_class


@value_class
class MatchingKernel(Interactive):
    """
    A convolution kernel from a sharp PSF to a wide one.

    The sharp PSF is taken as the image of unit flux, so that a template of unit sum
    turns into what the wide image shows of a source of unit flux: the kernel's sum is
    the fraction of light that the wide PSF's grid holds, a little below 1, where that is known
    and 1 where it is not (see ``normalize`` in `from_psfs`).

    ``read`` also takes an image in any FITS file that is a kernel, by its extension ``ext`` (int or str), the
    ``plane`` of a cube (int), ``pixel_scale`` where the header does not state it, and ``source`` as for
    `from_array`.

    Parameters
    ----------
    array : `~numpy.ndarray`, shape (n, n), n odd
        The kernel.
    pixel_scale : `~astropy.units.Quantity`
        Pixel of the images that it is for.
    source, target : `~numpy.ndarray`, optional
        The two PSFs on the same pixels.
    regularization : float, optional
        Wiener parameter with which it was made; NaN if unknown.
    meta : dict, optional
        What else is known of it.

    Raises
    ------
    ValueError
        If an array is not square, odd and finite.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.psf import MatchingKernel, gaussian_psf
    >>> form = {"pixel_scale": 0.06 * u.arcsec, "fov": 3 * u.arcsec}
    >>> sharp, wide = (gaussian_psf(width * u.arcsec, **form) for width in (0.2, 0.5))
    >>> kernel = MatchingKernel.from_psfs(sharp, wide)
    >>> print(f"noise gain {kernel.noise_gain:.3f}, error {kernel.meta['max_error']:.4f}")
    noise gain 0.087, error 0.0007
    """

    io_module: ClassVar[str] = "miricigale.psf.kernel_io"
    read, write = read_write(
        "a kernel and its PSFs",
        """ext : int or str, optional
        Extension of a kernel that others made; ``file.fits[EXTENSION]`` names it as well.
    plane : int or "mean", optional
        Plane of a cube of kernels, or the mean of all.
    pixel_scale : `~astropy.units.Quantity`, optional
        Pixel of the image that the kernel is for. Needed where the header does not state it; one that it
        states must be the same.
    source : `~photutils.psf.ImagePSF` or `~numpy.ndarray`, optional
        The sharp PSF, for a file without PSFs (see `from_array`).
    """,
    )

    array: np.ndarray
    pixel_scale: u.Quantity
    source: np.ndarray | None = None
    target: np.ndarray | None = None
    regularization: float = float("nan")
    meta: dict = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        wanted = "a square array ('MatchingKernel.from_psfs' makes the kernel of two PSFs)"
        check_that(not hasattr(self.array, "evaluate"), "array", wanted, type(self.array).__name__)
        for name in ("array", "source", "target"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, frozen_array(checked_square(value, name)))
        scale = positive(self.pixel_scale, ANGLE, "pixel_scale")
        self.__dict__.update(pixel_scale=scale * ANGLE, meta=dict(self.meta))

    def __repr__(self):
        n = self.array.shape[0]
        return (
            f"<MatchingKernel {n} x {n} px of {self.pixel_scale}, sum {self.array.sum():.4f}, "
            f"regularization {self.regularization:.3g}>"
        )

    @classmethod
    @takes_other_keywords
    def from_psfs(
        cls,
        hi,
        lo,
        *,
        pixel_scale=None,
        regularization="auto",
        hi_angle=None,
        lo_angle=None,
        grid_angle=0.0 * u.deg,
        resampling=None,
        extent=None,
        normalize=None,
        tolerance=1e-3,
    ):
        """
        Make the kernel by a Wiener filter that penalizes roughness (the Laplacian).

        Parameters
        ----------
        hi, lo : `~photutils.psf.ImagePSF`, `~numpy.ndarray`, str or other
            The sharp and the wide PSF; text is a file for `read_psf` or a filter that has a model
            (`filter_psf`), and ``(array, 0.03 * u.arcsec)`` an array with its pixel. An array alone, and a
            functional model of photutils, is taken as sampled on the
            image's grid (pixel and orientation), its sum the fraction of light it holds. Cores that do
            not stand on the center (by more than 0.01 pixel) are brought there, arrays with
            an even number of pixels to an odd one; ``meta["centering"]`` has the shifts.
        pixel_scale : `~astropy.units.Quantity`, optional
            Pixel of the image that is to be convolved; that of the sharp PSF by default.
        regularization : float, str, optional
            The Wiener parameter mu; ``"yang2021"`` for 0.03. It belongs to the pixel
            scale: the penalty of a given structure grows as the pixel's fourth power.
            ``"auto"`` goes through 0.1, 0.03, ... 1e-8, takes the largest error of the
            encircled energy at any radius for each, and chooses the largest mu (the
            smoothest kernel) whose error is at most ``tolerance`` above the smallest. Kernels
            whose noise gain exceeds 1.25 times that of the Gaussian between Gaussians as wide
            as the two cores, or whose negative pixels sum to less than -1.5, are left out: PSFs with
            noise or artifacts of resampling make those striped.
        hi_angle, lo_angle : `~astropy.units.Quantity`, optional
            Position angle of the +y axis of a PSF in the detector frame; needed for those,
            refused for PSFs on the sky. An array of angles (rolls, dithers) gives the average.
            A PSF with ``pa_aper`` (`read_psf`) is turned by that if none is given.
        grid_angle : `~astropy.units.Quantity`, optional
            Position angle of the image's +y axis.
        resampling : {"drizzle", None}, optional
            With ``"drizzle"`` the wide PSF is that of a drizzled mosaic on these pixels
            (see `psf_mosaic`); None for the PSF of single exposures.
        extent : `~astropy.units.Quantity`, optional
            Width of the kernel; that of the wide PSF if not given.
        normalize : bool, optional
            Whether the kernel has unit sum, as the paper's: fluxes then lack the light beyond
            the PSFs' grids. If not, its sum is the wide PSF's. By default a kernel is
            normalized where it is not known what fraction of all light the wide PSF holds: for
            arrays and for PSFs made without ``enclosed``.
        tolerance : float, optional
            See ``regularization``.

        Returns
        -------
        kernel : `MatchingKernel`
            Its meta has ``noise_gain``, ``gaussian_gain``, ``negative_sum``, ``residual``,
            ``max_error``, ``smallest_error``, ``within_limits`` (of the choice of mu),
            ``centering`` (arcsec x, y), ``held`` (what the sharp and the wide PSF's grids
            sum to, before any scaling), ``energy`` (what the wide one was scaled to).

        Raises
        ------
        ValueError
            If an angle is missing or one too many, shapes do not fit, an array's sum is
            not that of a PSF, or the first PSF is the wider one.

        Warns
        -----
        `~miricigale.utils.exceptions.PSFWarning`
            If the automatic choice cannot keep its limits or misses the wide PSF by more than
            0.02 of the light; if a kernel is normalized by default although more than 0.01 of
            the light lies beyond a grid.

        References
        ----------
        Boucaud et al. 2016, A&A 596, A63, eq. 15 (the filter); Yang et al. 2021, ApJ 908,
        144, section 3.3.

        Examples
        --------
        >>> import astropy.units as u
        >>> from miricigale.psf import MatchingKernel, gaussian_psf
        >>> kind = {"pixel_scale": 0.06 * u.arcsec, "fov": 6 * u.arcsec}
        >>> hi, lo = (gaussian_psf(w * u.arcsec, **kind) for w in (0.2, 0.5))
        >>> kernel = MatchingKernel.from_psfs(hi, lo, pixel_scale=0.06 * u.arcsec)
        >>> round(float(kernel.array.sum()), 4)
        1.0
        """
        hi = named_psf(hi)
        lo = named_psf(lo)
        for name, psf in {"hi": hi, "lo": lo}.items():
            is_psf = hasattr(psf, "param_names") or np.ndim(getattr(psf, "array", psf)) == 2
            wanted = "a PSF, its file, a name of a filter or a 2D array"
            check_that(is_psf, name, wanted, type(psf).__name__)
        if pixel_scale is None:
            pixel_scale = getattr(hi, "pixel_scale", None)
        check_that(
            pixel_scale is not None, "pixel_scale", "given where 'hi' does not state it", "None"
        )
        scale = scalar(pixel_scale, ANGLE, "pixel_scale")
        check_choice(resampling, "resampling", ("drizzle", None))
        source, target, mended = psf_pair(
            hi, lo, scale, angles=(hi_angle, lo_angle), grid_angle=grid_angle,
            resampling=resampling, extent=extent, normalize=normalize,
        )  # fmt: skip
        make = wiener(source, target)
        mu, array, figures = choose(regularization, make, source, target, tolerance)
        angle = float(grid_angle.to_value(u.deg))
        meta = {"penalty": "laplacian", "lost": 0.0, "grid_angle": angle}
        meta |= {"resampling": resampling or "none", **mended, **figures}
        return cls(array, scale * ANGLE, source, target, regularization=mu, meta=meta)

    @classmethod
    def identity(cls, psf, *, angle=None):
        """
        Make the kernel that changes nothing, for sources that are points on an image of this PSF.

        Parameters
        ----------
        psf : `~photutils.psf.ImagePSF`, str or other
            As for `from_psfs`, with its pixel; the kernel is on its cells.
        angle : `~astropy.units.Quantity`, optional
            Position angle of the +y axis of a PSF in the detector frame.

        Returns
        -------
        kernel : `MatchingKernel`
            Its ``source`` and ``target`` are the PSF, north up.

        Raises
        ------
        ValueError
            If the pixel of the PSF is unknown, or its angle.
        """
        psf = instrument_psf(named_psf(psf))
        if psf.frame == "detector" and angle is None and psf.pa_aper is None:
            raise argument_error(
                "angle",
                "given to 'MatchingKernel.identity' for a PSF in the detector's frame, or the PSF that of the "
                "image: psf_mosaic(miri_psf('F770W'), pixel_scale, exposure.pa_aper)",
                "None",
            )
        source, target, mended = psf_pair(psf, psf, psf.cell, angles=(angle, angle))
        array = np.zeros_like(source)
        array[tuple(n // 2 for n in array.shape)] = mended["energy"]
        return cls(array, pixel_scale=psf.cell * ANGLE, source=source, target=target, meta=mended)

    @classmethod
    def from_array(cls, array, *, pixel_scale, source=None, target=None):
        """
        Take a kernel that is ready, such as another program's.

        Parameters
        ----------
        array : `~numpy.ndarray`, shape (n, n), n odd
            The kernel. A sum between 0.9 and 1.1 is brought to 1.
        pixel_scale : `~astropy.units.Quantity`
            Pixel of the images that it is for.
        source, target : `~photutils.psf.ImagePSF` or `~numpy.ndarray`, optional
            The sharp and the wide PSF, on the sky or as arrays of the kernel's shape; the
            target is the convolved source if only that is given.

        Returns
        -------
        kernel : `MatchingKernel`
            ``meta["sum"]`` is what the array summed to.

        Raises
        ------
        ValueError
            If the kernel is not square and odd, its sum is another, a PSF does not fit, or the
            source is the wider one.

        Warns
        -----
        `~miricigale.utils.exceptions.PSFWarning`
            If the kernel was normalized by more than 0.001, or its core stands more than 0.1
            pixel off the center: it moves images by that.
        """
        scale = scalar(pixel_scale, ANGLE, "pixel_scale")
        array, psfs, total = ready_arrays(array, scale, source=source, target=target)
        return cls(array, pixel_scale=pixel_scale, meta={"sum": total, "lost": 0.0}, **psfs)

    @classmethod
    def blend(cls, kernels, weights=None):
        """
        Return the mean of kernels, such as those of several regions at a place between them.

        Parameters
        ----------
        kernels : sequence of `MatchingKernel`
            Alike in pixel, shape and in whether they have their PSFs.
        weights : array_like, optional
            Non-negative weights; equal if not given.

        Returns
        -------
        kernel : `MatchingKernel`
            With the mean PSFs; exact where one of the two PSFs is the same in all.

        Raises
        ------
        ValueError
            If there is none, they differ, or the weights do not fit.
        """
        return cls(**blended(kernels, weights))

    @property
    def noise_gain(self):
        """Factor by which the kernel multiplies the rms of uncorrelated noise."""
        return float(np.sqrt(np.sum(self.array**2)))

    @functools.cached_property
    def matched(self):
        """
        The sharp PSF after convolution, to be compared with ``target``.

        Raises
        ------
        ValueError
            If the kernel was made without PSFs.
        """
        if self.source is None or self.target is None:
            raise argument_error("source, target", "the kernel's PSFs", "a kernel without them")
        return fftconvolve(self.source, self.array, mode="same")

    def with_psfs(self, source, target):
        """
        Make the kernel between two other PSFs, as large as this one.

        Parameters
        ----------
        source, target : `~numpy.ndarray`, shape (n, n)
            The PSFs, on the pixels and of the shape of those that the kernel has.

        Returns
        -------
        kernel : `MatchingKernel`
            With the automatic regularization; that of points on an image stays one of points.

        Raises
        ------
        ValueError
            If a pixel is masked or not finite.
        """
        source = floats(source)
        target = floats(target)
        for name, values in (("source", source), ("target", target)):
            bad = int(np.count_nonzero(~np.isfinite(values)))
            check_that(not bad, name, "finite", f"{bad} pixels that are masked, NaN or infinite")
        if np.count_nonzero(self.array) == 1:
            return dataclasses.replace(self, source=target, target=target)
        mu, array, figures = choose("auto", wiener(source, target), source, target, 1e-3)
        edge = (len(array) - len(self.array)) // 2
        changed = {"source": source, "target": target, "regularization": mu}
        changed["array"] = array[edge : len(array) - edge, edge : len(array) - edge]
        return dataclasses.replace(self, **changed, meta={**self.meta, **figures})

    def apply(self, image):
        """
        Convolve an image, taking zero outside of it.

        Parameters
        ----------
        image : `~numpy.ndarray` or `~astropy.nddata.CCDData`, shape (ny, nx)
            Image on pixels of ``pixel_scale``.

        Returns
        -------
        image : `~numpy.ndarray` or `~astropy.nddata.CCDData`, shape (ny, nx)
            Of an image with coordinates and unit a copy without uncertainty: noise that was convolved is
            correlated.

        Raises
        ------
        ValueError
            If the image is not 2D or not finite (a pixel without data must be given a
            value before it is spread over the kernel).
        """
        if isinstance(image, CCDData):
            data = self.apply(image.data)
            return Image(
                data, unit=image.unit, wcs=image.wcs, mask=image.mask, meta=dict(image.meta)
            )
        return convolved(image, self.array)

    __call__ = apply

    def plot(self, ax=None, **kwargs):
        """
        Draw the encircled energies of the two PSFs, and of the sharp one after convolution.

        Parameters
        ----------
        ax : `~matplotlib.axes.Axes`, optional
            Where; the current axes by default.
        **kwargs
            Passed to `matplotlib.axes.Axes.plot`.

        Returns
        -------
        ax : `~matplotlib.axes.Axes`

        Raises
        ------
        ValueError
            If the kernel was made without PSFs.
        """
        from miricigale.plotting.measurements import plot_energies

        matched = self.matched
        pixels = energy_radii(self.target)
        psfs = {"sharp PSF": self.source, "wide PSF": self.target, "convolved": matched}
        curves = {name: energy_error(psf, 0.0 * psf, pixels) for name, psf in psfs.items()}
        return plot_energies(pixels * self.pixel_scale.value, curves, ax=ax, **kwargs)

    def _facts(self):
        return {
            "pixels": self.array.shape,
            "pixel scale": self.pixel_scale,
            "sum": f"{self.array.sum():.4f}",
            "regularization": f"{self.regularization:.3g}",
            "noise gain": f"{self.noise_gain:.3g}",
        }

    def encircled_energy_error(self, radii=None):
        """
        Return the encircled energy of the convolved sharp PSF minus that of the wide one.

        Parameters
        ----------
        radii : `~astropy.units.Quantity`, optional
            By default every half pixel from 1 to the edge.

        Returns
        -------
        error : `~numpy.ndarray`
            Fraction of all light, signed.

        Raises
        ------
        ValueError
            If the kernel was made without PSFs.
        """
        matched = self.matched
        pixels = energy_radii(self.target)
        if radii is not None:
            pixels = np.atleast_1d(to_array(radii, ANGLE, "radii")) / self.pixel_scale.value
        return energy_error(matched, self.target, np.ascontiguousarray(pixels))

    def cropped(self, extent):
        """
        Cut the kernel to a smaller square; what is lost stands in ``meta['lost']``.

        Parameters
        ----------
        extent : `~astropy.units.Quantity`
            New width.

        Returns
        -------
        kernel : `MatchingKernel`
            Not renormalized: its sum is smaller by ``meta['lost']``. ``source`` and
            ``target`` stay as they are.
        """
        width = scalar(extent, ANGLE, "extent") / self.pixel_scale.value
        half = int(width // 2)
        old = self.array.shape[0] // 2
        wanted = f"at most {self.array.shape[0] * self.pixel_scale.value:.4g} arcsec"
        check_that(0 <= half <= old, "extent", wanted, extent)
        array = self.array[old - half : old + half + 1, old - half : old + half + 1]
        lost = self.meta.get("lost", 0.0) + float(self.array.sum() - array.sum())
        return dataclasses.replace(self, array=array, meta={**self.meta, "lost": lost})
