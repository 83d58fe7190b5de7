"""One measurement of a field with injected sources, and that without any."""

import numpy as np
from astropy.table import QTable

from miricigale.injection.field import over_noise, recovered_rows
from miricigale.injection.population import (
    BRIGHTER,
    FAINTER,
    SHAPE,
    counts_slope,
    draw_sources,
    measured_population,
)
from miricigale.instrument.image import Image
from miricigale.photometry import ForcedFlags, detect_sources
from miricigale.photometry.images.arrays import draw_places, nearest_values, pixel_scale
from miricigale.utils.arrays import nans
from miricigale.utils.column_units import quantity_table
from miricigale.utils.exceptions import argument_error
from miricigale.utils.options import check_that
from miricigale.utils.random import stream
from miricigale.utils.units import ANGLE, FNU, ab_magnitude
from miricigale.utils.values import value_class

#: Flags with which a source still says what colors and shapes are like.
_HARMLESS = ForcedFlags.BLENDED | ForcedFlags.UNEXPLAINED_NEIGHBOR

#: Parts of an image, row by row from below.
PLACES = (
    "lower left",
    "lower middle",
    "lower right",
    "middle left",
    "center",
    "middle right",
    "upper left",
    "upper middle",
    "upper right",
)

#: Least distance of two injected sources, in widths of the PSF (FWHM).
APART = 6.0

#: Injected sources over those of the field, at most and by default; and their least number.
_SHARE = 0.2
_FEWEST = 20

#: Area for each injected source, in squares of the least distance.
_ROOM = 3.0


@value_class
class Base:
    """
    The field without injected sources.

    Attributes
    ----------
    table : `~astropy.table.QTable`
        The user's photometry.
    former : `~astropy.table.QTable`
        Sources of the prior (``sky``, ``flux``), or of the image with their shapes.
    detections, negatives : `~astropy.table.QTable`
        Detections on the image, and on its negative.
    population : `~astropy.table.QTable`
        Of `~miricigale.injection.population.measured_population`.
    psfs : tuple of `~miricigale.psf.InstrumentPSF`
        Of the image and of the prior (None without one).
    model : `~astropy.nddata.CCDData`
        Fitted model of the image without background, with the image's noise.
    empty_pulls : `~numpy.ndarray` or None
        Flux over error at empty positions; None where there are none.
    noise_correlation : `~numpy.ndarray`, shape (2 m + 1, 2 m + 1), or None
        Covariance of the noise of the image's pixels, as photometry measured it.
    facts : dict
        Plain values: ``limit`` (5-sigma AB limit: 5 times the median error), ``slope`` of the counts, ``fwhm``
        (arcsec), ``n_sources`` and ``n_injected`` (by default, each time), ``photon_noise`` (what is known of that
        of light in the image).
    """

    table: QTable
    former: QTable
    detections: QTable
    negatives: QTable
    population: QTable
    psfs: tuple
    model: object
    empty_pulls: np.ndarray | None
    noise_correlation: np.ndarray | None
    facts: dict


def measure_base(field, injection):
    """
    Measure a field as its user does, and what is needed to inject sources.

    Parameters
    ----------
    field : `~miricigale.injection.field.PriorField` or `~miricigale.injection.field.ImageField`
        The field.
    injection : `~miricigale.injection.Injection`
        Settings.

    Returns
    -------
    base : `Base`
    """
    measured, pixels, segments, catalog = field.measure()
    image = measured.image
    result = measured.result
    psfs = field.psfs(result)
    n = len(catalog)
    shapes = field.shapes(pixels, segments, catalog)
    flux = np.asarray(result.flux.value[:n])
    error = np.asarray(result.flux_err.value[:n])
    usable = np.isfinite(error) & (error > 0)
    check_that(usable.any(), "image", "a field of which some source is measured", "none")
    good = result.flags[:n] & ~int(_HARMLESS) == 0
    population = measured_population(shapes, flux, result.snr[:n], good)
    if (usable & good).any():
        error_of_points = np.median(error[usable & good])
    else:
        error_of_points = np.median(error[usable])
    limit = float(ab_magnitude(5 * error_of_points * FNU))
    fwhm = result.psf_fwhm.to_value(ANGLE)
    good_pixels = field.usable(image, pixels.prior)
    room = np.count_nonzero(good_pixels) * pixel_scale(image.wcs) ** 2 / (APART * fwhm) ** 2
    n_injected = max(1, int(min(room / _ROOM, max(_FEWEST, _SHARE * n))))
    former = shapes
    if field.has_prior:
        former = QTable({"sky": catalog["sky"]})
        if "flux" in catalog.colnames:
            former["flux"] = catalog["flux"]
        else:
            former["flux"] = shapes["flux"]
    return Base(
        table=measured.table,
        former=former,
        detections=detect_sources(image, preset=injection.preset)[1],
        negatives=detect_sources(_negative(image), preset=injection.preset)[1],
        population=population,
        psfs=psfs,
        model=_model(result),
        empty_pulls=_empty_pulls(result, field, injection.seed),
        noise_correlation=result.noise_correlation,
        facts={
            "limit": limit,
            "slope": counts_slope(np.asarray(population["magnitude"]), limit),
            "fwhm": fwhm,
            "n_sources": n,
            "n_injected": n_injected,
            "band": field.band,
            "prior_band": field.prior_band,
            "photon_noise": field.photon_noise.text,
        },
    )


