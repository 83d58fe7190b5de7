"""
How many AGN `miricigale.agn.draw_shares` counts over those that there are, by the weight of its Dirichlet prior.

    python benchmarks/agn_shares.py [--surveys 30]

Each survey has objects in four bins of redshift, AGN with equal shares of the fractions 0.1 to 0.95, and fractions
that are measured with normal errors, whose size has a log-normal scatter of 0.7. The prior of the fits has 1.25 %
in each of the fractions. Each line: objects, share of AGN, median error, pseudo-objects in each bin of redshift,
and the sum of the counted AGN (medians) with a fraction of 0.2 or more over the true ones, with its error.
"""

import argparse

import numpy as np

from miricigale.agn import draw_shares, shares

FRACTIONS = np.array([0.0, 0.1, 0.2, 0.4, 0.6, 0.8, 0.95])
PRIOR = np.array([0.925] + 6 * [0.0125])
N_Z = 4
#: Weight of each wrong bin of redshift over that of the right one.
WRONG_REDSHIFT = 0.02
#: First bin of the fraction that is counted.
FIRST = 2


def survey(n, share, error, seed):
    """Counted and true AGN of a simulated survey."""
    rng = np.random.default_rng(seed)
    redshift = rng.integers(0, N_Z, n)
    has_agn = rng.random(n) < share
    fraction = np.where(has_agn, rng.integers(1, FRACTIONS.size, n), 0)
    errors = error * np.exp(rng.normal(0.0, 0.7, n))
    data = FRACTIONS[fraction] + errors * rng.standard_normal(n)
    pull = (data[:, None] - FRACTIONS) / errors[:, None]
    weight = np.exp(-0.5 * pull**2) * PRIOR
    of_redshift = np.full((n, N_Z), WRONG_REDSHIFT)
    of_redshift[np.arange(n), redshift] = 1.0
    table = of_redshift[:, :, None, None] * weight[:, None, :, None]
    draws = draw_shares(table, PRIOR, n_draws=300, seed=seed)
    counted = np.median(draws.counts["galaxy"][:, :, FIRST:].sum(axis=(1, 2, 3)))
    return counted, np.sum(fraction >= FIRST)


def main():
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--surveys", type=int, default=30, help="simulated surveys a line")
    args = parser.parse_args()
    for n, share, error in (
        (350, 0.08, 0.3),
        (350, 0.08, 0.1),
        (350, 0.25, 0.3),
        (1400, 0.08, 0.3),
    ):
        for pseudo in (1.0, 0.5, 0.25):
            shares.CONCENTRATION = pseudo
            numbers = [survey(n, share, error, seed) for seed in range(args.surveys)]
            counted, true = np.array(numbers).T
            scatter = np.std(counted - true) * np.sqrt(args.surveys)
            print(
                f"{n:5d} {share:.2f} {error:.1f} {pseudo:.2f}  "
                f"{counted.sum() / true.sum():.2f} +- {scatter / true.sum():.2f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
