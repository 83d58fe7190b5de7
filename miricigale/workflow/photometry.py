"""Forced photometry of files: what they are is checked first, then measured and put on a page."""

import logging
import os
import tempfile
import warnings
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.io.fits.verify import VerifyWarning

from miricigale.filters import Filter
from miricigale.photometry.grids import grid_angle
from miricigale.photometry.mosaics import MosaicFile
from miricigale.utils.exceptions import DataError, MiricigaleWarning, argument_error
from miricigale.utils.files import split_extension, writing
from miricigale.utils.progress import progress
from miricigale.utils.units import to_array
from miricigale.workflow.kernel_files import file_place, is_own_kernel, matching_kernel

__all__ = ["empty_positions", "measure_files"]

_log = logging.getLogger(__name__)

#: Endings of tables that can be written.
_TABLES = (".ecsv", ".fits", ".fits.gz")


def measure_files(
    image,
    highres,
    *,
    filter=None,
    segmentation=None,
    catalog=None,
    kernel=None,
    psf=None,
    highres_psf=None,
    psf_scale=None,
    highres_psf_scale=None,
    pa_aper=None,
    fit_background=True,
    max_shift=None,
    output=None,
    page=None,
    overwrite=False,
    n_empty=400,
    seed=1,
    n_threads=None,
    progress_bar=False,
):
    """
    Measure the sources of a high-resolution image on another one, from files to files.

    Parameters
    ----------
    image, highres : path-like or `~miricigale.photometry.MosaicFile`
        The image and the prior.
    filter : str, optional
        Filter of the image, if its header does not tell; it must be one that
        `~miricigale.filters.Filter` knows.
    segmentation, catalog : path-like, optional
        See `~miricigale.photometry.read_prior`. Without a segmentation sources are detected
        on the prior.
    kernel : path-like, optional
        From the prior's resolution to that of the image, on the prior's pixels; see
        ``miricigale.workflow.kernel_files.read_kernel``.
    psf, highres_psf : path-like, optional
        PSFs of image and prior with the pixel and the drizzling in them, +y along that of
        their image: ``file.fits``, ``file.fits[EXTENSION]``, or of a cube
        ``file.fits[EXTENSION,PLANE]`` (``mean`` for the mean of all planes). Their centres are
        found. Without them and without a kernel MIRI images take
        `~miricigale.psf.miri_psf` and WFC3/IR priors `~miricigale.psf.hst_psf`.
    psf_scale, highres_psf_scale : `~astropy.units.Quantity`, optional
        Pixel of the PSFs; by default that of their images.
    pa_aper : `~astropy.units.Quantity`, optional
        Position angle of the detector's +y axis, for MIRI's PSF, if the header does not tell.
    fit_background : bool, optional
        Whether a constant is fitted to the image with the sources.
    max_shift : `~astropy.units.Quantity`, optional
        If given, a shift of the image up to this is fitted.
    output, page : path-like, optional
        Where the table (ECSV or FITS) and the HTML page are written; not if None.
    overwrite : bool, optional
        Whether files that are there are replaced.
    n_empty : int, optional
        Empty positions at which errors are tested, for the page.
    seed : int, optional
        Seed of these positions.
    n_threads : int, optional
        Number of threads; all by default.
    progress_bar : bool, optional
        Whether progress is shown.

    Returns
    -------
    table : `~astropy.table.QTable`
        ``id``, ``sky``, ``<filter>``, ``<filter>_err``, ``<filter>_flags`` and so on.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If a file is missing, damaged, or without unit or coordinates.
    ValueError
        If something that was given is not what the headers say, the images do not overlap or
        seem to be swapped, a PSF is missing, or a result cannot be written.
    """
    image, highres = (
        one if isinstance(one, MosaicFile) else MosaicFile(one) for one in (image, highres)
    )
    extras = {"segmentation": segmentation, "catalog": catalog, "kernel": kernel}
    extras.update(psf=psf, highres_psf=highres_psf)
    inputs = [one for one in extras.values() if one is not None]
    for what, path in (("output", output), ("page", page)):
        _check_output(what, path, overwrite, [image.path, highres.path, *inputs])
    filter_ = _check_images(image, highres, filter)
    for what, path in extras.items():
        if path is not None and not os.path.isfile(file_place(path)[0]):
            msg = f"no file {path} ('{what}')"
            raise DataError(msg)
    psfs = {"kernel": kernel, "psf": psf, "highres_psf": highres_psf}
    scales = {"psf_scale": psf_scale, "highres_psf_scale": highres_psf_scale}
    angle = _check_psfs(image, highres, filter_, pa_aper, **psfs)
    # after what is wrong with the files is known
    from miricigale.photometry import ForcedPhotometer

    with progress(show=progress_bar, total=4, desc="images", unit="steps") as bar:
        mosaic, prior = image.read(), highres.read()
        _check_sky(highres, prior)
        mosaic.meta["filter"] = filter_
        bar.update()
        bar.set_description("kernel and sources")
        matching = matching_kernel(image, highres, filter_, angle, **psfs, **scales)
        segments, sources = _sources(prior, segmentation, catalog, highres.path)
        bar.update()
        bar.set_description("fluxes")
        photometer = ForcedPhotometer(
            matching, fit_background=fit_background, max_shift=max_shift, n_threads=n_threads
        )
        result = photometer.measure(mosaic, prior, segments, sources)
        table = result.to_table(filter_)
        table.meta.update(image=str(image.path), highres=str(highres.path))
        bar.update()
        bar.set_description("page")
        if output is not None:
            Path(output).parent.mkdir(parents=True, exist_ok=True)
            with writing(output), warnings.catch_warnings():
                # of keywords of more than eight letters
                warnings.simplefilter("ignore", VerifyWarning)
                table.write(output, overwrite=overwrite)
        if page is not None:
            from miricigale.workflow.photometry_page import photometry_page

            empty = empty_positions(result, n_empty, seed=seed)
            blank = ForcedPhotometer(matching, template="psf", n_threads=n_threads)
            pulls = blank.measure(result.residual_image, catalog=empty) if len(empty) else None
            photometry_page(
                result, filter_, mosaic, prior, matching, None if pulls is None else pulls.snr
            ).write(page)
        bar.update()
    return table


