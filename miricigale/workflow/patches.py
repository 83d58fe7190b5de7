"""Forced photometry of mosaics that are larger than the memory: in patches, each a unit that is resumed."""

import dataclasses
import functools
import math
import re
import shutil
import tempfile
from pathlib import Path
from typing import ClassVar

import astropy.units as u
import numpy as np

from miricigale import photometry
from miricigale.pages import Link, Page, SectionWriter
from miricigale.photometry.commands.file_inputs import Inputs
from miricigale.photometry.commands.from_files import TABLE_KIND
from miricigale.photometry.commands.patches import (
    PatchGrid,
    join_patches,
    measure_patch,
    patch_parts,
)
from miricigale.photometry.detection.prior_catalog import read_catalog
from miricigale.photometry.images.arrays import pixel_scale
from miricigale.utils.caching import cached
from miricigale.utils.exceptions import argument_error
from miricigale.utils.files import cached_by_file, make_folder
from miricigale.utils.meta import provenance
from miricigale.utils.options import check_least, check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.outputs import check_output
from miricigale.utils.package_tables import declared
from miricigale.utils.table_files import read_table, write_table
from miricigale.utils.units import ANGLE, ab_magnitude, positive
from miricigale.workflow.engine.runner import StudyRunner
from miricigale.workflow.engine.stage import stage
from miricigale.workflow.options import Configuration, Section, option
from miricigale.workflow.recorded_inputs import (
    absolute,
    file_states,
    inputs_from_text,
    inputs_text,
)
from miricigale.workflow.sections import RunBasics, memory_of

#: Most bytes that a patch may take.
_MAX_PATCH_BYTES = 2_000_000_000
#: Memory of templates, where no other is given.
_TEMPLATE_MEMORY = photometry.MemorySettings(max_bytes=3e8)


class RunSection(RunBasics):
    """How the run goes."""

    name: str = option(
        "patches", "Name of the run; its folder unless --output is given.", folder=True
    )
    memory: float = memory_of("patches")


class FilesSection(Section):
    """What is measured."""

    inputs: str = option(
        "",
        "Files and options as JSON.",
    )


class PatchSection(Section):
    """The grid of patches."""

    size: int = option(1000, "Side of the cores (pixels of the prior).", low=1)
    overlap: int = option(0, "Pixels of the prior around them.", low=0)
    pages: bool = option(
        True,
        "Whether each patch has a page, and images of model and residual.",
    )


class PatchConfig(Configuration):
    """Everything that a run in patches depends on."""

    heading: ClassVar = "# miricigale photometry in patches; a record of what was asked for"

    run: RunSection
    files: FilesSection
    patches: PatchSection


@cached(maxsize=4)
def _inputs_and_grid(files, patches):
    inputs = inputs_from_text(files.inputs)
    return inputs, _grid(inputs, patches.size, patches.overlap)


def _grid(inputs, size, overlap):
    """Return the grid of patches, of cores of a size and overlap in pixels of the prior."""
    headers = [image.header for image in inputs.images]
    return PatchGrid.over(inputs.highres.header, headers, size, overlap)


def _task(config):
    """Return inputs and grid of a configuration."""
    return _inputs_and_grid(config.files, config.patches)


def _states(config, unit):
    """Return size and time of each file that is read, for the digest."""
    inputs, _ = _task(config)
    return file_states(inputs)


def _n_bytes(inputs, grid, unit):
    """Estimate how many bytes a patch takes."""
    shapes = []
    for part in patch_parts(inputs, grid, grid.names.index(unit)):
        shapes.append(tuple(side.stop - side.start for side in part) if part else (0, 0))
    return inputs.n_bytes(shapes[0], shapes[1:])


def _unit_names(config):
    _, grid = _task(config)
    return grid.names


def _unit_memory(config, unit):
    inputs, grid = _task(config)
    return _n_bytes(inputs, grid, unit)


_sources = cached_by_file(1, copies=True)(read_catalog)


def _catalog(inputs):
    """Return ids and positions of the sources, if there is a catalog."""
    if inputs.catalog is None:
        return None
    return _sources(inputs.catalog)["id", "sky"]


_SECTIONS = ("files", "patches")


