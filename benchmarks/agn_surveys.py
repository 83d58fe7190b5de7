"""
How well `miricigale.agn.draw_shares` counts AGN in mock surveys of fitted objects of which the AGN are known.

    python benchmarks/agn_surveys.py [--n 600] [--errors-of-models] [--surveys 40] [--tables FILE]

Truths are models of `SEDModel.survey` between the nodes of its axes, drawn with the priors of the fit at z = 0.2
to 4 (F444W < 26), half of them with an AGN, in equal numbers by fraction, in six bands of NIRCam, two of ACS and
six of MIRI. Errors are the depths of `DEPTHS` and 5 % of the flux, with ``--errors-of-models`` also those of
`SurveyCalibration.survey`, by which mock fluxes scatter. The first lines have the true numbers of objects by AGN
fraction, and those by the posteriors, for the fits to be right. Mock surveys are then drawn from the objects by
their posteriors, with AGN in 8 or 25 % and three distributions of their fractions. Each line: size, share of AGN,
distribution; the sum of the counted AGN (medians) with a fraction of 0.2 or more over the true ones, with its
error; the share of totals, and of bins of redshift and luminosity (fractions of 0.1 or more), whose 68 % interval
holds the truth, by randomized ranks. ``--tables`` keeps the posteriors, for they take nearly all of the time, 0.2
CPU-seconds an object.
"""

import argparse
import warnings
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.agn import draw_shares
from miricigale.fitting import (
    AGNBins,
    BayesFitter,
    GridSettings,
    MassFunction,
    SurveyCalibration,
    agn_fraction_prior,
)
from miricigale.fitting.data.template_error import pivots
from miricigale.sed import SEDModel
from miricigale.sed.cosmology import COSMOLOGY
from miricigale.utils.tables import error_column
from miricigale.utils.units import LUMINOSITY

#: 5-sigma depths in AB magnitudes.
DEPTHS = {
    "acs.f606w": 28.6, "acs.f814w": 28.3, "nircam.f115w": 29.0, "nircam.f150w": 29.0, "nircam.f200w": 29.1,
    "nircam.f277w": 29.2, "nircam.f356w": 29.1, "nircam.f444w": 28.6, "miri.f560w": 26.2, "miri.f770w": 26.3,
    "miri.f1000w": 25.4, "miri.f1280w": 24.7, "miri.f1500w": 24.4, "miri.f1800w": 23.4,
}  # fmt: skip
#: Band and AB magnitude of the limit of the sample.
SELECTION = ("nircam.f444w", 26.0)
REDSHIFTS = (0.2, 4.0)
#: log10 of the stellar masses that are drawn.
LOG_MASSES = (7.5, 12.0)
MODEL_ERROR = 0.05
BINS = AGNBins((0.2, 1.0, 2.0, 4.0), (43.0, 44.0, 45.0, 46.0))
#: First bins of fractions that are counted in totals and by luminosity: from 0.2 and from 0.1 on.
FIRST_OF_TOTAL = BINS.frac_agn.index(0.2) + 1
FIRST_OF_BINS = BINS.frac_agn.index(0.1) + 1
#: Weights of the AGN fractions (six bins above 0) in mock surveys.
DISTRIBUTIONS = {
    "equal": (1.0, 1.0, 1.0, 1.0, 1.0, 1.0),
    "faint": (8.0, 4.0, 2.0, 1.0, 0.5, 0.25),
    "bright": (0.5, 0.5, 1.0, 2.0, 3.0, 3.0),
}
#: Steps towards the most likely numbers.
N_ITERATIONS = 200
#: Half-width of 68.27 % of uniform ranks.
HALF_OF_INTERVAL = 0.3413


def make_fitter(errors_of_models):
    """Fitter of all objects."""
    axes = SEDModel.survey_axes()
    z = axes["redshift"]
    axes["redshift"] = z[(z > REDSHIFTS[0]) & (z < REDSHIFTS[1])]
    template_error = None
    if errors_of_models:
        template_error = SurveyCalibration.survey().template_error
    return BayesFitter(
        SEDModel.survey(),
        list(DEPTHS),
        axes=axes,
        priors={"frac_agn": agn_fraction_prior(axes["frac_agn"])},
        calibration=None,
        model_error=MODEL_ERROR,
        template_error=template_error,
        settings=GridSettings(agn_bins=BINS, mass_function=MassFunction()),
    )


def draw_models(fitter, n, share, rng):
    """
    Values of parameters drawn from the priors of a fitter but for mass: dict.

    A share of the models has an AGN, with equal numbers in all bins of the fraction and the prior within these.
    """
    priors = fitter.priors
    galaxy = rng.choice(priors.galaxy.size, n, p=priors.galaxy / priors.galaxy.sum())
    values = {}
    for name, axis in fitter.backend.between.axes.items():
        low, high = np.clip(axis.cells(), axis.values[0], axis.values[-1])
        if axis.kind == "galaxy":
            node = np.argmax(axis.share[:, galaxy], axis=0)
        else:
            node = rng.choice(axis.values.size, n, p=axis.weights)
        values[name] = low[node] + (high - low)[node] * rng.random(n)
        if name == "frac_agn":
            values[name] = _equal_in_bins(values[name], share, rng)
    return values


