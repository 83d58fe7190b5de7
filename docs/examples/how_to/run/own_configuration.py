"""
Run a study of your own
=======================

You want a study with your bands, exposures or catalog in place of a preset. You write a configuration file
(TOML), edit it, and run it.
"""

# %%
# On the command line:
#
# .. code-block:: console
#
#    $ miricigale run goodss --print-config > my.toml
#    $ miricigale run my.toml -o my-study
#
# In Python, a configuration is an object. Here is a very small one: one band, one dither, slopes in place of
# ramps, and bright galaxies only. An unknown key or a wrong value is an error that says what is allowed.

from pathlib import Path

import matplotlib.pyplot as plt

from miricigale.instrument import read_image
from miricigale.workflow import disk_use, load_config, run_study

exposures = {"filters": ["miri.f770w"], "kind": "rates"}
exposures |= {"n_groups": [20], "n_dithers": [1]}
overrides = {
    "run": {"name": "my-study"},
    "catalog": {"mag_limit": 22.5},
    "exposures": exposures,
    "fit": {"min_detected": 1},
}
config = load_config("goodss", quick=True, overrides=overrides)
Path("my.toml").write_text(config.to_toml(), encoding="utf-8")
print("\n".join(config.to_toml().splitlines()[:8]))

# %%
# How much disk the whole study would take, in MB:

{name: round(size / 1e6, 1) for name, size in disk_use(config).items()}

# %%
# Run it. ``until`` stops after a stage; without it the study goes on to fits and the report.

run_study(load_config("my.toml"), "my-study", until="mosaics")
sorted(str(path) for path in Path("my-study").rglob("*.fits"))

# %%
# The mosaic of the first sky:

mosaic = read_image("my-study/agn00/mosaic_miri.f770w.fits")
mosaic.plot()
plt.show()

# %%
# See :doc:`/method/workflow` for configurations, :doc:`/method/workflow_truth` for what the keys do, and
# :doc:`/accuracy/running` for time and disk of real studies.
