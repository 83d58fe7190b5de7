"""
Processor time of `miricigale.agn.AGNSurvey` on a field with nuclei, and how well its AGN are counted.

    python benchmarks/agn_field.py FOLDER [--n 5000] [--agn 0.1] [--injections 100000]

Galaxies are those of ``agn_surveys.py --errors-of-models``, of which a share (``--agn``) has an AGN, with a known
nucleus in each of the six bands of MIRI: the light of the AGN and 0 +- 5 % of the galaxy's, with 1.5 times the
error of the total flux and a correlation of -0.2. The survey runs as ``miricigale agn catalog.fits --area 60
--nuclei --injections 100000`` in one process: with the calibration of surveys, and AGN injected until the
completeness of each bin is known to 2 %. It prints the seconds of the processor (user and system) of the fits of
the catalog and of the whole run, and counted and true numbers of AGN.
"""

import argparse
import resource
import time
from pathlib import Path

import agn_surveys
import astropy.units as u
import numpy as np

from miricigale.agn import AGNSurvey
from miricigale.fitting.catalogs.classes import fit_classes
from miricigale.utils.tables import error_column

AREA = 60 * u.arcmin**2
#: Errors of nuclei over those of total fluxes, their correlation, and the galaxy's part of the nucleus.
NUCLEUS_ERROR = 1.5
NUCLEUS_CORRELATION = -0.2
NUCLEAR_STARS = 0.05
#: Galaxies that are drawn together.
CHUNK = 500


def make_field(n, share, seed):
    """Truths of n galaxies as a dict of arrays, and their photometry with nuclei."""
    rng = np.random.default_rng(seed)
    fitter = agn_surveys.make_fitter(errors_of_models=True)
    parts = []
    for _ in range(0, n, CHUNK):
        parts.append(agn_surveys.draw_truths(fitter, CHUNK, rng, share=share))
    truth = {name: np.concatenate([part[name] for part in parts])[:n] for name in parts[0]}
    table = agn_surveys.observe(truth["flux"], truth["redshift"], fitter.template_error, rng)
    for j, band in enumerate(agn_surveys.DEPTHS):
        if not band.startswith("miri."):
            continue
        host = truth["host"][:, j]
        stars = NUCLEAR_STARS * rng.standard_normal(n) * host
        error = NUCLEUS_ERROR * table[error_column(band)]
        name = f"{band}_flux_point"
        light = (truth["flux"][:, j] - host + stars) * u.uJy
        table[name] = light + error * rng.standard_normal(n)
        table[error_column(name)] = error
        table[f"{name}_corr"] = np.full(n, NUCLEUS_CORRELATION)
    return truth, table


def processor_seconds():
    """Seconds of the processor that this process and its children took: user and system."""
    total = 0.0
    for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN):
        usage = resource.getrusage(who)
        total += usage.ru_utime + usage.ru_stime
    return total


def compare(result, truth, bins):
    """Print counted and true numbers of AGN by redshift and luminosity, and of all."""
    counted = truth["frac_agn"] >= bins.frac_agn[bins.frac_agn.index(0.1)]
    ones = np.ones(truth["redshift"].size)
    z_bin, _, l_bin = bins.place(truth["redshift"], ones, truth["luminosity"])
    columns = ["n", "n_low", "n_high", "n_corrected", "n_injected", "completeness", "purity"]
    for row in result.numbers:
        i = np.searchsorted(bins.redshift, row["redshift_low"])
        k = np.searchsorted(bins.log_luminosity, row["log_luminosity_low"]) + 1
        true = np.count_nonzero(counted & (z_bin == i) & (l_bin == k))
        values = "  ".join(f"{row[name]:.3g}" for name in columns)
        place = f"z {row['redshift_low']:g}, log L {row['log_luminosity_low']:g}"
        print(f"{place}: true {true}; {', '.join(columns)}: {values}")
    for row in result.totals:
        true = np.count_nonzero(truth["frac_agn"] >= row["frac_agn"])
        interval = f"{row['n_low']:.1f} to {row['n_high']:.1f}"
        print(f"fractions from {row['frac_agn']:g}: true {true}, {row['n']:.1f} ({interval})")


def main():
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--n", type=int, default=5000, help="galaxies")
    parser.add_argument("--agn", type=float, default=0.1, help="share of them with an AGN")
    parser.add_argument("--injections", type=int, default=100_000, help="most injected AGN")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    catalog = args.folder / "catalog.fits"
    truth, table = make_field(args.n, args.agn, args.seed)
    table.meta = {}
    table.write(catalog, overwrite=True)
    np.savez(args.folder / "truth.npz", **truth)
    survey = AGNSurvey(AREA, n_injections=args.injections)
    output = args.folder / "agn"
    begin = processor_seconds()
    wall = time.time()
    fit_classes(catalog, output / "fits", agn_bins=survey.bins, nuclei=True)
    print(f"catalog: {processor_seconds() - begin:.0f} CPU-seconds", flush=True)
    result = survey.run(catalog, output, nuclei=True)
    seconds = processor_seconds() - begin
    print(
        f"all: {seconds:.0f} CPU-seconds, {time.time() - wall:.0f} s by the clock, "
        f"{len(result.injected)} injected AGN"
    )
    compare(result, truth, survey.bins)


if __name__ == "__main__":
    main()
