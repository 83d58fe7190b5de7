"""Positions of images: to each other, and to a catalog."""

import dataclasses

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord, search_around_sky
from astropy.wcs import WCS
from astropy.wcs.utils import proj_plane_pixel_scales
from scipy.spatial import KDTree

from miricigale.instrument import ImageFacts, psf_fwhm
from miricigale.reduction.background import estimate_background
from miricigale.reduction.images import plain_mask, with_data
from miricigale.utils import sep_tools
from miricigale.utils.exceptions import argument_error
from miricigale.utils.units import ANGLE, positive

# pairs vote for the shift within this radius, and are matched within it after the shift, arcsec
_VOTE = 0.1
# sigma of a pixel above which sources are detected
_DETECTED = 10.0
# sources to solve for a shift, and for a rotation too
_LEAST, _LEAST_ROTATION = 3, 10


@dataclasses.dataclass(frozen=True, kw_only=True)
class Alignment:
    """
    How the coordinates of an image were changed.

    Parameters
    ----------
    east, north : `~astropy.units.Quantity`
        Shift of the reference position.
    rotation : `~astropy.units.Quantity`
        Turn about it, from north to east.
    n_matched : int
        Sources that were used.
    scatter : `~astropy.units.Quantity`
        Of one source about the solution, in one coordinate.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.reduction import Alignment
    >>> solution = Alignment(
    ...     east=12 * u.mas,
    ...     north=-5 * u.mas,
    ...     rotation=0 * u.deg,
    ...     n_matched=14,
    ...     scatter=6 * u.mas,
    ... )
    >>> solution.east, solution.n_matched
    (<Quantity 12. mas>, 14)
    """

    east: u.Quantity
    north: u.Quantity
    rotation: u.Quantity
    n_matched: int
    scatter: u.Quantity


def align_to_catalog(image, catalog, *, radius=1 * u.arcsec):
    """
    Correct the coordinates of an image by the positions of a catalog.

    Parameters
    ----------
    image : `~astropy.nddata.CCDData`
        With uncertainty and WCS, background subtracted or not.
    catalog : `~astropy.coordinates.SkyCoord`
        Positions, at the epoch of the image.
    radius : `~astropy.units.Quantity`, optional
        Largest shift.

    Returns
    -------
    image : `~astropy.nddata.CCDData`
        With the corrected WCS; data and distortion are as they were.
    alignment : `Alignment`

    Raises
    ------
    ValueError
        If fewer than three sources of the catalog are found in the image, or an option is out of range.

    Notes
    -----
    Positions are windowed centroids, of sources above 10 sigma of a pixel. All pairs of a source and a
    position within ``radius`` vote for a shift; what agrees with the most frequent to 0.1 arcsec is fitted
    by least squares, clipped at three standard deviations; a rotation is fitted too with ten sources or
    more. A wrong scale would be one of the distortion, and is not looked for.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale import Detector, Exposure, Reducer
    >>> from miricigale.scene import Scene
    >>> first = Exposure("F770W", n_groups=20, subarray="SUB128", pointing="53 -27")
    >>> sky = first.wcs.pixel_to_world([30, 60, 100, 80], [40, 90, 60, 100])
    >>> stars = {"id": [1, 2, 3, 4], "ra": sky.ra.deg, "dec": sky.dec.deg}
    >>> stars |= {"F770W": [500] * 4 * u.uJy, "profile": ["point"] * 4}
    >>> charge = Detector.miri_imager().collect(
    ...     Scene(stars, first, background="low"), seed=1
    ... )
    >>> reducer = Reducer()
    >>> image = reducer.calibrate(reducer.fit_ramp(charge))
    >>> image.wcs.wcs.crval[1] += 0.2 / 3600  # wrong by 0.2 arcsec
    >>> from miricigale.reduction import align_to_catalog
    >>> corrected, solution = align_to_catalog(image, sky)
    >>> print(f"{solution.north.to(u.arcsec):.1f}, {solution.n_matched} stars")
    -0.2 arcsec, 4 stars
    """
    x, y = _sources(image, "image")
    return _aligned(image, x, y, _positions(catalog), positive(radius, ANGLE, "radius"), "image")


