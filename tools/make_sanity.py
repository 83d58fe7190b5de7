"""
Make the pictures and tables of docs/sanity.rst from a finished run.

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

from miricigale.evaluation import PUBLISHED_LIGHT, integrated_light
from miricigale.fitting import FitResults
from miricigale.photometry import ErrorModel
from miricigale.workflow import load_config, read_image
from miricigale.workflow.stages import figures
from miricigale.workflow.stages.sample import SampleFlags


def rst_table(header, rows):
    """A simple reStructuredText table."""
    rows = [[str(cell) for cell in row] for row in [header, *rows]]
    widths = [max(len(row[k]) for row in rows) for k in range(len(header))]
    line = "  ".join("=" * width for width in widths)
    text = ["  ".join(c.ljust(w) for c, w in zip(r, widths, strict=True)).rstrip() for r in rows]
    return "\n".join([line, text[0], line, *text[1:], line])


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
    truth = QTable.read(run / "truth.ecsv")
    matched = QTable.read(run / "matched.ecsv")
    errors = ErrorModel.read(run / "errors.ecsv")
    known = np.isfinite(truth["stellar_mass"].value) & ~np.asarray(truth["star"], bool)
    galaxies = truth[known]
    area = figures.catalog_area(truth)
    selection = np.asarray(matched["selection"])
    inside = matched[((selection & SampleFlags.OUTSIDE_FIELD) == 0) & matched["matched"]]
    fits = {unit: QTable.read(run / f"fits_{unit}.ecsv") for unit in ("with_miri", "without_miri")}
    results = {unit: FitResults.read(run / f"fits_{unit}.fits") for unit in fits}
    limits = {name: errors.limiting_flux(name).to_value(u.uJy) for name in bands}
    chosen = [bands[0], bands[len(bands) // 2], bands[-1]]
    sample = truth[selection == 0]
    typical = sample["id"][np.argsort(np.abs(np.asarray(sample["redshift"]) - 1.2))[5]]
    pictures = {
        "inputs": figures.input_figure(galaxies),
        "counts": figures.counts_figure(galaxies, bands, area),
        "offsets": figures.offset_figure(inside, bands),
        "errors": figures.error_figure(errors, bands, limits),
        "redshifts": figures.redshift_figure(sample, fits),
        "fractions": figures.fraction_figure(fits, config.sed.frac_agn),
        "example": figures.example_figure(results, truth, typical),
        "colour": figures.colour_figure(
            *(read_image(run / f"mosaic_{name}_fine.fits") for name in chosen),
            read_image(run / "f160w.fits"),
            [*chosen, config.highres.filter],
        ),
    }
    for name, figure in pictures.items():
        figure.savefig(args.images / f"{name}.png", dpi=80)
    print(f"{area.to_value(u.arcmin**2):.2f} square arcmin, {len(galaxies)} galaxies\n")
    rows = []
    for name, wave, least, value, down, up, reference in PUBLISHED_LIGHT:
        flux = galaxies[name][galaxies[name] >= least * u.uJy]
        light, error = integrated_light(flux, area, wave * u.um)
        rows.append(
            (
                name,
                f"{wave:g} um",
                f"{least:g}" if least else "none",
                f"{light.value:.2f} ± {error.value:.2f}",
                f"{value:.2f} -{down:.2f} +{up:.2f}",
                reference,
            )
        )
    print(rst_table(("band", "at", "limit (uJy)", "here", "published", "reference"), rows), "\n")
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
            f"{m['limit']:.2f}",
            f"{m['etc_limit']:.2f}",
            f"{100 * m['bright_median']:+.1f} ± {100 * m['bright_median_err']:.1f} %",
            m["bright_n"],
            f"{100 * m['points_median']:+.2f} %",
            f"{100 * m['points_scatter']:.2f} %",
            m["points_n"],
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
            unit.replace("_", " "),
            m["n"],
            f"{m['photoz_bias']:+.4f}",
            f"{m['photoz_sigma_mad']:.4f}",
            f"{m['photoz_n_outliers']} ({100 * m['photoz_outliers']:.1f} %)",
            f"{m['frac_agn_bias']:+.4f}",
            f"{m['frac_agn_sigma_mad']:.4f}",
            f"{m['frac_agn_width']:.3f}",
        )
        for unit, m in metrics["fits"].items()
    ]
    header = ("fit", "n", "dz/(1+z)", "sigma_MAD", "outliers", "fracAGN", "scatter", "width")
    print(rst_table(header, rows))


if __name__ == "__main__":
    main()
