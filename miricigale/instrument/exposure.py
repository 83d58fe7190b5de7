"""What is exposed, where and for how long."""

import dataclasses
import functools
import math
from operator import attrgetter

import astropy.units as u
from astropy.coordinates import SkyCoord

from miricigale.instrument.detector import miri_detector
from miricigale.instrument.dithers import dither_offsets
from miricigale.instrument.photometric import electron_rate
from miricigale.instrument.published_tables import imager_filter, table
from miricigale.instrument.siaf import aperture, attitude_matrix, pixel_to_v2v3, v2v3_to_sky
from miricigale.instrument.wcs import imager_wcs, tangent_offset
from miricigale.utils.arrays import is_inside
from miricigale.utils.exceptions import argument_error
from miricigale.utils.interactive import Interactive
from miricigale.utils.named_values import field_values
from miricigale.utils.options import check_names, check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.positions import as_position
from miricigale.utils.units import check_count, scalar
from miricigale.utils.values import value_class


def readout_patterns():
    """
    Return the names of the readout patterns.

    Examples
    --------
    >>> from miricigale.instrument import readout_patterns
    >>> readout_patterns()
    ('FASTR1', 'SLOWR1', 'FASTGRPAVG', 'FASTGRPAVG8', 'FASTGRPAVG16', 'FASTGRPAVG32', 'FASTGRPAVG64')
    """
    return (*table()["readout"], *table()["averaged"])


def frames_per_group(readout="FASTR1"):
    """
    Return the frames that are averaged on board to one group.

    Parameters
    ----------
    readout : str, optional
        One of `readout_patterns`.

    Returns
    -------
    n_frames : int
        1 for FASTR1 and SLOWR1.

    Examples
    --------
    >>> from miricigale.instrument import frames_per_group
    >>> frames_per_group("FASTGRPAVG8")
    8
    """
    check_names([readout], "readout pattern", readout_patterns())
    return table()["averaged"].get(readout, 1)


def frame_pattern(readout):
    """Return the pattern in which the frames of a readout pattern are read: itself, or that which is averaged."""
    return "FASTR1" if readout in table()["averaged"] else readout


def frame_time(readout="FASTR1", subarray="FULL"):
    """
    Return the time between two reads of a pixel.

    Parameters
    ----------
    readout : str, optional
        One of `readout_patterns`.
    subarray : str, optional
        One of `~miricigale.instrument.subarrays`; SLOWR1 reads none.

    Returns
    -------
    time : `~astropy.units.Quantity`
        In s. A group has as many frames as `frames_per_group` says.

    Examples
    --------
    >>> from miricigale.instrument import frame_time
    >>> frame_time().round(3), frame_time("FASTR1", "SUB64").round(3)
    (<Quantity 2.775 s>, <Quantity 0.085 s>)
    """
    check_names([readout], "readout pattern", readout_patterns())
    times = table()["readout"][frame_pattern(readout)]
    check_names([subarray], f"sub-array of {readout}", times)
    return times[subarray] * u.s


