"""Tasks that need each other, side by side within the threads and the memory of each machine."""

import collections
import heapq
import logging
import queue
import time
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, Future
from typing import NamedTuple

from miricigale.utils.exceptions import DataError
from miricigale.utils.values import value_class

log = logging.getLogger(__name__)

#: Workers that may die over one task.
_DEATHS = 4


@value_class
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


class Place(NamedTuple):
    """
    Where tasks are done: the processes of this machine, or a worker of a cluster.

    Parameters
    ----------
    submit : callable
        As that of an executor.
    slots : int
        Tasks that may be done there side by side.
    n_threads : int
        Threads of the machine, for a task alone.
    memory : float
        Bytes that these may take together.
    """

    submit: Callable
    slots: int
    n_threads: int
    memory: float


def local_place(executor, n_threads, memory):
    """
    Tell where tasks are done on this machine.

    Parameters
    ----------
    executor : `concurrent.futures.Executor` or None
        Does up to ``n_threads`` tasks side by side; one by one in this thread without it.
    n_threads : int
        Threads of all tasks together.
    memory : float
        Bytes that tasks side by side may take.

    Returns
    -------
    places : dict of str to `Place`
        One.
    """
    if executor is None:
        return {"here": Place(_Inline().submit, 1, n_threads, memory)}
    return {"here": Place(executor.submit, n_threads, n_threads, memory)}


class _Queue:
    """Tasks in their order; one is ready when all groups that it needs are complete."""

    def __init__(self, tasks):
        self._tasks = tasks
        self._unfinished = collections.Counter(task.group for task in tasks)
        self._missing = []
        self._waiting = collections.defaultdict(list)
        # by memory: there are few amounts and many tasks
        self._ready = collections.defaultdict(list)
        self.n_ready = 0
        for k, task in enumerate(tasks):
            groups = [group for group in task.needs if group in self._unfinished]
            self._missing.append(len(groups))
            for group in groups:
                self._waiting[group].append(k)
            if not groups:
                self._add(k)

    def _add(self, k):
        heapq.heappush(self._ready[self._tasks[k].memory], k)
        self.n_ready += 1

    def put_back(self, task):
        """Let a task that was taken begin once more."""
        self._add(self._tasks.index(task))

    def take(self, memory):
        """Return the first task that needs no more memory, or None."""
        fitting = [m for m, waiting in self._ready.items() if waiting and m <= memory]
        if not fitting:
            return None
        self.n_ready -= 1
        amount = min(fitting, key=lambda m: self._ready[m][0])
        return self._tasks[heapq.heappop(self._ready[amount])]

    def complete(self, task):
        """Note that a task is done."""
        self._unfinished[task.group] -= 1
        if not self._unfinished[task.group]:
            for k in self._waiting.pop(task.group, ()):
                self._missing[k] -= 1
                if not self._missing[k]:
                    self._add(k)


def run_tasks(tasks, *, places, n_threads, wait_for=None, report=None):
    """
    Do tasks, each when what it needs is complete.

    Parameters
    ----------
    tasks : iterable of `Task`
        In the order in which they begin, as far as they can.
    places : callable
        Gives the places as they are now, a dict of str to `Place`. A task begins where most memory is left; one
        that is larger than the memory of all places, alone where there is most. What runs at a place that
        is there no more is begun again.
    n_threads : int
        Threads of all tasks together.
    wait_for : float, optional
        Seconds after which places are asked for again; not while tasks run if not given.
    report : callable, optional
        Called with the titles of what runs, whenever that changes.

    Raises
    ------
    Exception
        The first that a task raised, after what ran beside it has been finished.
    `~miricigale.utils.exceptions.DataError`
        If a process of an executor died, or four places were lost over one task.
    """
    run = _Run(_Queue(list(tasks)), n_threads, wait_for, report)
    while True:
        machines = places()
        run.take_back_lost(machines)
        task, place = run.next_task(machines)
        if task is not None:
            run.begin(task, place, machines)
        elif run.running:
            run.finish_next()
        elif run.error is not None:
            raise run.error
        elif run.waiting.n_ready:
            log.warning("there are no workers any more: waiting for some")
            while not places():
                time.sleep(wait_for)
        else:
            return


class _Run:
    """Tasks that wait, and those that run: ``running`` has the task of each future, and the name of its place."""

    def __init__(self, waiting, n_threads, wait_for, report):
        self.waiting = waiting
        self.running = {}
        #: the first that a task raised; nothing begins after it
        self.error = None
        self._n_threads = n_threads
        self._wait_for = wait_for
        self._report = report
        # concurrent.futures.wait holds locks of all futures, and keeps them if it is interrupted
        self._done = queue.SimpleQueue()
        self._deaths = collections.Counter()

    def take_back_lost(self, machines):
        """Let tasks wait again that ran at places which are there no more."""
        for future, (task, place) in list(self.running.items()):
            if place in machines or future.done():
                continue
            future.cancel()
            del self.running[future]
            self._deaths[task] += 1
            if self._deaths[task] == _DEATHS:
                msg = (
                    f"{_DEATHS} workers died over {task.title}, the last at {place}; was there too little "
                    "memory? What is finished stands: the same command resumes it"
                )
                raise DataError(msg)
            log.warning("%s is lost; %s is done again by another worker", place, task.title)
            self.waiting.put_back(task)

    def next_task(self, machines):
        """Take the task that begins now and the name of its place; None and None if none does."""
        if self.error is not None or len(self.running) >= self._n_threads:
            return None, None
        place, memory = _roomiest(machines, self.running.values())
        return self.waiting.take(memory), place

    def begin(self, task, place, machines):
        """Begin a task, with its share of the threads."""
        slots = min(self._n_threads, sum(machine.slots for machine in machines.values()))
        together = min(slots, len(self.running) + self.waiting.n_ready + 1)
        n_threads = min(machines[place].n_threads, max(1, self._n_threads // together))
        try:
            future = task.begin(machines[place].submit, n_threads)
        except BrokenExecutor as err:
            raise _died(task) from err
        if future is None:
            self.waiting.complete(task)
            return
        self.running[future] = task, place
        future.add_done_callback(self._done.put)
        if self._report is not None:
            self._report([begun.title for begun, _ in self.running.values()])

    def finish_next(self):
        """Wait for a task to end, but no longer than until places are to be asked for again."""
        try:
            future = self._done.get(timeout=self._wait_for)
        except queue.Empty:
            return
        if future not in self.running:
            # of a place that was lost
            return
        task, _ = self.running.pop(future)
        failure = future.exception()
        if isinstance(failure, BrokenExecutor):
            raise _died(task) from failure
        if failure is not None:
            self.error = self.error or failure
            return
        task.finish(future.result())
        self.waiting.complete(task)


def _roomiest(places, running):
    """Return the place with most memory left, and how much; none (-1) where no slot is free."""
    memory = collections.Counter()
    n_tasks = collections.Counter()
    for task, name in running:
        memory[name] += task.memory
        n_tasks[name] += 1
    unused = {}
    for name, place in places.items():
        if n_tasks[name] < place.slots:
            unused[name] = place.memory - memory[name]
    if not unused:
        return None, -1
    name = max(unused, key=unused.get)
    largest = max(place.memory for place in places.values())
    if unused[name] == largest and not n_tasks[name]:
        # what fits nowhere is done alone
        return name, float("inf")
    return name, unused[name]


def _died(task):
    return DataError(f"a process ended during {task.title}; was there too little memory?")
