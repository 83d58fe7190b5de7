"""Fits of catalogues larger than memory: from file to file, in pieces that a later call goes on from."""

import importlib.metadata
import json
import logging
import os
import warnings
from dataclasses import fields, replace
from pathlib import Path

import astropy.units as u
import numpy as np

from miricigale.fitting.likelihood import read_ids
from miricigale.fitting.pairs import check_pairs
from miricigale.fitting.part_files import (
    LOCK,
    MANIFEST,
    PARTS_FORMAT,
    open_results,
    part_ids,
    part_name,
    read_manifest,
    write_manifest,
)
from miricigale.refdata.locate import file_sha256
from miricigale.utils.content import content_sha256
from miricigale.utils.exceptions import (
    DataError,
    MiricigaleWarning,
    OtherResultsError,
    argument_error,
)
from miricigale.utils.lock import FolderLock
from miricigale.utils.progress import progress
from miricigale.utils.row_files import open_rows
from miricigale.utils.tables import ascii_ids, error_column, require_columns
from miricigale.utils.units import FNU

__all__ = ["fit_file"]

logger = logging.getLogger(__name__)

_PACKAGES = ("miricigale", "numpy", "numba", "astropy")


def fit_file(
    fitter,
    path_in,
    path_out,
    *,
    chunk_rows=10000,
    redshift=None,
    redshift_prior=None,
    pairs=None,
    flux_unit=None,
    hdu=None,
    executor=None,
    progress_bar=False,
    resume=True,
):
    """
    Fit a catalogue on disk and write the results to disk, a piece at a time.

    The results are those of `BayesFitter.fit` for the whole catalogue, number for number; only
    one piece is in memory. They lie in a folder: ``part-00000.fits`` and so on, each a file that
    `FitResults.read` reads, and ``manifest.json``, which says of what fit they are. A call that
    was stopped goes on with the same arguments and fits what is missing.

    Parameters
    ----------
    fitter : `BayesFitter`
        The fitter.
    path_in : path-like
        The catalogue: FITS with a binary table, ECSV, or CSV with a line of names (``.csv``),
        with columns as `BayesFitter.fit` wants them.
    path_out : path-like
        The folder; made if it is not there.
    chunk_rows : int, optional
        Rows of a piece and so of a part file. 10000 objects of a grid of 65 redshifts and 11 AGN
        fractions take some 100 MB of results.
    redshift : str or array_like, optional
        As for `BayesFitter.fit`: a column, or values for all rows of the catalogue.
    redshift_prior : tuple, optional
        As for `BayesFitter.fit`: redshifts and densities, of which there may be one row for each
        row of the catalogue, or the name of a column that holds them.
    pairs : list of tuple of str, optional
        As for `BayesFitter.fit`: pairs of parameters of which joint posteriors are kept too.
    flux_unit : unit-like, optional
        Unit of flux columns and their errors where the file gives none, as CSV does.
    hdu : int or str, optional
        Extension of a FITS file; the only table by default.
    executor : `concurrent.futures.Executor`, optional
        Fits parts of each piece at the same time; the answer is the same.
    progress_bar : bool, optional
        Whether to show one.
    resume : bool, optional
        Whether to keep the parts that are there. Parts of another fit (other settings, grid,
        catalogue or ``chunk_rows``) are refused. False replaces what an earlier call wrote.

    Returns
    -------
    results : `FitResultsFiles`
        All parts.

    Warns
    -----
    `~miricigale.utils.exceptions.MiricigaleWarning`
        What `BayesFitter.fit` warns of, once.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the catalogue cannot be read by rows, the folder holds something else, or another
        process fits into it: then the message says which file to remove if that is gone.
    `~miricigale.utils.exceptions.OtherResultsError`
        If the folder holds parts of another fit.
    ValueError
        What `BayesFitter.fit` raises; if an id is no ASCII text, which FITS cannot hold,
        before anything is fitted. A note tells the rows.
    """
    if not all(hasattr(fitter, name) for name in ("fit", "settings", "grid")):
        raise argument_error("fitter", "a BayesFitter", type(fitter).__name__)
    if not isinstance(path_in, (str, os.PathLike)):
        raise argument_error("path_in", "the path of a catalogue", type(path_in).__name__)
    unit = None if flux_unit is None else u.Unit(flux_unit)
    if unit is not None and not unit.is_equivalent(FNU):
        msg = f"'flux_unit' must be convertible to {FNU}, got {unit}"
        raise u.UnitsError(msg)
    fluxes = {c for name in fitter.grid.filters for c in (name, error_column(name))}
    unit_text = None if unit is None else unit.to_string()
    rows = open_rows(
        path_in, chunk_rows, hdu=hdu, units=lambda name: unit_text if name in fluxes else None
    )
    pairs = check_pairs(pairs, fitter)
    inputs = _Inputs(rows, redshift, redshift_prior, unit, fluxes, pairs)
    _check_ids(rows)
    folder = Path(path_out)
    job = _job(fitter, rows, redshift, redshift_prior, unit_text, hdu, pairs)
    _check_folder(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with FolderLock(folder, name=LOCK, purpose="fit"):
        manifest = _open_folder(folder, job, resume)
        _fit_parts(fitter, inputs, folder, manifest, executor, progress_bar)
    return open_results(folder, model=getattr(fitter, "model", None))


def _check_ids(rows):
    """Refuse ids that parts cannot hold before the first is fitted, not when it is written."""
    if "id" not in rows.colnames:
        return
    for i in rows.foreign_chunks("id"):
        try:
            ascii_ids(read_ids(rows.chunk(i)), "photometry")
        except ValueError as err:
            start, stop = rows.span(i)
            err.add_note(f"in rows {start} to {stop - 1} of {rows.path}")
            raise


def _fit_parts(fitter, inputs, folder, manifest, executor, progress_bar):
    """Fit the pieces whose parts are not there, and write them."""
    rows = inputs.rows
    seen = _SeenIds()
    n_old, n_new = 0, 0
    with progress(show=progress_bar, total=rows.n_rows, desc="fit", unit="obj") as bar:
        for i in range(rows.n_chunks):
            start, stop = rows.span(i)
            path = folder / part_name(i)
            if _is_whole(path, manifest["parts"].get(path.name)):
                seen.add(part_ids(path))
                n_old += 1
            else:
                table, options = inputs.take(i)
                with warnings.catch_warnings():
                    if n_new:
                        # what is true of all pieces was said of the first
                        text = "bands of the photometry"
                        warnings.filterwarnings("ignore", text, MiricigaleWarning)
                    try:
                        results = _fit(fitter, table, options, seen, executor)
                    except (ValueError, u.UnitsError) as err:
                        err.add_note(f"in rows {start} to {stop - 1} of {rows.path}")
                        raise
                n_new += 1
                manifest["parts"][path.name] = _write_part(results, path)
                write_manifest(folder, manifest)
                seen.add(results.ids)
            bar.update(stop - start)
    logger.info("%s: %d parts, %d of them from before", folder, rows.n_chunks, n_old)


class _Inputs:
    """The pieces of a catalogue, and of what was given beside it."""

    def __init__(self, rows, redshift, redshift_prior, unit, fluxes, pairs):
        self.pairs = pairs
        self.rows, self.unit, self.fluxes = rows, unit, fluxes
        self.redshift, self.prior = redshift, redshift_prior
        n = rows.n_rows
        self.by_row = redshift is not None and not isinstance(redshift, str) and np.ndim(redshift)
        if isinstance(redshift, (list, tuple)):
            # rows are taken from it by number
            self.redshift = np.array(redshift)
        if self.by_row and np.shape(redshift) != (n,):
            raise argument_error("redshift", f"{n} values", f"shape {np.shape(redshift)}")
        self.prior_by_row = False
        if redshift_prior is not None:
            if isinstance(redshift_prior, str) or len(redshift_prior) != 2:
                raise argument_error(
                    "redshift_prior", "redshifts and densities", repr(redshift_prior)
                )
            density = redshift_prior[1]
            self.prior_by_row = not isinstance(density, str) and np.ndim(density) == 2
            if self.prior_by_row and len(density) != n:
                raise argument_error("redshift_prior", f"{n} rows", f"{len(density)}")
            if isinstance(density, (list, tuple)):
                self.prior = (redshift_prior[0], np.array(density))

    def take(self, i):
        """Piece ``i``: table, and the arguments of `fit` that go with it."""
        table = self.rows.chunk(i)
        if self.unit is not None:
            for name in self.fluxes.intersection(table.colnames):
                if table[name].unit is None:
                    table[name] = table[name] * self.unit
        piece = slice(*self.rows.span(i))
        options = {"pairs": self.pairs} if self.pairs else {}
        if self.redshift is not None:
            options["redshift"] = self.redshift[piece] if self.by_row else self.redshift
        if self.prior is not None:
            nodes, density = self.prior
            if isinstance(density, str):
                require_columns(table, [density], "photometry")
                density = table[density]
            elif self.prior_by_row:
                density = density[piece]
            options["redshift_prior"] = (nodes, density)
        return table, options


def _fit(fitter, table, options, seen, executor):
    """Fit a piece as a part of the whole: ids of earlier pieces are duplicates."""
    n = len(table)
    again = np.flatnonzero(seen.find(read_ids(table)))
    if again.size == 0:
        return fitter.fit(table, executor=executor, **options)
    # rows with these ids come first, so that the fit itself sees that they occur twice
    order = np.concatenate([again, np.arange(n)])
    table = table[order]
    for name in fitter.grid.filters:
        if name in table.colnames and np.asarray(table[name]).dtype.kind == "f":
            table[name][: again.size] = np.nan
    for name, value in options.items():
        if name == "redshift" and np.ndim(value) == 1:
            options[name] = value[order]
        elif name == "redshift_prior" and np.ndim(value[1]) == 2:
            options[name] = (value[0], value[1][order])
    results = fitter.fit(table, executor=executor, **options)
    return _without_first(results, again.size)


def _without_first(results, n):
    """Leave the first ``n`` rows out."""
    size = len(results)
    changes = {}
    for item in fields(results):
        value = getattr(results, item.name)
        if isinstance(value, np.ndarray):
            changes[item.name] = value[n:]
        elif isinstance(value, dict) and value:
            arrays = [isinstance(v, np.ndarray) and v.shape[:1] == (size,) for v in value.values()]
            if all(arrays):
                changes[item.name] = {name: array[n:] for name, array in value.items()}
    return replace(results, **changes)


class _SeenIds:
    """Ids that occurred, in sorted runs whose lengths at least double: n log n, few bytes an id."""

    def __init__(self):
        self._runs = []

    @staticmethod
    def _sorted(ids):
        ids = np.asarray(ids)
        # one byte a character in place of four
        return np.unique(np.char.encode(ids, "utf-8") if ids.dtype.kind == "U" else ids)

    def find(self, ids):
        """Which of these ids occurred: array of bool."""
        known, inverse = np.unique(np.asarray(ids), return_inverse=True)
        known = np.char.encode(known, "utf-8") if known.dtype.kind == "U" else known
        found = np.zeros(len(known), dtype=bool)
        for run in self._runs:
            place = np.minimum(np.searchsorted(run, known), len(run) - 1)
            found |= (run[place] == known) | ((run[place] != run[place]) & (known != known))
        return found[inverse]

    def add(self, ids):
        """Add ids."""
        run = self._sorted(ids)
        while self._runs and len(self._runs[-1]) <= len(run):
            run = np.union1d(self._runs.pop(), run)
        if len(run):
            self._runs.append(run)


def _job(fitter, rows, redshift, redshift_prior, flux_unit, hdu, pairs):
    """What makes a fit another one, in plain values."""
    values = vars(fitter)
    content = {
        name.strip("_"): content_sha256(value)
        for name, value in sorted(values.items())
        # the spectra are in the grid
        if name != "model"
    }
    job = {
        "catalogue": {
            "sha256": rows.sha256,
            "bytes": rows.path.stat().st_size,
            "rows": rows.n_rows,
            "hdu": hdu,
            "flux_unit": flux_unit,
        },
        "chunk_rows": rows.chunk_rows,
        "redshift": redshift if isinstance(redshift, str) else content_sha256(redshift),
        "redshift_prior": content_sha256(redshift_prior),
        "fitter": content,
        "settings": fitter.settings(),
    }
    return job | ({"pairs": [list(names) for names in pairs]} if pairs else {})


def _check_folder(folder):
    """Refuse a folder of something else, before anything is made in it."""
    if folder.exists() and not folder.is_dir():
        msg = f"{folder} is a file; results of fit_file go to a folder"
        raise DataError(msg)
    if not folder.is_dir() or (folder / MANIFEST).is_file():
        return
    # a fit that was killed at its first moment leaves these
    ours = (LOCK, MANIFEST)
    if any(not entry.name.startswith(ours) for entry in folder.iterdir()):
        msg = f"{folder} is not empty and holds no {MANIFEST}; results need a folder of their own"
        raise DataError(msg)


def _open_folder(folder, job, resume):
    """Manifest of the folder: the one that is there if it is of this fit, or a new one."""
    job = json.loads(json.dumps(job, default=str))
    if (folder / MANIFEST).is_file():
        manifest = read_manifest(folder)
        # a call that failed before its first part leaves nothing to keep
        if resume and manifest["parts"]:
            other = _differences(manifest["job"], job)
            if other:
                msg = f"{folder} holds results of another fit: {', '.join(other)} differ"
                raise OtherResultsError(msg, "resume=False to replace them")
            return manifest
        for name in manifest["parts"]:
            (folder / name).unlink(missing_ok=True)
    versions = {name: importlib.metadata.version(name) for name in _PACKAGES}
    manifest = {"format": PARTS_FORMAT, "versions": versions, "job": job, "parts": {}}
    write_manifest(folder, manifest)
    return manifest


def _differences(old, new, prefix=""):
    """Names of what differs between two dicts of plain values."""
    out = []
    for name in sorted({*old, *new}):
        a, b = old.get(name), new.get(name)
        if isinstance(a, dict) and isinstance(b, dict):
            out += _differences(a, b, f"{prefix}{name}.")
        elif a != b:
            out.append(prefix + name)
    # checksums say less than settings
    told = [name for name in out if not name.startswith("fitter.")]
    return told or out


def _write_part(results, path):
    """Write a part under another name and rename it; returns its record."""
    temporary = path.with_name(path.name + ".tmp")
    temporary.unlink(missing_ok=True)
    try:
        results.write(temporary, overwrite=True)
        record = {
            "rows": len(results),
            "fitted": int(np.count_nonzero(results.fitted)),
            "bytes": temporary.stat().st_size,
            "sha256": file_sha256(temporary),
        }
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return record


def _is_whole(path, record):
    """Whether a part is there as it was written."""
    if record is None or not path.is_file():
        return False
    if path.stat().st_size == record["bytes"] and file_sha256(path) == record["sha256"]:
        return True
    logger.warning("%s is damaged and is made again", path)
    return False
