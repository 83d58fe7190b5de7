"""Fits of catalogs larger than memory: from file to file, in pieces that a later call goes on from."""

import functools
import importlib.metadata
import io
import json
import logging
import os
import warnings
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.io import fits
from astropy.table import vstack

from miricigale.fitting.fitter import BayesFitter
from miricigale.fitting.likelihood import read_ids
from miricigale.fitting.results import FitResults
from miricigale.utils.content import content_sha256
from miricigale.utils.exceptions import (
    DataError,
    MiricigaleWarning,
    OtherResultsError,
    argument_error,
    unknown_name,
)
from miricigale.utils.files import open_fits
from miricigale.utils.folder import RecordFolder
from miricigale.utils.progress import progress
from miricigale.utils.random import check_seed
from miricigale.utils.row_files import open_rows
from miricigale.utils.store import native, plain_value, replacing
from miricigale.utils.tables import ascii_ids, error_column, require_columns
from miricigale.utils.units import FNU

__all__ = ["FitResultsFiles", "fit_file", "open_results"]

logger = logging.getLogger(__name__)

_FORMAT = "miricigale-fitparts-2"
_OLD_FORMAT = "miricigale-fitparts-1"
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
    seed=None,
    flux_unit=None,
    hdu=None,
    executor=None,
    progress_bar=False,
    resume=True,
):
    """
    Fit a catalog on disk and write the results to disk, a piece at a time.

    The results are those of `BayesFitter.fit` for the whole catalog, number for number; only
    one piece is in memory. They lie in a folder: ``part-00000.fits`` and so on, each a file that
    `FitResults.read` reads, and ``manifest.json``, which says of what fit they are. A call that
    was stopped goes on with the same arguments and fits what is missing.

    Parameters
    ----------
    fitter : `BayesFitter`
        The fitter. (Of a sampler, the cells of a redshift axis that is not the same for all objects
        are those of each part.)
    path_in : path-like
        The catalog: FITS with a binary table, ECSV, or CSV with a line of names (``.csv``),
        with columns as `BayesFitter.fit` wants them.
    path_out : path-like
        The folder; made if it is not there.
    chunk_rows : int, optional
        Rows of a piece and so of a part file. 10000 objects of a grid of 65 redshifts and 11 AGN
        fractions take some 100 MB of results.
    redshift : str or array_like, optional
        As for `BayesFitter.fit`: a column, or values for all rows of the catalog.
    redshift_prior : tuple, optional
        As for `BayesFitter.fit`: redshifts and densities, of which there may be one row for each
        row of the catalog, or the name of a column that holds them.
    pairs : list of tuple of str, optional
        As for `BayesFitter.fit`: pairs of parameters of which joint posteriors are kept too.
    seed : int, optional
        As for `BayesFitter.fit`. A sampler needs one, so that a later call can go on.
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
        catalog or ``chunk_rows``) are refused. False replaces what an earlier call wrote.

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
        If the catalog cannot be read by rows, the folder holds something else, or another
        process fits into it: then the message says which file to remove if that is gone.
    `~miricigale.utils.exceptions.OtherResultsError`
        If the folder holds parts of another fit.
    ValueError
        What `BayesFitter.fit` raises; if an id is no ASCII text, which FITS cannot hold,
        before anything is fitted. A note tells the rows.
    """
    if not isinstance(fitter, BayesFitter):
        raise argument_error("fitter", "a BayesFitter", type(fitter).__name__)
    if not isinstance(path_in, (str, os.PathLike)):
        raise argument_error("path_in", "the path of a catalogue", type(path_in).__name__)
    if fitter.engine != "grid":
        if seed is None:
            raise argument_error("seed", "given for a sampler, so that it can go on", "None")
        seed = check_seed(seed)
    else:
        # the same fit, in whatever order they are given
        pairs = fitter.backend.check_pairs(pairs)
    unit = None if flux_unit is None else u.Unit(flux_unit)
    if unit is not None and not unit.is_equivalent(FNU):
        msg = f"'flux_unit' must be convertible to {FNU}, got {unit}"
        raise u.UnitsError(msg)
    fluxes = {c for name in fitter.bands for c in (name, error_column(name))}
    unit_text = None if unit is None else unit.to_string()
    rows = open_rows(
        path_in, chunk_rows, hdu=hdu, units=lambda name: unit_text if name in fluxes else None
    )
    options = {"redshift": redshift, "redshift_prior": redshift_prior, "pairs": pairs}
    inputs = _Inputs(rows, options, unit, fluxes)
    _check_ids(rows)
    job = _job(fitter, rows, options | {"seed": seed}, {"hdu": hdu, "flux_unit": unit_text})
    with _FitFolder(path_out) as folder:
        _begin(folder, job, resume)
        _fit_parts(fitter, inputs, folder, seed, executor, progress_bar)
    return open_results(path_out, model=fitter.model)


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


