#!/usr/bin/env bash
# Weighted quantiles of corner and dynesty leave out the weight of the largest sample.
#
# Seen with corner 2.3.0, dynesty 3.1.0 and numpy 2.4.0:
#   - of the values 1, 2 and 3 with weights 1, 1 and 98 the median is 2; of the same 100 samples without weights it is 3;
#   - AGN fractions 0, 0.1 ... 1 of a grid, with probability 0.3 at 0 and 0.7 at 1: the median is 0.05, the 84 % limit
#     0.084, and so are the numbers above the panels of a corner plot with weights.
# The cumulative sum of weights is divided by its last value but one. With thousands of samples of similar weight this is
# not seen; a good guess would be that it holds for the nodes of a grid too. `numpy.quantile` is right.
# Prints what is seen, and fails if that changes.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "corner==2.3.0" "dynesty==3.1.0" "numpy==2.4.0"
cd "$folder"
MPLBACKEND=agg "$folder/venv/bin/python" - <<'PYTHON'
import warnings

import corner
import numpy as np
from dynesty.utils import quantile

warnings.simplefilter("error")
values = np.array([1.0, 2.0, 3.0])
weights = np.array([1.0, 1.0, 98.0])
repeated = np.repeat(values, weights.astype(int))
medians = {
    "corner, 100 samples": float(corner.quantile(repeated, [0.5])[0]),
    "corner, weights": float(corner.quantile(values, [0.5], weights=weights)[0]),
    "dynesty, weights": float(quantile(values, [0.5], weights=weights)[0]),
    "numpy, weights": float(np.quantile(values, 0.5, weights=weights, method="inverted_cdf")),
}
for name, median in medians.items():
    print(f"median, {name}: {median}")
assert list(medians.values()) == [3.0, 2.0, 2.0, 3.0]

fractions = np.linspace(0.0, 1.0, 11)
probability = np.zeros(11)
probability[0] = 0.3
probability[10] = 0.7
levels = [0.16, 0.5, 0.84]
limits = [round(float(x), 3) for x in corner.quantile(fractions, levels, weights=probability)]
truth = np.quantile(fractions, levels, weights=probability, method="inverted_cdf").tolist()
print(f"AGN fraction, 16, 50 and 84 %: corner {limits}, numpy {truth}")
assert limits == [0.016, 0.05, 0.084]
assert truth == [0.0, 1.0, 1.0]
figure = corner.corner(
    fractions[:, np.newaxis],
    weights=probability,
    show_titles=True,
    title_fmt=".3f",
    range=[(-0.1, 1.1)],
)
title = figure.axes[0].get_title()
print(f"title of the corner plot: {title}")
assert "0.050" in title
PYTHON
