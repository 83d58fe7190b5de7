#!/usr/bin/env bash
# LePhare's settings for COSMOS as its package carries them: models of galaxies without any dust.
#
# Seen with lephare 1.0.0:
#   - `default_cosmos_config` names four attenuation laws (EXTINC_LAW) and ten values of E(B-V) (EB_V), but the range of
#     templates that laws are applied to is MOD_EXTINC "0,0"; templates count from 1, so that `prepare` makes models with
#     E(B-V) of 0 alone, after a line about a wrong number of arguments among others;
#   - with a range for each of the four laws ("1,1,1,1,1,1,1,1") the same template has 37 models at a redshift.
# A good guess would be that settings which list laws and amounts of dust, and are named after a survey whose published
# redshifts have dust, make models with it: redshifts of dusty galaxies are then fitted with none.
# Templates, bandpasses, laws and reference stars are made here. Prints what is seen, and fails if that changes.
set -euo pipefail
folder="$(mktemp -d)"
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q "lephare==1.0.0" numpy
export LEPHAREDIR="$folder/data" LEPHAREWORK="$folder/work"
cd "$folder"
cat >data.py <<'PYTHON'
import os
from pathlib import Path

import numpy as np

data = Path(os.environ["LEPHAREDIR"])
for name in ("vega", "opa", "ext", "sed/GAL/GRAY", "sed/GAL/BETHERMIN12", "filt"):
    (data / name).mkdir(parents=True)
for name in ("filt", "lib_bin", "lib_mag", "zphota"):
    (Path(os.environ["LEPHAREWORK"]) / name).mkdir(parents=True)


def write(path, x, y):
    np.savetxt(data / path, np.transpose([x, y]), fmt="%.6e")


# one spectrum for the galaxy and the stars that magnitudes refer to
wave = np.geomspace(100.0, 1e6, 2000)
light = (5500.0 / wave) ** 2
for name in ("VegaLCB", "SunLCB", "BD+17", "BD+17o4708"):
    write(f"vega/{name}.sed", wave, 1e-9 * light)
write("sed/GAL/GRAY/gray.sed", wave, light)
(data / "sed/GAL/GRAY/gray.list").write_text("GRAY/gray.sed\n")
# a list that is opened in any case
(data / "sed/GAL/BETHERMIN12/BETHERMIN12_MOD.list").write_text("GRAY/gray.sed\n")
# no absorption between the galaxies
names = []
for k in range(81):
    names.append(f"{0.1 * k:.1f} open{k}.dat\n")
    path = data / f"opa/open{k}.dat"
    np.savetxt(path, np.transpose([np.arange(1300.0), np.ones(1300)]), fmt="%.6e")
(data / "opa/OPACITY.dat").write_text("".join(names))
x = np.geomspace(500.0, 2e5, 400)
for name in ("SMC_prevot", "SB_calzetti", "SB_calzetti_bump1", "SB_calzetti_bump2", "MW_seaton", "calzetti"):
    write(f"ext/{name}.dat", x, 4.0 * 5500.0 / x)
for name, low, high in (("blue", 4000.0, 5000.0), ("red", 7000.0, 8000.0)):
    x = np.linspace(low, high, 50)
    write(f"filt/{name}.dat", x, ((x > low) & (x < high)).astype(float))
PYTHON
cat >library.py <<'PYTHON'
import sys

import lephare

config = lephare.default_cosmos_config.copy()
config.update(
    {
        "FILTER_LIST": "blue.dat,red.dat",
        "FILTER_CALIB": "0,0",
        "GAL_SED": "sed/GAL/GRAY/gray.list",
        "Z_STEP": "0.5,0.,1.",
        "EM_LINES": "NO",
        "LIB_ASCII": "YES",
    }
)
if len(sys.argv) > 1:
    config["MOD_EXTINC"] = sys.argv[1]
lephare.prepare(config, star_config=None, qso_config=None)
PYTHON
"$folder/venv/bin/python" data.py
"$folder/venv/bin/python" library.py >default.log 2>&1
grep -v '^#' work/lib_mag/CE_COSMOS.dat >default.dat
"$folder/venv/bin/python" library.py 1,1,1,1,1,1,1,1 >ranges.log 2>&1
grep -v '^#' work/lib_mag/CE_COSMOS.dat >ranges.dat
"$folder/venv/bin/python" - <<'PYTHON'
import numpy as np

import lephare

config = lephare.default_cosmos_config
laws = config["EXTINC_LAW"].split(",")
amounts = [float(value) for value in config["EB_V"].split(",")]
print(f"settings: {len(laws)} laws, E(B-V) {amounts}, MOD_EXTINC {config['MOD_EXTINC']!r}")
assert len(laws) == 4
assert max(amounts) == 0.5
reddening = {}
for name in ("default", "ranges"):
    rows = np.loadtxt(f"{name}.dat", ndmin=2)
    reddening[name] = rows[:, 2]
    print(f"{name}: {len(rows)} models at three redshifts, E(B-V) up to {rows[:, 2].max()}")
# the rows of one template without dust at three redshifts
assert len(reddening["default"]) == 3
assert reddening["default"].max() == 0.0
# nine amounts of dust by four laws, and none
assert len(reddening["ranges"]) == 3 * (9 * 4 + 1)
assert reddening["ranges"].max() == 0.5
PYTHON
