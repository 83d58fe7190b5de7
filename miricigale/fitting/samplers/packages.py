"""Interfaces to nautilus (Lange 2023, MNRAS 525, 3181) and dynesty (Speagle 2020, MNRAS 493, 3132)."""

import threading
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np

from miricigale.fitting.samplers import Draws
from miricigale.utils.optional import require

__all__ = ["Lockstep", "dynesty", "nautilus"]

#: Models evaluated together: enough for the flux tables to run at full speed.
_BATCH = 128
#: Walkers that go side by side, so that their models are evaluated together.
_QUEUE = 64


def nautilus():
    """Import the package; return the sampler (see `get_sampler`)."""
    return partial(_sample_nautilus, require("nautilus", extra="samplers"))


def _sample_nautilus(package, log_like, n_dim, rng, request):
    """Sample the unit cube; see `get_sampler`."""
    # one network finds bounds about as good as four, in a quarter of the time
    options = {"n_batch": _BATCH, "n_networks": 1} | request.options
    run = {name: options.pop(name) for name in ("f_live", "n_shell") if name in options}
    # explored points were chosen by what was found there, which biases them a little
    run["discard_exploration"] = options.pop("discard_exploration", True)
    sampler = package.Sampler(
        np.asarray,
        lambda points: log_like(points[:, :n_dim]),
        # nautilus needs two dimensions at least: the likelihood ignores the second
        n_dim=max(n_dim, 2),
        n_live=request.n_live,
        vectorized=True,
        seed=int(rng.integers(2**63)),
        **options,
    )
    converged = sampler.run(n_eff=request.n_effective, n_like_max=request.max_calls, **run)
    _, log_weight, _, call = sampler.posterior(return_blobs=True)
    return Draws(
        call=np.asarray(call).astype(np.int64),
        log_weight=log_weight,
        log_evidence=float(sampler.log_z),
        log_evidence_err=float(1.0 / np.sqrt(max(sampler.n_eff, 1.0))),
        converged=bool(converged),
    )


def dynesty():
    """Import the package; return the sampler (see `get_sampler`)."""
    return partial(_sample_dynesty, require("dynesty", extra="samplers"))


def _sample_dynesty(package, log_like, n_dim, rng, request):
    """Sample the unit cube; see `get_sampler`."""
    # of few walkers each step depends on the last; too many waste what they find
    options = {"sample": "rwalk", "queue_size": min(_QUEUE, max(request.n_live // 4, 1))}
    options |= request.options
    run = {"dlogz": options.pop("dlogz", 0.01)}
    lockstep = Lockstep(log_like, options["queue_size"])
    sampler = package.NestedSampler(
        lockstep.evaluate,
        _itself,
        n_dim,
        nlive=request.n_live,
        rstate=rng,
        pool=lockstep,
        use_pool={"prior_transform": False, "update_bound": False},
        blob=True,
        **options,
    )
    sampler.run_nested(maxcall=request.max_calls, print_progress=False, save_bounds=False, **run)
    results = sampler.results
    return Draws(
        call=np.asarray(results.blob).astype(np.int64).ravel(),
        log_weight=np.asarray(results.logwt),
        log_evidence=float(results.logz[-1]),
        log_evidence_err=float(results.logzerr[-1]),
        converged=int(np.sum(results.ncall)) < request.max_calls,
    )


def _itself(point):
    return point


class Lockstep:
    """
    A pool whose tasks ask for single likelihoods and are answered all at once.

    The walkers of a nested sampler evaluate one model after the other; a table of models costs
    little more than one. Each task runs in a thread and waits at its likelihood until every
    other task has asked for one too or ended. Which points are evaluated together, and in which
    order, depends on the tasks alone.

    Parameters
    ----------
    log_like : callable
        Points, shape (m, n_dim), to ln(likelihood) and number of the call, shapes (m,).
    size : int
        Tasks that run side by side.
    """

    def __init__(self, log_like, size):
        self.size = size
        self._log_like = log_like
        self._turn = threading.Condition()
        self._own = threading.local()
        self._asked, self._answers, self._running = {}, {}, 0

    def map(self, function, items):
        """Call ``function`` with each item; list of results in order."""
        items = list(items)
        out = []
        with ThreadPoolExecutor(self.size) as threads:
            for first in range(0, len(items), self.size):
                part = items[first : first + self.size]
                self._asked, self._answers, self._running = {}, {}, len(part)
                tasks = [
                    threads.submit(self._run, function, number, item)
                    for number, item in enumerate(part)
                ]
                out += [task.result() for task in tasks]
        return out

    def evaluate(self, point):
        """ln(likelihood) of one point, and the number of the call."""
        number = getattr(self._own, "number", None)
        if number is None:
            value, call = self._log_like(np.asarray(point)[None])
            return float(value[0]), np.asarray(call[0])
        with self._turn:
            self._asked[number] = np.array(point)
            self._answer()
            self._turn.wait_for(lambda: number in self._answers)
            answer = self._answers.pop(number)
        if isinstance(answer, Exception):
            raise answer
        return answer

    def _run(self, function, number, item):
        self._own.number = number
        try:
            return function(item)
        finally:
            self._own.number = None
            with self._turn:
                self._running -= 1
                self._answer()

    def _answer(self):
        """Evaluate all points that are waited for, once every running task waits or has ended."""
        if not self._asked or len(self._asked) < self._running:
            return
        numbers = sorted(self._asked)
        points = np.array([self._asked.pop(number) for number in numbers])
        try:
            values, calls = self._log_like(points)
            answers = list(zip(map(float, values), map(np.asarray, calls), strict=True))
        except Exception as err:  # raised again in the tasks that wait
            answers = [err] * len(numbers)
        self._answers.update(zip(numbers, answers, strict=True))
        self._turn.notify_all()
