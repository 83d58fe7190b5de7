#!/usr/bin/env bash
# sep fills masked pixels of an aperture with the mean of the others, and states the error of an aperture without a mask.
#
# Seen with sep 1.4.1 and numpy 2.3.5, circular apertures of radius 5 of which the left half is not to be used:
#   - mask=: the sum is scaled to the whole area (77.64 of an image of ones, as without a mask), while the error stays
#     8.81 for noise of 1, where sums of 3,600 apertures scatter by 11.2;
#   - segmap=, with the half in the segment of a neighbor: the sum is that of the other half, 43.72, and so is the error;
#   - an aperture that the edge of the image cuts in the same way: 43.72, too.
# A good guess would be that pixels that are not used are treated in one way, and that an aperture of half the pixels has
# a larger error once its sum is scaled. Flags say that there are masked pixels, 32. photutils leaves masked pixels out of
# sum and error. Prints what is seen, and fails if that changes.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "sep==1.4.1" "numpy==2.3.5"
"$folder/venv/bin/python" - <<'PYTHON'
import numpy as np
import sep

RADIUS = 5.0
x, y = (grid.ravel() for grid in np.meshgrid(*[30.0 * np.arange(60) + 20.0] * 2))
shape = (1810, 1810)
left_half = np.zeros(shape, bool)
for center in np.unique(x).astype(int):
    left_half[:, center - 10 : center] = True
segments = np.where(left_half, 9999, 0).astype(np.int32)
ids = np.arange(1, len(x) + 1, dtype=np.int32)
noise = np.random.default_rng(1).normal(0.0, 1.0, shape)
ones = np.ones(shape)

seen = {}
for name, options in {
    "whole": {},
    "mask": {"mask": left_half},
    "segmap": {"segmap": segments, "seg_id": ids},
}.items():
    area = sep.sum_circle(ones, x, y, RADIUS, **options)[0][0]
    sums, errors, flags = sep.sum_circle(noise, x, y, RADIUS, err=1.0, **options)
    seen[name] = [round(float(value), 2) for value in (area, errors[0], np.std(sums))]
    print(f"{name}: sum of ones {area:.2f}, error {errors[0]:.2f}, scatter {np.std(sums):.2f}, flag {flags[0]}")
edge = sep.sum_circle(ones, [0.0], [20.0], RADIUS)[0][0]
print(f"cut by the edge of the image: sum of ones {edge:.2f}")

assert seen["mask"][0] == seen["whole"][0], seen
assert seen["mask"][1] == seen["whole"][1], seen
assert seen["mask"][2] > 1.2 * seen["mask"][1], seen
assert seen["segmap"][0] < 0.6 * seen["whole"][0], seen
assert seen["segmap"][1] < 0.8 * seen["whole"][1], seen
assert round(float(edge), 2) == seen["segmap"][0], (edge, seen)
PYTHON
