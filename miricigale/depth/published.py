"""Published limits, how the exposure time calculator gets its own, and the residual they imply."""

import astropy.units as u
import numpy as np

from miricigale.instrument import frame_time, imager_filters
from miricigale.instrument.published_tables import filter_row, imager_filter, table
from miricigale.utils.exceptions import unknown_name
from miricigale.utils.options import check_names, check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.units import to_array
from miricigale.utils.values import value_class


def _short(filter):
    """Name of a filter in the table; `KeyError` with the known ones for any other."""
    return imager_filter(filter).removeprefix("miri.")


@value_class
class EtcSetup:
    """
    Exposures and extraction behind a published limit (see `etc_setup`).

    Parameters
    ----------
    filter : str
        Such as ``"miri.f770w"``.
    radius : `~astropy.units.Quantity`
        Of the circular aperture, arcsec.
    annulus : `~astropy.units.Quantity`
        Inner and outer radius of the sky annulus, arcsec: as large as the aperture.
    subtract_annulus : bool
        Whether the annulus is measured. The published limits take the sky as known.
    readout : str
        Readout pattern; full frame.
    n_groups, n_integrations, n_exposures : int
        Groups of an integration, integrations of an exposure, exposures at one position.

    Examples
    --------
    >>> from miricigale.depth import etc_setup
    >>> setup = etc_setup("F770W")
    >>> print(f"{setup.radius:.3f}, {setup.n_groups} groups, {setup.readout}")
    0.323 arcsec, 106 groups, FASTR1
    """

    filter: str
    radius: u.Quantity
    annulus: u.Quantity
    subtract_annulus: bool
    readout: str
    n_groups: int
    n_integrations: int
    n_exposures: int

    @property
    def time(self):
        """Time in which light is gathered, all exposures, s."""
        n_frames = self.n_groups * self.n_integrations * self.n_exposures
        return n_frames * frame_time(self.readout)


@takes_other_keywords
def etc_setup(filter):
    """
    Return the exposures and extraction behind the published limits: 10 sigma in 10 ks.

    Parameters
    ----------
    filter : str
        One of `~miricigale.instrument.imager_filters`.

    Returns
    -------
    setup : `EtcSetup`

    References
    ----------
    The script with which the observatory makes the table,
    ``tests/miri/miri_sensitivity_imaging.py`` of spacetelescope/pandeia-verification; the
    limits of `etc_limit` are those of JWST user documentation, MIRI Sensitivity.

    Examples
    --------
    >>> from miricigale.depth import etc_setup
    >>> setup = etc_setup("miri.f1000w")
    >>> print(f"{setup.radius:.2f}, {setup.n_groups} groups, {setup.time:.0f}")
    0.42 arcsec, 106 groups, 10001 s
    """
    name = _short(filter)
    common = dict(table("etc")["setup"])
    setup = dict(table("etc")["filters"][name])
    radius = common.pop("radius_per_um") * setup.pop("wavelength") * u.arcsec
    return EtcSetup(f"miri.{name}", radius, radius * common.pop("annulus"), **common, **setup)


@takes_other_keywords
def etc_limit(filter, version="4.0"):
    """
    Point-source limit of the exposure time calculator: 10 sigma in 10 ks.

    Parameters
    ----------
    filter : str
        One of `~miricigale.instrument.imager_filters`.
    version : str, optional
        ``"4.0"`` or ``"2.0"``.

    Returns
    -------
    limit : `~astropy.units.Quantity`
        In uJy.

    Examples
    --------
    >>> from miricigale.depth import etc_limit
    >>> print(etc_limit("F770W"), etc_limit("F770W", "2.0"))
    0.246 uJy 0.241 uJy
    """
    versions = {"4.0": "etc_40", "2.0": "etc_20"}
    check_names([str(version)], "version of the exposure time calculator", versions)
    return filter_row(filter)[versions[str(version)]] * u.uJy


@takes_other_keywords
def scaled_limit(filter, time, *, n_sigma=5.0, version="4.0"):
    """
    Return the calculator's limit scaled to another exposure, as the root of the time.

    Parameters
    ----------
    filter : str
        One of `~miricigale.instrument.imager_filters`.
    time : `~astropy.units.Quantity`
        Total exposure time.
    n_sigma : float, optional
        Significance.
    version : str, optional
        As in `etc_limit`.

    Returns
    -------
    limit : `~astropy.units.Quantity`
        In uJy.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.depth import scaled_limit
    >>> limit = scaled_limit("F770W", 1665 * u.s)
    >>> print(f"{limit:.3f}, {limit.to(u.ABmag):.2f}")
    0.301 uJy, 25.20 mag(AB)
    """
    seconds = to_array(time, u.s, "time")
    check_that(np.all(seconds > 0), "time", "positive", time)
    return etc_limit(filter, version) * (n_sigma / 10) * np.sqrt(1e4 / seconds)


@takes_other_keywords
def proposal_limit(filter):
    """
    Return the 5-sigma limit that the CEERS proposal quotes for its exposures.

    Parameters
    ----------
    filter : str
        One of the six bands of the survey.

    Returns
    -------
    limit : `~astropy.units.Magnitude`
        AB.

    Raises
    ------
    KeyError
        If the survey has no such band.

    Examples
    --------
    >>> from miricigale.depth import proposal_limit
    >>> proposal_limit("F1500W")
    <Magnitude 23.8 mag(AB)>
    """
    row = filter_row(filter)
    if "proposal" not in row:
        filters = [name for name in imager_filters() if "proposal" in filter_row(name)]
        raise unknown_name("band of the survey", filter, filters)
    return row["proposal"] * u.ABmag


def residual_presets():
    """
    Return the names of the sets of residuals that `residual_amplitude` knows.

    Examples
    --------
    >>> from miricigale.depth import residual_presets
    >>> residual_presets()
    ('etc',)
    """
    return tuple(table("etc")["residual"])


@takes_other_keywords
def residual_amplitude(filter, preset="etc"):
    """
    Return the size of the fixed pattern that flat field and sky subtraction leave behind.

    Parameters
    ----------
    filter : str
        One of `~miricigale.instrument.imager_filters`.
    preset : str, optional
        ``"etc"``: with it, the limits of the exposure time calculator 4.0 come out of its own
        exposures and extraction.

    Returns
    -------
    amplitude : float
        Standard deviation as a fraction of the light, for a pattern with a Gaussian
        correlation of 1 pixel (`~miricigale.detector.Residual`).

    Notes
    -----
    Not a measurement: what photons, read noise and dark current leave of the published
    limits, all of it taken for a pattern that does not average down in 10 ks at one
    position. ``tools/make_residual.py`` solves for it. In dithered exposures it averages down
    with the number of positions.

    Examples
    --------
    >>> from miricigale.depth import residual_amplitude
    >>> print(f"{residual_amplitude('F770W'):.5f} of the sky")
    0.00065 of the sky
    """
    name = _short(filter)
    presets = table("etc")["residual"]
    check_names([preset], "residual preset", presets)
    return presets[preset][name]
