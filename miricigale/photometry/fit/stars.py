"""PSFs and kernels corrected by the stars that the images themselves show."""

import dataclasses

import numpy as np
from astropy.table import QTable
from astropy.wcs.utils import pixel_to_pixel
from scipy.spatial import KDTree

from miricigale.filters import Filter
from miricigale.photometry.images.arrays import fine_wcs, image_arrays, pixel_scale, sky_pixels
from miricigale.psf import KernelField, _core
from miricigale.psf.star_fit import TERMS, WHOLE, Star, StarPSF, fitted_stars
from miricigale.utils.parallel import single_threaded
from miricigale.utils.units import ANGLE

#: Least signal-to-noise of a star, and largest number that are looked at and used, the brightest first.
_SNR, _MOST, _USED = 50.0, 60, 20

#: In full widths at half maximum: how far out a star is looked at, within what distance no other source may be,
#: and the radius about others that is masked.
_REACH, _ALONE, _MASKED = 12.0, 3.0, 1.5

#: Light of others relative to the star's: within the distance above, and farther out or left in a pixel, beyond so
#: many errors.
_NEAR, _OTHERS, _CLIP = 0.02, 0.3, 5.0

#: Largest relative width that a star may have beyond the model, error of that, and deviation from the other stars.
_WIDTH, _WIDTH_ERR, _LIKE = 0.12, 0.02, 0.03

#: Largest ratio of the fluxes of a star in two bands beyond 1.6 um, the redder over the bluer one, where the
#: wavelengths differ by a fifth at least: the Rayleigh-Jeans tail falls, galaxies and dust do not.
_COLOR, _TAIL, _APART = 0.8, 1.6, 1.2


@dataclasses.dataclass(frozen=True, eq=False)
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
        known = {"image_psf": "model", "image_stars": 0}
        for name, one in self.fits.items():
            known |= {f"{name}_psf": one.kind, f"{name}_stars": len(one.after)}
            known[f"{name}_psf_chi2"] = [round(one.chi2[kind], 1) for kind in ("model", one.kind)]
            if one.kind != "model":
                known[f"{name}_psf_err"] = round(float(one.error), 5)
                for key, *pair in zip(TERMS, one.terms, one.terms_err, strict=True):
                    known[f"{name}_psf_{key}"] = [round(float(v), 4) for v in pair]
        return known


def kernel_stars(kernel, image, highres, catalog, *, grid=None, least=1):
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
    grid : `~astropy.wcs.WCS`, optional
        The pixels of the kernel; those of ``highres``, or north up without it.
    least : int, optional
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
    mean = kernel.mean if isinstance(kernel, KernelField) else kernel
    if grid is None:
        north_up = fine_wcs(image.wcs, image.shape, mean.pixel_scale.to_value(ANGLE))
        grid = north_up if highres is None else highres.wcs
    sky, ids, rows = catalog["sky"], catalog["id"], np.arange(len(catalog))
    place = 2 * np.stack(image.wcs.world_to_pixel(sky), axis=1) / image.shape[::-1] - 1
    fits, flux, table = {}, {}, []
    for name, one in (("prior", highres), ("image", image)):
        if one is None:
            continue
        psf = mean.source if name == "prior" else mean.target
        rows, found = _stars(image_arrays(one, name), grid, psf, sky, rows, place)
        if flux and _in_the_tail(highres, one):
            faint = [k for k, star in enumerate(found) if star.flux < _COLOR * flux[rows[k]]]
            rows, found = rows[faint], [found[k] for k in faint]
        rows, found = rows[:_USED], found[:_USED]
        flux = {k: star.flux for k, star in zip(rows, found, strict=True)}
        if len(rows):
            fits[name] = fit = StarPSF(psf, [star.star for star in found], least)
            pairs = zip(rows, fit.before, fit.after, strict=True)
            table += [(name, ids[k], a.snr, a.width[0], a.chi2, b.chi2) for k, a, b in pairs]
    names = ("on", "id", "snr", "width", "chi2_model", "chi2")
    table = QTable(rows=table, names=names) if table else QTable(names=names)
    if any(one.kind != "model" for one in fits.values()):
        kernel = _corrected(kernel, fits, image)
    return KernelStars(kernel, fits, table)


def with_stars(photometer, image, sources, highres=None, grid=None):
    """
    A `~miricigale.photometry.ForcedPhotometer` with the kernel that the stars give, and these.

    ``sources`` has the columns ``id`` and ``sky``; the other arguments are those of `kernel_stars`. Without the
    prior only the image's PSF is corrected.
    """
    least = WHOLE if photometer.psf_stars is None else 1
    with single_threaded():
        stars = kernel_stars(photometer.kernel, image, highres, sources, grid=grid, least=least)
    errors, fit = photometer.errors, stars.fits.get("image")
    if errors.psf_error is None and fit is not None and fit.kind != "model":
        errors = dataclasses.replace(errors, psf_error=min(float(fit.error), 0.99))
    return photometer.replace(kernel=stars.kernel, errors=errors, psf_stars=False), stars


def _in_the_tail(prior, image):
    """Whether stars are fainter in the image's band by their spectrum."""
    names = [one.meta.get("filter") for one in (prior, image)]
    if not all(name in Filter.names() for name in names):
        return False
    blue, red = (Filter(name).pivot.to_value("um") for name in names)
    return blue > _TAIL and red > _APART * blue