def _model(result):
    """Return the fitted model without its background, with the noise and the mask of the image."""
    residual = result.residual_image
    light = np.array(result.model_image.data, float)
    if result.background is not None:
        light -= result.background.to_value(result.model_image.unit)
    return Image(
        light,
        unit=result.model_image.unit,
        wcs=residual.wcs,
        mask=residual.mask,
        uncertainty=residual.uncertainty,
    )


def _negative(image):
    negative = image.copy()
    negative.data = -image.data
    return negative


def _empty_pulls(result, field, seed):
    """Return the flux over error of points where the measurement left no light."""
    from miricigale.photometry.commands.page import empty_pulls
    from miricigale.psf import MatchingKernel

    if field.has_prior:
        kernel = field.photometers[field.band].mean_kernel
    else:
        kernel = MatchingKernel.identity(field.psf)
    return empty_pulls(result, kernel, seed)


def injected_sources(injection, catalog, base, usable, wcs, number):
    """
    Say what is injected in one trial, and where.

    Parameters
    ----------
    injection : `~miricigale.injection.Injection`
        Settings.
    catalog : `~astropy.table.QTable` or None
        Own sources (`~miricigale.injection.population.read_sources`); drawn ones without.
    base : `Base`
        The field.
    usable : bool `~numpy.ndarray`, shape (ny, nx)
        Pixels of the image on which sources may be.
    wcs : `~astropy.wcs.WCS`
        Of the image.
    number : int
        Of the trial, from 1.

    Returns
    -------
    sources : `~astropy.table.QTable`
        ``row`` (that of an own catalog, -1 otherwise), ``sky``, ``profile``, shapes, ``flux``, ``prior_flux``.
    """
    rng = stream(injection.seed, "injection", number)
    if injection.n_sources is None:
        n = base.facts["n_injected"]
    else:
        n = injection.n_sources
    if n == 0:
        return QTable({"row": np.zeros(0, int)})
    rows = np.full(n, -1)
    if catalog is not None:
        on_image = _rows_on_image(catalog, usable, wcs)
        # all in turn, then from the beginning
        rows = on_image[((number - 1) * n + np.arange(n)) % len(on_image)]
        # a source is injected once at a time
        rows = rows[: len(on_image)]
        sources = quantity_table(catalog[rows], copy=True)
        _fill_prior_fluxes(sources, base, rng)
    else:
        limit = base.facts["limit"]
        magnitudes = limit - BRIGHTER, limit + FAINTER
        sources = draw_sources(
            base.population, n, injection.stars, base.facts["slope"], magnitudes, rng
        )
    sources["row"] = rows
    if "sky" not in sources.colnames:
        separation = APART * base.facts["fwhm"] / pixel_scale(wcs)
        xy = draw_places(usable, len(sources), separation, rng)
        check_that(len(xy), "image", "large enough for sources", "no free place")
        if injection.n_sources is not None and len(xy) < len(sources):
            wanted = f"at most {len(xy)}, which have room {APART:g} widths of the PSF apart"
            raise argument_error("n_sources", wanted, n)
        sources = sources[: len(xy)]
        sources["sky"] = wcs.pixel_to_world(*xy.T).icrs
    return sources


def _rows_on_image(catalog, usable, wcs):
    """Rows of an own catalog that are injected: those on usable pixels, or all where positions are drawn."""
    if "sky" not in catalog.colnames:
        return np.arange(len(catalog))
    xy = np.stack(wcs.world_to_pixel(catalog["sky"]), axis=-1)
    has_data, _ = nearest_values(usable, xy)
    rows = np.flatnonzero(has_data)
    check_that(len(rows), "catalog", "one with sources on the image", "positions elsewhere alone")
    return rows


