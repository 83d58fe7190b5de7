"""
Resume a stopped or killed run
==============================

A run was stopped with Ctrl-C, killed by the queue, or lost its machine. You want to go on where it was, or to do
only a part of it again.
"""

# %%
# Give the same command again. Finished steps are recognized by the checksums of what they read and made:
#
# .. code-block:: console
#
#    $ miricigale run goodss --quick -o study
#    ^C
#    $ miricigale run goodss --quick -o study
#
# In this small example the run is stopped after the catalog, and then goes on to the truth.

import json
import time
from pathlib import Path

import matplotlib.pyplot as plt
from astropy.table import QTable

from miricigale.workflow import load_config, run_study

overrides = {"catalog": {"mag_limit": 22.5}}
config = load_config("goodss", quick=True, overrides=overrides)
seconds = {}


def run(label, until):
    start = time.perf_counter()
    run_study(config, "study", until=until)
    seconds[label] = time.perf_counter() - start


run("to the catalog", "catalog")
run("resumed, to the truth", "truth")
run("nothing left to do", "truth")

# %%
# A product that was lost or damaged is made again, and nothing that depends on it. Its bytes are the same once the
# kernels are compiled (``miricigale compile``); a process that compiles them may differ by 1e-13.

Path("study/agn00/truth.ecsv").unlink()
run("lost product", "truth")

# %%
# The time of each call, and what the run has recorded:

ax = plt.subplots(figsize=(7, 2.8), layout="constrained")[1]
ax.barh(list(seconds), list(seconds.values()))
ax.invert_yaxis()
ax.set_xlabel("seconds")
plt.show()

# %%

steps = json.loads(Path("study/manifest.json").read_text())["stages"]
numbers = [len(step["products"]) for step in steps.values()]
QTable({"step": list(steps), "products": numbers})

# %%
# Parts of a run, by stage or unit (``*`` stands for anything):
#
# .. code-block:: console
#
#    $ miricigale run goodss --quick -o study --until mosaics
#    $ miricigale run goodss --quick -o study --from 'photometry:agn00/*'
#
# With another configuration the run stops and says what would be done again; ``--redo`` does it. A run whose
# machine died may leave a lock; the message says which file to remove. See :doc:`/method/workflow`.
