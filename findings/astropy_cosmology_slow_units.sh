#!/usr/bin/env bash
# Once astropy.cosmology is imported, to ask whether a unit is of another kind takes some 80 times as long everywhere.
#
# Seen with astropy 8.0.2 and numpy 2.4.0: the import adds an equivalency, of redshifts, to the registry of units of the
# process. `u.Jy.is_equivalent(u.K)` takes 1.4 us before it and 120 us after it, with no equivalency in the call; each
# attempt makes a unit and words an error that is thrown away. Units of the same kind are as quick as before.
# A good guess would be that an import of functions of distance changes nothing in other modules. Code that asks of what
# kind a quantity is, such as a reader of columns, pays for it whoever made the import. To compare
# `unit.physical_type` does not.
# Prints what is seen, and fails if that changes.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "astropy==8.0.2" "numpy==2.4.0"
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import timeit

import astropy.units as u
from astropy.units.core import get_current_unit_registry


def microseconds(function):
    return min(timeit.repeat(function, number=500, repeat=5)) / 500 * 1e6


def times():
    return {
        "Jy is K": microseconds(lambda: u.Jy.is_equivalent(u.K)),
        "Jy is uJy": microseconds(lambda: u.Jy.is_equivalent(u.uJy)),
        "type of Jy is that of K": microseconds(lambda: u.Jy.physical_type == u.K.physical_type),
    }


def n_equivalencies():
    return len(get_current_unit_registry().equivalencies)


before, n_before = times(), n_equivalencies()
import astropy.cosmology  # noqa: E402, F401

after, n_after = times(), n_equivalencies()
print(f"equivalencies of the process: {n_before} before, {n_after} after the import")
for name, value in before.items():
    print(f"{name}: {value:.2f} us before, {after[name]:.2f} us after")
ratios = {name: after[name] / before[name] for name in before}
assert (n_before, n_after) == (0, 1)
assert ratios["Jy is K"] > 10
assert ratios["Jy is uJy"] < 3
assert ratios["type of Jy is that of K"] < 3
PYTHON
