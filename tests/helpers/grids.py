"""Small random grids, and plain sums over all their models, which fits are held against."""

import itertools
from dataclasses import replace

import astropy.units as u
import numpy as np
from astropy.table import QTable
from numpy.testing import assert_allclose
from scipy.integrate import quad
from scipy.special import log_ndtr

from miricigale.fitting import BayesFitter, GridSettings
from miricigale.sed import ModelGrid


def make_grid(seed=0, *, n_z=4, n_tau=5, n_age=4, polar=(0.0, 0.1, 0.3), frac=None, n_b=6):
    """Smooth random spectra: galaxies and tori that overlap but can be distinguished."""
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


def photometry_table(names, flux, err, ids=None, **columns):
    """Photometry of fluxes and errors in uJy, shape (n, nb), or (nb,) of one object."""
    flux = np.atleast_2d(flux)
    err = np.broadcast_to(err, flux.shape)
    table = QTable({"id": np.arange(len(flux)) if ids is None else ids} | columns)
    for i, name in enumerate(names):
        table[name], table[f"{name}_err"] = flux[:, i] * u.uJy, err[:, i] * u.uJy
    return table


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
    table = photometry_table(grid.filters, flux, err)
    table["redshift"] = [grid.redshift[t[0]] for t in truth]
    return table, truth


def plain(column):
    """Values of a column, luminosities for a solar mass in W."""
    unit = getattr(column, "unit", None)
    if unit is not None and unit.is_equivalent(u.W / u.Msun):
        return column.to_value(u.W / u.Msun)
    return np.asarray(getattr(column, "value", column), float)


def cells(values, bounds):
    """Edges of cells from half way to half way, the outermost symmetric within the bounds."""
    middle = (values[1:] + values[:-1]) / 2
    first, last = 2 * values[0] - middle[0], 2 * values[-1] - middle[-1]
    return np.array([max(first, bounds[0]), *middle, min(last, bounds[1])])


def cell_integrals(values, nodes, density):
    """Integrals over the cells of redshifts of a density that is linear between its nodes."""
    edges = cells(values, (0.0, np.inf))
    options = {"args": (nodes, density), "points": nodes[1:-1]}
    return np.array([quad(np.interp, a, b, **options)[0] for a, b in itertools.pairwise(edges)])


def node_weights(values, prior):
    """Prior of the values of one parameter, which sums to 1; None is flat in them."""
    if prior is None:
        weights = np.ones(values.size)
    elif callable(prior) or isinstance(prior, str):
        # a density, in the cells from the first value to the last
        density = {"log": np.reciprocal}[prior] if isinstance(prior, str) else prior
        edges = cells(values, (values[0], values[-1]))
        weights = [quad(density, a, b)[0] for a, b in itertools.pairwise(edges)]
        weights = np.array(weights)
    else:
        weights = np.asarray(prior, float)
    return weights / weights.sum()


def free_parameters(grid, priors=None):
    """
    Parameters of galaxies and tori with several values.

    Yields name, kind, the prior of the values, the part of every model that has each value, shape
    (n_values, n_models), and on which models it has no effect: these stand for all its values, as
    their prior has them.
    """
    for kind, table in (("galaxy", grid.galaxy_parameters), ("agn", grid.agn_parameters)):
        for name in table.colnames:
            column = plain(table[name])
            inert = np.array([kind == "agn" and name in grid.inert[i] for i in range(len(table))])
            values = np.unique(grid.axes[name] if inert.any() else column)
            weights = node_weights(values, (priors or {}).get(name))
            share = np.where(inert, weights[:, None], column == values[:, None])
            if values.size > 1:
                yield name, kind, weights, share, inert


def model_priors(grid, priors=None, prior_f="grid"):
    """Weights of redshifts, galaxies, tori and fractions: products over their parameters."""
    priors = dict(priors or {})
    f = grid.frac_agn
    if prior_f == "uniform" and f.size > 1:
        priors.setdefault("frac_agn", np.diff(cells(f, (0.0, 1.0))))
    models = {"galaxy": np.ones(grid.n_galaxies), "agn": np.ones(1)}
    if grid.n_agn:
        models["agn"] = np.array(grid.agn_multiplicity, float)
    for _, kind, weights, share, inert in free_parameters(grid, priors):
        models[kind] *= np.where(inert, 1.0 / weights.size, weights @ share)
    return (
        node_weights(grid.redshift, priors.get("redshift")),
        models["galaxy"] / models["galaxy"].sum(),
        models["agn"] / models["agn"].sum(),
        node_weights(f, priors.get("frac_agn")),
    )


