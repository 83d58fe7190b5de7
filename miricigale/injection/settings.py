"""Settings of injection."""

import dataclasses

from miricigale.photometry import DETECTION_PRESETS, DetectionPreset
from miricigale.utils.options import check_least, check_names, check_positive, check_that
from miricigale.utils.random import check_seed
from miricigale.utils.values import value_class


@value_class(repr=False)
class InjectionSettings:
    """What is injected, and what counts as found; each as for `~miricigale.injection.Injection`."""

    catalog: object = None
    _: dataclasses.KW_ONLY
    n_trials: int = 10
    n_sources: int | None = None
    stars: float = 0.5
    threshold: float = 5.0
    preset: object = "yang2021_miri"
    seed: int = 1

    def __post_init__(self):
        check_least(self.n_trials, "n_trials", 1, whole=True)
        if self.n_sources is not None:
            check_least(self.n_sources, "n_sources", 0, whole=True)
        check_that(0 <= self.stars <= 1, "stars", "a share from 0 to 1", self.stars)
        check_positive(self.threshold, "threshold")
        if not isinstance(self.preset, DetectionPreset):
            check_names([self.preset], "detection preset", DETECTION_PRESETS)
        object.__setattr__(self, "seed", check_seed(self.seed))
