"""Units of stages on the workers of dask.distributed."""

import contextlib
import time
from concurrent.futures import CancelledError

from miricigale.utils.exceptions import DataError
from miricigale.utils.optional_packages import require
from miricigale.utils.options import check_data
from miricigale.workflow.engine.schedule import Place


@contextlib.contextmanager
def cluster_executor(address, *, memory=None):
    """
    Return the executor of the workers of a dask.distributed scheduler.

    A unit whose worker dies is done again on another one, three times.

    Parameters
    ----------
    address : str
        Of the scheduler, such as ``"tcp://host:8786"``.
    memory : float, optional
        GB of units side by side on one worker; half of what it has if not given, for what units take
        is estimated.

    Yields
    ------
    cluster : `Cluster`
        Its workers, which must see the folder of the run by the same path.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If there is no such scheduler, it has no workers, it or they have no or another version of the package, or,
        in the ``with`` block, workers died over a unit or the scheduler was lost.
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
        reason = f"has no workers; start some with 'dask worker {address}'"
        check_data(client.nthreads(), f"the scheduler at {address}", reason)

        # functions made here go to others as they are, where this module may be missing
        def version():
            try:
                from miricigale import __version__
            except ImportError:
                return "none"
            return __version__

        versions = {client.run_on_scheduler(version), *client.run(version).values()}
        if versions != {version()}:
            versions = ", ".join(sorted(versions))
            msg = f"scheduler and workers at {address} have version {versions} of the package, here is {version()}"
            raise DataError(msg)
        try:
            yield Cluster(client, memory)
        except distributed.scheduler.KilledWorker as err:
            msg = (
                f"workers of {address} died over one unit: {err}; the same command resumes the rest"
            )
            raise DataError(msg) from err
        except CancelledError as err:
            msg = f"the scheduler at {address} was lost; what is finished stands: the same command resumes it"
            raise DataError(msg) from err


class Cluster:
    """
    The workers of a scheduler, each with its own threads and memory.

    Parameters
    ----------
    client : `distributed.Client`
        Of the scheduler.
    memory : float, optional
        As for `cluster_executor`.
    """

    #: Seconds after which the scheduler is asked again which workers there are.
    wait_for = 2.0

    def __init__(self, client, memory=None):
        self._client = client
        self._memory = memory
        self._places = {}
        self._asked = -self.wait_for

    def places(self):
        """
        Tell which workers there are: those that died are none, those that replace them are.

        Returns
        -------
        places : dict of str to `~miricigale.workflow.engine.schedule.Place`
            By address.
        """
        if time.monotonic() - self._asked > self.wait_for:

            def workers(dask_scheduler):
                n_threads = {}
                memory = {}
                for worker in dask_scheduler.workers.values():
                    n_threads[worker.address] = worker.nthreads
                    memory[worker.address] = worker.memory_limit
                return n_threads, memory

            try:
                n_threads, memory = self._client.run_on_scheduler(workers)
            except OSError as err:
                raise CancelledError from err
            self._places = {}
            for address, n in n_threads.items():
                submit = self._submit(address)
                self._places[address] = Place(submit, n, n, self._bytes(memory[address]))
            self._asked = time.monotonic()
        return self._places

    def _bytes(self, limit):
        """Return bytes that units on a worker may take, by the limit of its memory."""
        if self._memory:
            return self._memory * 1e9
        # workers without a limit say 0
        return 0.5 * limit or float("inf")

    def _submit(self, address):
        # there and nowhere else: of workers that it may choose dask knows only those that there are now
        return self._client.get_executor(pure=False, workers=[address]).submit