def derived_quantities(grid):
    """
    What the property tables give: by name the part for a solar mass and that for a W of the AGN.

    A column of both tables is a sum and two parts; without one there is the sum of dust luminosity
    and AGN power.
    """
    none_g, none_k = np.zeros(grid.n_galaxies), np.zeros(max(grid.n_agn, 1))
    galaxy = {n: plain(c) for n, c in grid.galaxy_properties.items()}
    agn = {n: plain(c) for n, c in grid.agn_properties.items()} if grid.n_agn else {}
    both = [name for name in galaxy if name in agn]
    found = {"mass": (np.ones(grid.n_galaxies), none_k)}
    for name, values in galaxy.items():
        found[f"{name}_galaxy" if name in both else name] = values, none_k
    for name, values in agn.items():
        found[f"{name}_agn" if name in both else name] = none_g, values
    if both:
        found[both[0]] = galaxy[both[0]], agn[both[0]]
    else:
        found["total_luminosity"] = grid.dust_luminosity, np.ones(max(grid.n_agn, 1))
    return found


def agn_power(grid):
    """Power of the AGN for each solar mass formed, W: shape (nG, nf)."""
    f = grid.frac_agn
    return f / (1.0 - f) * grid.dust_luminosity[:, None]


def other_fraction(grid):
    """
    AGN fraction in the definition that is not the grid's, shape (nG, nA, nf), with its name.

    Of the light at 3-1000 um, or of dust luminosity and AGN power; no name without the columns.
    """
    by_dust = grid.frac_agn_definition == "dust"
    name, of_galaxy, of_agn = (
        ("frac_agn_ir", "ir_luminosity", "ir_luminosity")
        if by_dust
        else ("frac_agn_dust", "dust_luminosity", "agn_power")
    )
    columns = grid.galaxy_properties.colnames, grid.agn_properties.colnames
    if not grid.n_agn or of_galaxy not in columns[0] or of_agn not in columns[1]:
        return None, None
    agn = agn_power(grid)[:, None, :] * plain(grid.agn_properties[of_agn])[:, None]
    whole = agn + plain(grid.galaxy_properties[of_galaxy])[:, None, None]
    return name, np.divide(agn, whole, out=np.zeros(agn.shape), where=whole > 0)


def limited_scales(p, q, unit, level):
    """
    Scales that minimize chi2 with upper limits, by bisection; their variance and the terms.

    ``unit`` is the model flux over the limits' sigma, shape (..., n), ``level`` the limit over it.
    """
    if not unit.shape[-1]:
        return np.maximum(p, 0.0) / q, 1.0 / q, 0.0

    def hazard(u):
        return np.exp(-0.5 * u**2 - log_ndtr(-u)) / np.sqrt(2 * np.pi)

    def slope(s):
        return q * s - p + (hazard(s[..., None] * unit - level) * unit).sum(-1)

    low, high = np.zeros(p.shape), np.maximum(p, 0.0) / q
    for _ in range(80):
        middle = 0.5 * (low + high)
        above = slope(middle) > 0
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    s = np.where(slope(np.zeros(p.shape)) >= 0, 0.0, high)
    u = s[..., None] * unit - level
    variance = 1.0 / (q + (hazard(u) * (hazard(u) - u) * unit**2).sum(-1))
    return s, variance, -2.0 * log_ndtr(-u).sum(-1)


