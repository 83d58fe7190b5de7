"""PSF photometry of stars with photutils, to compare with forced photometry."""

import warnings

import astropy.units as u
import numpy as np
from astropy.table import Table
from astropy.utils.exceptions import AstropyUserWarning
from photutils.psf import PSF_FLAGS, PSFPhotometry

from miricigale.photometry.arrays import image_arrays, pixel_scale, sky_pixels
from miricigale.photometry.catalogs import catalog_sources
from miricigale.photometry.grids import grid_angle
from miricigale.psf import psf_mosaic
from miricigale.utils.meta import provenance
from miricigale.utils.tables import described_table
from miricigale.utils.units import ANGLE, FNU, positive

#: Bit of a star that is on no pixel; by its name, which all versions of photutils have.
_NO_OVERLAP = next(f.bit_value for f in PSF_FLAGS.FLAG_DEFINITIONS if f.name == "no_overlap")


#: Columns of photutils that are kept.
_FITTED = ("flux_fit", "flux_err", "x_fit", "y_fit", "reduced_chi2", "qfit", "cfit")


def psf_photometry(image, psf, catalog, *, pa=None, max_shift=0.1 * u.arcsec):
    """
    Fit a PSF to stars one by one (`photutils.psf.PSFPhotometry`), on squares of four times its FWHM.

    Parameters
    ----------
    image : `~astropy.nddata.CCDData`
        In units of surface brightness, background subtracted, with WCS and uncertainty.
    psf : `~photutils.psf.ImagePSF`
        PSF of the image with the meta of `~miricigale.psf.make_psf`, on any pixel scale; it must
        include the response of the image's pixels, and drizzling if the image is drizzled.
    catalog : `~astropy.table.QTable`
        Column ``sky`` and, if there is, ``id``.
    pa : `~astropy.units.Quantity`, optional
        Position angle of the +y axis of a PSF in the detector frame; needed for those. The PSF is
        turned to the image's axes.
    max_shift : `~astropy.units.Quantity` or None, optional
        How far positions may move along either axis; None keeps those of the catalog.

    Returns
    -------
    table : `~astropy.table.QTable`
        A row for each row of the catalog, in its order: ``id``, ``sky``, ``flux``, ``flux_err`` (uJy, for
        noise that is not correlated; NaN where not measured), ``x_fit``, ``y_fit`` (0-based pixels), ``shift``
        (arcsec from the catalog's position), ``chi2`` (reduced), ``qfit``, ``cfit``, ``neighbor``
        (whether another row is within the fitted square) and ``flags`` (photutils').

    Raises
    ------
    ValueError
        If ``max_shift`` is not positive, the angle of the PSF is not known, or the catalog does not fit.

    Notes
    -----
    Each star is fitted as if it were alone: ``neighbor`` marks where it is not, and forced photometry
    is for those. Sources are not grouped on purpose: photutils 3.0 keeps the model of a group by the number
    of its sources, so that groups of a second band in one process may be fitted with the PSF of the first
    (mended in 3.1).

    References
    ----------
    Stetson 1987, PASP 99, 191; Bradley et al., photutils (https://photutils.readthedocs.io).

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropy.coordinates import SkyCoord
    >>> from astropy.nddata import CCDData
    >>> from astropy.table import QTable
    >>> from miricigale.instrument import north_up_wcs
    >>> from miricigale.photometry import psf_photometry
    >>> from miricigale.psf import gaussian_psf, psf_image
    >>> psf = gaussian_psf(0.4 * u.arcsec, pixel_scale=0.1 * u.arcsec, fov=4 * u.arcsec)
    >>> sky = SkyCoord([53.1], [-27.8], unit="deg")
    >>> wcs = north_up_wcs(sky[0], 0.1 * u.arcsec, (61, 61))
    >>> light = psf_image(psf, pixel_scale=0.1 * u.arcsec, shape=61)
    >>> noise = np.random.default_rng(1).normal(0, 0.01, (61, 61))
    >>> image = CCDData(2 * light + noise, unit="uJy", wcs=wcs)
    >>> table = psf_photometry(image, psf, QTable({"sky": sky}))
    >>> print(f"{table['flux'][0]:.2f} +- {table['flux_err'][0]:.2f}")
    2.02 uJy +- 0.06 uJy
    """
    arrays = image_arrays(image, "image")
    ids, sky = catalog_sources(catalog)["id"], catalog["sky"]
    n = len(ids)
    scale = pixel_scale(image.wcs)
    model = psf_mosaic(
        psf, scale * ANGLE, pa, grid_angle=grid_angle(image.wcs, arrays.flux.shape), resampling=None
    )
    width = model.fwhm
    side = positive(4 * width, ANGLE, "psf") / scale
    side = max(3, 2 * int(np.ceil((side - 1) / 2)) + 1)
    bound = None
    if max_shift is None:
        model.x_0.fixed = model.y_0.fixed = True
    else:
        bound = positive(max_shift, ANGLE, "max_shift") / scale
    xy = sky_pixels(sky, image.wcs, arrays.flux.shape, side / 2)
    rows = np.flatnonzero(np.isfinite(xy[:, 0]))
    found, flags = {name: np.full(n, np.nan) for name in _FITTED}, np.full(n, _NO_OVERLAP)
    if len(rows):
        fitted = _fit(arrays, model, xy[rows], side, bound, width.value / scale)
        for name, values in found.items():
            values[rows] = np.ma.filled(np.ma.asarray(fitted[name], float), np.nan)
        flags[rows] = fitted["flags"]
    if max_shift is None:
        # errors of a position that is kept are none; its place is
        found["x_fit"][rows], found["y_fit"][rows] = xy[rows].T
    shift = np.hypot(found["x_fit"] - xy[:, 0], found["y_fit"] - xy[:, 1]) * scale
    near = np.zeros(n, bool)
    distance = np.abs(xy[rows, None] - xy[None, rows]).max(axis=2)
    np.fill_diagonal(distance, np.inf)
    near[rows] = (distance < side / 2).any(axis=1)
    columns = {
        "id": (ids, "Id of the catalog"),
        "sky": (sky, "Position of the catalog"),
        "flux": (found["flux_fit"] * FNU, "Flux of the PSF"),
        "flux_err": (found["flux_err"] * FNU, "1-sigma error, if the noise is not correlated"),
        "x_fit": (found["x_fit"], "Fitted position, 0-based"),
        "y_fit": (found["y_fit"], "Fitted position, 0-based"),
        "shift": (shift * ANGLE, "From the position of the catalog to the fitted one"),
        "chi2": (found["reduced_chi2"], "Reduced chi^2"),
        "qfit": (found["qfit"], "Sum of absolute residuals over the flux"),
        "cfit": (found["cfit"], "Residual of the central pixel over the flux"),
        "neighbor": (near, "Another row is within the fitted square: the flux is not its own"),
        "flags": (flags, _describe_flags()),
    }
    meta = provenance(method="photutils PSFPhotometry", fit_size=round(side * scale, 6))
    return described_table(columns, meta)


def _fit(arrays, model, xy, side, bound, width):
    """Run photutils on the flux per pixel."""
    photometry = PSFPhotometry(
        model, (side, side), grouper=None, xy_bounds=bound, aperture_radius=max(width, 1.5),
    )  # fmt: skip
    with warnings.catch_warnings():
        # what did not converge or has no pixels is in the flags
        warnings.simplefilter("ignore", AstropyUserWarning)
        return photometry(
            arrays.flux,
            mask=~arrays.usable,
            error=np.where(arrays.usable, arrays.sigma, 1.0),
            init_params=Table({"x": xy[:, 0], "y": xy[:, 1]}),
        )


def _describe_flags():
    bits = [(f.bit_value, f.description) for f in PSF_FLAGS.FLAG_DEFINITIONS]
    return "bit flags (sum): " + ", ".join(f"{bit} {text}" for bit, text in bits) + "; 0 good"
