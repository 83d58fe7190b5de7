"""Forced photometry of files: what they are is checked first, then measured and put on a page."""

from pathlib import Path

from miricigale.instrument.image_files import write_image
from miricigale.photometry.commands.exposure_files import with_exposures
from miricigale.photometry.commands.file_inputs import Inputs
from miricigale.photometry.commands.point_files import PointInputs
from miricigale.utils.exceptions import argument_error
from miricigale.utils.files import make_folder
from miricigale.utils.named_values import without_none
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.outputs import check_output, check_outputs
from miricigale.utils.parallel import check_memory
from miricigale.utils.progress import progress
from miricigale.utils.table_files import write_table

#: What tables can be written as, and images.
TABLE_KIND = {"kind": "a table", "endings": (".ecsv", ".fits", ".fits.gz")}
IMAGE_KIND = {"kind": "a FITS file", "endings": (".fits", ".fits.gz")}
_KINDS = {"output": TABLE_KIND, "page": {}, "model": IMAGE_KIND, "residual": IMAGE_KIND}

#: What is done with images that are too large.
_IN_PATCHES = (
    "measure it in patches (--patches FOLDER, miricigale.workflow.measure_patches in Python)"
)


@takes_other_keywords
def measure_files(
    image,
    highres=None,
    *,
    segmentation=None,
    catalog=None,
    detection=(),
    kernel=None,
    confidence=0.95,
    psf_stars=None,
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
        headers, such as filters, maps of the noise and PSFs. Several exposures (``_cal``) of one filter are
        fitted together, each with its PSFs by place and roll and its own sky.
    highres : path-like or `~miricigale.photometry.MosaicFile`, optional
        The prior. Its sources are looked at once for all bands. Without one the sources of the catalog are
        measured as points.
    segmentation, catalog : path-like, optional
        See `~miricigale.photometry.read_prior`. Without a segmentation sources are detected
        on the prior.
    detection : list of path-like or `~miricigale.photometry.MosaicFile`, optional
        Images on the prior's pixels in which sources are detected together with it
        (`~miricigale.photometry.chi_image`).
    kernel : path-like, or a list of one for each image (or None), optional
        From the prior's resolution to that of the image, on the prior's pixels; see
        ``miricigale.photometry.commands.kernel_files.read_kernel``; or a file of a `~miricigale.psf.KernelField`.
        Without a PSF of the prior sources are the segments as they are, and those without one are not measured.
    confidence : float, optional
        Of the upper limits in the columns ``<filter>_upper`` and on the page.
    psf_stars : bool or None, optional
        Whether stars correct the PSFs (see `~miricigale.photometry.ForcedPhotometer`), by default those of images
        with three stars at least; never a kernel that is given.
    output, page, model, residual : path-like, optional
        Where the table (ECSV or FITS), the HTML page and FITS images of the fitted model (with its
        background) and of the residual are written; not if None. Those of several bands have the
        name of the filter before their ending, those of exposures that and the name of the
        exposure. A page has one of its sources beside it, ``NAME-sources.html``.
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
    kind = PointInputs if highres is None else Inputs
    inputs = kind.of(
        image, highres, detection=detection, segmentation=segmentation, catalog=catalog,
        kernel=kernel, confidence=confidence, psf_stars=psf_stars, seed=seed, **options,
    )  # fmt: skip
    if highres is not None:
        inputs = with_exposures(inputs)
    # files that will be written, by their kind and number
    results = {("output", 0): output, ("page", 0): page}
    for k, label in enumerate(inputs.labels):
        results |= {
            ("model", k): _labelled(model, label),
            ("residual", k): _labelled(residual, label),
        }
    results = without_none(results)
    for (kind, _), path in results.items():
        check_output(path, kind, overwrite=overwrite, inputs=inputs.paths, **_KINDS[kind])
    if page is not None:
        # the modules of pages are not needed where none is written
        from miricigale.photometry.commands.browser import browser_files

        check_outputs(browser_files(page), "page", overwrite=overwrite, inputs=inputs.paths)
    kinds = dict.fromkeys(kind for kind, _ in results)
    written = [Path(path).resolve() for path in results.values()]
    if len(set(written)) < len(written):
        raise argument_error(", ".join(kinds), "different files", list(map(str, written)))
    inputs.check()
    check_memory(inputs.n_bytes(), "photometry of whole images", advice=_IN_PATCHES)
    with progress(show=progress_bar, total=4, desc="images", unit="steps") as bar:
        pixels = inputs.read()
        bar.update()
        bar.set_description("kernels and sources")
        photometers = inputs.photometers(n_threads)
        segments, sources = inputs.find_sources(pixels, catalog)
        bar.update()
        bar.set_description("fluxes")
        measured = inputs.measure(pixels, photometers, segments, sources)
        table = measured.table
        bar.update()
        bar.set_description("page")
        for path in written:
            make_folder(path.parent)
        if output is not None:
            write_table(table, output, overwrite=overwrite)
        for kind in {"model", "residual"} & kinds.keys():
            for k, image in enumerate(measured.products(kind)):
                write_image(image, results[kind, k], overwrite=True)
        if page is not None:
            measured.write_page(page)
        bar.update()
    return table


def _labelled(path, label):
    """Put a label before the ending of a path, if there are both."""
    if path is None or not label:
        return path
    name, dot, ending = Path(path).name.partition(".")
    return Path(path).with_name(f"{name}_{label}{dot}{ending}")
