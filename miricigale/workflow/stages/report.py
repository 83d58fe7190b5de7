"""Stage 14: truth and results to numbers, figures and one page."""

import json
import logging

import astropy.units as u
import numpy as np

from miricigale import sed
from miricigale.evaluation import (
    Missing,
    Report,
    number,
)
from miricigale.workflow.stage import stage
from miricigale.workflow.stages import (
    comparison,
    conditions,
    experiments,
    figures,
    perturbed,
    pictures,
    provenance,
    rivals,
)
from miricigale.workflow.stages.exposures import EXPOSURE_RESOURCES, GRID, exposure_plan
from miricigale.workflow.stages.figures import SET_LABELS, band_label
from miricigale.workflow.stages.images import measured_mosaic
from miricigale.workflow.stages.inputs import sed_resources
from miricigale.workflow.stages.metrics import StudyTables, study_metrics, truth_metrics
from miricigale.workflow.stages.sample import SampleFlags, footprint_area, typical_source
from miricigale.workflow.truths import reference, study_truths

__all__ = ["make_report"]

log = logging.getLogger(__name__)


@stage(
    "report",
    "report",
    version=5,
    needs=(
        "catalog",
        "truth",
        "exposures",
        "mosaics",
        "highres",
        "photometry",
        "points",
        "errors",
        "matches",
        "rivals",
        "fits",
        "experiments",
    ),
    sections=(
        *GRID,
        "run.name",
        "catalog",
        "sed",
        "detector",
        "highres.filter",
        "highres.pixel_scale",
        "photometry.method",
        "photometry.rivals",
        "reduction.pixel_scale",
        "fit",
        "errors",
        "point_sources",
        "perturb",
        "report",
    ),
    resources=lambda: (*sed_resources(), *EXPOSURE_RESOURCES),
    plan=exposure_plan,
    kernels=("fit",),
)
def make_report(context, _):
    """Stage 14: the page with its figures, and the numbers as JSON."""
    config = context.config
    bands, truths = config.exposures.filters, study_truths(config)
    every = {name: StudyTables.read(context, name) for name in truths}
    shown = reference(config)
    tables = every[shown]
    mosaics = {name: context.image(f"{shown}/mosaic_{name}.fits") for name in bands}
    area = footprint_area(mosaics.values())
    metrics = study_metrics(config, tables, area)
    # those of whose sky the analysis knows all
    known = {name: truth for name, truth in truths.items() if not truth.perturbations}
    metrics["truths"] = {
        name: truth_metrics(truth, every[name], bands) for name, truth in known.items()
    }
    if metrics["n_sample"] == 0:
        log.warning("no source is left to fit: %s", metrics["n_left_out"])
    text = json.dumps(_without_nan(metrics), indent=1, allow_nan=False)
    context.save("report/metrics.json", lambda path: path.write_text(text, encoding="utf-8"))
    model = sed.SEDModel.yang2021()
    report = Report(
        f"miricigale: {config.run.name}",
        subtitle=(
            f"{metrics['n_field']} galaxies in a MIRI field at RA {config.pointing.ra:.5f}, "
            f"Dec {config.pointing.dec:.5f}, injected fracAGN "
            f"{', '.join(map(str, config.sed.frac_agn))}, seed {context.seed}"
        ),
        notices=provenance.stand_ins(config, model),
        dpi=config.report.dpi,
    )
    writer = _Writer(context, report, tables, metrics, model, mosaics, area, truths[shown])
    writer.summary()
    report.links("The sources one by one:", [(name, f"sources-{name}.html") for name in truths])
    provenance.write_exposures(context, report, metrics, shown)
    writer.images()
    writer.photometry()
    others = rivals.read_rivals(context)
    rivals.write_rivals(context, report, others)
    writer.errors()
    writer.fits()
    study = comparison.study_results(config, known, {name: every[name] for name in known}, metrics)
    study.extra.update(rivals.source_extractor_numbers(others, context.seed))
    comparison.write_truths(context, report, study, metrics, FIT_COLUMNS)
    experiments.write_experiments(context, report, {name: every[name] for name in known})
    comparison.write_comparison(context, report, study, metrics["as_paper"])
    perturbed.write_perturbed(context, report, truths, every)
    writer.inputs()
    provenance.write_origin(report, config, model, [tables.truth.meta, tables.matched.meta])
    context.save("report/index.html", lambda path: report.write(path))


