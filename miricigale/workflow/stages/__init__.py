"""The stages of the study, in order."""

from miricigale.workflow.stages.images import (
    exposure_plan,
    exposure_units,
    make_exposure,
    make_highres,
    make_kernel,
    make_mosaic,
)
from miricigale.workflow.stages.inputs import axes_plan, fit_inputs, make_catalog, make_truth
from miricigale.workflow.stages.measure import fit_photometry, make_errors, measure_photometry
from miricigale.workflow.stages.points import measure_point_sources
from miricigale.workflow.stages.report import make_report

__all__ = ["study_stages"]


def _filters(config):
    return config.exposures.filters


def study_stages():
    """
    The stages, each after what it needs.

    Returns
    -------
    stages : tuple of `~miricigale.workflow.runner.Stage`
    """
    from miricigale.workflow.runner import Stage

    images = ("pointing", "exposures", "scene", "detector", "reduction")
    sed_data = ("ssp.bc03", "dust.dl07")
    return (
        Stage("catalog", make_catalog, "catalogue", sections=("catalog", "highres")),
        Stage(
            "seds",
            fit_inputs,
            "input SEDs",
            needs=("catalog",),
            sections=("sed", "fit"),
            resources=sed_data,
            plan=lambda config, _: axes_plan(config.sed.axes),
        ),
        Stage(
            "truth",
            make_truth,
            "model fluxes",
            needs=("catalog", "seds"),
            sections=("sed", "exposures", "fit", "highres"),
            resources=sed_data,
        ),
        Stage(
            "exposures",
            make_exposure,
            "exposure",
            needs=("truth",),
            sections=images,
            units=exposure_units,
            plan=lambda config, unit: {
                "exposures": exposure_plan(config, unit),
                "keep_level1b": config.run.keep_level1b,
            },
        ),
        Stage(
            "mosaics",
            make_mosaic,
            "mosaic",
            needs=("exposures",),
            sections=("exposures", "pointing", "reduction", "highres"),
            units=_filters,
            plan=exposure_plan,
        ),
        Stage(
            "highres",
            make_highres,
            "high-resolution image",
            needs=("truth",),
            sections=("highres", "photometry", "pointing", "exposures", "reduction"),
            plan=lambda config, _: exposure_plan(config),
        ),
        Stage(
            "kernels",
            make_kernel,
            "matching kernel",
            sections=("highres", "photometry", "pointing", "exposures", "reduction"),
            units=_filters,
            plan=exposure_plan,
        ),
        Stage(
            "photometry",
            measure_photometry,
            "forced photometry",
            needs=("mosaics", "highres", "kernels"),
            sections=("photometry", "exposures"),
            units=_filters,
        ),
        Stage(
            "points",
            measure_point_sources,
            "point sources",
            needs=("kernels",),
            sections=(*images, "highres", "point_sources", "photometry"),
            plan=exposure_plan,
            units=lambda config: _filters(config) if config.point_sources.enabled else (),
        ),
        Stage(
            "errors",
            make_errors,
            "error function",
            needs=("truth", "photometry"),
            sections=("errors", "photometry", "exposures"),
        ),
        Stage(
            "fits",
            fit_photometry,
            "fit",
            needs=("truth", "errors"),
            sections=("fit", "exposures"),
            resources=sed_data,
            plan=lambda config, _: axes_plan(config.fit.axes),
            units=lambda _: ("with_miri", "without_miri"),
        ),
        Stage(
            "report",
            make_report,
            "report",
            needs=(
                "catalog",
                "truth",
                "mosaics",
                "highres",
                "photometry",
                "points",
                "errors",
                "fits",
            ),
            sections=("report", "exposures", "fit", "errors", "pointing", "sed"),
        ),
    )
