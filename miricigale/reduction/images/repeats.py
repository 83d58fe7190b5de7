"""Exposures that are given twice: by their data, or by their keywords at two stages."""

import contextlib
import hashlib
import json

import numpy as np

from miricigale.instrument import ExposureHistory, joined_header
from miricigale.instrument.history import ORIGIN, keyword_values
from miricigale.utils.files import open_fits
from miricigale.utils.options import check_that

#: Keywords that together name an exposure of JWST.
_NAMES = (
    "PROGRAM", "OBSERVTN", "VISIT", "VISITGRP", "SEQ_ID", "ACT_ID", "EXPOSURE", "EXSEGNUM", "EXPSTART", "DETECTOR",
    "FILTER", "PATT_NUM",
)  # fmt: skip


class ExposureRecord:
    """
    Exposures that were seen so far.

    Two are the same if their data are, bit for bit, or if their keywords are: one is made of the other, or they
    are two versions of it. Simulations with other seeds share their keywords, so that of these at one stage (ramp,
    slopes, brightness) the data alone tell. Data of one single value, which have no noise, are never the same.
    """

    def __init__(self):
        self._data = {}
        self._keywords = {}

    def add(self, name, data, header, stage):
        """
        Remember an exposure.

        Parameters
        ----------
        name : str
            What it is called in messages.
        data : `~numpy.ndarray`
            Its counts or brightness.
        header : mapping
            Its keywords.
        stage : str
            What tells stages from each other.

        Returns
        -------
        same : str or None
            The name of the first one that it repeats.
        """
        data = np.ascontiguousarray(data)
        duplicate = None
        first = 0
        if data.size:
            first = data.flat[0]
        if not np.all(data == first):
            duplicate = self._data.setdefault(hashlib.sha256(data).hexdigest(), name)
        words = tuple(str(header.get(key)) for key in _NAMES)
        if header.get("EXPSTART") is not None and header.get("PROGRAM") is not None:
            first_name, before = self._keywords.setdefault(words, (name, stage))
            if (not _is_simulated(header) or before != stage) and duplicate in (None, name):
                duplicate = first_name
        if duplicate == name:
            return None
        return duplicate

    def add_file(self, path):
        """As `add`, of a FITS file with an image or ramp in SCI; None for what is no such file."""
        try:
            with open_fits(path, wanted="an exposure") as hdus:
                if "SCI" in hdus:
                    science = hdus["SCI"]
                else:
                    science = hdus[0]
                if science.data is None:
                    return None
                header = joined_header(hdus)
                stage = f"{science.data.ndim} {header.get('BUNIT')}"
                return self.add(str(path), science.data, header, stage)
        except (OSError, KeyError, ValueError):
            # what is wrong is said when the file is reduced
            return None

    def check(self, name, exposure):
        """Refuse an exposure that repeats another one."""
        data = getattr(exposure, "data", None)
        if data is None or np.ndim(data) < 2:
            return
        header = keyword_values(getattr(exposure, "meta", None) or {})
        if getattr(exposure, "observed", False):
            header = exposure.header
        if ExposureHistory.of(exposure).origin != "other":
            header["ORIGIN"] = ORIGIN
        stage = f"{np.ndim(data)} {getattr(exposure, 'unit', None)}"
        duplicate = self.add(name, np.asarray(data), header, stage)
        check_that(
            duplicate is None, "ramps", "exposures that differ", f"{name}, the same as {duplicate}"
        )


def _is_simulated(header):
    """Tell whether a header is that of a simulation of the package, or of what was made of one."""
    if header.get("ORIGIN") == ORIGIN:
        return True
    meta = {}
    # of another program it may be no JSON
    with contextlib.suppress(json.JSONDecodeError, TypeError):
        meta = json.loads(header.get("META", "{}"))
    return bool(meta.get("simulated")) or meta.get("origin") == "unrecorded"
