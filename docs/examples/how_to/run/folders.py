"""
Set where caches and data are kept
==================================

Your home folder is small, or a group shares libraries of spectra. You want the data folder and the caches
elsewhere.
"""

# %%
# The defaults are below astropy's cache folder. Three settings change them:

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from miricigale import conf
from miricigale.refdata import cache_folder, check_resources, find_resource

for name in ("data_folder", "cache_folder", "grid_cache_size"):
    print(f"{name:16} {getattr(conf, name)!r}")

# %%
# For every session, write the file ``~/.astropy/config/miricigale.cfg``:
#
# .. code-block:: text
#
#    data_folder = /data/miricigale
#    cache_folder = /scratch/miricigale
#    grid_cache_size = 1000
#
# For one session or one block, use ``set_temp``:

with conf.set_temp("cache_folder", str(Path("scratch").absolute())):
    print(cache_folder().name)

# %%
# To share libraries, one person adds them (``miricigale data add``), and the others set ``MIRICIGALE_DATA``:
#
# .. code-block:: console
#
#    $ export MIRICIGALE_DATA=/data/group/miricigale
#    $ export NUMBA_CACHE_DIR=/scratch/numba
#    $ miricigale data check
#
# The second variable is for compiled kernels, if neither the package's folder nor your cache can be written. What
# is found where:

rows = [row for row in check_resources() if row.state == "ok"]
print(len(rows), "resources are whole;", find_resource("catalog.goodss").name)

# %%
# The bundled tables are small. Everything large is in the two folders above.

sizes = {row.name: find_resource(row.name).stat().st_size / 1e6 for row in rows}
names = sorted(sizes, key=sizes.get)[-8:]
ax = plt.subplots(figsize=(7, 3.5), layout="constrained")[1]
ax.barh(names, [sizes[name] for name in names])
ax.set_xlabel(f"MB (all together: {np.sum(list(sizes.values())):.0f} MB)")
plt.show()

# %%
# See :doc:`/method/data` for all settings, and :doc:`/install` for compiled kernels.
