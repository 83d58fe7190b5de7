#!/usr/bin/env bash
# A spectrum that synphot is given in Jy is not linear in Jy between its points.
#
# Seen with synphot 1.8.0 and astropy 7.2.0, a source of 1 Jy at 1 um and at 10 um (Empirical1D with these two points):
#   - 1.8 Jy at 2 um, 3.0 Jy at 5 um and 2.4 Jy at 8 um;
#   - a source of 3631 Jy at 4 and 12 um has AB magnitude -0.30 in a band from 6.4 to 9 um, with 5 points -0.01.
# Points are converted to photons per second, area and wavelength and joined by straight lines there. A good guess would
# be lines in the unit that was given. Steep or coarse models, as power laws and grids of a few points for each octave,
# are then too bright. No warning is given. Prints what is seen, and fails if that changes.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "synphot==1.8.0" "astropy==7.2.0"
"$folder/venv/bin/python" - <<'PYTHON'
import astropy.units as u
import numpy as np
from synphot import Observation, SourceSpectrum, SpectralElement
from synphot.models import Box1D, Empirical1D

source = SourceSpectrum(Empirical1D, points=[1.0, 10.0] * u.um, lookup_table=[1.0, 1.0] * u.Jy)
fluxes = {}
for wavelength in (1.0, 2.0, 5.0, 8.0, 10.0):
    fluxes[wavelength] = round(float(source(wavelength * u.um, flux_unit="Jy").value), 2)
    print(f"{wavelength:4.1f} um: {fluxes[wavelength]:.2f} Jy")
assert fluxes == {1.0: 1.0, 2.0: 1.8, 5.0: 3.0, 8.0: 2.4, 10.0: 1.0}, fluxes
band = SpectralElement(Box1D, amplitude=1.0, x_0=7.7 * u.um, width=2.6 * u.um)
magnitudes = {}
for n_points in (2, 5):
    points = np.linspace(4.0, 12.0, n_points) * u.um
    flat = SourceSpectrum(Empirical1D, points=points, lookup_table=np.full(n_points, 3631.0) * u.Jy)
    magnitudes[n_points] = round(float(Observation(flat, band).effstim(u.ABmag).value), 2)
    print(f"flat in AB, {n_points} points: {magnitudes[n_points]:.2f} mag")
assert magnitudes == {2: -0.3, 5: -0.01}, magnitudes
PYTHON
