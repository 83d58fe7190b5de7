"""The exposures of the survey CEERS."""

from miricigale.instrument.exposure import Exposure
from miricigale.utils.options import check_names
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.package_tables import declared

_COUNTS = declared("miricigale.instrument", "ceers.toml")

#: Bands of the CEERS/MIRI imaging.
CEERS_FILTERS = tuple(_COUNTS["whole"])


@takes_other_keywords
def ceers_exposures(pointing, roll, *, filters=None, quick=False):
    """
    Return the exposures of one CEERS/MIRI pointing.

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

    Examples
    --------
    >>> from astropy.coordinates import SkyCoord
    >>> import astropy.units as u
    >>> from miricigale.instrument import ceers_exposures
    >>> field = SkyCoord(214.9, 52.9, unit="deg")
    >>> exposures = ceers_exposures(field, 0 * u.deg, filters=["miri.f770w"])
    >>> len(exposures), exposures[0].exposure_time
    (3, <Quantity 555. s>)
    """
    if filters is None:
        filters = CEERS_FILTERS
    else:
        filters = tuple(filters)
    check_names(filters, "band of the survey", CEERS_FILTERS)
    exposures = []
    for name in filters:
        n_groups, n_integrations, n_dithers = _COUNTS["quick" if quick else "whole"][name]
        base = Exposure(
            name, n_groups=n_groups, n_integrations=n_integrations, pointing=pointing, roll=roll
        )
        exposures += base.dithered("ceers", n_dithers)
    return exposures
