"""Forced photometry: all sources of a catalog fitted at once, with templates."""

import dataclasses

import astropy.units as u
import numpy as np
from astropy.table import QTable
from photutils.segmentation import SegmentationImage

from miricigale.instrument import epoch_of
from miricigale.photometry.detection.prior_catalog import (
    detected_prior,
    is_catalog,
    read_catalog,
    read_prior,
)
from miricigale.photometry.fit.chosen_kernel import SampledPSFs, check_one_band, chosen_kernel
from miricigale.photometry.fit.exposure_kernels import ExposureKernels, are_exposures
from miricigale.photometry.fit.fit_loop import fit_image
from miricigale.photometry.fit.progress import measurement_steps
from miricigale.photometry.fit.result_table import CatalogRows, NewSources, package, warn_of_none
from miricigale.photometry.fit.settings import ErrorSettings, MemorySettings
from miricigale.photometry.fit.stars import with_stars
from miricigale.photometry.images.arrays import fit_arrays, image_arrays, pixel_scale
from miricigale.photometry.images.flags import ForcedFlags
from miricigale.photometry.images.mosaics import as_mosaic
from miricigale.photometry.images.repeated_pixels import own_pixels
from miricigale.photometry.images.sky_noise import warn_of_background
from miricigale.photometry.templates.placement import Placement
from miricigale.photometry.templates.sources import SourceTemplates
from miricigale.psf import MODEL_FILTERS, KernelField, MatchingKernel
from miricigale.utils.exceptions import PhotometryWarning, PSFWarning, argument_error, warn
from miricigale.utils.files import is_path
from miricigale.utils.interactive import Interactive
from miricigale.utils.memory import return_freed_memory
from miricigale.utils.named_values import field_values
from miricigale.utils.options import check_choice, check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.parallel import single_threaded, thread_count, threads
from miricigale.utils.units import ANGLE, FNU, SURFACE_BRIGHTNESS, is_number, positive, to_array
from miricigale.utils.values import value_class


