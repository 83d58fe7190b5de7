#!/usr/bin/env bash
# Every other pixel of an image in astropy has coordinates that are half a pixel off.
#
# Seen with astropy 8.0.2: of ccd[::2, ::2] and ccd[::3, ::3], with ccd a CCDData with a WCS, the first pixel is the first
# pixel of the image, but the WCS puts it half a pixel, and one pixel, of the image further along both axes. The
# slice of the WCS is that of an image whose pixels were summed in blocks of 2 x 2 and 3 x 3 (block_reduce), where it is
# right; slices with a step of 1 are right too. A good guess would be that data and WCS of one slice belong together. No
# warning is given. Prints what is seen, and fails if that changes.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "astropy==8.0.2"
"$folder/venv/bin/python" - <<'PYTHON'
import numpy as np
from astropy.nddata import CCDData
from astropy.wcs import WCS

wcs = WCS(naxis=2)
wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
wcs.wcs.crval = [150.0, 2.0]
wcs.wcs.crpix = [30.0, 30.0]
wcs.wcs.cdelt = [-1e-5, 1e-5]
# each pixel holds its number
data = np.arange(60.0)[:, None] * 60.0 + np.arange(60.0)
image = CCDData(data, unit="adu", wcs=wcs)

seen = {}
for step in (1, 2, 3):
    part = image[::step, ::step]
    # the pixel of the image whose value the slice has at (4, 5), and the one where its WCS puts it
    y, x = divmod(part.data[5, 4], 60.0)
    stated = wcs.world_to_pixel(part.wcs.pixel_to_world(4, 5))
    seen[step] = [float(round(float(stated[0]) - x, 3)), float(round(float(stated[1]) - y, 3))]
    print(f"step {step}: the WCS of the slice is off by {seen[step]} pixels of the image")
assert seen == {1: [0.0, 0.0], 2: [0.5, 0.5], 3: [1.0, 1.0]}, seen
PYTHON