@stage(
    "patch",
    "patches",
    version=2,
    sections=_SECTIONS,
    plan=_states,
    units=_unit_names,
    memory=_unit_memory,
)
def patch_stage(context, unit):
    """Measure a patch: its table, and its page with model and residual of each band."""
    inputs, grid = _task(context.config)
    k = grid.names.index(unit)
    table, measured = measure_patch(inputs, grid, k, _catalog(inputs), context.n_threads)
    if measured is not None:
        table.meta["patch"] = _band_entries(measured, table)
        # pictures are of an image and the prior
        has_image = any("source" in image.meta for image in measured.pixels.images.values())
        has_prior = "source" in measured.pixels.prior.meta
        if context.config.patches.pages and has_image and has_prior and len(table):
            _save_page(context, measured, unit)
    context.save_table(f"patches/{unit}.ecsv", table)


def _save_page(context, measured, unit):
    """Save the page of a patch with its pictures, and its images of model and residual."""
    with tempfile.TemporaryDirectory() as folder:
        measured.write_page(Path(folder) / f"{unit}.html")
        for band, result in measured.results.items():
            stem = "patches/" + re.sub(r"[^\w.+-]", "-", f"{unit}_{band}")
            context.save_image(f"{stem}_model.fits", result.model_image)
            context.save_image(f"{stem}_residual.fits", result.residual_image)
        for path in sorted(Path(folder).rglob("*.*")):
            name = f"patches/{path.relative_to(folder).as_posix()}"
            context.save(name, functools.partial(shutil.copyfile, path))


def _band_entries(measured, table):
    """Return numbers of each band of a patch, as plain values."""
    entries = []
    for band, result in measured.results.items():
        flux = table[band]
        background = result.background
        clean = table[f"{band}_err"][np.isfinite(flux) & (table[f"{band}_flags"] == 0)]
        depth = None
        if len(clean):
            depth = float(ab_magnitude(5 * np.median(clean)))
        second_pass = result.meta.get("second_pass", {})
        entry = {
            "band": band,
            "n": len(table),
            "n_measured": int(np.isfinite(flux).sum()),
            "depth": depth,
            "background": None if background is None else float(background.value),
            "noise_scale": measured.pixels.images[band].meta.get("noise_scale"),
            "offset": str(result.meta.get("offset", "not measured")),
            "second_pass": str(second_pass.get("fitted", "not asked for")),
        }
        entries.append(entry)
    return entries


@stage("table", "table", needs=("patch",), sections=_SECTIONS, plan=_states)
def table_stage(context, _):
    """Join the tables of the patches, and write the page of all."""
    inputs, grid = _task(context.config)
    tables = {}
    rows = []
    for k, name in enumerate(grid.names):
        table = context.table(f"patches/{name}.ecsv")
        for entry in table.meta.pop("patch", ()):
            rows.append({"patch": name} | entry)
        if len(table):
            tables[k] = table
    check_that(tables, "highres", "an image with sources", "none in any patch")
    has_ids = inputs.segmentation is not None
    joined = join_patches(tables, grid, inputs.highres.header, _catalog(inputs), has_ids)
    settings = dataclasses.asdict(context.config.patches)
    joined.meta = provenance(
        stage="photometry",
        image=[str(image.path) for image in inputs.images],
        highres=str(inputs.highres.path),
        **settings,
    )
    context.save_table("table.fits", joined)
    title = f"Forced photometry in patches: {', '.join(inputs.bands)}"
    report = Page(title, subtitle=f"on the prior {Path(inputs.highres.path).name}")
    page = SectionWriter(report, declared("miricigale.photometry"))
    page.section("patches", n=len(joined), n_patches=len(grid.names), **settings)
    for row in rows:
        name = f"patches/{row['patch']}.html"
        if context.products.path(name).exists():
            row["patch"] = Link(row["patch"], name)
    page.table("table", rows)
    context.save("index.html", report.write)


def patch_stages():
    """Return the stages of photometry in patches."""
    return patch_stage, table_stage


