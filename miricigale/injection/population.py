"""What is injected: sources like those of the field, or those of a catalog, at random places."""

import astropy.units as u
import numpy as np
from astropy.table import QTable
from scipy.ndimage import find_objects

from miricigale.filters.photometry_table import as_photometry
from miricigale.photometry import SourceTemplates
from miricigale.photometry.detection.cutouts import own_segments
from miricigale.photometry.images.arrays import image_arrays, pixel_scale
from miricigale.photometry.shapes.shape_models import ShapeModels
from miricigale.scene import as_sources
from miricigale.utils.arrays import nans
from miricigale.utils.exceptions import argument_error
from miricigale.utils.missing_values import plain_floats
from miricigale.utils.options import check_that
from miricigale.utils.positions import as_positions
from miricigale.utils.tables import require_columns
from miricigale.utils.units import ANGLE, FNU, ab_magnitude

#: Columns of a shape.
SHAPE = ("half_light_radius", "sersic_index", "axis_ratio", "position_angle")

#: What an own catalog is called in messages.
_NAME = "catalog of sources"

#: Columns of which one is a position.
_POSITIONS = ("sky", "ra", "alpha_j2000", "raj2000", "x")

#: Probability of a point from which a fitted source is a star.
_IS_POINT = 0.5

#: Signal-to-noise in the image from which a source says what colors and shapes are like.
_WELL_MEASURED = 5.0

#: Least number of galaxies that are copied.
_FEWEST_GALAXIES = 3

#: Share of the measured galaxies, next in magnitude, of which one is copied; and their least number.
_NEIGHBOR_SHARE = 0.2
_FEWEST_NEIGHBORS = 5

#: Range of magnitudes about the 5-sigma limit of points, bright and faint.
BRIGHTER = 4.0
FAINTER = 1.0

#: Largest slope of the logarithm of the counts with magnitude: that of a Euclidean universe.
_STEEPEST = 0.6


def fitted_shapes(image, segments, sources, psf, n_threads):
    """
    Fit profiles to the sources of an image.

    Parameters
    ----------
    image : `~astropy.nddata.CCDData`
        The image.
    segments : int `~numpy.ndarray`, shape (ny, nx)
        Its segments.
    sources : `~astropy.table.QTable`
        ``id``, ``sky`` and ``label`` of the sources.
    psf : `~numpy.ndarray`, shape (k, k)
        PSF on the pixels of the image.
    n_threads : int or None
        Threads.

    Returns
    -------
    shapes : `~astropy.table.QTable`
        ``id``, ``sky``, ``profile``, those of `SHAPE`, and ``flux``, the light of the profile, which is NaN
        where nothing was fitted.
    """
    templates = SourceTemplates.from_images(image, segments, sources, psf=psf, n_threads=n_threads)
    scale = pixel_scale(image.wcs)
    fitted = templates.fitted
    parameters = np.array(fitted["parameters"], float)
    xy = np.stack(image.wcs.world_to_pixel(sources["sky"]), axis=-1).reshape(-1, 2)
    labels, _ = own_segments(segments, np.asarray(sources["label"], int), xy)
    # profiles of faint sources may be fitted as larger than all that is seen
    n_pixels = np.bincount(segments.ravel())[np.maximum(labels, 0)]
    largest = np.where(labels > 0, np.sqrt(n_pixels / np.pi), np.inf)
    parameters[:, 2] = np.minimum(parameters[:, 2], np.log(largest))
    ellipticity = np.hypot(parameters[:, 4], parameters[:, 5])
    point = np.array(fitted["point"], float)
    is_star = ~(point < _IS_POINT)
    rows = QTable({"id": templates.id, "sky": templates.sky})
    rows["profile"] = np.where(is_star, "point", "sersic")
    radius = np.exp(parameters[:, 2] + ellipticity / 2) * scale
    rows["half_light_radius"] = np.where(is_star, 0.0, radius) * ANGLE
    rows["sersic_index"] = np.where(is_star, 1.0, np.exp(parameters[:, 3]))
    rows["axis_ratio"] = np.where(is_star, 1.0, np.exp(-ellipticity))
    angle = np.where(is_star, 0.0, _position_angles(parameters, image.wcs))
    rows["position_angle"] = np.nan_to_num(angle) * u.deg
    arrays = image_arrays(image, "image")
    rows["flux"] = _profile_fluxes(arrays, segments, labels, parameters, is_star, psf) * FNU
    return rows


def _position_angles(parameters, wcs):
    """Return the position angles (deg) of the major axes of profiles, whose angles are from +x of the image."""
    x, y = np.nan_to_num(parameters[:, :2]).T
    theta = 0.5 * np.arctan2(parameters[:, 5], parameters[:, 4])
    along = wcs.pixel_to_world(x + np.cos(theta), y + np.sin(theta))
    return wcs.pixel_to_world(x, y).position_angle(along).to_value(u.deg)