def _check_output(what, path, overwrite, inputs):
    """Refuse a file that could not be written in the end, or that is not to be replaced."""
    if path is None:
        return
    path = Path(path)
    if what == "output" and not path.name.lower().endswith(_TABLES):
        raise argument_error("output", f"a table ({', '.join(_TABLES)})", path)
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
        # permissions alone do not tell, for a superuser or on a read-only disk
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as err:
        raise argument_error(what, "in a folder that can be written to", path) from err


def _check_images(image, highres, filter_):
    """The filter of the image, after checking that the two are what they should be."""
    wanted = filter_ or image.filter
    plain = [MosaicFile(one.path).header.filter for one in (image, highres)]
    if wanted is not None and plain[0] not in (None, wanted) and plain[1] == wanted:
        msg = (
            f"'image' and 'highres' seem to be swapped: {highres.path} is the image in {wanted}, "
            f"{image.path} is in {plain[0]}"
        )
        raise ValueError(msg)
    if wanted is not None and plain[0] not in (None, wanted):
        raise argument_error("filter", f"{plain[0]!r}, the filter in {image.path}", repr(wanted))
    for one in (image, highres):
        _ = one.header
    found = wanted or plain[0]
    if found is None:
        wanted = f"given, for the header of {image.path} does not name it"
        raise argument_error("filter", wanted, None)
    if found not in Filter.names() and not found.startswith("sedpy."):
        wanted = f"a filter that 'miricigale filters' lists, for {image.path}"
        raise argument_error("filter", wanted, repr(found))
    for one in (image, highres):
        grid_angle(one.header.wcs, one.header.shape)
    if not (_overlap(image.header, highres.header) or _overlap(highres.header, image.header)):
        where = [_middle(one.header).to_string("decimal", precision=4) for one in (image, highres)]
        msg = (
            f"'image' and 'highres' show different fields: the middle of {image.path} is at "
            f"{where[0]}, that of {highres.path} at {where[1]} deg"
        )
        raise ValueError(msg)
    return found


def _middle(header):
    ny, nx = header.shape
    return header.wcs.pixel_to_world((nx - 1) / 2, (ny - 1) / 2).icrs


