"""What exposures would yield: noise or images, fits of mock photometry, times."""

from miricigale.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "commands": ("plan_table", "write_plan"),
        "config": ("PlanConfig", "load_plan"),
        "exposures": ("BandPlan", "wall_clock"),
        "images": ("image_sample", "images_study", "paired_bands", "paired_numbers"),
        "page": ("write_page",),
        "planner": ("Plan", "Planner"),
        "compare": ("area_table", "comparison_table"),
        "sample": ("make_sample",),
    },
)