def _profile_fluxes(arrays, segments, labels, parameters, is_star, psf):
    """Return the light (uJy) of the profiles, by a fit to the pixels of their segments; NaN without a profile."""
    models = ShapeModels(psf / psf.sum())
    places = find_objects(segments)
    flux = nans(len(labels))
    for k, label in enumerate(labels):
        usable = 0 < label <= len(places) and np.isfinite(parameters[k]).all()
        if not usable or places[label - 1] is None:
            continue
        place = places[label - 1]
        moved = parameters[k] - [place[1].start, place[0].start, 0, 0, 0, 0]
        if is_star[k]:
            moved[2:] = [np.log(1e-3), 0.0, 0.0, 0.0]
        member = (segments[place] == label) & arrays.usable[place]
        profile = np.where(member, models.profiles(member.shape, moved)[0], 0.0)
        power = np.sum(profile**2)
        if power > 0:
            flux[k] = np.sum(profile * arrays.flux[place]) / power
    return flux


def measured_population(shapes, flux, snr, good):
    """
    Return the well measured sources, whose magnitudes, sizes and colors are drawn.

    Parameters
    ----------
    shapes : `~astropy.table.QTable`
        Of `fitted_shapes`.
    flux : `~numpy.ndarray`, shape (n,)
        Fluxes in the image, uJy.
    snr : `~numpy.ndarray`, shape (n,)
        Their signal-to-noise.
    good : bool `~numpy.ndarray`, shape (n,)
        Sources that are not flagged.

    Returns
    -------
    population : `~astropy.table.QTable`
        ``profile``, shape, ``magnitude`` in the image, and ``color``: that of the prior less that of the image.
    """
    fine = np.asarray(shapes["flux"].value)
    # a NaN fails every comparison
    usable = good & (snr > _WELL_MEASURED) & (flux > 0) & (fine > 0)
    rows = QTable(shapes[usable], copy=True)
    rows["magnitude"] = ab_magnitude(flux[usable] * FNU)
    rows["color"] = ab_magnitude(fine[usable] * FNU) - rows["magnitude"]
    return rows["profile", "half_light_radius", "sersic_index", "axis_ratio", "magnitude", "color"]


def read_sources(catalog, band, prior_band, wcs):
    """
    Read an own catalog of sources to be injected.

    Parameters
    ----------
    catalog : table in any form or path-like
        Fluxes or magnitudes of the band under any usual name (or ``flux``, ``mag``); with ``half_light_radius``,
        ``sersic_index``, ``axis_ratio`` and ``position_angle`` galaxies, where a radius is above 0; positions
        and fluxes of the prior's band if it has them.
    band : str
        The filter of the image.
    prior_band : str or None
        That of the prior; None without one.
    wcs : `~astropy.wcs.WCS`
        Of the image, for pixels ``x`` and ``y``.

    Returns
    -------
    sources : `~astropy.table.QTable`
        ``profile``, shape, ``flux`` (uJy), ``prior_flux`` (NaN where it is not stated) and, if the catalog has
        positions, ``sky``.

    Raises
    ------
    ValueError
        If there are no rows, or a flux is not positive, or one in the prior's band is negative, or a profile has
        another name than ``point`` and ``sersic``, or a shape is incomplete or out of range.
    """
    table = as_sources(catalog, band, _NAME)
    check_that(len(table), "catalog", "a table with rows", "none")
    require_columns(table, [band], "catalog", units={band: FNU})
    flux = plain_floats(table[band], band, "catalog") * table[band].unit.to(FNU)
    bad = ~(flux > 0) | ~np.isfinite(flux)
    check_that(not bad.any(), "catalog", "positive fluxes", f"{np.count_nonzero(bad)} others")
    rows = QTable()
    shapes = {name: nans(len(table)) for name in SHAPE}
    units = {"half_light_radius": ANGLE, "position_angle": u.deg}
    present = [name for name in SHAPE if name in table.colnames]
    require_columns(table, present, "catalog", units={k: units[k] for k in units if k in present})
    for name in present:
        values = plain_floats(table[name], name, "catalog")
        if name in units:
            values = values * u.Unit(table[name].unit).to(units[name])
        shapes[name] = values
    extended = shapes["half_light_radius"] > 0
    if "profile" in table.colnames:
        profile = np.asarray(table["profile"]).astype(str)
        unknown = sorted(set(profile.tolist()) - {"point", "sersic"})
        check_that(
            not unknown, "catalog", "a table with 'point' and 'sersic' in 'profile'", unknown
        )
        extended = profile == "sersic"
    _check_shapes(shapes, extended)
    rows["profile"] = np.where(extended, "sersic", "point")
    columns = {
        "half_light_radius": 0.0,
        "sersic_index": 1.0,
        "axis_ratio": 1.0,
        "position_angle": 0.0,
    }
    for name in SHAPE:
        rows[name] = np.where(extended, shapes[name], columns[name]) * units.get(name, 1)
    rows["flux"] = flux * FNU
    prior_flux = nans(len(table))
    if prior_band == band:
        prior_flux = flux
    elif prior_band is not None:
        # of two bands, so that 'flux' is not taken for that of the prior
        of_prior = as_photometry(catalog, [band, prior_band], _NAME)
        if prior_band in of_prior.colnames:
            require_columns(of_prior, [prior_band], "catalog", units={prior_band: FNU})
            prior_flux = plain_floats(of_prior[prior_band], prior_band, "catalog")
            prior_flux = prior_flux * of_prior[prior_band].unit.to(FNU)
            bad = (prior_flux < 0) | np.isinf(prior_flux)
            wanted = "fluxes in the prior's filter that are finite and at least 0, or missing"
            check_that(not bad.any(), "catalog", wanted, f"{np.count_nonzero(bad)} others")
    rows["prior_flux"] = prior_flux * FNU
    if {name.lower() for name in table.colnames} & set(_POSITIONS):
        rows["sky"] = as_positions(table, "catalog", wcs)
    return rows


