"""The history of an exposure: who made it, what was done to it, and with which references."""

import dataclasses
import numbers

import numpy as np
from astropy.time import Time

from miricigale.instrument.keywords import steps_done
from miricigale.utils.exceptions import argument_error
from miricigale.utils.named_values import attributes, without_none
from miricigale.utils.package_tables import declared

_STEPS = declared("miricigale.instrument", "keywords.toml")["references"].items()
#: References in the order in which they are used, with the step after which each is not needed any more.
REFERENCES = {name: step or None for name, step in _STEPS}

#: Reference types of CRDS whose names are not those of `REFERENCES`.
TYPES = {"bias": "superbias", "read_noise": "readnoise"}

#: ORIGIN of files of simulated ramps, which other pipelines keep in theirs.
ORIGIN = "miricigale"


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExposureHistory:
    """
    Who made an exposure, what was done to it, and with which references.

    What a reduction does to an exposure depends on this and on its settings alone.

    Parameters
    ----------
    origin : {"simulated", "unrecorded", "other"}, optional
        The package's `~miricigale.detector.Detector`, with the record of what acted; the same without the
        record, as in the rates that another pipeline makes of its ramps; or anything else.
    steps : iterable of str, optional
        What was done (`~miricigale.instrument.STEPS`), kept as a frozenset; a text is taken apart.
    references : dict of str to str, optional
        File or constant that was used, by the names of `~miricigale.reduction.ReferenceFiles`.
    day : float, optional
        Middle of the exposure, MJD.
    gain : float, optional
        Electrons per DN that slopes were fitted with.

    Raises
    ------
    ValueError
        If a value is of another kind.

    Examples
    --------
    >>> from astropy.io.fits import Header
    >>> from miricigale.instrument import ExposureHistory
    >>> header = Header({"ORIGIN": "miricigale", "S_LINEAR": "COMPLETE", "EXPMID": 60000.5})
    >>> history = ExposureHistory.from_header(header)
    >>> history.origin, history.done("bias"), history.done("dark")
    ('unrecorded', True, False)
    """

    origin: str = "other"
    steps: frozenset = frozenset()
    references: dict = dataclasses.field(default_factory=dict)
    day: float | None = None
    gain: float | None = None

    def __post_init__(self):
        steps = self.steps
        if isinstance(steps, str):
            steps = steps.replace(",", " ").split()
        object.__setattr__(self, "steps", frozenset(str(name).lower() for name in steps))
        for name in ("day", "gain"):
            value = getattr(self, name)
            if value is not None and not isinstance(value, numbers.Real):
                raise argument_error(
                    "exposure", f"one whose meta[{name!r}] is a number", repr(value)
                )

    replace = dataclasses.replace

    @classmethod
    def from_header(cls, header, *, recorded=False):
        """
        Return the history that the keywords of a file tell.

        Parameters
        ----------
        header : mapping
            As `~miricigale.instrument.joined_header` makes it.
        recorded : bool, optional
            Whether the file has the record of the simulated detector.

        Returns
        -------
        history : `ExposureHistory`
        """
        origin = "other"
        if header.get("ORIGIN") == ORIGIN:
            origin = "unrecorded"
        # the first six letters of the type in CRDS
        words = {name: f"R_{TYPES.get(name, name)[:6].upper()}" for name in REFERENCES}
        stated_files = {name: str(header[word]) for name, word in words.items() if word in header}
        references = {name: text.removeprefix("crds://") for name, text in stated_files.items()}
        if recorded:
            origin = "simulated"
        return cls(
            origin=origin, steps=steps_done(header), references=references, day=_middle_of(header)
        )

    @classmethod
    def of(cls, exposure):
        """
        Return the history of an exposure.

        Parameters
        ----------
        exposure : `~miricigale.detector.Ramp`, `~miricigale.detector.Charge` or `~astropy.nddata.CCDData`
            What has no ``history`` has it in its meta dictionary.

        Returns
        -------
        history : `ExposureHistory`
        """
        if hasattr(exposure, "history"):
            return exposure.history
        meta = getattr(exposure, "meta", None) or {}
        names = ("origin", "steps", "day", "gain")
        values = {name: meta[name] for name in names if meta.get(name) is not None}
        if meta.get("simulated"):
            values["origin"] = "simulated"
        references = {}
        for name in REFERENCES:
            if f"reference_{name}" in meta:
                references[name] = meta[f"reference_{name}"]
        return cls(**values, references=references)

    def meta(self):
        """Return the entries of the meta dictionary of an image, from which `of` makes it again."""
        values = {
            "simulated": self.simulated,
            "origin": self.origin if self.origin == "unrecorded" else None,
            "steps": sorted(self.steps) or None,
            **attributes(self, ("day", "gain")),
            **{f"reference_{name}": text for name, text in self.references.items()},
        }
        return without_none(values)

    @property
    def simulated(self):
        """Whether the package's Detector made the counts, and it is known what acted."""
        return self.origin == "simulated"

    def done(self, reference):
        """Tell whether the step of a reference was done; linear DN have their bias behind them."""
        step = REFERENCES[reference]
        return step in self.steps or (reference == "bias" and "linearity" in self.steps)


def _middle_of(header):
    """Return the middle of an exposure (MJD), or its start where that is all that is known."""
    for name in ("EXPMID", "EXPSTART"):
        if np.isfinite(day := float(header.get(name) or np.nan)):
            return day
    try:
        start = Time(f"{header['DATE-OBS']}T{header.get('TIME-OBS', '00:00:00')}", scale="utc")
    except (KeyError, ValueError):
        return None
    return float(start.mjd)


#: Keywords of the middle of an exposure, and of its start, MJD.
_MIDDLES = ("MJD-AVG", "MJD-MID", "EXPMID", "EXPSTART", "MJD-OBS", "MJD-BEG")


def keyword_values(meta):
    """Return the values of the keywords that the meta dictionary of an image keeps, without their comments."""
    values = {}
    for name, card in meta.get("keywords", {}).items():
        values[name] = card[0] if isinstance(card, list) else card
    return values


def epoch_of(image):
    """
    Tell when an image was taken.

    Parameters
    ----------
    image : `~astropy.nddata.CCDData` or other
        Its history, the keywords in its meta dictionary or those of its WCS say it.

    Returns
    -------
    epoch : `~astropy.time.Time` or None
        The middle of the exposure, or its start if that is all that is there; None where nothing is.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.nddata import CCDData
    >>> from miricigale.instrument import epoch_of
    >>> image = CCDData(np.ones((4, 4)), unit="MJy/sr", meta={"day": 60310.0})
    >>> print(epoch_of(image).iso)
    2024-01-01 00:00:00.000
    """
    meta = getattr(image, "meta", None) or {}
    header = keyword_values(meta)
    days = [header.get(name) for name in _MIDDLES[:3]]
    days += [meta.get("day"), *map(header.get, _MIDDLES[3:])]
    wcs = getattr(getattr(image, "wcs", None), "wcs", None)
    days += [getattr(wcs, name, None) for name in ("mjdavg", "mjdobs", "mjdbeg")]
    for day in days:
        # keywords of what is not known are 0
        if isinstance(day, numbers.Real) and np.isfinite(day) and day > 0:
            return Time(float(day), format="mjd", scale="utc")
    for text in (getattr(wcs, "dateavg", ""), getattr(wcs, "dateobs", "")):
        if text:
            return Time(text, scale="utc")
    day = _middle_of(header)
    if day is None:
        return None
    return Time(day, format="mjd", scale="utc")
