"""Tasks that need each other, side by side within a number of threads and an amount of memory."""

import dataclasses
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, wait

from miricigale.utils.exceptions import DataError


@dataclasses.dataclass(frozen=True, eq=False)
class Task:
    """
    A piece of work.

    Parameters
    ----------
    group : str
        Tasks of a group are complete together.
    title : str
        What it does.
    begin : callable
        Called with ``submit`` of an executor and a number of threads when all that it needs is
        complete; gives a future, or None if there is nothing to do.
    finish : callable
        Called with what the future gives.
    needs : frozenset of str, optional
        Groups that must be complete before; those of which there is no task are.
    memory : int, optional
        Bytes that it takes.
    """

    group: str
    title: str
    begin: Callable
    finish: Callable
    needs: frozenset = frozenset()
    memory: int = 0


class _Inline(Executor):
    """Calls at once, in this thread."""

    def submit(self, function, *args, **kwargs):
        future = Future()
        try:
            future.set_result(function(*args, **kwargs))
        except Exception as err:
            future.set_exception(err)
        return future


def run_tasks(tasks, *, executor=None, n_threads=1, memory=float("inf"), report=None):
    """
    Do tasks, each when what it needs is complete.

    Parameters
    ----------
    tasks : iterable of `Task`
        In the order in which they begin, as far as they can.
    executor : `concurrent.futures.Executor`, optional
        Does up to ``n_threads`` of them side by side; one by one without it.
    n_threads : int, optional
        Threads of all tasks together.
    memory : float, optional
        Bytes that tasks side by side may take; a larger one is done alone.
    report : callable, optional
        Called with the titles of what runs, whenever that changes.

    Raises
    ------
    Exception
        The first that a task raised, after what ran beside it has been finished.
    `~miricigale.utils.exceptions.DataError`
        If a process of the executor died.
    """
    slots = n_threads if executor is not None else 1
    submit = (executor or _Inline()).submit
    waiting, running, error = list(tasks), {}, None
    while True:
        task = None
        if error is None and len(running) < slots:
            ready = _ready(waiting, running.values())
            task = _fitting(ready, running.values(), memory)
        if task is not None:
            waiting.remove(task)
            together = min(slots, len(running) + len(ready))
            try:
                future = task.begin(submit, n_threads // together)
            except BrokenExecutor as err:
                raise _died(task) from err
            if future is not None:
                running[future] = task
                if report is not None:
                    report([other.title for other in running.values()])
        elif running:
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                task = running.pop(future)
                failed = future.exception()
                if isinstance(failed, BrokenExecutor):
                    raise _died(task) from failed
                if failed is None:
                    task.finish(future.result())
                error = error or failed
        elif error is not None:
            raise error
        else:
            return


def _died(task):
    return DataError(f"a process ended during {task.title}; was there too little memory?")


def _ready(waiting, running):
    """Tasks whose needs are complete."""
    incomplete = {task.group for task in (*waiting, *running)}
    return [task for task in waiting if incomplete.isdisjoint(task.needs)]


def _fitting(ready, running, memory):
    """The first task that there is memory for."""
    left = memory - sum(task.memory for task in running)
    return next((task for task in ready if not running or task.memory <= left), None)
