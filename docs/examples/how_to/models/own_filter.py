"""
Use your own filter
===================

You have a filter curve that the library lacks: an array, a table, a text file, or one downloaded from the SVO.
You want fluxes of spectra in that band, and to use it in models and fits like any other.
"""

# %%
# A filter needs an array of wavelengths with a unit, and an array of throughputs that count photons. Flux columns
# get the name of the filter.

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
from astropy.table import QTable

from miricigale import SEDModel
from miricigale.filters import Filter, FilterSet

wave = np.linspace(8.4, 9.6, 60) * u.um
curve = np.exp(-(((wave - 9.0 * u.um) / (0.25 * u.um)) ** 4))
narrow = Filter(wave, curve, "mine.f900n", meta={"source": "a proposal"})
narrow

# %%
# The suffix of a file decides how it is read. Tables (ECSV, FITS, and VOTable as the SVO offers it) have units. A
# text file must name the unit of the wavelengths in a comment, or you give it by ``unit``.

table = QTable({"wave": wave.to(u.AA), "throughput": curve})
table.write("narrow.ecsv", overwrite=True)
with open("wide.txt", "w") as file:
    file.write("# wavelength in um, throughput\n")
    for x, t in [(11.0, 0), (11.4, 0.6), (12.8, 0.7), (14.2, 0.5), (14.8, 0)]:
        file.write(f"{x} {t}\n")

from_table = Filter.read("narrow.ecsv")
wide = Filter.read("wide.txt", name="mine.f1290x", unit=u.um)
FilterSet([from_table, wide]).to_table()

# %%
# Your own filters and filters of the library go into one set, which every function that takes bands accepts.

bands = FilterSet(["F770W", narrow, "F1000W", wide, "F1500W"])
model = SEDModel.yang2021(libraries="bundled")
sed = model(redshift=0.16, age=1.0, ebv=0.4, mass=1e10)

fig, ax = plt.subplots(figsize=(8, 4))
sed.plot(ax, color="0.4", lw=1)
ax.plot(bands.pivots, sed.fluxes(bands), "o", color="black")
twin = ax.twinx()
bands.plot(twin, ls="--", lw=1.2)
twin.set_ylim(0, 3)
ax.set(xlim=(5, 20), xscale="linear", ylim=(100, 2e4))
ax.set_title("Two custom filters among those of MIRI")
plt.show()

# %%
# Names of the library are understood in any usual form, the SVO's among them (:doc:`find_band`). A band of synphot
# comes by ``Filter.from_synphot``. The path of a file can be given in place of a name:
# ``sed.synthetic_flux("narrow.ecsv")``. Conventions (photon counting, AB means, how curves end) are in
# :doc:`/method/filters`.
