"""Forced photometry of files: what they are is checked first, then measured and put on a page."""

import logging
import os
import tempfile
import warnings
from pathlib import Path

import numpy as np
from astropy.io.fits.verify import VerifyWarning

from miricigale.filters import Filter
from miricigale.instrument.image_files import write_image
from miricigale.photometry.grids import grid_angle
from miricigale.photometry.kernel_files import can_be_modeled, file_place, matching_kernel
from miricigale.photometry.mosaics import MosaicFile
from miricigale.utils.exceptions import DataError, PhotometryWarning, argument_error
from miricigale.utils.files import split_extension
from miricigale.utils.progress import progress
from miricigale.utils.store import replacing
from miricigale.utils.tables import error_column

_log = logging.getLogger(__name__)

#: Endings of tables that can be written.
_TABLES = (".ecsv", ".fits", ".fits.gz")

#: Largest number of empty positions at which errors are tested.
_EMPTY = 400


def measure_files(
    image,
    highres,
    *,
    segmentation=None,
    catalog=None,
    kernel=None,
    background_order=0,
    max_shift=None,
    output=None,
    page=None,
    model=None,
    residual=None,
    overwrite=False,
    seed=1,
    n_threads=None,
    progress_bar=False,
    **options,
):
    """
    Measure the sources of a high-resolution image on another one, from files to files.

    Parameters
    ----------
    image, highres : path-like or `~miricigale.photometry.MosaicFile`
        The image and the prior; as `~miricigale.photometry.MosaicFile` with what is not in their headers, such as
        filters, maps of the noise and PSFs.
    segmentation, catalog : path-like, optional
        See `~miricigale.photometry.read_prior`. Without a segmentation sources are detected
        on the prior.
    kernel : path-like, optional
        From the prior's resolution to that of the image, on the prior's pixels; see
        ``miricigale.photometry.kernel_files.read_kernel``. Without a PSF of the prior sources are
        the segments as they are, and those without one are not measured.
    background_order : int or None, optional
        Order of the background that is fitted with the sources, 0 for a constant; none is fitted if None.
    max_shift : `~astropy.units.Quantity`, optional
        If given, a shift of the image up to this is fitted.
    output, page, model, residual : path-like, optional
        Where the table (ECSV or FITS), the HTML page and FITS images of the fitted model (with its
        background) and of the residual are written; not if None.
    overwrite : bool, optional
        Whether files that are there are replaced.
    seed : int, optional
        Seed of the empty positions at which errors are tested, for the page.
    n_threads : int, optional
        Number of threads; all by default.
    progress_bar : bool, optional
        Whether progress is shown.
    **options
        Others of `~miricigale.photometry.ForcedPhotometer`, such as ``second_pass``: what the prior lacks is
        then in the last rows of the table, flagged ``NOT_IN_CATALOG``.

    Returns
    -------
    table : `~astropy.table.QTable`
        ``id``, ``sky``, ``<filter>``, ``<filter>_err``, ``<filter>_flags`` and so on.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If a file is missing, damaged, or without unit or coordinates.
    ValueError
        If an argument contradicts a header, the images do not overlap or
        seem to be swapped, a PSF is missing, or a result cannot be written.

    Examples
    --------
    >>> from miricigale.photometry import measure_files
    >>> table = measure_files(
    ...     "f770w_i2d.fits", "f444w_i2d.fits", output="f770w.ecsv", page="f770w.html"
    ... )  # doctest: +SKIP
    """
    image, highres = (
        one if isinstance(one, MosaicFile) else MosaicFile(one) for one in (image, highres)
    )
    extras = {"segmentation": segmentation, "catalog": catalog, "kernel": kernel}
    extras.update(psf=image.psf, highres_psf=highres.psf)
    inputs = [one for one in extras.values() if one is not None]
    results = {"output": output, "page": page, "model": model, "residual": residual}
    for what, path in results.items():
        _check_output(what, path, overwrite, [image.path, highres.path, *inputs])
    written = [Path(path).resolve() for path in results.values() if path is not None]
    if len(set(written)) < len(written):
        given = ", ".join(what for what, path in results.items() if path is not None)
        raise argument_error(given, "different files", [str(path) for path in written])
    _check_images(image, highres)
    for what, path in extras.items():
        if path is not None and not os.path.isfile(file_place(path)[0]):
            msg = f"no file {path} ('{what}')"
            raise DataError(msg)
    if catalog is not None:
        _check_catalog(catalog, image, highres)
    _check_psfs(image, highres, kernel)
    filter_ = image.header.filter
    # heavy imports only after the files were checked
    from miricigale.photometry import ForcedPhotometer, read_prior
    from miricigale.photometry.priors import detected_prior

    with progress(show=progress_bar, total=4, desc="images", unit="steps") as bar:
        mosaic, prior = image.read(), highres.read()
        bar.update()
        bar.set_description("kernel and sources")
        matching = matching_kernel(image, highres, kernel)
        if segmentation is None:
            segments, sources = detected_prior(prior, catalog)
        else:
            segments, sources = read_prior(prior, segmentation=segmentation, catalog=catalog)
        bar.update()
        bar.set_description("fluxes")
        photometer = ForcedPhotometer(
            matching, background_order=background_order, max_shift=max_shift, n_threads=n_threads,
            **options,
        )  # fmt: skip
        result = photometer.measure(mosaic, prior, segments, sources)
        table = _with_new_sources(result.to_table(filter_), result.new_sources, filter_)
        table.meta.update(image=str(image.path), highres=str(highres.path))
        bar.update()
        bar.set_description("page")
        for path in written:
            path.parent.mkdir(parents=True, exist_ok=True)
        if output is not None:
            with replacing(output, overwrite=overwrite) as partial, warnings.catch_warnings():
                # keywords of more than eight letters
                warnings.simplefilter("ignore", VerifyWarning)
                table.write(partial)
        for path, picture in ((model, result.model_image), (residual, result.residual_image)):
            if path is not None:
                with replacing(path) as partial:
                    write_image(picture, partial)
        if page is not None:
            from miricigale.photometry.page import photometry_page

            pulls = _pulls(result, matching, seed, n_threads)
            photometry_page(result, filter_, mosaic, prior, matching, pulls, segments).write(page)
        bar.update()
    return table


