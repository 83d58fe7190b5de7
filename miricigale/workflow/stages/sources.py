"""Pages on which the sources of a truth are looked at one by one, beside the report."""

import dataclasses
import json
from importlib import resources

import astropy.units as u
import numpy as np
from astropy.table import QTable
from markupsafe import Markup
from matplotlib.colors import to_hex

from miricigale import fitting, photometry, sed
from miricigale.evaluation import OUTLIER, AssociationFlags
from miricigale.filters import Filter
from miricigale.pages import render
from miricigale.utils.tables import error_column
from miricigale.utils.units import FNU, WAVE, ab_magnitude
from miricigale.workflow.page.labels import SET_COLORS, SET_LABELS, band_label
from miricigale.workflow.stage import stage
from miricigale.workflow.stages.conditions import ConditionFlags, any_condition
from miricigale.workflow.stages.cutouts import Cutouts
from miricigale.workflow.stages.exposures import bands_of_truth
from miricigale.workflow.stages.inputs import sed_resources
from miricigale.workflow.stages.sample import SampleFlags
from miricigale.workflow.truths import of_truth, truth_names

__all__ = ["CHUNK", "make_sources"]

#: Sources whose details and pictures are in one file.
CHUNK = 32
#: Cells of the spectra, evenly spaced in the logarithm of wavelength.
N_WAVE = 240
#: Parameters whose posteriors are drawn.
DRAWN = ("redshift", "frac_agn")
#: The flags that the page explains, by what it calls them.
FLAGS = {
    "selection": SampleFlags,
    "condition": ConditionFlags,
    "fit": fitting.FitFlags,
    "photometry": photometry.ForcedFlags,
    "association": AssociationFlags,
}


@stage(
    "sources",
    "source browser",
    needs={
        "truth": of_truth,
        "mosaics": bands_of_truth,
        "highres": None,
        "photometry": bands_of_truth,
        "matches": of_truth,
        "fits": lambda config, unit: [f"{unit}/{name}" for name in config.fit.sets],
    },
    sections=(
        "run.name",
        "exposures.filters",
        "highres.filter",
        "highres.pixel_scale",
        "photometry.method",
        "reduction.pixel_scale",
        "fit.bands",
        "fit.sets",
        "report.pictures",
    ),
    resources=sed_resources,
    units=truth_names,
    plan=lambda config, _: list(truth_names(config)),
    kernels=("fit",),
)
def make_sources(context, name):
    """Beside stage 14: the page of a truth, and what it shows of its sources, `CHUNK` in a file."""
    tables = _Tables.read(context, name)
    cutouts = Cutouts.read(context, name)
    imaged = cutouts.on_image(tables.truth["sky"])
    shown = tables.first_of(imaged, context.config.report.pictures)
    # those of a file are near to each other in the page, and those without pictures come last
    order = np.argsort(~shown, kind="stable")
    folder = f"report/sources/{name}"
    details = _Details(tables)
    for k, first in enumerate(range(0, len(order), CHUNK)):
        rows = order[first : first + CHUNK]
        pictured = rows[shown[rows]]
        tops = {}
        if pictured.size:
            sheet, limits = cutouts.sheet(tables.truth["sky"][pictured])
            tops = dict(zip(pictured, limits, strict=True))
            context.save(f"{folder}/{k:03d}.png", lambda path, sheet=sheet: sheet.save(path))
        entries = [
            details.entry(row)
            | {"top": _rounded(tops[row]) if row in tops else None, "imaged": bool(imaged[row])}
            for row in rows
        ]
        text = f"loaded({k}, {_json(entries)});\n"
        context.save(f"{folder}/{k:03d}.js", lambda path, text=text: path.write_text(text, "utf-8"))
    facts = {
        "truth": name,
        "truths": context.plan,
        "chunk": CHUNK,
        "outlier": OUTLIER,
        "pictured": int(shown.sum()),
        "prior": band_label(context.config.highres.filter),
        "cutouts": cutouts.describe(),
        "flags": {kind: flags.meanings() for kind, flags in FLAGS.items()},
        **details.describe(),
        "table": _table(tables, order),
    }
    page = _page(context.config, name, facts)
    context.save(f"report/sources-{name}.html", lambda path: path.write_text(page, "utf-8"))


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class _Tables:
    """
    What the page shows of a truth.

    ``truth`` and ``matched`` have the same sources row by row; ``results`` are those of each set of
    bands, and ``fits`` their tables; ``fitted_row`` is the row of each source in these, -1 without.
    """

    truth: QTable
    matched: QTable
    results: dict
    fits: dict
    fitted_row: np.ndarray
    bands: tuple
    miri: tuple
    prior: str

    @classmethod
    def read(cls, context, name):
        """Read the products of a truth."""
        config = context.config
        matched = QTable.read(context.path(f"{name}/matched.ecsv"))
        results = {
            chosen: fitting.FitResults.read(context.path(f"{name}/fits_{chosen}.fits"))
            for chosen in config.fit.sets
        }
        sample = np.asarray(matched["selection"]) == 0
        miri = tuple(config.exposures.filters)
        bands = (*(band for band in config.fit.bands if band not in miri), *miri)
        return cls(
            QTable.read(context.path(f"{name}/truth.ecsv")),
            matched,
            results,
            {chosen: found.to_table() for chosen, found in results.items()},
            np.where(sample, np.cumsum(sample) - 1, -1),
            bands,
            miri,
            config.highres.filter,
        )

    @property
    def compared(self):
        """The sets in the table and the figure of the spectrum: with and without MIRI."""
        pair = [name for name in ("all", "none") if name in self.results]
        return pair or list(self.results)[:2]

    def first_of(self, rows, n):
        """Which of some rows (bool) are shown if at most ``n`` can be: fitted ones, then the brightest."""
        bright = np.nan_to_num(self.truth[self.prior].value, nan=-np.inf)
        order = np.lexsort((-bright, self.fitted_row < 0, ~rows))
        first = np.zeros(len(rows), bool)
        first[order[:n]] = True
        return first & rows

    def of_sources(self, values):
        """Values of the rows of the fits as values of the sources, NaN without a fit."""
        values, out = np.asarray(values, float), np.full(len(self.truth), np.nan)
        sample = self.fitted_row >= 0
        out[sample] = values[self.fitted_row[sample]]
        return out


