#!/usr/bin/env bash
# The same tree, written by asdf in several processes: the files differ.
#
# Seen with asdf 6.0.0, asdf-astropy 0.11.0 and astropy 8.0.2:
#   - the history of a file lists the extensions that were used in the order of a set of objects, which changes from
#     process to process, with the same PYTHONHASHSEED too;
#   - nothing else differs: the lists hold the same extensions.
# A good guess would be that asdf, which keeps the order of keys, writes the same bytes for the same tree. Checksums of
# files that hold ASDF, such as JWST's _cal.fits, do not tell whether their content is the same.
# Prints what is seen, and fails if that changes.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "asdf==6.0.0" "asdf-astropy==0.11.0" "astropy==8.0.2"
cd "$folder"
cat >write.py <<'PYTHON'
import sys

import asdf
import astropy.units as u
from astropy.coordinates import ICRS
from astropy.modeling.models import Shift

asdf.AsdfFile({"unit": u.m, "frame": ICRS(), "model": Shift(1.0)}).write_to(sys.argv[1])
PYTHON
for k in 0 1 2 3 4 5 6 7; do
    PYTHONHASHSEED=0 "$folder/venv/bin/python" write.py "file$k.asdf"
done
"$folder/venv/bin/python" - <<'PYTHON'
from pathlib import Path

import asdf

paths = sorted(Path().glob("file*.asdf"))
lists = []
for path in paths:
    with asdf.open(path) as file:
        extensions = file.tree["history"]["extensions"]
        lists.append([entry.get("extension_uri") or entry["extension_class"] for entry in extensions])
contents = {path.read_bytes() for path in paths}
alike = all(sorted(one) == sorted(lists[0]) for one in lists)
print(f"{len(paths)} processes wrote the same tree as {len(contents)} different files")
print(f"the same extensions are listed: {alike}")
assert len(contents) > 1
assert alike
PYTHON
