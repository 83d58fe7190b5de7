"""Settings of a `Reducer`, checked, and as options of the steps."""

from miricigale.detector import ResetAnomaly
from miricigale.instrument import DetectorProperties
from miricigale.reduction.background import NEGATIVE_NOISES, check_mesh
from miricigale.reduction.reference_cache import ReferenceCache
from miricigale.reduction.references import ReferenceFiles
from miricigale.utils.exceptions import argument_error
from miricigale.utils.options import check_choice, check_kind, check_positive
from miricigale.utils.parallel import thread_count

__all__ = ["BACKENDS", "check_settings", "mesh_options", "negative_options"]

#: Known backends.
BACKENDS = ("native", "jwst")


def check_settings(reducer):
    """
    Refuse settings of a `~miricigale.reduction.Reducer` that are out of range.

    Raises
    ------
    ValueError
        Naming the setting, what was wanted and what came.
    """
    for name, known in (
        ("backend", BACKENDS),
        ("background", ("masked", "sep", "dithers")),
        ("negative_noise", NEGATIVE_NOISES),
        ("reference_correction", (True, False, "channels", None)),
    ):
        check_choice(getattr(reducer, name), name, known)
    for name in (
        "jump_threshold", "neighbor_threshold", "shower_threshold", "negative_threshold",
        "outlier_threshold",
    ):  # fmt: skip
        check_positive(getattr(reducer, name), name, optional=True)
    for name in ("cosmic_ray_sigma", "cosmic_ray_contrast"):
        check_positive(getattr(reducer, name), name)
    check_mesh(reducer.box, reducer.filter_size)
    for name in ("skip_first", "skip_last"):
        value = getattr(reducer, name)
        if value is not None and (value < 0 or int(value) != value):
            raise argument_error(name, "an integer of at least 0", value)
    for name in ("saturation", "pixfrac"):
        if not 0 < getattr(reducer, name) <= 1:
            raise argument_error(name, "above 0 and at most 1", getattr(reducer, name))
    if reducer.reference_window is not None and reducer.reference_correction != "channels":
        wanted = "None without reference_correction='channels'"
        raise argument_error("reference_window", wanted, reducer.reference_window)
    thread_count(reducer.n_threads)
    check_kind(reducer.reset_anomaly, "reset_anomaly", ResetAnomaly)
    check_kind(reducer.properties, "properties", DetectorProperties)
    if not isinstance(reducer.references, (ReferenceFiles, ReferenceCache)) and (
        reducer.references not in (None, "none", "simulated")
    ):
        wanted = "ReferenceFiles, a ReferenceCache, 'none', 'simulated' or None"
        raise argument_error("references", wanted, repr(reducer.references))


def mesh_options(reducer):
    """Options of `~miricigale.reduction.estimate_background`."""
    options = {name: getattr(reducer, name) for name in ("box", "filter_size", "plane")}
    return options | {"method": "sep" if reducer.background == "sep" else "masked"}


def negative_options(reducer):
    """Options of `~miricigale.reduction.background.remove_background`."""
    return {name: getattr(reducer, name) for name in ("negative_threshold", "negative_noise")}
