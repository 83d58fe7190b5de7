"""
Compare fits with outliers with the exact mixture, in plain numpy, on some 10^4 models.

    python benchmarks/outliers.py [--n 60] [--part 0.05]
    python benchmarks/outliers.py --ceers FILE [--grid FILE]

Objects are models of the grid with 5 % noise, and 0, 1 or 2 of 11 bands wrong by a factor of 0.1, 0.3, 3
or 6. Each model has the scale that is best for its own mixture, found from many starts.
The second form fits 300 real sources with and without, and says the time of an object.
"""

import argparse
import time

import astropy.units as u
import numpy as np
from astropy.stats import mad_std
from astropy.table import QTable
from ceers import sample
from fit import loop_time

from miricigale import BayesFitter, SEDModel
from miricigale.fitting import GridSettings, SurveyCalibration
from miricigale.fitting.posterior.posterior import cell_percentiles
from miricigale.sed import ModelGrid

#: The exact sum is over the nodes.
NODES = {"settings": GridSettings(interpolate=0)}

BANDS = [
    "acs.f606w", "acs.f814w", "nircam.f115w", "nircam.f150w", "nircam.f200w", "nircam.f277w",
    "nircam.f356w", "nircam.f444w", "miri.f770w", "miri.f1000w", "miri.f1500w",
]  # fmt: skip
AXES = {
    "tau": [0.1, 3.0], "age": [0.12, 0.7, 3.0], "ebv": [0, 0.2, 0.5, 1.0], "q_pah": [0.47, 4.58],
    "slope": [-0.4, 0.0], "tau97": [3.0, 11.0], "ebv_polar": [0.0, 0.2],
    "frac_agn": [0, 0.2, 0.6, 0.95], "redshift": np.geomspace(1.1, 6, 30) - 1,
}  # fmt: skip
LEVELS = np.array([0.16, 0.5, 0.84])


def exact(model, flux, sigma, broad, part, steps=12):
    """Ln of the mixture of every model at its best scale, and how likely each band is wrong."""
    best, wrong = np.full(len(model), -np.inf), np.zeros(model.shape)
    for start in range(-1, flux.size):
        weight = np.tile(sigma**-2.0, (len(model), 1))
        if start >= 0:
            weight[:, start] = broad[start] ** -2.0
        for _ in range(steps):
            scale = np.maximum((weight * model * flux).sum(1), 0) / (weight * model * model).sum(1)
            square = np.square(flux - scale[:, None] * model)
            good = np.log1p(-part) - 0.5 * square / sigma**2
            bad = np.log(part * sigma / broad) - 0.5 * square / broad**2
            share = 1 / (1 + np.exp(np.clip(good - bad, -700, 700)))
            weight = (1 - share) / sigma**2 + share / broad**2
        log = np.logaddexp(good, bad).sum(1)
        better = log > best
        best[better], wrong[better] = log[better], share[better]
    return best, wrong


def make(grid, index, model, n, n_wrong, rng):
    """Fluxes, errors, redshifts and which bands are wrong of n objects."""
    depth = np.where(np.arange(len(BANDS)) < 8, 0.01, 0.1)
    flux, wrong, place = np.empty((n, len(BANDS))), np.zeros((n, len(BANDS)), bool), []
    for i in range(n):
        place.append(rng.integers(len(model)))
        true = model[place[i]] / model[place[i]][5] * 10 ** rng.uniform(-1.5, 0.5)
        flux[i] = true + np.hypot(0.05 * true, depth) * rng.normal(size=len(BANDS))
        bad = rng.choice(len(BANDS), n_wrong, replace=False)
        flux[i, bad] *= rng.choice([0.1, 0.3, 3.0, 6.0], n_wrong)
        wrong[i, bad] = True
    return flux, np.hypot(0.03 * np.abs(flux), depth), grid.redshift[index[0][place]], wrong


