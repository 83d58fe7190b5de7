"""The whole study: configuration, stages, and a runner that resumes."""

from miricigale.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "config": ("StudyConfig", "load_config", "preset_names"),
        "engine.runner": ("StudyRunner",),
        "engine.stage": ("Context", "Stage"),
        "stages": ("study_stages",),
        "engine.store": ("ProductStore",),
        "disk": ("disk_use",),
        "study": ("check_study", "run_study"),
    },
)
