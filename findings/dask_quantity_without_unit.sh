#!/usr/bin/env bash
# A Quantity of astropy that a task of dask.distributed returns comes back as a plain array, without its unit.
#
# Seen with distributed 2026.8.0 and astropy 8.0.2: results travel as NumPy arrays, subclasses too. A Quantity within a
# dict loses its unit as well; one in a QTable keeps it, and so does one that is an argument.
# A good guess would be that it is pickled, as within an object, or that an error is raised. No warning is given.
# Prints what is seen, and fails if that changes.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "distributed==2026.8.0" "dask==2026.8.0" "astropy==8.0.2" "numpy==2.4.0"
cd "$folder"
cat > run.py <<'PYTHON'
import astropy.units as u
import numpy as np
from astropy.table import QTable
from dask.distributed import Client


def flux():
    return np.ones(3) * u.uJy


def fluxes():
    return {"flux": np.ones(3) * u.uJy}


def table():
    return QTable({"flux": np.ones(3) * u.uJy})


def unit(values):
    return str(getattr(values, "unit", None))


if __name__ == "__main__":
    with Client(n_workers=1, threads_per_worker=1, dashboard_address=None) as client:
        alone = unit(client.submit(flux).result())
        within = unit(client.submit(fluxes).result()["flux"])
        column = unit(client.submit(table).result()["flux"])
        argument = client.submit(unit, flux()).result()
    print(f"unit of a result: {alone}; within a dict: {within}; in a QTable: {column}; of an argument: {argument}")
    assert (alone, within, column, argument) == ("None", "None", "uJy", "uJy")
PYTHON
"$folder/venv/bin/python" run.py
