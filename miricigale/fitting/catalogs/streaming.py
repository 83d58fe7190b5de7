"""Fits of catalogs larger than memory: from file to file, in pieces, and resumed by a later call."""

import contextlib
import importlib.metadata
import json
import logging
import os
import sqlite3
import threading
from collections import Counter, deque
from functools import partial

import numpy as np

from miricigale.filters.catalog_files import (
    catalog_messages,
    codes_of,
    count_negative_errors,
    negative_error_message,
    without_codes_of,
)
from miricigale.filters.photometry_table import unit_of_fluxes
from miricigale.fitting.catalogs.catalog_rows import give_units, open_catalog
from miricigale.fitting.data.fitted_bands import bands_with_errors, warn_of_unfitted
from miricigale.fitting.data.likelihood import HIGH_CHI2, flux_columns, unused_bands
from miricigale.fitting.data.nuclei import nucleus_columns
from miricigale.fitting.fitter import BayesFitter
from miricigale.fitting.results.io import (
    FORMAT,
    FitFolder,
    open_results,
    part_columns,
    part_ids,
    part_name,
    write_part,
)
from miricigale.fitting.results.pulls import warn_of_pulls
from miricigale.fitting.results.result_tables import reduced_chi2
from miricigale.fitting.results.sample_flags import chi2_limit, chi2_step, warn_of_unconverged
from miricigale.utils.content_hash import content_sha256
from miricigale.utils.exceptions import (
    CatalogWarning,
    FitWarning,
    OtherResultsError,
    argument_error,
    warn,
)
from miricigale.utils.files import PARTIAL
from miricigale.utils.folder import FileFolder
from miricigale.utils.ids import Duplicates
from miricigale.utils.meta import package_version, plain_value, undated
from miricigale.utils.named_values import convert_values
from miricigale.utils.options import check_data, check_that, check_type
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.progress import progress
from miricigale.utils.random import check_seed
from miricigale.utils.tables import ascii_ids, read_ids, require_columns

logger = logging.getLogger(__name__)

#: Astropy's warnings are turned off for a process, not for a thread.
_WRITING = threading.Lock()
_PACKAGES = ("numpy", "numba", "astropy")


