"""Data models of the official pipeline (``jwst``), which may hold images and ramps in memory."""

import tempfile
from pathlib import Path


def is_data_model(value):
    """Tell whether something is a data model of ``jwst``, known without importing it."""
    return callable(getattr(value, "save", None)) and hasattr(
        getattr(value, "meta", None), "instrument"
    )


def read_data_model(model, read):
    """
    Read a data model as the file that it saves, which has all of its planes, header and WCS.

    Parameters
    ----------
    model : `jwst.datamodels.JwstDataModel`
        Such as an ``ImageModel`` or a ``RampModel``.
    read : callable
        Function of the path that returns what is read.
    """
    with tempfile.TemporaryDirectory() as folder:
        return read(Path(model.save(str(Path(folder) / "model.fits"))))
