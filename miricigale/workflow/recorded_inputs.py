"""Files and settings as plain text in the record of a run, and the states of files that it depends on."""

import json
import os
from pathlib import Path

import astropy.units as u

from miricigale.instrument import DetectorProperties
from miricigale.photometry import ErrorSettings, MemorySettings, MosaicFile
from miricigale.photometry.commands.file_inputs import Inputs
from miricigale.reduction import (
    BackgroundSettings,
    MosaicSettings,
    RampSettings,
    Reducer,
    ReferenceCache,
    ReferenceFiles,
)
from miricigale.utils.files import file_place
from miricigale.utils.named_values import field_values
from miricigale.utils.store import plain_value

#: Fields of an image that name files.
PATHS = ("path", "error", "variance", "inverse_variance", "weight", "psf")

#: Classes whose instances may stand in a record.
_CLASSES = (
    BackgroundSettings,
    DetectorProperties,
    ErrorSettings,
    MemorySettings,
    MosaicFile,
    MosaicSettings,
    RampSettings,
    Reducer,
    ReferenceCache,
    ReferenceFiles,
)


def absolute(path):
    """Return the same path for workers, which have another working directory; None stays."""
    if path is None:
        return None
    return os.path.abspath(path)


def _with_tuples(values):
    """Return values with tuples in place of lists, as fields of settings are."""
    restored = dict(values)
    for name, value in values.items():
        if isinstance(value, list):
            restored[name] = tuple(value)
    return restored


def _plain_value(value):
    """Return a value that JSON does not know in a form that it does; `_restored` takes it back."""
    if isinstance(value, u.Quantity):
        return {"value": float(value.value), "unit": value.unit.to_string()}
    if type(value) in _CLASSES:
        entries = field_values(value)
        for name, entry in entries.items():
            is_path = isinstance(entry, Path)
            if is_path or (isinstance(value, MosaicFile) and name in PATHS):
                entries[name] = absolute(entry)
        return {"of": type(value).__name__, **entries}
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    return plain_value(value)


def _restored(values):
    """Return what `_plain_value` made plain."""
    if values.keys() == {"value", "unit"}:
        return values["value"] * u.Unit(values["unit"])
    if "of" not in values:
        return values
    name = values.pop("of")
    (kind,) = (kind for kind in _CLASSES if kind.__name__ == name)
    return kind(**_with_tuples(values))


def as_text(value):
    """
    Write settings as text, from which `from_text` makes them again.

    Parameters
    ----------
    value : object
        Plain values, quantities, paths, images and settings of photometry and reduction, in dicts and lists.

    Returns
    -------
    text : str
        JSON, the same for the same settings; paths of images are absolute.
    """
    return json.dumps(value, default=_plain_value, sort_keys=True)


def from_text(text):
    """Read settings from a text that `as_text` made; lists are lists."""
    return json.loads(text, object_hook=_restored)


def inputs_text(inputs):
    """Write what is measured (`~miricigale.photometry.commands.file_inputs.Inputs`) as text."""
    return as_text(field_values(inputs))


def inputs_from_text(text):
    """Read what is measured from a text that `inputs_text` made."""
    return Inputs(**_with_tuples(from_text(text)))


def file_states(inputs, further_paths=()):
    """
    Return size and time of each file that is read, for the digest of a stage.

    Parameters
    ----------
    inputs : `~miricigale.photometry.commands.file_inputs.Inputs`
        What is measured.
    further_paths : iterable of path-like, optional
        Further files.

    Returns
    -------
    states : dict of str to list of int
        By path.
    """
    paths = list(inputs.paths) + list(further_paths)
    for file in (inputs.highres, *inputs.images, *inputs.detection):
        paths += [getattr(file, name) for name in PATHS]
    return path_states(paths)


def path_states(paths):
    """Return size and time of files by path, as `file_states`; paths may name an extension, or be None."""
    files = {str(file_place(path)[0]) for path in paths if path is not None}
    states = {}
    for file in sorted(files):
        stat = os.stat(file)
        states[file] = [stat.st_size, stat.st_mtime_ns]
    return states
