"""Maps over pieces of work by whatever executor the caller brings."""

from miricigale.utils.progress import progress

__all__ = ["chunks", "parallel_map"]


def parallel_map(function, items, *, executor=None, progress_bar=False, desc=None):
    """
    Apply ``function`` to each item, in order, serially or on an executor.

    Parameters
    ----------
    function : callable
        Called with one item; must be picklable for process executors.
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
    """
    items = list(items)
    if executor is None:
        return [function(item) for item in progress(items, show=progress_bar, desc=desc)]
    futures = [executor.submit(function, item) for item in items]
    try:
        return [f.result() for f in progress(futures, show=progress_bar, desc=desc)]
    except BaseException:
        for future in futures:
            future.cancel()
        raise


def chunks(n, size):
    """Yield slices of at most ``size`` that cover ``range(n)``; the cut depends on n and size only."""
    for start in range(0, n, size):
        yield slice(start, min(n, start + size))
