#!/usr/bin/env bash
# A PSF that photutils resizes to other pixels is wider, or narrower, than these pixels ask for.
#
# Seen with photutils 3.0.0, numpy 2.4.0 and scipy 1.17.0, a Gaussian of sigma 1.5 pixels resized to pixels of half
# the size, where its sigma is 3:
#   - 3.286 on an array of 11 x 11 pixels, 3.125 on 25 x 25, 3.060 on 51 x 51, 3.030 on 101 x 101;
#   - the size of the new array is not twice the old one but 23, 51, 103 and 203.
# Centers of the outermost pixels stay on each other, so that sizes grow by (m - 1) / (n - 1) with n and m pixels a side
# before and after, in place of the ratio of the pixel scales. A good guess would be that the ratio counts, whatever the
# size of the array is. No warning is given. Prints what is seen, and fails if that changes.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "photutils==3.0.0" "numpy==2.4.0" "scipy==1.17.0"
"$folder/venv/bin/python" - <<'PYTHON'
import numpy as np
from photutils.psf_matching import resize_psf


def gaussian(n_pixels, sigma):
    axis = np.arange(n_pixels) - 0.5 * (n_pixels - 1)
    profile = np.exp(-0.5 * (axis / sigma) ** 2)
    psf = np.outer(profile, profile)
    return psf / psf.sum()


def measured_sigma(psf):
    axis = np.arange(psf.shape[1]) - 0.5 * (psf.shape[1] - 1)
    return np.sqrt(psf.sum(axis=0) @ axis**2 / psf.sum())


seen = {}
for n_pixels in (11, 25, 51, 101):
    resized = resize_psf(gaussian(n_pixels, 1.5), 0.11, 0.055)
    sigma = measured_sigma(resized)
    n_new = resized.shape[0]
    by_ends = 1.5 * (n_new - 1) / (n_pixels - 1)
    print(f"{n_pixels} -> {n_new} pixels: sigma {sigma:.3f} (twice 1.5 is 3), by the outermost pixels {by_ends:.3f}")
    assert abs(sigma - by_ends) < 0.02
    seen[n_new] = round(float(sigma), 2)
assert seen == {23: 3.29, 51: 3.12, 103: 3.06, 203: 3.03}, seen
PYTHON