@takes_other_keywords
def fit_file(
    fitter,
    path_in,
    path_out,
    *,
    chunk_rows=1000,
    redshift=None,
    redshift_prior=None,
    pairs=None,
    seed=None,
    flux_unit=None,
    catalog_map=None,
    hdu=None,
    executor=None,
    progress_bar=False,
    resume=True,
):
    """
    Fit a catalog on disk and write the results to disk, a piece at a time.

    The results are those of `BayesFitter.fit` for the whole catalog, number for number; only
    one piece is in memory. They lie in a folder: ``part-00000.fits`` and so on, each a file that
    `FitResults.read` reads, and ``manifest.json``, which says of what fit they are. Their table is
    that of `FitResultsFiles.to_table` and `FitResultsFiles.write_table`. A call that was stopped
    resumes with the same arguments and fits what is missing.

    Parameters
    ----------
    fitter : `BayesFitter`
        The fitter. (Of a sampler, the cells of a redshift axis that is not the same for all objects
        are those of each part.)
    path_in : path-like
        The catalog: FITS with a binary table or parquet, by pieces; or ECSV, CSV, VOTable and plain text, which
        are in memory as a whole. Its columns are as `BayesFitter.fit` wants them, or become so by
        ``catalog_map``.
    path_out : path-like
        The folder; made if it is not there.
    chunk_rows : int, optional
        Rows of a piece and so of a part file, which is what a stopped fit loses at most: a minute of work between
        the nodes of the survey's grid. 10,000 objects of a grid of 65 redshifts and 11 AGN fractions take some
        100 MB of results.
    redshift, redshift_prior, pairs : optional
        As for `BayesFitter.fit`, for all rows of the catalog; densities of redshift may be the name
        of a column that holds them.
    seed : int, optional
        As for `BayesFitter.fit`. A sampler needs one, so that a later call can resume it.
    flux_unit : unit-like, optional
        Unit of flux columns and their errors where the file gives none, as CSV does.
    catalog_map : `~miricigale.filters.CatalogMap`, str or path-like, optional
        Names, units and missing values of the catalog, as for
        `~miricigale.filters.read_catalog_photometry`.
    hdu : int or str, optional
        Extension of a FITS file; the only table by default.
    executor : `concurrent.futures.Executor`, optional
        Fits parts of each piece at the same time; the answer is the same. Workers of dask make whole pieces, and
        write them, where there are as many pieces as workers or more: they must see the folder by the same path.
        A piece whose worker is lost is made by another one.
    progress_bar : bool, optional
        Whether to show one.
    resume : bool, optional
        Whether to keep the parts that are there. Parts of another fit (other settings, grid,
        catalog or ``chunk_rows``) are refused. False replaces what an earlier call wrote.

    Returns
    -------
    results : `FitResultsFiles`
        All parts.

    Warns
    -----
    `~miricigale.utils.exceptions.CatalogWarning`
        What `BayesFitter.fit` warns of, once, of scatter by the first part. Numbers that stand for no value are
        counted in the whole file before anything is fitted.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the catalog cannot be read by rows, the folder holds something else, or another
        process fits into it: then the message says which file to remove if that is gone.
    `~miricigale.utils.exceptions.OtherResultsError`
        If the folder holds parts of another fit.
    ValueError
        What `BayesFitter.fit` raises; if an id is no ASCII text, which FITS cannot hold,
        before anything is fitted. A note names the rows.

    Examples
    --------
    >>> from miricigale.fitting import fit_file
    >>> results = fit_file(fitter, "catalog.fits", "fits", redshift="z_spec")  # doctest: +SKIP
    >>> results.write_table("table.fits")  # doctest: +SKIP
    """
    check_type(fitter, "fitter", BayesFitter, "a BayesFitter")
    check_type(path_in, "path_in", (str, os.PathLike), "the path of a catalog")
    unit = None
    if flux_unit is not None:
        unit = unit_of_fluxes(flux_unit, "flux_unit")
    rows = open_catalog(path_in, chunk_rows, hdu=hdu, catalog_map=catalog_map, flux_unit=unit)
    if fitter.waits:
        bands = bands_with_errors(rows.colnames, "path_in")
        warn_of_unfitted(unused_bands(rows.chunk(0), bands))
        fitter = fitter.for_bands(bands)
    if fitter.engine != "grid":
        check_that(seed is not None, "seed", "given for a sampler, to resume it", "None")
        seed = check_seed(seed)
    else:
        # the same fit, in whatever order they are given
        pairs = fitter.backend.check_pairs(pairs)
    options = {"redshift": redshift, "redshift_prior": redshift_prior, "pairs": pairs}
    mapped = hasattr(rows, "map")
    if not mapped:
        pieces = (codes_of(rows.chunk(i), fitter.bands) for i in range(rows.n_chunks))
        messages = list(catalog_messages((), pieces))
    else:
        messages = rows.messages()
    for text in messages:
        warn(f"{rows.path.name}: {text}", CatalogWarning)
    named = list(fitter.bands) + list(nucleus_columns(rows.colnames))
    fluxes = set(flux_columns(named))
    take = row_pieces(rows, options, unit, fluxes, fitter.bands)
    kinds = set()
    n_negative = Counter()
    for i in range(rows.n_chunks):
        with _noted(rows, i):
            chunk = rows.chunk(i)
            n_negative.update(count_negative_errors(chunk, fitter.filters or fitter.bands))
            ids = ascii_ids(read_ids(chunk), "photometry")
            if ids.size:
                kinds.add(ids.dtype.kind)
            got = "whole numbers in earlier rows, and others here"
            check_that(len(kinds) < 2, "photometry", "a table with ids of one kind", got)
    text = negative_error_message(n_negative)
    if text:
        warn(f"{rows.path.name}: {text}", FitWarning)
    catalog_settings = {"hdu": hdu, "flux_unit": None}
    if unit is not None:
        catalog_settings["flux_unit"] = unit.to_string()
    if mapped:
        catalog_settings["map"] = rows.map.settings()
    job = _job(fitter, rows, options | {"seed": seed}, catalog_settings)
    with FitFolder(path_out) as folder:
        _begin(folder, job, resume)
        _fit_parts(fitter, rows, take, folder, seed, executor, progress_bar)
        # the limit depends on the whole sample
        folder.facts["chi2_limit"] = _chi2_limit(folder, rows.n_chunks)
        folder.write_manifest()
        _warn_of_unconverged(fitter, folder, rows.n_chunks)
    return open_results(path_out, model=fitter.model, curves=fitter.curves)


def _columns_of_parts(folder, n_parts, *names):
    """Read columns of all parts together: an array for each name."""
    parts = [part_columns(folder.path(part_name(i)), *names) for i in range(n_parts)]
    return map(np.concatenate, zip(*parts, strict=True))


def _chi2_limit(folder, n_parts):
    """Compute the reduced chi2 above which a fit is poor, from all parts."""
    chi2 = reduced_chi2(*_columns_of_parts(folder, n_parts, "chi2", "n_bands"))
    return chi2_limit(chi2[:: chi2_step(len(chi2))])


def _warn_of_unconverged(fitter, folder, n_parts):
    """Warn of fits that are not converged, of all parts together."""
    flags, chi2 = _columns_of_parts(folder, n_parts, "flags", "chi2")
    warn_of_unconverged(flags, np.isfinite(chi2), fitter.settings().get("interpolate"))


