"""Maps over pieces of work by whatever executor the caller brings."""

import contextlib
import functools
import itertools
import logging
import multiprocessing
import os
import pickle
import signal
import sys
import tempfile
import threading
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from pathlib import Path

import threadpoolctl

from miricigale.utils.exceptions import argument_error
from miricigale.utils.options import check_that
from miricigale.utils.progress import progress

#: Lets this thread set numbers of threads: one that did so keeps others from it since threadpoolctl 3.8.
_take_over = getattr(threadpoolctl.OpenBLASController, "clear_controlling_thread", lambda **_: None)

#: Most runs of items that threads are handed: a future for each of thousands of items costs as much as small ones.
_MAX_RUNS = 128

#: Functions whose pickle is longer (bytes) go to other processes once, not with every piece.
_HEAVY = 100_000


def available_memory():
    """
    Bytes of memory of the machine, or of the container that this process runs in.

    Returns
    -------
    n_bytes : int
        4 GB where the system does not say.
    """
    try:
        total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return 4_000_000_000
    try:
        limit = Path("/sys/fs/cgroup/memory.max").read_text().strip()
    except OSError:
        return total
    if limit.isdigit():
        return min(total, int(limit))
    return total


def check_memory(n_bytes, purpose, *, advice):
    """
    Refuse what does not fit into the memory, before it is begun.

    Parameters
    ----------
    n_bytes : int
        What would be allocated.
    purpose : str
        What it is, for the message.
    advice : str
        What can be done instead.

    Raises
    ------
    MemoryError
        If it is more than nine tenths of the memory (`available_memory`).
    """
    limit = 0.9 * available_memory()
    if n_bytes > limit:
        available = f"{limit / 1e9:.3g} GB can be had"
        msg = f"{purpose} would take {n_bytes / 1e9:.3g} GB of memory, and {available}: {advice}"
        raise MemoryError(msg)


@contextlib.contextmanager
def process_pool(n_processes):
    """
    Processes that end with this one, whatever ends it.

    Parameters
    ----------
    n_processes : int
        How many.

    Yields
    ------
    executor : `concurrent.futures.ProcessPoolExecutor`
        Its processes are stopped at once when the ``with`` block is left by an exception such
        as `KeyboardInterrupt`.
    """
    level = logging.getLogger().getEffectiveLevel()
    before = set(multiprocessing.active_children())
    # forks of a process with threads can hang
    context = multiprocessing.get_context("spawn")
    options = {"initializer": _end_with_parent, "initargs": (level,)}
    executor = ProcessPoolExecutor(n_processes, mp_context=context, **options)
    try:
        yield executor
    except BaseException:
        for process in set(multiprocessing.active_children()) - before:
            process.terminate()
        raise
    finally:
        executor.shutdown(cancel_futures=True)


