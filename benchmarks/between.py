"""
Models between the nodes of a grid, drawn from posteriors of real galaxies, against the chain that made the grid.

    MIRICIGALE_DATA=../shared/data python benchmarks/between.py [--grid survey] [--sources 20] [--draws 20]

Sources are those of `benchmarks/ceers.py`, half of them with S/N above 5 in two MIRI bands, fitted as
``BayesFitter(model, bands, axes=grid)`` does. Each draw is computed again by ``SEDModel.fluxes`` at its
parameters. Shown are relative differences of fluxes above 0.1 % of the brightest, for each band, and of derived
quantities: their median, the median and the 95th percentile of their sizes, and the part within 2 %.
"""

import argparse
import os
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.table import QTable
from ceers import sample

from miricigale.fitting import BayesFitter
from miricigale.sed import SEDModel

MODELS = {
    "survey": SEDModel.survey,
    "far-infrared": SEDModel.survey,
    "yang2021": SEDModel.yang2021,
    "yang2021-quick": SEDModel.yang2021,
}
QUANTITIES = (
    "stellar_mass",
    "sfr",
    "sfr_100myr",
    "dust_luminosity",
    "ir_luminosity",
    "age_mass",
    "a_v",
)
#: Part of the brightest flux of a model below which a flux is not compared.
FAINT = 1e-3


def sources(n):
    """Photometry of n sources, half of them bright in MIRI, and its bands."""
    path = Path(os.environ["MIRICIGALE_DATA"]) / "ceers" / "ceers_photometry_part.fits"
    table, bands, n_miri = sample(path)
    rng = np.random.default_rng(8)
    anywhere = rng.choice(len(table), n // 2, replace=False)
    bright = rng.choice(np.flatnonzero(n_miri >= 2), n - n // 2, replace=False)
    return table[np.concatenate([anywhere, bright])], bands


def parameters_of(model, grid, samples, drawn):
    """Table of the parameters of draws: those that were drawn, and the constants of the grid."""
    table = QTable()
    for name, parameter in model.parameters.items():
        if name in samples.parameters:
            table[name] = samples[name].to(parameter.unit).ravel()[drawn]
    for tables in (grid.galaxy_parameters, grid.agn_parameters):
        for name in tables.colnames:
            if name not in table.colnames:
                constant = u.Quantity(tables[name])[0]
                table[name] = np.full(drawn.sum(), constant.value) * model.parameters[name].unit
    return table


def line(name, ratio):
    """One row of the table."""
    difference = ratio - 1.0
    size = np.abs(difference)
    numbers = [np.median(difference), np.median(size), np.percentile(size, 95)]
    shown = " ".join(f"{100 * value:8.2f}" for value in numbers)
    print(f"{name:20} {shown} {100 * np.mean(size < 0.02):8.1f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[1])
    parser.add_argument("--grid", choices=MODELS, default="survey")
    parser.add_argument("--sources", type=int, default=20)
    parser.add_argument("--draws", type=int, default=20)
    args = parser.parse_args()
    table, bands = sources(args.sources)
    model = MODELS[args.grid]()
    fitter = BayesFitter(model, bands, axes=args.grid)
    samples = fitter.sample(table, args.draws, seed=3)
    drawn = np.isfinite(samples["mass"].value).ravel()
    exact = model.fluxes(parameters_of(model, fitter.grid, samples, drawn), bands)
    expected = np.column_stack([exact[band].to_value("uJy") for band in bands])
    flux = samples.fluxes(bands).to_value("uJy").reshape(-1, len(bands))[drawn]
    bright = expected > FAINT * expected.max(axis=1, keepdims=True)
    ratio = flux / expected
    print(f"{drawn.sum()} draws; per cent: median, median size, 95 %, within 2 %")
    line("all fluxes", ratio[bright])
    for k, band in enumerate(bands):
        line(band, ratio[bright[:, k], k])
    for name in QUANTITIES:
        true = exact[name].value
        value = samples[name].to_value(exact[name].unit).ravel()[drawn]
        line(name, value[true > 0] / true[true > 0])


if __name__ == "__main__":
    main()