def _fit_parts(fitter, inputs, folder, seed, executor, progress_bar):
    """Fit the pieces whose parts are not there, and write them."""
    rows = inputs.rows
    seen, n_new = set(), 0
    with progress(show=progress_bar, total=rows.n_rows, desc="fit", unit="obj") as bar:
        for i in range(rows.n_chunks):
            start, stop = rows.span(i)
            name = _part_name(i)
            if name in folder.records and folder.is_whole(name):
                seen.update(_keys(_part_ids(folder.path(name))))
            else:
                if name in folder.records:
                    logger.warning("%s is damaged and is made again", folder.path(name))
                table, options = inputs.take(i)
                with warnings.catch_warnings():
                    if n_new:
                        # what is true of all pieces was said of the first
                        text = "bands of the photometry"
                        warnings.filterwarnings("ignore", text, MiricigaleWarning)
                    try:
                        keys = _keys(read_ids(table))
                        repeated = np.array([key in seen for key in keys], dtype=bool)
                        results = fitter._fit_rows(
                            table, options, seed=seed, repeated=repeated, executor=executor
                        )
                    except (ValueError, u.UnitsError) as err:
                        err.add_note(f"in rows {start} to {stop - 1} of {rows.path}")
                        raise
                n_new += 1
                folder.save(name, lambda path, results=results: results.write(path))
                folder.finish(
                    name,
                    "",
                    {name: folder.describe(name)},
                    rows=len(results),
                    fitted=int(np.count_nonzero(results.fitted)),
                )
                seen.update(keys)
            bar.update(stop - start)
    logger.info("%s: %d parts, %d of them new", folder.folder, rows.n_chunks, n_new)


def _keys(ids):
    """Ids as a set knows them: numbers that are NaN are one."""
    return [key if key == key else None for key in ids.tolist()]


class _Inputs:
    """The pieces of a catalog, and of what was given beside it."""

    def __init__(self, rows, options, unit, fluxes):
        self.rows, self.unit, self.fluxes = rows, unit, fluxes
        self.options = dict(options)
        redshift, prior = options["redshift"], options["redshift_prior"]
        n = rows.n_rows
        self.by_row = redshift is not None and not isinstance(redshift, str) and np.ndim(redshift)
        if isinstance(redshift, (list, tuple)):
            # rows are taken from it by number
            self.options["redshift"] = np.array(redshift)
        if self.by_row and np.shape(redshift) != (n,):
            raise argument_error("redshift", f"{n} values", f"shape {np.shape(redshift)}")
        self.prior_by_row = False
        if prior is not None:
            if isinstance(prior, str) or len(prior) != 2:
                raise argument_error("redshift_prior", "redshifts and densities", repr(prior))
            density = prior[1]
            self.prior_by_row = not isinstance(density, str) and np.ndim(density) == 2
            if self.prior_by_row and len(density) != n:
                raise argument_error("redshift_prior", f"{n} rows", f"{len(density)}")
            if isinstance(density, (list, tuple)):
                self.options["redshift_prior"] = (prior[0], np.array(density))

    def take(self, i):
        """Piece ``i``: table, and the arguments of `fit` that go with it."""
        table = self.rows.chunk(i)
        if self.unit is not None:
            for name in self.fluxes.intersection(table.colnames):
                if table[name].unit is None:
                    table[name] = table[name] * self.unit
        piece = slice(*self.rows.span(i))
        options = dict(self.options)
        if self.by_row:
            options["redshift"] = options["redshift"][piece]
        if options["redshift_prior"] is not None:
            nodes, density = options["redshift_prior"]
            if isinstance(density, str):
                require_columns(table, [density], "photometry")
                density = table[density]
            elif self.prior_by_row:
                density = density[piece]
            options["redshift_prior"] = (nodes, density)
        return table, options


# ------------------------------------------------------------------- folder and manifest


class _FitFolder(RecordFolder):
    """Folder of the parts of a fit: each a record of one file, the fit itself in the facts."""

    purpose = "fit"
    lock_name = "fit.lock"
    records_name = "parts"
    remedy = "results of fit_file need a folder of their own"

    def parse(self, values):
        """Facts and records; those of the layout before say sizes and checksums by themselves."""
        facts, parts = super().parse(values)
        facts["job"]["catalogue"]["rows"], facts["job"]["chunk_rows"]
        if facts["format"] == _OLD_FORMAT:
            parts = {
                name: {
                    "hash": "",
                    "rows": part["rows"],
                    "fitted": part["fitted"],
                    "products": {name: {key: part[key] for key in ("sha256", "bytes")}},
                }
                for name, part in parts.items()
            }
        return facts | {"format": _FORMAT}, parts


