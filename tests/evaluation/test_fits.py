"""The tables of real fits: truths from the grid, so that posteriors must be right."""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable

from helpers.studies import BANDS, LIMITS
from miricigale.evaluation import coverage_table, posterior_ranks
from miricigale.fitting import BayesFitter
from miricigale.photometry import ErrorModel
from miricigale.photometry.surveys import YANG2021_DEPTHS
from miricigale.sed import SEDModel

N = 120
OTHERS = tuple(YANG2021_DEPTHS)


@pytest.fixture(scope="module")
def case():
    """Truths drawn from the prior of the grid, with and without MIRI, fitted with the right errors."""
    rng = np.random.default_rng(1)
    axes = SEDModel.yang2021_axes("quick")
    model = SEDModel.yang2021(libraries="bundled")
    # on the nodes: between those of a coarse grid there is no right model
    nodes = axes["redshift"]
    truth = QTable({"id": np.arange(N)})
    truth["redshift"] = rng.choice(nodes[(nodes > 0.2) & (nodes < 2.5)], N)
    for name in ("tau", "ebv", "alpha", "tau97", "ebv_polar", "temperature_polar"):
        truth[name] = rng.choice(axes[name], N)
    truth["age"] = rng.choice([0.5, 1.0], N)
    truth["frac_agn"] = rng.choice([0.0, 0.2, 0.4, 0.6, 0.8], N)
    truth["mass"] = 10 ** rng.uniform(9.5, 11, N)
    light = model.fluxes(truth, [*OTHERS, *BANDS])
    truth["accretion_power"] = light["accretion_power"]
    errors = ErrorModel.from_depths(
        dict(YANG2021_DEPTHS) | LIMITS, fractional=dict.fromkeys([*OTHERS, *BANDS], 0.03)
    )
    light["id"] = truth["id"]
    mock = errors.perturb(light[["id", *OTHERS, *BANDS]], seed=1)
    fits = {
        name: BayesFitter(model, [*OTHERS, *bands], axes=axes, model_error=error).fit(mock)
        for name, bands, error in (("all", BANDS, 0), ("none", (), 0), ("wide", BANDS, 0.1))
    }
    return truth, fits


def ranks_of(case, fit):
    truth, fits = case
    ranks = {}
    for name in ("redshift", "frac_agn", "accretion_power"):
        values, levels = fits[fit].cdf(name)
        true = u.Quantity(truth[name]).to_value(values.unit)
        ranks[name] = posterior_ranks(true, values.value, levels, seed=1)
    return ranks


@pytest.mark.parametrize("fit", ["all", "none"])
def test_posteriors_of_truths_of_the_grid_cover_them(case, fit):
    ranks = ranks_of(case, fit)
    table = coverage_table(ranks)
    # 120 sources: 4.3 % and 2 %
    inside = dict(zip(zip(table["name"], table["level"], strict=True), table["share"], strict=True))
    for name in ranks:
        # of a power only quantiles are kept: where few models remain they hold more than they say
        most = 0.88 if name == "accretion_power" else 0.82
        assert 0.55 < inside[name, 0.68] < most
        assert inside[name, 0.95] > 0.88


def test_posteriors_with_an_error_that_the_models_do_not_have_are_too_wide(case):
    for name in ("frac_agn", "accretion_power"):
        ranks = {fit: ranks_of(case, fit)[name] for fit in ("wide", "all")}
        wide, right = coverage_table(ranks, levels=(0.68,))["share"]
        assert wide > right
