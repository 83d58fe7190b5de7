"""The source browser: pages that show the sources of a truth one by one, linked from the report."""

import astropy.units as u
import numpy as np
from matplotlib.colors import to_hex

from miricigale import fitting, photometry, sed
from miricigale.evaluation import OUTLIER, AssociationFlags
from miricigale.filters import Filter
from miricigale.pages.browser import (
    N_WAVE,
    band_entries,
    cell_weights,
    image_note,
    list_column,
    moments_of,
    parameter_entries,
    rounded,
    shown_unit,
    source_pages,
    spectrum_edges,
    thousandths_of_log,
)
from miricigale.plotting.cutouts import Cutouts
from miricigale.sed.cells import cell_means
from miricigale.utils.arrays import quotient, spread_over
from miricigale.utils.missing_values import floats
from miricigale.utils.named_values import first_value
from miricigale.utils.tables import error_column
from miricigale.utils.units import FNU, WAVE, ab_magnitude
from miricigale.workflow.engine.stage import stage
from miricigale.workflow.labels import SET_COLORS, SET_LABELS, band_label
from miricigale.workflow.page.numbers import StudyTables
from miricigale.workflow.stages.conditions import ConditionFlags, any_condition, has_flag
from miricigale.workflow.stages.exposures import KERNEL
from miricigale.workflow.stages.grids import of_patch, shown_patch, study_patches
from miricigale.workflow.stages.images import measured_mosaic
from miricigale.workflow.stages.inputs import existing_bands, sed_resources, sources_memory
from miricigale.workflow.stages.sample import SampleFlags, is_sample
from miricigale.workflow.truths import truth_names

#: Parameters whose posteriors are drawn.
DRAWN = ("redshift", "frac_agn")
#: What the table of sources has of each: AGN are selected by the median.
_VALUES = {"redshift": "mean", "frac_agn": "p50"}
#: Dashes of the lines of sets of bands.
_DASHES = {"none": "5 3", "blue": "1.5 2", "red": "8 2 1.5 2"}
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
    version=3,
    needs=("truth", "mosaics", "highres", "photometry", "matches", "fits"),
    sections=("run.name", "catalog") + KERNEL + ("photometry", "fit", "report"),
    resources=sed_resources,
    units=truth_names,
    # the prior of the patch that is shown is of no truth
    reads=lambda config, unit: [unit, f"{unit}/{shown_patch(config)}"],
    plan=lambda config, _: list(truth_names(config)),
    memory=sources_memory,
)
def make_sources(context, name):
    """Stage 14, in addition: the page of a truth, and what it shows of its sources."""
    config = context.config
    tables = _Sources(context, name)
    suffix, _ = measured_mosaic(config)
    # pictures are of one patch where there are more
    patch = shown_patch(config)
    bands = {}
    for band in study_patches(config)[patch].bands:
        mosaic = of_patch(f"{name}/mosaic_{band}{suffix}", patch)
        measured = of_patch(f"{name}/photometry/{band}", patch)
        paths = (f"{mosaic}.fits", f"{measured}_model.fits", f"{measured}_residual.fits")
        bands[band] = [context.image(path) for path in paths]
    cutouts = Cutouts(context.image(f"{of_patch('f160w', patch)}.fits"), bands)
    sky = tables.truth["sky"]
    imaged = cutouts.on_image(sky)
    shown = tables.first_of(imaged, config.report.pictures)
    # those of a file are near to each other in the page, and those without pictures come last
    order = np.argsort(~shown, kind="stable")
    layout = cutouts.describe()
    facts = {
        "own": name,
        "truths": context.plan,
        "line": "truth",
        "prior": band_label(tables.prior),
        "cutouts": layout,
        "flags": {kind: flags.meanings() for kind, flags in FLAGS.items()},
        **tables.describe(),
        "table": tables.columns(order),
        "notes": {
            "pictured": f"{shown.sum()} sources have pictures, those that were fitted first, then the brightest "
            "([report] pictures).",
            "images": image_note(
                layout, "north up, east left; circle: 1 arcsec about the true position"
            ),
            "spectrum": f"Arrows: three times the error, where the flux is below its error. Models are means over "
            f"{N_WAVE} cells of wavelength. Existing bands have mock fluxes for fitted sources only.",
        },
    }
    source_pages(
        context.save,
        "report",
        (f"sources-{name}", f"sources/{name}"),
        f"{config.run.name}: sources of {name}",
        facts,
        order,
        shown,
        lambda row: tables.entry(row) | {"imaged": bool(imaged[row])},
        lambda rows: cutouts.sheet(sky[rows]),
    )


