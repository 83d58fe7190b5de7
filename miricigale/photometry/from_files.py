"""Forced photometry of files: what they are is checked first, then measured and put on a page."""

import logging
import os
import tempfile
from pathlib import Path

import numpy as np
from astropy.io import fits

from miricigale.filters import Filter
from miricigale.instrument.image_files import write_image
from miricigale.photometry.grids import grid_angle
from miricigale.photometry.kernel_files import can_be_modeled, file_place, matching_kernel
from miricigale.photometry.mosaics import MosaicFile
from miricigale.utils.exceptions import DataError, argument_error
from miricigale.utils.files import split_extension
from miricigale.utils.progress import progress
from miricigale.utils.store import replacing
from miricigale.utils.table_files import write_table

_log = logging.getLogger(__name__)

#: Endings of tables that can be written.
_TABLES = (".ecsv", ".fits", ".fits.gz")

#: What the file of a `~miricigale.psf.KernelField` states as its format.
FIELD = "kernel-field-1"


def measure_files(
    image,
    highres,
    *,
    segmentation=None,
    catalog=None,
    detection=(),
    kernel=None,
    confidence=0.95,
    psf_stars=False,
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
    Measure the sources of a high-resolution image on others, from files to files.

    Parameters
    ----------
    image : path-like or `~miricigale.photometry.MosaicFile`, or a list of them
        The image, or those of several bands; as `~miricigale.photometry.MosaicFile` with what is not in their
        headers, such as filters, maps of the noise and PSFs.
    highres : path-like or `~miricigale.photometry.MosaicFile`
        The prior. Its sources are looked at once for all bands.
    segmentation, catalog : path-like, optional
        See `~miricigale.photometry.read_prior`. Without a segmentation sources are detected
        on the prior.
    detection : list of path-like or `~miricigale.photometry.MosaicFile`, optional
        Images on the prior's pixels in which sources are detected together with it
        (`~miricigale.photometry.chi_image`).
    kernel : path-like, or a list of one for each image (or None), optional
        From the prior's resolution to that of the image, on the prior's pixels; see
        ``miricigale.photometry.kernel_files.read_kernel``; or a file of a `~miricigale.psf.KernelField`.
        Without a PSF of the prior sources are the segments as they are, and those without one are not measured.
    confidence : float, optional
        Of the upper limits in the columns ``<filter>_upper`` and on the page.
    psf_stars : bool, optional
        Whether stars correct the PSFs (see `~miricigale.photometry.ForcedPhotometer`); never a kernel that
        is given.
    output, page, model, residual : path-like, optional
        Where the table (ECSV or FITS), the HTML page and FITS images of the fitted model (with its
        background) and of the residual are written; not if None. Those of several bands have the
        name of the filter before their ending. A page has one of its sources beside it, ``NAME-sources.html``.
    overwrite : bool, optional
        Whether files that are there are replaced.
    seed : int, optional
        Seed of the empty positions at which errors are tested, for the page.
    n_threads : int, optional
        Number of threads; all by default.
    progress_bar : bool, optional
        Whether progress is shown.
    **options
        Of `~miricigale.photometry.ForcedPhotometer`: a constant background is fitted unless ``background_order``
        is given (None for no background). Sources that the prior lacks are fitted in all bands, and are the last
        rows of the table, flagged ``NOT_IN_CATALOG``, if ``second_pass`` says so; by default the evidence does.

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
    ...     ["f770w_i2d.fits", "f1000w_i2d.fits"], "f444w_i2d.fits", output="miri.ecsv", page="miri.html"
    ... )  # doctest: +SKIP
    """
    images, kernels = (list(v) if isinstance(v, (list, tuple)) else [v] for v in (image, kernel))
    kernels = kernels * len(images) if kernels == [None] else kernels
    if len(kernels) != len(images):
        raise argument_error("kernel", f"one for each of {len(images)} images", len(kernels))
    files = (
        one if isinstance(one, MosaicFile) else MosaicFile(one)
        for one in (*images, highres, *detection)
    )
    files = list(files)
    images, highres, others = files[: len(images)], files[len(images)], files[len(images) + 1 :]
    named = [("segmentation", segmentation), ("catalog", catalog), ("highres_psf", highres.psf)]
    named += [("psf", one.psf) for one in images] + [("kernel", one) for one in kernels]
    named = [(what, path) for what, path in named if path is not None]
    results = {("output", 0): output, ("page", 0): page}
    for k, one in enumerate(images):
        own = one if len(images) > 1 else None
        results |= {("model", k): _of_band(model, own), ("residual", k): _of_band(residual, own)}
    results = {key: path for key, path in results.items() if path is not None}
    read = [one.path for one in files] + [path for _, path in named]
    for (what, _), path in results.items():
        check_output(what, path, overwrite, read)
    written = [Path(path).resolve() for path in results.values()]
    if len(set(written)) < len(written):
        given = ", ".join(dict.fromkeys(what for what, _ in results))
        raise argument_error(given, "different files", [str(path) for path in written])
    for one in images:
        _check_images(one, highres)
    for what, path in named:
        if not os.path.isfile(file_place(path)[0]):
            msg = f"no file {path} ('{what}')"
            raise DataError(msg)
    for one, own in zip(images, kernels, strict=True):
        if catalog is not None:
            _check_catalog(catalog, one, highres)
        _check_psfs(one, highres, own)
    bands = [one.header.filter for one in images]
    if len(set(bands)) < len(bands):
        raise argument_error("image", "of different filters", bands)
    # heavy imports only after the files were checked
    from miricigale.photometry import ForcedPhotometer, chi_image, read_prior
    from miricigale.photometry.bands import join_bands, measure_prior
    from miricigale.photometry.priors import detected_prior
    from miricigale.psf import KernelField

    with progress(show=progress_bar, total=4, desc="images", unit="steps") as bar:
        prior, mosaics = highres.read(), {k: v.read() for k, v in zip(bands, images, strict=True)}
        bar.update()
        bar.set_description("kernels and sources")
        options = {"background_order": 0, "second_pass": None, "n_threads": n_threads} | options
        photometers = {
            band: ForcedPhotometer(
                _kernel(one, highres, own), psf_stars=psf_stars and own is None, **options
            )
            for band, one, own in zip(bands, images, kernels, strict=True)
        }
        if segmentation is None:
            found = chi_image([prior, *(one.read() for one in others)]) if others else prior
            segments, sources = detected_prior(found, catalog)
        else:
            segments, sources = read_prior(prior, segmentation=segmentation, catalog=catalog)
        bar.update()
        bar.set_description("fluxes")
        found = measure_prior(mosaics, photometers, prior, segments, sources)
        if len(found) == 1:
            table = found[bands[0]].to_table(bands[0], confidence=confidence)
        else:
            tables = {k: one.to_table(confidence=confidence) for k, one in found.items()}
            table = join_bands(tables)
        paths = [str(one.path) for one in images]
        table.meta.update(image=paths[0] if len(paths) == 1 else paths, highres=str(highres.path))
        bar.update()
        bar.set_description("page")
        for path in written:
            path.parent.mkdir(parents=True, exist_ok=True)
        if output is not None:
            with replacing(output, overwrite=overwrite) as partial:
                write_table(table, partial)
        for k, result in enumerate(found.values()):
            for what in {"model", "residual"} & {one for one, _ in results}:
                with replacing(results[what, k]) as partial:
                    write_image(getattr(result, f"{what}_image"), partial)
        if page is not None:
            from miricigale.photometry.page import Measured, write_page

            measured = []
            for name, result in found.items():
                kernel = photometers[name].kernel
                if result.psf_stars is not None:
                    kernel = result.psf_stars.kernel
                kernel = kernel.mean if isinstance(kernel, KernelField) else kernel
                measured.append(Measured(name, result, mosaics[name], kernel, None))
            write_page(page, measured, prior, segments, confidence, seed)
        bar.update()
    return table


def _of_band(path, file):
    """The path of what belongs to one of several images, if one is given: with its filter before the ending."""
    if path is None or file is None:
        return path
    name, dot, ending = Path(path).name.partition(".")
    band = str(file.header.filter).rpartition(".")[2]
    return Path(path).with_name(f"{name}_{band}{dot}{ending}")


def _kernel(image, highres, path):
    """The kernel between two images; that of a file may be of several places."""
    from miricigale.psf import KernelField

    if path is not None and fits.getheader(file_place(path)[0]).get("FORMAT") == FIELD:
        return KernelField.read(path)
    return matching_kernel(image, highres, path)


def check_output(what, path, overwrite, inputs):
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
