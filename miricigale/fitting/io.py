"""Results and draws as FITS files, for `astropy.io.registry`."""

import astropy.units as u
import numpy as np
from astropy.table import Table

from miricigale.fitting.priors import GridAxis
from miricigale.fitting.results import CIGALE_LEAST_STD, FitResults
from miricigale.fitting.samples import Samples
from miricigale.sed import ModelGrid
from miricigale.utils.content import content_sha256
from miricigale.utils.exceptions import argument_error
from miricigale.utils.store import native, open_parts, write_parts
from miricigale.utils.tables import ascii_ids
from miricigale.utils.unified import register

__all__ = ["read_results", "read_samples", "write_results", "write_samples"]

_RESULTS = "miricigale-fitresults-4"
#: Files of the formats before: their settings are in the meta; those of 2 have no pairs.
_OLD_RESULTS = ("miricigale-fitresults-3", "miricigale-fitresults-2")
_SAMPLES = "miricigale-samples-1"
_DICTS = ("pdf", "best")
_TUPLES = ("filters", "quantities", "descriptions", "intensive", "fitted_filters")
_FACTS = ("redshift_fixed", "constants", "least_std", "meta")


def write_results(results, path, *, overwrite=False):
    """
    Write results: a table extension of all arrays, and a text extension of all else.

    Raises
    ------
    ValueError
        If an id is text that is not ASCII, or ends in a blank.
    """
    single, results = results.isscalar, results._several()
    ascii_ids(results.ids, "ids")
    table = {}
    for name, value in results._per_object():
        if isinstance(value, np.ndarray):
            table[name] = value
    for name in _DICTS:
        for key, value in getattr(results, name).items():
            table[f"{name}:{key}"] = getattr(value, "value", value)
    for i, weights in enumerate(results.pairs.values()):
        table[f"pair:{i}"] = weights
    text = {name: getattr(results, name) for name in (*_TUPLES, *_FACTS)}
    text["pairs"] = [list(names) for names in results.pairs]
    text["units"] = [u.Unit(unit).to_string() for unit in results.units]
    text["shapes"] = {name: array.shape[1:] for name, array in table.items()}
    text["axes"] = _axes_to_plain(results.axes)
    text["single"] = single
    # FITS has no columns of arrays without elements
    full = {name: array for name, array in table.items() if array.size or not len(array)}
    write_parts(path, _RESULTS, text=text, tables={"RESULTS": Table(full)}, overwrite=overwrite)


def read_results(path, *, rows=None):
    """Read results, all or these rows (a list or array); see `~miricigale.fitting.FitResults`."""
    layouts, some = (_RESULTS, *_OLD_RESULTS), rows is not None
    with open_parts(path, layouts, wanted="fit results", memmap=some) as parts:
        text, table = parts.text, parts.table("RESULTS", rows=rows)
        n = len(table)
        columns = {
            name: native(table[name]).reshape(n, *shape)
            if name in table.colnames
            else np.zeros((n, *shape))
            for name, shape in text["shapes"].items()
        }
        if parts.layout in _OLD_RESULTS:
            text = text | _old_facts(text["meta"].get("fit", {}), text["filters"])
        values = {name: tuple(text[name]) for name in _TUPLES}
        values |= {name: text[name] for name in _FACTS}
        values |= {name: array for name, array in columns.items() if ":" not in name}
        for name in _DICTS:
            values[name] = {
                key.removeprefix(f"{name}:"): array
                for key, array in columns.items()
                if key.startswith(f"{name}:")
            }
        pairs = enumerate(text.get("pairs", ()))
        values["pairs"] = {tuple(names): columns[f"pair:{i}"] for i, names in pairs}
        values["units"] = tuple(u.Unit(unit) for unit in text["units"])
        values["axes"] = _axes_from_plain(text["axes"])
        results = FitResults(**values)
        return results._take(0) if text.get("single") else results


