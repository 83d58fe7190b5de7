"""Nested samplers for continuous parameters: their arguments, what they return, and how to find one by name."""

import threading
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np

from miricigale.utils.optional_packages import require
from miricigale.utils.options import check_names
from miricigale.utils.parallel import chunks
from miricigale.utils.values import value_class

#: What to cite for them.
CITATIONS = {
    "nautilus": ("Lange 2023, MNRAS 525, 3181 (nautilus)",),
    "dynesty": ("Speagle 2020, MNRAS 493, 3132 (dynesty)",),
}
#: Models evaluated together: enough for the flux tables to run at full speed.
_BATCH = 128
#: Walkers that go side by side, so that their models are evaluated together.
_QUEUE = 64


@value_class
class Draws:
    """
    Weighted draws from a posterior.

    Parameters
    ----------
    call : `~numpy.ndarray` of int, shape (n,)
        Which evaluation of the likelihood each draw is, counted from 0 in the order of the calls.
    log_weight : `~numpy.ndarray`, shape (n,)
        Natural logarithm of the weights, whatever their sum.
    log_evidence, log_evidence_err : float
        ln of the evidence and its 1-sigma error as the sampler sees it.
    converged : bool
        Whether the sampler finished before ``max_calls``.
    """

    call: np.ndarray
    log_weight: np.ndarray
    log_evidence: float
    log_evidence_err: float
    converged: bool

    @property
    def weight(self):
        """Weights that sum to 1."""
        weight = np.exp(self.log_weight - self.log_weight.max())
        return weight / weight.sum()


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


def _sample_dynesty(package, log_like, n_dim, rng, request):
    """Sample the unit cube; see `get_sampler`."""
    # of few walkers each step depends on the last; too many waste what they find
    options = {"sample": "rwalk", "queue_size": min(_QUEUE, max(request.n_live // 4, 1))}
    options |= request.options
    run = {"dlogz": options.pop("dlogz", 0.01)}
    lockstep = Lockstep(log_like, options["queue_size"])
    sampler = package.NestedSampler(
        lockstep.evaluate,
        np.asarray,
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
        self._asked = {}
        self._answers = {}
        self._running = 0

    def map(self, function, items):
        """Call ``function`` with each item; list of results in order."""
        items = list(items)
        out = []
        with ThreadPoolExecutor(self.size) as threads:
            for rows in chunks(len(items), self.size):
                part = items[rows]
                self._asked = {}
                self._answers = {}
                self._running = len(part)
                run = partial(self._run, function)
                out += list(threads.map(run, range(len(part)), part))
        return out

    def evaluate(self, point):
        """Return ln(likelihood) of one point, and the number of the call."""
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


#: Samplers by name, to be given their package first.
SAMPLERS = {"nautilus": _sample_nautilus, "dynesty": _sample_dynesty}


def get_sampler(engine):
    """
    Find a sampler by its name.

    Parameters
    ----------
    engine : str or callable
        One of `SAMPLERS`, or a function that does what those do: called as
        ``sample(log_like, n_dim, rng, request)`` with

        - ``log_like(points)``: ln(likelihood), shape (m,), of points of the unit cube, shape
          (m, n_dim), in which the prior is flat, and the numbers of these calls, shape (m,);
        - ``rng``: the `~numpy.random.Generator` that everything random is drawn from;
        - ``request``: the `~miricigale.fitting.SamplerSettings`,

        it returns `Draws`.

    Returns
    -------
    sample : callable

    Raises
    ------
    KeyError
        If there is none of this name.
    ImportError
        If its package is not installed; the message holds the pip command.
    """
    if callable(engine):
        return engine
    check_names([engine], "engine", SAMPLERS)
    return partial(SAMPLERS[engine], require(engine, extra="samplers"))
