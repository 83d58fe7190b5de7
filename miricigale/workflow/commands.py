"""What the smaller commands of the command line do, for use in code too."""

from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable

from miricigale.filters import Filter
from miricigale.fitting import BayesFitter
from miricigale.instrument import (
    ceers_exposures,
    proposal_limit,
    psf_fwhm,
    saturation_forecast,
    scaled_limit,
)
from miricigale.photometry import ForcedPhotometer, detect_sources
from miricigale.psf import MatchingKernel, hst_psf, miri_psf, psf_mosaic
from miricigale.sed import SEDModel
from miricigale.utils.exceptions import DataError, argument_error
from miricigale.utils.tables import error_column
from miricigale.workflow.products import read_image

__all__ = ["filter_table", "fit_table", "measure_files", "plan_table"]


def filter_table(pattern=""):
    """
    The filters whose name holds a text.

    Parameters
    ----------
    pattern : str, optional
        Part of the name; all if empty.

    Returns
    -------
    table : `~astropy.table.QTable`
        ``name``, ``pivot`` and ``width`` (um).
    """
    names = [name for name in Filter.names() if pattern.lower() in name]
    filters = [Filter.from_name(name) for name in names]
    return QTable(
        {
            "name": np.array(names, dtype=str),
            "pivot": u.Quantity([f.pivot for f in filters], u.um) if names else [] * u.um,
            "width": u.Quantity([f.width for f in filters], u.um) if names else [] * u.um,
        }
    )


def plan_table(*, quick=False):
    """
    The CEERS exposures: time, filling of the well by the sky, limits.

    Parameters
    ----------
    quick : bool, optional
        Whether of the quick exposures.

    Returns
    -------
    table : `~astropy.table.QTable`
        A row for each band.
    """
    exposures = ceers_exposures(SkyCoord(0 * u.deg, 0 * u.deg), 0 * u.deg, quick=quick)
    names = list(dict.fromkeys(e.filter for e in exposures))
    rows = []
    for name in names:
        mine = [e for e in exposures if e.filter == name]
        time = u.Quantity([e.exposure_time for e in mine]).sum()
        rows.append(
            (
                name,
                mine[0].n_groups,
                mine[0].n_integrations,
                len(mine),
                np.round(time.to(u.s), 1),
                round(float(saturation_forecast(mine[0])), 3),
                np.round(scaled_limit(name, time).to(u.ABmag), 2),
                np.round(proposal_limit(name), 2),
                psf_fwhm(name),
            )
        )
    columns = ("filter", "groups", "integrations", "dithers", "time", "sky_in_well")
    columns += ("limit_etc", "limit_proposal", "fwhm")
    return QTable(rows=rows, names=columns)


def _read_table(path):
    path = Path(path)
    if not path.is_file():
        msg = f"no table {path}"
        raise DataError(msg)
    try:
        return QTable.read(path)
    except (OSError, ValueError, TypeError) as err:
        msg = f"{path} cannot be read as a table (ECSV or FITS): {str(err).splitlines()[0]}"
        raise DataError(msg) from err


def fit_table(
    path, *, axes="fit", redshift=None, model_error=0.1, executor=None, progress_bar=False
):
    """
    Fit a table of photometry with the chain of Yang et al. 2021.

    Parameters
    ----------
    path : path-like
        ECSV or FITS with ``id`` and, for each band, ``<filter>`` and ``<filter>_err``.
    axes : {"fit", "quick"}, optional
        Model grid; see `miricigale.sed.yang2021_axes`.
    redshift : str, optional
        Column of known redshifts; fitted if not given.
    model_error : float, optional
        Relative model error.
    executor : `concurrent.futures.Executor`, optional
        Workers.
    progress_bar : bool, optional
        Whether progress is shown.

    Returns
    -------
    results : `~miricigale.fitting.FitResults`

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If there is no such file.
    ValueError
        If no column is a flux in a known filter with an error beside it.
    """
    table = _read_table(path)
    known = set(Filter.names())
    bands = [
        name
        for name in table.colnames
        if (name in known or name.startswith("sedpy.")) and error_column(name) in table.colnames
    ]
    if not bands:
        raise argument_error(
            "photometry",
            "a table with columns <filter> and <filter>_err ('miricigale filters' lists the names)",
            f"columns {table.colnames}",
        )
    fitter = BayesFitter(
        SEDModel.yang2021(), bands, axes=SEDModel.yang2021_axes(axes), model_error=model_error
    )
    return fitter.fit(table, redshift=redshift, executor=executor, progress_bar=progress_bar)


def measure_files(image, highres, *, filter, pa_aper):
    """
    Detect on a high-resolution image and measure on a MIRI mosaic.

    Parameters
    ----------
    image, highres : path-like
        FITS files with SCI, ERR (and MASK) in MJy/sr, north up, background subtracted.
    filter : str
        Filter of the mosaic.
    pa_aper : float
        Position angle of the detector's y axis in degrees.

    Returns
    -------
    table : `~astropy.table.QTable`
        ``id``, ``sky``, flux, error and flags of every detection.
    """
    mosaic, prior = read_image(image), read_image(highres)
    scales = [
        np.sqrt(abs(np.linalg.det(i.wcs.pixel_scale_matrix))) * 3600 * u.arcsec
        for i in (mosaic, prior)
    ]
    kernel = MatchingKernel.from_psfs(
        hst_psf(pixel_scale=scales[1]),
        psf_mosaic(miri_psf(filter), scales[0], pa_aper * u.deg),
        pixel_scale=scales[1],
    )
    segmentation, detected = detect_sources(prior)
    return ForcedPhotometer(kernel).measure(mosaic, prior, segmentation, detected).to_table()
