"""
Measure the calibration that fits of real galaxies have by default, on sources of CEERS.

    python tools/make_calibration.py CATALOG [--full FILE]

Writes miricigale/refdata/files/sed/survey_calibration.ecsv and prints its checksum for resources.toml. ``CATALOG``
is the photometry of Lisiecki et al. 2025, or a part of it; of it sources with S/N above 5 in seven bands and a
published redshift of 0.1 to 5.5. ``--full`` writes the calibration with what is of that catalog alone, too: zero
points, errors of its bands, wrong fluxes.
"""

import argparse
import dataclasses
import hashlib
from pathlib import Path

import numpy as np

from miricigale.filters import read_catalog_photometry
from miricigale.fitting import BayesFitter, calibrate
from miricigale.sed import SEDModel

OUT = Path(__file__).parents[1] / "miricigale/refdata/files/sed/survey_calibration.ecsv"


def sample(path):
    """Sources of the catalog with fluxes enough, and all bands."""
    table = read_catalog_photometry(path, "ceers")
    bands = [name for name in table.colnames if f"{name}_err" in table.colnames]
    for name in bands:
        # -99 is no error
        none = ~(table[f"{name}_err"] > 0)
        table[name][none] = table[f"{name}_err"][none] = np.nan
    signal = np.array([np.nan_to_num((table[b] / table[f"{b}_err"]).value) for b in bands])
    z = np.asarray(table["redshift"], float)
    return table[((signal > 5).sum(axis=0) >= 7) & (z > 0.1) & (z < 5.5)], bands


def main():
    """Measure, and write."""
    parser = argparse.ArgumentParser()
    parser.add_argument("catalog", type=Path)
    parser.add_argument("--full", type=Path)
    args = parser.parse_args()
    table, bands = sample(args.catalog)
    # not with what it is to make
    fitter = BayesFitter(SEDModel.survey(), bands, calibration=None)
    found = calibrate(fitter, table, reference="wfc3.f160w", name="CEERS")
    print(found.scores)
    if args.full:
        found.write(args.full, overwrite=True)
    dataclasses.replace(found, bands=found.bands[:0]).write(OUT, overwrite=True)
    print(hashlib.sha256(OUT.read_bytes()).hexdigest())


if __name__ == "__main__":
    main()
