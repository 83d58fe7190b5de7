"""The source browser: pages that show the sources of a truth one by one, linked from the report."""

import json
from importlib import resources

import astropy.units as u
import numpy as np
from markupsafe import Markup
from matplotlib.colors import to_hex

from miricigale import fitting, photometry, sed
from miricigale.evaluation import OUTLIER, AssociationFlags
from miricigale.filters import Filter
from miricigale.pages import render
from miricigale.utils.tables import error_column
from miricigale.utils.units import FNU, WAVE, ab_magnitude
from miricigale.workflow.engine.stage import stage
from miricigale.workflow.page.labels import SET_COLORS, SET_LABELS, band_label
from miricigale.workflow.page.numbers import StudyTables
from miricigale.workflow.stages.conditions import ConditionFlags, any_condition
from miricigale.workflow.stages.cutouts import Cutouts
from miricigale.workflow.stages.exposures import KERNEL
from miricigale.workflow.stages.inputs import existing_bands, sed_resources
from miricigale.workflow.stages.sample import SampleFlags
from miricigale.workflow.truths import truth_names

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
    version=2,
    needs=("truth", "mosaics", "highres", "photometry", "matches", "fits"),
    sections=("run.name", "catalog", *KERNEL, "photometry", "fit", "report"),
    resources=sed_resources,
    units=truth_names,
    plan=lambda config, _: list(truth_names(config)),
)
def make_sources(context, name):
    """Stage 14, in addition: the page of a truth, and what it shows of its sources, `CHUNK` in a file."""
    tables, cutouts = _Sources(context, name), Cutouts.read(context, name)
    sky = tables.truth["sky"]
    imaged = cutouts.on_image(sky)
    shown = tables.first_of(imaged, context.config.report.pictures)
    # those of a file are near to each other in the page, and those without pictures come last
    order = np.argsort(~shown, kind="stable")
    for k, first in enumerate(range(0, len(order), CHUNK)):
        rows, stem, tops = order[first : first + CHUNK], f"report/sources/{name}/{k:03d}", {}
        pictured = rows[shown[rows]]
        if pictured.size:
            sheet, limits = cutouts.sheet(sky[pictured])
            tops = dict(zip(pictured, _rounded(limits), strict=True))
            context.save(f"{stem}.png", sheet.save)
        entries = [
            tables.entry(row) | {"top": tops.get(row), "imaged": bool(imaged[row])} for row in rows
        ]
        _save_text(context, f"{stem}.js", f"loaded({k}, {_json(entries)});\n")
    facts = {
        "truth": name,
        "truths": context.plan,
        "chunk": CHUNK,
        "outlier": OUTLIER,
        "pictured": int(shown.sum()),
        "prior": band_label(tables.prior),
        "cutouts": cutouts.describe(),
        "flags": {kind: flags.meanings() for kind, flags in FLAGS.items()},
        **tables.describe(),
        "table": tables.columns(order),
    }
    script = resources.files("miricigale.pages") / "templates" / "sources.js"
    page = render(
        "sources.html",
        title=f"{context.config.run.name}: sources of {name}",
        facts=Markup(_json(facts)),
        script=Markup(script.read_text("utf-8")),
    )
    _save_text(context, f"report/sources-{name}.html", page)


def _save_text(context, name, text):
    context.save(name, lambda path: path.write_text(text, "utf-8"))