def _without_nan(values):
    """The same values with None for NaN, which JSON does not know."""
    if isinstance(values, dict):
        return {key: _without_nan(value) for key, value in values.items()}
    if isinstance(values, list):
        return [_without_nan(value) for value in values]
    return None if isinstance(values, float) and not np.isfinite(values) else values


#: Why numbers of the fits are missing.
NO_SAMPLE = "no source in the fit"


class _Writer:
    """The sections of the page; each reads the products that it shows, of the reference truth."""

    def __init__(self, context, report, tables, metrics, model, mosaics, area, truth):
        self.context, self.report, self.metrics, self.truth = context, report, metrics, truth
        self.tables, self.model, self.config = tables, model, context.config
        self.bands = context.config.exposures.filters
        self.mosaics, self.area = mosaics, area
        self.selection = np.asarray(tables.matched["selection"])

    def _table(self, entries, columns, **options):
        """A table of a row for each entry, and of columns: header to the cell of an entry."""
        rows = [[cell(entry) for cell in columns.values()] for entry in entries]
        self.report.table(rows, header=tuple(columns), **options)

    def summary(self):
        """Headline numbers."""
        m, fits = self.metrics, self.metrics["fits"]
        compared = [unit for unit in ("all", "none") if unit in fits]
        self.report.section(
            "At a glance",
            "Real galaxies with known redshifts were given the mid-infrared light of their fitted "
            "SEDs, exposed, reduced and measured; then redshift and AGN fraction were fitted "
            "together, with and without the MIRI bands, and held against the truth.",
        )
        self.report.items(
            [
                ("galaxies in the field", m["n_field"]),
                (
                    "imaged in all bands",
                    f"{m['area']:.2f} arcmin\N{SUPERSCRIPT TWO}",
                ),
                ("found on the high-resolution image", m["n_matched"]),
                (f"in the fit: {self.config.fit.min_detected}+ MIRI bands", m["n_sample"]),
                *(
                    (
                        f"photo-z outliers {SET_LABELS[unit]}",
                        _percent(fits[unit]["photoz_outliers"], NO_SAMPLE),
                    )
                    for unit in compared
                ),
                *(
                    (f"fracAGN offset ± scatter {SET_LABELS[unit]}", _plus_minus(fits[unit]))
                    for unit in compared
                ),
            ]
        )
        least = m["n_bands_detected"]
        paper = "Yang et al. 2021"
        if not m["as_paper"]:
            paper += ", six bands, other exposures"
        # of Gaussian errors it is 0.67 sigma
        if self.config.errors.statistic == "mad":
            note = "; 5 sigma in Yang et al. are of the median absolute difference, 3.4 of these"
        else:
            note = ""
        name, prior = self.config.catalog.mag_column, band_label(self.config.highres.filter)
        limit = self.config.catalog.mag_limit
        none = "no galaxy"
        columns = {
            "sample": lambda row: f"{prior} < {row['limit']:g}",
            "galaxies": lambda row: row["n"],
            f"detected in {least}+ bands": lambda row: _percent(row["fraction"], none),
            "68 % interval": lambda row: (
                f"{_percent(row['low'], none)} to {_percent(row['high'], none)}"
                if row["n"]
                else Missing(none)
            ),
            paper: lambda row: _percent(row["paper"], ""),
        }
        self._table(
            m["detected"],
            columns,
            caption="Galaxies of the field detected (5 sigma by the error function) in "
            f"{'two or more bands' if least == 2 else 'the one band'}; the catalog ends at "
            f"{name} = {limit:g}{note}",
            empty=f"The catalog ends at {name} = {limit:g}: too bright for the shares of detected "
            f"galaxies that are published, to {prior} = 25 and 26.",
        )
        conditions.write_left_out(self.report, m)

    def images(self):
        """The field in color or gray; mosaic, model and residual."""
        self.report.section("Images")
        chosen = figures.three_bands(self.bands)
        labels = ", ".join(band_label(name) for name in chosen)
        prior = self.context.image("f160w.fits")
        if len(chosen) == 3:
            told = (
                f"The field: the high-resolution image, and {labels} (the shortest, the middle and "
                "the longest of the bands by wavelength) in blue, green and red, each in units of its own noise."
            )
        else:
            told = f"The field: the high-resolution image and {labels}; too few bands for colors."
        self.report.figure(
            pictures.field_figure(
                [self.mosaics[name] for name in chosen],
                prior,
                [*chosen, self.config.highres.filter],
            ),
            f"{told} The bar is 20 arcsec long.",
        )
        suffix, _ = measured_mosaic(self.config)
        pairs = [
            (
                self.context.image(f"{self.truth.name}/mosaic_{name}{suffix}.fits"),
                self.context.image(f"{self.truth.name}/photometry/{name}_model.fits"),
            )
            for name in chosen
        ]
        self.report.figure(
            pictures.residual_figure(pairs, chosen),
            "Mosaic, fitted model and their difference where the model is brightest; differences from "
            "-5 to +5 sigma of their own noise. The bar is 5 arcsec long.",
        )

    def photometry(self):
        """Measured against true fluxes, and the point sources."""
        how = ""
        if self.config.photometry.method == "yang2021":
            how = ", by the steps of Yang et al. 2021 (bare segments, errors for white noise)"
        self.report.section(
            "Forced photometry",
            f"Every detection of the high-resolution image is fitted in each MIRI mosaic{how}; matched "
            "sources inside the field are shown.",
        )
        matched = self.tables.matched
        inside = (self.selection & SampleFlags.OUTSIDE_FIELD) == 0
        table = matched[inside & np.asarray(matched["matched"])]
        if len(table) == 0:
            self.report.text("No source of the field was found on the high-resolution image.")
        else:
            limits = {name: entry["limit"] for name, entry in self.metrics["bands"].items()}
            self.report.figure(
                figures.magnitude_figure(table, self.bands),
                "Measured against true magnitudes; ticks at the bottom: no positive flux measured, or "
                "fainter than the axis.",
            )
            self.report.figure(
                figures.offset_figure(table, self.bands, limits, conditions.MARKS),
                "Measured minus true magnitude of sources with positive flux, with the running "
                "median of 20 sources and its scatter; triangles lie beyond the axis, circles mark "
                "crowded sources, squares those at the edge.",
            )
        points = self.tables.points
        entries = self.metrics["bands"].items()
        reason, lost = "no isolated source above 20 sigma", "no point source measured"
        columns = {
            "band": lambda x: band_label(x[0]),
            "isolated > 20 sigma": lambda x: x[1]["bright_n"],
            "median offset": lambda x: _percent(x[1]["bright_median"], reason, "+.2f"),
            "its error": lambda x: _percent(x[1]["bright_median_err"], reason),
        }
        caption = "Measured over true flux minus one"
        if points:
            whole = "no whole point source in the field"
            columns |= {
                "point sources": lambda x: x[1]["points_n"],
                "their median offset": lambda x: _percent(x[1]["points_median"], lost, "+.2f"),
                "scatter": lambda x: _percent(x[1]["points_scatter"], lost),
                "f_scaling": lambda x: number(x[1]["f_scaling"], ".4f", whole),
            }
            caption += (
                "; f_scaling, the factor that brings the light of the point sources within the radius of 80 % to "
                "that of the PSF, is 1 where images and PSF agree"
            )
        self._table(entries, columns, caption=caption)
        if points:
            shown = {name: table[np.asarray(table["in_field"])] for name, table in points.items()}
            self.report.figure(
                figures.point_figure(shown, self.bands),
                "Bright point sources on a grid, one exposure a band through the whole chain; "
                "blue: median, gray: 3 %; triangles lie beyond the axis.",
            )
        else:
            self.report.text("The check with bright point sources was not made ([point_sources]).")
        conditions.write_conditions(self.report, self.metrics)

    def errors(self):
        """The error function and the limits."""
        self.report.section(
            "Error function and limits",
            "Scatter of measured about true fluxes in bins of true flux; it is used as the error of "
            "the measured fluxes in the fit.",
        )
        errors, bands = self.tables.errors, self.metrics["bands"]
        limits = {name: errors.limiting_flux(name).to_value(u.uJy) for name in self.bands}
        self.report.figure(
            figures.error_figure(errors, self.bands, limits),
            "Error function of each band; dots mark the 5-sigma limits.",
        )
        if len(bands) > 1:
            self.report.figure(
                figures.limit_figure(bands),
                "5-sigma limits beside those of the exposure time calculator (4.0), scaled to the "
                "same time as its root; short exposures, in which read noise counts, fall short of "
                "that.",
            )
        none = "the error function reaches 5 sigma nowhere"
        few = "no source below 20 sigma"
        proposal = "CEERS proposal"
        if not all(entry["ceers"] for entry in bands.values()):
            proposal += ", for other exposures"
        columns = {
            "band": lambda x: band_label(x[0]),
            "5 sigma, error function": lambda x: number(x[1]["limit"], ".2f", none),
            "formal": lambda x: number(x[1]["formal_limit"], ".2f", "no source measured"),
            "calculator, scaled": lambda x: f"{x[1]['etc_limit']:.2f}",
            "minus calculator": lambda x: number(x[1]["limit"] - x[1]["etc_limit"], "+.2f", none),
            proposal: lambda x: _proposal(x[1]),
            "pull median": lambda x: number(x[1]["pull_median"], "+.2f", few),
            "pull scatter": lambda x: number(x[1]["pull_scatter"], ".2f", few),
        }
        self._table(
            bands.items(),
            columns,
            caption=(
                "5-sigma limits (AB magnitudes), and (measured - true) / formal error of the sources "
                "below 20 sigma, blends and template errors included"
            ),
        )

    def fits(self):
        """Redshifts, AGN fractions, and one source in detail."""
        self.report.section(
            "Redshift and AGN fraction",
            "Posterior means of the same sources, fitted with the existing bands alone and with MIRI.",
        )
        sample = self.tables.truth[self.selection == 0]
        if len(sample) == 0:
            left = ", ".join(
                f"{name.replace('_', ' ')} {n}"
                for name, n in self.metrics["n_left_out"].items()
                if n
            )
            self.report.text(
                f"No source is left to fit. Why the {self.metrics['n_catalog']} sources of the "
                f"catalog were left out, each for one reason or more: {left}."
            )
            return
        fits = self.tables.fits
        self.report.figure(
            figures.redshift_figure(sample, fits),
            "Fitted against true redshift; dashed: the limits beyond which a source is an outlier.",
        )
        self.report.figure(
            figures.fraction_figure(fits, self.truth.frac_agn),
            "Posterior means and widths of the AGN fraction.",
        )
        self._table(
            self.metrics["fits"].items(),
            FIT_COLUMNS,
            caption="Redshift and AGN fraction against truth; truths lie within the models of the "
            f"fit, whose {100 * self.config.fit.model_error:g} % model error they do not have, so "
            "posteriors are wide",
        )
        conditions.write_fits(self.report, self.metrics)
        comparison.write_coverage(
            self.report, self.tables, self.config.fit.model_error, self.context.seed
        )
        results = self.tables.results
        key = typical_source(sample, results["all"].fitted, self.bands[-1])
        if key is None:
            self.report.text("No source of the sample could be fitted.")
            return
        self.report.figure(
            figures.example_figure(results, self.tables.truth, key, self.model),
            f"Source {key}: photometry and best models, residuals of the fit with MIRI, and the "
            "posteriors of redshift and AGN fraction with and without MIRI.",
        )

    def inputs(self):
        """The inputs beside published relations."""
        self.report.section(
            "The inputs beside published relations",
            "What was injected follows from fits to real galaxies; these are checks that it is sane.",
        )
        galaxies = self.tables.galaxies()
        if len(galaxies) == 0:
            self.report.text("No galaxy of the catalog has a model.")
            return
        figure, (faint, passive) = figures.input_figure(galaxies)
        agn = ", AGN included," if self.truth.frac_agn > 0 else ""
        self.report.figure(
            figure,
            f"Galaxies of the catalog. Left: luminosity of 3-1000 µm{agn} against redshift, with "
            "the 8-1000 µm luminosities of three star-formation rates after Kennicutt 1998 (Salpeter IMF). Right: "
            "star-formation rate (100 Myr) against stellar mass, with the main sequence of Speagle et "
            f"al. 2014 (Kroupa IMF). {faint} and {passive} galaxies lie below the axes.",
        )
        self._counts(self.tables.galaxies(field=True))

    def _counts(self, galaxies):
        """Number counts and the light of all galaxies, over the imaged area."""
        options = self.config.catalog
        if len(galaxies) == 0:
            self.report.text("No galaxy with a model lies in the imaged area.")
            return
        self.report.figure(
            figures.counts_figure(galaxies, self.bands, self.area),
            f"Number counts of the injected fluxes: {len(galaxies)} galaxies in the "
            f"{self.metrics['area']:.2f} square arcmin that all bands have imaged, to "
            f"{options.mag_column} = {options.mag_limit:g}; Poisson errors.",
        )
        none = "no source above the limit in the imaged area"
        columns = {
            "band": lambda row: f"{band_label(row['band'])}, {row['wavelength']:g} µm",
            "faint limit": lambda row: f"{row['least']:g} µJy" if row["least"] else "none",
            "sources": lambda row: row["n"],
            "here": lambda row: (
                f"{row['light']:.2f} ± {row['light_err']:.2f}" if row["n"] else Missing(none)
            ),
            "published": lambda row: f"{row['published']:.2f} -{row['down']:.2f} +{row['up']:.2f}",
            "reference": lambda row: row["reference"],
        }
        self._table(
            self.metrics["light"],
            columns,
            caption="Light of all galaxies above a flux, nu I_nu in nW / m2 / sr; Poisson errors, without "
            "cosmic variance",
            empty="The light of all galaxies together is published near 15 and 24 µm; no band of "
            "this run (F1500W, F2100W) is there.",
        )