@contextlib.contextmanager
def _noted(rows, i):
    """Add the rows of a piece to an error about it."""
    try:
        yield
    except ValueError as err:
        start, stop = rows.span(i)
        err.add_note(f"in rows {start} to {stop - 1} of {rows.path}")
        raise


def _fit_parts(fitter, rows, take, folder, seed, executor, progress_bar):
    """Fit the pieces whose parts are not there, and write them."""
    n_new = 0
    waiting = deque()
    duplicates = Duplicates()

    def finish(i, part):
        products, n_rows, n_fitted = part
        name = part_name(i)
        problem = "was written by a worker to a folder that cannot be seen from here"
        check_data(folder.path(name).is_file(), folder.path(name), problem)
        folder.finish(name, "", products, rows=n_rows, fitted=n_fitted)
        bar.update(n_rows)

    def collect(n_allowed):
        while len(waiting) > n_allowed:
            i, future = waiting.popleft()
            with _noted(rows, i):
                finish(i, future.result())

    with (
        progress(show=progress_bar, total=rows.n_rows, desc="fit", unit="obj") as bar,
        _seen_ids(folder) as seen_before,
        _workers(fitter, folder, rows.n_chunks, executor) as (submit, n_waiting),
    ):
        for i in range(rows.n_chunks):
            name = part_name(i)
            if name in folder.records and folder.is_whole(name):
                ids = part_ids(folder.path(name))
                duplicates.add(ids, seen_before(ids))
                bar.update(len(ids))
                continue
            if name in folder.records:
                logger.warning("%s is missing or damaged and is made again", folder.path(name))
            with _noted(rows, i):
                table, options = take(i)
                ids = read_ids(table)
                repeated = seen_before(ids)
                duplicates.add(ids, repeated)
                options |= {"seed": seed, "repeated": repeated}
                if n_new and submit:
                    waiting.append((i, submit(name, table, options)))
                else:
                    if not n_new:
                        # what the first piece warns of holds for all pieces
                        fitter._warn_of_bands(table)
                    results = fitter._fit_part(table, **options, parallel={"executor": executor})
                    if not n_new:
                        warn_of_pulls(results)
                    finish(i, _save_part(folder, name, results))
            n_new += 1
            # only pieces that workers are busy with stay in memory
            collect(n_waiting)
        collect(0)
    duplicates.warn(rows.path.name)
    logger.info("%s: %d parts, %d of them new", folder.folder, rows.n_chunks, n_new)


@contextlib.contextmanager
def _workers(fitter, folder, n_chunks, executor):
    """
    Yield a function that sends a piece to a worker of dask, and the largest number of pieces to send.

    None if there are fewer pieces than workers.
    """
    # dask's executor has no public way to its client
    client = getattr(executor, "_client", None)
    n_workers = 0
    if client is not None:
        n_workers = sum(client.nthreads().values())
    if not 0 < n_workers <= n_chunks:
        yield None, 0
        return
    # optional
    from miricigale.utils.dask_workers import call_kept, kept_by_workers

    place = FileFolder(folder.folder.absolute())
    with kept_by_workers(client, partial(_make_part, fitter, place)) as name:
        yield partial(executor.submit, call_kept, name), 2 * n_workers


def _make_part(fitter, folder, name, table, options):
    """Fit a piece and write it, on a worker."""
    return _save_part(folder, name, fitter._fit_part(table, **options, parallel={}))


def _save_part(folder, name, results):
    """Write a part; return its record for the manifest, its rows, and how many were fitted."""
    # the same bytes, whenever they and the grid are made
    results = results._changed(meta=undated(results.meta))
    with _WRITING:
        folder.save(name, partial(write_part, results))
    return {name: folder.describe(name)}, len(results), int(np.count_nonzero(results.fitted))


@contextlib.contextmanager
def _seen_ids(folder):
    """Open a function of ids that says which of them occurred in earlier calls; they are kept on disk."""
    path = folder.folder.absolute() / f"{PARTIAL}ids"
    try:
        # the folder is locked, and its file system may know no locks of parts of files
        place = f"{path.as_uri()}?nolock=1"
        with contextlib.closing(sqlite3.connect(place, uri=True, isolation_level=None)) as database:

            def seen_before(ids):
                keys = [(_key(value),) for value in ids.tolist()]
                select = "SELECT 1 FROM seen WHERE id = ?"
                rows = [database.execute(select, key).fetchone() for key in keys]
                database.executemany("INSERT OR IGNORE INTO seen VALUES (?)", keys)
                return np.array([row is not None for row in rows], dtype=bool)

            # nothing is read by a later process; 64 MB of them are in memory
            for pragma in ("journal_mode = OFF", "synchronous = OFF", "cache_size = -64000"):
                database.execute(f"PRAGMA {pragma}")
            database.execute("BEGIN")
            database.execute("CREATE TABLE seen (id PRIMARY KEY) WITHOUT ROWID")
            yield seen_before
    except sqlite3.Error as err:
        msg = f"{path} could not be written: {err}"
        raise OSError(msg) from err
    finally:
        path.unlink(missing_ok=True)


