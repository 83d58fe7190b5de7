"""
Cite what you used
==================

You write a paper with results of the package. You want the references of the models, tables and instrument data
that went into them.
"""

# %%
# Without a file, ``miricigale cite`` prints the reference of the package. With a product it prints what that
# product used:
#
# .. code-block:: console
#
#    $ miricigale cite
#    $ miricigale cite fits.ecsv

import matplotlib.pyplot as plt

from miricigale import BayesFitter, ErrorModel, SEDModel
from miricigale.cli import main
from miricigale.refdata import citations, resource

status = main(["cite"])

# %%
# A fit as an example. Its table keeps the references of the components of the model:

errors = ErrorModel.yang2021()
model = SEDModel.yang2021()
source = {"id": [1], "redshift": [1.2], "frac_agn": [0.3], "mass": [3e10]}
light = model.fluxes(source, list(errors.filters))
photometry = errors.perturb(light["id", *errors.filters], seed=1)
axes = SEDModel.yang2021_axes("quick")
results = BayesFitter(model, list(errors.filters), axes=axes).fit(photometry)
results.to_table().write("fits.ecsv", overwrite=True)
status = main(["cite", "fits.ecsv"])

# %%
# The fit that would appear in your paper:

results[0].plot_sed()
plt.show()

# %%
# One table of reference data, with its license:

one = resource("dust.dl07")
print(one.citation)
print(one.licence)

# %%
# References of several tables, each once:

citations("dust.dl07", "igm.inoue2014")

# %%
# ``miricigale data list`` has the licenses and references of all tables. See :doc:`/cite` and
# :doc:`/method/data`.
