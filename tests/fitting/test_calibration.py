"""Objects drawn from the prior: posteriors must be right on average."""

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.fitting import BayesFitter


def _draw(grid, n, rng):
    """Draw models with equal weights and a flat prior in total signal to noise."""
    z_all, g_all = np.nonzero(grid.allowed)
    rows = rng.integers(z_all.size, size=n)
    k_weight = grid.agn_multiplicity / grid.agn_multiplicity.sum()
    z, g = z_all[rows], g_all[rows]
    k = rng.choice(grid.n_agn, n, p=k_weight)
    f = rng.integers(grid.frac_agn.size, size=n)
    model = grid.flux(z, g, k, f)
    sigma = np.array([0.1, 0.1, 0.2, 0.15, 0.1, 0.3])
    total = rng.uniform(5.0, 60.0, n)
    s = total / np.sqrt(np.sum((model / sigma) ** 2, axis=1))
    flux = s[:, None] * model + sigma * rng.normal(size=model.shape)
    table = QTable({"id": np.arange(n)})
    for j, name in enumerate(grid.filters):
        table[name] = flux[:, j] * u.uJy
        table[f"{name}_err"] = np.full(n, sigma[j]) * u.uJy
    return table, z, g, k, f, s


def test_ranks_are_uniform_and_intervals_cover(make_grid):
    n = 3000
    grid = make_grid(11, n_z=8, n_tau=6, n_age=4, frac=np.append(np.arange(5) * 0.2, 0.95))
    rng = np.random.default_rng(4)
    table, z, _g, _k, f, s = _draw(grid, n, rng)
    results = BayesFitter(grid, model_error=0.0).fit(table)
    assert results.fitted.all()
    for name, node in (("redshift", z), ("frac_agn", f)):
        pdf = results.pdf[name]
        total = np.cumsum(pdf, axis=1)
        at = np.take_along_axis(total, node[:, None], axis=1)[:, 0]
        own = np.take_along_axis(pdf, node[:, None], axis=1)[:, 0]
        rank = at - own * rng.random(n)
        counts = np.histogram(rank, bins=10, range=(0, 1))[0]
        chi2 = np.sum((counts - n / 10) ** 2 / (n / 10))
        # 9 degrees of freedom: 27.9 has a probability of 0.001
        assert chi2 < 27.9, (name, counts)
        cover = np.mean((rank > 0.16) & (rank < 0.84))
        assert abs(cover - 0.68) < 0.03, name
    low, high = results.percentile("mass", [0.16, 0.84]).value.T
    cover = np.mean((s > low) & (s < high))
    assert abs(cover - 0.68) < 0.03
