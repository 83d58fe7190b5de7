"""
How many AGN `miricigale.agn.draw_shares` counts over those that there are, where each is measured with an error.

    python benchmarks/agn_shares.py [--surveys 30]

Each survey has objects in four bins of redshift, AGN with the fractions 0.1 to 0.95 in equal numbers or more of
the small or large ones, and fractions that are measured with normal errors, whose size has a log-normal scatter
of 0.7. The prior of the fits has 1.25 % in each of the fractions. Each line: objects, share of AGN, median error,
distribution of the fractions; the sum of the counted AGN (medians) with a fraction of 0.2 or more over the true
ones, with its error; the share of surveys whose 68 % interval of that number holds the truth, and the same of the
AGN of each bin of redshift, both by randomized ranks.
"""

import argparse

import numpy as np

from miricigale.agn import draw_shares

FRACTIONS = np.array([0.0, 0.1, 0.2, 0.4, 0.6, 0.8, 0.95])
PRIOR = np.array([0.925] + 6 * [0.0125])
#: Weights of the fractions above 0 in simulated surveys.
DISTRIBUTIONS = {
    "equal": np.ones(6),
    "faint": np.array([8.0, 4.0, 2.0, 1.0, 0.5, 0.25]),
    "bright": np.array([0.5, 0.5, 1.0, 2.0, 3.0, 3.0]),
}
N_Z = 4
#: Weight of each wrong bin of redshift over that of the right one.
WRONG_REDSHIFT = 0.02
#: First bin of the fraction that is counted.
FIRST = 2
#: Half-width of 68.27 % of uniform ranks.
HALF_OF_INTERVAL = 0.3413
#: Objects, share of AGN, median error of the fraction, distribution.
CASES = (
    (350, 0.08, 0.3, "equal"),
    (350, 0.08, 0.3, "faint"),
    (350, 0.08, 0.3, "bright"),
    (350, 0.08, 0.1, "equal"),
    (350, 0.25, 0.3, "equal"),
    (1400, 0.08, 0.3, "equal"),
)


def survey(n, share, error, distribution, seed):
    """Draws of the AGN in each bin of redshift of a simulated survey, and the true numbers."""
    rng = np.random.default_rng(seed)
    redshift = rng.integers(0, N_Z, n)
    has_agn = rng.random(n) < share
    weights = DISTRIBUTIONS[distribution]
    fraction = rng.choice(np.arange(1, FRACTIONS.size), n, p=weights / weights.sum())
    fraction = np.where(has_agn, fraction, 0)
    errors = error * np.exp(rng.normal(0.0, 0.7, n))
    data = FRACTIONS[fraction] + errors * rng.standard_normal(n)
    pull = (data[:, None] - FRACTIONS) / errors[:, None]
    weight = np.exp(-0.5 * pull**2) * PRIOR
    of_redshift = np.full((n, N_Z), WRONG_REDSHIFT)
    of_redshift[np.arange(n), redshift] = 1.0
    table = of_redshift[:, :, None, None] * weight[:, None, :, None]
    draws = draw_shares(table, PRIOR, n_draws=500, seed=seed)
    counted = draws.counts["galaxy"][:, :, FIRST:].sum(axis=(2, 3))
    return counted, np.bincount(redshift[fraction >= FIRST], minlength=N_Z)


def ranks(draws, true, rng):
    """Randomized ranks of true numbers, shape (...), among draws of them, (n_draws, ...)."""
    below = np.mean(draws < true, axis=0)
    equal = np.mean(draws == true, axis=0)
    return below + equal * rng.random(np.shape(true))


def score(case, n_surveys):
    """Print a line of the table."""
    rng = np.random.default_rng(1)
    medians = []
    numbers = []
    of_totals = []
    of_bins = []
    for seed in range(n_surveys):
        counted, true = survey(*case, seed)
        total = counted.sum(axis=1)
        medians.append(np.median(total))
        numbers.append(true.sum())
        of_totals.append(ranks(total, true.sum(), rng))
        of_bins.append(ranks(counted, true, rng))
    medians = np.array(medians)
    numbers = np.array(numbers)
    scatter = np.std(medians - numbers) * np.sqrt(n_surveys) / numbers.sum()
    in_total = np.mean(np.abs(np.array(of_totals) - 0.5) < HALF_OF_INTERVAL)
    in_bins = np.mean(np.abs(np.array(of_bins) - 0.5) < HALF_OF_INTERVAL)
    n, share, error, distribution = case
    print(
        f"{n:5d} {share:.2f} {error:.1f} {distribution:7s} "
        f"{medians.sum() / numbers.sum():.2f} +- {scatter:.2f}  "
        f"total {100 * in_total:3.0f} %, bins {100 * in_bins:3.0f} %",
        flush=True,
    )


def main():
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--surveys", type=int, default=30, help="simulated surveys a line")
    args = parser.parse_args()
    for case in CASES:
        score(case, args.surveys)


if __name__ == "__main__":
    main()
