#!/usr/bin/env bash
# pyphot gives no light at all to a spectrum whose points lie on both sides of a band.
#
# Seen with pyphot 2.1.1 and numpy 2.4.0, a source of 3631 Jy at all wavelengths (AB magnitude 0):
#   - on 20 points per decade, its flux in a band of 1.1 % at 1.19 um (NB118, say) is 0;
#   - in a band from 11.0 to 11.6 um (F1130W) it is 0 on 8 points per decade, 0.05 mag too faint on 16, and 0.06 mag too
#     bright on 24; on 1000 it is right.
# The band is interpolated at the points of the spectrum, and only there. A good guess would be the points of both (within
# 0.06 mag of 0 in all of these) or an error: coarse models, of dust or power laws, drop out of narrow bands, as if
# they were dark there. No warning is given.
# Prints what is seen, and fails if that changes.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "pyphot==2.1.1" "astropy==7.2.0" "numpy==2.4.0" requests
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import warnings

import numpy as np
from pyphot import Filter

SPEED_OF_LIGHT = 2.99792458e18  # Angstrom / s


def band(center, width):
    """Return the points of a band with steep edges, in Angstrom."""
    wave = np.linspace(center - 0.7 * width, center + 0.7 * width, 401)
    throughput = np.exp(-0.5 * ((wave - center) / (0.5 * width)) ** 8)
    return wave, throughput


bands = {"narrow": band(11900.0, 130.0), "F1130W": band(113000.0, 6000.0)}
seen = {}
for name, points_per_decade in (
    ("narrow", 20),
    ("F1130W", 8),
    ("F1130W", 16),
    ("F1130W", 24),
    ("F1130W", 1000),
):
    wave = np.geomspace(1e3, 1e6, 3 * points_per_decade + 1)
    flux = 3631e-23 * SPEED_OF_LIGHT / wave**2
    curve = Filter(*bands[name], name=name, dtype="photon", unit="AA")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mean = curve.get_flux(wave, flux)
    mean = float(getattr(mean, "value", mean))
    magnitude = np.inf
    if mean > 0:
        magnitude = round(float(-2.5 * np.log10(mean) - curve.AB_zero_mag), 2)
    # points of both, the spectrum joined by straight lines
    lam, throughput = bands[name]
    fine = np.union1d(lam, wave[(wave > lam[0]) & (wave < lam[-1])])
    photons = np.interp(fine, lam, throughput) * fine
    both = np.trapezoid(photons * np.interp(fine, wave, flux), fine) / np.trapezoid(photons, fine)
    reference = -2.5 * np.log10(both) - curve.AB_zero_mag
    seen[name, points_per_decade] = magnitude
    print(
        f"{name}, {points_per_decade} points per decade: pyphot {mean:.3e} erg/s/cm2/AA, "
        f"{magnitude} mag; points of both {reference:.3f} mag"
    )
assert list(seen.values()) == [np.inf, np.inf, 0.05, -0.06, 0.0], seen
PYTHON
