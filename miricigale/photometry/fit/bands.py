"""Several bands with the same sources: measured with the same templates, joined in one table."""

import dataclasses

import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable, Table

from miricigale.photometry.detection.catalogs import joined_sky
from miricigale.photometry.fit.exposure_kernels import are_exposures
from miricigale.photometry.fit.forced import ForcedPhotometer
from miricigale.photometry.fit.result_table import new_ids
from miricigale.photometry.fit.results import band_column
from miricigale.photometry.fit.stars import with_stars
from miricigale.photometry.images.arrays import sky_pixels
from miricigale.photometry.images.flags import ForcedFlags
from miricigale.photometry.images.mosaics import as_mosaic
from miricigale.photometry.images.repeated_pixels import own_pixels
from miricigale.photometry.templates.sources import SourceTemplates
from miricigale.utils.meta import provenance
from miricigale.utils.named_values import first_value
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.result_table import ResultTable
from miricigale.utils.units import own_unit


@takes_other_keywords
def measure_bands(images, kernels, templates, **options):
    """
    Measure the same sources on images of several bands.

    Parameters
    ----------
    images : dict of str to `~astropy.nddata.CCDData`
        The images by name of the filter; lists of exposures are fitted together.
    kernels : dict of str to `~miricigale.psf.MatchingKernel` or `ForcedPhotometer`
        From the high-resolution image to each of them, or what measures it.
    templates : `SourceTemplates`
        The sources.
    **options
        Options of the `ForcedPhotometer` for those bands whose kernel is given.

    Returns
    -------
    results : dict of str to `ForcedPhotometryResult`
        By name of the filter, in the order of the images; `join_bands` makes one table of them.

    Raises
    ------
    ValueError, TypeError, `~astropy.units.UnitsError`
        If a band has no kernel or an input does not fit; a note names the band.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropy.coordinates import SkyCoord
    >>> from astropy.nddata import CCDData
    >>> from astropy.table import QTable
    >>> from miricigale.instrument import north_up_wcs
    >>> from miricigale.photometry import ForcedPhotometer, SourceTemplates, measure_bands
    >>> from miricigale.psf import gaussian_psf, psf_image
    >>> psf = gaussian_psf(0.4 * u.arcsec, pixel_scale=0.1 * u.arcsec, fov=4 * u.arcsec)
    >>> sky = SkyCoord([53.1], [-27.8], unit="deg")
    >>> wcs = north_up_wcs(sky[0], 0.1 * u.arcsec, (61, 61))
    >>> light = psf_image(psf, pixel_scale=0.1 * u.arcsec, shape=61)
    >>> noise = np.random.default_rng(1).normal(0, 0.01, (61, 61))
    >>> image = CCDData(2 * light + noise, unit="uJy", wcs=wcs)
    >>> templates = SourceTemplates.from_catalog(QTable({"sky": sky}))
    >>> images = {"miri.f770w": image, "miri.f1000w": image.multiply(2)}
    >>> kernels = dict.fromkeys(images, ForcedPhotometer(psf=psf))
    >>> for name, result in measure_bands(images, kernels, templates).items():
    ...     print(f"{name} {result.flux[0]:.2f}")
    miri.f770w 2.02 uJy
    miri.f1000w 4.05 uJy
    """
    missing = sorted(set(images) ^ set(kernels))
    check_that(not missing, "kernels", "one for each image", f"not in both: {missing}")

    def measure(name, image):
        photometer = kernels[name]
        if not isinstance(photometer, ForcedPhotometer):
            photometer = ForcedPhotometer(photometer, **options)
        return photometer.measure(image, templates=templates)

    return _each_band(measure, images)


def _each_band(measure, images):
    """Call a function with name and image of each band: dict by name. Errors say of which band they are."""
    results = {}
    for name, image in images.items():
        try:
            results[name] = measure(name, image)
        except (ValueError, TypeError) as err:
            err.add_note(f"in the band {name!r}")
            raise
    return results


def measure_prior(images, photometers, highres, segmentation, catalog):
    """
    Measure the sources of a prior on images of several bands, and with them what any of these shows beyond it.

    Parameters
    ----------
    images, photometers : dict of str to `~astropy.nddata.CCDData` and to `ForcedPhotometer`
        By name of the filter, with the same templates.
    highres, segmentation, catalog
        As for `ForcedPhotometer.measure`.

    Returns
    -------
    results : dict of str to `ForcedPhotometryResult`
        Of the same sources in all bands: those of the catalog, and after them new ones, flagged
        ``NOT_IN_CATALOG``, where a photometer found some. Of those within half the width of the PSF of one that
        another band has shown there is one.
    """
    opened = {}
    for name, image in images.items():
        if are_exposures(image):
            opened[name] = list(map(as_mosaic, image))
        else:
            opened[name] = own_pixels(as_mosaic(image))
    photometers = {name: p.on_pixels(images[name], highres) for name, p in photometers.items()}
    stars = {}
    for name, photometer in photometers.items():
        if photometer.psf_stars is not False and not photometer.bare:
            photometers[name], stars[name] = with_stars(photometer, opened[name], catalog, highres)
    results = _measure_prior(opened, photometers, highres, segmentation, catalog)
    for name, band_stars in stars.items():
        results[name] = band_stars.noted(results[name])
    return results