def real(path, grid_path):
    """Fit sources of CEERS with two MIRI bands, from the survey preset, with flat priors."""
    table, bands = sample(path)
    z = np.array(table["redshift"], float)
    rows = np.flatnonzero((z > 0.1) & (z < 5.5))
    rows = np.random.default_rng(3).choice(rows, min(300, rows.size), replace=False)
    table, z = table[rows], z[rows]
    if grid_path:
        grid = ModelGrid.read(grid_path)
    else:
        grid = SEDModel.survey().grid(SEDModel.survey_axes(), bands)
    loop = loop_time(grid, grid.n_allowed, len(bands))
    print(f"{z.size} sources, plain loop {loop:.2f} s an object")
    hst = [name for name in bands if not name.startswith("miri")]
    for label, names, error in (
        ("HST, NIRCam", hst, 0.0), ("with MIRI", bands, 0.0),
        ("with 20 % in MIRI", bands, 0.2), ("with 35 % in MIRI", bands, 0.35),
    ):  # fmt: skip
        errors = {name: error if name.startswith("miri") else 0.0 for name in names}
        for part in (None, 0.03, 0.05, 0.1):
            given = {
                "model_error": errors,
                "template_error": SurveyCalibration.survey().template_error,
                **NODES,
            }
            fitter = BayesFitter(grid, names, outliers=part, **given)
            fitter.fit(table[:2])
            start = time.process_time()
            results = fitter.fit(table)
            ms = (time.process_time() - start) / z.size * 1e3
            low, middle, high = results.percentile("redshift", LEVELS).value.T
            off = (middle - z) / (1 + z)
            inside = np.mean((low <= z) & (z <= high))
            wrong = 0 if part is None else np.nansum(results.outlier > 0.5)
            print(
                f"{label:18s} {part!s:5s} bias {np.median(off):+.4f} sigma_MAD {mad_std(off):.4f}",
                f"outliers {np.mean(np.abs(off) > 0.15):.3f} in 68 % {inside:.2f}",
                f"wrong fluxes {wrong:d}, {ms:.1f} ms",
                flush=True,
            )


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--n", type=int, default=60, help="objects")
    parser.add_argument("--part", type=float, default=0.05, help="prior fraction")
    parser.add_argument("--ceers", help="photometry of CEERS")
    parser.add_argument("--grid", help="grid of the survey preset in the bands of CEERS")
    options = parser.parse_args()
    if options.ceers:
        real(options.ceers, options.grid)
        return
    n, rng = options.n, np.random.default_rng(7)
    grid = SEDModel.survey().grid(AXES, BANDS)
    given = {
        "model_error": 0.0,
        "template_error": SurveyCalibration.survey().template_error,
        **NODES,
    }
    fitter = BayesFitter(grid, BANDS, outliers=options.part, **given)
    plain = BayesFitter(grid, BANDS, **given)
    error = fitter.backend.engine.template_error
    shape = grid.redshift.size, grid.galaxy.shape[1], grid.n_agn, grid.frac_agn.size
    index = np.meshgrid(*map(np.arange, shape), indexing="ij")
    some = grid.allowed[:, :, None, None] & ((index[3] > 0) | (index[2] == 0))
    index = [one[some] for one in index]
    count, model = np.where(index[3] == 0, grid.n_agn, 1.0), grid.flux(*index)
    print(f"{len(model)} models; errors of percentiles of redshift over half the interval")
    for n_wrong in range(3):
        flux, err, z, wrong = make(grid, index, model, n, n_wrong, rng)
        table = QTable({"id": np.arange(n)})
        for k, name in enumerate(BANDS):
            table[name], table[f"{name}_err"] = flux[:, k] * u.uJy, err[:, k] * u.uJy
        ours, without = fitter.fit(table), plain.fit(table)
        axis, part = ours.axes["redshift"], np.full(len(BANDS), options.part)
        off, rise, change = [], [], []
        for i in range(n):
            wide = np.pad(np.abs(flux[i]), 1)
            wide = np.maximum(wide[1:-1], np.maximum(wide[2:], wide[:-2]))
            wide = np.hypot(10 * err[i], wide)
            log, share = np.empty(len(model)), np.empty(model.shape)
            for k in range(shape[0]):
                rows, sigma = index[0] == k, np.hypot(err[i], error[k] * flux[i])
                log[rows], share[rows] = exact(model[rows], flux[i], sigma, wide, part)
                log[rows] -= np.log(sigma).sum() + 0.5 * len(BANDS) * np.log(2 * np.pi)
            weight = count * np.exp(log - log.max())
            pdf = np.bincount(index[0], weight, shape[0])[None] / weight.sum()
            true = cell_percentiles(axis.values, pdf, LEVELS, axis.bounds)[0]
            for one in (ours, without):
                off.append(2 * (one[i].percentile("redshift", LEVELS).value - true))
                off[-1] /= true[2] - true[0]
            rise.append(ours.log_evidence[i] - np.log(weight.sum() / np.prod(shape)) - log.max())
            change.append(ours.outlier[i] - (weight @ share) / weight.sum())
        off = np.abs(off).reshape(n, 2, 3)
        far = [
            np.mean(np.abs(one.median("redshift").value - z) > 0.15 * (1 + z))
            for one in (ours, without)
        ]
        print(f"{n_wrong} wrong bands")
        print("  50, 90, 99 %, with:", *np.percentile(off[:, 0], [50, 90, 99]).round(3))
        print("  50, 90, 99 %, without:", *np.percentile(off[:, 1], [50, 90, 99]).round(2))
        print("  ln evidence 0, 5, 50, 100 %:", *np.percentile(rise, [0, 5, 50, 100]).round(3))
        print("  probabilities, rms:", np.sqrt(np.mean(np.square(change))).round(4))
        found = np.mean(ours.outlier[wrong] > 0.5) if n_wrong else np.nan
        print(f"  found {found:.2f}, false {np.mean(ours.outlier[~wrong] > 0.5):.4f}")
        print(f"  outliers in redshift {far[0]:.3f}, without {far[1]:.3f}", flush=True)


if __name__ == "__main__":
    main()
