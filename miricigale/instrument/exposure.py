"""What is exposed, where and for how long."""

import dataclasses
import functools
import math

import astropy.units as u
from astropy.coordinates import SkyCoord

from miricigale.instrument.detector import miri_detector
from miricigale.instrument.dithers import dither_offsets
from miricigale.instrument.figures import filter_row, table
from miricigale.instrument.photometric import electron_rate
from miricigale.instrument.siaf import aperture, attitude_matrix, pixel_to_v2v3, v2v3_to_sky
from miricigale.instrument.wcs import imager_wcs, scalar_position, tangent_offset
from miricigale.utils.exceptions import argument_error, unknown_name
from miricigale.utils.units import to_array

#: Bands of the CEERS/MIRI imaging.
CEERS_FILTERS = (
    "miri.f770w",
    "miri.f1000w",
    "miri.f1280w",
    "miri.f1500w",
    "miri.f1800w",
    "miri.f2100w",
)

#: Groups, integrations and dithers of each band: 1665 s, and 4662 s at F2100W. Integrations are
#: short enough for the low sky to fill less than 60 % of the well.
_CEERS = dict.fromkeys(CEERS_FILTERS, (200, 1, 3))
_CEERS["miri.f1500w"] = (100, 2, 3)
_CEERS["miri.f1800w"] = (50, 4, 3)
_CEERS["miri.f2100w"] = (10, 28, 6)

#: The same for a trial: about a third of the frames, two dithers.
_QUICK = dict.fromkeys(CEERS_FILTERS, (66, 1, 2))
_QUICK["miri.f1800w"] = (33, 2, 2)
_QUICK["miri.f2100w"] = (10, 7, 2)


def readout_patterns():
    """Names of the readout patterns."""
    return tuple(table()["readout"])


def frame_time(readout="FASTR1", subarray="FULL"):
    """
    Time between two reads of a pixel.

    Parameters
    ----------
    readout : str, optional
        One of `readout_patterns`.
    subarray : str, optional
        One of `~miricigale.instrument.subarrays`; only FASTR1 reads sub-arrays.

    Returns
    -------
    time : `~astropy.units.Quantity`
        In s. Both patterns have one frame in a group.
    """
    times = table()["readout"]
    if readout not in times:
        raise unknown_name("readout pattern", readout, times)
    if subarray not in times[readout]:
        kind = f"sub-array of {readout}"
        raise unknown_name(kind, subarray, times[readout])
    return times[readout][subarray] * u.s