def align_images(images, catalog=None, *, radius=1 * u.arcsec):
    """
    Align images to each other, or to a catalog.

    Parameters
    ----------
    images : list of `~astropy.nddata.CCDData`
        As for `align_to_catalog`.
    catalog : `~astropy.coordinates.SkyCoord`, optional
        Without one, the first image stands where it is, and each of the others is aligned to the sources of
        those before it.
    radius : optional
        As for `align_to_catalog`.

    Returns
    -------
    images : list of `~astropy.nddata.CCDData`
    alignments : list of `Alignment`
        Of the first image without a catalog that of none, with the number of its sources.

    Raises
    ------
    ValueError
        As of `align_to_catalog`, naming the image by its place in the list; or if there are no images.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale import Detector, Exposure, Reducer
    >>> from miricigale.scene import Scene
    >>> first = Exposure("F770W", n_groups=20, subarray="SUB128", pointing="53 -27")
    >>> sky = first.wcs.pixel_to_world([30, 60, 100, 80], [40, 90, 60, 100])
    >>> stars = {"id": [1, 2, 3, 4], "ra": sky.ra.deg, "dec": sky.dec.deg}
    >>> stars |= {"F770W": [500] * 4 * u.uJy, "profile": ["point"] * 4}
    >>> charge = Detector.miri_imager().collect(
    ...     Scene(stars, first, background="low"), seed=1
    ... )
    >>> reducer = Reducer()
    >>> image = reducer.calibrate(reducer.fit_ramp(charge))
    >>> image.wcs.wcs.crval[1] += 0.2 / 3600  # wrong by 0.2 arcsec
    >>> from miricigale.reduction import align_images
    >>> images, solutions = align_images([image], sky)
    >>> print(f"{solutions[0].north.to(u.arcsec):.1f}, {solutions[0].n_matched} stars")
    -0.2 arcsec, 4 stars
    """
    images = list(images)
    if not images:
        raise argument_error("images", "at least one image", "none")
    reach = positive(radius, ANGLE, "radius")
    known = None if catalog is None else _positions(catalog)
    out, alignments = [], []
    for k, im in enumerate(images):
        name = f"images[{k}]"
        x, y = _sources(im, name)
        if known is None:
            still = dict.fromkeys(("east", "north", "scatter"), 0 * ANGLE)
            aligned, alignment = im, Alignment(**still, rotation=0 * u.deg, n_matched=x.size)
        else:
            aligned, alignment = _aligned(im, x, y, known, reach, name)
        if catalog is None:
            sky = aligned.wcs.pixel_to_world(x, y)
            if known is not None:
                # what is there already stays as it is
                _, apart, _ = sky.match_to_catalog_sky(known)
                sky = sky[apart.to_value(ANGLE) > 0.5]
                sky = SkyCoord(np.append(known.ra, sky.ra), np.append(known.dec, sky.dec))
            known = sky.icrs
        out.append(aligned)
        alignments.append(alignment)
    return out, alignments


def _positions(catalog):
    if not isinstance(catalog, SkyCoord) or catalog.isscalar:
        raise argument_error("catalog", "a SkyCoord of several positions", repr(catalog)[:60])
    unknown = int(np.count_nonzero(~np.isfinite(catalog.cartesian.norm())))
    if unknown:
        got = f"{unknown} of {len(catalog)} that are not"
        raise argument_error("catalog", "of finite positions", got)
    return SkyCoord(catalog.icrs.ra, catalog.icrs.dec)


def _sources(image, argument):
    """Windowed positions of the sources of an image, in pixels."""
    if image.wcs is None or image.uncertainty is None:
        raise argument_error(argument, "one with uncertainty and WCS", "one without")
    if not str(image.wcs.wcs.ctype[0]).startswith("RA"):
        wanted = "one with right ascension along its first axis of the sky"
        raise argument_error(argument, wanted, " and ".join(image.wcs.wcs.ctype))
    scale = float(np.mean(proj_plane_pixel_scales(image.wcs))) * 3600
    name = ImageFacts.of(image).filter
    if name is None:
        raise argument_error(argument, "one whose meta names its filter", "none")
    width = psf_fwhm(name).to_value(ANGLE) / scale / 2.3548
    mask, background = plain_mask(image), estimate_background(image, warn=False)
    data = np.where(mask, 0, image.data - background.level)
    found, _ = sep_tools.extract(data, _DETECTED, err=background.rms, mask=mask)
    # the edge, and what is masked, cuts sources
    x, y, fine = sep_tools.window_positions(data, found["x"], found["y"], width, mask=mask)
    moved = np.hypot(x - found["x"], y - found["y"])
    good = fine & (moved < width) & (found["flag"] == 0)
    return x[good], y[good]


