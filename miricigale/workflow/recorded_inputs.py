"""Files and settings as plain text in the record of a run, and the states of files that it depends on."""

import dataclasses
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
from miricigale.utils.store import plain_value

#: Fields of an image that name files.
PATHS = ("path", "error", "variance", "inverse_variance", "weight", "psf")

#: What may stand in a record, by name.
_KINDS = {
    kind.__name__: kind
    for kind in (
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
}


def absolute(path):
    """The same path for workers, which have another working directory; None stays."""
    return None if path is None else os.path.abspath(path)


def _plain(value):
    """What JSON does not know, as it does; `_restored` takes it back."""
    if isinstance(value, u.Quantity):
        return {"value": float(value.value), "unit": value.unit.to_string()}
    if type(value).__name__ in _KINDS:
        known = {one.name: getattr(value, one.name) for one in dataclasses.fields(value)}
        if isinstance(value, MosaicFile):
            known |= {name: absolute(known[name]) for name in PATHS}
        known = {k: absolute(v) if isinstance(v, Path) else v for k, v in known.items()}
        return {"of": type(value).__name__, **known}
    return os.fspath(value) if isinstance(value, os.PathLike) else plain_value(value)


def _restored(values):
    if values.keys() == {"value", "unit"}:
        return values["value"] * u.Unit(values["unit"])
    if "of" not in values:
        return values
    kind = _KINDS[values.pop("of")]
    return kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()})


def as_text(value):
    """
    Text of settings, from which `from_text` makes them again.

    Parameters
    ----------
    value : object
        Plain values, quantities, paths, images and settings of photometry and reduction, in dicts and lists.

    Returns
    -------
    text : str
        JSON, the same for the same settings; paths of images are absolute.
    """
    return json.dumps(value, default=_plain, sort_keys=True)


def from_text(text):
    """Settings of a text that `as_text` made; lists are lists."""
    return json.loads(text, object_hook=_restored)


def inputs_text(inputs):
    """Text of what is measured (`~miricigale.photometry.commands.file_inputs.Inputs`)."""
    return as_text({one.name: getattr(inputs, one.name) for one in dataclasses.fields(inputs)})


def inputs_from_text(text):
    """What is measured, of a text that `inputs_text` made."""
    values = from_text(text)
    return Inputs(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()})


def file_states(inputs, others=()):
    """
    Size and time of each file that is read, for the digest of a stage.

    Parameters
    ----------
    inputs : `~miricigale.photometry.commands.file_inputs.Inputs`
        What is measured.
    others : iterable of path-like, optional
        Further files.

    Returns
    -------
    states : dict of str to list of int
        By path.
    """
    files = [inputs.highres, *inputs.images, *inputs.detection]
    paths = [getattr(one, name) for one in files for name in PATHS]
    paths = {file_place(one)[0] for one in (*paths, *inputs.paths, *others) if one is not None}
    states = {path: os.stat(path) for path in sorted(map(str, paths))}
    return {path: [one.st_size, one.st_mtime_ns] for path, one in states.items()}
