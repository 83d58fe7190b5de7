"""The ramp: counts of one exposure, group by group, and its file."""

import functools
import numbers
import operator
from operator import attrgetter

import astropy.units as u
import numpy as np
from astropy.nddata import NDData

from miricigale.detector import level1b, ramp_reader
from miricigale.detector.effects.order import checked_effects
from miricigale.instrument import DQ, STEPS, DetectorProperties, ExposureHistory
from miricigale.utils.arrays import peak_index
from miricigale.utils.exceptions import argument_error
from miricigale.utils.interactive import Interactive
from miricigale.utils.missing_values import mask_of
from miricigale.utils.named_values import attributes
from miricigale.utils.options import check_kind, check_that
from miricigale.utils.units import DN


def _read_only(array):
    view = array.view()
    view.flags.writeable = False
    return view


def _flags(values, name, shape, dtype):
    """Read-only flags of a shape and type; others are refused."""
    values = np.asarray(values)
    if values.shape != shape or values.dtype != dtype:
        got = f"shape {values.shape}, dtype {values.dtype}"
        raise argument_error(name, f"of shape {shape}, dtype {np.dtype(dtype)}", got)
    return _read_only(values)


class Ramp(Interactive, NDData):
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
    properties : `~miricigale.instrument.DetectorProperties`, optional
        Of the simulated detector that made the counts; None where they are not known.
    steps : iterable of str, optional
        What the pipeline has done to the counts (`~miricigale.instrument.STEPS`), kept as a frozenset; nothing
        if not given.
    header : `~astropy.io.fits.Header`, optional
        Keywords of the observation, by which reference files are chosen; those that `write`
        would write if not given.
    meta : dict, optional
        Where it came from.

    Raises
    ------
    ValueError
        If a shape is not that of the exposure, a dtype is another or a step is not known.

    Examples
    --------
    >>> import numpy as np
    >>> import astropy.units as u
    >>> from miricigale import Detector, Exposure
    >>> exposure = Exposure("F770W", n_groups=10, subarray="SUB64", pointing="53 -27")
    >>> sky = np.full(exposure.shape, 5.0) * u.MJy / u.sr
    >>> ramp = Detector.miri_imager().expose(sky, exposure, seed=1)
    >>> ramp
    <Ramp miri.f770w: 1 integration(s) x 10 groups, 64 x 72 pixels, uint16>
    >>> path = ramp.write("sub64_uncal.fits")  # doctest: +SKIP
    >>> ramp.integration(0).shape
    (1, 10, 64, 72)
    """

    _parts = ("exposure",)

    def __init__(
        self,
        data,
        exposure,
        *,
        pixel_dq=None,
        group_dq=None,
        effects=None,
        properties=None,
        steps=(),
        header=None,
        meta=None,
    ):
        if hasattr(data, "mask"):
            bad = int(np.count_nonzero(mask_of(data)))
            wanted = "without a mask ('group_dq' says what is wrong with groups)"
            check_that(not bad, "data", wanted, f"{bad} masked values")
        data = np.asarray(getattr(data, "unmasked", data))
        shape = (exposure.n_integrations, exposure.n_groups) + exposure.shape
        check_that(data.shape == shape, "data", f"of the exposure's shape {shape}", data.shape)
        check_that(
            data.dtype in (np.uint16, np.float32), "data", "of dtype uint16 or float32", data.dtype
        )
        if pixel_dq is None:
            pixel_dq = np.zeros(shape[2:], np.uint32)
        pixel_dq = _flags(pixel_dq, "pixel_dq", shape[2:], np.uint32)
        if group_dq is not None:
            group_dq = _flags(group_dq, "group_dq", shape, np.uint8)
        if effects is not None:
            effects = checked_effects(effects)
        check_kind(properties, "properties", DetectorProperties)
        steps = frozenset(steps)
        if unknown := steps - set(STEPS.values()):
            raise argument_error("steps", f"of {sorted(STEPS.values())}", sorted(unknown))
        # the WCS is that of the two pixel axes
        super().__init__(_read_only(data), unit=DN, wcs=exposure.wcs, meta=dict(meta or {}))
        self.exposure = exposure
        self.pixel_dq = pixel_dq
        self.group_dq = group_dq
        self.effects = effects
        self.properties = properties
        self.steps = steps
        if header is None:
            self._header = None
        else:
            self._header = header.copy()
        self._frozen = True

    def __setattr__(self, name, value):
        if getattr(self, "_frozen", False):
            msg = f"a ramp does not change: {name!r} cannot be set"
            raise AttributeError(msg)
        super().__setattr__(name, value)

    def _values(self):
        """Return the arguments by which the ramp can be made again, but for data and exposure."""
        names = ("pixel_dq", "group_dq", "effects", "properties", "steps")
        values = attributes(self, names)
        return values | {"header": self._header, "meta": dict(self.meta)}

    def __reduce__(self):
        # made anew, for arrays to be read-only again
        return functools.partial(Ramp, self.data, self.exposure, **self._values()), ()

    @property
    def simulated(self):
        """Whether the package's `Detector` made the counts: it is known what acted."""
        return self.effects is not None

    @property
    def history(self):
        """Who made the counts and what was done to them, `~miricigale.instrument.ExposureHistory`."""
        header = {}
        if self.observed:
            header = self.header
        history = ExposureHistory.from_header(header, recorded=self.simulated)
        return history.replace(steps=self.steps)

    @property
    def observed(self):
        """Whether the ramp has keywords of an observation, from its file."""
        return self._header is not None

    @property
    def header(self):
        """A copy of the keywords of the observation, `~astropy.io.fits.Header`."""
        if self._header is not None:
            return self._header.copy()
        return level1b.keywords(self.exposure)

    @property
    def group_time(self):
        """Time between groups in s: that of the header, or of the exposure."""
        computed = self.exposure.group_time.to_value("s")
        in_header = None if self._header is None else self._header.get("TGROUP")
        if in_header is None or (self.exposure.n_frames > 1 and in_header < 0.75 * computed):
            # files of 2023 and before state the time of a frame for groups that are averaged on board
            return computed
        return float(in_header)

    def integration(self, number):
        """
        Return one integration as a ramp of its own.

        Parameters
        ----------
        number : int
            From 0.

        Returns
        -------
        ramp : `Ramp`

        Raises
        ------
        ValueError
            If there is no such integration.
        """
        check_that(0 <= number < self.shape[0], "number", f"from 0 to {self.shape[0] - 1}", number)
        part = slice(number, number + 1)
        values = self._values()
        if self.group_dq is not None:
            values["group_dq"] = self.group_dq[part]
        return Ramp(self.data[part], self.exposure.replace(n_integrations=1), **values)

    def __getitem__(self, number):
        """
        Return an integration by its number, or counts by several indices.

        ``ramp[0]`` is the first integration as a `Ramp`; ``ramp[0, -1]`` are the counts (DN) of its last group,
        as floats: differences of groups can be negative, which the integers of ``ramp.data`` cannot.
        """
        if isinstance(number, tuple):
            return self.data[number].astype(float) * u.DN
        wanted = "that of an integration; ramp[0, -1] is a group, ramp[0, :, y, x] a pixel"
        check_that(isinstance(number, numbers.Integral), "number", wanted, repr(number))
        if not -len(self.data) <= number < len(self.data):
            msg = f"integration {number} of {len(self.data)}"
            raise IndexError(msg)
        return self.integration(number % len(self.data))

    @property
    def times(self):
        """Times of the groups since the reset, s, shape (n_groups,)."""
        return np.arange(1, self.shape[1] + 1) * self.group_time * u.s

    def plot(self, pixel=None, ax=None, *, x=None, y=None, **kwargs):
        """
        Draw the counts of a pixel over time.

        Parameters
        ----------
        pixel : tuple of int, optional
            Column and row, (x, y) from 0; the usable pixel that steadily gathers most counts by default.
        ax : `~matplotlib.axes.Axes`, optional
            Where; the current axes by default.
        x, y : int, optional
            The pixel, in place of ``pixel``.
        **kwargs
            Passed to `matplotlib.axes.Axes.plot`.

        Returns
        -------
        ax : `~matplotlib.axes.Axes`
            A line for each integration; flagged groups (saturated, jumps), where flags are known, are crossed.

        Raises
        ------
        ValueError
            If there is no such pixel.
        """
        from miricigale.plotting.measurements import plot_ramp

        ny, nx = self.shape[2:]
        if x is not None or y is not None:
            check_that(pixel is None, "pixel", "left out beside x and y", pixel)
            pixel = (x, y)
            check_that(None not in pixel, "x, y", "given both", pixel)
        if pixel is None:
            # in every quarter of the integration, so that no hit of a cosmic ray is taken for a source
            groups = np.linspace(0, self.shape[1] - 1, min(5, self.shape[1])).astype(int)
            gathered = np.diff(self.data[0, groups].astype(float), axis=0).min(axis=0)
            gathered[(self.pixel_dq & int(DQ.DO_NOT_USE)) != 0] = -np.inf
            pixel = peak_index(gathered)[::-1]
        check_that(np.shape(pixel) == (2,), "pixel", "column and row, (x, y)", pixel)
        x, y = map(operator.index, pixel)
        check_that(0 <= x < nx and 0 <= y < ny, "pixel", f"(x, y) below ({nx}, {ny})", pixel)
        flags = None
        if self.group_dq is not None:
            flags = self.group_dq[:, :, y, x] != 0
        title = f"pixel ({x}, {y})"
        return plot_ramp(
            self.times.value, self.data[:, :, y, x], flags, ax=ax, title=title, **kwargs
        )

    def _facts(self):
        return self.exposure._facts() | {"data": f"{self.shape} {self.data.dtype}"}

    def shows(self, kind):
        """
        Tell whether an effect acted on this ramp.

        Parameters
        ----------
        kind : type
            A class of effects, such as `LastFrame`.

        Returns
        -------
        shows : bool or None
            None where it is not known what acted.
        """
        if self.effects is None:
            return None
        return any(isinstance(effect, kind) for effect in self.effects)

    shape = property(attrgetter("data.shape"), doc="(n_int, n_group, ny, nx).")

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
            If the data are not counts (uint16), or the name is one of another product of JWST, such as
            ``x_cal.fits``.

        Notes
        -----
        A ramp that was read and not simulated keeps the keywords of its file. ``INT_TIMES`` has
        the times of the integrations (UTC; barycentric ones are not known).

        Level 1b holds no flags. Those of pixels, and the effects with the meta dictionary, stand
        in two extensions of our own (``SIM_PIXELDQ``, ``SIM_META``) that the official pipeline
        passes over; those of groups are not written.
        """
        return level1b.write(path, self, start=start, filename=filename, overwrite=overwrite)

    @classmethod
    def read(cls, path):
        """
        Read the ramp of an exposure, our own or one of JWST, as the pipeline has it at any stage.

        Parameters
        ----------
        path : path-like
            An ``*_uncal.fits`` of the MIRI imager, an ``*_ramp.fits``, or what one of the steps
            between them saved; of ground tests too, whose headers state no filter or pointing.

        Returns
        -------
        ramp : `Ramp`
            ``steps`` has what the header says was done. In level 1b that is not ours reference
            columns are the only flags.

        Raises
        ------
        `~miricigale.utils.exceptions.DataError`
            If the file is missing, truncated or not of that kind, or its header contradicts its
            data (NGROUPS, NINTS, INTSTART, INTEND, SUBSIZE1, SUBSIZE2) or the read-out pattern
            (TGROUP, TFRAME, NFRAMES, GROUPGAP).
        MemoryError
            If the ramp is larger than the memory.
        """
        return cls(**ramp_reader.read(path))