def _table(tables, order):
    """Columns of the table of all sources, in the order of the files."""
    truth, matched = tables.truth, tables.matched
    columns = {
        "id": truth["id"],
        "mag": ab_magnitude(truth[tables.prior]),
        "ra": truth["sky"].ra.deg,
        "dec": truth["sky"].dec.deg,
        "redshift": truth["redshift"],
        "frac_agn": truth["frac_agn"],
    }
    digits = {"mag": 5, "ra": 9, "dec": 9}
    for name in tables.compared:
        fits, results = tables.fits[name], tables.results[name]
        for parameter in DRAWN:
            if f"{parameter}_mean" in fits.colnames:
                mean = tables.of_sources(fits[f"{parameter}_mean"])
                columns[f"{parameter}_{name}"] = mean
        columns[f"chi2_{name}"] = tables.of_sources(results.reduced_chi2)
    for name in tables.miri:
        flux, error = matched[name].value, matched[error_column(name)].value
        columns[f"sn_{name}"] = np.divide(
            flux, error, out=np.full(len(flux), np.nan), where=error > 0
        )
        digits[f"sn_{name}"] = 3
    columns["n_detected"] = matched["n_detected"]
    columns["selection"] = matched["selection"]
    columns["condition"] = any_condition(matched, tables.miri)
    columns["association"] = matched["association"]
    for name, results in tables.results.items():
        columns[f"fit_{name}"] = np.nan_to_num(tables.of_sources(results.flags)).astype(int)
    return {
        name: _rounded(np.asarray(values)[order], digits.get(name, 4))
        for name, values in columns.items()
    }


