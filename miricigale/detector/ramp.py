"""The ramp: counts of one exposure, group by group, and its file."""

import numpy as np
from astropy.nddata import NDData

from miricigale.detector import level1b
from miricigale.detector.effects import Effect
from miricigale.utils.exceptions import argument_error
from miricigale.utils.units import DN

__all__ = ["Ramp"]


def _read_only(array):
    view = array.view()
    view.flags.writeable = False
    return view


def _remade(data, exposure, values):
    return Ramp(data, exposure, **values)


class Ramp(NDData):
    """
    Counts of one exposure: every group of every integration.

    A ramp never changes. Its arrays are large, so that they are not copied but marked
    read-only.

    Parameters
    ----------
    data : `~numpy.ndarray` of uint16 or float32, shape (n_int, n_group, ny, nx)
        Counts in DN.
    exposure : `~miricigale.instrument.Exposure`
        What was exposed.
    pixel_dq : `~numpy.ndarray` of uint32, shape (ny, nx), optional
        Flags of pixels, bits as in `DQ`; zero if not given.
    group_dq : `~numpy.ndarray` of uint8, shape like ``data``, optional
        Flags of groups (the lower eight bits of `DQ`); None where they are not known, as
        in a file of level 1b.
    effects : tuple of `Effect`, optional
        What acted on the light and the charge, in order; None where it is not known, as for
        ramps of the observatory.
    meta : dict, optional
        Where it came from.

    Raises
    ------
    ValueError
        If a shape is not that of the exposure or a dtype is another.
    """

    def __init__(self, data, exposure, *, pixel_dq=None, group_dq=None, effects=None, meta=None):
        data = np.asarray(data)
        shape = (exposure.n_integrations, exposure.n_groups, *exposure.shape)
        if data.shape != shape:
            raise argument_error("data", f"of the exposure's shape {shape}", data.shape)
        if data.dtype not in (np.uint16, np.float32):
            raise argument_error("data", "of dtype uint16 or float32", data.dtype)
        if pixel_dq is None:
            pixel_dq = np.zeros(shape[2:], np.uint32)
        pixel_dq = np.asarray(pixel_dq)
        if pixel_dq.shape != shape[2:] or pixel_dq.dtype != np.uint32:
            got = f"shape {pixel_dq.shape}, dtype {pixel_dq.dtype}"
            raise argument_error("pixel_dq", f"of shape {shape[2:]}, dtype uint32", got)
        if group_dq is not None:
            group_dq = np.asarray(group_dq)
            if group_dq.shape != shape or group_dq.dtype != np.uint8:
                got = f"shape {group_dq.shape}, dtype {group_dq.dtype}"
                raise argument_error("group_dq", f"of shape {shape}, dtype uint8", got)
            group_dq = _read_only(group_dq)
        if effects is not None:
            effects = tuple(effects)
            for effect in effects:
                if not isinstance(effect, Effect):
                    raise argument_error("effects", "made of detector effects", repr(effect))
        super().__init__(_read_only(data), unit=DN, meta=dict(meta or {}))
        self._exposure = exposure
        self._pixel_dq = _read_only(pixel_dq)
        self._group_dq = group_dq
        self._effects = effects
        self._frozen = True

    def __setattr__(self, name, value):
        if getattr(self, "_frozen", False):
            msg = f"a ramp does not change: {name!r} cannot be set"
            raise AttributeError(msg)
        super().__setattr__(name, value)

    def __reduce__(self):
        # made anew, for arrays to be read-only again
        planes = {"pixel_dq": self.pixel_dq, "group_dq": self.group_dq}
        values = {**planes, "effects": self.effects, "meta": dict(self.meta)}
        return _remade, (self.data, self.exposure, values)

    @property
    def exposure(self):
        """The `~miricigale.instrument.Exposure`."""
        return self._exposure

    @property
    def pixel_dq(self):
        """Flags of pixels, uint32 (ny, nx)."""
        return self._pixel_dq

    @property
    def group_dq(self):
        """Flags of groups, uint8 like the data, or None."""
        return self._group_dq

    @property
    def effects(self):
        """What acted, a tuple of `Effect` in their order; None where it is not known."""
        return self._effects

    def shows(self, kind):
        """
        Whether an effect acted on this ramp.

        Parameters
        ----------
        kind : type
            A class of effects, such as `LastFrame`.

        Returns
        -------
        shows : bool or None
            None where it is not known what acted.
        """
        if self._effects is None:
            return None
        return any(isinstance(effect, kind) for effect in self._effects)

    @property
    def wcs(self):
        """The exposure's `~astropy.wcs.WCS` (of the two pixel axes)."""
        return self._exposure.wcs

    @wcs.setter
    def wcs(self, value):
        if value is not None:
            msg = "a ramp's WCS is that of its exposure"
            raise AttributeError(msg)

    @property
    def shape(self):
        """(n_int, n_group, ny, nx)."""
        return self.data.shape

    def __repr__(self):
        n_int, n_group, ny, nx = self.shape
        return (
            f"<Ramp {self.exposure.filter}: {n_int} integration(s) x {n_group} groups, "
            f"{ny} x {nx} pixels, {self.data.dtype}>"
        )

    __str__ = __repr__

    def write(self, path, *, start=None, filename=None, overwrite=False):
        """
        Write a JWST level-1b file (``*_uncal.fits``).

        Parameters
        ----------
        path : path-like
            The file; it appears under its name only when it is complete.
        start : `~astropy.time.Time`, optional
            When the exposure began; 2022-06-21 plus an hour for each dither if not given.
        filename : str, optional
            For the keyword FILENAME, if the file is renamed later; that of ``path`` if not given.
        overwrite : bool, optional
            Whether an existing file is replaced.

        Returns
        -------
        path : `pathlib.Path`

        Raises
        ------
        OSError
            If the file exists and ``overwrite`` is False.
        ValueError
            If the data are not counts (uint16).

        Notes
        -----
        Level 1b holds no flags. Those of pixels, and the effects with the meta dictionary, stand
        in two extensions of our own (``SIM_PIXELDQ``, ``SIM_META``) that the official pipeline
        passes over; those of groups are not written.
        """
        return level1b.write(path, self, start=start, filename=filename, overwrite=overwrite)

    @classmethod
    def read(cls, path):
        """
        Read a level-1b file, our own or one of JWST.

        Parameters
        ----------
        path : path-like
            An ``*_uncal.fits`` of the MIRI imager.

        Returns
        -------
        ramp : `Ramp`
            In a file that is not ours reference columns are the only flags.

        Raises
        ------
        `~miricigale.utils.exceptions.DataError`
            If the file is missing, truncated or not of that kind.
        """
        return cls(**level1b.read(path))
