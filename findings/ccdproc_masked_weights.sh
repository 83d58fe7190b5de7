#!/usr/bin/env bash
# A weighted average of images in ccdproc is too faint where a pixel is masked or clipped.
#
# Seen with ccdproc 2.5.1, astropy 7.2.0 and numpy 2.4.0, four images that are 10 everywhere, one with a masked pixel:
#   - without weights the average is 10 there; with weights of 1 for each image, it is 7.5, and is not masked;
#   - eight such images, one with a cosmic ray that is clipped by `combine`: 10 without weights, 8.75 with weights of 1.
# The sum leaves out the masked pixel, the sum of the weights does not. The text of `average_combine` says that such pixels
# are not included, and a good guess would be that equal weights change nothing. Exposures that are weighted by their
# noise or time then lose a share of the light of each pixel with a cosmic ray. No warning is given.
# Prints what is seen, and fails if that changes.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "ccdproc==2.5.1" "astropy==7.2.0" "numpy==2.4.0"
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import warnings

import ccdproc
import numpy as np
from astropy.nddata import CCDData

warnings.simplefilter("error")


def images(n):
    """Return n images of 3 by 3 pixels of 10."""
    return [CCDData(np.full((3, 3), 10.0), unit="adu") for _ in range(n)]


seen = {}
masked = images(4)
masked[0].mask = np.zeros((3, 3), bool)
masked[0].mask[1, 1] = True
combiner = ccdproc.Combiner(masked)
seen["masked, no weights"] = combiner.average_combine()
combiner.weights = np.ones(4)
seen["masked, weights of 1"] = combiner.average_combine()

struck = images(8)
struck[0].data[1, 1] = 1000.0
clip = {"sigma_clip": True, "sigma_clip_low_thresh": 2, "sigma_clip_high_thresh": 2}
seen["clipped, no weights"] = ccdproc.combine(struck, method="average", **clip)
seen["clipped, weights of 1"] = ccdproc.combine(
    struck, method="average", weights=np.ones(8), **clip
)
values = []
for name, average in seen.items():
    values.append(float(average.data[1, 1]))
    print(f"{name}: {values[-1]} (masked: {bool(average.mask[1, 1])}), elsewhere {average.data[0, 0]}")
    assert average.data[0, 0] == 10.0
    assert not average.mask[1, 1]
assert values == [10.0, 7.5, 10.0, 8.75], values
PYTHON