def _part_name(i):
    """File name of part ``i``."""
    return f"part-{i:05d}.fits"


def _part_ids(path):
    """Ids of a part, read without the rest."""
    with open_fits(path, wanted="fit results", memmap=True) as hdus:
        return native(np.array(hdus["RESULTS"].data["ids"]))


def _job(fitter, rows, options, given):
    """What makes a fit another one, in plain values."""
    redshift, prior = options["redshift"], options["redshift_prior"]
    job = {
        "catalogue": {
            "sha256": rows.sha256,
            "bytes": rows.path.stat().st_size,
            "rows": rows.n_rows,
            **given,
        },
        "chunk_rows": rows.chunk_rows,
        "redshift": redshift if isinstance(redshift, str) else content_sha256(redshift),
        "redshift_prior": content_sha256(prior),
        "fitter": {name: content_sha256(value) for name, value in fitter.backend.content.items()},
        "settings": fitter.settings() | {"max_reduced_chi2": fitter.max_reduced_chi2},
    }
    job |= {"pairs": [list(names) for names in options["pairs"]]} if options["pairs"] else {}
    return job if options["seed"] is None else job | {"seed": options["seed"]}


def _begin(folder, job, resume):
    """Keep the parts of this fit, or remove those of another if ``resume`` is not set."""
    job = json.loads(json.dumps(job, default=plain_value))
    # a call that failed before its first part leaves nothing to keep
    if resume and folder.records:
        other = _differences(folder.facts["job"], job)
        if other:
            msg = f"{folder.folder} holds results of another fit: {', '.join(other)} differ"
            raise OtherResultsError(msg, "resume=False to replace them")
        return
    for key in list(folder.records):
        folder.drop(key)
    versions = {name: importlib.metadata.version(name) for name in _PACKAGES}
    folder.facts = {"format": _FORMAT, "versions": versions, "job": job}
    folder.write_manifest()


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
    told = [name for name in out if name.split(".")[0] != "fitter"]
    return told or out


# ----------------------------------------------------------------------- results in files


def open_results(path, *, partial=False, model=None):
    """
    Open the results that `fit_file` wrote.

    Parameters
    ----------
    path : path-like
        The folder.
    partial : bool, optional
        Whether a folder in which parts are missing is opened too.
    model : `~miricigale.sed.SEDModel`, optional
        The model the grid was made from, for spectra of the best fits.

    Returns
    -------
    results : `FitResultsFiles`

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the folder holds no such results, or parts are missing.
    """
    results = FitResultsFiles(path, model=model)
    if not (partial or results.complete):
        msg = (
            f"{path} holds {len(results.paths)} of {results.n_parts} parts: fit_file with the "
            "same arguments goes on; partial=True opens what is there"
        )
        raise DataError(msg)
    return results


