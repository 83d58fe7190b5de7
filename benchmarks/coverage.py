"""
How often intervals hold the truth if errors of models are like those of a survey, independent or shared by bands.

    MIRICIGALE_DATA=../shared/data python benchmarks/coverage.py [--n 120] [--lengths 0 0.1] [--sizes 1 1.5]
        [--factors 1 1.5] [--above 0]

Truths are models drawn from the posteriors of CEERS sources with S/N above 5 in two MIRI bands, one of each, on
the nodes. Their fluxes get errors of models with the size of the template error of `SurveyCalibration.survey`
times ``--sizes``, with a Gaussian correlation in log10 of rest wavelength of length ``--lengths`` (dex; 0:
independent), and noise with the errors of bands that the fit has: in MIRI 3.3 times those of the catalog and 15 %
of the flux. They are fitted on the nodes with the template error times ``--factors`` at rest wavelengths
``--above`` so many um. The sources themselves are fitted too: most of their redshifts are photometric. Shares are
of randomized ranks, for truths lie on nodes (`posterior_ranks`).
"""

import argparse
import dataclasses
import os
import time
from pathlib import Path

import astropy.units as u
import numpy as np
from ceers import OUTLIER, sample

from miricigale.evaluation import posterior_ranks
from miricigale.fitting import BayesFitter, GridSettings, SurveyCalibration, TemplateError
from miricigale.fitting.data.template_error import pivots
from miricigale.fitting.grid.node_fluxes import model_fluxes
from miricigale.fitting.grid.node_scan import NodeScan
from miricigale.sed import SEDModel

N_DRAWS = 128
#: Part of the variance that is independent, so that matrices of correlations can be inverted.
INDEPENDENT = 1e-6
MIRI_ERRORS = (3.3, 0.15)
OTHER_ERRORS = (1.0, 0.02)


def draw_truths(fitter, table, rng):
    """Draw a model of each source that has one: rows, redshifts, AGN fractions, and fluxes in all bands in uJy."""
    data, log_prior, _ = fitter._prepare(table, None, None)
    engine = dataclasses.replace(fitter.backend.engine, mixture=None)
    drawn = {}

    def draw(source):
        share = np.exp(source.start.log_weight - source.start.log_weight.max())
        i = rng.choice(N_DRAWS, p=share / share.sum())
        index = source.start.index[i : i + 1]
        model = model_fluxes(engine, index)[0]
        sigma = data.sigma[source.row]
        flux = np.where(np.isfinite(sigma), data.flux[source.row], 0.0)
        weight = 1.0 / (sigma**2 + (engine.template_error[index[0, 0]] * flux) ** 2)
        scale = np.sum(weight * model * flux) / np.sum(weight * model**2)
        drawn[source.row] = (index[0], scale * model)

    NodeScan(engine, N_DRAWS).fit(**data.of_engine(log_prior), each=draw)
    rows = np.array(sorted(drawn))
    index = np.array([drawn[row][0] for row in rows])
    fluxes = np.array([drawn[row][1] for row in rows])
    grid = engine.grid
    return rows, grid.redshift[index[:, 0]], grid.frac_agn[index[:, 3]], fluxes


def mock(table, bands, truths, fluxes, length, size, seed=11):
    """Photometry of truths with errors of models and of bands."""
    rng = np.random.default_rng(seed)
    rest = pivots(bands).to_value(u.um) / (1.0 + truths[:, None])
    error = size * SurveyCalibration.survey().template_error(rest * u.um)
    shared = np.empty(rest.shape)
    for i, wave in enumerate(np.log10(rest)):
        correlation = np.eye(wave.size)
        if length > 0:
            correlation = np.exp(-0.5 * ((wave[:, None] - wave) / length) ** 2)
            correlation += INDEPENDENT * np.eye(wave.size)
        shared[i] = np.linalg.cholesky(correlation) @ rng.normal(size=wave.size)
    out = table.copy()
    for i, band in enumerate(bands):
        factor, part = OTHER_ERRORS
        if band.startswith("miri"):
            factor, part = MIRI_ERRORS
        flux = fluxes[:, i] * np.exp(error[:, i] * shared[:, i] - 0.5 * error[:, i] ** 2)
        noise = factor * table[f"{band}_err"].to_value(u.uJy) * rng.normal(size=len(table))
        noise += part * fluxes[:, i] * rng.normal(size=len(table))
        measured = np.isfinite(table[band].to_value(u.uJy))
        out[band] = np.where(measured, flux + noise, np.nan) * u.uJy
    return out


