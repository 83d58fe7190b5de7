"""Results and draws in FITS files, and results in the files of a folder."""

import itertools
import numbers
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.table import Table, vstack

from miricigale.fitting.posterior.priors import GridAxis
from miricigale.fitting.results.results import FitResults
from miricigale.fitting.results.sample_flags import with_high_chi2
from miricigale.fitting.results.samples import Samples
from miricigale.sed import ModelGrid
from miricigale.utils.content_hash import content_sha256
from miricigale.utils.exceptions import argument_error, data_error
from miricigale.utils.file_formats import register
from miricigale.utils.files import open_fits
from miricigale.utils.folder import RecordFolder
from miricigale.utils.named_values import attributes, subset
from miricigale.utils.object_rows import ByID
from miricigale.utils.options import check_data, check_type
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.row_files import write_rows
from miricigale.utils.store import native, open_parts, write_parts
from miricigale.utils.table_files import write_ecsv
from miricigale.utils.tables import ascii_ids

#: Layout of a folder of `fit_file`.
FORMAT = "miricigale-fitparts-2"

_RESULTS = "miricigale-fitresults-4"
_SAMPLES = "miricigale-samples-2"
#: What names of columns of values between nodes begin with.
_DRAWN = "drawn:"
_DICTS = ("pdf", "best")
_TUPLES = ("filters", "quantities", "descriptions", "intensive", "fitted_filters")
_AXIS = ("values", "unit", "kind", "weights", "bounds")
_FACTS = ("redshift_fixed", "constants", "least_std", "meta")


def write_results(results, path, *, overwrite=False):
    """Write results: their table, a table extension of all arrays, and a text extension of all else."""
    shown = results._several().to_table()
    _write_results(results, path, shown=shown, overwrite=overwrite)


def write_part(results, path):
    """Write results as `write_results` does, without their table, which is that of all parts."""
    _write_results(results, path, shown=None, overwrite=False)


def _write_results(results, path, *, shown, overwrite):
    single = results.isscalar
    results = results._several()
    ascii_ids(results.ids, "ids")
    table = {n: array for n, array in results._per_object() if isinstance(array, np.ndarray)}
    for name in _DICTS:
        parts = getattr(results, name).items()
        table |= {f"{name}:{key}": getattr(value, "value", value) for key, value in parts}
    table |= {f"pair:{i}": weights for i, weights in enumerate(results.pairs.values())}
    text = attributes(results, _TUPLES + _FACTS)
    text |= {
        "pairs": [list(names) for names in results.pairs],
        "units": [u.Unit(unit).to_string() for unit in results.units],
        "shapes": {name: array.shape[1:] for name, array in table.items()},
        "axes": _axes_to_plain(results.axes),
        "single": single,
    }
    # FITS has no columns of arrays without elements
    full = {name: array for name, array in table.items() if array.size or not len(array)}
    write_parts(
        path, _RESULTS, shown=shown, text=text, tables={"RESULTS": Table(full)}, overwrite=overwrite
    )


def read_results(path, *, rows=None):
    """Read results, all or these rows (a list or array); see `~miricigale.fitting.FitResults`."""
    mapped = rows is not None
    with open_parts(path, (_RESULTS,), wanted="fit results", memmap=mapped) as parts:
        text = parts.text
        arrays = parts.columns("RESULTS", rows=rows)
        n = len(arrays["ids"])
        columns = {}
        for name, shape in text["shapes"].items():
            # columns without elements are not in the file
            columns[name] = arrays.get(name, np.zeros(0)).reshape(n, *shape)
        values = {name: tuple(text[name]) for name in _TUPLES}
        values |= subset(text, _FACTS) | {name: {} for name in _DICTS}
        for key, array in columns.items():
            name, _, part = key.partition(":")
            if not part:
                values[name] = array
            elif name in _DICTS:
                values[name][part] = array
        pairs = enumerate(text["pairs"])
        values["pairs"] = {tuple(names): columns[f"pair:{i}"] for i, names in pairs}
        values["units"] = tuple(map(u.Unit, text["units"]))
        values["axes"] = _axes_from_plain(text["axes"], {})
        results = FitResults(**values)
        if text.get("single"):
            return results._take(0)
        return results


def write_samples(samples, path, *, overwrite=False):
    """Write samples: a table extension of the draws, a text extension, and the axes' shares."""
    single = samples.isscalar
    samples = samples._several()
    ascii_ids(samples.ids, "ids")
    text = {
        "meta": samples.meta,
        "seed": samples.seed,
        "single": single,
        "axes": _axes_to_plain(samples.axes),
        "grid": {"sha256": content_sha256(samples.grid), "text": repr(samples.grid)},
        "n_draws": samples.n_draws,
    }
    columns = {}
    for name, array in samples._per_object():
        if isinstance(array, np.ndarray):
            columns[name] = array
    columns |= {_DRAWN + name: array for name, array in samples.drawn.items()}
    table = Table(columns)
    shares = {}
    for i, axis in enumerate(samples.axes.values()):
        if axis.share is not None:
            shares[f"SHARE{i}"] = np.asarray(axis.share, dtype=float)
    write_parts(
        path,
        _SAMPLES,
        shown=samples.to_table(),
        text=text,
        arrays=shares,
        tables={"SAMPLES": table},
        overwrite=overwrite,
    )