def _key(value):
    """Turn an id into a key of the database: all NaN are one key, integers beyond 64 bits are text."""
    if value != value:
        return b""
    if isinstance(value, int) and value >= 1 << 63:
        return str(value)
    return value


def row_pieces(rows, options, unit, fluxes, bands):
    """Return a function of the number of a piece: its table, and the arguments of `fit` for its rows."""
    redshift = options["redshift"]
    prior = options["redshift_prior"]
    if prior is not None and (isinstance(prior, str) or len(prior) != 2):
        raise argument_error("redshift_prior", "redshifts and densities", repr(prior))
    if prior is None:
        nodes = None
        density = None
    else:
        nodes, density = prior
    for name, value in (("redshift", redshift), ("redshift_prior", density)):
        if _is_of_rows(name, value) and len(value) != rows.n_rows:
            raise argument_error(name, f"{rows.n_rows} values", f"shape {np.shape(value)}")

    def take(i):
        table = rows.chunk(i)
        if not hasattr(rows, "map"):
            # a map has done so
            table = without_codes_of(table, codes_of(table, bands))
        start, stop = rows.span(i)
        piece = slice(start, stop)
        give_units(table, fluxes, unit)
        piece_options = options | {}
        if _is_of_rows("redshift", redshift):
            piece_options["redshift"] = redshift[piece]
        if isinstance(density, str):
            require_columns(table, [density], "photometry")
            piece_options["redshift_prior"] = (nodes, table[density])
        elif _is_of_rows("redshift_prior", density):
            piece_options["redshift_prior"] = (nodes, density[piece])
        return table, piece_options

    return take


def _is_of_rows(name, value):
    """Whether what is known of redshifts is given row by row, not for all or by a column."""
    if isinstance(value, str):
        return False
    n_axes = {"redshift": 1, "redshift_prior": 2}[name]
    return np.ndim(value) == n_axes


def _job(fitter, rows, options, catalog_settings):
    """Collect what makes a fit another one, in plain values."""
    redshift = options["redshift"]
    prior = options["redshift_prior"]
    redshift_content = redshift
    if not isinstance(redshift, str):
        redshift_content = content_sha256(redshift)
    job = {
        "catalogue": {
            "sha256": rows.sha256,
            "bytes": rows.path.stat().st_size,
            "rows": rows.n_rows,
            **catalog_settings,
        },
        "chunk_rows": rows.chunk_rows,
        "redshift": redshift_content,
        "redshift_prior": content_sha256(prior),
        "fitter": convert_values(content_sha256, fitter.backend.content),
        "settings": fitter.settings() | {"max_reduced_chi2": HIGH_CHI2},
    }
    if options["pairs"]:
        job |= {"pairs": [list(names) for names in options["pairs"]]}
    if options["seed"] is None:
        return job
    return job | {"seed": options["seed"]}


def _begin(folder, job, resume):
    """Keep the parts of this fit, or remove those of another if ``resume`` is not set."""
    job = json.loads(json.dumps(job, default=plain_value))
    versions = {"miricigale": package_version()}
    versions |= {name: importlib.metadata.version(name) for name in _PACKAGES}
    # a call that failed before its first part leaves nothing to keep
    if resume and folder.records:
        changes = _differences(folder.facts["job"], job)
        if changes:
            msg = f"{folder.folder} holds results of another fit: {', '.join(changes)} differ"
            remedy = "resume=False to replace them"
            begun = folder.facts["versions"]["miricigale"]
            if begun != versions["miricigale"]:
                remedy += (
                    f" (they are of miricigale {begun}, whose settings may have other names: that "
                    "version can resume it, and open_results(path, partial=True) reads them)"
                )
            raise OtherResultsError(msg, remedy)
        return
    for key in list(folder.records):
        folder.drop(key)
    folder.facts = {"format": FORMAT, "versions": versions, "job": job}
    folder.write_manifest()


def _differences(old, new, prefix=""):
    """List the names of what differs between two dicts of plain values."""
    out = []
    for name in sorted(old.keys() | new.keys()):
        a = old.get(name)
        b = new.get(name)
        if isinstance(a, dict) and isinstance(b, dict):
            out += _differences(a, b, f"{prefix}{name}.")
        elif a != b:
            out.append(prefix + name)
    # checksums say less than settings
    settings = [name for name in out if name.split(".")[0] != "fitter"]
    return settings or out