def _counts_of(filter, time, group, n_integrations, max_fill=0.6, max_groups=100):
    """Groups and integrations whose time is nearest to the wanted one; the integrations may be given."""
    seconds = scalar(time, u.s, "time")
    groups = round(seconds / group.value)
    check_that(groups >= 2, "time", f"at least two groups of {group}", time)
    choices = [n_integrations]
    if n_integrations is None:
        fills = miri_detector().full_well / electron_rate(filter) / group.value
        longest = min(
            max(2, math.floor(max_fill * fills)), check_count(max_groups, "max_groups", 2)
        )
        n_least = math.ceil(groups / longest)
        # one more, or up to a tenth, if they come nearer
        choices = range(n_least, n_least + max(2, n_least // 10 + 1))
    counts = [(max(2, round(groups / n)), n) for n in choices]
    return min(counts, key=lambda pair: abs(math.prod(pair) - groups))


@value_class(init=False)
class Exposure(Interactive):
    """
    One exposure of the imager.

    Parameters
    ----------
    filter : str, `~miricigale.filters.Filter` or None
        Such as ``"F770W"`` or ``"miri.f770w"``; None where it is not known, as in ground tests.
    time : `~astropy.units.Quantity`, optional
        Wanted exposure time in place of ``n_groups``; `from_time` splits it, and ``exposure_time`` is what
        comes of it.
    readout : str, optional
        Readout pattern, one of `readout_patterns`: ``"FASTR1"``, ``"SLOWR1"``, or ``"FASTGRPAVG8"`` and
        its kind, whose groups are means of frames of FASTR1.
    n_groups : int, optional
        Groups in an integration, at least 2.
    n_integrations : int, optional
        Integrations; 1 by default, with ``time`` as of `from_time`.
    subarray : str, optional
        One of `~miricigale.instrument.subarrays`.
    pointing : `~astropy.coordinates.SkyCoord`, str, pair or None, optional
        Where the reference pixel of the sub-array looks; text such as ``"150.1 +2.2"`` or a pair is right
        ascension and declination. None, as ``roll``, where nothing is pointed at: such an exposure has no world
        coordinates.
    roll : `~astropy.units.Quantity`, optional
        Position angle of +V3 at the reference pixel, east of north; 0 deg if only the pointing is given.
    dither : int, optional
        Number of the dither, from 0: a label, and part of the random key.

    Raises
    ------
    KeyError
        If filter, readout or sub-array are not known.
    ValueError
        If a count is too small, neither or both of ``n_groups`` and ``time`` are given, or the pointing is not
        one position.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale import Exposure
    >>> Exposure("F770W", time=1 * u.hour, pointing="150.1 +2.2")
    <Exposure miri.f770w: FASTR1, 13 x 100 groups, 3607.5 s, FULL at 150.1 +2.2, roll 0 deg>
    """

    filter: str | None
    _: dataclasses.KW_ONLY
    readout: str
    n_groups: int
    n_integrations: int
    subarray: str
    pointing: SkyCoord | None
    roll: u.Quantity | None
    dither: int

    @takes_other_keywords
    def __init__(
        self,
        filter,
        time=None,
        *,
        readout="FASTR1",
        n_groups=None,
        n_integrations=None,
        subarray="FULL",
        pointing=None,
        roll=None,
        dither=0,
    ):
        if filter is not None:
            filter = imager_filter(filter)
        readout = str(readout).upper()
        subarray = str(subarray).upper()
        aperture(subarray)
        group = frames_per_group(readout) * frame_time(readout, subarray)
        if (n_groups is None) == (time is None):
            got = "both"
            if time is None:
                got = "neither"
            raise argument_error("n_groups, time", "one of them given", got)
        counts = {"dither": check_count(dither, "dither", 0)}
        if n_integrations is not None:
            n_integrations = check_count(n_integrations, "n_integrations")
        if time is not None:
            n_groups, n_integrations = _counts_of(filter, time, group, n_integrations)
        counts["n_groups"] = check_count(n_groups, "n_groups", 2)
        counts["n_integrations"] = n_integrations or 1
        if pointing is not None:
            pointing = as_position(pointing, "pointing")
            if roll is None:
                roll = 0.0 * u.deg
            roll = scalar(roll, u.deg, "roll") % 360 * u.deg
        elif roll is not None:
            raise argument_error("pointing", "given where 'roll' is", "None")
        values = {"filter": filter, "readout": readout, "subarray": subarray, **counts}
        for name, value in {**values, "pointing": pointing, "roll": roll}.items():
            object.__setattr__(self, name, value)

    def __repr__(self):
        text = (
            f"<Exposure {self.filter}: {self.readout}, {self.n_integrations} x {self.n_groups} groups, "
            f"{self.exposure_time.value:.1f} s, {self.subarray}"
        )
        if self.pointing is not None:
            ra = self.pointing.ra.deg
            dec = self.pointing.dec.deg
            text += f" at {ra:.8g} {dec:+.8g}, roll {self.roll.value:g} deg"
        return f"{text}>"

    def _facts(self):
        values = {name.replace("_", " "): value for name, value in field_values(self).items()}
        return values | {"exposure time": self.exposure_time}

    @classmethod
    def from_time(cls, filter, time, *, max_fill=0.6, max_groups=100, **options):
        """
        Make the exposure of a filter that lasts a given time.

        It has equal integrations, as few as the two limits allow, or one or a tenth more where their time is
        nearer to the wanted one. ``exposure_time`` says what it is.

        Parameters
        ----------
        filter : str
            Such as ``"miri.f770w"``.
        time : `~astropy.units.Quantity`
            Wanted exposure time, without the resets between integrations.
        max_fill : float, optional
            Largest fraction of the full well that the sky of the low background fills.
        max_groups : int, optional
            Largest number of groups in an integration. Deep MIRI imaging has 100 or so; beyond 180 in
            FASTR1 STScI advises another pattern [1]_.
        **options
            Other arguments of `Exposure` than the counts.

        Returns
        -------
        exposure : `Exposure`

        References
        ----------
        .. [1] JWST User Documentation, "MIRI Detector Readout FASTR1".
        """
        group = cls(filter, n_groups=2, **options).group_time
        n_groups, n_integrations = _counts_of(filter, time, group, None, max_fill, max_groups)
        return cls(filter, n_groups=n_groups, n_integrations=n_integrations, **options)

    def replace(self, **changes):
        """Copy with other values of the parameters; a ``time`` replaces the counts."""
        if "time" in changes:
            changes = {"n_groups": None, "n_integrations": None} | changes
        return dataclasses.replace(self, **changes)

    @property
    def aperture(self):
        """The sub-array, an `~miricigale.instrument.Aperture`."""
        return aperture(self.subarray)

    shape = property(attrgetter("aperture.shape"), doc="Rows and columns, ``(ny, nx)``.")

    @property
    def frame_time(self):
        """Time of one frame, s."""
        return frame_time(self.readout, self.subarray)

    @property
    def n_frames(self):
        """Frames that are averaged to one group."""
        return frames_per_group(self.readout)

    @property
    def group_time(self):
        """Time between groups, s: that of their frames."""
        return self.n_frames * self.frame_time

    def of_frames(self):
        """
        Return this exposure with each frame a group of its own.

        Returns
        -------
        exposure : `Exposure`
            Itself where groups are no averages.
        """
        if self.n_frames == 1:
            return self
        n_groups = self.n_groups * self.n_frames
        return self.replace(readout=frame_pattern(self.readout), n_groups=n_groups)

    @property
    def integration_time(self):
        """Time from reset to the last read, s."""
        return self.n_groups * self.group_time

    @property
    def exposure_time(self):
        """Time in which light was gathered, all integrations, s."""
        return self.n_integrations * self.integration_time

    @property
    def duration(self):
        """Time with the reset frame between integrations, s."""
        return self.exposure_time + (self.n_integrations - 1) * self.frame_time

    @property
    def footprint(self):
        """Corners of the sub-array on the sky, `~astropy.coordinates.SkyCoord` of shape (4,)."""
        self.check_sky()
        ny, nx = self.shape
        return self.wcs.pixel_to_world(
            [-0.5, nx - 0.5, nx - 0.5, -0.5], [-0.5, -0.5, ny - 0.5, ny - 0.5]
        )

    def contains(self, sky):
        """
        Say which positions fall on the sub-array.

        Parameters
        ----------
        sky : `~astropy.coordinates.SkyCoord`
            Positions.

        Returns
        -------
        inside : bool or bool `~numpy.ndarray`, of the shape of ``sky``
        """
        self.check_sky()
        x, y = self.wcs.world_to_pixel(sky)
        return is_inside(x, y, self.shape)

    def plot(self, ax=None, **kwargs):
        """
        Draw the sub-array on the sky, north up and east to the left.

        Parameters
        ----------
        ax : `~matplotlib.axes.Axes`, optional
            Where; the current axes by default. Dithers are drawn over each other.
        **kwargs
            Passed to `matplotlib.axes.Axes.fill`.

        Returns
        -------
        ax : `~matplotlib.axes.Axes`

        Raises
        ------
        ValueError
            If the exposure has no filter or no pointing.
        """
        from miricigale.plotting.axes import plain_text
        from miricigale.plotting.images import plot_footprint

        corners = self.footprint
        label = f"{plain_text(self.filter)}, dither {self.dither}"
        options = {"label": label} | kwargs
        return plot_footprint(corners.ra.deg, corners.dec.deg, ax=ax, **options)

    def check_sky(self):
        """
        Refuse an exposure without a filter or a pointing.

        Raises
        ------
        ValueError
            If ``filter`` or ``pointing`` is None.
        """
        for name in ("filter", "pointing"):
            check_that(getattr(self, name) is not None, "exposure", f"one with a {name}", "None")

    @property
    def pa_aper(self):
        """Position angle of the ideal +y axis, deg; detector columns follow it to 0.2 deg."""
        if self.roll is None:
            return None
        return (self.roll + self.aperture.v3_ideal_y_angle * u.deg) % (360 * u.deg)

    @functools.cached_property
    def wcs(self):
        """World coordinates, a TAN-SIP `~astropy.wcs.WCS` (see `imager_wcs`); None without pointing."""
        if self.pointing is None:
            return None
        return imager_wcs(self.pointing, self.roll, subarray=self.subarray)

    def pointing_keywords(self):
        """
        Return the keywords of level-1b headers that say where the telescope looks.

        Returns
        -------
        keywords : dict
            RA_REF, DEC_REF, ROLL_REF, V2_REF, V3_REF, VPARITY, V3I_YANG, PA_APER, RA_V1,
            DEC_V1, PA_V3 (at V1), SUBARRAY, SUBSTRT1/2, SUBSIZE1/2 (1-based).

        Raises
        ------
        ValueError
            If the exposure has no filter or no pointing.
        """
        self.check_sky()
        part = self.aperture
        ra = self.pointing.ra.deg
        dec = self.pointing.dec.deg
        v2, v3 = map(float, pixel_to_v2v3(*part.reference, subarray=self.subarray))
        matrix = attitude_matrix(ra, dec, self.roll.value, v2=v2, v3=v3)
        ra_v1, dec_v1 = v2v3_to_sky(0.0, 0.0, matrix)
        boresight = SkyCoord(float(ra_v1), float(dec_v1), unit="deg")
        # a point on the +V3 axis
        north = SkyCoord(*map(float, v2v3_to_sky(0.0, 3600.0, matrix)), unit="deg")
        return {
            "RA_REF": float(ra),
            "DEC_REF": float(dec),
            "ROLL_REF": float(self.roll.value),
            "V2_REF": v2,
            "V3_REF": v3,
            "VPARITY": part.parity,
            "V3I_YANG": part.v3_ideal_y_angle,
            "PA_APER": float(self.pa_aper.value),
            "RA_V1": float(ra_v1),
            "DEC_V1": float(dec_v1),
            "PA_V3": float(boresight.position_angle(north).deg),
            "SUBARRAY": part.name,
            "SUBSTRT1": part.origin[0] + 1,
            "SUBSTRT2": part.origin[1] + 1,
            "SUBSIZE1": part.shape[1],
            "SUBSIZE2": part.shape[0],
        }

    def dithered(self, pattern="4-point", n=None, *, first=0, start=0):
        """
        Return this exposure at ``n`` positions of a dither pattern.

        Parameters
        ----------
        pattern : str, path-like, `~astropy.units.Quantity`, `~astropy.table.Table` or int, optional
            See `dither_offsets`; a number is ``n`` of the default's.
        n : int, optional
            Number of positions; all of the pattern's by default.
        first : int, optional
            Number of the first dither, a label.
        start : int, optional
            Which point of the pattern is the first.

        Returns
        -------
        exposures : list of `Exposure`
        """
        self.check_sky()
        if isinstance(pattern, int):
            pattern, n = "4-point", pattern
        pa = self.pa_aper
        out = []
        for number, (dx, dy) in enumerate(dither_offsets(pattern, n, start=start)):
            out.append(
                self.replace(
                    pointing=tangent_offset(self.pointing, dx, dy, pa), dither=first + number
                )
            )
        return out
