"""Positions of images: to each other, and to a catalog."""

import dataclasses

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord, search_around_sky
from astropy.time import Time
from astropy.wcs import WCS
from astropy.wcs.utils import proj_plane_pixel_scales
from scipy.spatial import KDTree

from miricigale.instrument import ImageFacts, epoch_of, psf_fwhm
from miricigale.reduction.images.images import plain_mask, with_data
from miricigale.reduction.sky.background import estimate_background
from miricigale.utils import sep_tools
from miricigale.utils.exceptions import argument_error
from miricigale.utils.files import listed_images
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.positions import at_epoch
from miricigale.utils.units import ANGLE, positive

# pairs vote for the shift within this radius, and are matched within it after the shift, arcsec
_VOTE = 0.1
# sigma of a pixel above which sources are detected
_DETECTED = 10.0
# sources to solve for a shift, and for a rotation too
_LEAST = 3
_LEAST_ROTATION = 10


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


@takes_other_keywords
def align_to_catalog(image, catalog, *, radius=1 * u.arcsec):
    """
    Correct the coordinates of an image by the positions of a catalog.

    Parameters
    ----------
    image : `~astropy.nddata.CCDData`
        With uncertainty and WCS, background subtracted or not.
    catalog : `~astropy.coordinates.SkyCoord`
        Positions at the epoch of the image; those with proper motions and ``obstime``, as of Gaia, are
        brought to it.
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
        If fewer than three sources of the catalog are found in the image, an option is out of range, or the
        catalog has proper motions and its time or that of the image is not known.

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
    detected = [(image, *_sources(image, "image"))]
    reach = positive(radius, ANGLE, "radius")
    (aligned,), alignment = _aligned(detected, _positions(catalog, [image]), reach, "image")
    return aligned, alignment


@takes_other_keywords
def align_images(images, catalog=None, *, radius=1 * u.arcsec, groups=None):
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
    groups : iterable, optional
        Of which group each image is, such as its visit: dithers on one guide star have the right places to each
        other, but visits are off from each other, so that a group is moved as a whole, by all of its sources.
        Each image by itself if not given.

    Returns
    -------
    images : list of `~astropy.nddata.CCDData`
    alignments : list of `Alignment`
        Of the first group without a catalog that of none, with the number of its sources.

    Raises
    ------
    ValueError
        As of `align_to_catalog`, naming the first image of a group by its place in the list; if there are no
        images, or not one group for each.

    References
    ----------
    STScI-MIRI, notebooks on imaging: dithers with one guide star agree, tiles with different ones are off by up
    to 2 arcsec.

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
    images = listed_images(images)
    check_that(images, "images", "at least one image", "none")
    reach = positive(radius, ANGLE, "radius")
    groups = list(range(len(images)) if groups is None else groups)
    check_that(
        len(groups) == len(images), "groups", f"one for each of {len(images)} images", len(groups)
    )
    reference = None
    out = [None] * len(images)
    alignments = [None] * len(images)
    for group in dict.fromkeys(groups):
        members = [k for k, name in enumerate(groups) if name == group]
        detected = [(images[k], *_sources(images[k], f"images[{k}]")) for k in members]
        if catalog is not None:
            reference = _positions(catalog, [images[k] for k in members])
        if reference is None:
            still = dict.fromkeys(("east", "north", "scatter"), 0 * ANGLE)
            moved, sizes = zip(*((im, x.size) for im, x, _ in detected), strict=True)
            alignment = Alignment(**still, rotation=0 * u.deg, n_matched=sum(sizes))
        else:
            moved, alignment = _aligned(detected, reference, reach, f"images[{members[0]}]")
        for k, im, (_, x, y) in zip(members, moved, detected, strict=True):
            out[k] = im
            alignments[k] = alignment
            if catalog is None:
                sky = im.wcs.pixel_to_world(x, y).icrs
                if reference is not None:
                    # what is there already stays as it is
                    _, separation, _ = sky.match_to_catalog_sky(reference)
                    sky = sky[separation.to_value(ANGLE) > 0.5]
                    sky = SkyCoord(
                        np.append(reference.ra, sky.ra), np.append(reference.dec, sky.dec)
                    )
                reference = sky
    return out, alignments


def visit_of(image):
    """Return the visit of an image, of the keyword VISIT_ID of its observation."""
    visit = image.meta.get("keywords", {}).get("VISIT_ID", [None])[0]
    check_that(visit is not None, "images", "ones with the keyword VISIT_ID", "one without")
    return visit


def _positions(catalog, images):
    """Return the places of a catalog at the mean time of images that are moved together."""
    if not isinstance(catalog, SkyCoord) or catalog.isscalar:
        raise argument_error("catalog", "a SkyCoord of several positions", repr(catalog)[:60])
    unknown = int(np.count_nonzero(~np.isfinite(catalog.cartesian.norm())))
    check_that(
        not unknown, "catalog", "of finite positions", f"{unknown} of {len(catalog)} that are not"
    )
    epochs = [epoch_of(im) for im in images]
    days = [np.nan if epoch is None else epoch.utc.mjd for epoch in epochs]
    # of any without a time the mean is unknown
    day = np.mean(days)
    epoch = None
    if np.isfinite(day):
        epoch = Time(day, format="mjd", scale="utc")
    return at_epoch(catalog, epoch, "catalog")


def _sources(image, argument):
    """Return the windowed positions of the sources of an image, in pixels."""
    if image.wcs is None or image.uncertainty is None:
        raise argument_error(argument, "one with uncertainty and WCS", "one without")
    if not str(image.wcs.wcs.ctype[0]).startswith("RA"):
        wanted = "one with right ascension along its first axis of the sky"
        raise argument_error(argument, wanted, " and ".join(image.wcs.wcs.ctype))
    scale = float(np.mean(proj_plane_pixel_scales(image.wcs))) * 3600
    name = ImageFacts.of(image).filter
    check_that(name is not None, argument, "one whose meta names its filter", "none")
    width = psf_fwhm(name).to_value(ANGLE) / scale / 2.3548
    mask = plain_mask(image)
    background = estimate_background(image, warn=False)
    data = np.where(mask, 0, image.data - background.level)
    try:
        detected, _ = sep_tools.extract(data, _DETECTED, err=background.rms, mask=mask)
    except ValueError as err:
        # more peaks in one area than sep can tell apart
        raise argument_error(argument, "one whose sources can be told apart", str(err)) from None
    # the edge, and what is masked, cuts sources
    x, y, fine = sep_tools.window_positions(data, detected["x"], detected["y"], width, mask=mask)
    moved = np.hypot(x - detected["x"], y - detected["y"])
    good = fine & (moved < width) & (detected["flag"] == 0)
    return x[good], y[good]


def _aligned(detected, catalog, radius, argument):
    """Images, with pixels of their sources, moved together to a catalog: the images, and by how much."""
    plane = _tangent_plane(detected[0][0].wcs.wcs.crval)
    places, targets, n_sources = _pairs(detected, catalog, radius, plane)
    matched = _agreeing(targets - places)
    for _ in range(5):
        wanted = f"one with at least {_LEAST} sources of the catalog within {radius:g} arcsec"
        got = f"{np.count_nonzero(matched)} of {n_sources} sources"
        check_that(np.count_nonzero(matched) >= _LEAST, argument, wanted, got)
        turn, move = _solved(places[matched], targets[matched])
        residual = targets - places @ _rotation(turn).T - move
        spread = np.sqrt(np.mean(np.square(residual[matched])))
        matched_before = matched
        matched = np.hypot(*residual.T) < max(3 * spread, 1e-6)
        if np.array_equal(matched, matched_before):
            break
    alignment = Alignment(
        east=move[0] * ANGLE,
        north=move[1] * ANGLE,
        rotation=np.degrees(turn) * u.deg,
        n_matched=int(np.count_nonzero(matched)),
        scatter=float(np.sqrt(np.mean(np.square(residual[matched])))) * ANGLE,
    )
    moved = []
    for im, *_ in detected:
        aligned = with_data(im, im.data, n_aligned=alignment.n_matched)
        aligned.wcs = _moved_wcs(im.wcs, plane, _rotation(turn), move)
        moved.append(aligned)
    return moved, alignment


def _tangent_plane(center):
    """Return the coordinates east and north of a position (deg), in deg: "pixels" of the plane are degrees."""
    plane = WCS(naxis=2)
    plane.wcs.ctype = "RA---TAN", "DEC--TAN"
    plane.wcs.crval = center
    plane.wcs.crpix = (1.0, 1.0)
    plane.wcs.cdelt = 1.0, 1.0
    return plane


def _pairs(detected, catalog, radius, plane):
    """
    Pair sources of images with all positions of a catalog within a radius in arcsec.

    Returns
    -------
    places, targets : `~numpy.ndarray`, shape (n_pairs, 2)
        Sources and positions of the catalog in the plane, arcsec.
    n_sources : int
        Number of sources of the images.
    """
    ra = [np.empty(0)]
    dec = [np.empty(0)]
    for im, x, y in detected:
        if x.size:
            sky = im.wcs.pixel_to_world(x, y).icrs
            ra.append(sky.ra.deg)
            dec.append(sky.dec.deg)
    sky = SkyCoord(np.concatenate(ra), np.concatenate(dec), unit="deg")
    source = position = np.empty(0, int)
    if len(sky):
        source, position, _, _ = search_around_sky(sky, catalog, radius * ANGLE)
    if not len(source):
        return np.empty((0, 2)), np.empty((0, 2)), len(sky)
    places = np.stack(plane.world_to_pixel(sky[source]), axis=1) * 3600
    targets = np.stack(plane.world_to_pixel(catalog[position]), axis=1) * 3600
    return places, targets, len(sky)


def _agreeing(shift):
    """Tell which pairs agree with the most frequent shift, of shifts in arcsec, shape (n, 2)."""
    if not len(shift):
        return np.zeros(0, bool)
    tree = KDTree(shift)
    votes = tree.query_ball_point(shift, _VOTE, return_length=True)
    # the neighbors of one of the most frequent: between two such places there are none
    neighbors = tree.query_ball_point(shift[np.argmax(votes)], _VOTE)
    return np.hypot(*(shift - np.median(shift[neighbors], axis=0)).T) < _VOTE


def _moved_wcs(wcs, plane, matrix, move):
    """Return the world coordinates turned by a matrix and moved by arcsec (east, north) in a tangent plane."""
    wcs = wcs.deepcopy()
    if wcs.wcs.has_cd():
        wcs.wcs.cd = matrix @ wcs.wcs.cd
    else:
        # PC acts on pixels, before the scale CDELT: CDELT PC' = matrix CDELT PC
        scale = np.diag(wcs.wcs.cdelt)
        wcs.wcs.pc = np.linalg.inv(scale) @ matrix @ scale @ wcs.wcs.get_pc()
    place = np.array(plane.wcs_world2pix([wcs.wcs.crval], 0)[0])
    wcs.wcs.crval = plane.wcs_pix2world([matrix @ place + move / 3600], 0)[0]
    wcs.wcs.set()
    return wcs


def _rotation(turn):
    """Return the matrix of a turn from north to east, of places (east, north)."""
    cos = np.cos(turn)
    sin = np.sin(turn)
    return np.array([[cos, sin], [-sin, cos]])


def _solved(places, targets):
    """Turn from north to east, and shift, that bring places to others."""
    turn = 0.0
    if len(places) >= _LEAST_ROTATION:
        a = places - places.mean(axis=0)
        b = targets - targets.mean(axis=0)
        turn = np.arctan2(np.sum(a[:, 1] * b[:, 0] - a[:, 0] * b[:, 1]), np.sum(a * b))
    return turn, (targets - places @ _rotation(turn).T).mean(axis=0)