class _Sources(StudyTables):
    """Photometry, spectra, posteriors, parameters and flags of the sources of a truth, as the page has them."""

    def __init__(self, context, name):
        super().__init__(context, name)
        config = context.config
        truth = self.truth
        self.model = sed.SEDModel.yang2021()
        self.prior = config.highres.filter
        self.miri = tuple(config.exposures.filters)
        existing = (band for band in existing_bands(config) if band not in self.miri)
        self.bands = (*existing, *self.miri)
        self.pivots = np.array([Filter.from_name(band).pivot.value for band in self.bands])
        self.edges = spectrum_edges(self.pivots)
        self.sampled = is_sample(self.matched)
        # with and without MIRI: the sets in the table and the figure of the spectrum
        self.compared = [unit for unit in ("all", "none") if unit in self.results]
        if not self.compared:
            self.compared = list(self.results)[:2]
        # all sets are fitted with the same model
        fits = first_value(self.results).first
        self.units = {}
        parameters = []
        for parameter in fits.parameters:
            if parameter in truth.colnames:
                unit = shown_unit(fits.unit(parameter))
                self.units[parameter] = unit
                # columns without a unit are in that of the parameter
                parameters.append(u.Quantity(truth[parameter], unit, dtype=float).value)
        self.parameters = np.transpose(parameters)
        self.true = np.transpose([truth[band].to_value(FNU) for band in self.bands])
        measured = [self._measured(band) for band in self.bands]
        self.flux = np.transpose([flux for flux, _ in measured])
        self.error = np.transpose([error for _, error in measured])

    def _measured(self, band):
        """Return fluxes and errors (uJy) of all sources in a band; mock ones are of the sample alone."""
        if band in self.miri:
            flux = self.matched[band].to_value(FNU)
            return flux, self.matched[error_column(band)].to_value(FNU)
        results = first_value(self.results)
        k = results.first.filters.index(band)
        flux = self.of_sources(results.of("flux")[:, k])
        return flux, self.of_sources(results.of("flux_err")[:, k])

    def of_sources(self, values):
        """Return values of the rows of the fits as values of the sources, NaN without a fit."""
        return spread_over(values, self.sampled, len(self.truth))

    def first_of(self, rows, n):
        """Tell which of some rows (bool) are shown if at most ``n`` can be: fitted ones, then the brightest."""
        bright = np.nan_to_num(self.truth[self.prior].value, nan=-np.inf)
        order = np.lexsort((-bright, ~self.sampled, ~rows))
        first = np.zeros(len(rows), bool)
        first[order[:n]] = True
        return first & rows

    def columns(self, order):
        """Return columns of the table of all sources, in the order of the files."""
        truth = self.truth
        matched = self.matched
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
                value = fits[f"{parameter}_{_VALUES[parameter]}"]
                columns[f"{parameter}_{unit}"] = self.of_sources(value)
            columns[f"chi2_{unit}"] = self.of_sources(fits["reduced_chi2"])
        for band in self.miri:
            flux, error = self._measured(band)
            columns[f"sn_{band}"] = quotient(flux, error, np.nan)
            digits[f"sn_{band}"] = 3
        for key in ("n_detected", "selection", "association"):
            columns[key] = matched[key]
        in_field = ~has_flag(matched, "selection", SampleFlags.OUTSIDE_FIELD)
        columns |= {"in_field": in_field, "sample": self.sampled}
        columns["left"] = in_field & ~self.sampled
        z = floats(truth["redshift"])
        for unit in self.compared:
            with np.errstate(invalid="ignore"):
                columns[f"outlier_{unit}"] = (
                    abs(columns[f"redshift_{unit}"] - z) / (1 + z) > OUTLIER
                )
        of_sets = [columns[f"outlier_{unit}"] for unit in self.compared]
        columns["outlier"] = np.any(of_sets, axis=0)
        columns["condition"] = any_condition(matched, self.miri)
        for unit, fits in self.fits.items():
            columns[f"fit_{unit}"] = np.nan_to_num(self.of_sources(fits["flags"])).astype(int)
        for key, values in columns.items():
            columns[key] = rounded(np.asarray(values)[order], digits.get(key, 4))
        return columns

    def describe(self):
        """Return what all sources have in common."""
        sets = []
        edges = {}
        for unit, results in self.results.items():
            color = to_hex(SET_COLORS[unit])
            dash = _DASHES.get(unit)
            sets.append({"name": unit, "label": SET_LABELS[unit], "color": color, "dash": dash})
            edges[unit] = {}
            for key in DRAWN:
                edges[unit][key] = rounded(results.first.distribution(key)[0].value)
        labels = map(band_label, self.bands)
        shows = {
            "field": ["in the field", "in_field"],
            "all": ["all of the catalog", None],
            "sample": ["the sample (fitted)", "sample"],
            "left": ["in the field, not fitted", "left"],
        }
        for unit in self.compared:
            shows[f"outliers_{unit}"] = [f"outliers in z {SET_LABELS[unit]}", f"outlier_{unit}"]
        shows["outliers"] = ["outliers in z of either", "outlier"]
        flag_columns = [[key, key, ""] for key in ("selection", "condition", "association")]
        heading = [["ra", "RA", 6], ["dec", "Dec", 6], ["mag", band_label(self.prior), 2]]
        heading += [["redshift", "true z", 4], ["frac_agn", "true fracAGN", 3]]
        for unit in self.fits:
            flag_columns.append([f"fit_{unit}", "fit", f"fit {SET_LABELS[unit]}"])
        return {
            "sets": sets,
            "columns": self._list_columns(),
            "shows": shows,
            "flag_columns": flag_columns,
            "heading": heading,
            "bands": band_entries(self.bands, labels, self.pivots, miri=self.miri),
            "wave": rounded(np.sqrt(self.edges[1:] * self.edges[:-1])),
            "pdf_edges": edges,
            "parameters": parameter_entries(self.units),
        }

    def _list_columns(self):
        """Describe the columns of the list of sources."""
        prior = band_label(self.prior)
        title = "true AB magnitude in the band of the prior"
        columns = [list_column("id", "id", "id of the catalog")]
        columns.append(list_column("mag", prior, title, digits=2))
        for key, group, digits, value in (
            ("redshift", "redshift", 3, "mean"),
            ("frac_agn", "fracAGN", 2, "median"),
        ):
            columns.append(list_column(key, "true", "injected", group=group, digits=digits))
            for unit in self.compared:
                options = {"group": group, "digits": digits}
                if key == "redshift":
                    options["off"] = f"outlier_{unit}"
                label = SET_LABELS[unit]
                title = f"posterior {value}, {label}"
                columns.append(list_column(f"{key}_{unit}", label, title, **options))
        title = "measured flux over the error of the error function"
        for band in self.miri:
            key = f"sn_{band}"
            columns.append(list_column(key, band_label(band), title, group="S/N", digits=1))
        columns.append(list_column("n_detected", "bands", "MIRI bands above 5 sigma", group=" "))
        for unit in self.compared:
            options = {"group": "reduced χ²", "digits": 2}
            columns.append(
                list_column(f"chi2_{unit}", SET_LABELS[unit], "of the best model", **options)
            )
        title = "why it is not fitted, conditions, flags of the fits"
        columns.append(list_column("flags", "in words", title, group="flags", text=True))
        return columns

    def entry(self, row):
        """Return what belongs to the source in a row of the truth."""
        entry = {
            "id": self.truth["id"][row].item(),
            "true": rounded(self.true[row]),
            "flux": rounded(self.flux[row]),
            "error": rounded(self.error[row], 3),
            "bits": {
                "condition": [int(self.matched[f"{band}_condition"][row]) for band in self.miri],
                "photometry": [int(self.matched[f"{band}_flags"][row]) for band in self.miri],
            },
            "parameters": rounded(self.parameters[row]),
        }
        if self.sampled[row]:
            entry["fits"] = {unit: self._fit(unit, entry["id"]) for unit in self.results}
        return entry

    def _fit(self, unit, key):
        """Return chi2, posteriors and moments of a source, and the spectrum of its best model."""
        result = self.results[unit].loc[key]
        if not result.fitted:
            return None
        fit = {
            "chi2": rounded(result.chi2),
            "n_bands": int(result.n_bands),
            "moments": moments_of(result, self.units),
            "pdf": {name: cell_weights(result.pdf[name]) for name in DRAWN},
        }
        if unit in self.compared:
            best = result.best_sed(self.model)
            means = cell_means(best.wave.to_value(WAVE), best.fnu.to_value(FNU), self.edges)
            fit["spectrum"] = thousandths_of_log(means)
        return fit
