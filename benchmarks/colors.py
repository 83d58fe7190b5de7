"""
How well two MIRI colors tell galaxies, composites and AGN apart, by how the bands are paired.

    python benchmarks/colors.py [--all]

The skies of `frac_agn.py` at six fractions, galaxies and AGN above 5 sigma in F1000W, true classes by the
AGN share of the 5-15 um light. For each range of redshift and each pair of colors: share of each class that is
found, by circles fitted to the other half of the galaxies, of true fluxes and of fluxes with noise. ``--all``
tries all pairs of colors of the six bands (minutes), otherwise those of `COLOR_WINDOWS`, and the three ways to
pair the bands of Kirkpatrick et al. 2017 at redshift 1.
"""

import argparse
import dataclasses
import itertools

import numpy as np
from astropy.table import vstack
from frac_agn import CEERS_FILTERS, Case, make_truth, model_of, observe

from miricigale.evaluation import (
    CLASS_NAMES,
    COLOR_WINDOWS,
    KIRKPATRICK_LIMITS,
    classify,
    color_classes,
    mid_infrared_fractions,
)

FRACTIONS = (0.0, 0.2, 0.4, 0.6, 0.8, 0.99)
ALPHAS = (1.0, 1.5, 2.0, 2.5)
#: The bands of Kirkpatrick et al. 2017 at redshifts 0.75 to 1.25.
FOUR = ("miri.f770w", "miri.f1000w", "miri.f1500w", "miri.f1800w")


def sky(fraction, seed=1):
    """True fluxes, fluxes with noise, and AGN shares of the 5-15 um light of a sky."""
    truth = make_truth(Case(nodes=ALPHAS), fraction, seed)
    noisy, _ = observe(truth, "run", seed)
    seen = np.asarray(noisy["miri.f1000w"] > 5 * noisy["miri.f1000w_err"])
    truth, noisy = truth[seen], noisy[seen]
    share = np.zeros(len(truth))
    if fraction > 0:
        share = mid_infrared_fractions(model_of("bundled", "bundled"), truth)
    return truth["id", "redshift", *CEERS_FILTERS], noisy["id", *CEERS_FILTERS], share


def pairings(bands):
    """The ways to make two colors of four bands."""
    first, *others = bands
    for other in others:
        yield (other, first), tuple(band for band in others if band != other)


def main():
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--all", action="store_true", help="all pairs of colors")
    args = parser.parse_args()
    skies = [sky(fraction) for fraction in FRACTIONS]
    truth, noisy = (vstack([one[k] for one in skies], metadata_conflicts="silent") for k in (0, 1))
    true = classify(np.concatenate([one[2] for one in skies]), limits=KIRKPATRICK_LIMITS)
    redshift = np.asarray(truth["redshift"], float)
    for k, window in enumerate(COLOR_WINDOWS):
        pairs = [(window.x, window.y), *(pairings(FOUR) if k == 0 else ())]
        if args.all:
            colors = itertools.combinations(CEERS_FILTERS, 2)
            pairs = list(itertools.combinations(colors, 2))
        rows = []
        for x, y in dict.fromkeys(pairs):
            one = dataclasses.replace(window, x=x, y=y)
            shares = []
            for fluxes in (truth, noisy):
                found = color_classes(
                    fluxes, redshift, true, windows=[one], groups=truth["id"], seed=1
                )
                known = found != "unknown"
                shares += [np.mean(found[known & (true == n)] == n) for n in CLASS_NAMES]
            rows.append((np.mean(shares[:3]), x, y, shares))
        rows.sort(key=lambda row: -row[0])
        print(f"{window.z_low:g} < z < {window.z_high:g}: {', '.join(CLASS_NAMES)}; with noise")
        for score, x, y, shares in rows[:10]:
            names = "  ".join("/".join(band[5:].upper() for band in color) for color in (x, y))
            text = " ".join(f"{100 * share:3.0f}" for share in shares)
            print(f"    {names:30s} {text}   mean {100 * score:.0f} %", flush=True)


if __name__ == "__main__":
    main()