def _fit_columns():
    """Columns of a table of fits: header to the cell of a set of bands and its metrics."""
    none = "no source fitted"
    return {
        "fit": lambda x: SET_LABELS[x[0]],
        "sources": lambda x: x[1]["n"],
        "dz/(1+z) median": lambda x: number(x[1]["photoz_bias"], "+.4f", none),
        "sigma_MAD": lambda x: number(x[1]["photoz_sigma_mad"], ".4f", none),
        "outliers": lambda x: x[1]["photoz_n_outliers"],
        "share": lambda x: _percent(x[1]["photoz_outliers"], none),
        "fracAGN offset": lambda x: number(x[1]["frac_agn_bias"], "+.3f", none),
        "scatter": lambda x: number(x[1]["frac_agn_sigma_mad"], ".3f", none),
        "width": lambda x: number(x[1]["frac_agn_width"], ".3f", none),
        "z in 16-84 %": lambda x: _percent(x[1]["redshift_coverage"], none),
    }


FIT_COLUMNS = _fit_columns()


def _proposal(entry):
    """The limit of CEERS' proposal, and the time that it is for where that is another."""
    if entry["ceers"] or not np.isfinite(entry["proposal"]):
        return number(entry["proposal"], ".1f", "no band of CEERS")
    return f"{entry['proposal']:.1f} in {entry['proposal_time']:.0f} s"


def _plus_minus(fit):
    if not np.isfinite(fit["frac_agn_bias"]):
        return Missing(NO_SAMPLE)
    return f"{fit['frac_agn_bias']:+.2f} ± {fit['frac_agn_sigma_mad']:.2f}"


def _percent(value, reason, spec=".1f"):
    return number(value, f"{{:{spec}}} %", reason, scale=100)
