"""Stages 1 and 2: catalog, input SEDs."""

import functools
import math
from pathlib import Path

import numpy as np
from astropy.table import QTable, vstack

from miricigale import fitting, sed
from miricigale.filters import Filter
from miricigale.fitting.results.pulls import without_scatter_warnings
from miricigale.photometry import YANG2021_DEPTHS
from miricigale.refdata import resources
from miricigale.refdata.lookup import fingerprint
from miricigale.scene import read_catalog
from miricigale.utils.caching import cached
from miricigale.utils.content_hash import file_sha256
from miricigale.utils.exceptions import argument_error
from miricigale.utils.missing_values import floats
from miricigale.utils.named_values import convert_values, subset
from miricigale.utils.tables import error_column
from miricigale.utils.units import ab_magnitude
from miricigale.workflow.engine.stage import LONG, stage
from miricigale.workflow.options import require
from miricigale.workflow.stages.grids import of_patch

#: Redshifts closer than this share a node of the grid of the input fit.
REDSHIFT_STEP = 0.01
#: Pivot wavelength in um beyond which bands tell dusts apart.
DUST_SHOWS = 5.0


def input_axes(kind, *, dust=False):
    """
    Return the axes of the fit of the input SEDs but redshift, of the grid ``"galaxy"`` or ``"quick"``.

    Those of Yang et al. 2021, but one value of the dust's alpha unless ``dust``: bands shorter than 5 um
    do not constrain it, and a fit would run to the edge of the grid (see `make_truth`).
    """
    preset = sed.SEDModel.yang2021_axes(kind)
    axes = subset(preset, ("tau", "age", "ebv", "alpha"))
    if not dust:
        axes["alpha"] = np.array([2.0])
    return axes


def plain_axes(axes):
    """Return plain values of a grid's axes, for hashing."""
    return convert_values(list, axes)


def fit_plan(config, _):
    """Return the axes of the final fit."""
    axes = sed.SEDModel.yang2021_axes(config.fit.axes)
    if config.fit.dust_excess:
        axes["dust_excess"] = config.fit.dust_excess
    return plain_axes(axes)


def sed_resources():
    """Return the reference data of the models: the preset takes the best libraries that there are."""
    return (*sed.SEDModel.yang2021().resources, "filters.sedpy")


def catalog_bands(catalog):
    """Return the names of the flux columns of a catalog: those with a dot in the name."""
    return [name for name in catalog.colnames if "." in name and not name.endswith("_err")]


def input_bands(catalog, max_wavelength):
    """
    Return the bands of a catalog that its SEDs are fitted to, and their longest pivot wavelength in um.

    A dict of band to whether it has a column of errors; those without end at ``max_wavelength`` (um).
    The wavelength is 0 without bands.
    """
    bands = {}
    longest = 0.0
    for name in catalog_bands(catalog):
        pivot = Filter.from_name(name).pivot.value
        has_errors = error_column(name) in catalog.colnames
        if has_errors or pivot <= max_wavelength:
            bands[name] = has_errors
            longest = max(longest, pivot)
    return bands, longest


def measured_error(catalog, name, catalog_error):
    """Return errors of a catalog's band: its own, NaN where not positive, or without any a part of the flux."""
    if error_column(name) not in catalog.colnames:
        return np.abs(catalog[name]) * catalog_error
    error = catalog[error_column(name)]
    # a flux without a positive error is treated as missing
    return np.where(error.value > 0, error.value, np.nan) * error.unit


def existing_bands(config):
    """
    Return the bands that are fitted with those that are simulated: dict of name to 5-sigma AB depth.

    The depth is None where each source has the error of the catalog.
    """
    fit = config.fit
    catalog = config.catalog
    if fit.bands:
        return dict.fromkeys(fit.bands) | dict(zip(fit.bands, fit.depths, strict=False))
    if catalog.source in resources():
        return dict(YANG2021_DEPTHS)
    bands = dict.fromkeys(catalog_bands(study_catalog(catalog)))
    for name in config.exposures.filters:
        bands.pop(name, None)
    return bands


