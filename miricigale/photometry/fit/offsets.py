"""Offsets of an image against a catalog: source by source, and as a smooth map."""

import numpy as np
import scipy.optimize
from astropy.stats import gaussian_sigma_to_fwhm
from astropy.table import QTable

from miricigale.photometry._core.stamps import offset_sums
from miricigale.photometry.fit.template_fit import TemplateFit, row_snr
from miricigale.photometry.images.arrays import lengths
from miricigale.photometry.images.fields import SmoothField, legendre_terms, n_terms
from miricigale.photometry.images.flags import ForcedFlags
from miricigale.utils.arrays import quiet_division
from miricigale.utils.exceptions import PhotometryWarning, warn
from miricigale.utils.parallel import chunks
from miricigale.utils.units import ANGLE
from miricigale.utils.values import value_class

#: Least signal-to-noise of sources whose offsets are measured.
BRIGHT_SNR = 20.0

#: Largest light of neighbors relative to a source's own, both below its template.
MAX_NEIGHBOR_LIGHT = 0.2

#: Least number of sources for each term of the map.
MIN_SOURCES = 3

#: Least error (pixels) of a measured offset.
OFFSET_FLOOR = 0.01

#: Distance from the map, in errors, beyond which a source does not count.
_CLIP = 4.0

#: Change of offsets (pixels) at which they are done.
OFFSETS_DONE = 5e-3

#: How often sources are moved by their own offsets, and how far at most in rms widths of the PSF; offset of all,
#: in full widths at half maximum, of which there is a warning.
OFFSET_PASSES = 3
MAX_OFFSET = 0.3
COMMON_OFFSET = 0.05


@value_class
class OffsetMap:
    """
    Where an image shows sources, less where the catalog has them.

    Attributes
    ----------
    sources : `~astropy.table.QTable`
        The sources it was measured on: ``id``, ``sky``, ``x_centroid``, ``y_centroid`` (pixels),
        ``dx``, ``dy`` (arcsec along the image's axes), their error ``offset_err``, and ``used``,
        False for those that are too far off.
    field : `~miricigale.photometry.SmoothField`
        (dx, dy) in arcsec.
    wcs : `~astropy.wcs.WCS`
        The image's.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.coordinates import SkyCoord
    >>> from astropy.table import QTable
    >>> import astropy.units as u
    >>> from miricigale.instrument import north_up_wcs
    >>> from miricigale.photometry import OffsetMap, SmoothField
    >>> sky = SkyCoord(53.1, -27.8, unit="deg")
    >>> wcs = north_up_wcs(sky, 0.1 * u.arcsec, (101, 101))
    >>> field = SmoothField(np.array([[0.02, -0.01], [0.005, 0], [0, 0]]), (101, 101), 1)
    >>> offsets = OffsetMap(QTable({"used": [True]}), field, wcs)
    >>> offsets.evaluate(sky).round(3)
    <Quantity [ 0.02, -0.01] arcsec>
    """

    sources: QTable
    field: SmoothField
    wcs: object

    def __repr__(self):
        n = int(np.count_nonzero(self.sources["used"]))
        return f"<OffsetMap of order {self.field.order}, {n} of {len(self.sources)} sources>"

    def evaluate(self, sky):
        """
        Return offsets (dx, dy) in arcsec at positions.

        Parameters
        ----------
        sky : `~astropy.coordinates.SkyCoord`
            Positions.

        Returns
        -------
        offset : `~astropy.units.Quantity`, shape (..., 2)
            (dx, dy) along the image's axes, in arcsec.
        """
        x, y = self.wcs.world_to_pixel(sky)
        return self.field(x, y) * ANGLE

    def plot(self, ax=None, **kwargs):
        """
        Draw the measured offsets over those of the map, as arrows.

        Parameters
        ----------
        ax : `~matplotlib.axes.Axes`, optional
            Where to draw.
        **kwargs
            Passed to `~miricigale.plotting.images.plot_offsets`.

        Returns
        -------
        ax : `~matplotlib.axes.Axes`
        """
        from miricigale.plotting.images import plot_offsets

        table = self.sources
        offset = np.stack([table["dx"].value, table["dy"].value], axis=1)
        xy = np.stack([table["x_centroid"], table["y_centroid"]], axis=1)
        return plot_offsets(xy, offset, self.field, used=np.asarray(table["used"]), ax=ax, **kwargs)


