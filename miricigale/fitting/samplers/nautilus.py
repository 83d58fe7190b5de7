"""The door to nautilus: importance nested sampling with neural networks (Lange 2023)."""

from functools import partial

import numpy as np

from miricigale.fitting.samplers import Draws
from miricigale.utils.optional import require

__all__ = ["load"]

#: Models evaluated together: enough for the flux tables to run at full speed.
_BATCH = 128


def load():
    """Import the package; return the sampler (see `get_sampler`)."""
    return partial(_sample, require("nautilus", extra="samplers"))


def _sample(nautilus, log_like, n_dim, rng, request):
    """Sample the unit cube; see `get_sampler`."""
    # one network finds bounds about as good as four, in a quarter of the time
    options = {"n_batch": _BATCH, "n_networks": 1} | request.options
    run = {name: options.pop(name) for name in ("f_live", "n_shell") if name in options}
    # explored points were chosen by what was found there, which biases them a little
    run["discard_exploration"] = options.pop("discard_exploration", True)
    sampler = nautilus.Sampler(
        np.asarray,
        lambda points: log_like(points[:, :n_dim]),
        # it knows no single dimension: a second one goes along that nothing depends on
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