def _measure_prior(images, photometers, highres, segmentation, catalog):
    """Measure as `measure_prior` does, without stars."""
    # without PSFs there are no wings
    first = min(photometers.values(), key=lambda photometer: photometer.bare)
    is_near = np.zeros(len(catalog), bool)
    for name, image in images.items():
        reach = len(photometers[name].mean_kernel.target)
        exposures = image if isinstance(image, list) else [image]
        for exposure in exposures:
            xy = sky_pixels(catalog["sky"], exposure.wcs, exposure.shape, reach)
            is_near |= np.isfinite(xy[:, 0])
    # templates of sources on some image; the others are points that no fit sees
    templates = first._templates(highres, segmentation, catalog[is_near])
    if not is_near.all():
        parts = [templates, SourceTemplates.from_catalog(catalog[~is_near])]
        order = np.argsort(np.concatenate([np.flatnonzero(is_near), np.flatnonzero(~is_near)]))
        joined = SourceTemplates.concatenate(parts)[order]
        templates = dataclasses.replace(joined, meta=templates.meta)
    if first.bare:
        # kernels are not alike
        templates = dataclasses.replace(templates, psf=None)
    # bands that show sources which the catalog lacks are measured with those of all bands, and not before
    results = _each_band(
        lambda name, image: photometers[name]._measure_or_find(image, templates), images
    )
    # sources that the bands have found, each once
    sky = SkyCoord([], [], unit="deg")
    for result in results.values():
        if result.new_sources is None or not len(result.new_sources):
            continue
        new = result.new_sources["sky"].icrs
        if len(sky):
            # within half the width of the PSF it is the same source
            new = new[new.match_to_catalog_sky(sky)[1] > result.psf_fwhm / 2]
        sky = joined_sky([sky, new])
    if not len(sky):
        return results
    points = SourceTemplates.from_catalog(
        QTable({"id": new_ids(templates.id, len(sky)), "sky": sky})
    )
    columns = {"flags": np.full(len(sky), int(ForcedFlags.NOT_IN_CATALOG))}
    if templates.flux is not None:
        columns["flux"] = np.full(len(sky), 0.0)
    if templates.components is not None:
        columns["components"] = np.full(len(sky), 1)
    points = dataclasses.replace(points, **columns)
    joined = SourceTemplates.concatenate([templates, points])
    joined = dataclasses.replace(joined, meta=templates.meta)
    # the same sources in all bands, without a search of their own
    last_pass = {}
    for name, photometer in photometers.items():
        last_pass[name] = photometer.replace(second_pass=False)
    last_results = measure_bands(images, last_pass, joined)
    for name, result in last_results.items():
        result.meta["second_pass"] = results[name].meta["second_pass"]
    return last_results


@takes_other_keywords
def join_bands(results):
    """
    Put the photometry of several bands in one table, by id.

    Parameters
    ----------
    results : dict of str to `ForcedPhotometryResult` or `~astropy.table.QTable`
        By name of the filter; tables as `ForcedPhotometryResult.to_table` makes them without
        a name, or some of their columns.

    Returns
    -------
    table : `~astropy.table.QTable`
        ``id`` and ``sky`` (of the first band that has it), and for each band ``<name>``,
        ``<name>_err``, ``<name>_flags`` and so on. A row for each id that any band has, in the order
        in which they come; where a band lacks it its flux is NaN and flagged ``NO_DATA``.

    Raises
    ------
    ValueError
        If there is no band.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropy.coordinates import SkyCoord
    >>> from astropy.table import QTable
    >>> from miricigale.photometry import join_bands
    >>> sky = SkyCoord([53.10, 53.11], [-27.8, -27.8], unit="deg")
    >>> blue = QTable({"id": [1, 2], "sky": sky, "flux": [1.0, 2.0] * u.uJy})
    >>> red = QTable({"id": [2], "sky": sky[1:], "flux": [3.0] * u.uJy})
    >>> print(join_bands({"miri.f770w": blue, "miri.f1500w": red})["id", "miri.f770w", "miri.f1500w"])
     id miri.f770w miri.f1500w
           uJy         uJy
    --- ---------- -----------
      1        1.0         nan
      2        2.0         3.0
    """
    check_that(results, "results", "at least one band", "none")
    tables = {}
    bands = {}
    for name, result in results.items():
        tables[name] = result if isinstance(result, Table) else result.to_table()
        if tables[name].meta:
            bands[name] = dict(tables[name].meta)
    # the first table that has an id, and its row there
    rows = {}
    for table in tables.values():
        for k, key in enumerate(np.asarray(table["id"]).tolist()):
            rows.setdefault(key, (table, k))
    ids = list(rows)
    meta = provenance(stage="photometry")
    if bands:
        meta["bands"] = bands
    joined = ResultTable(meta=meta)
    first = first_value(tables)
    joined["id"] = np.array(ids) if ids else np.asarray(first["id"])[:0]
    if all(np.array_equal(table["id"], first["id"]) for table in tables.values()):
        joined["sky"] = first["sky"]
    else:
        joined["sky"] = SkyCoord([table["sky"][k].icrs for table, k in rows.values()])
    for name, table in tables.items():
        # rows of this band in the order of the ids; -1 if it lacks one
        row_of_id = {key: k for k, key in enumerate(np.asarray(table["id"]).tolist())}
        index = np.array([row_of_id.get(key, -1) for key in ids], int)
        for column in table.colnames:
            label = band_column(column, name)
            if label == column:
                continue
            joined[label] = spread_rows(table[column], index, column)
            joined[label].info.description = table[column].info.description
    return joined


def spread_rows(values, index, column):
    """
    Take rows of a column by number, filled for those that are missing (-1).

    Missing numbers are NaN or 0, texts "none", and ``flags``, if that is the name of the column, ``NO_DATA``.
    """
    if np.all(index >= 0):
        return values[index].copy()
    kind = np.asarray(values).dtype.kind
    empty = {"f": np.nan, "b": False, "U": "none"}.get(kind, 0)
    if column == "flags":
        empty = int(ForcedFlags.NO_DATA)
    spread = np.where(index >= 0, np.asarray(values)[index], empty)
    unit = own_unit(values)
    if unit is None:
        return spread
    return spread * unit