def _with_new_sources(table, new, filter_):
    """A table and, in its last rows, the sources that the catalog lacks."""
    if new is None or len(new) == 0:
        return table
    from astropy.table import QTable, vstack

    from miricigale.photometry.bands import spread_rows

    known = {"id": "id", "sky": "sky", filter_: "flux", error_column(filter_): "flux_err"}
    known.update({f"{filter_}_{name}": name for name in ("flags", "snr", "coverage", "chi2")})
    absent = np.full(len(new), -1)
    rows = {
        name: new[known[name]] if name in known else spread_rows(table[name], absent, name)
        for name in table.colnames
    }
    rows[f"{filter_}_template"] = np.full(len(new), "point")
    return vstack([table, QTable(rows)], metadata_conflicts="silent")


def _check_output(what, path, overwrite, inputs):
    """Refuse a file that could not be written in the end, or that is not to be replaced."""
    if path is None:
        return
    path = Path(path)
    if what == "output" and not path.name.lower().endswith(_TABLES):
        raise argument_error("output", f"a table ({', '.join(_TABLES)})", path)
    if what in ("model", "residual") and not path.name.lower().endswith((".fits", ".fits.gz")):
        raise argument_error(what, "a FITS file (.fits, .fits.gz)", path)
    if path.is_dir():
        raise argument_error(what, "a file", f"the folder {path}")
    if any(path.resolve() == Path(split_extension(one)[0]).resolve() for one in inputs):
        raise argument_error(what, "another file than those that are read", path)
    if path.exists() and not overwrite:
        raise argument_error(what, "a new file (or 'overwrite' given)", f"{path}, which is there")
    folder = path.parent
    while not folder.exists():
        folder = folder.parent
    try:
        # permission bits are not enough for a superuser or on a read-only disk
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as err:
        raise argument_error(what, "in a folder that can be written to", path) from err


def _check_images(image, highres):
    """Refuse images that are not what they should be, or do not overlap."""
    wanted, stated = image.filter, [MosaicFile(one.path).header.filter for one in (image, highres)]
    if wanted is not None and stated[0] not in (None, wanted) and stated[1] == wanted:
        msg = (
            f"'image' and 'highres' seem to be swapped: {highres.path} is the image in {wanted}, "
            f"{image.path} is in {stated[0]}"
        )
        raise ValueError(msg)
    found, _ = (one.header.filter for one in (image, highres))
    if found is None:
        wanted = f"given, for the header of {image.path} does not name it"
        raise argument_error("filter", wanted, None)
    if found not in Filter.names() and not found.startswith("sedpy."):
        wanted = f"a filter that 'miricigale filters' lists, for {image.path}"
        raise argument_error("filter", wanted, repr(found))
    for one in (image, highres):
        try:
            grid_angle(one.header.wcs, one.header.shape)
        except ValueError as err:
            msg = f"{one.path}: {err}"
            raise ValueError(msg) from err
    if not (_overlap(image.header, highres.header) or _overlap(highres.header, image.header)):
        where = [_middle(one.header).to_string("decimal", precision=4) for one in (image, highres)]
        msg = (
            f"'image' and 'highres' show different fields: the middle of {image.path} is at "
            f"{where[0]}, that of {highres.path} at {where[1]} deg"
        )
        raise ValueError(msg)


