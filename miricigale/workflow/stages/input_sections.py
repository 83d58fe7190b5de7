"""The section of the report on the inputs, beside published relations."""

from miricigale.pages import Missing
from miricigale.workflow.stages import figures
from miricigale.workflow.stages.figures import band_label

__all__ = ["write_inputs"]


def write_inputs(report, tables, metrics, config, area):
    """
    Luminosities, star formation, counts and light of the galaxies of a truth.

    ``tables`` are its `~miricigale.workflow.stages.metrics.StudyTables`, ``area`` is the solid angle of the
    imaged field.
    """
    report.section(
        "The inputs beside published relations",
        "What was injected follows from fits to real galaxies; these are checks that it is sane.",
    )
    galaxies = tables.galaxies()
    if len(galaxies) == 0:
        report.text("No galaxy of the catalog has a model.")
        return
    figure, left_out = figures.input_figure(galaxies)
    report.figure(
        figure,
        "Star-formation rate (100 Myr) against stellar mass of the galaxies of the catalog by redshift, with the "
        f"main sequence of Speagle et al. 2014 (Kroupa IMF) in the middle of each range; {left_out} of "
        f"{len(galaxies)} lie at other redshifts or below the axes.",
    )
    _write_counts(report, tables.galaxies(field=True), metrics, config, area)


def _write_counts(report, galaxies, metrics, config, area):
    """Number counts and the light of all galaxies, over the imaged area."""
    options = config.catalog
    if len(galaxies) == 0:
        report.text("No galaxy with a model lies in the imaged area.")
        return
    report.figure(
        figures.counts_figure(galaxies, config.exposures.filters, area),
        f"Number counts of the injected fluxes: {len(galaxies)} galaxies in the "
        f"{metrics['area']:.2f} square arcmin that all bands have imaged, to "
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
    report.table(
        [[cell(row) for cell in columns.values()] for row in metrics["light"]],
        header=tuple(columns),
        text=(0, len(columns) - 1),
        caption="Light of all galaxies above a flux, nu I_nu in nW / m2 / sr; Poisson errors, without "
        "cosmic variance",
        empty="The light of all galaxies together is published near 15 and 24 µm; no band of "
        "this run (F1500W, F2100W) is there.",
    )
