"""Stage 14: truth and results to numbers, figures and one page."""

import json
import logging

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.evaluation import (
    PUBLISHED_LIGHT,
    Report,
    integrated_light,
)
from miricigale.fitting import FitResults
from miricigale.instrument import proposal_limit
from miricigale.photometry import ErrorModel
from miricigale.workflow.stages import figures
from miricigale.workflow.stages.metrics import FITS, study_metrics
from miricigale.workflow.stages.sample import SampleFlags

__all__ = ["make_report"]

log = logging.getLogger(__name__)


def make_report(context, _):
    """Stage 14: the page, its figures as PNG, and the numbers as JSON."""
    config = context.config
    metrics = study_metrics(context)
    if metrics["n_sample"] == 0:
        log.warning("no source is left to fit: %s", metrics["n_left_out"])
    context.save("report/metrics.json", lambda path: path.write_text(json.dumps(metrics, indent=1)))
    report = Report(
        f"miricigale: {config.run.name}",
        subtitle=(
            f"{metrics['n_field']} galaxies in a MIRI field at RA {config.pointing.ra:.5f}, "
            f"Dec {config.pointing.dec:.5f}, injected fracAGN {config.sed.frac_agn:g}, "
            f"seed {context.seed}"
        ),
        dpi=config.report.dpi,
    )
    writer = _Writer(context, report, metrics)
    writer.summary()
    writer.images()
    writer.photometry()
    writer.errors()
    writer.fits()
    writer.inputs()
    writer.configuration()
    context.save("report/index.html", lambda path: report.write(path))


def _without_nan(values):
    """The same values with None for NaN, which JSON does not know."""
    if isinstance(values, dict):
        return {key: _without_nan(value) for key, value in values.items()}
    if isinstance(values, list):
        return [_without_nan(value) for value in values]
    return None if isinstance(values, float) and not np.isfinite(values) else values


