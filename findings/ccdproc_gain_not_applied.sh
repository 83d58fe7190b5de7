#!/usr/bin/env bash
# ccdproc cleans an image of cosmic rays without applying the gain, and calls its ADU electrons.
#
# Seen with ccdproc 2.5.1, astroscrappy 1.3.0, astropy 7.2.0 and numpy 2.4.0, an image of 10 adu, gain 2 electron / adu:
#   - `cosmicray_lacosmic(gain_apply=True)` returns 20 electron;
#   - `cosmicray_lacosmic(gain_apply=False)` returns 10 electron, with or without a unit of the gain.
# Its text says "return gain-corrected data, with correct units, otherwise do not gain-correct the data". A good guess
# would be 10 adu. Later steps that trust the unit are wrong by the gain, and do not apply it. No warning is given.
# Prints what is seen, and fails if that changes.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "ccdproc==2.5.1" "astroscrappy==1.3.0" "astropy==7.2.0" "numpy==2.4.0"
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import warnings

import astropy.units as u
import numpy as np
from astropy.nddata import CCDData
from ccdproc import cosmicray_lacosmic

warnings.simplefilter("error")
seen = {}
for gain in (2 * u.electron / u.adu, 2.0):
    for gain_apply in (True, False):
        image = CCDData(np.full((30, 30), 10.0), unit="adu")
        readnoise = 3.0
        if isinstance(gain, u.Quantity):
            readnoise = 3.0 * u.electron
        clean = cosmicray_lacosmic(image, gain=gain, readnoise=readnoise, gain_apply=gain_apply)
        pixel = f"{clean.data[0, 0]} {clean.unit}"
        seen[str(gain), gain_apply] = pixel
        print(f"10 adu, gain {gain}, gain_apply={gain_apply}: {pixel}")
assert list(seen.values()) == ["20.0 electron", "10.0 electron", "20.0 electron", "10.0 electron"], seen
PYTHON
