#!/usr/bin/env bash
# astro-sedpy takes a spectrum that ends within a band as dark beyond its end.
#
# Seen with astro-sedpy 0.4.1 and numpy 2.4.0, a source of constant AB magnitude 0 in F770W of MIRI (6.2 to 9.3 um):
#   - 0.09 mag if its spectrum ends at 8.5 um, 0.41 at 8.0 um, 0.87 at 7.5 um;
#   - NaN only if it ends before the band begins, at 6.0 um.
# A good guess would be an error or NaN, as synphot raises PartialOverlap, for models of galaxies often end at the last
# wavelength of a library and are then put at some redshift. No warning is given. Prints what is seen, and fails if that
# changes.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "astro-sedpy==0.4.1" "numpy==2.4.0"
"$folder/venv/bin/python" - <<'PYTHON'
import warnings

import numpy as np
from sedpy.observate import Filter

warnings.simplefilter("error", UserWarning)
band = Filter("jwst_f770w")
wavelength = np.linspace(5e4, 12e4, 5000)  # Angstrom
# 3631 Jy in erg / (s cm2 Angstrom)
flux = 3631e-23 * 2.99792458e18 / wavelength**2
seen = []
for end in (12e4, 8.5e4, 8.0e4, 7.5e4, 6.0e4):
    with np.errstate(all="ignore"):
        covered = wavelength <= end
        magnitude = float(band.ab_mag(wavelength[covered], flux[covered]))
    print(f"spectrum to {end / 1e4:.1f} um: {magnitude:.2f} mag")
    seen.append(round(magnitude, 2))
assert seen[:4] == [0.0, 0.09, 0.41, 0.87], seen
assert np.isnan(seen[4])
PYTHON
