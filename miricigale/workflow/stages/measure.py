"""Stage 11: forced photometry."""

import numpy as np
from astropy.table import vstack

from miricigale import photometry, psf
from miricigale.photometry.commands.patches import RIM, own_rows
from miricigale.photometry.fit.bands import spread_rows
from miricigale.utils.named_values import places, rows_of
from miricigale.utils.tables import error_column
from miricigale.workflow.engine.stage import stage
from miricigale.workflow.stages.exposures import IMAGE_RESOURCES, KERNEL
from miricigale.workflow.stages.grids import (
    PATCHED,
    grid_of,
    mosaic_memory,
    of_patch,
    parts_of,
    patch_grid,
    patch_plan,
    study_bands,
    study_patches,
    truth_bands,
)
from miricigale.workflow.stages.images import measured_mosaic, mosaic_psf, prior_psf


@stage(
    "templates",
    "templates of the sources",
    version=3,
    needs=("highres",),
    sections=("highres.filter", "highres.pixel_scale"),
    units=study_patches,
    memory=mosaic_memory,
)
def make_templates(context, patch):
    """Stage 11, once for all bands: what the detected sources look like on the prior."""
    image, labels, sources = _detections(context, patch)
    templates = photometry.SourceTemplates.from_images(
        image, labels, sources, psf=prior_psf(context.config), n_threads=context.n_threads
    )
    context.save_result(f"{of_patch('templates', patch)}.fits", templates)


@stage(
    "photometry",
    "forced photometry",
    version=7,
    needs=("mosaics", "highres", "kernels", "templates"),
    sections=KERNEL + ("photometry.method",),
    resources=IMAGE_RESOURCES,
    units=truth_bands,
    plan=patch_plan,
    memory=mosaic_memory,
)
def measure_photometry(context, unit):
    """Stage 11: forced photometry of one band, on its own grid or by the steps of Yang et al. 2021."""
    truth, name, patch = parts_of(unit)
    suffix, _ = measured_mosaic(context.config)
    mosaic = context.image(f"{of_patch(f'{truth}/mosaic_{name}{suffix}', patch)}.fits")
    result = measure_band(context, mosaic, name, context.config.photometry.method, patch)
    place = of_patch(f"{truth}/photometry/{name}", patch)
    context.save_table(f"{place}.ecsv", result.to_table())
    context.save_image(f"{place}_model.fits", result.model_image)
    context.save_image(f"{place}_residual.fits", result.residual_image)


@stage(
    "detections",
    "detections of all patches",
    needs=("highres",),
    sections=PATCHED,
    units=lambda config: ("",) if config.patches.size else (),
)
def join_detections(context, _):
    """Stage 9, of patches: each detection once, with its patch and its label there."""
    config = context.config
    grid = patch_grid(config)
    wcs = grid_of(config, config.highres.pixel_scale)
    tables = []
    for name in study_patches(config):
        table = context.table(f"detections_{name}.ecsv")
        xy = np.transpose(wcs.world_to_pixel(table["sky"]))
        table["patch"] = name
        table["label"] = table["id"]
        tables.append(table[grid.is_near(grid.names.index(name), xy, RIM)])
    joined = vstack(tables, metadata_conflicts="silent")
    numbers = np.array(places(joined["patch"], grid.names))
    xy = np.transpose(wcs.world_to_pixel(joined["sky"]))
    joined = joined[own_rows(numbers, grid, xy)]
    joined["id"] = np.arange(1, len(joined) + 1)
    context.save_table("detections.ecsv", joined)


@stage(
    "joined",
    "photometry of all patches",
    needs=("detections", "photometry"),
    sections=PATCHED,
    units=lambda config: study_bands(config) if config.patches.size else (),
)
def join_photometry(context, unit):
    """Stage 11, of patches: the photometry of a band at all detections."""
    truth, band = unit.split("/")
    detections = context.table("detections.ecsv")
    # row of each detection in the stacked tables, -1 where the band has no data
    rows = np.full(len(detections), -1)
    n_rows = 0
    tables = []
    for name, patch in study_patches(context.config).items():
        if band in patch.bands:
            table = context.table(f"{truth}/photometry/{band}_{name}.ecsv")
            inside = np.asarray(detections["patch"]) == name
            order = np.argsort(table["id"])
            place = np.searchsorted(table["id"], detections["label"][inside], sorter=order)
            rows[inside] = n_rows + order[place]
            n_rows += len(table)
            tables.append(table)
    stacked = vstack(tables, metadata_conflicts="silent")
    joined = detections["id", "sky"]
    for name in stacked.colnames[2:]:
        if name in ("x", "y"):
            # of the mosaic of a patch, which has a grid of its own
            continue
        joined[name] = spread_rows(stacked[name], rows, name)
    context.save_table(f"{truth}/photometry/{band}.ecsv", joined)


def photometer_of(context, name, method, patch):
    """Return the photometer of one band: of the package, or by the steps of Yang et al. 2021."""
    config = context.config
    if method == "yang2021":
        blur = mosaic_psf(config, name, config.highres.pixel_scale, patch)
        return photometry.Yang2021Photometer(prior_psf(config), blur, n_threads=context.n_threads)
    kernel = psf.MatchingKernel.read(context.path(f"{of_patch(f'kernel_{name}', patch)}.fits"))
    # the constant absorbs the light of faint sources and of wings in the background
    return photometry.ForcedPhotometer(kernel, background_order=0, n_threads=context.n_threads)


def measure_band(context, mosaic, name, method, patch=""):
    """Measure a mosaic of one band by forced photometry, ``"package"`` or ``"yang2021"``."""
    photometer = photometer_of(context, name, method, patch)
    if method == "yang2021":
        # on the grid of the prior
        image, labels, sources = _detections(context, patch)
        return photometer.measure(mosaic, image, labels, sources)
    path = context.path(f"{of_patch('templates', patch)}.fits")
    templates = photometry.SourceTemplates.read(path)
    return photometer.measure(mosaic, templates=templates)


def _detections(context, patch):
    """Return the high-resolution image, the labels of its segments, and the detected sources."""
    _, labels = context.image(f"{of_patch('segm', patch)}.fits", "segmentation")
    image = context.image(f"{of_patch('f160w', patch)}.fits")
    sources = context.table(f"{of_patch('detections', patch)}.ecsv")
    return image, labels.astype(np.int32), sources


def joined_photometry(tables):
    """Join tables of results by band into one, with a row for each detection."""
    columns = ["id", "sky", "flux", error_column("flux"), "flags"]
    return photometry.join_bands(rows_of(tables, columns))
