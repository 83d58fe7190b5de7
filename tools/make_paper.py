"""
Make the table of docs/accuracy/paper.rst: every number of Yang et al. 2021 beside those of finished studies.

    python tools/make_paper.py RUN [AS_THEIRS]

RUN is one of ``miricigale run yang2021``; AS_THEIRS is another in which what the paper does otherwise is done as
there, and adds what share of each difference that explains. The table is printed as reStructuredText.
"""

import argparse
from pathlib import Path

import numpy as np
from astropy.table import QTable
from make_sanity import rst_table


def shown(value, low=np.nan, high=np.nan):
    """A number with half the width of its interval."""
    if not np.isfinite(value):
        return ""
    error = 0.5 * (high - low)
    if not (np.isfinite(error) and error > 0):
        return f"{value:.4g}"
    digits = max(0, 1 - int(np.floor(np.log10(error))))
    return f"{value:.{digits}f} ± {error:.{digits}f}"


def apart(row):
    """How far a number is from the paper's: its verdict in a word or in errors."""
    verdict = row["verdict"]
    if verdict.startswith("differs"):
        return f"{row['sigma']:+.1f} σ" if np.isfinite(row["sigma"]) else verdict.split(":")[0]
    return {"agrees": "agrees", "within": "within", "not": ""}[verdict.split()[0]]


def explained(ours, theirs):
    """Share of the difference that is gone if all is done as in the paper."""
    if not ours["verdict"].startswith("differs") or not np.isfinite(theirs["ours"]):
        return ""
    if not theirs["verdict"].startswith("differs"):
        return "all"
    gone = (ours["ours"] - theirs["ours"]) / (ours["ours"] - ours["paper"])
    return f"{round(100 * gone)} %"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("run", type=Path)
    parser.add_argument("as_theirs", type=Path, nargs="?")
    args = parser.parse_args()
    folders = [args.run, *([args.as_theirs] if args.as_theirs else [])]
    tables = [QTable.read(folder / "report" / "paper.ecsv") for folder in folders]
    rows = []
    for both in zip(*tables, strict=True):
        row = both[0]
        mark = {"=": "", "~": "about "}.get(row["relation"], f"{row['relation']} ")
        where = row["source"].replace("section ", "").replace("appendix ", "")
        cells = [row["description"], where, f"{mark}{row['paper']:.4g}"]
        for one in both:
            cells += [shown(one["ours"], one["low"], one["high"]), apart(one)]
        rows.append([*cells, *(explained(row, other) for other in both[1:])])
    header = ["number", "in", "paper", "here", "difference"]
    header += ["as theirs", "difference", "explained"][: 3 * (len(tables) - 1)]
    # an empty first cell would join a row to the one before
    print(rst_table(header, [[cell or "\\ " for cell in row] for row in rows]))
    for label, table in zip(("here", "as theirs"), tables, strict=False):
        words = [row["verdict"].split()[0] for row in table]
        print(label, {word: words.count(word) for word in sorted(set(words))})


if __name__ == "__main__":
    main()
