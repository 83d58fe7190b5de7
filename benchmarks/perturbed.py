"""
What it costs that the analysis does not know the sky: the table of docs/method/workflow.rst.

    python benchmarks/perturbed.py FOLDER [--set perturb.cutouts=IMAGE.fits --set perturb.cutouts_of=any]

runs the preset ``goodss`` with all effects on a sky of fracAGN 0.4, all bands and the full grid, as rates of one
dither, until the fits, and prints accuracies and their changes with the number of sources in common. A run
that was stopped resumes; ``--only-table`` takes the skies that stand in the folder, ``--only NAME`` (repeated)
makes these and the one without effects.
"""

import argparse
from pathlib import Path

from miricigale.utils.parallel import process_pool
from miricigale.workflow import Context, load_config, run_study
from miricigale.workflow.options import read_setting
from miricigale.workflow.page.numbers import StudyTables
from miricigale.workflow.stages.perturbed import perturbation_costs
from miricigale.workflow.truths import study_truths

STUDY = {
    "run": {"threads": 2},
    "exposures": {"kind": "rates", "n_dithers": [1] * 6},
    "sed": {"frac_agn": [0.0, 0.4]},
    "point_sources": {"enabled": False},
    "fit": {"sets": ["all"]},
    "perturb": {"of": [0.4], "effects": ["all"]},
}


def show(config, folder):
    """Print the table of the skies whose fits stand in the folder."""
    context, every = Context(config, folder), {}
    truths = {
        name: truth
        for name, truth in study_truths(config).items()
        if (folder / name / "fits_all.fits").is_file()
    }
    for name in truths:
        every[name] = StudyTables(context, name)
    table = perturbation_costs(truths, every, config.exposures.filters, seed=config.run.seed)
    quantities = list(dict.fromkeys(table["quantity"]))
    print(" | ".join(["perturbation", *quantities]))
    for name in dict.fromkeys(table["perturbation"]):
        rows = {row["quantity"]: row for row in table[table["perturbation"] == name]}
        cells = []
        for quantity in quantities:
            row, kind = rows[quantity], "value" if name == "none" else "change"
            share = "." in quantity or quantity.endswith("outliers")
            scale, digits = (100, 1) if share else (1, 3)
            sign = "+" if kind == "change" or quantity.endswith("offset") else ""
            error = row[kind + "_err"]
            text = f"{scale * row[kind]:{sign}.{digits}f} ± {scale * error:.{digits}f} ({row['n']})"
            cells.append(text if row["n"] else "no source")
        print(" | ".join([name, *cells]))


def main():
    parser = argparse.ArgumentParser(description=__doc__.strip().partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--set", action="append", default=[], metavar="section.key=value")
    parser.add_argument("--only-table", action="store_true")
    parser.add_argument("--only", action="append", default=[], metavar="NAME")
    arguments = parser.parse_args()
    values = {name: dict(section) for name, section in STUDY.items()}
    for text in arguments.set:
        section, key, value = read_setting(text)
        values.setdefault(section, {})[key] = value
    config = load_config("goodss", overrides=values)
    if not arguments.only_table:
        with process_pool(config.run.threads) as executor:
            skies = ["agn40", *(f"agn40+{name}" for name in arguments.only)]
            for until in [f"fits:{sky}/*" for sky in skies] if arguments.only else ["fits"]:
                run_study(
                    config, arguments.folder, executor=executor, until=until, progress_bar=True
                )
    show(config, arguments.folder)


if __name__ == "__main__":
    main()
