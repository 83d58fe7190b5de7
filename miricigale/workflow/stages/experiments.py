"""Further fits of the samples of a study: freed AGN, far infrared, without model error."""

import numpy as np

from miricigale import photometry, sed
from miricigale.evaluation import photoz_metrics, recovery_metrics
from miricigale.evaluation.coverage import interval_share
from miricigale.fitting import GridSettings
from miricigale.photometry.errors.error_model import HERSCHEL_DEPTHS
from miricigale.utils.arrays import finite_values, nans, quiet_division
from miricigale.utils.missing_values import floats
from miricigale.utils.named_values import convert_values
from miricigale.workflow.derived import rows_of
from miricigale.workflow.engine.stage import stage
from miricigale.workflow.stages.fits import FIT_SECTIONS, fit_mock, fit_sample, true_ranks
from miricigale.workflow.stages.inputs import fit_plan, plain_axes, sed_resources
from miricigale.workflow.stages.sample import is_sample
from miricigale.workflow.truths import study_truths, unit_names

#: Most sources of each truth that are fitted with a freed torus.
N_FREE = 100
#: Error of the light of AGN in the fits between the nodes.
AGN_ERROR = 0.3
#: Parameters whose posteriors are ranked.
RANKED = ("redshift", "frac_agn")
#: What Yang et al. 2021 fix, freed; the fixed values (70 deg, 1, 1) are nodes or within. To stay below
#: a hundred million models the other axes of the AGN are thinner than in the study.
_FREED = {"inclination": (60.0, 70.0, 90.0), "p": (0.0, 1.0), "q": (0.0, 1.0)}
_THINNER = {
    "tau97": (3.0, 7.0, 11.0),
    "ebv_polar": (0.0, 0.1, 0.3),
    "temperature_polar": (100.0, 300.0),
}


def experiment_units(config):
    """Return the names of the experiments, ``<truth>/<experiment>``, of the truths without perturbations."""
    unperturbed = [name for name, truth in study_truths(config).items() if not truth.perturbations]
    return unit_names(unperturbed, config.fit.experiments)


def experiment_axes(name, config):
    """Return the axes of the grid of an experiment of a study."""
    axes = fit_plan(config, name)
    if name == "free_agn":
        if config.fit.axes == "fit":
            axes |= _THINNER
        axes |= _FREED
    return axes


def _experiment_plan(config, unit):
    """Return what an experiment takes from the package, for hashing."""
    name = unit.partition("/")[2]
    plan = {"axes": plain_axes(experiment_axes(name, config))}
    if name == "free_agn":
        plan["n"] = N_FREE
    elif name == "between":
        plan["agn_error"] = AGN_ERROR
    elif name == "far_infrared":
        plan["depths"] = dict(HERSCHEL_DEPTHS)
    return plan


def far_infrared_photometry(sample, *, seed):
    """
    Simulate photometry of sources in the bands of Herschel, with the depths of `HERSCHEL_DEPTHS`.

    ``sample`` has the parameters of the model and ``id``; errors are depth / 5 and 10 % of the flux.
    """
    model = sed.SEDModel.yang2021()
    bands = list(HERSCHEL_DEPTHS)
    parameters = [name for name in sample.colnames if name in model.parameters]
    light = model.fluxes(sample["id", *parameters], bands)
    errors = photometry.ErrorModel.from_depths(HERSCHEL_DEPTHS, fractional=0.1)
    light["id"] = sample["id"]
    return errors.perturb(light["id", *bands], seed=seed)


@stage(
    "experiments",
    "further fit",
    needs=("truth", "matches"),
    sections=FIT_SECTIONS,
    resources=sed_resources,
    plan=_experiment_plan,
    units=experiment_units,
)
def fit_experiment(context, unit):
    """Fit the sample of a truth, with all MIRI bands, in another way than the study does."""
    plan = context.plan
    truth_name, name = unit.split("/")
    truth, matched, mock = fit_sample(context, truth_name)
    sample = truth[is_sample(matched)]
    if "n" in plan and len(mock) > plan["n"]:
        rows = np.linspace(0, len(mock) - 1, plan["n"]).round().astype(int)
        mock = mock[rows]
        sample = sample[rows]
    bands = list(context.config.exposures.filters)
    redshift = None
    options = {"axes": convert_values(np.array, plan["axes"])}
    if name == "far_infrared":
        light = far_infrared_photometry(sample, seed=context.seed)
        bands += list(HERSCHEL_DEPTHS)
        for column in light.colnames:
            mock[column] = light[column]
    elif name == "known_redshift":
        redshift = floats(sample["redshift"])
    elif name == "no_model_error":
        options["model_error"] = 0.0
    elif name == "between":
        options["settings"] = GridSettings(agn_error=AGN_ERROR)
    results = fit_mock(context, mock, bands, redshift=redshift, **options)
    place = f"{truth_name}/experiments/{name}"
    context.save_result(f"{place}.fits", results)
    context.save_table(f"{place}.ecsv", ranked_table(results, sample, context.seed))


def ranked_table(results, sample, seed):
    """Return the table of results with the ranks of the true values (``<name>_rank``), for coverage."""
    table = results.to_table()
    for name in RANKED:
        rank = nans(len(table))
        # at known redshifts they have no odds
        if len(table) and (name != "redshift" or "redshift_odds" in table.colnames):
            rank = true_ranks(results, sample, name, seed)
        table[f"{name}_rank"] = rank
        table[f"{name}_rank"].info.description = "Rank of the true value in the posterior"
    return table


def experiment_numbers(sample, table):
    """
    Measure how well the sources of a table of fits are recovered.

    Parameters
    ----------
    sample : `~astropy.table.QTable`
        The truth, with at least the sources of the table.
    table : `~astropy.table.QTable`
        Of the stage, or of the fits of the study with ranks.

    Returns
    -------
    numbers : dict of str to float
        ``n``; ``photoz_sigma_mad`` and ``photoz_outliers`` (NaN where redshifts were known);
        ``frac_agn_bias``, ``frac_agn_sigma_mad`` and ``frac_agn_width`` (median posterior width);
        ``power_bias`` and ``power_sigma_mad`` in dex of sources with an AGN; ``redshift_coverage`` and
        ``frac_agn_coverage``, shares of true values in the central 68 %.
    """
    true = rows_of(sample, table["id"])
    photoz = photoz_metrics(true["redshift"], table["redshift_mean"])
    fraction = recovery_metrics(true["frac_agn"], table["frac_agn_mean"])
    width = floats(table["frac_agn_std"])
    width = finite_values(width)
    power = nans(len(true))
    if "accretion_power" in true.colnames and "accretion_power_mean" in table.colnames:
        with quiet_division():
            power = np.log10(table["accretion_power_mean"] / true["accretion_power"]).value
    power = recovery_metrics(np.zeros(power.size), power)
    numbers = {
        "n": photoz.n,
        "photoz_sigma_mad": photoz.sigma_mad,
        "photoz_outliers": photoz.outlier_fraction,
        "frac_agn_bias": fraction.median,
        "frac_agn_sigma_mad": fraction.sigma_mad,
        "frac_agn_width": float(np.median(width)) if width.size else np.nan,
        "power_bias": power.median,
        "power_sigma_mad": power.sigma_mad,
    }
    if not np.isfinite(table["redshift_rank"]).any():
        # redshifts were not fitted
        numbers["photoz_sigma_mad"] = np.nan
        numbers["photoz_outliers"] = np.nan
    for name in RANKED:
        rank = floats(table[f"{name}_rank"])
        numbers[f"{name}_coverage"] = interval_share(rank)
    return numbers