class _Writer:
    """The sections of the page; each reads the products that it shows."""

    def __init__(self, context, report, metrics):
        self.context, self.report, self.metrics = context, report, metrics
        self.config = context.config
        self.bands = context.config.exposures.filters
        self.truth = QTable.read(context.path("truth.ecsv"))
        self.matched = QTable.read(context.path("matched.ecsv"))
        self.errors_model = ErrorModel.read(context.path("errors.ecsv"))
        self.fit_tables = {unit: QTable.read(context.path(f"fits_{unit}.ecsv")) for unit in FITS}
        self.sample = np.asarray(self.matched["selection"]) == 0

    def summary(self):
        """Headline numbers."""
        m, fits = self.metrics, self.metrics["fits"]
        self.report.section(
            "At a glance",
            "Real galaxies with known redshifts were given the mid-infrared light of their fitted "
            "SEDs, exposed, reduced and measured; then redshift and AGN fraction were fitted "
            "together, with and without the MIRI bands, and held against the truth.",
        )
        self.report.items(
            [
                ("galaxies in the field", m["n_field"]),
                ("found on the high-resolution image", m["n_matched"]),
                (f"in the fit: {self.config.fit.min_detected}+ MIRI bands", m["n_sample"]),
                ("photo-z outliers with MIRI", _percent(fits["with_miri"]["photoz_outliers"])),
                ("photo-z outliers without", _percent(fits["without_miri"]["photoz_outliers"])),
                ("fracAGN with MIRI", _plus_minus(fits["with_miri"])),
                ("fracAGN without", _plus_minus(fits["without_miri"])),
            ]
        )
        self.report.table(
            [
                (
                    f"H < {row['limit']:g}",
                    _percent(row["fraction"]),
                    f"{_percent(row['low'])} to {_percent(row['high'])}",
                    _percent(row["paper"]),
                )
                for row in m["detected"]
                if self.config.catalog.mag_limit >= row["limit"]
            ],
            header=("sample", "detected in 2+ bands", "68 % interval", "Yang et al. 2021"),
            caption="Galaxies of the field detected (5 sigma by the error function) in two or more bands",
        )

    def images(self):
        """Colour image; mosaic, model and residual."""
        self.report.section("Images")
        by_wave = list(self.bands)
        chosen = [by_wave[round(k * (len(by_wave) - 1) / 2)] for k in range(3)]
        images = [self.context.image(f"mosaic_{name}_fine.fits") for name in chosen]
        prior = self.context.image("f160w.fits")
        self.report.figure(
            figures.colour_figure(*images, prior, [*chosen, self.config.highres.filter]),
            "The field: high-resolution prior, and three MIRI bands drizzled to its grid.",
        )
        triples = [
            (
                self.context.image(f"mosaic_{name}.fits"),
                self.context.image(f"photometry/{name}_model.fits"),
                self.context.image(f"photometry/{name}_residual.fits"),
            )
            for name in chosen
        ]
        self.report.figure(
            figures.triptych_figure(triples, chosen),
            "Mosaic, fitted model and residual of the brightest part (-3 to +12 sigma).",
        )

    def photometry(self):
        """Measured against true fluxes, and the point sources."""
        self.report.section(
            "Forced photometry",
            "Every detection of the high-resolution image is fitted in each MIRI mosaic; matched "
            "sources inside the field are shown.",
        )
        inside = (np.asarray(self.matched["selection"]) & SampleFlags.OUTSIDE_FIELD) == 0
        table = self.matched[inside & np.asarray(self.matched["matched"])]
        self.report.figure(
            figures.magnitude_figure(table, self.bands), "Measured against true magnitudes."
        )
        self.report.figure(
            figures.offset_figure(table, self.bands),
            "Measured minus true magnitude with the running median of 20 sources and its scatter; "
            "triangles lie beyond the axis.",
        )
        rows = [
            (
                name,
                entry["bright_n"],
                _signed(entry["bright_median"]),
                f"{100 * entry['bright_median_err']:.1f} %",
                *(
                    (
                        entry["points_n"],
                        _signed(entry["points_median"]),
                        _percent(entry["points_scatter"]),
                    )
                    if "points_n" in entry
                    else ("", "", "")
                ),
            )
            for name, entry in self.metrics["bands"].items()
        ]
        self.report.table(
            rows,
            header=(
                "band",
                "isolated > 20 sigma",
                "median offset",
                "its error",
                "point sources",
                "median offset",
                "scatter",
            ),
            caption="Measured over true flux minus one",
        )
        if self.config.point_sources.enabled:
            points = {
                name: QTable.read(self.context.path(f"points/{name}.ecsv")) for name in self.bands
            }
            points = {name: table[np.asarray(table["in_field"])] for name, table in points.items()}
            self.report.figure(
                figures.point_figure(points, self.bands),
                "Bright point sources on a grid, one exposure a band through the whole chain; "
                "blue: median, grey: 3 %.",
            )

    def errors(self):
        """The error function and the limits."""
        self.report.section(
            "Error function and limits",
            "Scatter of measured about true fluxes in bins of true flux; it is used as the error of "
            "the measured fluxes in the fit.",
        )
        limits = {
            name: self.errors_model.limiting_flux(name).to_value(u.uJy) for name in self.bands
        }
        self.report.figure(
            figures.error_figure(self.errors_model, self.bands, limits),
            "Error function of each band; dots mark the 5-sigma limits.",
        )
        self.report.table(
            [
                (
                    name,
                    f"{entry['limit']:.2f}",
                    f"{entry['formal_limit']:.2f}",
                    f"{entry['etc_limit']:.2f}",
                    _proposal(name),
                    f"{entry['pull_median']:+.2f}",
                    f"{entry['pull_scatter']:.2f}",
                )
                for name, entry in self.metrics["bands"].items()
            ],
            header=(
                "band",
                "5 sigma, error function",
                "formal",
                "calculator 4.0, scaled",
                "CEERS proposal",
                "pull median",
                "pull scatter",
            ),
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
        sample = self.truth[self.sample]
        self.report.figure(
            figures.redshift_figure(sample, self.fit_tables),
            "Fitted against true redshift; dashed: the limits beyond which a source is an outlier.",
        )
        self.report.figure(
            figures.fraction_figure(self.fit_tables, self.config.sed.frac_agn),
            "Posterior means and widths of the AGN fraction.",
        )
        self.report.table(
            [
                (
                    unit.replace("_", " "),
                    entry["n"],
                    f"{entry['photoz_bias']:+.4f}",
                    f"{entry['photoz_sigma_mad']:.4f}",
                    f"{entry['photoz_n_outliers']} ({_percent(entry['photoz_outliers'])})",
                    f"{entry['frac_agn_bias']:+.3f}",
                    f"{entry['frac_agn_sigma_mad']:.3f}",
                    f"{entry['frac_agn_width']:.3f}",
                    _percent(entry["redshift_coverage"]),
                )
                for unit, entry in self.metrics["fits"].items()
            ],
            header=(
                "fit",
                "sources",
                "dz/(1+z) median",
                "sigma_MAD",
                "outliers",
                "fracAGN offset",
                "scatter",
                "width",
                "z in 16-84 %",
            ),
            caption="Redshift and AGN fraction against truth; truths lie within the models of the fit, "
            "whose 10 % model error they do not have, so posteriors are wide",
        )
        results = {unit: FitResults.read(self.context.path(f"fits_{unit}.fits")) for unit in FITS}
        key = self._example()
        if key is not None:
            self.report.figure(
                figures.example_figure(results, self.truth, key),
                f"Source {key}: photometry and best fit with MIRI, and the posteriors of redshift "
                "and AGN fraction with (red) and without (blue) MIRI.",
            )

    def _example(self):
        """A typical source: median magnitude among those near redshift one."""
        sample = self.truth[self.sample]
        if len(sample) == 0:
            return None
        near = np.abs(np.asarray(sample["redshift"]) - 1.2)
        chosen = sample[np.argsort(near, kind="stable")[: max(1, len(sample) // 5)]]
        flux = chosen[self.bands[-1]].value
        return chosen["id"][np.argsort(flux)[int(0.7 * (len(chosen) - 1))]]

    def inputs(self):
        """The inputs beside published relations."""
        self.report.section(
            "The inputs beside published relations",
            "What was injected follows from fits to real galaxies; these are checks that it is sane.",
        )
        known = np.isfinite(self.truth["stellar_mass"].value)
        galaxies = self.truth[known & ~np.asarray(self.truth["star"], bool)]
        self.report.figure(
            figures.input_figure(galaxies),
            "Left: infrared luminosity against redshift; right: star-formation rate (100 Myr) against "
            "stellar mass with the main sequence of Speagle et al. 2014 at z = 0.5, 1 and 2.",
        )
        area = figures.catalog_area(self.truth)
        self.report.figure(
            figures.counts_figure(galaxies, self.bands, area),
            "Number counts of the injected fluxes of all galaxies of the catalogue "
            f"({area.to_value(u.arcmin**2):.1f} square arcmin, H < {self.config.catalog.mag_limit:g}).",
        )
        rows = []
        for name, wave, least, value, down, up, reference in PUBLISHED_LIGHT:
            if name in self.bands:
                flux = galaxies[name][galaxies[name] >= least * u.uJy]
                light, error = integrated_light(flux, area, wave * u.um)
                rows.append(
                    (
                        f"{name}, {wave:g} um",
                        f"{least:g} uJy" if least else "none",
                        f"{light.value:.2f} +- {error.value:.2f} ({len(flux)})",
                        f"{value:.2f} -{down:.2f} +{up:.2f}",
                        reference,
                    )
                )
        if rows:
            self.report.table(
                rows,
                header=(
                    "band",
                    "faint limit",
                    "this catalogue (sources)",
                    "published",
                    "reference",
                ),
                caption="Light of all galaxies above a flux, nu I_nu in nW / m2 / sr; Poisson errors",
            )

    def configuration(self):
        """Configuration and times."""
        self.report.section("How it was made")
        rows = {}
        for key, record in self.context.store.records.items():
            rows.setdefault(key.split(":")[0], []).append(record["seconds"])
        self.report.table(
            [(name, len(times), f"{sum(times):.1f}") for name, times in rows.items()],
            header=("stage", "pieces", "seconds"),
            caption="Time of each stage",
        )
        self.report.text(
            "The configuration is config.toml in the folder of the run; 'miricigale run' takes it. What "
            "to cite for the data: 'miricigale data list'."
        )


def _plus_minus(fit):
    return f"{fit['frac_agn_bias']:+.2f} ± {fit['frac_agn_sigma_mad']:.2f}"


def _percent(value):
    return f"{100 * value:.1f} %" if np.isfinite(value) else "none"


def _signed(value):
    return f"{100 * value:+.2f} %" if np.isfinite(value) else "none"


def _proposal(name):
    try:
        return f"{proposal_limit(name).value:.1f}"
    except KeyError:
        return ""
