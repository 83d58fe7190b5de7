#!/usr/bin/env bash
# specutils resamples masked pixels as if they were good, and the result has no mask.
#
# Seen with specutils 2.4.0 and astropy 7.2.0, a spectrum of 1 mJy in 100 pixels of which one, a cosmic ray of 1000 mJy, is
# masked, resampled to pixels of 1, 2 and 5 times the width by each of the three resamplers:
#   - FluxConservingResampler has 1000, 500.5 and 200.8 mJy in the pixel that holds it, LinearInterpolatedResampler and
#     SplineInterpolatedResampler 1000 mJy where a new pixel falls on it;
#   - the mask of every result is None.
# A good guess would be that masked pixels are left out, or that pixels made of them are masked; line_flux leaves them out.
# No warning is given. Prints what is seen, and fails if that changes.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "specutils==2.4.0" "astropy==7.2.0"
"$folder/venv/bin/python" - <<'PYTHON'
import warnings

import astropy.units as u
import numpy as np
from specutils import Spectrum
from specutils import manipulation
from specutils.analysis import line_flux

flux = np.ones(100)
flux[50] = 1000.0
mask = flux > 1.0
spectrum = Spectrum(spectral_axis=np.arange(1.0, 101.0) * u.um, flux=flux * u.mJy, mask=mask)
print(f"sum over the line, which leaves it out: {line_flux(spectrum):.0f}")
assert line_flux(spectrum).value < 101

warnings.simplefilter("error")
seen = {}
for name in ("FluxConserving", "LinearInterpolated", "SplineInterpolated"):
    resampler = getattr(manipulation, f"{name}Resampler")()
    for width in (1, 2, 5):
        # the pixel at 51 um is the middle of a new one
        grid = np.arange(51.0 - 8 * width, 51.0 + 8.5 * width, width) * u.um
        result = resampler(spectrum, grid[(grid > 3 * u.um) & (grid < 98 * u.um)])
        seen[name, width] = round(float(result.flux.value.max()), 1)
        print(f"{name}, pixels of {width} um: highest {seen[name, width]} mJy, mask {result.mask}")
        assert result.mask is None, result.mask
assert seen["FluxConserving", 1] == 1000.0, seen
assert seen["FluxConserving", 5] == 200.8, seen
assert seen["FluxConserving", 2] > 500, seen
assert all(seen[name, 1] == 1000.0 for name in ("LinearInterpolated", "SplineInterpolated")), seen
PYTHON
