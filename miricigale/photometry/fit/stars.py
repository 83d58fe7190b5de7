"""PSFs and kernels corrected by the stars that the images themselves show."""

import dataclasses

import numpy as np
from astropy.table import QTable
from astropy.wcs.utils import pixel_to_pixel
from scipy.spatial import KDTree

from miricigale.filters import Filter
from miricigale.photometry.fit.exposure_kernels import mean_kernel
from miricigale.photometry.images.arrays import (
    fine_wcs,
    image_arrays,
    lengths,
    pixel_scale,
    sky_pixels,
    sky_to_pixels,
)
from miricigale.psf import KernelField, _core
from miricigale.psf.star_fit import TERMS, WHOLE, Star, StarPSF, fitted_stars
from miricigale.utils.parallel import single_threaded
from miricigale.utils.units import ANGLE
from miricigale.utils.values import value_class

#: Least signal-to-noise of a star, and largest number that are looked at and used, the brightest first.
_SNR = 50.0
_MOST = 60
_USED = 20

#: Radius, in full widths at half maximum, to which a star is looked at.
_REACH = 12.0

#: Distance in full widths within which no other source may be.
_ALONE = 3.0

#: Radius in full widths about other sources that is masked.
_MASKED = 1.5

#: Largest light of others relative to the star's: within the distance above, and farther out.
_NEAR = 0.02
_OTHERS = 0.3

#: Errors beyond which a pixel is brightened by another source.
_CLIP = 5.0

#: Largest relative width that a star may have beyond the model, and its error.
_WIDTH = 0.12
_WIDTH_ERR = 0.02

#: Largest deviation of the relative width from the other stars.
_LIKE = 0.03

#: Largest ratio of the fluxes of a star in two bands, the redder over the bluer one: the Rayleigh-Jeans tail
#: falls, galaxies and dust do not.
_COLOR = 0.8

#: Wavelength (um) beyond which a band is in the Rayleigh-Jeans tail, and least ratio of two bands' wavelengths.
_TAIL = 1.6
_APART = 1.2


@value_class
class KernelStars:
    """
    The stars of an image and of its prior, and what became of the kernel with them.

    Attributes
    ----------
    kernel : `~miricigale.psf.MatchingKernel` or `~miricigale.psf.KernelField`
        From the corrected PSF of the prior to that of the image.
    fits : dict of str to `~miricigale.psf.star_fit.StarPSF`
        Of ``"image"`` and ``"prior"``, as far as they show stars.
    table : `~astropy.table.QTable`
        A row for each star of each: ``on``, ``id``, ``snr``, ``width`` (relative to the model's core) and
        chi-square below its light with the model (``chi2_model``) and with the corrected PSF (``chi2``).
    """

    kernel: object
    fits: dict
    table: QTable

    def noted(self, result):
        """Copy of a `~miricigale.photometry.ForcedPhotometryResult` that says what was done."""
        return dataclasses.replace(result, psf_stars=self, meta={**result.meta, **self.meta})

    @property
    def meta(self):
        """What was done, for the meta of a table: kind of each correction, stars, chi-square, terms, error."""
        facts = {"image_psf": "model", "image_stars": 0}
        for name, fit in self.fits.items():
            facts |= {f"{name}_psf": fit.kind, f"{name}_stars": len(fit.after)}
            facts[f"{name}_psf_chi2"] = [round(fit.chi2["model"], 1), round(fit.chi2[fit.kind], 1)]
            if fit.kind != "model":
                facts[f"{name}_psf_err"] = round(float(fit.error), 5)
                for key, value, error in zip(TERMS, fit.terms, fit.terms_err, strict=True):
                    facts[f"{name}_psf_{key}"] = [round(float(value), 4), round(float(error), 4)]
        return facts