def read_samples(path, grid, *, model=None):
    """Read samples, with the grid that was fitted (another is refused) and, if it is known, its model."""
    check_type(grid, "grid", ModelGrid, "the ModelGrid that was fitted")
    with open_parts(path, (_SAMPLES,), wanted="samples") as parts:
        text = parts.text
        table = parts.table("SAMPLES")
        shape = len(table), int(text["n_draws"])
        columns = {name: native(table[name]) for name in ("ids", "flags", "index", "scale")}
        columns["index"] = columns["index"].reshape(shape + (4,))
        columns["scale"] = columns["scale"].reshape(shape)
        columns["drawn"] = {}
        for name in table.colnames:
            if name.startswith(_DRAWN):
                array = native(table[name]).reshape(shape)
                columns["drawn"][name.removeprefix(_DRAWN)] = array
        if "flux" in table.colnames:
            columns["flux"] = native(table["flux"]).reshape(shape + (len(grid.filters),))
        shares = {}
        for i, name in enumerate(text["axes"]):
            if f"SHARE{i}" in parts:
                shares[name] = parts.array(f"SHARE{i}")
        axes = _axes_from_plain(text["axes"], shares)
        grid_sha256 = text["grid"]["sha256"]
        grid_text = text["grid"]["text"]
        meta = text["meta"]
        seed = int(text["seed"])
    if content_sha256(grid) != grid_sha256:
        raise argument_error("grid", f"the one of the samples, {grid_text}", f"another, {grid!r}")
    samples = Samples(grid=grid, model=model, meta=meta, axes=axes, seed=seed, **columns)
    if text.get("single"):
        return samples._take(0)
    return samples


def _axes_to_plain(axes):
    """Turn axes without their shares into what JSON knows."""
    out = {}
    for name, axis in axes.items():
        out[name] = attributes(axis, _AXIS)
        out[name]["unit"] = u.Unit(axis.unit).to_string()
    return out


def _axes_from_plain(text, shares):
    """Make axes of what `_axes_to_plain` returned; ``shares`` by name are part of them."""
    kinds = {"values": np.array, "weights": np.array, "unit": u.Unit, "kind": str, "bounds": tuple}
    axes = {}
    for name, axis in text.items():
        fields = {key: kind(axis[key]) for key, kind in kinds.items()}
        axes[name] = GridAxis(name, **fields, share=shares.get(name))
    return axes


register(FitResults, read=read_results, write=write_results)
register(FitResults, write=write_ecsv, name="ascii.ecsv")
register(Samples, read=read_samples, write=write_samples)
register(Samples, write=write_ecsv, name="ascii.ecsv")


# ----------------------------------------------------------------- folders of fit_file


class FitFolder(RecordFolder):
    """Folder of the parts of a fit: each a record of one file, the fit itself in the facts."""

    purpose = "fit"
    lock_name = "fit.lock"
    records_name = "parts"
    inputs = ("calibration.ecsv",)
    remedy = "results of fit_file need a folder of their own"

    def parse(self, values):
        """Check facts and records of the manifest, whose facts are complete; none before the fit is known."""
        facts, parts = super().parse(values)
        if facts.get("format", FORMAT) != FORMAT:
            raise data_error(
                self.folder,
                f"holds results of fit_file in the layout {facts['format']!r} of another version of the package, "
                f"and this one reads {FORMAT!r}: fit again in another folder, or read it with the version that "
                "wrote it",
            )
        if facts or parts:
            facts["job"]["catalogue"]["rows"], facts["job"]["chunk_rows"]
        return facts, parts


def part_name(i):
    """Return the file name of part ``i``."""
    return f"part-{i:05d}.fits"


def part_columns(path, *names):
    """Read columns of plain numbers or text of a part by name, without the rest: list of arrays."""
    with open_fits(path, wanted="fit results", memmap=True) as hdus:
        data = hdus["RESULTS"].data
        return [native(np.array(data[name])) for name in names]


def part_ids(path):
    """Read the ids of a part, without the rest."""
    return part_columns(path, "ids")[0]