def _old_facts(fit, filters):
    """What files of the formats before told in the settings of their meta."""
    return {
        "fitted_filters": fit.get("filters", filters),
        "redshift_fixed": fit.get("redshift") == "fixed",
        "constants": fit.get("constants", {}),
        "least_std": CIGALE_LEAST_STD if fit.get("compat") == "cigale" else 0.0,
    }


def write_samples(samples, path, *, overwrite=False):
    """
    Write samples: a table extension of the draws, a text extension, and the axes' shares.

    Raises
    ------
    ValueError
        If an id is text that is not ASCII, or ends in a blank.
    """
    single, samples = samples.isscalar, samples._several()
    ascii_ids(samples.ids, "ids")
    text = {
        "meta": samples.meta,
        "seed": samples.seed,
        "single": single,
        "axes": _axes_to_plain(samples.axes),
        "grid": {"sha256": content_sha256(samples.grid), "text": repr(samples.grid)},
        "n_draws": samples.n_draws,
    }
    table = Table(dict(samples._per_object()))
    shares = {
        f"SHARE{i}": np.asarray(axis.share, dtype=float)
        for i, axis in enumerate(samples.axes.values())
        if axis.share is not None
    }
    tables = {"SAMPLES": table}
    write_parts(path, _SAMPLES, text=text, arrays=shares, tables=tables, overwrite=overwrite)


def read_samples(path, grid, *, model=None):
    """
    Read samples, with the grid that was fitted and, if it is known, its model.

    Raises
    ------
    ValueError
        If the grid is another.
    """
    if not isinstance(grid, ModelGrid):
        raise argument_error("grid", "the ModelGrid that was fitted", type(grid).__name__)
    with open_parts(path, (_SAMPLES,), wanted="samples") as parts:
        text, table = parts.text, parts.table("SAMPLES")
        n, n_draws = len(table), int(text["n_draws"])
        columns = {name: native(table[name]) for name in ("ids", "flags", "index", "scale")}
        columns["index"] = columns["index"].reshape(n, n_draws, 4)
        columns["scale"] = columns["scale"].reshape(n, n_draws)
        shares = {
            name: parts.array(f"SHARE{i}")
            for i, name in enumerate(text["axes"])
            if f"SHARE{i}" in parts
        }
        axes = _axes_from_plain(text["axes"], shares)
        known, whose, meta = text["grid"]["sha256"], text["grid"]["text"], text["meta"]
        # earlier files have it in the meta
        seed = int(text.get("seed", meta.get("seed", 0)))
    if content_sha256(grid) != known:
        raise argument_error("grid", f"the one of the samples, {whose}", f"another, {grid!r}")
    samples = Samples(grid=grid, model=model, meta=meta, axes=axes, seed=seed, **columns)
    return samples._take(0) if text.get("single") else samples


def _axes_to_plain(axes):
    """Turn axes without their shares into what JSON knows."""
    return {
        name: {
            "values": axis.values,
            "unit": u.Unit(axis.unit).to_string(),
            "kind": axis.kind,
            "weights": axis.weights,
            "bounds": list(axis.bounds),
        }
        for name, axis in axes.items()
    }


def _axes_from_plain(text, shares=None):
    """Make axes of what `_axes_to_plain` returned; ``shares`` by name are part of them."""
    return {
        name: GridAxis(
            name,
            np.array(axis["values"]),
            u.Unit(axis["unit"]),
            axis["kind"],
            np.array(axis["weights"]),
            (shares or {}).get(name),
            tuple(axis["bounds"]),
        )
        for name, axis in text.items()
    }


def _write_table(results, path, *, overwrite=False):
    """Write the table of `FitResults.to_table` or `Samples.to_table`."""
    results.to_table().write(path, format="ascii.ecsv", overwrite=overwrite)


register(FitResults, read=read_results, write=write_results)
register(FitResults, write=_write_table, name="ascii.ecsv")
register(Samples, read=read_samples, write=write_samples)
register(Samples, write=_write_table, name="ascii.ecsv")
