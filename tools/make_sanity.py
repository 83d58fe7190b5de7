"""
Make the pictures and tables of docs/accuracy/study.rst from a finished run.

    miricigale run goodss -o RUN
    python tools/make_sanity.py RUN

The pictures go to docs/images, the tables are printed as reStructuredText.
"""

import argparse
import json
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.instrument.image_files import read_image
from miricigale.pages import cell_of, number
from miricigale.sed import SEDModel
from miricigale.workflow import Context, labels, load_config
from miricigale.workflow.page import (
    band_figures,
    pictures,
    provenance,
    source_figures,
    study_figures,
)
from miricigale.workflow.page.numbers import StudyTables
from miricigale.workflow.page.paper import study_results
from miricigale.workflow.stages.sample import SampleFlags, typical_source
from miricigale.workflow.stages.variants import variant_entries
from miricigale.workflow.truths import reference, study_truths, variant_changes


def rst_table(header, rows):
    """A simple reStructuredText table."""
    rows = [[str(cell) for cell in row] for row in [header, *rows]]
    widths = [max(len(row[k]) for row in rows) for k in range(len(header))]
    line = "  ".join("=" * width for width in widths)
    text = ["  ".join(c.ljust(w) for c, w in zip(r, widths, strict=True)).rstrip() for r in rows]
    return "\n".join([line, text[0], line, *text[1:], line])


def shown(value, spec, scale=1):
    """A number, or a dash where the metrics have none."""
    return str(number(None if value is None else scale * value, spec, ""))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("run", type=Path, help="folder of a finished run")
    parser.add_argument(
        "--images", type=Path, default=Path(__file__).parents[1] / "docs" / "images"
    )
    args = parser.parse_args()
    args.images.mkdir(parents=True, exist_ok=True)
    run = args.run
    config = load_config(run / "config.toml")
    bands = config.exposures.filters
    metrics = json.loads((run / "report" / "metrics.json").read_text())
    sky = reference(config)
    tables = StudyTables(Context(config, run), sky)
    truth, matched, errors = tables.truth, tables.matched, tables.errors
    galaxies = tables.galaxies(field=True)
    area = metrics["area"] * u.arcmin**2
    selection = np.asarray(matched["selection"])
    inside = matched[((selection & SampleFlags.OUTSIDE_FIELD) == 0) & matched["matched"]]
    fits, results = tables.fits, tables.results
    limits = {name: errors.limiting_flux(name).to_value(u.uJy) for name in bands}
    magnitudes = {name: errors.limiting_magnitude(name).value for name in bands}
    chosen = labels.three_bands(bands)
    sample = truth[selection == 0]
    typical = typical_source(sample, results["all"].fitted, bands[-1])
    row = truth[np.asarray(truth["id"]) == typical][0]
    study = study_results(config, study_truths(config), {sky: tables}, metrics)
    model = SEDModel.yang2021()
    drawn = {
        "inputs": band_figures.input_figure(tables.galaxies())[0],
        "counts": band_figures.counts_figure(galaxies, bands, area),
        "offsets": band_figures.offset_figure(inside, bands, magnitudes),
        "errors": band_figures.error_figure(errors, bands, limits),
        "redshifts": study_figures.redshift_figure(
            {name: (sample["redshift"], table) for name, table in fits.items()}
        ),
        "fractions": study_figures.histogram_figure(study, "fraction"),
        "example": source_figures.example_figure(results, row, typical, model),
        "color": pictures.field_figure(
            [read_image(run / sky / f"mosaic_{name}.fits") for name in chosen],
            read_image(run / "f160w.fits"),
            [*chosen, config.highres.filter],
        ),
    }
    for name, figure in drawn.items():
        figure.savefig(args.images / f"{name}.png", dpi=80, metadata={"Software": None})
    lines = [text.unescape() for text in provenance.stand_ins(config, model)]
    print(*(f"* {text}" for text in lines), sep="\n", end="\n\n")
    rows = provenance.library_rows(model)
    print(rst_table(("part", "component", "library", "reference"), rows), "\n")
    print(f"{metrics['area']:.2f} square arcmin, {len(galaxies)} galaxies\n")
    rows = [
        (
            row["band"],
            f"{row['wavelength']:g} µm",
            f"{row['least']:g}" if row["least"] else "none",
            f"{shown(row['light'], '.2f')} ± {shown(row['light_err'], '.2f')}",
            f"{row['published']:.2f} -{row['down']:.2f} +{row['up']:.2f}",
            row["reference"],
        )
        for row in metrics["light"]
    ]
    print(rst_table(("band", "at", "limit (µJy)", "here", "published", "reference"), rows), "\n")
    rows = [
        (
            f"H < {row['limit']:g}",
            f"{100 * row['fraction']:.0f} %",
            f"{100 * row['low']:.0f} to {100 * row['high']:.0f} %",
            f"{100 * row['paper']:.0f} %",
        )
        for row in metrics["detected"]
    ]
    print(rst_table(("sample", "here", "68 % interval", "Yang et al. 2021"), rows), "\n")
    rows = [
        (
            name,
            shown(m["limit"], ".2f"),
            f"{m['etc_limit']:.2f}",
            " ± ".join(
                shown(m[f"bright_{key}"], spec, scale=100)
                for key, spec in (("median", "{:+.1f}"), ("median_err", "{:.1f} %"))
            ),
            m["bright_n"],
            shown(m.get("points_median"), "{:+.2f} %", scale=100),
            shown(m.get("points_scatter"), "{:.2f} %", scale=100),
            m.get("points_n", 0),
        )
        for name, m in metrics["bands"].items()
    ]
    header = (
        "band",
        "5 sigma",
        "calculator",
        "isolated > 20 sigma",
        "n",
        "points",
        "scatter",
        "n ",
    )
    print(rst_table(header, rows), "\n")
    rows = [
        (
            labels.SET_LABELS[unit],
            m["n"],
            shown(m["photoz_bias"], "+.4f"),
            shown(m["photoz_sigma_mad"], ".4f"),
            f"{m['photoz_n_outliers']} ({shown(m['photoz_outliers'], '{:.1f} %', scale=100)})",
            shown(m["frac_agn_bias"], "+.4f"),
            shown(m["frac_agn_sigma_mad"], ".4f"),
            shown(m["frac_agn_width"], ".3f"),
        )
        for unit, m in metrics["fits"].items()
    ]
    header = ("fit", "n", "dz/(1+z)", "sigma_MAD", "outliers", "fracAGN", "scatter", "width")
    print(rst_table(header, rows), "\n")
    if config.variants.images:
        table = QTable.read(run / "report" / "variants.ecsv")
        columns = labels.texts_of("variants")["table"]["columns"]
        rows = [
            [cell_of(entry, tuple(column)) for _, *column in columns]
            for entry in variant_entries(table, variant_changes(config))
        ]
        print(rst_table([header for header, *_ in columns], rows))


if __name__ == "__main__":
    main()