class FitResultsFiles:
    """
    Results of a fit in files, of which one part at a time is in memory.

    Made by `fit_file` and `open_results`. It has as many elements as objects, in the order of
    the catalog: iterating gives the `FitResults` of each object, ``[id]`` those of an id.

    Parameters
    ----------
    path : path-like
        The folder.
    model : `~miricigale.sed.SEDModel`, optional
        The model the grid was made from.
    """

    def __init__(self, path, *, model=None):
        self.path = Path(path)
        self.model = model
        folder = _FitFolder(path)
        if not folder.facts:
            msg = f"{path} holds no results of fit_file (no manifest)"
            raise DataError(msg)
        #: What was fitted, and how.
        self.job = folder.facts["job"]
        self.n_parts = max(1, -(-self.job["catalogue"]["rows"] // self.job["chunk_rows"]))
        parts = folder.records
        names = [_part_name(i) for i in range(self.n_parts)]
        self.paths = tuple(self.path / name for name in names if name in parts)
        for item in self.paths:
            if not item.is_file():
                msg = f"{self.path} has lost {item.name}, which its manifest names"
                raise DataError(msg)
        self._records = tuple(parts[item.name] for item in self.paths)
        self._kept = functools.lru_cache(maxsize=1)(self._read)

    def __repr__(self):
        n = sum(record["fitted"] for record in self._records)
        state = "" if self.complete else f" of {self.n_parts}"
        return (
            f"<FitResultsFiles of {len(self)} objects, {n} fitted, "
            f"{len(self.paths)}{state} parts in {self.path}>"
        )

    def __len__(self):
        return sum(record["rows"] for record in self._records)

    @property
    def complete(self):
        """Whether all parts are there."""
        return len(self.paths) == self.n_parts

    def _read(self, path):
        return FitResults.read(path)._changed(model=self.model)

    def parts(self):
        """Iterate over the parts: one `FitResults` at a time."""
        return map(self._read, self.paths)

    def __iter__(self):
        for part in self.parts():
            yield from part

    def __getitem__(self, key):
        """Return the results of the object with this id (the first, if it occurs twice)."""
        key = key.item() if isinstance(key, np.generic) else key
        for path in self.paths:
            # only the ids are read until the part is found
            if key in _part_ids(path).tolist():
                return self._kept(path)[key]
        msg = f"no object with the id {key!r} among {len(self)}"
        raise KeyError(msg)

    def to_table(self, columns=None):
        """
        Results as one table; see `FitResults.to_table`.

        Parameters
        ----------
        columns : list of str, optional
            Columns to keep, all by default; memory is needed for these only.

        Returns
        -------
        table : `~astropy.table.QTable`
        """
        tables = list(self._tables(columns))
        meta = tables[0].meta
        for table in tables:
            table.meta = {}
        out = tables[0] if len(tables) == 1 else vstack(tables, join_type="exact")
        out.meta.update(meta)
        return out

    def _tables(self, columns):
        if not self.paths:
            msg = f"{self.path} holds no part yet"
            raise DataError(msg)
        for part in self.parts():
            table = part.to_table()
            for name in columns or ():
                if name not in table.colnames:
                    raise unknown_name("column", name, table.colnames)
            yield table if columns is None else table[list(columns)]

    def write_table(self, path, *, columns=None, overwrite=False):
        """
        Write the table of all results to one FITS file, a part at a time.

        Parameters
        ----------
        path : path-like
            The file.
        columns : list of str, optional
            Columns to write, all by default.
        overwrite : bool, optional
            Whether a file that is there is replaced.

        Raises
        ------
        OSError
            If the file is there and ``overwrite`` is not set.
        """
        # parts may have ids of different lengths
        width = max((_part_ids(item).dtype.itemsize for item in self.paths), default=0)
        write_rows(path, self._tables(columns), len(self), id_width=width, overwrite=overwrite)


def write_rows(path, tables, n_rows, *, id_width=0, overwrite=False):
    """
    Write tables of the same columns as one FITS table, one at a time.

    Parameters
    ----------
    path : path-like
        The file.
    tables : iterable of `~astropy.table.Table`
        At least one.
    n_rows : int
        Rows of all.
    id_width : int, optional
        Bytes of the longest text in the columns ``id``, four a character.
    overwrite : bool, optional
        Whether a file that is there is replaced.
    """
    layout, n_bytes = None, 0
    with replacing(path, overwrite=overwrite) as partial, open(partial, "wb") as stream:
        for table in tables:
            header, rows = _fits_rows(table, id_width)
            columns = [header[f"TFORM{i + 1}"] for i in range(header["TFIELDS"])]
            if layout is None:
                layout = columns
                header["NAXIS2"] = n_rows
                for part in (fits.PrimaryHDU().header, header):
                    stream.write(part.tostring().encode("ascii"))
            elif columns != layout:
                msg = "the parts have different columns"
                raise DataError(msg)
            n_bytes += stream.write(rows)
        stream.write(bytes(-n_bytes % 2880))


def _fits_rows(table, id_width):
    """Header and rows of a table as astropy writes it, ids that are text as wide as told."""
    if "id" in table.colnames and table["id"].dtype.kind == "U":
        about = table["id"].info.description
        table["id"] = np.asarray(table["id"]).astype(f"U{max(1, id_width // 4)}")
        table["id"].info.description = about
    meta, table.meta = dict(table.meta), {}
    for key, value in meta.items():
        if key == "citations":
            key, value = "cite", "; ".join(value)
        # headers hold no dicts
        plain = isinstance(value, (str, int, float, bool))
        table.meta[key] = value if plain else json.dumps(value, default=plain_value)
    file = io.BytesIO()
    with warnings.catch_warnings():
        # FITS does not know dex; astropy does when it reads the table
        warnings.filterwarnings("ignore", "The unit 'dex' could not be saved in native FITS")
        table.write(file, format="fits")
    data = file.getvalue()
    with fits.open(io.BytesIO(data)) as hdus:
        header, start = hdus[1].header.copy(), hdus[1].fileinfo()["datLoc"]
    return header, data[start : start + header["NAXIS1"] * header["NAXIS2"]]
