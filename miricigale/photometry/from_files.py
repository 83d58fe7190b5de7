"""Forced photometry of files: what they are is checked first, then measured and put on a page."""

import dataclasses
import logging
import os
import tempfile
import warnings
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.io.fits.verify import VerifyWarning

from miricigale.filters import Filter
from miricigale.instrument.image_files import write_image
from miricigale.photometry.grids import grid_angle
from miricigale.photometry.kernel_files import can_be_modeled, file_place, matching_kernel
from miricigale.photometry.mosaics import MosaicFile
from miricigale.utils.exceptions import DataError, MiricigaleWarning, argument_error
from miricigale.utils.files import split_extension
from miricigale.utils.progress import progress
from miricigale.utils.store import replacing
from miricigale.utils.tables import error_column
from miricigale.utils.units import to_array

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
    psf_angle=None,
    highres_psf_angle=None,
    pa_aper=None,
    highres_pa_aper=None,
    background_order=0,
    max_shift=None,
    output=None,
    page=None,
    model=None,
    residual=None,
    overwrite=False,
    n_empty=400,
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
        The image and the prior.
    filter : str, optional
        Filter of the image, if its header does not tell; it must be one that
        `~miricigale.filters.Filter` knows.
    segmentation, catalog : path-like, optional
        See `~miricigale.photometry.read_prior`. Without a segmentation sources are detected
        on the prior.
    kernel : path-like, optional
        From the prior's resolution to that of the image, on the prior's pixels; see
        ``miricigale.photometry.kernel_files.read_kernel``. Without a PSF of the prior sources are
        the segments as they are, and those without one are not measured.
    psf, highres_psf : path-like, optional
        PSFs of image and prior with the pixel and the drizzling in them: ``file.fits``,
        ``file.fits[EXTENSION]``, or of a cube ``file.fits[EXTENSION,PLANE]`` (``mean`` for the mean
        of all planes). Their centers are found. Those of MIRI, NIRCam's wide filters and WFC3/IR
        are compared with the model (`~miricigale.psf.checked_psf`), which is taken where none is
        given (`~miricigale.psf.filter_psf`).
    psf_scale, highres_psf_scale : `~astropy.units.Quantity`, optional
        Pixel of the PSFs; by default that of their header, or else of their images.
    psf_angle, highres_psf_angle : `~astropy.units.Quantity`, optional
        Position angle of the PSFs' +y; by default that of their header, or else of their images'
        +y.
    pa_aper, highres_pa_aper : `~astropy.units.Quantity`, optional
        Position angle of the detector's +y axis, if the header does not tell.
    background_order : int or None, optional
        Order of the background that is fitted with the sources, 0 for a constant; none is fitted if None.
    max_shift : `~astropy.units.Quantity`, optional
        If given, a shift of the image up to this is fitted.
    output, page, model, residual : path-like, optional
        Where the table (ECSV or FITS), the HTML page and FITS images of the fitted model (with its
        background) and of the residual are written; not if None.
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
        If something that was given is not what the headers say, the images do not overlap or
        seem to be swapped, a PSF is missing, or a result cannot be written.
    """
    image, highres = (
        one if isinstance(one, MosaicFile) else MosaicFile(one) for one in (image, highres)
    )
    extras = {"segmentation": segmentation, "catalog": catalog, "kernel": kernel}
    extras.update(psf=psf, highres_psf=highres_psf)
    inputs = [one for one in extras.values() if one is not None]
    results = {"output": output, "page": page, "model": model, "residual": residual}
    for what, path in results.items():
        _check_output(what, path, overwrite, [image.path, highres.path, *inputs])
    written = [Path(path).resolve() for path in results.values() if path is not None]
    if len(set(written)) < len(written):
        given = ", ".join(what for what, path in results.items() if path is not None)
        raise argument_error(given, "different files", [str(path) for path in written])
    filter_ = _check_images(image, highres, filter)
    for what, path in extras.items():
        if path is not None and not os.path.isfile(file_place(path)[0]):
            msg = f"no file {path} ('{what}')"
            raise DataError(msg)
    if catalog is not None:
        _check_catalog(catalog, image, highres)
    psfs = {"kernel": kernel, "psf": psf, "highres_psf": highres_psf}
    psfs.update(psf_scale=psf_scale, highres_psf_scale=highres_psf_scale)
    psfs.update(psf_angle=psf_angle, highres_psf_angle=highres_psf_angle)
    headers = [
        dataclasses.replace(
            one.header,
            filter=name,
            pa_aper=_checked_angle(one, angle, argument),
        )
        for one, name, angle, argument in (
            (image, filter_, pa_aper, "pa_aper"),
            (highres, highres.header.filter, highres_pa_aper, "highres_pa_aper"),
        )
    ]
    _check_psfs(image, highres, headers, kernel, psf, highres_psf)
    # heavy imports only after the files were checked
    from miricigale.photometry import ForcedPhotometer

    with progress(show=progress_bar, total=4, desc="images", unit="steps") as bar:
        mosaic, prior = image.read(), highres.read()
        mosaic.meta["filter"] = filter_
        bar.update()
        bar.set_description("kernel and sources")
        matching = matching_kernel(*headers, **psfs)
        segments, sources = _sources(prior, segmentation, catalog, highres.path)
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

            pulls = _pulls(result, matching, n_empty, seed, n_threads)
            photometry_page(result, filter_, mosaic, prior, matching, pulls, segments).write(page)
        bar.update()
    return table


def _with_new_sources(table, new, filter_):
    """A table and, in its last rows, the sources that the catalog lacks."""
    if new is None or len(new) == 0:
        return table
    from astropy.table import vstack

    known = {"id": "id", "sky": "sky", "flux": filter_, "flux_err": error_column(filter_)}
    known.update({name: f"{filter_}_{name}" for name in ("flags", "snr", "coverage", "chi2")})
    rows = table[np.zeros(len(new), int)]
    for name, column in known.items():
        rows[column] = new[name]
    for name in set(table.colnames) - set(known.values()):
        values = rows[name]
        if isinstance(values, u.Quantity) or values.dtype.kind == "f":
            values[:] = np.nan
        elif values.dtype.kind == "b":
            values[:] = False
    rows[f"{filter_}_template"] = "point"
    return vstack([table, rows], metadata_conflicts="silent")


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


def _checked_angle(file, angle, argument):
    """The position angle that was given or that the header states, which must agree."""
    stated = file.header.pa_aper
    if angle is None:
        return stated
    angle = float(to_array(angle, u.deg, argument, finite=True)) * u.deg
    if stated is not None:
        difference = (angle - stated).to_value(u.deg)
        if abs((difference + 180) % 360 - 180) > 1:
            wanted = f"PA_APER of {file.path}, {stated.value:.2f} deg"
            raise argument_error(argument, wanted, angle)
    return angle


def _check_psfs(image, highres, headers, kernel, psf, highres_psf):
    """Refuse images whose PSF is neither given nor known."""
    from miricigale.psf import MODEL_FILTERS

    if kernel is not None:
        if psf is not None:
            raise argument_error("psf", "left out where a kernel is given", psf)
        return
    for file, header, path, prefix in (
        (image, headers[0], psf, ""),
        (highres, headers[1], highres_psf, "highres_"),
    ):
        if path is not None or can_be_modeled(header):
            continue
        if header.filter in MODEL_FILTERS:
            wanted = f"given, for the header of {file.path} has no PA_APER (or '{prefix}psf')"
            raise argument_error(prefix + "pa_aper", wanted, None)
        name = header.filter or "an image whose filter is unknown ('highres_filter')"
        wanted = f"given (or 'kernel'), for there is no model PSF for {name}"
        raise argument_error(prefix + "psf", wanted, None)


def _check_catalog(path, image, highres):
    """Refuse a catalog of another field."""
    from astropy.coordinates import SkyCoord

    from miricigale.photometry.arrays import sky_pixels
    from miricigale.photometry.priors import read_catalog

    sky = read_catalog(path)["sky"]

    def inside(sky, header):
        return np.isfinite(sky_pixels(sky, header.wcs, header.shape, 0.0)).any()

    for what, file in (("image", image), ("highres", highres)):
        if inside(sky, file.header):
            continue
        msg = f"none of the {len(sky)} sources of {path} is on {file.path} ('{what}')"
        known = np.isfinite(sky.ra.deg)
        hours = SkyCoord(15 * sky.ra[known], sky.dec[known])
        if inside(hours, file.header):
            msg += ": is ra in hours? Wanted are degrees, or a column with a unit"
        elif known.any():
            first = sky[known][0].to_string("decimal", precision=4)
            where = _middle(file.header).to_string("decimal", precision=4)
            msg += f": the first is at {first}, the middle of the image at {where} deg"
        raise ValueError(msg)


def _sources(prior, segmentation, catalog, path):
    from miricigale.photometry import detect_sources, read_prior

    if segmentation is not None:
        return read_prior(prior, segmentation=segmentation, catalog=catalog, path=path)
    segments, detected = detect_sources(prior)
    _log.info("%d sources detected on %s", len(detected), path)
    if catalog is None:
        return segments.data, detected
    return read_prior(prior, segmentation=segments.data, catalog=catalog, path=path)


def _pulls(result, kernel, n, seed, n_threads):
    """Flux over error of point sources where none is; None without a PSF or such places."""
    from miricigale.photometry import ForcedPhotometer

    empty = empty_positions(result, n, seed=seed)
    if kernel.target is None or not len(empty):
        return None
    blank = ForcedPhotometer(kernel, template="psf", n_threads=n_threads)
    with warnings.catch_warnings():
        # the warning about a background was given already
        warnings.simplefilter("ignore", MiricigaleWarning)
        return blank.measure(result.residual_image, catalog=empty).snr


def empty_positions(result, n, *, seed):
    """
    Up to ``n`` random positions at which a measurement left no light: ``id`` and ``sky``.

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
    chosen = rng.choice(len(x), min(n, len(x)), replace=False) if len(x) else np.zeros(0, int)
    sky = residual.wcs.pixel_to_world(x[chosen].astype(float), y[chosen].astype(float)).icrs
    return QTable({"id": np.arange(1, len(chosen) + 1), "sky": sky})
