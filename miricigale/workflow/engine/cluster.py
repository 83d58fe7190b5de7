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
    Executor of the workers of a dask.distributed scheduler.

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
        what = f"has no workers; start some with 'dask worker {address}'"
        check_data(client.nthreads(), f"the scheduler at {address}", what)

        # functions made here go to others as they are, where this module may be missing
        def version():
            try:
                from miricigale import __version__
            except ImportError:
                return "none"
            return __version__

        found = {client.run_on_scheduler(version), *client.run(version).values()}
        if found != {version()}:
            versions = ", ".join(sorted(found))
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
        self._client, self._memory = client, memory
        self._places, self._asked = {}, -self.wait_for

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
                return {
                    w.address: (w.nthreads, w.memory_limit) for w in dask_scheduler.workers.values()
                }

            try:
                found = self._client.run_on_scheduler(workers)
            except OSError as err:
                raise CancelledError from err
            self._places = {
                address: Place(self._submit(address), n_threads, n_threads, self._bytes(limit))
                for address, (n_threads, limit) in found.items()
            }
            self._asked = time.monotonic()
        return self._places

    def _bytes(self, limit):
        # workers without a limit say 0
        return self._memory * 1e9 if self._memory else 0.5 * limit or float("inf")

    def _submit(self, address):
        # there and nowhere else: of workers that it may choose dask knows only those that there are now
        return self._client.get_executor(pure=False, workers=[address]).submit
