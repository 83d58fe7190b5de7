#!/usr/bin/env bash
# The attenuation curve `noll` of sedpy brightens galaxies in the infrared, if used as its text recommends.
#
# Seen with astro-sedpy 0.4.1 and numpy 2.4.0, optical depth 1 at 5500 A, slope delta = +0.3 (grayer than Calzetti) and
# c_r = -delta, which "maintains the Calzetti R_v = 4.05" in the words of the function:
#   - the optical depth is -0.32 at 2.2 um, -0.59 at 3.5 um and -0.74 at 7.7 um: light is multiplied by 2.1 there;
#   - with delta = +0.5 it is -2.1 at 7.7 um, a factor of 8; with delta = -0.5, where the curve of Calzetti has ended, it is +0.15;
#   - A(B) - A(V) is Calzetti's to 4 % in all three.
# The factor that restores the color acts on tau - 1, so that 1.12 c_r stays where the curve has ended, times the power law.
# A good guess would be zero (as `calzetti` has) or a few percent: dust never brightens, in any band. No warning is given.
# Prints what is seen, and fails if that changes.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "astro-sedpy==0.4.1" "numpy==2.4.0"
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import warnings

import numpy as np

warnings.simplefilter("error")
from sedpy.attenuation import calzetti, noll

wave = np.array([4400.0, 5500.0, 22000.0, 35000.0, 77000.0])
depths = {"calzetti": calzetti(wave).round(2).tolist()}
for delta in (-0.5, 0.0, 0.3, 0.5):
    depths[delta] = noll(wave, tau_v=1.0, delta=delta, c_r=-delta).round(2).tolist()
for curve, depth in depths.items():
    brightening = np.exp(-depth[-1])
    print(f"{curve}: optical depths at {wave / 1e4} um {depth}, light at 7.7 um x {brightening:.2f}")
assert depths["calzetti"] == depths[0.0] == [1.25, 1.0, 0.09, 0.0, 0.0]
assert depths[-0.5] == [1.24, 1.0, 0.3, 0.22, 0.15]
assert depths[0.3] == [1.25, 1.0, -0.32, -0.59, -0.74]
assert depths[0.5] == [1.24, 1.0, -0.84, -1.41, -2.1]
PYTHON
