"""Nested samplers for continuous parameters: what one is given, what it returns, and which there are."""

from dataclasses import dataclass

import numpy as np

from miricigale.utils.exceptions import unknown_name
from miricigale.utils.units import check_count

__all__ = [
    "CITATIONS",
    "SAMPLERS",
    "Draws",
    "Request",
    "effective_size",
    "get_sampler",
]

#: Samplers by name; those of other packages are in the module ``packages``, by the same names.
SAMPLERS = ("nautilus", "dynesty")

#: What to cite for them.
CITATIONS = {
    "nautilus": ("Lange 2023, MNRAS 525, 3181 (nautilus)",),
    "dynesty": ("Speagle 2020, MNRAS 493, 3132 (dynesty)",),
}


@dataclass(frozen=True)
class Request:
    """
    Settings of a sampler.

    Parameters
    ----------
    n_live : int
        Number of live points.
    n_effective : int
        Effective size that the sample shall have, if the sampler can go on until it has.
    max_calls : int
        Number of evaluated models after which the sampler stops, finished or not.
    options : dict
        Passed on to the sampler.
    """

    n_live: int
    n_effective: int
    max_calls: int
    options: dict

    def __post_init__(self):
        for name, least in (("n_live", 10), ("n_effective", 1), ("max_calls", 1)):
            check_count(getattr(self, name), name, least)


@dataclass(frozen=True, eq=False)
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


def effective_size(weight):
    """Kish's effective size of a weighted sample, (sum w)^2 / sum w^2."""
    return float(np.sum(weight) ** 2 / np.sum(np.square(weight)))


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
        - ``request``: a `Request`,

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
    if engine not in SAMPLERS:
        raise unknown_name("engine", engine, SAMPLERS)
    from miricigale.fitting.samplers import packages

    return getattr(packages, engine)()
