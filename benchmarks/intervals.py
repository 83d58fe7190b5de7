"""
How often intervals hold the truth where it lies between the nodes of a grid, and what that costs.

    python benchmarks/intervals.py [--n 300] [--draws 0 200] [--grid small|large|survey] [--finer] [--seed 7]
                                   [--model-error 0.1] [--snr 10] [--depth 0] [--scattered] [--interpolated]

Objects are models drawn from the prior of the fit: of any node, anywhere in its cell between the outermost nodes,
computed by the chain itself, or with ``--interpolated`` by the fit's own tables, so that errors of these have no
part. They have S/N ``--snr`` in 21 bands, u* to MIPS 24, or for the axes of surveys in 14 of HST, NIRCam and MIRI,
and an error of ``--depth`` times the brightest flux besides. They are not scattered by the model error of the
fit, which stands for what the models of a grid are off by, unless ``--scattered``. ``--draws`` is ``interpolate``
of the fitter, ``--finer`` makes a finer
grid. Grids have 0.8, 69 and 20.5 million models. Printed are the parts of the truths in 68 and 95 % intervals,
their binomial errors, milliseconds of CPU an object, in one call and one object a call, seconds to make the
fitter, and the plain loop of ``benchmarks/fit.py``.
"""

import argparse
import time

import astropy.units as u
import numpy as np
from astropy.table import QTable
from fit import loop_time

from miricigale.fitting import BayesFitter, FitFlags, GridSettings
from miricigale.sed import SEDModel

BANDS = [
    "megacam.u", "megacam.g", "megacam.r", "megacam.i", "megacam.z", "acs.f606w", "acs.f814w",
    "wfc3.f125w", "wfc3.f140w", "wfc3.f160w", "irac.ch1", "irac.ch2", "irac.ch3", "irac.ch4", "mips.24",
    "miri.f770w", "miri.f1000w", "miri.f1280w", "miri.f1500w", "miri.f1800w", "miri.f2100w",
]  # fmt: skip
SURVEY_BANDS = [
    "acs.f606w", "acs.f814w", "wfc3.f125w", "wfc3.f160w", "nircam.f115w", "nircam.f150w", "nircam.f200w",
    "nircam.f277w", "nircam.f356w", "nircam.f410m", "nircam.f444w", "miri.f560w", "miri.f770w", "miri.f1000w",
]  # fmt: skip
SMALL = {
    "tau": [0.1, 0.5, 1.0, 5.0],
    "age": [0.5, 1.0, 3.0, 5.0],
    "ebv": [0.1, 0.2, 0.4, 0.6, 0.9],
    "alpha": [1.0, 2.0, 2.5],
    "tau97": [3.0, 7.0, 11.0],
    "ebv_polar": [0.0, 0.15, 0.3],
    "temperature_polar": [100.0, 300.0],
    "frac_agn": [0.0, 0.2, 0.4, 0.6, 0.8, 0.99],
    "redshift": np.expm1(np.linspace(np.log(1.14), np.log(6.9), 31)),
}
LARGE = SEDModel.yang2021_axes("fit") | {
    "tau": [0.1, 0.3, 0.5, 1.0, 2.0, 5.0],
    "age": [0.5, 1.0, 2.0, 3.0, 5.0],
    "ebv_polar": [0.0, 0.03, 0.1, 0.2, 0.3],
    "redshift": np.expm1(np.linspace(np.log(1.14), np.log(6.9), 115)),
}
NAMES = ("redshift", "frac_agn", "stellar_mass", "sfr", "dust_luminosity")


def drawn(fitter, n, rng):
    """Values of parameters by name, from the prior of a fitter."""
    priors, usable = fitter.priors, fitter.backend.engine.usable
    shape, out = usable.shape, {}
    weight = (usable * priors.galaxy * priors.redshift[:, None]).ravel()
    z, galaxy = np.unravel_index(rng.choice(weight.size, n, p=weight / weight.sum()), shape)
    for name, axis in priors.axes.items():
        # what is absent, and labels, are at their nodes alone
        low, high = axis.cells(bounds=(axis.values[0], axis.values[-1]))
        node = z
        if axis.kind == "galaxy":
            node = np.argmax(axis.share[:, galaxy], axis=0)
        elif name != "redshift":
            node = rng.choice(axis.values.size, n, p=axis.weights)
        out[name] = low[node] + (high - low)[node] * rng.random(n)
    return out


def interpolated_fluxes(fitter, values):
    """Fluxes and derived quantities from the tables of a fitter between nodes, as `SEDModel.fluxes` gives them."""
    models = fitter.backend.between.models
    redshift = values["redshift"]
    flux, power = models.fluxes(values, redshift, values["frac_agn"])
    described = models.describe(values, redshift, power, np.ones(len(redshift)))
    quantities = fitter.backend.engine.quantities
    units = dict(zip(quantities.names, quantities.units, strict=True))
    table = QTable({name: flux[:, j] * u.uJy for j, name in enumerate(fitter.bands)})
    for name in NAMES[2:]:
        table[name] = described[name] * units[name]
    return table


