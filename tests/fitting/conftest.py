"""Small random grids and a plain evaluation of everything, against which fits are held."""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from scipy.stats import norm

from miricigale.sed import ModelGrid


def make_grid(seed=0, *, n_z=4, n_tau=5, n_age=4, polar=(0.0, 0.1, 0.3), frac=None, n_b=6):
    """Smooth random spectra: galaxies and tori that overlap but can be told apart."""
    rng = np.random.default_rng(seed)
    redshift = np.linspace(0.2, 2.0, n_z) if n_z > 1 else np.array([0.7])
    tau, age = np.linspace(0.5, 3.0, n_tau), np.linspace(0.5, 9.0, n_age)
    taus, ages = (x.ravel() for x in np.meshgrid(tau, age, indexing="ij"))
    n_g = taus.size
    galaxy = 1e-9 * np.exp(rng.normal(0, 0.8, (n_z, n_g, n_b)))
    dust = 1e27 * rng.uniform(0.2, 2.0, n_g)
    dust[0] = 0.0
    frac = np.array([0.0, 0.2, 0.5, 0.9]) if frac is None else np.asarray(frac)
    temperatures = [100.0, 200.0]
    rows = [
        (t, e, temp)
        for t in (3.0, 7.0)
        for e in polar
        for temp in ([150.0] if e == 0.0 else temperatures)
    ]
    if frac.size == 1 and frac[0] == 0:
        rows = []
    n_a = len(rows)
    agn = 1e-36 * np.exp(rng.normal(0, 0.8, (n_z, n_a, n_b)))
    count = [2 if row[1] == 0.0 else 1 for row in rows]
    agn_parameters, agn_properties = QTable(), QTable()
    if rows:
        values = np.array(rows)
        agn_parameters["tau97"] = values[:, 0]
        agn_parameters["ebv_polar"] = values[:, 1] * u.mag
        agn_parameters["temperature_polar"] = values[:, 2] * u.K
        agn_properties["accretion_power"] = rng.uniform(1.0, 3.0, n_a)
        agn_properties["ir_luminosity"] = rng.uniform(0.5, 1.0, n_a)
    axes = {"tau97": [3.0, 7.0], "ebv_polar": list(polar), "temperature_polar": temperatures}
    return ModelGrid(
        filters=tuple(f"band{i}" for i in range(n_b)),
        redshift=redshift,
        galaxy=galaxy,
        agn=agn,
        dust_luminosity=dust,
        frac_agn=frac,
        allowed=ages[None, :] <= (12.0 / (1.0 + redshift))[:, None],
        galaxy_parameters=QTable({"tau": taus * u.Gyr, "age": ages * u.Gyr}),
        agn_parameters=agn_parameters,
        galaxy_properties=QTable(
            {
                "stellar_mass": rng.uniform(0.5, 0.9, n_g) * u.dimensionless_unscaled,
                "sfr": np.where(ages > 5, 0.0, rng.uniform(1e-10, 1e-9, n_g)) / u.yr,
                "ir_luminosity": dust * 1.1 * u.W / u.Msun,
            }
        ),
        agn_properties=agn_properties,
        agn_multiplicity=np.array(count, dtype=int),
        meta={"citations": ["nobody"]},
        axes=axes,
        inert=[("temperature_polar",) if row[1] == 0.0 else () for row in rows],
    )


def draw_photometry(grid, n, seed=1, *, noise=0.1, missing=0.0, mass=(9.5, 11.0)):
    """Models of a grid with noise: table of photometry, true indices and masses."""
    rng = np.random.default_rng(seed)
    n_b = len(grid.filters)
    flux, err, truth = np.empty((n, n_b)), np.empty((n, n_b)), []
    for i in range(n):
        z = rng.integers(grid.redshift.size)
        g = rng.choice(np.flatnonzero(grid.allowed[z]))
        k, f = rng.integers(max(grid.n_agn, 1)), rng.integers(grid.frac_agn.size)
        s = 10.0 ** rng.uniform(*mass)
        model = s * grid.flux(z, g, k, f)
        err[i] = noise * np.median(model)
        flux[i] = model + err[i] * rng.normal(size=n_b)
        truth.append((z, g, k, f, s))
    flux[rng.random(flux.shape) < missing] = np.nan
    table = QTable({"id": np.arange(n)})
    for j, name in enumerate(grid.filters):
        table[name] = flux[:, j] * u.uJy
        table[f"{name}_err"] = err[:, j] * u.uJy
    table["redshift"] = [grid.redshift[t[0]] for t in truth]
    return table, truth


