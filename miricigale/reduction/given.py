"""Exposures as a `Reducer` takes them: objects, paths, patterns of files and data models."""

import glob
import os

from astropy.nddata import CCDData

from miricigale.detector import Charge, Ramp
from miricigale.instrument.data_models import is_data_model, read_data_model
from miricigale.reduction.files import open_exposure
from miricigale.utils.exceptions import DataError, argument_error


def opened(given):
    """An exposure of its file or data model; anything else itself."""
    if is_data_model(given):
        return read_data_model(given, open_exposure)
    return open_exposure(given) if isinstance(given, (str, os.PathLike)) else given


def several(given):
    """Exposures of one, of a pattern of files, or of several."""
    if isinstance(given, str) and glob.has_magic(given) and not os.path.exists(given):
        paths = sorted(glob.glob(os.path.expanduser(given)))
        if not paths:
            msg = f"no file is called {given}"
            raise DataError(msg)
        return paths
    if isinstance(given, (str, os.PathLike)) and os.path.isdir(given):
        wanted = f"files, such as {os.path.join(given, '*_uncal.fits')!r}"
        raise argument_error("ramps", wanted, "a folder")
    one = isinstance(given, (str, os.PathLike, Ramp, Charge, CCDData)) or is_data_model(given)
    return [given] if one else given