def shows_dust(catalog, options):
    """Tell whether each source has a flux beyond `DUST_SHOWS` in a band that its SED is fitted to, shape (n,)."""
    shown = np.zeros(len(catalog), bool)
    for name in input_bands(catalog, options.max_wavelength)[0]:
        if Filter.from_name(name).pivot.value > DUST_SHOWS:
            error = measured_error(catalog, name, options.catalog_error)
            shown |= np.isfinite(catalog[name] + error)
    return shown


def study_catalog(options):
    """Return the catalog of the section ``catalog`` of a configuration."""
    path = Path(options.source).expanduser()
    state = None
    if path.is_file():
        stat = path.stat()
        state = (stat.st_mtime_ns, stat.st_size)
    return _catalog(options, state)


@cached(maxsize=2, copies=True)
def _catalog(options, state):
    """Return the catalog, read and warned of once; ``state`` changes with a file."""
    catalog = read_catalog(
        options.source,
        columns=dict(pair.split("=") for pair in options.columns),
        units=dict(pair.split("=") for pair in options.units),
        survey=options.survey or None,
        missing=options.missing,
        factor=options.factor or None,
    )
    has_redshifts = np.any(catalog["redshift"] > 0)
    require(has_redshifts, "catalog", "source", "must have a column 'redshift'", catalog.colnames)
    return catalog


def _input_plan(config, _):
    """Return axes of the input fit, and the bands whose errors a user's catalog has, for hashing."""
    plan = plain_axes(input_axes(config.sed.axes))
    if config.catalog.source not in resources():
        bands, _ = input_bands(study_catalog(config.catalog), config.sed.max_wavelength)
        plan["own errors"] = [name for name, errors in bands.items() if errors]
    return plan


def _content(source):
    """Return the checksum of a catalog: the content of a user's file may change."""
    if source in resources():
        return fingerprint(source)
    return file_sha256(Path(source).expanduser())


@stage(
    "catalog",
    "catalog",
    sections=("catalog", "highres.filter"),
    plan=lambda config, _: _content(config.catalog.source),
)
def make_catalog(context, _):
    """Stage 1: read the catalog and cut it at the faint limit."""
    options = context.config.catalog
    catalog = study_catalog(options)
    sample = bright_sources(catalog, options, context.config.highres.filter)
    sample.meta["n_sources"] = len(catalog)
    context.save_rows("catalog", sample)


def bright_sources(catalog, options, prior):
    """Return sources up to ``mag_limit`` in the column ``mag_column`` of the options, or in the band ``prior``."""
    column = options.mag_column
    if column in catalog.colnames:
        magnitudes = catalog[column]
        magnitudes = np.asarray(getattr(magnitudes, "value", magnitudes), float)
    elif prior in catalog.colnames:
        column = prior
        magnitudes = ab_magnitude(catalog[prior])
    else:
        wanted = f"one of {catalog.colnames}, or the catalog must have fluxes in {prior}"
        raise argument_error("mag_column", wanted, repr(column))
    # a source without a magnitude is kept; the report says why it is not fitted
    sample = catalog[~(magnitudes > options.mag_limit)]
    good = np.any(magnitudes <= options.mag_limit)
    wanted = f"leaves none of the {len(catalog)} sources, {column} of {np.nanmin(magnitudes):.2f} and more"
    require(good, "catalog", "mag_limit", wanted, options.mag_limit)
    return sample


def pieces(n):
    """Return the names of the pieces that n sources are fitted in; a single empty one if these are few."""
    if n <= LONG:
        return [""]
    return [f"{k:04d}" for k in range(math.ceil(n / LONG))]


def catalog_pieces(config):
    """Return the names of the pieces that the sources of the study's catalog are fitted in."""
    catalog = study_catalog(config.catalog)
    return pieces(len(bright_sources(catalog, config.catalog, config.highres.filter)))


def sources_memory(config, _):
    """
    Estimate how many bytes a process takes that has the tables of all sources.

    Measured: 1.2 GB at most of a field of one pointing, and from 12,000 to 100,000 sources 3.6 kB for each.
    """
    return 1_200_000_000 + 3_600 * LONG * len(catalog_pieces(config))


def piece_rows(piece):
    """Return the rows of a piece, a slice."""
    if not piece:
        return slice(None)
    return slice(LONG * int(piece), LONG * (int(piece) + 1))


