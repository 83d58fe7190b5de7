"""The stages of the study, in order."""


def study_stages():
    """
    Return the stages, each after what it needs.

    Returns
    -------
    stages : tuple of `~miricigale.workflow.engine.stage.Stage`

    Examples
    --------
    >>> from miricigale.workflow import study_stages
    >>> [stage.name for stage in study_stages()][:5]
    ['catalog', 'seds', 'truth', 'exposures', 'mosaics']
    """
    from miricigale.workflow.page import report_stage, sources_stage
    from miricigale.workflow.stages import (
        experiments,
        fits,
        images,
        inputs,
        measure,
        points,
        rivals,
        skies,
        truth,
        variants,
    )

    return (
        inputs.make_catalog,
        inputs.fit_inputs,
        truth.make_truth,
        images.make_exposure,
        images.make_mosaic,
        images.make_highres,
        measure.join_detections,
        images.make_kernel,
        measure.make_templates,
        measure.measure_photometry,
        measure.join_photometry,
        points.measure_point_sources,
        fits.make_errors,
        fits.match_sources,
        rivals.measure_rivals,
        variants.measure_variants,
        fits.fit_photometry,
        experiments.fit_experiment,
        skies.fit_skies,
        sources_stage.make_sources,
        report_stage.make_report,
    )