def held(results, name, true):
    """Percentage of truths within the central 68 % of their posteriors."""
    values, levels = results.cdf(name)
    ranks = posterior_ranks(true, values.value, levels, seed=1)
    return 100.0 * np.mean(np.abs(ranks - 0.5) < 0.34)


def score(label, fitter, table, true, frac_agn=None):
    """Print a line of the table."""
    start = time.process_time()
    results = fitter.fit(table)
    spent = time.process_time() - start
    low, middle, high = results.percentile("redshift", (0.16, 0.5, 0.84)).value.T
    off = (middle - true) / (1.0 + true)
    width = np.median((high - low) / (1.0 + true)) / 2.0
    of_fraction = ""
    if frac_agn is not None:
        of_fraction = f"{held(results, 'frac_agn', frac_agn):.0f}"
    print(
        f"{label:46s} {held(results, 'redshift', true):4.0f} {of_fraction:>4s} "
        f"{100 * np.mean(np.abs(off) > OUTLIER):6.1f} {np.median(off):+8.4f} {width:7.4f} {spent:6.1f}",
        flush=True,
    )


def main():
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--n", type=int, default=120, help="sources")
    parser.add_argument("--lengths", type=float, nargs="+", default=[0.0, 0.1])
    parser.add_argument("--sizes", type=float, nargs="+", default=[1.0, 1.5])
    parser.add_argument("--factors", type=float, nargs="+", default=[1.0, 1.5])
    parser.add_argument("--above", type=float, default=0.0, help="um")
    args = parser.parse_args()
    path = Path(os.environ["MIRICIGALE_DATA"]) / "ceers/ceers_photometry_part.fits"
    table, bands, n_miri = sample(path)
    rng = np.random.default_rng(3)
    rows = np.sort(rng.choice(np.flatnonzero(n_miri >= 2), args.n, replace=False))
    grid = SEDModel.survey().grid(SEDModel.survey_axes(), bands)
    settings = GridSettings(interpolate=0)
    survey = SurveyCalibration.survey().with_prior_errors(bands)
    fitter = BayesFitter(grid, bands, calibration=survey, settings=settings)
    has_model, true, frac_agn, fluxes = draw_truths(fitter, table[rows], rng)
    sources = table[rows][has_model]
    fluxes = fluxes[:, [fitter.backend.filters.index(band) for band in bands]]
    print(f"{len(sources)} sources, {100 * np.mean(frac_agn > 0):.0f} % of the truths with an AGN")
    print(f"{'':46s} z, % f, %  out.%     bias   width  CPU s")
    for factor in args.factors:
        wave = np.unique(np.append(survey.template_error.wave.value, np.geomspace(0.09, 25, 60)))
        error = survey.template_error(wave * u.um) * np.where(wave > args.above, factor, 1.0)
        changed = dataclasses.replace(survey, template_error=TemplateError(wave * u.um, error))
        other = BayesFitter(grid, bands, calibration=changed, settings=settings)
        for length in args.lengths:
            for size in args.sizes:
                label = f"errors x {size:g}, {length:g} dex; fit x {factor:g}"
                photometry = mock(sources, bands, true, fluxes, length, size)
                score(label, other, photometry, true, frac_agn)
        published = np.asarray(sources["redshift"], float)
        score(f"sources themselves; fit x {factor:g}", other, sources, published)


if __name__ == "__main__":
    main()
