"""The whole study: configuration, stages, and a runner that resumes."""

from miricigale.workflow.config import StudyConfig, load_config, preset_names
from miricigale.workflow.products import read_image, write_image
from miricigale.workflow.runner import OtherRunError, StudyRunner
from miricigale.workflow.stage import Context, Stage
from miricigale.workflow.stages import study_stages
from miricigale.workflow.store import ProductStore
from miricigale.workflow.study import check_study, disk_use, run_study

__all__ = [
    "Context",
    "OtherRunError",
    "ProductStore",
    "Stage",
    "StudyConfig",
    "StudyRunner",
    "check_study",
    "disk_use",
    "load_config",
    "preset_names",
    "read_image",
    "run_study",
    "study_stages",
    "write_image",
]
