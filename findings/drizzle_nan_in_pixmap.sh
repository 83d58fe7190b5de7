#!/usr/bin/env bash
# One NaN in the map of pixels of drizzle loses half of an image, or all of it, depending on where it stands.
#
# Seen with drizzle 3.0.0 and numpy 2.4.0, an image of 60 x 60 pixels drizzled onto its own grid:
#   - at most places a NaN costs its own pixel and the eight beside it, 3591 of 3600 are left;
#   - at (45, 45) 1770 are left, at (3, 3) none is.
# A good guess would be that the pixel alone is left out, or that an error is raised. No warning is given.
# Prints what is seen, and fails if that changes.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "drizzle==3.0.0" "numpy==2.4.0"
"$folder/venv/bin/python" - <<'PYTHON'
import warnings

import numpy as np
from drizzle.resample import Drizzle

warnings.simplefilter("error")
shape = (60, 60)
rows, columns = np.indices(shape, dtype=float)
ones = np.ones(shape, np.float32)
covered = {}
for place in (None, (30, 30), (45, 45), (3, 3)):
    pixmap = np.dstack([columns, rows])
    if place is not None:
        pixmap[place] = np.nan
    sink = Drizzle(kernel="square", out_shape=shape, disable_ctx=True)
    sink.add_image(ones, exptime=1.0, pixmap=pixmap, weight_map=ones)
    covered[place] = int(np.count_nonzero(sink.out_wht))
    print(f"NaN at {place}: {covered[place]} of {ones.size} pixels have light")
assert list(covered.values()) == [3600, 3591, 1770, 0]
PYTHON
