"""Sections of the report on the images of the reference truth: field, detections, photometry, limits."""

import astropy.units as u
import numpy as np

from miricigale.pages import Missing, number
from miricigale.psf import MatchingKernel
from miricigale.workflow.stages import conditions, figures, pictures, truth_figures
from miricigale.workflow.stages.exposures import study_exposures, study_pointings
from miricigale.workflow.stages.figures import SET_LABELS, band_label
from miricigale.workflow.stages.images import measured_mosaic, reducer_of
from miricigale.workflow.stages.sample import SampleFlags
from miricigale.workflow.stages.truth_sections import percent

__all__ = ["ImageSections", "field_text"]

NO_SAMPLE = "no source in the fit"


class ImageSections:
    """The sections of the page; each reads the products that it shows, of the reference truth."""

    def __init__(self, context, report, tables, metrics, study, mosaics, truth):
        self.context, self.report, self.metrics, self.truth = context, report, metrics, truth
        self.tables, self.study, self.config = tables, study, context.config
        self.bands = context.config.exposures.filters
        self.mosaics = mosaics
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
                        percent(fits[unit]["photoz_outliers"], NO_SAMPLE),
                    )
                    for unit in compared
                ),
                *(
                    (f"fracAGN offset ± scatter {SET_LABELS[unit]}", _plus_minus(fits[unit]))
                    for unit in compared
                ),
            ]
        )

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
        unit = next(n for n, e in study_exposures(self.config).items() if e.filter == chosen[-1])
        rate, cal = (
            self.context.image(f"{self.truth.name}/exposures/{unit}_{kind}.fits")
            for kind in ("rate", "cal")
        )
        self.report.figure(
            pictures.subtraction_figure(rate, cal, reducer_of(self.config)),
            f"An exposure in {band_label(chosen[-1])} before and after its background was subtracted, and medians "
            "of strips along both axes without the pixels of sources.",
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

    def detections(self):
        """Which galaxies are detected, and why the others are not in the fit."""
        m = self.metrics
        self.report.section(
            "Detections",
            "Galaxies of the field by their brightness on the high-resolution image, and by their infrared "
            "luminosity.",
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
            f"detected in {least}+ bands": lambda row: percent(row["fraction"], none),
            "68 % interval": lambda row: (
                f"{percent(row['low'], none)} to {percent(row['high'], none)}"
                if row["n"]
                else Missing(none)
            ),
            paper: lambda row: percent(row["paper"], ""),
        }
        if any(np.isfinite(row["to_proposal"]) for row in m["detected"]):
            columns["by true flux, to the limits of the CEERS proposal"] = lambda row: percent(
                row["to_proposal"], none
            )
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
        if self.study.truths[0].field.any():
            self.report.figure(
                truth_figures.detection_figure(self.study),
                "Luminosity of 3-1000 µm against redshift of the galaxies of the field, injected "
                f"{truth_figures.truth_label(self.study.truths[0])}. MIPS: the true flux at 24 µm is above "
                f"{truth_figures.MIPS_LIMIT:g} AB.",
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
        kernels = {
            n: MatchingKernel.read(self.context.path(f"kernel_{n}.fits")) for n in self.bands
        }
        self.report.figure(
            pictures.convolution_figure(kernels),
            "Encircled energy of the PSF of the high-resolution image minus that of each band, as it is and "
            "convolved with the matching kernel; gray: 4 %.",
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
            self.report.figure(
                truth_figures.shape_figure(self.study),
                "The same of galaxies whose true flux is above 5 sigma, by Sersic index; circles mark crowded "
                "ones.",
            )
        points = self.tables.points
        entries = self.metrics["bands"].items()
        reason, lost = "no isolated source above 20 sigma", "no point source measured"
        columns = {
            "band": lambda x: band_label(x[0]),
            "isolated > 20 sigma": lambda x: x[1]["bright_n"],
            "median offset": lambda x: percent(x[1]["bright_median"], reason, "+.2f"),
            "its error": lambda x: percent(x[1]["bright_median_err"], reason),
        }
        caption = "Measured over true flux minus one"
        if points:
            whole = "no whole point source in the field"
            columns |= {
                "point sources": lambda x: x[1]["points_n"],
                "their median offset": lambda x: percent(x[1]["points_median"], lost, "+.2f"),
                "scatter": lambda x: percent(x[1]["points_scatter"], lost),
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
            "fainter than calculator": lambda x: number(
                x[1]["limit"] - x[1]["etc_limit"], "+.2f", none
            ),
            proposal: lambda x: _proposal(x[1]),
            "pull median": lambda x: number(x[1]["pull_median"], "+.2f", few),
            "pull scatter": lambda x: number(x[1]["pull_scatter"], ".2f", few),
        }
        self._table(
            bands.items(),
            columns,
            caption=(
                "5-sigma limits (AB magnitudes; the calculator's are of its own low background), and "
                "(measured - true) / formal error of the sources below 20 sigma, blends and template "
                "errors included"
            ),
        )
        if rows := _coverage_rows(bands):
            self.report.table(
                rows,
                header=("band", "exposure time", "galaxies", "5 sigma"),
                caption="Limits by the exposure time at a source, in units of that of one pointing: "
                "medians of the galaxies with less than 0.8, 0.8 to 1.5, and more",
            )


def field_text(config):
    """Where the telescope looks, in words."""
    centers = study_pointings(config)
    field = "a MIRI field" if len(centers) == 1 else f"{len(centers)} MIRI pointings"
    if config.pointing.centers:
        return f"{field}, the first at RA {centers[0].ra.deg:.5f}, Dec {centers[0].dec.deg:.5f}"
    return f"{field} at RA {config.pointing.ra:.5f}, Dec {config.pointing.dec:.5f}"


def _coverage_rows(bands):
    """Rows of the table of depths by exposure time; none where all sources have the same."""
    return [
        (band_label(name), f"{entry['share']:.2f}", entry["n"], number(entry["limit"], ".2f", "-"))
        for name, metrics in bands.items()
        for entry in metrics["coverage"]
        if len(metrics["coverage"]) > 1
    ]


def _proposal(entry):
    """The limit of CEERS' proposal, and the time that it is for where that is another."""
    if entry["ceers"] or not np.isfinite(entry["proposal"]):
        return number(entry["proposal"], ".1f", "no band of CEERS")
    return f"{entry['proposal']:.1f} in {entry['proposal_time']:.0f} s"


def _plus_minus(fit):
    if not np.isfinite(fit["frac_agn_bias"]):
        return Missing(NO_SAMPLE)
    return f"{fit['frac_agn_bias']:+.3f} ± {fit['frac_agn_sigma_mad']:.3f}"