def kernel_stars(kernel, image, highres, catalog, *, grid, min_stars):
    """
    Correct a kernel by the stars of its two images.

    Parameters
    ----------
    kernel : `~miricigale.psf.MatchingKernel` or `~miricigale.psf.KernelField`
        With its PSFs.
    image, highres : `~astropy.nddata.CCDData`
        The image and its prior, None without one.
    catalog : `~astropy.table.QTable`
        Columns ``id`` and ``sky``: all sources, stars among them.
    grid : `~astropy.wcs.WCS` or None
        The pixels of the kernel; those of ``highres``, or north up without it.
    min_stars : int
        Number of stars below which the PSF of an image is not corrected.

    Returns
    -------
    stars : `KernelStars`
        The kernel is the given one if there are no stars, or they do not confirm a correction.

    Notes
    -----
    Stars are bright, alone, as narrow as the PSF and as each other, and, if both bands are beyond 1.6 um,
    fainter in the redder one. Those of the prior are looked for on the image; without a prior, those of the
    catalog.

    References
    ----------
    Anderson & King 2000, PASP 112, 1360.
    """
    mean = mean_kernel(kernel)
    if grid is None and highres is not None:
        grid = highres.wcs
    if grid is None:
        grid = fine_wcs(image.wcs, image.shape, mean.pixel_scale.to_value(ANGLE))
    sky = catalog["sky"]
    ids = catalog["id"]
    rows = np.arange(len(catalog))
    # from -1 to 1 across the image
    place = 2 * sky_to_pixels(sky, image.wcs) / image.shape[::-1] - 1
    fits = {}
    flux = {}
    table = []
    for name, picture in (("prior", highres), ("image", image)):
        if picture is None:
            continue
        # stars of the prior are looked for on the image too
        psf = mean.source if name == "prior" else mean.target
        rows, stars = _stars(image_arrays(picture, name), grid, psf, sky, rows, place)
        if flux and _in_the_tail(highres, picture):
            faint = [k for k, star in enumerate(stars) if star.flux < _COLOR * flux[rows[k]]]
            rows = rows[faint]
            stars = [stars[k] for k in faint]
        rows = rows[:_USED]
        stars = stars[:_USED]
        flux = {k: star.flux for k, star in zip(rows, stars, strict=True)}
        if not len(rows):
            continue
        fit = StarPSF(psf, [star.star for star in stars], min_stars)
        fits[name] = fit
        for k, before, after in zip(rows, fit.before, fit.after, strict=True):
            table.append((name, ids[k], before.snr, before.width[0], before.chi2, after.chi2))
    names = ("on", "id", "snr", "width", "chi2_model", "chi2")
    # a row for each star
    table = QTable(rows=table, names=names) if table else QTable(names=names)
    if any(fit.kind != "model" for fit in fits.values()):
        kernel = _corrected(kernel, fits, image)
    return KernelStars(kernel, fits, table)


def with_stars(photometer, image, sources, highres, grid=None):
    """
    Return a `~miricigale.photometry.ForcedPhotometer` with the kernel that the stars give, and these.

    ``sources`` has the columns ``id`` and ``sky``; the other arguments are those of `kernel_stars`. Without the
    prior only the image's PSF is corrected.
    """
    min_stars = WHOLE if photometer.psf_stars is None else 1
    with single_threaded():
        stars = kernel_stars(
            photometer.kernel, image, highres, sources, grid=grid, min_stars=min_stars
        )
    errors = photometer.errors
    fit = stars.fits.get("image")
    if errors.psf_error is None and fit is not None and fit.kind != "model":
        errors = dataclasses.replace(errors, psf_error=min(float(fit.error), 0.99))
    return photometer.replace(kernel=stars.kernel, errors=errors, psf_stars=False), stars


def _in_the_tail(prior, image):
    """Return whether stars are fainter in the image's band by their spectrum."""
    prior_band = prior.meta.get("filter")
    band = image.meta.get("filter")
    if prior_band not in Filter.names() or band not in Filter.names():
        return False
    blue = Filter(prior_band).pivot.to_value("um")
    red = Filter(band).pivot.to_value("um")
    return blue > _TAIL and red > _APART * blue