class _Details:
    """What the page shows of single sources: photometry, spectra, posteriors, parameters, flags."""

    def __init__(self, tables):
        self.tables, self.model = tables, sed.SEDModel.yang2021()
        truth, matched, every = tables.truth, tables.matched, list(tables.results.values())
        self.pivots = np.array([Filter.from_name(name).pivot.value for name in tables.bands])
        self.edges = np.geomspace(0.7 * self.pivots.min(), 1.4 * self.pivots.max(), N_WAVE + 1)
        self.units = {
            name: every[0].unit(name)
            for name in every[0].parameters
            if name in truth.colnames and all(name in results.parameters for results in every)
        }
        self.true = np.transpose([truth[name].to_value(FNU) for name in tables.bands])
        # columns without a unit are in that of the parameter
        self.parameters = np.transpose(
            [u.Quantity(truth[name], unit, dtype=float).value for name, unit in self.units.items()]
        )
        self.flux, self.error = np.full((2, *self.true.shape), np.nan)
        for k, name in enumerate(tables.bands):
            if name in tables.miri:
                self.flux[:, k] = matched[name].to_value(FNU)
                self.error[:, k] = matched[error_column(name)].to_value(FNU)
                continue
            # the mock fluxes of the sample, which all sets share
            at = every[0].filters.index(name)
            self.flux[:, k] = tables.of_sources(every[0].flux[:, at])
            self.error[:, k] = tables.of_sources(every[0].flux_err[:, at])
        self.moments = {
            name: np.array(
                [
                    [results.mean(p).to_value(unit), results.std(p).to_value(unit)]
                    for p, unit in self.units.items()
                ]
            )
            for name, results in tables.results.items()
        }

    def describe(self):
        """What all sources have in common."""
        tables = self.tables
        return {
            "sets": [
                {"name": name, "label": SET_LABELS[name], "color": to_hex(SET_COLORS[name])}
                for name in tables.results
            ],
            "compared": tables.compared,
            "bands": [
                {
                    "name": name,
                    "label": band_label(name),
                    "wave": _rounded(wave),
                    "miri": name in tables.miri,
                }
                for name, wave in zip(tables.bands, self.pivots, strict=True)
            ],
            "wave": _rounded(np.sqrt(self.edges[1:] * self.edges[:-1])),
            "pdf_edges": {
                name: {
                    parameter: _rounded(results.distribution(parameter)[0].value)
                    for parameter in _drawn(results)
                }
                for name, results in tables.results.items()
            },
            "parameters": [
                {"name": name, "unit": unit.to_string()} for name, unit in self.units.items()
            ],
        }

    def entry(self, row):
        """What belongs to the source in a row of the truth."""
        tables, at = self.tables, int(self.tables.fitted_row[row])
        entry = {
            "id": tables.truth["id"][row].item(),
            "true": _rounded(self.true[row]),
            "flux": _rounded(self.flux[row]),
            "error": _rounded(self.error[row], 3),
            "flags": [int(tables.matched[f"{name}_flags"][row]) for name in tables.miri],
            "conditions": [int(tables.matched[f"{name}_condition"][row]) for name in tables.miri],
            "parameters": _rounded(self.parameters[row]),
        }
        if at >= 0:
            entry["fits"] = {name: self._fit(name, at) for name in tables.results}
        return entry

    def _fit(self, name, at):
        """Chi2, posteriors and moments of a row of the fits, and the spectrum of its best model."""
        results = self.tables.results[name]
        one = results[results.ids[at]]
        if not one.fitted:
            return None
        fit = {
            "chi2": _rounded(one.chi2),
            "n_bands": int(one.n_bands),
            "moments": _rounded(self.moments[name][:, :, at]),
            "pdf": {parameter: _weights(one.pdf[parameter]) for parameter in _drawn(results)},
        }
        if name in self.tables.compared:
            spectrum = one.best_sed(self.model)
            means = _cell_means(
                spectrum.wave.to_value(WAVE), spectrum.fnu.to_value(FNU), self.edges
            )
            fit["spectrum"] = _milli_dex(means)
        return fit


def _drawn(results):
    """Those of the drawn parameters that a fit has posteriors of."""
    return [name for name in DRAWN if name in results.axes]


def _weights(pdf):
    """Posterior weights in thousandths: index of the first cell that is not empty, and the weights."""
    weights = np.round(1000 * pdf).astype(int)
    filled = np.flatnonzero(weights)
    if filled.size == 0:
        return [0, []]
    return [int(filled[0]), weights[filled[0] : filled[-1] + 1].tolist()]


def _cell_means(x, y, edges):
    """Means of a function, given by points that straight lines join, between edges."""
    steps = 0.5 * (y[1:] + y[:-1]) * np.diff(x)
    total = np.concatenate([[0.0], np.cumsum(steps)])
    return np.diff(np.interp(edges, x, total)) / np.diff(edges)


def _milli_dex(values):
    """Thousandths of log10 of values; None where they are not positive."""
    return [round(1000 * np.log10(value)) if value > 0 else None for value in values]


def _rounded(values, digits=4):
    """Plain numbers of so many significant digits, None for NaN; text, integers and flags as they are."""
    values = np.asarray(values)
    if values.ndim:
        return [_rounded(value, digits) for value in values]
    if values.dtype.kind != "f":
        return values.item()
    if not np.isfinite(values):
        return None
    value = float(f"{float(values):.{digits}g}")
    return int(value) if value.is_integer() and abs(value) < 1e9 else value


def _json(values):
    """JSON that may stand in a script of a page."""
    text = json.dumps(values, separators=(",", ":"), allow_nan=False)
    # no tag and no comment of HTML can begin in it
    return text.replace("<", "\\u003c")


def _page(config, name, facts):
    """The page as text: the facts and the script are part of it."""
    script = resources.files("miricigale.pages") / "templates" / "sources.js"
    return render(
        "sources.html",
        title=f"{config.run.name}: sources of {name}",
        facts=Markup(_json(facts)),
        script=Markup(script.read_text("utf-8")),
    )