@stage(
    "seds",
    "input SEDs",
    version=2,
    needs=("catalog",),
    sections=("sed.axes", "sed.catalog_error", "sed.max_wavelength", "fit.model_error"),
    resources=sed_resources,
    units=catalog_pieces,
    plan=_input_plan,
)
def fit_inputs(context, piece):
    """Stage 2: fit a galaxy grid to the catalog's fluxes at the known redshifts."""
    config = context.config
    catalog = context.table("catalog.ecsv")[piece_rows(piece)]
    results = fit_seds(
        catalog,
        config.sed,
        model_error=config.fit.model_error,
        progress_bar=context.progress_bar,
    )
    context.save_result(f"{of_patch('input_seds', piece)}.fits", results)


class FitPieces:
    """
    Fits of the sources of a catalog, of which one piece is in memory.

    Parameters
    ----------
    context : `~miricigale.workflow.Context`
        Of a stage, or of none.
    name : str
        Name of the products, without that of the piece.
    n : int
        Number of sources of the catalog.
    """

    def __init__(self, context, name, n):
        self._paths = [context.path(f"{of_patch(name, piece)}.fits") for piece in pieces(n)]
        self._read = functools.lru_cache(maxsize=1)(fitting.FitResults.read)
        #: Called with the name of an array, such as ``"chi2"``: that of all sources.
        self.of = cached(self._joined)

    @property
    def first(self):
        """The first piece (`~miricigale.fitting.FitResults`)."""
        return self._read(self._paths[0])

    def _joined(self, name):
        return np.concatenate([getattr(self._read(path), name) for path in self._paths])

    def cdf(self, name):
        """As of `~miricigale.fitting.FitResults`, of all sources."""
        parts = [self._read(path).cdf(name) for path in self._paths]
        # edges of cells, or levels of quantiles, are those of all
        return tuple(
            arrays[0] if arrays[0].ndim == 1 else np.concatenate(arrays)
            for arrays in zip(*parts, strict=True)
        )

    def to_table(self):
        """As of `~miricigale.fitting.FitResults`, of all sources."""
        tables = [self._read(path).to_table() for path in self._paths]
        return vstack(tables, metadata_conflicts="silent")

    #: Sources by id, as of `~miricigale.fitting.FitResults`.
    loc = property(lambda self: self)

    @functools.cached_property
    def _path_of(self):
        paths = {}
        for path in self._paths:
            paths |= dict.fromkeys(self._read(path).ids.tolist(), path)
        return paths

    def __getitem__(self, key):
        # ids are Python's numbers and texts
        key = getattr(key, "item", lambda: key)()
        return self._read(self._path_of[key]).loc[key]


def fit_seds(catalog, options, *, model_error, executor=None, progress_bar=False):
    """
    Fit a galaxy grid to the fluxes of a catalog at its redshifts.

    ``options`` has ``axes`` (as `input_axes`), ``catalog_error``, the relative error of the bands without a
    column of errors, and ``max_wavelength`` (um), up to which these are fitted.
    """
    bands, longest = input_bands(catalog, options.max_wavelength)
    require(
        bands, "sed", "max_wavelength", "leaves none of the catalog's bands", options.max_wavelength
    )
    photometry = QTable({"id": catalog["id"]})
    photometry["redshift"] = floats(catalog["redshift"])
    for name in bands:
        photometry[name] = catalog[name]
        photometry[error_column(name)] = measured_error(catalog, name, options.catalog_error)
    nodes = np.unique(np.round(photometry["redshift"] / REDSHIFT_STEP) * REDSHIFT_STEP)
    axes = input_axes(options.axes, dust=longest > DUST_SHOWS)
    settings = fitting.GridSettings(redshift_tolerance=REDSHIFT_STEP, interpolate=0)
    fitter = fitting.BayesFitter(
        sed.SEDModel.yang2021(agn=False),
        list(bands),
        axes=axes | {"redshift": nodes[nodes > 0]},
        model_error=model_error,
        settings=settings,
        # a single band is enough for a flux
        n_bands_min=1,
    )
    options = {"executor": executor, "progress_bar": progress_bar}
    with without_scatter_warnings():
        # real galaxies with an AGN, which this chain lacks, scatter; no option of a study changes that
        return fitter.fit(photometry, redshift="redshift", **options)
