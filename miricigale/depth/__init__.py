"""How deep an exposure goes: what saturates, how faint a source is measured, published limits."""

from miricigale.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "brightest": ("saturation_flux",),
        "fitted": ("fitted_noise",),
        "limits": ("aperture_noise", "sensitivity", "sensitivity_table"),
        "noise": ("ExposureNoise",),
        "published": (
            "EtcSetup",
            "etc_limit",
            "etc_setup",
            "proposal_limit",
            "residual_amplitude",
            "residual_presets",
            "scaled_limit",
        ),
        "saturation": (
            "SaturationForecast",
            "forecast_table",
            "saturation_forecast",
            "saturation_time",
        ),
        "zodiacal": ("sky_background", "zodiacal_factor", "zodiacal_levels"),
    },
)
