"""Truth against result, from tables: matching, metrics, classes, a study beside its paper, the report."""

from miricigale.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "estimates": ("Estimate", "bootstrap"),
        "classes": (
            "CLASS_NAMES",
            "KIRKPATRICK_LIMITS",
            "SelectionQuality",
            "class_fractions",
            "classify",
            "confusion",
            "selection_quality",
        ),
        "colors": ("COLOR_WINDOWS", "ColorCircles", "ColorWindow", "color_classes"),
        "counts": (
            "PUBLISHED_LIGHT",
            "dust_obscured_fraction",
            "integrated_light",
            "main_sequence_dust",
            "main_sequence_sfr",
            "number_counts",
            "sfr_to_infrared_luminosity",
            "uvj_quiescent",
        ),
        "coverage": ("coverage_table", "posterior_ranks"),
        "infrared": (
            "PAH_FEATURES",
            "equivalent_width",
            "feature_magnitude",
            "feature_redshifts",
            "feature_residuals",
            "light_share",
            "mid_infrared_fractions",
        ),
        "match": ("AssociationFlags", "associate", "match_truth"),
        "metrics": (
            "PhotozMetrics",
            "RecoveryMetrics",
            "fraction_interval",
            "photoz_metrics",
            "recovery_metrics",
            "running_median",
            "sigma_mad",
        ),
        "population": (
            "AGNPopulation",
            "agn_fraction",
            "galaxy_mass_function",
            "xray_luminosity_function",
            "xray_obscured_fraction",
        ),
        "report": ("Missing", "Report", "number"),
        "xray": (
            "XRAY_LIMITS",
            "XRayLimit",
            "completeness",
            "half_complete",
            "xray_luminosity_at",
            "yang2021_xray_flux",
        ),
    },
)
