"""
Run on a cluster or many cores
==============================

You have several cores, or several machines with a shared disk. You want a study, or a fit of a large catalog, to
use them. The results do not depend on the number of workers.
"""

# %%
# Commands use all cores of the machine; ``--threads`` limits them. With a dask scheduler they use its workers
# (``pip install miricigale[dask]``):
#
# .. code-block:: console
#
#    $ miricigale run goodss --threads 4
#    $ dask scheduler --host 192.168.1.10 --dashboard-address 127.0.0.1:8787
#    $ dask worker tcp://192.168.1.10:8786 --nthreads 1
#    $ miricigale run goodss -o /shared/study --scheduler tcp://192.168.1.10:8786
#
# A plain ``dask scheduler`` listens on all network interfaces and runs what anyone sends who reaches it:
# ``--host`` binds it to the address of one network (``127.0.0.1`` for workers on the same machine).
#
# In Python you bring an executor. Fits run well in threads:

from concurrent.futures import ThreadPoolExecutor

import matplotlib.pyplot as plt
import numpy as np
from astropy.table import QTable

from miricigale import BayesFitter, ErrorModel, SEDModel

model, errors = SEDModel.yang2021(), ErrorModel.yang2021()
rng = np.random.default_rng(1)
n = 60
parameters = QTable({"id": np.arange(n), "redshift": rng.uniform(0.3, 3, n)})
parameters["frac_agn"] = rng.choice([0.0, 0.4], n)
parameters["mass"] = 3e10
light = model.fluxes(parameters, list(errors.filters))
photometry = errors.perturb(light["id", *errors.filters], seed=1)

fitter = BayesFitter(model, list(errors.filters), axes="yang2021-quick")
results = {}
for n_workers in (1, 2, 4):
    with ThreadPoolExecutor(n_workers) as executor:
        results[n_workers] = fitter.fit(photometry, executor=executor)

# %%
# The answers are the same, for any number of workers:

first = results[1].mean("frac_agn")
for n_workers, one in results.items():
    difference = np.max(np.abs(one.mean("frac_agn") - first))
    print(f"{n_workers} workers: largest difference {difference:g}")

ax = plt.subplots(figsize=(5.5, 5), layout="constrained")[1]
for n_workers, marker in {1: "o", 4: "x"}.items():
    z = results[n_workers].mean("redshift")
    label = f"{n_workers} workers"
    ax.plot(parameters["redshift"], z, marker, mfc="none", label=label)
ax.set(xlabel="true redshift", ylabel="redshift")
ax.legend()
plt.show()

# %%
# A study uses processes. Each of them imports your script, so that the call must stand under ``__main__``:
#
# .. code-block:: python
#
#    from miricigale.utils.parallel import process_pool
#    from miricigale.workflow import load_config, run_study
#
#    if __name__ == "__main__":
#        with process_pool(4) as executor:
#            run_study(load_config("goodss"), "study", executor=executor)
#
# Set ``[run] memory`` in the configuration (GB on each machine), or fewer threads, if memory is short.
#
# Under SLURM, workers are jobs. Start them from Python (``pip install dask-jobqueue``), keep that session open,
# and run the study with the address that it prints:
#
# .. code-block:: python
#
#    from dask_jobqueue import SLURMCluster
#
#    cluster = SLURMCluster(cores=1, memory="6GB", walltime="04:00:00")
#    cluster.scale(jobs=40)
#    print(cluster.scheduler_address)
#
# A survey of many pointings is done in patches of the sky (``[patches] size``), so that no unit needs more than 2
# GB. The preset ``cosmosweb`` is the MIRI imaging of COSMOS-Web, 152 visits in F770W; it needs your catalog. See
# what it takes first:
#
# .. code-block:: console
#
#    $ miricigale run cosmosweb --set catalog.source=cosmos.fits --plan
#    $ miricigale run cosmosweb --set catalog.source=cosmos.fits -o /shared/cosmos \
#        --scheduler tcp://host:8786
#
# Workers may come and go, such as at the end of their time. What a run says of trouble:
#
# ================================  ============================================================================
# message                           what to do
# ================================  ============================================================================
# ... is lost; ... is done again    nothing, another worker does the unit
# there are no workers any more     start some; the run waits for them
# 4 workers died over ...           it is short of memory: larger workers, or ``--nthreads 1``; then the same
#                                   command resumes
# the scheduler ... was lost        start it and its workers again; the same command resumes
# scheduler and workers ... have    install one version everywhere, also where the scheduler runs
# version ...
# ... is not on HOST: all workers   use a folder of a shared disk, by the same path on each machine
# must see the folder of the run
# ================================  ============================================================================
#
# :doc:`/accuracy/running` has times and memory, :doc:`/method/workflow` how units are done, and
# :doc:`/tutorials/large_catalogs` fits of catalogs that do not fit in memory.