def _fill_prior_fluxes(sources, base, rng):
    """Draw the colors of own sources that state no flux in the prior's band."""
    missing = ~np.isfinite(sources["prior_flux"].value)
    if base.facts["prior_band"] is None or not missing.any():
        return
    if not len(base.population):
        wanted = "with fluxes in the prior's band, for no source of the field has a color"
        raise argument_error("catalog", wanted, f"{np.count_nonzero(missing)} without")
    colors = np.asarray(base.population["color"])
    drawn = colors[rng.integers(len(colors), size=np.count_nonzero(missing))]
    flux = sources["flux"][missing] * 10 ** (-0.4 * drawn)
    sources["prior_flux"][missing] = flux


def run_trial(field, injection, base, sources, image_file, number):
    """
    Inject sources, detect and measure.

    Parameters
    ----------
    field, injection, base
        As for `measure_base`, and what it returned.
    sources : `~astropy.table.QTable`
        Of `injected_sources`.
    image_file : `~miricigale.photometry.MosaicFile` or None
        An image that shows them already.
    number : int
        Of the trial, from 1.

    Returns
    -------
    rows : `~astropy.table.QTable`
        A row for each source (see `~miricigale.injection.InjectionResult`).
    table : `~astropy.table.QTable`
        The user's photometry of the field with the sources.
    """
    if not len(sources):
        measured, *_ = field.measure(
            former=None if field.has_prior else base.former, image_file=image_file
        )
        return QTable(), measured.table
    photons = {
        "covariance": base.noise_correlation,
        "rng": stream(injection.seed, "injected photons", number),
    }
    measured = field.measure(sources, base.psfs, base.former, image_file, photons)[0]
    image = measured.image
    result = measured.result
    rows = QTable({"row": sources["row"], "sky": sources["sky"].icrs})
    rows["kind"] = np.where(np.asarray(sources["profile"]) == "point", "star", "galaxy")
    xy = np.stack(image.wcs.world_to_pixel(sources["sky"]), axis=-1)
    rows["x"], rows["y"] = xy.T
    rows["flux_true"] = sources["flux"].to(FNU)
    rows["magnitude"] = ab_magnitude(sources["flux"])
    rows["prior_flux_true"] = sources["prior_flux"].to(FNU)
    for name in SHAPE:
        rows[name] = sources[name]
    _, detections = detect_sources(image, preset=injection.preset)
    fluxes = np.asarray(detections["flux"].to_value(FNU))
    former_fluxes = np.asarray(base.detections["flux"].to_value(FNU))
    partners = recovered_rows(
        detections["sky"], base.detections["sky"], former_fluxes, sources["sky"],
        sources["flux"].to_value(FNU), base.facts["fwhm"] * ANGLE,
    )  # fmt: skip
    rows["detected"] = partners >= 0
    rows["flux_detected"] = _values_of_rows(fluxes, partners) * FNU
    rows["in_prior"] = measured.rows >= 0
    for name in ("flux", "flux_err"):
        rows[name] = _values_of_rows(getattr(result, name).to_value(FNU), measured.rows) * FNU
    rows["flags"] = np.where(measured.rows >= 0, result.flags[measured.rows], 0)
    rows["template"] = np.where(measured.rows >= 0, result.template[measured.rows], "none")
    rows["recovered"] = rows["flux"] > injection.threshold * rows["flux_err"]
    at = np.stack(base.model.wcs.world_to_pixel(sources["sky"]), axis=-1)
    rows["neighbor_light"] = over_noise(base.model, at)
    rows["place"] = place_names(at, base.model.shape)
    return rows, measured.table


def place_names(xy, shape):
    """
    Name the part of an image that each position is on, of three by three.

    Parameters
    ----------
    xy : `~numpy.ndarray`, shape (n, 2)
        Pixel positions.
    shape : (int, int)
        Of the image.

    Returns
    -------
    names : str `~numpy.ndarray`, shape (n,)
        Such as ``"upper left"``, in the axes of the image.
    """
    column = np.clip((3 * (xy[:, 0] + 0.5) / shape[1]).astype(int), 0, 2)
    row = np.clip((3 * (xy[:, 1] + 0.5) / shape[0]).astype(int), 0, 2)
    return np.array(PLACES)[3 * row + column]


def _values_of_rows(values, rows):
    """Return the values of rows; NaN for those of -1."""
    labels = nans(len(rows))
    labels[rows >= 0] = np.asarray(values)[rows[rows >= 0]]
    return labels
