#!/usr/bin/env bash
# Smoothing a spectrum with specutils makes its stated errors larger, while its noise becomes smaller.
#
# Seen with specutils 2.4.0 and astropy 7.2.0, independent noise of 0.1 Jy with this standard deviation as uncertainty:
#   - box_smooth of 5 pixels: the scatter falls to 0.044 (0.1 / sqrt 5), the uncertainty rises to 0.224 (0.1 sqrt 5);
#   - gaussian_smooth of 5 pixels: the scatter falls to 0.023, the uncertainty rises to 0.421.
# The inverse of the variance, not the variance, is convolved with the square of the kernel. A good guess would be the
# scatter, as the documentation speaks of a standard propagation of errors. No warning is given. A table of fluxes from a
# smoothed spectrum has S/N too low by 5 and 18. Prints what is seen, and fails if that changes.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "specutils==2.4.0" "astropy==7.2.0"
"$folder/venv/bin/python" - <<'PYTHON'
import astropy.units as u
import numpy as np
from astropy.nddata import StdDevUncertainty
from specutils import Spectrum
from specutils.manipulation import box_smooth, gaussian_smooth

n_pixels = 40_000
noise = np.random.default_rng(1).normal(scale=0.1, size=n_pixels)
spectrum = Spectrum(
    spectral_axis=np.linspace(5.0, 10.0, n_pixels) * u.um,
    flux=(1.0 + noise) * u.Jy,
    uncertainty=StdDevUncertainty(np.full(n_pixels, 0.1) * u.Jy),
)
seen = {}
for smooth in (box_smooth, gaussian_smooth):
    smoothed = smooth(spectrum, 5)
    middle = slice(100, -100)
    scatter = float(np.std(smoothed.flux.value[middle]))
    stated = float(np.median(smoothed.uncertainty.array[middle]))
    print(f"{smooth.__name__}: scatter 0.100 -> {scatter:.3f}, uncertainty 0.100 -> {stated:.3f}")
    seen[smooth.__name__] = (round(scatter, 2), round(stated, 2))
assert seen == {"box_smooth": (0.04, 0.22), "gaussian_smooth": (0.02, 0.42)}, seen
PYTHON