@takes_other_keywords
def open_results(path, *, partial=False, model=None, curves=()):
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
    curves : iterable of `~miricigale.filters.Filter`, optional
        Curves of bands that are not of the library, for drawings.

    Returns
    -------
    results : `FitResultsFiles`

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the folder holds no such results, or parts are missing.

    Examples
    --------
    >>> from miricigale.fitting import open_results
    >>> results = open_results("fits")  # doctest: +SKIP
    >>> results.to_table(["id", "mass_p50"])  # doctest: +SKIP
    """
    results = FitResultsFiles(path, model=model, curves=curves)
    if not (partial or results.complete):
        remedy = "fit_file with the same arguments resumes; partial=True opens what is there"
        raise data_error(path, f"holds {len(results.paths)} of {results.n_parts} parts: {remedy}")
    return results


class FitResultsFiles:
    """
    Results of a fit in files, of which one part at a time is in memory.

    Made by `fit_file` and `open_results`. It has as many elements as objects, in the order of
    the catalog: iterating gives the `FitResults` of each object, ``[id]`` those of an id and
    ``[rows]``, a slice or array of row numbers or of truth values, those of some rows.

    Parameters
    ----------
    path : path-like
        The folder.
    model : `~miricigale.sed.SEDModel`, optional
        The model the grid was made from.
    curves : iterable of `~miricigale.filters.Filter`, optional
        Curves of bands that are not of the library.

    Examples
    --------
    >>> from miricigale.fitting import open_results
    >>> results = open_results("fits")  # doctest: +SKIP
    >>> for part in results.parts():  # doctest: +SKIP
    ...     print(len(part), part.reduced_chi2.mean())
    """

    def __init__(self, path, *, model=None, curves=()):
        self.path = Path(path)
        self.model = model
        self.curves = tuple(curves)
        folder = FitFolder(path)
        check_data(folder.facts, path, "holds no results of fit_file (no manifest)")
        #: What was fitted, and how.
        self.job = folder.facts["job"]
        # of all parts, once they are there
        self._chi2_limit = folder.facts.get("chi2_limit")
        self.n_parts = max(1, -(-self.job["catalogue"]["rows"] // self.job["chunk_rows"]))
        parts = folder.records
        names = [part_name(i) for i in range(self.n_parts)]
        self.paths = tuple(self.path / name for name in names if name in parts)
        for item in self.paths:
            check_data(item.is_file(), self.path, f"has lost {item.name}, which its manifest names")
        self._records = tuple(parts[item.name] for item in self.paths)

    def __repr__(self):
        n = sum(record["fitted"] for record in self._records)
        state = ""
        if not self.complete:
            state = f" of {self.n_parts}"
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

    def _read(self, path, rows=None):
        results = read_results(path, rows=rows)._changed(model=self.model, curves=self.curves)
        if self._chi2_limit is None:
            return results
        return with_high_chi2(results, self._chi2_limit)

    def parts(self):
        """Iterate over the parts: one `FitResults` at a time."""
        return map(self._read, self.paths)

    def __iter__(self):
        return itertools.chain.from_iterable(self.parts())

    def __getitem__(self, key):
        """Return `FitResults` of a row or rows, or of an id that is text; others are not read."""
        if isinstance(key, numbers.Integral):
            return self[[key]][0]
        if isinstance(key, (slice, list)) or np.ndim(key):
            return self._rows(np.arange(len(self))[key])
        return self._take(self.row(key))

    @property
    def loc(self):
        """Objects by id: ``results.loc[id]``."""
        return ByID(self)

    def _take(self, place):
        path, row = place
        return self._read(path, [row])[0]

    def row(self, key):
        """Find the file of an id and the row in it."""
        if isinstance(key, np.generic):
            key = key.item()
        for path in self.paths:
            ids = part_ids(path).tolist()
            if key in ids:
                return path, ids.index(key)
        msg = f"no object with the id {key!r} among {len(self)}"
        raise KeyError(msg)

    def _rows(self, rows):
        """Read the results of rows by number, in their order."""
        n_rows = [record["rows"] for record in self._records]
        ends = np.cumsum([0] + list(n_rows))
        of_part = np.searchsorted(ends, rows, side="right") - 1
        parts = []
        for i, path in enumerate(self.paths):
            # the first part also stands for no rows at all
            if i == 0 or np.any(of_part == i):
                parts.append(self._read(path, rows[of_part == i] - ends[i]))
        order = np.argsort(of_part, kind="stable")
        return FitResults.concatenate(parts)[np.argsort(order)]

    def to_table(self, columns=None):
        """
        Return the results as one table; see `FitResults.to_table`.

        Parameters
        ----------
        columns : list of str, optional
            As of that; memory is needed for these only.

        Returns
        -------
        table : `~astropy.table.QTable`
        """
        tables = list(self._tables(columns))
        meta = tables[0].meta
        for table in tables:
            table.meta = {}
        out = vstack(tables, join_type="exact")
        out.meta = meta
        return out

    def _tables(self, columns):
        check_data(self.paths, self.path, "holds no part yet")
        for part in self.parts():
            yield part.to_table(columns)

    def write_table(self, path, *, columns=None, overwrite=False):
        """
        Write the table of all results to one FITS or parquet file, a part at a time.

        Parameters
        ----------
        path : path-like
            The file: parquet if its name ends in ``.parquet``, else FITS.
        columns : list of str, optional
            Columns to write, all by default.
        overwrite : bool, optional
            Whether a file that is there is replaced (an `OSError` otherwise).
        """
        # parts may have ids of different lengths
        width = max((part_ids(item).dtype.itemsize for item in self.paths), default=0)
        write_rows(path, self._tables(columns), len(self), id_width=width, overwrite=overwrite)
