"""Which sources are compared and fitted, and why the others are not."""

import re
from operator import eq, ge, gt, le, lt

import astropy.units as u
import numpy as np
from astropy.table import Column, QTable
from astropy.wcs.utils import proj_plane_pixel_area, proj_plane_pixel_scales
from scipy.ndimage import uniform_filter

from miricigale.photometry import ErrorModel
from miricigale.photometry.images.arrays import nearest_values
from miricigale.utils.missing_values import floats
from miricigale.utils.named_values import rows_of
from miricigale.utils.options import check_that
from miricigale.utils.tables import Flags, error_column
from miricigale.workflow.options import of_option, require


class SampleFlags(Flags):
    """Why a source of the catalog is not in the fitted sample."""

    OUTSIDE_FIELD = 1, "Outside the pixels that all bands share."
    STAR = 2, "A star."
    NO_MODEL = 4, "No model SED could be made, and so no flux: it is on no image."
    NOT_MATCHED = 8, "Not found on the high-resolution image, or another source is nearer."
    FEW_BANDS = 16, "Detected in too few MIRI bands."
    OUTSIDE_GRID = 32, "Its redshift is outside of the grid of the fit."
    NO_REDSHIFT = 64, "A galaxy without a positive redshift, and so without a model."
    MIN_REDSHIFT = 128, "Its redshift is below [fit] min_redshift."
    MIN_MASS = 256, "Its stellar mass is below [fit] min_mass."
    MAX_CHI2 = 512, "The reduced chi2 of its input fit is above [fit] max_chi2."
    REDSHIFT_QUALITY = 1024, "Its redshift is not as [fit] redshift_quality says."


#: Keys of the cuts of [fit]: the last flags.
CUTS = tuple(flag.name.lower() for flag in SampleFlags)[-4:]
#: What is no galaxy of a field that counts, wherever it is.
NOT_COUNTED = sum(SampleFlags[key.upper()] for key in ("star", "no_model") + CUTS)
_COMPARE = {"<=": le, ">=": ge, "<": lt, ">": gt, "=": eq}


def is_sample(matched):
    """Tell which sources of a matched table no flag keeps from the fit, shape (n,)."""
    return np.asarray(matched["selection"]) == 0


def values_at(sky, wcs, plane):
    """Return values of a plane with a WCS at the pixels of positions, shape (n,); 0 outside of it."""
    return nearest_values(plane, np.stack(wcs.world_to_pixel(sky), axis=-1))[0]


def in_field(sky, images):
    """Tell whether positions, shape (n,), fall on a usable pixel of every image (with WCS and mask)."""
    usable = [values_at(sky, image.wcs, ~np.asarray(image.mask, bool)) for image in images]
    return np.all(usable, axis=0)


def mean_coverage(sky, image, n_images):
    """
    Return the number of exposures about each position, shape (n,), of the image that they were drizzled to.

    It is the mean of the plane ``n_images`` over 1 arcsec, for bad pixels and cosmic rays leave
    single pixels with fewer; 0 off the image.
    """
    pixel = float(proj_plane_pixel_scales(image.wcs)[0] * 3600)
    mean = uniform_filter(n_images.astype(np.float32), max(1, round(1.0 / pixel)), mode="constant")
    return values_at(sky, image.wcs, mean).astype(float)


def matched_errors(matched, inside, bands, *, noise=None, **options):
    """
    Measure error functions (`~miricigale.photometry.ErrorModel`) of bands, of matched sources.

    ``matched`` is of `~miricigale.evaluation.match_truth`; ``inside`` says which rows are in the field,
    and ``noise`` is that of `~miricigale.photometry.ErrorModel.from_tables` for all rows, which has the
    ``options`` ``statistic`` and ``bin_size`` too.
    """
    truth = QTable({"id": matched["id"]})
    for name in bands:
        truth[name] = matched[f"{name}_true"]
    if noise is not None:
        noise = rows_of(noise, inside)
    return ErrorModel.from_tables(
        truth[inside], matched[inside], filters=bands, noise=noise, **options
    )


def footprint_area(images, within=True):
    """Return the solid angle of the pixels that are usable in every image on one grid, as for `in_field`."""
    images = list(images)
    shapes = [image.shape for image in images]
    check_that(len(set(shapes)) == 1, "images", "on one grid", shapes)
    usable = ~np.any([image.mask for image in images], axis=0) & within
    pixel = proj_plane_pixel_area(images[0].wcs) * u.deg**2
    return (np.count_nonzero(usable) * pixel).to(u.arcmin**2)