def _equal_in_bins(fraction, share, rng):
    """Draw fractions of the prior again: a share of them above 0, with equal numbers in all bins."""
    ones = np.ones(fraction.size)
    _, place, _ = BINS.place(ones, fraction, ones)
    n_bins = len(BINS.frac_agn) - 1
    wanted = np.where(
        rng.random(fraction.size) < 1.0 - share, 0, rng.integers(1, n_bins + 1, fraction.size)
    )
    out = np.zeros(fraction.size)
    for j in range(1, n_bins + 1):
        chosen = wanted == j
        out[chosen] = rng.choice(fraction[place == j], chosen.sum())
    return out


def draw_truths(fitter, n, rng, *, share=0.5):
    """
    Models in the limit of the sample, of which a share has an AGN, as a dict.

    ``flux`` and ``host`` (without the AGN) are in uJy, ``luminosity`` of the AGN is in erg/s.
    """
    models = fitter.backend.between.models
    n_drawn = 40 * n
    values = draw_models(fitter, n_drawn, share, rng)
    z = values["redshift"]
    flux, power = models.fluxes(values, z, values["frac_agn"])
    formed = np.ones(n_drawn)
    stars = models.describe(values, z, power, formed)["stellar_mass"]
    log_mass = rng.uniform(*LOG_MASSES, n_drawn)
    mass = 10.0**log_mass
    density = MassFunction()(mass * u.Msun, z) * COSMOLOGY.differential_comoving_volume(z).value
    # cells of redshift are equal in ln(1 + z)
    density *= 1.0 + z
    flux = flux * (mass / stars)[:, None]
    band, limit = SELECTION
    limit = (limit * u.ABmag).to_value(u.uJy)
    with np.errstate(invalid="ignore"):
        good = np.isfinite(flux).all(axis=1) & (flux[:, list(DEPTHS).index(band)] > limit)
    density = np.where(good, density, 0.0)
    accepted = np.flatnonzero(rng.random(n_drawn) < density / density.max())[:n]
    if accepted.size < n:
        raise RuntimeError(f"{accepted.size} models of {n} are within the limit: draw more")
    rows = {name: column[accepted] for name, column in values.items()}
    derived = models.describe(rows, z[accepted], power[accepted], (mass / stars)[accepted])
    host, _ = models.fluxes(rows, z[accepted], np.zeros(accepted.size))
    return {
        "flux": flux[accepted],
        "host": host * (mass / stars)[accepted, None],
        "redshift": z[accepted],
        "frac_agn": rows["frac_agn"],
        "luminosity": derived["accretion_power"] * LUMINOSITY.to("erg / s"),
    }


def observe(flux, redshift, template_error, rng):
    """Photometry of fluxes in uJy, with noise."""
    part = np.full(flux.shape, MODEL_ERROR)
    if template_error is not None:
        rest = pivots(DEPTHS).to_value(u.um) / (1.0 + redshift[:, None])
        part = np.hypot(part, template_error(rest * u.um))
    table = QTable({"id": np.arange(len(flux))})
    for j, (band, depth) in enumerate(DEPTHS.items()):
        error = 0.2 * (depth * u.ABmag).to_value(u.uJy)
        noise = error * rng.standard_normal(len(flux))
        noise += part[:, j] * flux[:, j] * rng.standard_normal(len(flux))
        table[band] = (flux[:, j] + noise) * u.uJy
        table[error_column(band)] = np.full(len(flux), error) * u.uJy
    return table


def fitted_objects(n, errors_of_models, seed):
    """Posteriors of objects in bins, their true bins, and the prior of the bins of the fraction: dict."""
    rng = np.random.default_rng(seed)
    fitter = make_fitter(errors_of_models)
    truth = draw_truths(fitter, n, rng)
    results = fitter.fit(observe(truth["flux"], truth["redshift"], fitter.template_error, rng))
    z_bin, frac_bin, l_bin = BINS.place(truth["redshift"], truth["frac_agn"], truth["luminosity"])
    return {
        "table": results.agn_weights,
        "z_bin": z_bin,
        "frac_bin": frac_bin,
        "l_bin": l_bin,
        "prior": BINS.prior(fitter.backend.between.axes["frac_agn"]),
    }


def probabilities(objects, number):
    """Probability of each object to be in a bin of the fraction, (n, n_frac), if so many of them are."""
    weight = objects["table"].sum(axis=(1, 3)) * number / objects["prior"]
    return weight / weight.sum(axis=1, keepdims=True)