def objects(fitter, model, n, rng, noise, extra, depth=0.0, between=None):
    """
    Photometry with noise and a further one, as parts of fluxes, and true values by name.

    ``depth`` is a further error as a part of an object's brightest flux. Models are those of the chain, or of the
    tables of the fitter ``between``.
    """
    values, bands = drawn(fitter, 2 * n, rng), list(fitter.bands)
    values |= {name: np.full(2 * n, value) for name, value in fitter.backend.constants.items()}
    true = QTable({k: v * (model.parameters[k].unit or u.one) for k, v in values.items()})
    if between is None:
        fluxes = model.fluxes(true, bands)
    else:
        fluxes = interpolated_fluxes(between, values)
    # some are older than the universe, though their node is not
    good = np.flatnonzero(np.isfinite(fluxes["sfr"].value))[:n]
    true, fluxes = true[good], fluxes[good]
    for name in NAMES[2:]:
        true[name] = fluxes[name]
    brightest = np.max([fluxes[name].to_value(u.uJy) for name in bands], axis=0) * u.uJy
    table = QTable({"id": np.arange(n)})
    for name in bands:
        error = np.hypot(noise * fluxes[name], depth * brightest)
        scatter = np.hypot(error, extra * fluxes[name])
        table[name] = fluxes[name] + scatter * rng.normal(size=n)
        table[f"{name}_err"] = error
    return table, true


def held(results, true, name, part):
    """Part of the truths within an interval."""
    low, high = results.percentile(name, [0.5 - part / 2, 0.5 + part / 2]).T
    return np.mean((true[name] >= low) & (true[name] <= high))


def main():
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--n", type=int, default=300)
    parser.add_argument("--draws", type=int, nargs="+", default=[0, 200])
    parser.add_argument("--grid", choices=("small", "large", "survey"), default="small")
    parser.add_argument("--finer", action="store_true")
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--model-error", type=float, default=0.1)
    parser.add_argument("--snr", type=float, default=10.0)
    parser.add_argument("--depth", type=float, default=0.0)
    parser.add_argument("--scattered", action="store_true")
    parser.add_argument("--interpolated", action="store_true")
    args = parser.parse_args()
    if args.grid == "survey":
        model, axes, bands = SEDModel.survey(), SEDModel.survey_axes(), SURVEY_BANDS
    else:
        model, bands = SEDModel.yang2021(libraries="bundled"), BANDS
        axes = SMALL if args.grid == "small" else LARGE
    grid = model.grid(axes, bands)
    print(grid)
    options = {"model_error": args.model_error}
    rng, n = np.random.default_rng(args.seed), args.n
    nodes = BayesFitter(grid, bands, **options, settings=GridSettings(interpolate=0))
    extra = args.scattered * args.model_error
    between = None
    if args.interpolated:
        settings = GridSettings(finer=model if args.finer else None)
        between = BayesFitter(grid, bands, settings=settings, **options)
    table, true = objects(nodes, model, n, rng, 1.0 / args.snr, extra, args.depth, between)
    for part in (0.68, 0.95):
        error = 100 * np.sqrt(part * (1 - part) / n)
        print(f"parts of {n} truths in {100 * part:.0f} % intervals, +- {error:.1f} %")
    print(f"draws  ms   one  made {' '.join(f'{name:>16s}' for name in NAMES)}  on one node")
    for n_draws in args.draws:
        start = time.time()
        finer = model if n_draws and args.finer else None
        settings = GridSettings(interpolate=n_draws, finer=finer)
        fitter = BayesFitter(grid, bands, settings=settings, **options)
        made = time.time() - start
        # kernels are compiled, and models prepared, once
        fitter.fit(table[:1])
        start = time.process_time()
        results = fitter.fit(table)
        spent = 1e3 * (time.process_time() - start) / n
        start = time.process_time()
        for i in range(min(n, 50)):
            fitter.fit(table[i : i + 1])
        single = 1e3 * (time.process_time() - start) / min(n, 50)
        parts = [[100 * held(results, true, name, p) for p in (0.68, 0.95)] for name in NAMES]
        alone = np.mean((results.flags & int(FitFlags.ONE_NODE)) != 0)
        print(
            f"{n_draws:5d} {spent:4.0f} {single:4.0f} {made:5.1f} "
            f"{' '.join(f'{a:9.1f} {b:6.1f}' for a, b in parts)} {100 * alone:11.1f}%",
            flush=True,
        )
    loop = loop_time(grid, grid.n_allowed, len(bands))
    print(f"the plain loop over all models takes {loop:.2f} s an object")


if __name__ == "__main__":
    main()