def detected_bands(table, bands):
    """Count the bands in which each source is above five times its error."""
    return sum((table[name] > 5 * table[error_column(name)]).astype(int) for name in bands)


def good_redshifts(catalog, rules):
    """
    Tell which rows of a catalog fulfill all rules such as ``"redshift_source=spec"`` or ``"q_z<=3"``, shape (n,).

    A value that is missing fulfills none; a `ConfigError` where there is no such column or number.
    """
    good = np.ones(len(catalog), bool)
    wanted = "must be as 'column=value', '<=', '<', '>=' or '>', of a column of the catalog"
    for rule in rules:
        column, *comparison = re.split(r"\s*(<=|>=|<|>|=)\s*", rule.strip(), maxsplit=1)
        sign, limit = comparison or ("", "")
        usable = limit and column in catalog.colnames
        require(usable, "fit", "redshift_quality", wanted, f"{rule!r}; {catalog.colnames}")
        values = np.ma.asarray(getattr(catalog[column], "value", catalog[column]))
        is_text = sign == "=" and values.dtype.kind not in "iuf"
        kind = float
        if is_text:
            kind = str
        with of_option(f"[fit] redshift_quality, {rule!r}:", ValueError):
            values = np.ma.filled(values.astype(kind), kind("nan"))
            good &= _COMPARE[sign](values, kind(limit))
    return good


def cut_flags(options, catalog, truth, chi2):
    """
    Return `SampleFlags` of the galaxies that the cuts of the section ``fit`` (``options``) leave out, shape (n,).

    ``catalog`` and ``truth`` have the same sources row by row, and ``chi2`` is that of their input fits.
    """
    cuts = {
        SampleFlags.MIN_REDSHIFT: truth["redshift"] < options.min_redshift,
        SampleFlags.MIN_MASS: truth["stellar_mass"] < options.min_mass * u.Msun,
        SampleFlags.MAX_CHI2: (chi2 > options.max_chi2) & (options.max_chi2 > 0),
        SampleFlags.REDSHIFT_QUALITY: ~good_redshifts(catalog, options.redshift_quality),
    }
    flags = sum(flag * np.asarray(rows) for flag, rows in cuts.items())
    return np.where(np.asarray(truth["star"], bool), 0, flags)


def add_selection(matched, truth, bands, *, inside, min_detected, redshifts, cuts=0):
    """
    Add ``n_detected`` and ``selection`` (`SampleFlags`, 0 in the sample) to a matched table.

    ``matched`` is of `~miricigale.evaluation.match_truth` with errors from the error function,
    ``truth`` has the same sources row by row, with ``star``; ``inside`` is that of `in_field`,
    ``redshifts`` the nodes of the grid of the fit, and ``cuts`` those of `cut_flags`.
    """
    flags = np.zeros(len(matched), int) + cuts
    matched["n_detected"] = detected_bands(matched, bands)
    has_model = np.all([np.isfinite(matched[f"{name}_true"].value) for name in bands], axis=0)
    redshift = floats(truth["redshift"])
    star = np.asarray(truth["star"], bool)
    flags[~np.asarray(inside)] |= SampleFlags.OUTSIDE_FIELD
    flags[star] |= SampleFlags.STAR
    flags[~has_model] |= SampleFlags.NO_MODEL
    flags[~matched["matched"]] |= SampleFlags.NOT_MATCHED
    flags[matched["n_detected"] < min_detected] |= SampleFlags.FEW_BANDS
    outside = (redshift < redshifts[0]) | (redshift > redshifts[-1])
    flags[(redshift > 0) & outside] |= SampleFlags.OUTSIDE_GRID
    flags[~(redshift > 0) & ~star] |= SampleFlags.NO_REDSHIFT
    matched["selection"] = Column(flags, description=SampleFlags.describe())


def typical_source(sample, fitted, band):
    """
    Return the id of a source to be shown: a bright one among those nearest to redshift 1.2.

    ``fitted`` says which rows of ``sample`` have a fit; None without any.
    """
    sample = sample[np.asarray(fitted, bool)]
    if len(sample) == 0:
        return None
    distance = np.abs(np.asarray(sample["redshift"]) - 1.2)
    chosen = sample[np.argsort(distance, kind="stable")[: max(1, len(sample) // 5)]]
    order = np.argsort(chosen[band].value, kind="stable")
    return chosen["id"][order[int(0.7 * (len(chosen) - 1))]]
