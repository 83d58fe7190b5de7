"""
A real run of CIGALE again: its own ini and table of Seyferts, against its own results.

    python benchmarks/seyferts.py RUN                                       bundled libraries
    python benchmarks/seyferts.py RUN --libraries FOLDER --filters FOLDER   with libraries and curves

RUN has pcigale.ini, the catalog that it names and CIGALE's results.fits. FOLDER of --libraries has dale2014/
and skirtor2016/ as `miricigale data add` takes them (registered in a temporary folder); where the SKIRTOR files
lack the ini's q, --q takes another. FOLDER of --filters has curves as CIGALE's database_builder/filters.

Each quantity gives a line: medians here and there, the median of the differences object by object (dex; plain
for fracAGN), and their 16-84 % range; then reduced chi2 with CPU seconds. The last lines have the fluxes of our
models at the parameters of CIGALE's best ones: ratio by band, median over the objects.
"""

import argparse
import contextlib
import tempfile
import time
import warnings
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale import conf
from miricigale.cigale import read_cigale_results, read_pcigale_ini
from miricigale.cigale.names import cigale_names
from miricigale.refdata.libraries import add_library
from miricigale.utils.exceptions import MiricigaleWarning

QUANTITIES = (
    "stellar.m_star",
    "sfh.sfr",
    "dust.luminosity",
    "agn.fracAGN",
    "agn.accretion_power",
    "agn.luminosity",
    "agn.total_dust_luminosity",
    "agn.disk_luminosity",
)
FILES = {
    "dust.dale2014": "dale2014",
    "torus.skirtor2016": "skirtor2016/SKIRTOR.fits.gz",
}


def numbers(table, name):
    column = table[name]
    return np.ma.filled(np.ma.asarray(getattr(column, "value", column), float), np.nan)


def compare(ours, theirs):
    """Print a line for each quantity."""
    print(f"{'quantity':34s} {'here':>10s} {'CIGALE':>10s} {'median':>8s}  16-84 %")
    for name in QUANTITIES:
        for kind in ("bayes", "best"):
            column = f"{kind}.{name}"
            if column not in ours.colnames or column not in theirs.colnames:
                print(f"{column:34s} not there")
                continue
            a, b = numbers(ours, column), numbers(theirs, column)
            with np.errstate(all="ignore"):
                change = a - b if name == "agn.fracAGN" else np.log10(a / b)
            change = change[np.isfinite(change)]
            low, mid, high = np.percentile(change, [16, 50, 84])
            good = np.isfinite(a) & np.isfinite(b)
            print(
                f"{column:34s} {np.median(a[good]):10.3g} {np.median(b[good]):10.3g} {mid:+8.3f}  "
                f"{low:+.3f} {high:+.3f}"
            )


def at_their_best(setup, theirs):
    """Fluxes of our models at the parameters of CIGALE's best ones, over theirs."""
    table = QTable()
    known = setup.model().parameters
    for ours, (name, _, factor) in cigale_names(setup.modules).items():
        if ours in known and f"best.{name}" in theirs.colnames:
            table[ours] = numbers(theirs, f"best.{name}") / factor
    if "q" in table.colnames and "q" not in setup.parameters:
        table["q"] = setup.model().defaults["q"]
    table["mass"] = numbers(theirs, "best.sfh.integrated")
    fluxes = setup.model().fluxes(table, setup.filters())
    print("our model at the parameters of CIGALE's best, over its flux:")
    for name, band in setup.bands.items():
        if f"best.{band}" in theirs.colnames:
            ratio = fluxes[name].to_value(u.mJy) / numbers(theirs, f"best.{band}")
            low, mid, high = np.nanpercentile(ratio, [16, 50, 84])
            print(f"  {band:12s} {mid:.3f}  {low:.3f} {high:.3f}")
    for ours, name in (("stellar_mass", "stellar.m_star"), ("dust_luminosity", "dust.luminosity"),
                       ("accretion_power", "agn.accretion_power")):  # fmt: skip
        ratio = fluxes[ours].value / numbers(theirs, f"best.{name}")
        print(f"  {name:24s} {np.nanmedian(ratio):.3f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--libraries", type=Path)
    parser.add_argument("--filters", type=Path)
    parser.add_argument("--q", type=float, help="q of the torus, where the library lacks the ini's")
    args = parser.parse_args()
    names = {path.stem: path for path in sorted(args.filters.glob("*.dat"))} if args.filters else {}
    warnings.simplefilter("ignore", MiricigaleWarning)
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        if args.libraries:
            stack.enter_context(conf.set_temp("data_folder", str(folder / "data")))
            for name, file in FILES.items():
                add_library(name, args.libraries / file)
        ini = args.run / "pcigale.ini"
        text = ini.read_text()
        if args.q is not None:
            text = text.replace("    q = 1.0\n", f"    q = {args.q:g}\n")
        (folder / "pcigale.ini").write_text(text)
        setup = read_pcigale_ini(folder / "pcigale.ini", names=names)
        print(setup.describe())
        photometry = setup.catalog(args.run / setup.data_file.name)
        start = time.process_time()
        results = setup.fit(photometry)
        seconds = time.process_time() - start
        out = folder / "results.fits"
        setup.write_results(results, out)
        ours = read_cigale_results(out)
        theirs = read_cigale_results(args.run / "results.fits")
        compare(ours, theirs)
        chi2 = [numbers(table, "best.reduced_chi_square") for table in (ours, theirs)]
        print(
            f"reduced chi2, median: {np.nanmedian(chi2[0]):.3f}; CIGALE {np.nanmedian(chi2[1]):.3f}"
        )
        print(f"{len(photometry)} objects, grid and fit: {seconds:.1f} s of CPU")
        at_their_best(setup, theirs)


if __name__ == "__main__":
    main()