@takes_other_keywords
@value_class
class ForcedPhotometer(Interactive):
    """
    Measure the sources of a catalog on an image of lower resolution.

    Each source's light on a high-resolution image is brought to the image's resolution
    and pixels; the sum of all such templates, each times its flux, is fitted to the image.

    Parameters
    ----------
    kernel : `~miricigale.psf.MatchingKernel`, `~miricigale.psf.KernelField` or other, optional
        From the high-resolution image's PSF (``source``) to the image's (``target``), on the
        pixels of the high-resolution image. ``target`` must be the PSF of the image that is
        measured: that of a drizzled mosaic for a drizzled mosaic. With kernels of several places
        each source has that of its own; shapes are fitted with the mean of the sources. If the
        kernel has no PSFs, sources are their segments as they are (``template="cutout"``, ``wings=False``), with a
        warning, and sources without a segment are not measured. Files, and arrays with their pixel scale
        (``(array, 0.03 * u.arcsec)``), are taken by `~miricigale.psf.as_kernel`. For exposures that are fitted
        together a list of kernels, or `ExposureKernels`, one for each.
    psf, highres_psf : `~photutils.psf.ImagePSF`, str or other, optional
        PSFs of the image and of the high-resolution image, in place of the kernel, in any form that
        `~miricigale.psf.MatchingKernel.from_psfs` takes; it makes the kernel. Without a high-resolution image,
        give the PSF of the image alone: sources are then points. Arrays and models of photutils that do not state
        their pixels are on those of the image that they belong to, in the direction of its axes, when it is
        measured; ``(array, 0.03 * u.arcsec)`` states them.
    filter : str, optional
        Filter of the image, with whose model ``psf`` is compared (`~miricigale.psf.checked_psf`): a PSF of unit
        sum is then taken to hold the part of the light that the model holds on its pixels, as
        ``miricigale photometry`` does. Without it, it is taken to hold all.
    template : {"auto", "cutout", "psf", "sersic"}, optional
        What sources look like. ``"auto"`` cuts them from the high-resolution image where a
        segment of enough signal-to-noise belongs to them, otherwise takes a point source.
        ``"cutout"`` does so without regard to the signal-to-noise. ``"sersic"`` draws the
        profile that the catalog states.
    wings : bool, optional
        Whether cutouts are carried on beyond their well-measured core by a profile scaled to what is
        seen; otherwise they are the segments as they are.
    background_order : int, optional
        If given, a background is fitted with the sources: a polynomial in position of this order, 0 (a
        constant) to 4. Its terms are images that are kept during the fit.
    max_shift : `~astropy.units.Quantity`, optional
        If given, a shift of the whole image is fitted too. A larger one than this is
        rejected with a warning, and the image is measured without.
    offset_order : int, optional
        If given (0 to 3), a map of offsets takes the place of the one shift: a polynomial in position of
        this order through the offsets of bright isolated sources that are below ``max_shift``. With too few
        of them the order is lowered, or one shift fitted, and a warning says so.
    integrate : bool, optional
        Whether templates are averaged over the image's pixels, for a kernel whose target
        does not include the response of the pixel.
    components : {1, 2}, optional
        With 2, sources whose template without error fits poorly are fitted once more as their template and
        a point on top of it, and stay so where chi-square is less than without the point. A column
        ``components`` of the catalog (1 or 2) can select these sources instead. The point is at the catalog's
        position, or at the center of the fitted profile if that is more than 3 sigma away.
    second_pass : bool or None, optional
        Whether peaks of the residual above 5 sigma that the catalog lacks are fitted together with it, as
        points; they are listed in ``new_sources`` of the result. None leaves it to the evidence: they are
        where at most a tenth of them are false, by the peaks of the residual's negative and of Gaussian noise.
    psf_stars : bool or None, optional
        Whether stars on the image and on the high-resolution image correct the two PSFs, as far as stars that
        are left out confirm it (`~miricigale.photometry.fit.stars.kernel_stars`); the error that remains is
        ``psf_error``, unless that is given, and ``psf_stars`` of the result says what was found. None corrects
        the PSF of an image only if it shows three stars at least, each of which the others can confirm.
    errors : `ErrorSettings`, optional
        What the errors are made of.
    memory : `MemorySettings`, optional
        What is kept in memory.
    n_threads : int, optional
        Number of threads; by default one for each processor. It changes nothing in the
        result.

    Raises
    ------
    ValueError
        If an option is out of range, or the kernel has no PSFs and points or profiles are asked for.

    Notes
    -----
    Normal equations in whitened form are factorized sparsely. Errors are the diagonal of
    H (A^T W C W A) H, where H is the inverse normal matrix and C the measured covariance
    of the noise; their scale is thus the one of the residuals, not that of the uncertainty.

    Templates are not exact. The profile of each source is known up to the covariance of its fit to the
    high-resolution image; at the image's resolution this is a few independent changes of its template,
    which are fitted with the fluxes, each with a normal prior of the width it is known to. A bright source
    thus finds its size in the image that is measured, a faint one keeps the high-resolution
    image's, and errors (``flux_err_template``) are those of the two together. Changes that are
    below 0.3 of the noise in all pixels together are left out.

    Cutouts of noisy segments make the fit too faint, since the template's own noise adds to
    its power: that part (noise variance times the kernel's power) is taken off the diagonal.

    References
    ----------
    Merlin et al. 2015, A&A 582, A15 (T-PHOT); Yang et al. 2021, ApJ 908, 144, section 3.4;
    Fuller 1987, Measurement Error Models (errors in variables).

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropy.coordinates import SkyCoord
    >>> from astropy.nddata import CCDData
    >>> from miricigale.instrument import north_up_wcs
    >>> from miricigale.photometry import ForcedPhotometer
    >>> from miricigale.psf import gaussian_psf, psf_image
    >>> psf = gaussian_psf(0.4 * u.arcsec, pixel_scale=0.1 * u.arcsec, fov=4 * u.arcsec)
    >>> sky = SkyCoord([53.1], [-27.8], unit="deg")
    >>> wcs = north_up_wcs(sky[0], 0.1 * u.arcsec, (61, 61))
    >>> light = psf_image(psf, pixel_scale=0.1 * u.arcsec, shape=61)
    >>> noise = np.random.default_rng(1).normal(0, 0.01, (61, 61))
    >>> image = CCDData(2 * light + noise, unit="uJy", wcs=wcs)
    >>> result = ForcedPhotometer(psf=psf).measure(image, sky)
    >>> print(f"{result.flux[0]:.2f} +- {result.flux_err[0]:.2f}")
    2.02 uJy +- 0.06 uJy
    """

    kernel: object = None
    _: dataclasses.KW_ONLY
    psf: dataclasses.InitVar[object] = None
    highres_psf: dataclasses.InitVar[object] = None
    filter: dataclasses.InitVar[str | None] = None
    template: str = "auto"
    wings: bool = True
    background_order: int | None = None
    max_shift: u.Quantity | None = None
    offset_order: int | None = None
    integrate: bool = False
    components: int = 1
    second_pass: bool | None = False
    psf_stars: bool | None = False
    errors: ErrorSettings = dataclasses.field(default_factory=ErrorSettings)
    memory: MemorySettings = dataclasses.field(default_factory=MemorySettings)
    n_threads: int | None = None

    def __post_init__(self, psf, highres_psf, filter):
        template = self.template
        check_choice(template, "template", ("auto", "cutout", "psf", "sersic"))
        kernel = chosen_kernel(self.kernel, psf, highres_psf, filter)
        if psf is not None and highres_psf is None and template == "auto":
            template = "psf"
        # the kernel that all have in common: the mean, with PSFs in any case
        mean = kernel
        if isinstance(kernel, KernelField | ExposureKernels):
            mean = kernel.mean
        is_bare = False
        if isinstance(mean, MatchingKernel):
            is_bare = mean.source is None or mean.target is None
        changed = {"kernel": kernel, "template": template, "bare": is_bare, "mean_kernel": mean}
        changed["n_threads"] = thread_count(self.n_threads)
        if is_bare:
            wanted = f"a MatchingKernel with its PSFs for template={template!r}"
            check_that(template in ("auto", "cutout"), "kernel", wanted, "one without")
            msg = (
                "the kernel has no PSFs: sources are their segments as they are, without wings, and "
                "those without a segment are not measured"
            )
            warn(msg, PhotometryWarning)
            # as far as it reaches, and as wide
            mean = dataclasses.replace(mean, source=mean.array, target=mean.array)
            changed |= {"template": "cutout", "wings": False, "mean_kernel": mean}
        # options in their ranges
        for name, largest in (("background_order", 4), ("offset_order", 3)):
            order = getattr(self, name)
            if order is not None and not (is_number(order, np.integer) and 0 <= order <= largest):
                raise argument_error(name, f"an integer from 0 to {largest}", repr(order))
        if self.offset_order is not None and self.max_shift is None:
            raise argument_error("max_shift", "given with 'offset_order'", "None")
        check_choice(self.components, "components", (1, 2))
        for name in ("second_pass", "psf_stars"):
            check_choice(getattr(self, name), name, (False, True, None))
        for name, kind in (("errors", ErrorSettings), ("memory", MemorySettings)):
            if not isinstance(getattr(self, name), kind):
                raise argument_error(name, kind.__name__, repr(getattr(self, name)))
        if self.max_shift is not None:
            changed["max_shift"] = positive(self.max_shift, ANGLE, "max_shift") * ANGLE
        for name, value in changed.items():
            object.__setattr__(self, name, value)

    replace = dataclasses.replace

    def __repr__(self):
        return f"<ForcedPhotometer template={self.template!r}, {self.kernel!r}>"

    def _facts(self):
        return field_values(self)

    @takes_other_keywords
    def measure(
        self,
        image,
        highres=None,
        segmentation=None,
        catalog=None,
        *,
        templates=None,
        progress_bar=None,
    ):
        """
        Measure all sources of a catalog.

        Parameters
        ----------
        image : `~astropy.nddata.CCDData`, path-like or other (see `as_mosaic`)
            The image, in units of surface brightness or of the flux in a pixel, background subtracted unless
            it is fitted, with WCS, uncertainty and mask. Any pixel scale and orientation. A list of exposures of
            one filter is fitted together, each on its own pixels and with a sky of its own (a polynomial of
            ``background_order``, a constant for None).
        highres : `~astropy.nddata.CCDData`, path-like or other, optional
            The high-resolution image, background subtracted, on pixels of the kernel (or the catalog,
            where there is none). Needed for cutouts; without it the kernel's grid is taken to be north up.
        segmentation : `~photutils.segmentation.SegmentationImage`, array or path-like, optional
            Segments of ``highres``; for cutouts they are detected (`detect_sources`) if not given.
        catalog : table in any form, path-like or `~astropy.coordinates.SkyCoord`, optional
            Positions (pixels ``x`` and ``y`` are those of ``highres``, or of ``image`` without it), and what
            `SourceTemplates.from_images`, or for Sersic templates `SourceTemplates.from_catalog`, take; by
            default a source for each segment.
        templates : `SourceTemplates`, optional
            What the sources look like, in place of the three above, made once for several
            images. The settings ``template`` and ``wings`` are then theirs.
        progress_bar : bool, optional
            Whether the steps are shown; by default in interactive sessions, for images of more than 0.2
            megapixels.

        Returns
        -------
        result : `ForcedPhotometryResult`

        Raises
        ------
        ValueError, TypeError, `~astropy.units.UnitsError`
            If an input does not fit; the message says which.

        Warns
        -----
        `~miricigale.utils.exceptions.PhotometryWarning`
            If no source is on the image, labels are not those of the segmentation, areas that are
            exactly 0 are not masked, or a background that was left in ``image`` or ``highres``
            goes into the fluxes.
        """
        check_one_band(image, "image")
        if templates is not None and not isinstance(templates, SourceTemplates):
            msg = f"'templates' must be SourceTemplates, got {type(templates).__name__}"
            raise TypeError(msg)
        # a catalog may be where the images would be
        if segmentation is None and catalog is None and is_catalog(highres):
            catalog = highres
            highres = None
        if catalog is None and is_catalog(segmentation):
            catalog = segmentation
            segmentation = None
        if isinstance(self.kernel, SampledPSFs):
            # read once, so that what a file lacks is said once
            if not are_exposures(image):
                image = as_mosaic(image, "image")
            if highres is not None:
                highres = as_mosaic(highres, "highres")
            options = {"segmentation": segmentation, "catalog": catalog, "templates": templates}
            options["progress_bar"] = progress_bar
            return self.on_pixels(image, highres).measure(image, highres, **options)
        if are_exposures(image):
            from miricigale.photometry.fit.exposure_photometry import measure_exposures

            return measure_exposures(
                self,
                image,
                highres,
                segmentation,
                catalog,
                templates=templates,
                progress_bar=progress_bar,
            )
        if isinstance(self.kernel, ExposureKernels):
            wanted = f"{len(self.kernel)} exposures, one for each kernel"
            raise argument_error("image", wanted, "one image")
        image = own_pixels(as_mosaic(image, "image"))
        self._warn_of_total(image)
        arrays = fit_arrays(image, "image")
        prior, sources = self._sources(image, highres, segmentation, catalog, templates)
        if self.psf_stars is not False and not self.bare:
            catalog_sources = QTable({"id": sources.id, "sky": sources.sky})
            sharp = prior and prior[0]
            photometer, stars = with_stars(self, image, catalog_sources, sharp, sources.wcs)
            options = {"templates": templates, "progress_bar": progress_bar}
            result = photometer.measure(image, *(prior or ()), **options)
            return stars.noted(result)
        with measurement_steps(progress_bar, arrays.flux.size) as steps:
            return self._measured(image, arrays, sources, prior=prior, steps=steps)

    def on_pixels(self, image, highres=None):
        """
        Put PSFs that do not state their pixels on those of images.

        Parameters
        ----------
        image, highres : optional
            As for `measure`.

        Returns
        -------
        photometer : `ForcedPhotometer`
            Itself, if its PSFs state their pixels.

        Raises
        ------
        ValueError
            If a PSF is on the pixels of an image that is not given, or of exposures.
        """
        if isinstance(self.kernel, SampledPSFs):
            return self.replace(kernel=self.kernel.kernel(image, highres))
        return self

    def _warn_of_total(self, image):
        """Warn of a PSF that may lack wings, where the model of the image's filter would tell."""
        kernel = self.kernel
        filter = image.meta.get("filter")
        is_assumed = isinstance(kernel, MatchingKernel) and "total_assumed" in kernel.meta
        if is_assumed and filter in MODEL_FILTERS:
            msg = (
                f"the PSF is taken to hold all of the light; ForcedPhotometer(psf=psf, filter={filter!r}) takes "
                "from the model of the image's filter how much of it such a stamp holds"
            )
            warn(msg, PSFWarning)

    def _measure_or_find(self, image, templates):
        """
        Measure as `measure` does with templates, or find sources that they lack: then for these alone.

        Returns
        -------
        result : `ForcedPhotometryResult` or `~miricigale.photometry.fit.result_table.NewSources`
        """
        if are_exposures(image) or (self.psf_stars is not False and not self.bare):
            return self.measure(image, templates=templates)
        image = own_pixels(as_mosaic(image, "image"))
        arrays = fit_arrays(image, "image")
        with measurement_steps(False, arrays.flux.size) as steps:
            return self._measured(image, arrays, templates, until_new=True, steps=steps)

    def _measured(self, image, arrays, sources, *, prior=None, until_new=False, steps):
        """
        Measure sources on an image, ``arrays`` being its pixels.

        Their templates are made of the ``prior`` (high-resolution image, segments and catalog), or else they are
        templates already. With ``until_new`` it is as `_measure_or_find`; ``steps`` is of `measurement_steps`.
        """
        # sources on or near the image, and their templates
        place = Placement.of(self, arrays, sources.sky)
        warn_of_none(sources, place.near_rows, "'image'")
        if prior is None:
            templates = sources[place.near_rows]
        else:
            highres, segmentation, catalog = prior
            steps.begin("templates")
            templates = self._templates(highres, segmentation, catalog[place.near_rows])
            # models and stamps of the fits to the prior
            return_freed_memory()
        self._check_grid(templates)
        rows, templates = self._rows(sources, place, templates)
        meta = self._meta_of(image, templates)
        if "repeated_pixels" in image.meta:
            meta["repeated_pixels"] = image.meta["repeated_pixels"]
        with threads(self.n_threads) as executor, single_threaded():
            steps.begin("templates on the image")
            bank = place.bank(rows.near_rows, templates, executor)
            grid = place.grid(templates)
            steps.begin("fit")
            fit, diagnostics, new_xy = fit_image(
                arrays, bank, self, rows, grid, until_new=until_new
            )
            if diagnostics is None:
                return NewSources.of(fit, new_xy, rows)
            steps.begin("errors")
            result = package(fit, diagnostics, new_xy, rows, meta)
        if self.background_order is None:
            warn_of_background(result, self.mean_kernel)
        return result

    __call__ = measure

    def render(self, image, templates, flux):
        """
        Draw sources as they are seen on an image.

        Parameters
        ----------
        image : `~astropy.nddata.CCDData`
            The image, as for `measure`; the values of its pixels do not count.
        templates : `SourceTemplates`
            What the sources look like.
        flux : `~astropy.units.Quantity`, shape (n,)
            Their fluxes.

        Returns
        -------
        model : `~astropy.units.Quantity`, shape (ny, nx)
            Surface brightness in MJy/sr.

        Raises
        ------
        ValueError, TypeError, `~astropy.units.UnitsError`
            If an input does not fit; the message says which.
        """
        if isinstance(self.kernel, SampledPSFs):
            return self.on_pixels(image).render(image, templates, flux)
        arrays = image_arrays(as_mosaic(image, "image"), "image")
        flux = to_array(flux, FNU, "flux", ndim=1)
        if len(flux) != len(templates):
            raise argument_error("flux", f"{len(templates)} fluxes, one for each source", len(flux))
        place = Placement.of(self, arrays, templates.sky)
        near_templates = templates[place.near_rows]
        self._check_grid(near_templates)
        model = np.zeros(arrays.flux.shape)
        with threads(self.n_threads) as executor, single_threaded():
            bank = place.bank(place.near_rows, near_templates, executor)
            # fluxes in the order of the bank's rows
            values = flux[place.near_rows][bank.order]
            bank.add_to(model, values)
        return model / arrays.area * SURFACE_BRIGHTNESS

    def _rows(self, sources, place, templates):
        """Return the catalog as the fit takes it, and the templates of its sources that are near."""
        rows = CatalogRows.of(sources, place.xy, place.near_rows, templates)
        if not self.bare:
            return rows, templates
        # there is no PSF for points: they are not measured
        with_segment = np.flatnonzero(templates.kind != "point")
        templates = templates[with_segment]
        rows = dataclasses.replace(
            rows,
            near_rows=place.near_rows[with_segment],
            template=np.where(rows.template == "point", "none", rows.template),
            fitted=templates.fitted,
        )
        return rows, templates

    def _meta_of(self, image, templates):
        """Return what a result says of its making: template and filter."""
        meta = {"template": templates.meta.get("template", self.template)}
        name = image.meta.get("filter", image.meta.get("FILTER"))
        if name is not None:
            meta["filter"] = str(name)
        return meta

    def _sources(self, image, highres, segmentation, catalog, templates):
        """Prior, as `_prior` reads it (None with templates), and the sources that are measured."""
        has_prior = not (highres is None and segmentation is None and catalog is None)
        if templates is not None:
            wanted = "given alone with the image or the exposures"
            check_that(not has_prior, "templates", wanted, "a catalog too")
            return None, templates
        prior = self._prior(image, highres, segmentation, catalog)
        sources = SourceTemplates.from_catalog(prior[2])
        return prior, dataclasses.replace(sources, sky=prior[2]["sky"])

    def _prior(self, image, highres, segmentation, catalog):
        """Return high-resolution image, segments and catalog; detect those that cutouts need and lack."""
        if highres is None and catalog is None:
            raise argument_error("catalog", "given without a high-resolution image", "None")
        if highres is not None:
            highres = as_mosaic(highres, "highres")
            if highres.wcs is None:
                image_arrays(highres, "highres")
            self._check_scale("highres", highres.wcs)
        if catalog is not None:
            # pixels of a catalog are those of the image it was made of
            place = image if highres is None else highres
            catalog = read_catalog(catalog, place.wcs, epoch_of(place))
        if self.template in ("psf", "sersic") or highres is None:
            return highres, segmentation, catalog
        if segmentation is None:
            segments, sources = detected_prior(highres, catalog)
            return highres, segments, sources
        if catalog is not None and not is_path(segmentation):
            # labels are those of the catalog, or by position
            return highres, segmentation, catalog
        if isinstance(segmentation, SegmentationImage):
            segmentation = segmentation.data
        segments, sources = read_prior(highres, segmentation=segmentation, catalog=catalog)
        return highres, segments, sources

    def _templates(self, highres, segmentation, catalog):
        """Make the templates that the settings ask for."""
        if highres is None and segmentation is not None:
            raise argument_error("highres", "the image that the segments belong to", "None")
        for name, value in (("highres", highres), ("segmentation", segmentation)):
            if value is None and self.template == "cutout":
                raise argument_error(name, "given for cutouts", "None")
        if self.template in ("psf", "sersic") or segmentation is None:
            kind = "sersic" if self.template == "sersic" else "psf"
            grid = None if highres is None else highres.wcs
            templates = SourceTemplates.from_catalog(catalog, template=kind, wcs=grid)
            if self.template != "auto":
                return templates
            flags = np.full(len(templates), int(ForcedFlags.NO_SEGMENT))
            return dataclasses.replace(
                templates, flags=flags, meta={**templates.meta, "template": "auto"}
            )
        return SourceTemplates.from_images(
            highres, segmentation, catalog, psf=self.mean_kernel.source, template=self.template,
            wings=self.wings, n_threads=self.n_threads,
        )  # fmt: skip

    def _check_scale(self, name, wcs):
        scale = self.mean_kernel.pixel_scale.to_value(ANGLE)
        have = pixel_scale(wcs)
        wanted = f"on the kernel's pixels of {scale:.4g} arcsec"
        # the kernel of a PSF without one of the prior moves no light
        if np.count_nonzero(self.mean_kernel.array) == 1:
            wanted = (
                f"left out, or its PSF given, ForcedPhotometer(psf=psf, highres_psf=prior_psf): without it the "
                f"prior is expected on the cells of 'psf', {scale:.4g} arcsec (its pixel over its oversampling)"
            )
        check_that(not abs(have / scale - 1) > 0.01, name, wanted, f"{have:.4g} arcsec")

    def _check_grid(self, templates):
        """Refuse templates on other pixels than the kernel's, warn of those of another PSF."""
        if templates.wcs is None:
            return
        self._check_scale("templates", templates.wcs)
        if templates.psf is not None:
            source = self.mean_kernel.source
            peaks = templates.psf.max(), source.max() / source.sum()
            if abs(peaks[0] / peaks[1] - 1) > 0.1:
                msg = (
                    f"the templates were made with a PSF whose peak holds {peaks[0]:.3g} of the light, the "
                    f"kernel is from one whose peak holds {peaks[1]:.3g}: is it of the same image?"
                )
                warn(msg, PhotometryWarning)
