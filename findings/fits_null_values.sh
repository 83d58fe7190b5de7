#!/usr/bin/env bash
# Masked columns of an astropy table, written to FITS and read again: an integer that equals the null value is lost,
# and a masked False comes back as an unmasked True.
#
# Seen with astropy 8.0.2 and numpy 2.4.0:
#   - a masked column of integers is written with TNULL = 999999, whatever it holds, so that a real 999999 (an id, say)
#     is masked after reading;
#   - a logical column has no null value: its masked entries are written as True.
# A good guess would be that a null value is chosen that does not occur, or that an error is raised. No warning is given.
# Prints what is seen, and fails if that changes.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "astropy==8.0.2" "numpy==2.4.0"
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import warnings

import numpy as np
from astropy.io import fits
from astropy.table import MaskedColumn, Table

warnings.simplefilter("error")
numbers = MaskedColumn([999999, 7, 3], mask=[False, False, True])
flags = MaskedColumn([False, False, True], mask=[True, False, False])
Table({"number": numbers, "flag": flags}).write("masked.fits")
table = Table.read("masked.fits")

null = fits.getheader("masked.fits", 1)["TNULL1"]
lost = bool(np.ma.getmaskarray(table["number"])[0])
masked = bool(np.ma.getmaskarray(table["flag"])[0])
value = bool(table["flag"][0])
print(f"TNULL1 = {null}; the real 999999 is masked after reading: {lost}")
print(f"the masked False is masked after reading: {masked}; its value: {value}")
assert null == 999999
assert lost
assert not masked
assert value
PYTHON