def _limited(p, q, unit, level):
    """
    Scales that minimise chi2 with upper limits, by bisection; their variance and the terms.

    ``unit`` is the model flux over the limits' sigma, shape (..., n), ``level`` the limit over it.
    """

    def slope(s):
        u = s[..., None] * unit - level
        return q * s - p + (np.exp(norm.logpdf(u) - norm.logsf(u)) * unit).sum(-1)

    low, high = np.zeros(p.shape), np.maximum(p, 0.0) / q
    for _ in range(120):
        middle = 0.5 * (low + high)
        above = slope(middle) > 0
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    s = np.where(slope(np.zeros(p.shape)) >= 0, 0.0, high)
    u = s[..., None] * unit - level
    hazard = np.exp(norm.logpdf(u) - norm.logsf(u))
    variance = 1.0 / (q + (hazard * (hazard - u) * unit**2).sum(-1))
    return s, variance, -2.0 * norm.logsf(u).sum(-1)


def brute_force(fitter, flux, sigma, log_prior=None, limit=None):
    """
    Posterior of one object by arrays over all models, with nothing left out.

    ``limit`` says which bands are upper limits; ``flux`` and ``sigma`` hold them.
    """
    grid, priors = fitter.grid, fitter.priors
    quantities = fitter.backend.quantities
    limit = np.zeros(flux.size, bool) if limit is None else np.asarray(limit)
    use = np.isfinite(sigma) & ~limit
    w = np.where(use, 1.0 / np.square(sigma), 0.0)
    level = flux[limit] / sigma[limit]
    flux = np.where(use, flux, 0.0)
    f = grid.frac_agn
    x = (f / (1.0 - f))[None, :] * grid.dust_luminosity[:, None]
    agn, prior_agn = grid.agn, priors.agn
    if grid.n_agn == 0:
        agn, prior_agn = np.zeros((grid.redshift.size, 1, flux.size)), np.ones(1)
    model = grid.galaxy[:, :, None, None, :] + x[None, :, None, :, None] * agn[:, None, :, None, :]
    p, q = (model * w * flux).sum(-1), (model * model * w).sum(-1)
    s, variance, terms = _limited(p, q, model[..., limit] / sigma[limit], level)
    chi2 = (w * (flux - s[..., None] * model) ** 2).sum(-1) + terms
    prior = (
        (priors.redshift if log_prior is None else np.exp(log_prior))[:, None, None, None]
        * (priors.galaxy / priors.galaxy.sum())[None, :, None, None]
        * (prior_agn / prior_agn.sum())[None, None, :, None]
        * priors.frac
        * grid.allowed[:, :, None, None]
    )
    like = prior * np.exp(-0.5 * (chi2 - chi2[prior > 0].min()))
    total = like.sum()
    like /= total
    # every quantity for unit scale; s has the variance 1 / q
    power = x[None, :, None, :]
    rows = [row[None, :, None, None] for row in quantities.galaxy_scale]
    rows += [power * row[None, None, :, None] for row in quantities.agn_scale]
    mixed = quantities.mixed_galaxy[None, :, None, None]
    if grid.n_agn:
        mixed = mixed + power * quantities.mixed_agn[None, None, :, None]
    unit = [np.broadcast_to(row, s.shape) for row in [*rows, mixed]]
    more = fitter.backend.engine.scale_error * variance
    mean = np.array([(like * s * row).sum() for row in unit])
    # about the means, so that narrow posteriors keep their digits
    std = [
        np.sqrt((like * ((s * row - m) ** 2 + more * row**2)).sum())
        for row, m in zip(unit, mean, strict=True)
    ]
    band = ((like * s)[..., None] * model).sum((0, 1, 2, 3))
    apart = (s[..., None] * model - band) ** 2 + more[..., None] * model**2
    values = [s * row for row in unit]
    if fitter.backend.fraction is not None:
        y = (
            (f / (1.0 - f))
            * fitter.backend.fraction.galaxy[:, None, None]
            * fitter.backend.fraction.agn[:, None]
        )
        values.append(np.broadcast_to(y / (1.0 + y), s.shape))
        mean = np.append(mean, (like * values[-1]).sum())
        std.append(np.sqrt((like * (values[-1] - mean[-1]) ** 2).sum()))
    return {
        "chi2": chi2[prior > 0].min(),
        "index": np.unravel_index(np.where(prior > 0, chi2, np.inf).argmin(), chi2.shape),
        "log_sum": np.log(total) - 0.5 * chi2[prior > 0].min(),
        "zf": like.sum((1, 2)),
        "galaxy": like.sum((0, 2, 3)),
        "agn": like.sum((0, 1, 3)),
        "mean": mean,
        "std": np.array(std),
        "band": band,
        "band_std": np.sqrt((like[..., None] * apart).sum((0, 1, 2, 3))),
        "scale": s,
        "values": values,
        "weights": like,
    }


@pytest.fixture(name="make_grid", scope="session")
def _make_grid():
    return make_grid


@pytest.fixture(name="draw_photometry", scope="session")
def _draw_photometry():
    return draw_photometry


@pytest.fixture(name="brute_force", scope="session")
def _brute_force():
    return brute_force


@pytest.fixture(scope="session")
def grid():
    return make_grid()


@pytest.fixture(scope="session")
def photometry(grid):
    return draw_photometry(grid, 12, missing=0.1)[0]