def _stars(arrays, grid, psf, sky, rows, place):
    """Which of some rows of a catalog are stars, and their `FittedStar`, brightest first."""
    step, shape = pixel_scale(arrays.wcs) / pixel_scale(grid), arrays.flux.shape
    fwhm = _core.half_maximum_width(psf, len(psf) // 2, len(psf) // 2) / step
    xy = sky_pixels(sky, arrays.wcs, shape, 0.0)
    seen = np.flatnonzero(np.isfinite(xy[:, 0]))
    light = np.zeros(len(xy))
    at = tuple(np.rint(xy[seen, ::-1]).astype(int).T)
    light[seen] = arrays.flux[at] * np.sqrt(np.sum(psf**2)) / (step * psf.max())
    snr = light[rows] / arrays.sigma[tuple(np.rint(np.nan_to_num(xy[rows, ::-1])).astype(int).T)]
    rows = rows[np.argsort(-snr)][: np.count_nonzero(snr > _SNR)]
    tree, kept, stars = KDTree(xy[seen]), [], []
    for k in rows[:_MOST]:
        others = seen[tree.query_ball_point(xy[k], _REACH * fwhm)]
        others = others[others != k]
        distance = np.hypot(*(xy[others] - xy[k]).T)
        # of what is a nuisance for its light, or for being near
        limit = distance * np.where(light[others] > _OTHERS * light[k], 0.5, np.inf)
        limit[(distance < _ALONE * fwhm) & (light[others] > _NEAR * light[k])] = 0.0
        alone = limit.min(initial=np.inf)
        if alone > _ALONE * fwhm:
            kept.append(k)
            reach = min(_REACH * fwhm, alone, (len(psf) // 2 - 2) / step)
            size = reach, _MASKED * fwhm, len(psf) // 2 - 2, step
            # what is nearer is faint
            others = others[distance > _ALONE * fwhm]
            stars.append(_star(arrays, grid, xy[k], xy[others], place[k], *size))
    fits = fitted_stars(psf, [_without_others(fit) for fit in fitted_stars(psf, stars)])
    width, error = np.reshape([fit.width for fit in fits], (-1, 2)).T
    # to first order, which makes narrow ones too narrow
    good = (width > -2 * _WIDTH) & (width < _WIDTH) & (error < _WIDTH_ERR)
    # galaxies are wider: of the narrower half the middle one is a star
    usual = np.quantile(width[good], 0.25) if good.any() else 0.0
    good &= np.abs(width - usual) < _LIKE + 3 * error
    return np.array(kept, int)[good], [fits[k] for k in np.flatnonzero(good)]


def _star(arrays, grid, xy, others, place, reach, masked, half, step):
    """The pixels about a star, without those of other sources."""
    ny, nx = arrays.flux.shape
    x0, y0 = np.maximum(np.rint(xy - reach).astype(int), 0)
    y, x = np.mgrid[y0 : min(round(xy[1] + reach) + 1, ny), x0 : min(round(xy[0] + reach) + 1, nx)]
    u, v = np.subtract(
        pixel_to_pixel(arrays.wcs, grid, x, y),
        np.reshape(pixel_to_pixel(arrays.wcs, grid, *xy), (2, 1, 1)),
    )
    use = (np.hypot(x - xy[0], y - xy[1]) < reach) & (np.maximum(np.abs(u), np.abs(v)) < half)
    for one in others:
        use &= np.hypot(x - one[0], y - one[1]) > masked
    sigma = np.where(use, arrays.sigma[y, x], np.inf)
    return Star(arrays.flux[y, x], sigma, u, v, place, step**2)


def _without_others(fit):
    """A star without pixels that other sources brighten."""
    sigma, use = fit.star.sigma.copy(), np.isfinite(fit.star.sigma)
    most = _CLIP * np.hypot(sigma[use], _OTHERS * (fit.star.data[use] - fit.residual))
    sigma[use] = np.where(fit.residual > most, np.inf, sigma[use])
    return dataclasses.replace(fit.star, sigma=sigma)


def _corrected(kernel, fits, image):
    """The kernel between corrected PSFs; kernels of the corners if these change over the field."""
    if not isinstance(kernel, KernelField) and any(one.slope.any() for one in fits.values()):
        x, y = np.array(image.shape[::-1])[:, None] * [[0, 0, 1, 1], [0, 1, 0, 1]] - 0.5
        kernel = KernelField([kernel] * 4, image.wcs.pixel_to_world(x, y).icrs)

    def changed(one, place=(0.0, 0.0)):
        psfs = {"prior": one.source, "image": one.target}
        psfs |= {name: fit.at(place, psfs[name]) for name, fit in fits.items()}
        return one.with_psfs(*psfs.values())

    if not isinstance(kernel, KernelField):
        return changed(kernel)
    places = 2 * np.stack(image.wcs.world_to_pixel(kernel.sky), axis=1) / image.shape[::-1] - 1
    kernels = [changed(*one) for one in zip(kernel.kernels, places, strict=True)]
    return dataclasses.replace(kernel, kernels=kernels)