def source_offsets(fit, flux, residual, model, rows):
    """
    Measure the offsets of sources from their templates.

    Parameters
    ----------
    fit : `TemplateFit` or `~miricigale.photometry.fit.exposure_fit.ExposurePart`
        The fit, or an exposure of one.
    flux : `~numpy.ndarray`, shape (n,)
        Fluxes of the rows of its bank, uJy.
    residual, model : `~numpy.ndarray`, shape (ny, nx)
        What it left, and the model of all sources.
    rows : int `~numpy.ndarray`, shape (k,), sorted
        Rows of the bank that were fitted.

    Returns
    -------
    step : `~numpy.ndarray`, shape (k, 2)
        (dx, dy) in pixels; NaN where they cannot be measured.
    error, others : `~numpy.ndarray`, shape (k,)
        1 sigma along an axis, for white noise of the size of the residuals; light of others below the
        template, over the template's own.

    Notes
    -----
    The template times its flux and the derivatives of that by x and y are fitted to the residual within
    two full widths at half maximum of the PSF. Derivatives are differences of neighboring pixels:
    steps are right to some tens of percent, so that they must be repeated.
    """
    out = np.empty((len(rows), 18))
    half = max(3, int(np.ceil(2 * 2.3548 * fit.psf_width)))
    at = np.rint(fit.bank.xy[rows]).astype(int)
    for block in fit.bank.blocks():
        low, high = np.searchsorted(rows, [block.first, block.last])

        def measure(part, block=block, low=low):
            part = slice(low + part.start, low + part.stop)
            block_rows = rows[part] - block.first
            light = (
                block.values,
                block.box[block_rows],
                block.start[block_rows],
                flux[rows[part]],
            )
            offset_sums(*light, at[part], half, model, residual, fit.inverse_sigma, out[part])

        fit.bank.map(measure, chunks(high - low, 256))
    products = out[:, :16].reshape(-1, 4, 4)
    (neighbor_light, n_pixels) = out[:, 16:].T
    # normal equations of light and steps along x and y, scaled to a unit diagonal
    scale = np.sqrt(products.diagonal(axis1=1, axis2=2))[:, :3]
    with quiet_division():
        normal = products[:, :3, :3] / (scale[:, :, None] * scale[:, None])
        normal[~(np.linalg.det(normal) > 1e-12)] = np.nan
        inverse = np.linalg.inv(normal)
        projection = products[:, :3, 3] / scale
        step = np.einsum("kij,kj->ki", inverse, projection)
        # chi^2 that remains sets the scale of the errors
        chi2_left = np.maximum(products[:, 3, 3] - np.sum(step * projection, axis=1), 0)
        # variance of a step: the mean of both axes
        variance = np.mean((inverse.diagonal(axis1=1, axis2=2) / scale**2)[:, 1:], axis=1)
        error = np.sqrt(variance * chi2_left / np.maximum(n_pixels - 3, 1))
        return (step / scale)[:, 1:], error, neighbor_light / scale[:, 0] ** 2


def fit_offsets(arrays, bank, settings, catalog):
    """
    Fit an image with templates at positions that follow a smooth map of offsets (a `TemplateFit`).

    Where too few bright isolated sources are left, with one shift of the image, and a warning. Parameters
    are those of `~miricigale.photometry.fit.fit_loop.fit_image`.
    """
    fit = TemplateFit(arrays, bank, settings)
    moved = 0.0
    xy = catalog.xy[catalog.near_rows]
    limit = settings.max_shift.value / fit.scale
    for _ in range(6):
        # offsets of bright sources, those already applied included
        rows, offset, error = _bright_offsets(fit, catalog, moved)
        good = lengths(offset) < limit
        order = settings.offset_order
        while order >= 0 and np.count_nonzero(good) < MIN_SOURCES * n_terms(order):
            order -= 1
        if order < 0:
            _too_few(0, good, "one shift is fitted to all sources instead")
            return TemplateFit(arrays, bank, settings, search=True)
        member = fit.bank.order[rows]
        field, is_used = _robust_field(xy[member], offset, error, good, arrays.flux.shape, order)
        x, y = xy.T
        change = field(x, y) - moved
        if np.abs(change).max(initial=0.0) < OFFSETS_DONE:
            break
        moved = moved + change
        fit.bank.forget()
        fit = TemplateFit(arrays, bank, settings, moved=moved)
    if order < settings.offset_order:
        _too_few(settings.offset_order, good, f"order {order} is taken")
    sources = catalog.near_rows[member]
    # the sources of the map, in arcsec
    table = QTable({"id": catalog.id[sources], "sky": catalog.sky[sources]})
    table["x_centroid"], table["y_centroid"] = xy[member].T
    table["dx"], table["dy"] = offset.T * fit.scale * ANGLE
    table["offset_err"] = error * fit.scale * ANGLE
    table["used"] = is_used
    in_arcsec = SmoothField(field.coefficients * fit.scale, field.shape, order)
    fit.offset_map = OffsetMap(table, in_arcsec, arrays.wcs)
    return fit


def _too_few(order, good, instead):
    """Warn of an offset map with fewer sources than it needs."""
    needed = f"needs {MIN_SOURCES * n_terms(order)} bright isolated sources within 'max_shift'"
    msg = f"an offset map of order {order} {needed}, got {np.count_nonzero(good)}: {instead}"
    warn(msg, PhotometryWarning)