@takes_other_keywords
def measure_patches(
    image,
    highres,
    folder,
    *,
    patch_size=None,
    overlap=10 * u.arcsec,
    output=None,
    overwrite=False,
    pages=True,
    executor=None,
    redo=False,
    n_threads=None,
    progress_bar=False,
    **options,
):
    """
    Measure the sources of mosaics that are larger than the memory, in patches.

    The prior is cut into squares, each measured with an overlap around it as by
    `~miricigale.photometry.measure_files`. A source belongs to the patch whose core holds it. What is finished
    stays in the folder: the same call resumes it.

    Parameters
    ----------
    image, highres
        As for `~miricigale.photometry.measure_files`; images are files.
    folder : path-like
        Of the products: ``table.fits``, the page ``index.html``, and in ``patches`` a table, a page and images
        of each.
    patch_size : int, optional
        Side of the cores in pixels of the prior; as many as take 2 GB by default.
    overlap : `~astropy.units.Quantity`, optional
        Width of the rim around them (angle).
    output : path-like, optional
        Where the table (ECSV or FITS) is written too.
    overwrite : bool, optional
        Whether ``output`` is replaced if it is there.
    pages : bool, optional
        Whether each patch has a page, and of each band the images ``<patch>_<band>_model.fits`` and
        ``_residual.fits``, with the overlap.
    executor : optional
        Processes, threads or a cluster that measure patches side by side, as for
        `~miricigale.workflow.StudyRunner`; the products are the same bytes.
    redo : bool, optional
        Whether products of other files or options in the folder are replaced; otherwise they are refused.
    n_threads : int, optional
        Number of threads of all patches together; all by default.
    progress_bar : bool, optional
        Whether progress is shown.
    **options
        ``segmentation``, ``catalog`` and all others of `~miricigale.photometry.measure_files`.

    Returns
    -------
    table : `~astropy.table.QTable`
        As of `~miricigale.photometry.measure_files`, with ``patch``. The rows of a catalog in their order;
        without one sources are counted, patch by patch. Sources that the prior lacks are the last rows.

    Raises
    ------
    `~miricigale.utils.exceptions.OtherResultsError`
        If the folder holds what other files or options made, and ``redo`` is False.
    `~miricigale.utils.exceptions.DataError`, ValueError
        As `~miricigale.photometry.measure_files`; if the folder is another's or in use.

    Examples
    --------
    >>> from miricigale.workflow import measure_patches
    >>> table = measure_patches("f770w_i2d.fits", "f444w_i2d.fits", "patches")  # doctest: +SKIP
    """
    inputs = Inputs.of(image, highres, **{"memory": _TEMPLATE_MEMORY, **options})
    inputs = dataclasses.replace(
        inputs,
        segmentation=absolute(inputs.segmentation),
        catalog=absolute(inputs.catalog),
        kernels=tuple(map(absolute, inputs.kernels)),
        # all patches have one PSF unless their stars are asked for
        psf_stars=bool(inputs.psf_stars),
    )
    check_output(output, "output", overwrite=overwrite, inputs=inputs.paths, **TABLE_KIND)
    inputs.check()
    # refused here rather than in each patch
    inputs.photometers(n_threads)
    header = inputs.highres.header
    rim = math.ceil(positive(overlap, ANGLE, "overlap") / pixel_scale(header.wcs))
    if patch_size is None:
        patch_size = _largest(inputs, rim)
    check_least(patch_size, "patch_size", max(rim, 1), whole=True)
    config = PatchConfig(
        run=RunSection(threads=n_threads or 0, seed=inputs.seed),
        files=FilesSection(inputs=inputs_text(inputs)),
        patches=PatchSection(size=int(patch_size), overlap=rim, pages=pages),
    )
    runner = StudyRunner(
        config, folder, patch_stages, executor=executor, redo=redo, progress_bar=progress_bar
    )
    table = read_table(runner.run().path("table.fits"), wanted="the table")
    if output is not None:
        make_folder(Path(output).parent)
        write_table(table, output, overwrite=overwrite)
    return table


def _largest(inputs, rim):
    """Return the side of cores of the same size whose patches take 2 GB at most."""
    longest = max(inputs.highres.header.shape)
    for n in range(1, longest):
        grid = _grid(inputs, math.ceil(longest / n), rim)
        if max(_n_bytes(inputs, grid, name) for name in grid.names) <= _MAX_PATCH_BYTES:
            return grid.size
    raise argument_error("overlap", "small enough for patches of 2 GB", f"{rim} pixels")
