"""
Find a filter by the name you know
==================================

You have names of bands from a catalog, from the SVO, from CIGALE or EAZY. You want to know which filter each is,
its wavelength and its width.
"""

# %%
# ``Filter`` and every function that asks for bands take names in any usual form.

import matplotlib.pyplot as plt
from astropy.table import Table

from miricigale import Filter
from miricigale.filters import FilterSet, cigale_band, filter_table, find_filter

names = [
    "F770W",
    "JWST/MIRI.F1000W",
    "jwst.nircam.F200W",
    "wfc3_ir_f160w",
    "ACS_F814W",
    "IRAC 3.6",
    "spitzer.mips.24",
    "SDSS r",
    "VISTA_Ks",
]
rows = []
for name in names:
    found = Filter(name)
    pivot, width = found.pivot.round(3), found.width.round(3)
    rows.append((name, found.name, cigale_band(found.name), pivot, width))
Table(rows=rows, names=["given", "here", "CIGALE", "pivot", "width"])

# %%
# ``find_filter`` gives the name alone, or ``None`` where there is no such curve. An unknown name is an error
# that lists the nearest ones.

print(find_filter("HST/WFC3_IR.F140W"), find_filter("no such band"))
try:
    Filter("F707W")
except KeyError as error:
    print(error)

# %%
# ``filter_table`` lists the library, all of it or the names that hold a text.

filter_table("nircam")

# %%
# A pattern selects several. The curves, from NIRCam to MIRI:

fig, axes = plt.subplots(2, 1, figsize=(8, 5), layout="constrained")
for ax, pattern in zip(axes, ("nircam.f*w", "miri.*"), strict=True):
    FilterSet([pattern]).plot(ax)
    ax.set(ylim=(0, 1.6))
    ax.legend(ncol=5, fontsize="x-small", loc="upper center")
plt.show()

# %%
# On the command line ``miricigale filters nircam`` prints the same table. Columns of a catalog are renamed by
# the same rules: see ``as_photometry`` and ``read_catalog_photometry`` in :doc:`/method/filters`, and
# :doc:`own_filter` for curves that the library lacks.
