"""Numbers that describe a PSF: encircled energy and its radii, width, tables of them."""

import math

import astropy.units as u
import numpy as np
from scipy.optimize import least_squares

from miricigale.instrument import imager_filters, psf_fwhm
from miricigale.psf import _core
from miricigale.psf.by_filter import exposure_psf
from miricigale.psf.effects import detector_response
from miricigale.psf.model import enclosed_light, instrument_psf
from miricigale.utils.options import check_choice, check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.package_tables import declared
from miricigale.utils.tables import described_rows
from miricigale.utils.units import ANGLE, scalar


def _psf_or_model(psf):
    """Return a PSF that states its pixel, or the model of the filter that is named."""
    if isinstance(psf, str):
        return exposure_psf(psf)
    return instrument_psf(psf)


@takes_other_keywords
def encircled_energy(psf, radius, *, pixel_scale=None):
    """
    Return the fraction of a point source's light inside circles around the center.

    Parameters
    ----------
    psf : `~photutils.psf.ImagePSF` or str
        A PSF with the meta of `~miricigale.psf.make_psf`; or a filter, whose model for a single exposure is taken.
    radius : `~astropy.units.Quantity`
        Scalar or array of radii.
    pixel_scale : `~astropy.units.Quantity`, optional
        If given, the fraction is that of a sum over an image of such pixels, each taken as
        constant over its square (the mean over all positions of the center on a pixel).

    Returns
    -------
    fraction : float or `~numpy.ndarray`
        Of all light, also of that beyond the PSF's grid.

    Raises
    ------
    ValueError
        If a radius is negative or its circle leaves the grid.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.psf import encircled_energy, gaussian_psf
    >>> psf = gaussian_psf(0.3 * u.arcsec, pixel_scale=0.1 * u.arcsec, fov=4 * u.arcsec)
    >>> encircled_energy(psf, [0.15, 0.3, 0.6] * u.arcsec).round(3)
    array([0.499, 0.937, 1.   ])
    """
    psf = _psf_or_model(psf)
    data = psf.data
    if pixel_scale is not None:
        scale = scalar(pixel_scale, ANGLE, "pixel_scale")
        # sums over cells take them as constant too
        width = math.sqrt(max(scale**2 - psf.cell**2, 0.0)) / psf.pixel_scale.value
        data = detector_response(data, oversampling=psf.n_cells, pixel=False, boxes=(width,))
    return enclosed_light(psf, data, radius)


@takes_other_keywords
def radius_of_encircled_energy(psf, fraction):
    """
    Return the radius of the circle that holds a fraction of the light.

    Parameters
    ----------
    psf : `~photutils.psf.ImagePSF` or str
        A PSF with the meta of `~miricigale.psf.make_psf`; or a filter, whose model for a single exposure is taken.
    fraction : float
        Of all light, between 0 and 1.

    Returns
    -------
    radius : `~astropy.units.Quantity`
        In arcsec.

    Raises
    ------
    ValueError
        If the grid does not hold the fraction.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.psf import gaussian_psf, radius_of_encircled_energy
    >>> psf = gaussian_psf(0.3 * u.arcsec, pixel_scale=0.1 * u.arcsec, fov=4 * u.arcsec)
    >>> print(f"{radius_of_encircled_energy(psf, 0.5):.3f}")
    0.150 arcsec
    """
    psf = _psf_or_model(psf)
    cells = np.arange(0.0, psf.half_width / psf.cell, 0.25)
    x, y = psf.origin
    sums = _core.radial_sums(psf.data, x, y, cells) / psf.n_cells**2
    wanted = f"positive and at most the {sums[-1]:.4f} that the PSF's grid holds"
    check_that(0 < fraction <= min(1, sums[-1]), "fraction", wanted, fraction)
    k = int(np.argmax(sums >= fraction))
    if k == 0:
        return 0.0 * ANGLE
    part = (fraction - sums[k - 1]) / (sums[k] - sums[k - 1])
    return (cells[k - 1] + part * 0.25) * psf.cell * ANGLE