def settled(fit, bank, catalog):
    """
    Move bright isolated sources to where the image shows them, and fit again.

    Registration and colors move sources against each other by some milliarcseconds, which bright ones show. Each
    goes by its own offset, as far as offsets scatter beyond their errors; nothing is done if they do not, or if
    what all have in common is large enough for a warning: ``max_shift`` is for that.

    Parameters
    ----------
    fit, bank
        A `TemplateFit`, and the templates before they were moved.
    catalog : `~miricigale.photometry.fit.result_table.CatalogRows`
        The catalog; ``near_rows`` lists the bank's sources.

    Returns
    -------
    fit : `TemplateFit`
        Its ``source_shifts``, (k, 2), are what each source was moved by (pixels), None if nothing was done.
    """
    xy = catalog.xy[catalog.near_rows]
    shape = fit.arrays.flux.shape
    common = np.array(fit.displacement(xy))
    source_shifts = np.zeros_like(common)
    first = fit
    for _ in range(OFFSET_PASSES):
        rows, offset, error = _bright_offsets(fit, catalog, common + source_shifts)
        deviation = offset - common[fit.bank.order[rows]]
        # what is farther off is another source
        good = lengths(deviation) < MAX_OFFSET * fit.psf_width
        member = fit.bank.order[rows][good]
        deviation = deviation[good]
        error = error[good]
        if len(member) <= MIN_SOURCES:
            break
        # the largest order, up to 3, that the sources allow
        order = 0
        while order < 3 and len(member) > MIN_SOURCES**2 * n_terms(order + 1):
            order += 1
        smooth, _ = _robust_field(xy[member], deviation, error, good[good], shape, order)
        x, y = xy[member].T
        smooth = smooth(x, y)
        if np.abs(smooth).max() > COMMON_OFFSET * gaussian_sigma_to_fwhm * fit.psf_width:
            break
        shrunk = shrunk_offsets(deviation, error)
        if shrunk is None:
            break
        new = np.zeros_like(source_shifts)
        new[member] = shrunk
        change = np.abs(new - source_shifts).max()
        source_shifts = new
        fit = TemplateFit(
            fit.arrays,
            bank,
            fit.settings,
            moved=common + source_shifts,
            like=fit.bank,
            search=False,
        )
        fit.shift = first.shift
        fit.offset_map = first.offset_map
        fit.source_shifts = source_shifts
        if change < OFFSETS_DONE:
            break
    if fit is not first and first.shift is not None:
        fit.include_shift(first.shift)
    return fit


def shrunk_offsets(offsets, error):
    """Shrink offsets, (k, 2), by the part of their scatter that is noise; None if they scatter by no more."""
    scatter = excess_variance(lengths(offsets), error)
    if scatter <= OFFSET_FLOOR**2:
        return None
    return offsets * (scatter / (scatter + error**2))[:, None]


def excess_variance(distance, error):
    """Variance along an axis of distances in a plane, beyond that of their errors; it may be negative."""
    # of two normal errors the median distance is 1.18
    return (np.median(distance) / 1.1774) ** 2 - np.median(error) ** 2


def _bright_offsets(fit, catalog, moved):
    """Measure offsets of bright isolated sources from the catalog: rows, offsets (pixels) and errors."""
    if not len(fit.rows):
        return np.empty(0, int), np.empty((0, 2)), np.empty(0)
    moved = np.broadcast_to(moved, (len(fit.bank.order), 2))
    model = fit.model()
    residual = fit.residual(model)
    source = catalog.near_rows[fit.bank.order]
    bad = int(ForcedFlags.SHARED_SEGMENT | ForcedFlags.NOISY_SEGMENT)
    is_whole = (fit.light > 0.9).all(axis=1) & (catalog.flags[source] & bad == 0)
    rows = np.flatnonzero(is_whole & ~fit.noisy & (row_snr(fit) > BRIGHT_SNR))
    step, error, neighbors = source_offsets(fit, fit.flux, residual, model, rows)
    # where residuals are larger than the stated noise the latter overstates the significance
    keep = (
        np.isfinite(error)
        & (neighbors < MAX_NEIGHBOR_LIGHT)
        & (error < fit.psf_width / BRIGHT_SNR * 2)
    )
    rows = rows[keep]
    offset = moved[fit.bank.order[rows]] + step[keep]
    return rows, offset, np.hypot(error[keep], OFFSET_FLOOR)


def _robust_field(xy, offset, error, good, shape, order):
    """Fit a polynomial through offsets that some of the sources do not follow; return it and which ones do."""
    x, y = xy.T
    terms = np.stack(legendre_terms(x, y, shape, order), axis=-1)

    def weighted(rows, total):
        return terms[rows] / total[rows, None], offset[rows] / total[rows, None]

    a, b = weighted(good, error)
    start = np.linalg.lstsq(a, b)[0]

    def misfit(flat):
        return (a @ flat.reshape(start.shape) - b).ravel()

    # robust against sources that moved
    solution = scipy.optimize.least_squares(misfit, start.ravel(), loss="soft_l1")
    coefficients = solution.x.reshape(start.shape)
    for _ in range(5):
        distance = lengths(offset - terms @ coefficients)
        # galaxies differ from band to band: what scatters beyond the errors is added to them
        scatter = excess_variance(distance[good], error[good])
        total = np.hypot(error, np.sqrt(max(scatter, 0.0)))
        is_used = good & (distance < _CLIP * total)
        matrix, right = weighted(is_used, total)
        coefficients = np.linalg.lstsq(matrix, right)[0]
    return SmoothField(coefficients, shape, order), is_used