def calibrate(objects):
    """Print true numbers by bin of the fraction, and those by the posteriors; return the most likely ones."""
    number = np.bincount(objects["frac_bin"], minlength=BINS.shape[1])
    part = probabilities(objects, number)
    error = np.sqrt(np.sum(part * (1.0 - part), axis=0))
    for j in range(number.size):
        print(
            f"bin {j}: {number[j]} objects, {part[:, j].sum():.1f} +- {error[j]:.1f} by posteriors"
        )
    high = part[:, FIRST_OF_TOTAL:].sum(axis=1)
    error = np.sqrt(np.sum(high * (1.0 - high)))
    print(f"from 0.2: {number[FIRST_OF_TOTAL:].sum()}, {high.sum():.1f} +- {error:.1f}", flush=True)
    most_likely = np.array(number, float)
    for _ in range(N_ITERATIONS):
        most_likely = probabilities(objects, most_likely).sum(axis=0)
    return most_likely


def draw_survey(objects, number, size, share, weights, rng):
    """
    Rows of a mock survey, and the true numbers in bins.

    An object with a fraction in a bin is drawn by its probability to be there, its redshift and luminosity by its
    posterior, so that posteriors are right and surveys are independent of the errors of the few that are fitted.
    """
    part = probabilities(objects, number)
    weights = np.asarray(weights) / np.sum(weights)
    shares = np.concatenate([[1.0 - share], share * weights])
    n_of_bins = rng.multinomial(size, shares)
    true = np.zeros(BINS.shape, int)
    rows = []
    for j, n_of_bin in enumerate(n_of_bins):
        chosen = rng.choice(len(part), n_of_bin, p=part[:, j] / part[:, j].sum())
        rows.append(chosen)
        for row in chosen:
            place = objects["table"][row, :, j]
            z, k = np.unravel_index(
                rng.choice(place.size, p=place.ravel() / place.sum()), place.shape
            )
            true[z, j, k] += 1
    return np.concatenate(rows), true


def ranks(draws, true, rng):
    """Randomized ranks of true numbers, shape (...), among draws of them, (n_draws, ...)."""
    below = np.mean(draws < true, axis=0)
    equal = np.mean(draws == true, axis=0)
    return below + equal * rng.random(np.shape(true))


def counted(objects, rows, true, seed):
    """Draws of the total and of bins of redshift and luminosity, and the true numbers."""
    n_z = len(BINS.redshift) - 1
    draws = draw_shares(objects["table"][rows], objects["prior"], n_draws=1000, seed=seed)
    counts = draws.counts["galaxy"][:, :n_z]
    true = true[:n_z]
    total = counts[:, :, FIRST_OF_TOTAL:].sum(axis=(1, 2, 3))
    bins = counts[:, :, FIRST_OF_BINS:, 1:].sum(axis=2)
    return total, true[:, FIRST_OF_TOTAL:].sum(), bins, true[:, FIRST_OF_BINS:, 1:].sum(axis=1)


def score(objects, number, size, share, name, n_surveys, rng):
    """Print a line of the table."""
    medians = []
    numbers = []
    of_totals = []
    of_bins = []
    for seed in range(n_surveys):
        rows, true = draw_survey(objects, number, size, share, DISTRIBUTIONS[name], rng)
        total, true_total, bins, true_bins = counted(objects, rows, true, seed)
        medians.append(np.median(total))
        numbers.append(true_total)
        of_totals.append(ranks(total, true_total, rng))
        of_bins.append(ranks(bins, true_bins, rng))
    medians = np.array(medians)
    numbers = np.array(numbers)
    scatter = np.std(medians - numbers) * np.sqrt(n_surveys) / numbers.sum()
    held = [
        100.0 * np.mean(np.abs(np.array(r) - 0.5) < HALF_OF_INTERVAL) for r in (of_totals, of_bins)
    ]
    print(
        f"{size:5d} {share:.2f} {name:7s} {medians.sum() / numbers.sum():.3f} +- {scatter:.3f}  "
        f"totals {held[0]:3.0f} %  bins {held[1]:3.0f} %",
        flush=True,
    )


def main():
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--n", type=int, default=600, help="objects that are fitted")
    parser.add_argument("--errors-of-models", action="store_true")
    parser.add_argument("--surveys", type=int, default=40, help="mock surveys a line")
    parser.add_argument("--sizes", type=int, nargs="+", default=[400], help="objects of a survey")
    parser.add_argument("--tables", type=Path, help="where posteriors are kept (npz)")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    if args.tables is not None and args.tables.exists():
        objects = dict(np.load(args.tables))
    else:
        objects = fitted_objects(args.n, args.errors_of_models, args.seed)
        if args.tables is not None:
            np.savez(args.tables, **objects)
    usable = np.isfinite(objects["table"].sum(axis=(1, 2, 3)))
    for name in ("table", "z_bin", "frac_bin", "l_bin"):
        objects[name] = objects[name][usable]
    number = calibrate(objects)
    rng = np.random.default_rng(args.seed)
    for size in args.sizes:
        for share in (0.08, 0.25):
            for name in DISTRIBUTIONS:
                score(objects, number, size, share, name, args.surveys, rng)


if __name__ == "__main__":
    main()