class _Sources(StudyTables):
    """What the page shows of a truth: photometry, spectra, posteriors, parameters and flags of its sources."""

    def __init__(self, context, name):
        super().__init__(context, name)
        config, truth = context.config, self.truth
        self.model, self.prior = sed.SEDModel.yang2021(), config.highres.filter
        self.miri = tuple(config.exposures.filters)
        existing = (band for band in existing_bands(config) if band not in self.miri)
        self.bands = (*existing, *self.miri)
        self.pivots = np.array([Filter.from_name(band).pivot.value for band in self.bands])
        self.edges = np.geomspace(0.7 * self.pivots.min(), 1.4 * self.pivots.max(), N_WAVE + 1)
        self.sampled = np.asarray(self.matched["selection"]) == 0
        # with and without MIRI: the sets in the table and the figure of the spectrum
        both = [unit for unit in ("all", "none") if unit in self.results]
        self.compared = both or list(self.results)[:2]
        # all sets are fitted with the same model
        fitted = next(iter(self.results.values()))
        known = [name for name in fitted.parameters if name in truth.colnames]
        self.units = {name: fitted.unit(name) for name in known}
        # columns without a unit are in that of the parameter
        values = (u.Quantity(truth[k], unit, dtype=float) for k, unit in self.units.items())
        self.parameters = np.transpose([one.value for one in values])
        self.true = np.transpose([truth[band].to_value(FNU) for band in self.bands])
        pairs = zip(*map(self._measured, self.bands), strict=True)
        self.flux, self.error = map(np.transpose, pairs)

    def _measured(self, band):
        """Fluxes of all sources in a band and their errors; mock fluxes are of the sample, and of all sets."""
        if band in self.miri:
            return [self.matched[key].to_value(FNU) for key in (band, error_column(band))]
        results = next(iter(self.results.values()))
        at = results.filters.index(band)
        return [self.of_sources(values[:, at]) for values in (results.flux, results.flux_err)]

    def of_sources(self, values):
        """Values of the rows of the fits as values of the sources, NaN without a fit."""
        out = np.full(len(self.truth), np.nan)
        out[self.sampled] = values
        return out

    def first_of(self, rows, n):
        """Which of some rows (bool) are shown if at most ``n`` can be: fitted ones, then the brightest."""
        bright = np.nan_to_num(self.truth[self.prior].value, nan=-np.inf)
        order = np.lexsort((-bright, ~self.sampled, ~rows))
        first = np.zeros(len(rows), bool)
        first[order[:n]] = True
        return first & rows

    def columns(self, order):
        """Columns of the table of all sources, in the order of the files."""
        truth, matched = self.truth, self.matched
        columns = {
            "id": truth["id"],
            "mag": ab_magnitude(truth[self.prior]),
            "ra": truth["sky"].ra.deg,
            "dec": truth["sky"].dec.deg,
            "redshift": truth["redshift"],
            "frac_agn": truth["frac_agn"],
        }
        digits = {"mag": 5, "ra": 9, "dec": 9}
        for unit in self.compared:
            fits = self.fits[unit]
            for parameter in DRAWN:
                columns[f"{parameter}_{unit}"] = self.of_sources(fits[f"{parameter}_mean"])
            columns[f"chi2_{unit}"] = self.of_sources(self.results[unit].reduced_chi2)
        for band in self.miri:
            flux, error = self._measured(band)
            none = np.full(len(flux), np.nan)
            columns[f"sn_{band}"] = np.divide(flux, error, out=none, where=error > 0)
            digits[f"sn_{band}"] = 3
        columns |= {key: matched[key] for key in ("n_detected", "selection", "association")}
        columns["condition"] = any_condition(matched, self.miri)
        for unit, results in self.results.items():
            columns[f"fit_{unit}"] = np.nan_to_num(self.of_sources(results.flags)).astype(int)
        return {
            key: _rounded(np.asarray(values)[order], digits.get(key, 4))
            for key, values in columns.items()
        }

    def describe(self):
        """What all sources have in common."""
        return {
            "sets": [
                {"name": unit, "label": SET_LABELS[unit], "color": to_hex(SET_COLORS[unit])}
                for unit in self.results
            ],
            "compared": self.compared,
            "bands": [
                {"name": name, "label": band_label(name), "wave": wave, "miri": name in self.miri}
                for name, wave in zip(self.bands, _rounded(self.pivots), strict=True)
            ],
            "wave": _rounded(np.sqrt(self.edges[1:] * self.edges[:-1])),
            "pdf_edges": {
                unit: {key: _rounded(found.distribution(key)[0].value) for key in DRAWN}
                for unit, found in self.results.items()
            },
            "parameters": [{"name": key, "unit": str(unit)} for key, unit in self.units.items()],
        }

    def entry(self, row):
        """What belongs to the source in a row of the truth."""
        entry = {
            "id": self.truth["id"][row].item(),
            "true": _rounded(self.true[row]),
            "flux": _rounded(self.flux[row]),
            "error": _rounded(self.error[row], 3),
            "flags": [int(self.matched[f"{band}_flags"][row]) for band in self.miri],
            "conditions": [int(self.matched[f"{band}_condition"][row]) for band in self.miri],
            "parameters": _rounded(self.parameters[row]),
        }
        if self.sampled[row]:
            entry["fits"] = {unit: self._fit(unit, entry["id"]) for unit in self.results}
        return entry

    def _fit(self, unit, key):
        """Chi2, posteriors and moments of a source, and the spectrum of its best model."""
        one = self.results[unit].loc[key]
        if not one.fitted:
            return None
        fit = {
            "chi2": _rounded(one.chi2),
            "n_bands": int(one.n_bands),
            "moments": [
                [_rounded(moment(name).to_value(own)) for moment in (one.mean, one.std)]
                for name, own in self.units.items()
            ],
            "pdf": {name: _weights(one.pdf[name]) for name in DRAWN},
        }
        if unit in self.compared:
            best = one.best_sed(self.model)
            means = _cell_means(best.wave.to_value(WAVE), best.fnu.to_value(FNU), self.edges)
            # thousandths of log10
            fit["spectrum"] = [round(1000 * np.log10(x)) if x > 0 else None for x in means]
        return fit


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