def brute_force(
    grid, flux, sigma, log_prior=None, limit=None, *, priors=None, prior_f="grid", scale_error=True
):
    """
    Posterior of one object by arrays over all models, with nothing left out.

    ``limit`` says which bands are upper limits; ``flux`` and ``sigma`` hold them. ``log_prior`` is
    that of the redshifts, else they have the weights of ``priors``.
    """
    limit = np.zeros(flux.size, bool) if limit is None else np.asarray(limit)
    use = np.isfinite(sigma) & ~limit
    w = np.where(use, 1.0 / np.square(sigma), 0.0)
    level = flux[limit] / sigma[limit]
    flux = np.where(use, flux, 0.0)
    power = agn_power(grid)
    agn = grid.agn if grid.n_agn else np.zeros((grid.redshift.size, 1, flux.size))
    model = (
        grid.galaxy[:, :, None, None, :] + power[None, :, None, :, None] * agn[:, None, :, None, :]
    )
    p, q = (model * w * flux).sum(-1), (model * model * w).sum(-1)
    s, variance, terms = limited_scales(p, q, model[..., limit] / sigma[limit], level)
    chi2 = (w * (flux - s[..., None] * model) ** 2).sum(-1) + terms
    of_redshift, of_galaxy, of_agn, of_frac = model_priors(grid, priors, prior_f)
    if log_prior is not None:
        of_redshift = np.exp(log_prior)
    prior = (
        of_redshift[:, None, None, None]
        * of_galaxy[:, None, None]
        * of_agn[:, None]
        * of_frac
        * grid.allowed[:, :, None, None]
    )
    like = prior * np.exp(-0.5 * (chi2 - chi2[prior > 0].min()))
    total = like.sum()
    like /= total
    more = float(scale_error) * variance
    values, mean, std = {}, [], []
    # for unit scale; s has the variance 1 / q
    for name, (galaxy, torus) in derived_quantities(grid).items():
        unit = galaxy[:, None, None] + power[:, None, :] * torus[:, None]
        values[name] = s * unit
        mean.append((like * values[name]).sum())
        # about the mean, so that narrow posteriors keep their digits
        apart = (values[name] - mean[-1]) ** 2 + more * unit**2
        std.append(np.sqrt((like * apart).sum()))
    name, fraction = other_fraction(grid)
    if name is not None:
        values[name] = np.broadcast_to(fraction, s.shape)
        mean.append((like * values[name]).sum())
        std.append(np.sqrt((like * (values[name] - mean[-1]) ** 2).sum()))
    band = ((like * s)[..., None] * model).sum((0, 1, 2, 3))
    apart = (s[..., None] * model - band) ** 2 + more[..., None] * model**2
    return {
        "chi2": chi2[prior > 0].min(),
        "index": np.unravel_index(np.where(prior > 0, chi2, np.inf).argmin(), chi2.shape),
        "log_sum": np.log(total) - 0.5 * chi2[prior > 0].min(),
        "zf": like.sum((1, 2)),
        "galaxy": like.sum((0, 2, 3)),
        "agn": like.sum((0, 1, 3)),
        "mean": np.array(mean),
        "std": np.array(std),
        "band": band,
        "band_std": np.sqrt((like[..., None] * apart).sum((0, 1, 2, 3))),
        "scale": s,
        "values": values,
        "weights": like,
    }


#: Grids (options of `make_grid`) and fitters that are compared with plain sums, by name.
CASES = {
    "default": ({}, {}),
    "priors": (
        {},
        {
            "priors": {
                "redshift": lambda z: z * np.exp(-z),
                "age": "log",
                "ebv_polar": [0.5, 1.0, 2.0],
                "temperature_polar": [1.0, 3.0],
            }
        },
    ),
    "prior_f by width": ({}, {}),
    "no galaxy-only models": ({"frac": [0.1, 0.5, 0.95]}, {}),
    "no AGN": ({"frac": [0.0]}, {}),
    "one redshift": ({"n_z": 1}, {}),
    "no scale error": ({}, {"scale_error": False}),
}


def assert_plain(
    results, grid, *, rtol, atol=1e-12, floor=1.0, std_rtol=None, known=None, **options
):
    """
    Every sum of results is that of `brute_force`, to ``rtol``; posteriors also to ``atol``.

    Quantities are so to 1e-9 of the largest times ``floor``, for those of an AGN that is not there are not
    worth their digits. ``known`` are the redshifts of a fit at known ones, ``options`` those of `brute_force`.
    """
    assert np.all(results.fitted)
    std_rtol = 1e3 * rtol if std_rtol is None else std_rtol
    parameters = list(free_parameters(grid, options.get("priors")))
    for i in range(len(results)):
        log_prior = None
        if known is not None:
            log_prior = np.where(grid.redshift == known[i], 0.0, -np.inf)
        want = brute_force(grid, results.flux[i], results.sigma[i], log_prior, **options)
        assert_allclose(results.chi2[i], want["chi2"], rtol=1e-9, atol=1e-9)
        assert tuple(results.best_index[i])[:2] == tuple(want["index"])[:2]
        constant = np.log(results.sigma[i][np.isfinite(results.sigma[i])]).sum()
        constant += 0.5 * results.n_bands[i] * np.log(2 * np.pi)
        assert_allclose(results.log_evidence[i] + constant, want["log_sum"], rtol=0, atol=1e-5)
        assert_allclose(results.pdf_2d[i], want["zf"], rtol=rtol, atol=atol)
        for name, kind, _, share, _ in parameters:
            assert_allclose(results.pdf[name][i], share @ want[kind], rtol=rtol, atol=atol)
        scale, (mean, std) = 1e-9 * np.abs(want["mean"]).max(), results.moments[i, :, :2].T
        assert_allclose(mean, want["mean"], rtol=rtol, atol=floor * scale)
        assert_allclose(std, want["std"], rtol=std_rtol, atol=1e2 * scale)
        assert_allclose(results.model_flux[i], want["band"], rtol=max(rtol, 1e-7))
        assert_allclose(results.model_flux_std[i], want["band_std"], rtol=1e-4)


def node_fitter(*args, settings=None, **options):
    """Fitter of the nodes alone: models of random grids have nothing between them."""
    settings = replace(settings or GridSettings(), interpolate=0)
    return BayesFitter(*args, settings=settings, **options)