def _check_shapes(shapes, extended):
    """Refuse galaxies without a shape that can be drawn."""
    wanted = {
        "half_light_radius": shapes["half_light_radius"] > 0,
        "sersic_index": (shapes["sersic_index"] >= 0.3) & (shapes["sersic_index"] <= 8),
        "axis_ratio": (shapes["axis_ratio"] > 0) & (shapes["axis_ratio"] <= 1),
        "position_angle": np.isfinite(shapes["position_angle"]),
    }
    for name, good in wanted.items():
        bad = extended & ~good
        if bad.any():
            row = int(np.argmax(bad))
            need = f"a usable {name!r} for each galaxy"
            raise argument_error("catalog", need, f"{shapes[name][row]} in row {row} (from 0)")


def counts_slope(magnitude, limit):
    """
    Return the slope of the logarithm of the counts with magnitude, by maximum likelihood.

    Parameters
    ----------
    magnitude : `~numpy.ndarray`, shape (n,)
        Magnitudes of the sources.
    limit : float
        Magnitude to which they are complete.

    Returns
    -------
    slope : float
        Per magnitude, from 0 to 0.6.
    """
    brighter = limit - magnitude[magnitude < limit]
    if not len(brighter):
        return 0.0
    return float(np.clip(1.0 / (np.log(10.0) * np.mean(brighter)), 0.0, _STEEPEST))


def draw_magnitudes(n, slope, low, high, rng):
    """Draw magnitudes between two whose counts go as ``10 ** (slope * magnitude)``, shape (n,)."""
    share = rng.uniform(size=n)
    rate = slope * np.log(10.0)
    if rate * (high - low) < 1e-6:
        return low + share * (high - low)
    return low + np.log1p(share * np.expm1(rate * (high - low))) / rate


def draw_sources(population, n, star_share, slope, magnitudes, rng):
    """
    Draw sources like those of the field.

    Parameters
    ----------
    population : `~astropy.table.QTable`
        Of `measured_population`.
    n : int
        How many.
    star_share : float
        Probability of a star.
    slope : float
        Of `counts_slope`.
    magnitudes : (float, float)
        Range, bright and faint.
    rng : `~numpy.random.Generator`
        Random numbers.

    Returns
    -------
    sources : `~astropy.table.QTable`
        ``profile``, shape, ``flux`` and ``prior_flux``. Shape and color are those of a measured source of a
        similar magnitude, the position angle is random.

    Raises
    ------
    ValueError
        If too few sources were measured to draw from.
    """
    magnitude = draw_magnitudes(n, slope, *magnitudes, rng)
    is_star = rng.uniform(size=n) < star_share
    donors = {True: population[population["profile"] == "point"]}
    donors[False] = population[population["profile"] == "sersic"]
    if not is_star.all() and len(donors[False]) < _FEWEST_GALAXIES:
        wanted = "given, or 'stars' 1: the field has too few galaxies to draw from"
        raise argument_error("catalog", wanted, f"{len(donors[False])} of them")
    if not len(donors[True]):
        # their colors alone are taken
        donors[True] = population
    check_that(
        len(donors[True]) or not is_star.any(),
        "catalog",
        "given, for a field like this",
        "no source",
    )
    rows = []
    for star, m in zip(is_star, magnitude, strict=True):
        pool = donors[bool(star)]
        n_near = max(_FEWEST_NEIGHBORS, int(_NEIGHBOR_SHARE * len(pool)))
        nearest = np.argsort(np.abs(pool["magnitude"] - m), kind="stable")[:n_near]
        rows.append(pool[int(nearest[rng.integers(len(nearest))])])
    radius = np.array([row["half_light_radius"].value for row in rows])
    sources = QTable({"profile": np.where(is_star, "point", "sersic")})
    sources["half_light_radius"] = np.where(is_star, 0.0, radius) * ANGLE
    for name in ("sersic_index", "axis_ratio"):
        values = np.array([row[name] for row in rows])
        sources[name] = np.where(is_star, 1.0, values)
    sources["position_angle"] = rng.uniform(0.0, 180.0, n) * u.deg
    color = np.array([row["color"] for row in rows])
    sources["flux"] = 10 ** (0.4 * (23.9 - magnitude)) * FNU
    sources["prior_flux"] = 10 ** (0.4 * (23.9 - magnitude - color)) * FNU
    return sources