@takes_other_keywords
def fwhm(psf, *, method="half_maximum"):
    """
    Return the full width at half maximum.

    Parameters
    ----------
    psf : `~photutils.psf.ImagePSF` or str
        A PSF with the meta of `~miricigale.psf.make_psf`; or a filter, whose model for a single exposure is taken.
    method : {"half_maximum", "gaussian"}, optional
        Where the azimuthal mean falls to a half (the attribute ``fwhm``), or that of a round
        Gaussian fitted out to 0.75 FWHM, the usual way to measure stars. The core of a
        diffraction pattern falls more steeply than a Gaussian: the fit is 1-3 % narrower.

    Returns
    -------
    fwhm : `~astropy.units.Quantity`
        In arcsec.

    Raises
    ------
    ValueError
        If the method is unknown.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.psf import fwhm, gaussian_psf
    >>> psf = gaussian_psf(0.3 * u.arcsec, pixel_scale=0.1 * u.arcsec, fov=4 * u.arcsec)
    >>> print(f"{fwhm(psf):.3f}, {fwhm(psf, method='gaussian'):.3f}")
    0.300 arcsec, 0.300 arcsec
    """
    psf = _psf_or_model(psf)
    check_choice(method, "method", ("half_maximum", "gaussian"))
    if method == "half_maximum":
        return psf.fwhm
    start = psf.fwhm.value / psf.cell
    x, y = psf.origin
    return _gaussian_width(psf.data, x, y, start) * psf.cell * ANGLE


def _gaussian_width(data, x, y, start):
    yy, xx = np.indices(data.shape)
    r = np.hypot(xx - x, yy - y)
    inside = r < 0.75 * start
    r2 = r[inside] ** 2
    values = data[inside]

    def residual(p):
        return p[0] * np.exp(-4 * np.log(2) * r2 / p[1] ** 2) - values / values.max()

    return float(least_squares(residual, [1.0, start]).x[1])


def _r80(psf):
    try:
        return radius_of_encircled_energy(psf, 0.8).value
    except ValueError:
        return np.nan


@takes_other_keywords
def psf_table(psfs, *, radii=(0.5, 1.0, 1.5, 2.5, 5.0) * u.arcsec):
    """
    Tabulate PSFs: width, radius of 80 %, encircled energies.

    Parameters
    ----------
    psfs : iterable of `~photutils.psf.ImagePSF`
        PSFs with the meta of `~miricigale.psf.make_psf`.
    radii : `~astropy.units.Quantity`, optional
        Radii of the encircled energies.

    Returns
    -------
    table : `~astropy.table.QTable`
        Columns ``filter``, ``frame``, ``angle`` (NaN on the detector), ``includes``, ``fwhm``,
        ``fwhm_gaussian``, ``fwhm_flight`` (NaN but for MIRI's filters), ``r80`` (NaN if the
        grid holds less), ``enclosed`` and ``eef_<radius>``, with units and descriptions.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.psf import miri_psf, psf_table
    >>> table = psf_table([miri_psf("F1500W", fov=6 * u.arcsec)], radii=[0.5, 1] * u.arcsec)
    >>> for name in ("fwhm", "fwhm_flight", "eef_0.5", "eef_1"):
    ...     table[name].info.format = ".3f"
    >>> print(table["filter", "fwhm", "fwhm_flight", "eef_0.5", "eef_1"])
       filter    fwhm  fwhm_flight eef_0.5 eef_1
                arcsec    arcsec
    ----------- ------ ----------- ------- -----
    miri.f1500w  0.513       0.488   0.681 0.818
    """
    texts = dict(declared("miricigale.psf", "columns.toml"))
    radius_of_column = {}
    for radius in radii:
        name = f"eef_{radius.to_value(ANGLE):g}"
        radius_of_column[name] = radius
        texts[name] = f"fraction of all light within {radius}"
    rows = []
    for i, item in enumerate(psfs):
        psf = instrument_psf(item, f"psfs[{i}]")
        name = psf.filter or ""
        row = {
            "filter": name,
            "frame": psf.frame,
            "angle": np.nan * u.deg,
            "includes": " ".join(psf.includes),
            "fwhm": psf.fwhm,
            "fwhm_gaussian": fwhm(psf, method="gaussian"),
            "fwhm_flight": np.nan * ANGLE,
            "r80": _r80(psf) * ANGLE,
            "enclosed": psf.enclosed,
        }
        if psf.frame == "sky":
            row["angle"] = psf.angle
        if name in imager_filters():
            row["fwhm_flight"] = psf_fwhm(name)
        for column, radius in radius_of_column.items():
            row[column] = encircled_energy(psf, radius)
        rows.append(row)
    return described_rows(rows, texts)