def _stars(arrays, grid, psf, sky, rows, place):
    """Find stars among some rows of a catalog: their rows and `FittedStar`, brightest first."""
    step = pixel_scale(arrays.wcs) / pixel_scale(grid)
    shape = arrays.flux.shape
    fwhm = _core.half_maximum_width(psf, len(psf) // 2, len(psf) // 2) / step
    xy = sky_pixels(sky, arrays.wcs, shape, 0.0)
    on_image = np.flatnonzero(np.isfinite(xy[:, 0]))
    light = np.zeros(len(xy))
    at = tuple(np.rint(xy[on_image, ::-1]).astype(int).T)
    # signal of a fit of the PSF: light by the central pixel, times the root of the PSF's power
    light[on_image] = arrays.flux[at] * np.sqrt(np.sum(psf**2)) / (step * psf.max())
    snr = light[rows] / arrays.sigma[tuple(np.rint(np.nan_to_num(xy[rows, ::-1])).astype(int).T)]
    rows = rows[np.argsort(-snr)][: np.count_nonzero(snr > _SNR)]
    tree = KDTree(xy[on_image])
    star_rows = []
    stars = []
    for k in rows[:_MOST]:
        neighbors = on_image[tree.query_ball_point(xy[k], _REACH * fwhm)]
        neighbors = neighbors[neighbors != k]
        distance = lengths(xy[neighbors] - xy[k])
        # of what is a nuisance for its light, or for being near
        limit = distance * np.where(light[neighbors] > _OTHERS * light[k], 0.5, np.inf)
        limit[(distance < _ALONE * fwhm) & (light[neighbors] > _NEAR * light[k])] = 0.0
        clear_radius = limit.min(initial=np.inf)
        if clear_radius > _ALONE * fwhm:
            star_rows.append(k)
            reach = min(_REACH * fwhm, clear_radius, (len(psf) // 2 - 2) / step)
            masked = _MASKED * fwhm
            half = len(psf) // 2 - 2
            # what is nearer is faint
            neighbors = neighbors[distance > _ALONE * fwhm]
            star = _star(arrays, grid, xy[k], xy[neighbors], place[k], reach, masked, half, step)
            stars.append(star)
    cleaned = list(map(_without_others, fitted_stars(psf, stars)))
    fits = fitted_stars(psf, cleaned)
    width, error = np.reshape([fit.width for fit in fits], (-1, 2)).T
    # to first order, which makes narrow ones too narrow
    good = (width > -2 * _WIDTH) & (width < _WIDTH) & (error < _WIDTH_ERR)
    # galaxies are wider: of the narrower half the middle one is a star
    if good.any():
        usual = np.quantile(width[good], 0.25)
        good &= np.abs(width - usual) < _LIKE + 3 * error
    return np.array(star_rows, int)[good], [fits[k] for k in np.flatnonzero(good)]


def _star(arrays, grid, xy, neighbors, place, reach, masked, half, step):
    """Cut out the pixels about a star, without those of other sources."""
    ny, nx = arrays.flux.shape
    x0, y0 = np.maximum(np.rint(xy - reach).astype(int), 0)
    y, x = np.mgrid[y0 : min(round(xy[1] + reach) + 1, ny), x0 : min(round(xy[0] + reach) + 1, nx)]
    # offsets from the star on the PSF's grid
    center_u, center_v = pixel_to_pixel(arrays.wcs, grid, xy[0], xy[1])
    u, v = pixel_to_pixel(arrays.wcs, grid, x, y)
    u = u - center_u
    v = v - center_v
    use = (np.hypot(x - xy[0], y - xy[1]) < reach) & (np.maximum(np.abs(u), np.abs(v)) < half)
    for neighbor in neighbors:
        use &= np.hypot(x - neighbor[0], y - neighbor[1]) > masked
    sigma = np.where(use, arrays.sigma[y, x], np.inf)
    return Star(arrays.flux[y, x], sigma, u, v, place, step**2)


def _without_others(fit):
    """Return a star without pixels that other sources brighten."""
    sigma = fit.star.sigma.copy()
    use = np.isfinite(fit.star.sigma)
    # noise, and a part of the star's own light
    limit = _CLIP * np.hypot(sigma[use], _OTHERS * (fit.star.data[use] - fit.residual))
    sigma[use] = np.where(fit.residual > limit, np.inf, sigma[use])
    return dataclasses.replace(fit.star, sigma=sigma)


def _corrected(kernel, fits, image):
    """Make the kernel between corrected PSFs; kernels of the corners if these change over the field."""
    if not isinstance(kernel, KernelField) and any(fit.slope.any() for fit in fits.values()):
        x, y = np.array(image.shape[::-1])[:, None] * [[0, 0, 1, 1], [0, 1, 0, 1]] - 0.5
        kernel = KernelField([kernel] * 4, image.wcs.pixel_to_world(x, y).icrs)

    def changed(old_kernel, place):
        source = old_kernel.source
        target = old_kernel.target
        if "prior" in fits:
            source = fits["prior"].at(place, source)
        if "image" in fits:
            target = fits["image"].at(place, target)
        return old_kernel.with_psfs(source, target)

    if not isinstance(kernel, KernelField):
        return changed(kernel, (0.0, 0.0))
    places = 2 * sky_to_pixels(kernel.sky, image.wcs) / image.shape[::-1] - 1
    return dataclasses.replace(kernel, kernels=list(map(changed, kernel.kernels, places)))
