"""The stages of the study, in order."""

from miricigale.refdata import resources
from miricigale.refdata.locate import fingerprint
from miricigale.workflow.stage import Stage
from miricigale.workflow.stages.exposures import (
    IMAGE_RESOURCES,
    exposure_memory,
    exposure_plan,
    exposure_units,
)

__all__ = ["study_stages"]


def _filters(config):
    return config.exposures.filters


def study_stages():
    """
    The stages, each after what it needs.

    Returns
    -------
    stages : tuple of `~miricigale.workflow.stage.Stage`
    """
    from miricigale.sed import SEDModel

    # what only the processes of the run call is named, and imported there
    from miricigale.workflow.stages.inputs import input_axes, plain_axes

    images = ("pointing", "exposures", "scene", "detector", "reduction")
    grid = ("pointing", "exposures")
    kernel = ("highres", "photometry.regularization", "reduction")
    # the preset takes the best libraries that there are: a new one makes a new result
    sed_data = (*SEDModel.yang2021().resources, "filters.sedpy")
    # residual = "etc" says whose pattern it is, not how strong
    exposure_data = (*IMAGE_RESOURCES, "instrument.etc")
    return (
        Stage(
            "catalog",
            "inputs:make_catalog",
            "catalogue",
            sections=("catalog",),
            plan=lambda config, _: (
                fingerprint(config.catalog.source) if config.catalog.source in resources() else ""
            ),
        ),
        Stage(
            "seds",
            "inputs:fit_inputs",
            "input SEDs",
            version=2,
            needs=("catalog",),
            sections=("sed.axes", "sed.catalog_error", "sed.max_wavelength", "fit.model_error"),
            resources=sed_data,
            plan=lambda config, _: plain_axes(input_axes(config.sed.axes)),
            kernels=("fit",),
        ),
        Stage(
            "truth",
            "inputs:make_truth",
            "model fluxes",
            version=2,
            needs=("catalog", "seds"),
            sections=(
                "sed.frac_agn",
                "sed.alpha",
                "exposures.filters",
                "fit.bands",
                "highres.filter",
            ),
            resources=sed_data,
            kernels=("fit",),
        ),
        Stage(
            "exposures",
            "images:make_exposure",
            "exposure",
            version=3,
            needs=("truth",),
            sections=(*images, "run.keep_level1b"),
            resources=exposure_data,
            units=exposure_units,
            plan=exposure_plan,
            memory=exposure_memory,
            kernels=("images",),
        ),
        Stage(
            "mosaics",
            "images:make_mosaic",
            "mosaic",
            needs=("exposures",),
            sections=(*grid, "reduction", "highres.pixel_scale"),
            units=_filters,
            plan=exposure_plan,
            kernels=("images",),
        ),
        Stage(
            "highres",
            "images:make_highres",
            "high-resolution image",
            version=2,
            needs=("truth",),
            sections=(*grid, "highres", "photometry.threshold", "photometry.min_area"),
            resources=("filters.sedpy",),
            plan=lambda config, _: exposure_plan(config),
            kernels=("images",),
        ),
        Stage(
            "kernels",
            "images:make_kernel",
            "matching kernel",
            version=2,
            sections=(*grid, *kernel),
            resources=IMAGE_RESOURCES,
            units=_filters,
            plan=exposure_plan,
            kernels=("images", "photometry"),
        ),
        Stage(
            "templates",
            "measure:make_templates",
            "templates of the sources",
            needs=("highres",),
            sections=("highres.filter", "highres.pixel_scale"),
            kernels=("photometry",),
        ),
        Stage(
            "photometry",
            "measure:measure_photometry",
            "forced photometry",
            needs=("mosaics", "highres", "kernels", "templates"),
            sections=(*grid, *kernel, "photometry.method"),
            resources=IMAGE_RESOURCES,
            plan=exposure_plan,
            units=_filters,
            kernels=("photometry",),
            version=4,
        ),
        Stage(
            "points",
            "points:measure_point_sources",
            "point sources",
            version=3,
            needs=("kernels",),
            sections=(
                *images,
                "highres",
                "photometry.threshold",
                "photometry.min_area",
                "photometry.method",
                "point_sources",
            ),
            resources=exposure_data,
            plan=exposure_plan,
            units=lambda config: _filters(config) if config.point_sources.enabled else (),
            memory=exposure_memory,
            kernels=("images", "photometry"),
        ),
        Stage(
            "errors",
            "measure:make_errors",
            "error function",
            version=2,
            needs=("truth", "mosaics", "photometry"),
            sections=(
                "errors",
                "exposures.filters",
                "photometry.match_radius",
                "fit.min_detected",
                "fit.axes",
            ),
            plan=lambda config, _: plain_axes(SEDModel.yang2021_axes(config.fit.axes)),
        ),
        Stage(
            "fits",
            "measure:fit_photometry",
            "fit",
            version=4,
            needs=("truth", "errors"),
            sections=("fit", "exposures.filters"),
            resources=sed_data,
            plan=lambda config, _: plain_axes(SEDModel.yang2021_axes(config.fit.axes)),
            units=lambda _: ("with_miri", "without_miri"),
            kernels=("fit",),
        ),
        Stage(
            "report",
            "report:make_report",
            "report",
            version=3,
            needs=(
                "catalog",
                "truth",
                "exposures",
                "mosaics",
                "highres",
                "photometry",
                "points",
                "errors",
                "fits",
            ),
            sections=(
                *grid,
                "run.name",
                "catalog",
                "sed",
                "detector",
                "highres.filter",
                "highres.pixel_scale",
                "photometry.method",
                "reduction.pixel_scale",
                "fit",
                "errors",
                "point_sources",
                "report",
            ),
            resources=(*sed_data, *exposure_data),
            plan=exposure_plan,
            kernels=("fit",),
        ),
    )