def _overlap(one, other):
    """Whether some of a coarse grid of pixels of one image are on the other."""
    from astropy.wcs.utils import pixel_to_pixel

    axes = [np.linspace(0, n - 1, 15) for n in one.shape]
    y, x = (grid.ravel() for grid in np.meshgrid(*axes, indexing="ij"))
    x, y = pixel_to_pixel(one.wcs, other.wcs, x, y)
    ny, nx = other.shape
    return bool(np.any((x > -0.5) & (x < nx - 0.5) & (y > -0.5) & (y < ny - 0.5)))


def _check_psfs(image, highres, filter_, pa_aper, *, kernel, psf, highres_psf):
    """The position angle for MIRI's PSF, after checking that there is a PSF of each."""
    stated = image.header.pa_aper
    if pa_aper is not None:
        pa_aper = float(to_array(pa_aper, u.deg, "pa_aper", finite=True)) * u.deg
        if stated is not None:
            difference = (pa_aper - stated).to_value(u.deg)
            if abs((difference + 180) % 360 - 180) > 1:
                wanted = f"PA_APER of {image.path}, {stated.value:.2f} deg"
                raise argument_error("pa_aper", wanted, pa_aper)
    angle = stated if pa_aper is None else pa_aper
    if kernel is not None:
        if psf is not None:
            raise argument_error("psf", "left out where a kernel is given", psf)
        if highres_psf is None and not is_own_kernel(kernel):
            wanted = f"given, for {kernel} holds the kernel alone"
            raise argument_error("highres_psf", wanted, None)
        return angle
    if psf is None:
        if not filter_.startswith("miri."):
            wanted = f"given (or 'kernel'), for there is no model PSF for {filter_}"
            raise argument_error("psf", wanted, None)
        if angle is None:
            wanted = f"given, for the header of {image.path} has no PA_APER"
            raise argument_error("pa_aper", wanted, None)
    if highres_psf is None and not (highres.header.filter or "").startswith("wfc3."):
        name = highres.header.filter or "a prior whose filter is unknown ('highres_filter')"
        wanted = f"given (or 'kernel'), for there is no model PSF for {name}"
        raise argument_error("highres_psf", wanted, None)
    return angle


def _check_sky(file, image):
    level = image.meta["sky_over_noise"]
    if abs(level) > 1:
        msg = (
            f"{file.path} has a sky of {level:.3g} times its noise, which goes into the templates; "
            "subtract it ('background_box')"
        )
        warnings.warn(msg, MiricigaleWarning, stacklevel=3)


def _sources(prior, segmentation, catalog, path):
    from miricigale.photometry import detect_sources, read_prior

    if segmentation is not None:
        return read_prior(prior, segmentation=segmentation, catalog=catalog, path=path)
    segments, detected = detect_sources(prior)
    _log.info("%d sources detected on %s", len(detected), path)
    if catalog is None:
        return segments.data, detected
    return read_prior(prior, segmentation=segments.data, catalog=catalog, path=path)


def empty_positions(result, n, *, seed, distance=0.3):
    """
    Positions at which a measurement left no light.

    Parameters
    ----------
    result : `~miricigale.photometry.ForcedPhotometryResult`
        A measurement.
    n : int
        How many are wanted; there may be fewer.
    seed : int
        Seed of the draw.
    distance : float, optional
        Least distance in arcsec to pixels with light of a model (above a third of the noise) or
        without data.

    Returns
    -------
    catalog : `~astropy.table.QTable`
        ``id`` and ``sky``.
    """
    import scipy.ndimage
    from astropy.table import QTable

    from miricigale.photometry.arrays import pixel_scale

    residual = result.residual_image
    sigma = residual.uncertainty.array
    level = 0.0 if result.background is None else result.background.to_value(residual.unit)
    free = ~np.asarray(residual.mask, bool)
    free &= np.abs(result.model_image.data - level) < 0.3 * np.where(free, sigma, 1.0)
    steps = max(1, round(distance / pixel_scale(residual.wcs)))
    # what is beyond the image has no data
    free = scipy.ndimage.binary_erosion(free, iterations=steps)
    y, x = np.nonzero(free)
    rng = np.random.default_rng(seed)
    chosen = rng.choice(len(x), min(n, len(x)), replace=False) if len(x) else np.zeros(0, int)
    sky = residual.wcs.pixel_to_world(x[chosen].astype(float), y[chosen].astype(float)).icrs
    return QTable({"id": np.arange(1, len(chosen) + 1), "sky": sky})
