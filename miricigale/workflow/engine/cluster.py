"""Units of stages on the workers of dask.distributed."""

import contextlib
from concurrent.futures import CancelledError

from miricigale.utils.exceptions import DataError
from miricigale.utils.optional import require


def _version():
    from miricigale import __version__

    return __version__


@contextlib.contextmanager
def cluster_executor(address):
    """
    Executor of the workers of a dask.distributed scheduler.

    A unit whose worker dies is done again on another one, as often as the scheduler allows
    (``distributed.scheduler.allowed-failures``, 3 by default).

    Parameters
    ----------
    address : str
        Of the scheduler, such as ``"tcp://host:8786"``.

    Yields
    ------
    executor : `concurrent.futures.Executor`
        Does functions on the workers, which must see the folder of the run by the same path.
    n_threads : int
        Threads of all workers.
    memory : float
        GB of all workers; 0 if they do not say.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If there is no such scheduler, it has no workers or of another version of the package, or, in
        the ``with`` block, workers died over a unit or the scheduler was lost.
    ImportError
        If dask.distributed is not installed.
    """
    distributed = require("distributed", extra="dask")
    try:
        client = distributed.Client(address, timeout=10)
    except (OSError, ValueError) as err:
        msg = f"there is no dask scheduler at {address!r}: {err}"
        raise DataError(msg) from err
    with client:
        n_threads = sum(client.nthreads().values())
        if not n_threads:
            msg = f"the scheduler at {address} has no workers; start some with 'dask worker {address}'"
            raise DataError(msg)
        others = {v for v in client.run(_version).values() if v != _version()}
        if others:
            msg = f"workers of {address} have version {sorted(others)} of the package, here is {_version()}"
            raise DataError(msg)
        workers = client.scheduler_info()["workers"].values()
        memory = sum(worker["memory_limit"] for worker in workers) / 1e9
        try:
            yield client.get_executor(pure=False), n_threads, memory
        except distributed.scheduler.KilledWorker as err:
            msg = (
                f"{err.allowed_failures + 1} workers of {address} died over one unit, the last on "
                f"{err.last_worker.address}; was there too little memory? What is finished stands: "
                "the same command resumes it"
            )
            raise DataError(msg) from err
        except CancelledError as err:
            msg = f"the scheduler at {address} was lost; what is finished stands: the same command resumes it"
            raise DataError(msg) from err