def _end_with_parent(level):
    """
    Begin a process of `multiprocessing`: it leaves interrupts to its parent, and ends with it.

    Parameters
    ----------
    level : int
        Level of the messages that it writes to stderr.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    logging.basicConfig(level=level, format="%(message)s")
    parent = multiprocessing.parent_process()

    def end():
        parent.join()
        os._exit(1)

    threading.Thread(target=end, daemon=True).start()


def parallel_map(function, items, *, executor=None, progress_bar=False, desc=None):
    """
    Apply ``function`` to each item, in order, serially or on an executor.

    Parameters
    ----------
    function : callable
        Called with one item; must be picklable for process executors. One that carries much
        data (a model grid) is not sent with every item: a process pool reads it from a
        temporary file once for each process, workers of dask keep it.
    items : iterable
        The pieces of work.
    executor : `concurrent.futures.Executor`, optional
        Any executor (threads, processes, dask's ``client.get_executor()``); serial if
        not given. The answer is the same either way.
    progress_bar : bool, optional
        Whether a progress bar is shown.
    desc : str, optional
        Label of the bar.

    Returns
    -------
    results : list
        In the order of ``items``.

    Raises
    ------
    ValueError
        If ``executor`` has no ``submit``.
    """
    items = list(items)
    if executor is None:
        return [function(item) for item in progress(items, show=progress_bar, desc=desc)]
    check_that(hasattr(executor, "submit"), "executor", "a concurrent.futures.Executor", executor)
    if isinstance(executor, ThreadPoolExecutor) and len(items) > _MAX_RUNS and not progress_bar:
        runs = [items[run] for run in chunks(len(items), -(-len(items) // _MAX_RUNS))]
        results = parallel_map(functools.partial(_apply, function), runs, executor=executor)
        return list(itertools.chain.from_iterable(results))
    with _sent_once(function, executor) as call:
        futures = [executor.submit(*call, item) for item in items]
        try:
            return [f.result() for f in progress(futures, show=progress_bar, desc=desc)]
        except BaseException:
            for future in futures:
                future.cancel()
            raise


def _apply(function, items):
    """Apply a function to each of some items."""
    return [function(item) for item in items]


@contextlib.contextmanager
def _sent_once(function, executor):
    """What to submit before the item, so that a heavy function travels once."""
    # dask's executor has no public way to its client
    client = getattr(executor, "_client", None)
    if not hasattr(client, "register_plugin"):
        client = None
    if client is None and not isinstance(executor, ProcessPoolExecutor):
        yield (function,)
        return
    try:
        data = pickle.dumps(function, protocol=pickle.HIGHEST_PROTOCOL)
    except (pickle.PicklingError, AttributeError, TypeError):
        # the executor may have better means, or says what is wrong
        data = b""
    if len(data) <= _HEAVY:
        yield (function,)
    elif client is not None:
        # optional
        from miricigale.utils.dask_workers import call_kept, kept_by_workers

        with kept_by_workers(client, function) as name:
            yield call_kept, name
    else:
        handle, name = tempfile.mkstemp(prefix="miricigale-", suffix=".pickle")
        try:
            with os.fdopen(handle, "wb") as stream:
                stream.write(data)
            del data
            yield (_call_from_file, name)
        finally:
            Path(name).unlink(missing_ok=True)


def _call_from_file(path, item):
    """Call a function that every process reads from a file when it needs it first."""
    return _unpickled(path)(item)


@functools.lru_cache(maxsize=1)  # what the caller made is not ours to freeze
def _unpickled(path):
    # a pickle can run any code; this one is of the process that asks for the work, which wrote it to a
    # temporary file that its user alone can read and write (mkstemp), and nothing else is read here
    with open(path, "rb") as stream:
        return pickle.load(stream)


def thread_count(n_threads=None):
    """
    Check a number of threads.

    Parameters
    ----------
    n_threads : int, optional
        What was asked for; the number of processors of this process if not given.

    Returns
    -------
    n_threads : int

    Raises
    ------
    ValueError
        If it is no integer of at least 1.
    """
    if n_threads is None:
        if hasattr(os, "sched_getaffinity"):
            return len(os.sched_getaffinity(0))
        return os.cpu_count() or 1
    if n_threads < 1 or int(n_threads) != n_threads:
        raise argument_error("n_threads", "at least 1 and an integer", n_threads)
    return int(n_threads)


@contextlib.contextmanager
def threads(n_threads=None):
    """
    Threads for kernels and transforms that release the interpreter lock.

    They are not waited for when the ``with`` block is left by an exception.

    Parameters
    ----------
    n_threads : int, optional
        As for `thread_count`.

    Yields
    ------
    executor : `concurrent.futures.ThreadPoolExecutor` or None
        None, for `parallel_map` to work serially, where it is one thread.
    """
    n_threads = thread_count(n_threads)
    if n_threads == 1:
        yield None
        return
    executor = ThreadPoolExecutor(n_threads)
    try:
        yield executor
    except BaseException:
        executor.shutdown(wait=False, cancel_futures=True)
        raise
    executor.shutdown()


class _SingleThreaded:
    """Limits all threads of this process: from the first that enters to the last that leaves."""

    def __init__(self):
        self._lock = threading.Lock()
        self._users = 0
        self._limits = []
        self._pools = None
        self._known = 0

    def __enter__(self):
        with self._lock:
            self._users += 1
            # libraries may have been loaded since; looking for them takes milliseconds
            if self._known != len(sys.modules):
                self._pools = threadpoolctl.ThreadpoolController()
                self._known = len(sys.modules)
            if any(pool["num_threads"] > 1 for pool in self._pools.info()):
                _take_over(force=True)
                self._limits.append(self._pools.limit(limits=1))

    def __exit__(self, *exc):
        with self._lock:
            self._users -= 1
            while self._limits and not self._users:
                _take_over(force=True)
                self._limits.pop().restore_original_limits()


_single_threaded = _SingleThreaded()


def single_threaded():
    """
    Context in which linear algebra runs on one core, in all threads of this process.

    Sums that are cut into other pieces differ in the last digit, and samplers would then go
    other ways. On many small matrices the threads of the linear algebra moreover wait for each
    other longer than they work.
    """
    return _single_threaded


def chunks(n, size):
    """Yield slices of at most ``size`` that cover ``range(n)``; the cut depends on n and size only."""
    for start in range(0, n, size):
        yield slice(start, min(n, start + size))