@dataclasses.dataclass(frozen=True, eq=False)
class Exposure:
    """
    One exposure of the imager.

    Parameters
    ----------
    filter : str or None
        Such as ``"miri.f770w"``; None where it is not known, as in ground tests.
    readout : str, optional
        Readout pattern, ``"FASTR1"`` or ``"SLOWR1"``.
    n_groups : int
        Groups in an integration, at least 2.
    n_integrations : int, optional
        Integrations.
    subarray : str, optional
        One of `~miricigale.instrument.subarrays`.
    pointing : `~astropy.coordinates.SkyCoord` or None
        Where the reference pixel of the sub-array looks; None, as ``roll``, where nothing is
        pointed at: such an exposure has no world coordinates.
    roll : `~astropy.units.Quantity` or None
        Position angle of +V3 at the reference pixel, east of north.
    dither : int, optional
        Number of the dither, from 0: a label, and part of the random key.

    Raises
    ------
    KeyError
        If filter, readout or sub-array are not known.
    ValueError
        If a count is too small or the pointing is not one position.
    """

    filter: str | None
    _: dataclasses.KW_ONLY
    readout: str = "FASTR1"
    n_groups: int
    n_integrations: int = 1
    subarray: str = "FULL"
    pointing: SkyCoord | None
    roll: u.Quantity | None
    dither: int = 0

    def __post_init__(self):
        if self.filter is not None:
            filter_row(self.filter)
            short = str(self.filter).removeprefix("miri.")
            object.__setattr__(self, "filter", f"miri.{short}")
        aperture(self.subarray)
        frame_time(self.readout, self.subarray)
        for name, least in (("n_groups", 2), ("n_integrations", 1), ("dither", 0)):
            value = getattr(self, name)
            if isinstance(value, bool) or int(value) != value or value < least:
                raise argument_error(name, f"an integer of at least {least}", value)
            object.__setattr__(self, name, int(value))
        if (self.pointing is None) != (self.roll is None):
            raise argument_error("pointing, roll", "both given or both None", "one of them")
        if self.pointing is None:
            return
        scalar_position(self.pointing, "pointing")
        object.__setattr__(
            self, "pointing", SkyCoord(self.pointing.icrs.ra, self.pointing.icrs.dec)
        )
        roll = float(to_array(self.roll, u.deg, "roll", ndim=0, finite=True))
        object.__setattr__(self, "roll", roll % 360 * u.deg)

    @classmethod
    def from_time(cls, filter, time, *, max_fill=0.6, **options):
        """
        Make the exposure of a filter that lasts a given time.

        Parameters
        ----------
        filter : str
            Such as ``"miri.f770w"``.
        time : `~astropy.units.Quantity`
            Wanted exposure time; the nearest number of groups is taken.
        max_fill : float, optional
            The exposure is split into as many equal integrations as keep the sky of the
            low background below this fraction of the full well.
        **options
            Other arguments of `Exposure` than the counts.

        Returns
        -------
        exposure : `Exposure`
        """
        seconds = float(to_array(time, u.s, "time", ndim=0, finite=True))
        frame = frame_time(options.get("readout", "FASTR1"), options.get("subarray", "FULL"))
        frames = round(seconds / frame.value)
        if frames < 2:
            raise argument_error("time", f"at least two frames of {frame}", time)
        fills = miri_detector().full_well / electron_rate(filter)
        most = max(2, math.floor(max_fill * fills / frame.value))
        n_integrations = math.ceil(frames / most)
        n_groups = max(2, round(frames / n_integrations))
        return cls(filter, n_groups=n_groups, n_integrations=n_integrations, **options)

    replace = dataclasses.replace

    @property
    def aperture(self):
        """The sub-array, an `~miricigale.instrument.Aperture`."""
        return aperture(self.subarray)

    @property
    def shape(self):
        """Rows and columns, ``(ny, nx)``."""
        return self.aperture.shape

    @property
    def frame_time(self):
        """Time of one frame, s."""
        return frame_time(self.readout, self.subarray)

    @property
    def group_time(self):
        """Time between groups, s: one frame."""
        return self.frame_time

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

    def check_sky(self):
        """
        Refuse an exposure without a filter or a pointing.

        Raises
        ------
        ValueError
            If ``filter`` or ``pointing`` is None.
        """
        for name in ("filter", "pointing"):
            if getattr(self, name) is None:
                raise argument_error("exposure", f"one with a {name}", "None")

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
        Keywords of level-1b headers that say where the telescope looks.

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
        ra, dec = self.pointing.ra.deg, self.pointing.dec.deg
        v2, v3 = (float(v) for v in pixel_to_v2v3(*part.reference, subarray=self.subarray))
        matrix = attitude_matrix(ra, dec, self.roll.value, v2=v2, v3=v3)
        ra_v1, dec_v1 = v2v3_to_sky(0.0, 0.0, matrix)
        boresight = SkyCoord(float(ra_v1), float(dec_v1), unit="deg")
        # a point on the +V3 axis
        north = SkyCoord(*(float(t) for t in v2v3_to_sky(0.0, 3600.0, matrix)), unit="deg")
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

    def dithered(self, pattern, n=None, *, first=0, start=0):
        """
        This exposure at ``n`` positions of a dither pattern.

        Parameters
        ----------
        pattern : str, path-like, `~astropy.units.Quantity` or `~astropy.table.Table`
            See `dither_offsets`.
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
        pa = self.pa_aper
        return [
            self.replace(pointing=tangent_offset(self.pointing, dx, dy, pa), dither=first + number)
            for number, (dx, dy) in enumerate(dither_offsets(pattern, n, start=start))
        ]


def ceers_exposures(pointing, roll, *, filters=None, quick=False):
    """
    The exposures of one CEERS/MIRI pointing.

    Parameters
    ----------
    pointing : `~astropy.coordinates.SkyCoord`
        Center of the field: where the reference pixel looks before dithering.
    roll : `~astropy.units.Quantity`
        Position angle of +V3 there.
    filters : iterable of str, optional
        Which of the six bands; all if not given.
    quick : bool, optional
        Whether about a third of the frames and two dithers are enough.

    Returns
    -------
    exposures : list of `Exposure`
        Band by band; FASTR1, full frame, three dithers (six at F2100W) of 200 frames
        (280): 1665 s (4662 s) in all. The split into groups and integrations is ours.

    References
    ----------
    Yang et al. 2021, ApJ, 908, 144, section 2.
    """
    filters = CEERS_FILTERS if filters is None else tuple(filters)
    exposures = []
    for name in filters:
        if name not in _CEERS:
            raise unknown_name("band of the survey", name, CEERS_FILTERS)
        n_groups, n_integrations, n_dithers = (_QUICK if quick else _CEERS)[name]
        base = Exposure(
            name, n_groups=n_groups, n_integrations=n_integrations, pointing=pointing, roll=roll
        )
        exposures += base.dithered("ceers", n_dithers)
    return exposures