def _aligned(image, x, y, catalog, radius, argument):
    """Image with its WCS moved to a catalog, and by how much."""
    # plane about the reference position, deg, east and north
    plane = WCS(naxis=2)
    plane.wcs.ctype = "RA---TAN", "DEC--TAN"
    plane.wcs.crval, plane.wcs.crpix = image.wcs.wcs.crval, (1.0, 1.0)
    plane.wcs.cdelt = 1.0, 1.0
    sky = image.wcs.pixel_to_world(x, y).icrs if len(x) else SkyCoord([], [], unit="deg")
    i, j, *_ = search_around_sky(sky, catalog, radius * ANGLE) if len(x) else ([], [])
    one, other = (
        np.stack(plane.world_to_pixel(s[k]), axis=1) * 3600 if len(k) else np.empty((0, 2))
        for s, k in ((sky, i), (catalog, j))
    )
    shift = other - one
    used = np.zeros(len(shift), bool)
    if len(shift):
        tree = KDTree(shift)
        votes = tree.query_ball_point(shift, _VOTE, return_length=True)
        # of several shifts that are as frequent one: between them there are none
        near = tree.query_ball_point(shift[np.argmax(votes)], _VOTE)
        used = np.hypot(*(shift - np.median(shift[near], axis=0)).T) < _VOTE
    turn, move, residual = 0.0, np.zeros(2), shift
    for _ in range(5):
        if np.count_nonzero(used) < _LEAST:
            wanted = f"one with at least {_LEAST} sources of the catalog within {radius:g} arcsec"
            raise argument_error(argument, wanted, f"{np.count_nonzero(used)} of {len(x)} sources")
        turn, move = _solved(one[used], other[used])
        residual = other - one @ _rotation(turn).T - move
        spread = np.sqrt(np.mean(np.square(residual[used])))
        new = np.hypot(*residual.T) < max(3 * spread, 1e-6)
        if np.array_equal(new, used):
            break
        used = new
    wcs = image.wcs.deepcopy()
    matrix = _rotation(turn)
    if wcs.wcs.has_cd():
        wcs.wcs.cd = matrix @ wcs.wcs.cd
    else:
        scale = np.diag(wcs.wcs.cdelt)
        wcs.wcs.pc = np.linalg.inv(scale) @ matrix @ scale @ wcs.wcs.get_pc()
    center = plane.pixel_to_world(*(move / 3600)).icrs
    wcs.wcs.crval = [center.ra.deg, center.dec.deg]
    wcs.wcs.set()
    alignment = Alignment(
        east=move[0] * ANGLE,
        north=move[1] * ANGLE,
        rotation=np.degrees(turn) * u.deg,
        n_matched=int(np.count_nonzero(used)),
        scatter=float(np.sqrt(np.mean(np.square(residual[used])))) * ANGLE,
    )
    out = with_data(image, image.data, n_aligned=alignment.n_matched)
    out.wcs = wcs
    return out, alignment


def _rotation(turn):
    """Matrix of a turn from north to east, of places (east, north)."""
    cos, sin = np.cos(turn), np.sin(turn)
    return np.array([[cos, sin], [-sin, cos]])


def _solved(one, other):
    """Turn from north to east, and shift, that bring places to others."""
    turn = 0.0
    if len(one) >= _LEAST_ROTATION:
        a, b = one - one.mean(axis=0), other - other.mean(axis=0)
        turn = np.arctan2(np.sum(a[:, 1] * b[:, 0] - a[:, 0] * b[:, 1]), np.sum(a * b))
    return turn, (other - one @ _rotation(turn).T).mean(axis=0)