def _middle(header):
    ny, nx = header.shape
    return header.wcs.pixel_to_world((nx - 1) / 2, (ny - 1) / 2).icrs


def _inside(sky, header):
    """Whether some positions are on an image."""
    from miricigale.photometry.arrays import sky_pixels

    return np.isfinite(sky_pixels(sky, header.wcs, header.shape, 0.0)).any()


def _overlap(one, other):
    """Whether some of a coarse grid of pixels of one image are on the other."""
    axes = [np.linspace(0, n - 1, 15) for n in one.shape]
    y, x = (grid.ravel() for grid in np.meshgrid(*axes, indexing="ij"))
    return _inside(one.wcs.pixel_to_world(x, y), other)


def _check_psfs(image, highres, kernel):
    """Refuse images whose PSF is neither given nor known."""
    from miricigale.psf import MODEL_FILTERS

    if kernel is not None:
        if image.psf is not None:
            raise argument_error("psf", "left out where a kernel is given", image.psf)
        return
    for file, prefix in ((image, ""), (highres, "highres_")):
        name = file.header.filter
        if file.psf is not None or can_be_modeled(file.header):
            continue
        if name in MODEL_FILTERS:
            wanted = f"given, for the header of {file.path} has no PA_APER (or '{prefix}psf')"
            raise argument_error(prefix + "pa_aper", wanted, None)
        name = name or "an image whose filter is unknown ('highres_filter')"
        wanted = f"given (or 'kernel'), for there is no model PSF for {name}"
        raise argument_error(prefix + "psf", wanted, None)


def _check_catalog(path, image, highres):
    """Refuse a catalog of another field."""
    from astropy.coordinates import SkyCoord

    from miricigale.photometry.priors import read_catalog

    sky = read_catalog(path)["sky"]
    for what, file in (("image", image), ("highres", highres)):
        if _inside(sky, file.header):
            continue
        msg = f"none of the {len(sky)} sources of {path} is on {file.path} ('{what}')"
        known = np.isfinite(sky.ra.deg)
        hours = SkyCoord(15 * sky.ra[known], sky.dec[known])
        if _inside(hours, file.header):
            msg += ": is ra in hours? Wanted are degrees, or a column with a unit"
        elif known.any():
            first = sky[known][0].to_string("decimal", precision=4)
            where = _middle(file.header).to_string("decimal", precision=4)
            msg += f": the first is at {first}, the middle of the image at {where} deg"
        raise ValueError(msg)


def _pulls(result, kernel, seed, n_threads):
    """Flux over error of point sources where none is; None without a PSF or such places."""
    from miricigale.photometry import ForcedPhotometer

    empty = _empty_positions(result, seed)
    if kernel.target is None or not len(empty):
        return None
    blank = ForcedPhotometer(kernel, template="psf", n_threads=n_threads)
    with warnings.catch_warnings():
        # the warning about a background was given already
        warnings.simplefilter("ignore", PhotometryWarning)
        return blank.measure(result.residual_image, catalog=empty).snr


def _empty_positions(result, seed):
    """
    Random positions at which a measurement left no light: ``id`` and ``sky``.

    They are at least 0.3 arcsec from pixels with light of a model (above a third of the
    noise) or without data.
    """
    import scipy.ndimage
    from astropy.table import QTable

    from miricigale.photometry.arrays import pixel_scale

    residual = result.residual_image
    sigma = residual.uncertainty.array
    level = 0.0 if result.background is None else result.background.to_value(residual.unit)
    free = ~np.asarray(residual.mask, bool)
    free &= np.abs(result.model_image.data - level) < 0.3 * np.where(free, sigma, 1.0)
    steps = max(1, round(0.3 / pixel_scale(residual.wcs)))
    # pixels beyond the image count as without data
    free = scipy.ndimage.binary_erosion(free, iterations=steps)
    y, x = np.nonzero(free)
    rng = np.random.default_rng(seed)
    chosen = rng.choice(len(x), min(_EMPTY, len(x)), replace=False) if len(x) else np.zeros(0, int)
    sky = residual.wcs.pixel_to_world(x[chosen].astype(float), y[chosen].astype(float)).icrs
    return QTable({"id": np.arange(1, len(chosen) + 1), "sky": sky})
