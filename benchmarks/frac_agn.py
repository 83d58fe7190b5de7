"""
How well the fits of a study recover AGN fractions, and on what it depends: photometry without images.

    python benchmarks/frac_agn.py                                  all cases at fracAGN 0
    python benchmarks/frac_agn.py --cases run --frac-agn 0.2 0.6   some of them with AGN
    python benchmarks/frac_agn.py --sets all none --seeds 4        with and without MIRI, four draws together
    python benchmarks/frac_agn.py --libraries FOLDER               and cases with the paper's libraries

Galaxies of the bundled catalog within 54 arcsec of the pointing of `goodss` get the SEDs of the workflow
(best fits, scaled to F160W) and Gaussian noise in 15 existing bands and six of MIRI. Those detected (5
sigma) in two or more of the six are fitted on the 24 million models of Yang et al. 2021. The first case has
the limits of a run of `goodss`, and 3 % of the flux as error besides; each other case changes one thing or
two. FOLDER has dale2014/ and skirtor2016/ as `miricigale data add` takes them; they are registered in a
temporary folder. The torus has q = 0 with them, for which spectra of SKIRTOR are freely distributed.

Each fit gives a line: galaxies; share of those with H < 26 and H < 25 that are detected; median and
sigma_MAD of the posterior means of fracAGN less the true one, and the median posterior width; mean weight
of fracAGN = 0; share of best models with it; share in the true class; sigma_MAD and outliers of the
redshifts; offset and scatter (dex) of the accretion power. About 10 s a line, 200 MB.
"""

import argparse
import contextlib
import dataclasses
import functools
import tempfile
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable, vstack

from miricigale import conf
from miricigale.depth import proposal_limit, scaled_limit
from miricigale.evaluation import (
    classify,
    main_sequence_dust,
    photoz_metrics,
    recovery_metrics,
)
from miricigale.fitting import BayesFitter, GridSettings
from miricigale.instrument import CEERS_FILTERS, ceers_exposures
from miricigale.photometry import YANG2021_DEPTHS, ErrorModel
from miricigale.refdata.libraries import add_library
from miricigale.scene import read_catalog
from miricigale.sed import SEDModel
from miricigale.sed import components as parts
from miricigale.utils.random import stream
from miricigale.utils.tables import error_column
from miricigale.workflow.stages.inputs import input_axes, input_bands
from miricigale.workflow.stages.truth import add_agn

CENTER = SkyCoord(53.13440, -27.83444, unit="deg")
PRIOR = "wfc3.f160w"
BANDS = [*YANG2021_DEPTHS, *CEERS_FILTERS]
AXES = SEDModel.yang2021_axes("fit")
ALPHAS = tuple(AXES["alpha"].tolist())
#: Bands of MIRI that are fitted.
SETS = {"all": CEERS_FILTERS, "none": (), "blue": CEERS_FILTERS[:3], "red": CEERS_FILTERS[3:]}
#: 5-sigma limits (AB) of the error functions of a run of `goodss`.
RUN_LIMITS = dict(zip(CEERS_FILTERS, (26.26, 25.24, 24.52, 24.12, 23.34, 23.24), strict=True))
TORUS = {"p": 1.0, "opening_angle": 40.0, "radius_ratio": 20.0}


@dataclasses.dataclass(frozen=True)
class Case:
    """Truths, noise and fit of one experiment; the defaults are those of a run of `goodss`."""

    alpha: tuple = (1.5, 2.5)  # range of the truths' alpha
    nodes: tuple = ()  # or the values that it is drawn from
    refitted: bool = False  # or truths are best fits to the existing bands, alpha too
    redshift_nodes: bool = False  # whether true redshifts are nodes of the grid
    agn_nodes: tuple = ()  # parameters of true AGN that are those of the grid's templates
    main_sequence: bool = False  # whether dust luminosities are those of the main sequence
    dust: str = "bundled"  # of truth and fit: bundled or library
    torus: str = "bundled"
    dust_of_fit: str = ""  # of the fit, if another
    limits: str = "run"  # of MIRI: run, etc or proposal
    sample: str = ""  # limits that decide about the sample, if others
    deeper: float = 0.0  # magnitudes
    error_scale: float = 1.0  # errors of MIRI over the noise
    noise: bool = True
    model_error: float = 0.1
    prior_f: str = "grid"
    fixed_redshift: bool = False
    interpolate: int = 0  # models between the nodes, as in the runs none
    agn_error: float = 0.0  # of the AGN's light, between the nodes


#: Parameters of the AGN: the value that the fit fixes, or None for its nodes.
AGN_FIXED = {
    "inclination": 70.0,
    "p": 1.0,
    "q": 1.0,
    "emissivity_polar": 1.6,
    "ebv_polar": None,
    "temperature_polar": None,
}
POLAR = tuple(name for name in AGN_FIXED if name.endswith("polar"))


def all_but(*names):
    """Parameters of the AGN without some."""
    return tuple(name for name in AGN_FIXED if name not in names)


LIBRARIES = {"dust": "library", "torus": "library"}
CASES = {
    "run": Case(),
    # the truths' dust
    **{f"alpha-{value}": Case(nodes=(value,)) for value in ALPHAS},
    "alpha-wide": Case(alpha=(ALPHAS[0], ALPHAS[-1])),
    "main-sequence": Case(main_sequence=True),
    # truths on the nodes of the grid
    "redshift-nodes": Case(redshift_nodes=True),
    "alpha-nodes": Case(nodes=ALPHAS),
    "all-nodes": Case(nodes=ALPHAS, redshift_nodes=True, agn_nodes=all_but()),
    "agn-nodes": Case(agn_nodes=all_but()),
    # one property of the true AGN drawn, the others on the nodes
    "agn-inclination": Case(agn_nodes=all_but("inclination")),
    "agn-p": Case(agn_nodes=all_but("p")),
    "agn-q": Case(agn_nodes=all_but("q")),
    "agn-polar": Case(agn_nodes=all_but(*POLAR)),
    "refitted": Case(refitted=True),
    # libraries, and others in the truth than in the fit
    "dale": Case(dust="library"),
    "skirtor": Case(torus="library"),
    "libraries": Case(**LIBRARIES),
    "libraries-nodes": Case(nodes=ALPHAS, redshift_nodes=True, **LIBRARIES),
    "libraries-refitted": Case(refitted=True, **LIBRARIES),
    "libraries-alpha-1.0": Case(nodes=(1.0,), **LIBRARIES),
    "dust-differs": Case(dust="library", dust_of_fit="bundled"),
    # limits, sample, noise, and errors that are medians as in the paper
    "etc-limits": Case(limits="etc"),
    "proposal-limits": Case(limits="proposal"),
    "proposal-refitted": Case(limits="proposal", refitted=True),
    "proposal-alpha-1.0": Case(limits="proposal", nodes=(1.0,)),
    "proposal-alpha-nodes": Case(limits="proposal", nodes=ALPHAS),
    # limits of the paper are up to a magnitude shallower than these
    "half-mag-shallower": Case(limits="proposal", nodes=ALPHAS, deeper=-0.5),
    "one-mag-shallower": Case(limits="proposal", nodes=ALPHAS, deeper=-1.0),
    "proposal-libraries-alpha-1.0": Case(limits="proposal", nodes=(1.0,), **LIBRARIES),
    "proposal-sample": Case(sample="proposal"),
    "one-mag-deeper": Case(deeper=1.0, sample="run"),
    "no-noise": Case(noise=False),
    "median-errors": Case(error_scale=0.6745),
    # model error, prior, redshift
    "model-error-5": Case(model_error=0.05),
    "model-error-0": Case(model_error=0.0),
    "nodes-model-error-0": Case(nodes=ALPHAS, redshift_nodes=True, model_error=0.0),
    "prior-uniform": Case(prior_f="uniform"),
    "redshift-fixed": Case(fixed_redshift=True),
    # between the nodes, with an error of the light of AGN
    "between": Case(interpolate=200),
    **{
        f"agn-error-30-model-error-{100 * e:.0f}": Case(
            interpolate=200, agn_error=0.3, model_error=e
        )
        for e in (0.02, 0.05)
    },
    **{
        f"agn-error-{100 * e:.0f}": Case(interpolate=200, agn_error=e) for e in (0.1, 0.2, 0.3, 0.5)
    },
}


def model_of(dust, torus):
    """The chain of the paper with bundled tables, or with libraries that are registered."""
    library = torus == "library"
    kind, q = (parts.Skirtor2016, 0.0) if library else (parts.ParametricTorus, 1.0)
    return SEDModel([
        parts.DelayedSFH(),
        parts.BC03(),
        parts.CalzettiLeitherer(),
        parts.Dale2014() if dust == "library" else parts.DraineLi2007Alpha(),
        parts.Meiksin2006(),
        kind(q=q, **TORUS),
    ])  # fmt: skip


def nearest(values, nodes):
    """The nearest of the nodes to each value."""
    values = np.asarray(getattr(values, "value", values), float)
    return nodes[np.argmin(np.abs(values[:, None] - nodes), axis=1)]


def best_galaxies(model, photometry, bands, axes):
    """Table of the fits of galaxies without AGN at their redshifts."""
    nodes = np.unique(np.round(photometry["redshift"], 2))
    axes = axes | {"redshift": nodes[nodes > 0]}
    fitter = BayesFitter(model, bands, axes=axes, settings=GridSettings(redshift_tolerance=0.01))
    return fitter.fit(photometry, redshift="redshift").to_table()


@functools.cache
def galaxies():
    """Best fits to the catalog, as the stage "input SEDs" makes them."""
    catalog = read_catalog("catalog.goodss")
    redshift = np.asarray(catalog["redshift"], float)
    good = catalog["sky"].separation(CENTER) < 54 * u.arcsec
    good &= (np.asarray(catalog["mag_f160w"]) < 26.6) & ~np.asarray(catalog["star"], bool)
    good &= (redshift > AXES["redshift"][0]) & (redshift < AXES["redshift"][-1])
    catalog = catalog[good]
    bands = list(input_bands(catalog, 3.0)[0])
    photometry = QTable({"id": catalog["id"], "redshift": redshift[good]})
    for name in bands:
        photometry[name] = catalog[name]
        photometry[error_column(name)] = 0.05 * np.abs(catalog[name])
    best = best_galaxies(
        SEDModel.yang2021(agn=False, libraries="bundled"), photometry, bands, input_axes("galaxy")
    )
    table = QTable({name: best[f"{name}_best"] for name in ("tau", "age", "ebv", "mass")})
    table["id"], table["redshift"], table[PRIOR] = catalog["id"], redshift[good], catalog[PRIOR]
    return table


def refit(table, model, seed):
    """Replace parameters by those of the best fits to the existing bands with their noise."""
    bands = list(YANG2021_DEPTHS)
    light = model.fluxes(table, bands)
    light["id"] = table["id"]
    photometry = ErrorModel.yang2021().perturb(light[["id", *bands]], seed=seed + 1000)
    photometry["redshift"] = table["redshift"]
    galaxy = SEDModel([part for part in model.components if part.role != "agn"])
    best = best_galaxies(galaxy, photometry, bands, input_axes("galaxy", dust=True))
    for name in ("tau", "age", "ebv", "alpha", "mass"):
        table[name] = best[f"{name}_best"]


def make_truth(case, frac_agn, seed):
    """Parameters and fluxes of the sky."""
    table = galaxies().copy()
    measured = table[PRIOR]
    table.remove_column(PRIOR)
    table["frac_agn"] = np.zeros(len(table))
    model = model_of(case.dust, case.torus)
    draws = [stream(seed, "truth", "alpha", str(key)) for key in table["id"]]
    if case.nodes:
        table["alpha"] = [draw.choice(case.nodes) for draw in draws]
    else:
        table["alpha"] = [draw.uniform(*case.alpha) for draw in draws]
    if case.refitted:
        refit(table, model, seed)
    if case.redshift_nodes:
        table["redshift"] = nearest(table["redshift"], AXES["redshift"])
    # the galaxy has the flux that was measured
    table["mass"] = table["mass"] * (measured / model.fluxes(table, [PRIOR])[PRIOR]).to_value(u.one)
    if case.main_sequence:
        light = model.fluxes(table, [PRIOR])
        light["redshift"] = table["redshift"]
        table["dust_excess"] = main_sequence_dust(light, seed=seed)["dust_excess"]
    if frac_agn > 0:
        add_agn(table, frac_agn, seed)
        for name in case.agn_nodes:
            fixed = AGN_FIXED[name]
            table[name] = nearest(table[name], AXES[name]) if fixed is None else fixed
        if case.torus == "library":
            table["p"], table["q"] = 1.0, 0.0
    light = model.fluxes(table, BANDS)
    for name in (*BANDS, "accretion_power"):
        table[name] = light[name]
    return table


@functools.cache
def limits_of(name):
    """5-sigma limits (AB magnitudes) of the bands of MIRI."""
    if name == "run":
        return RUN_LIMITS
    if name == "proposal":
        return {band: proposal_limit(band).value for band in CEERS_FILTERS}
    times = dict.fromkeys(CEERS_FILTERS, 0 * u.s)
    for exposure in ceers_exposures(CENTER, 0 * u.deg):
        times[exposure.filter] = times[exposure.filter] + exposure.exposure_time
    return {band: scaled_limit(band, time).to_value(u.ABmag) for band, time in times.items()}


def observe(truth, limits, seed, *, deeper=0.0, error_scale=1.0):
    """Photometry with noise, and which sources are detected in two bands of MIRI."""
    depths = {band: limit + deeper for band, limit in limits_of(limits).items()}
    errors = ErrorModel.yang2021() | ErrorModel.from_depths(depths, fractional=0.03)
    table = errors.perturb(truth[["id", *BANDS]], seed=seed)
    for band in CEERS_FILTERS:
        table[error_column(band)] *= error_scale
    detected = sum(np.asarray(table[b] > 5 * table[error_column(b)], int) for b in CEERS_FILTERS)
    return table, detected >= 2


@functools.cache
def fitter_of(dust, torus, miri, model_error, **options):
    """The fitter with a set of the bands of MIRI, kept for the next case."""
    bands = [*YANG2021_DEPTHS, *SETS[miri]]
    settings = GridSettings(**options)
    model = model_of(dust, torus)
    return BayesFitter(model, bands, axes=AXES, model_error=model_error, settings=settings)


def fit(case, frac_agn, miri, seed):
    """A row for each source: detected or not, true and found values (NaN if not fitted)."""
    truth = make_truth(case, frac_agn, seed)
    photometry, detected = observe(
        truth, case.limits, seed, deeper=case.deeper, error_scale=case.error_scale
    )
    table = QTable({"detected": detected, "magnitude": truth[PRIOR].to_value(u.ABmag)})
    if case.sample:
        detected = detected & observe(truth, case.sample, seed)[1]
    if not case.noise:
        for band in BANDS:
            photometry[band] = truth[band]
    options = {name: getattr(case, name) for name in ("prior_f", "interpolate", "agn_error")}
    dust = case.dust_of_fit or case.dust
    fitter = fitter_of(dust, case.torus, miri, case.model_error, **options)
    truth = truth[detected]
    known = nearest(truth["redshift"], AXES["redshift"]) if case.fixed_redshift else None
    results = fitter.fit(photometry[detected], redshift=known)
    found = results.to_table()
    low, high = results.percentile("redshift", (0.16, 0.84)).value.T
    inside = (truth["redshift"] >= low) & (truth["redshift"] <= high)
    true = truth["accretion_power"] if frac_agn > 0 else np.nan * u.W
    values = {
        "frac": found["frac_agn_mean"],
        "width": found["frac_agn_std"],
        "zero": results.pdf["frac_agn"][:, 0],
        "best": found["frac_agn_best"] == 0,
        "z_true": truth["redshift"],
        "z": found["redshift_mean"],
        "inside": inside,
        "power": (found["accretion_power_mean"] / true).to_value(u.one),
    }
    for name, column in values.items():
        table[name] = np.full(len(table), np.nan)
        table[name][detected] = np.asarray(column, float)
    return table


def line(name, frac_agn, miri, table):
    """The numbers of a fit."""
    shares = [np.mean(table["detected"][table["magnitude"] < limit]) for limit in (26, 25)]
    table = table[np.isfinite(table["frac"])]
    frac = recovery_metrics(np.full(len(table), frac_agn), table["frac"])
    z = photoz_metrics(table["z_true"], table["z"])
    right = classify(np.asarray(table["frac"])) == classify([frac_agn])[0]
    text = (
        f"{name:29s} {frac_agn:4.2f} {miri:4s} {frac.n:5d} {shares[0]:4.2f} {shares[1]:4.2f} "
        f"{frac.median:+7.4f} {frac.sigma_mad:7.4f} {np.median(table['width']):6.3f} "
        f"{np.mean(table['zero']):5.2f} {np.mean(table['best']):5.2f} {np.mean(right):5.2f} "
        f"{z.sigma_mad:7.4f} {z.n_outliers:3d} ({100 * z.outlier_fraction:4.1f} %) "
        f"{100 * np.mean(table['inside']):3.0f} %"
    )
    if frac_agn > 0:
        power = recovery_metrics(np.zeros(len(table)), np.log10(table["power"]))
        text += f" {power.median:+6.2f} {power.sigma_mad:5.2f}"
    return text


HEADER = (
    f"{'case':29s} {'f':>4s} {'MIRI':4s} {'n':>5s} {'H<26':4s} {'<25':>4s} {'median':>7s} {'scatter':7s} "
    f"{'width':>6s} {'P(0)':>5s} best0 class {'dz':>7s} outliers     68 %  power"
)


def register(folder, data):
    """Register the libraries of a folder in another data folder, in this process."""
    conf.data_folder = data
    add_library("dust.dale2014", Path(folder, "dale2014"))
    tori = Path(folder, "skirtor2016")
    add_library("torus.skirtor2016", next(tori.glob("*.fits.gz"), tori))


def main():
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--libraries", help="folder with dale2014/ and skirtor2016/")
    parser.add_argument("--cases", nargs="+", choices=CASES, metavar="CASE", help=", ".join(CASES))
    parser.add_argument("--frac-agn", nargs="+", type=float, default=[0.0])
    parser.add_argument("--sets", nargs="+", choices=SETS, default=["all"], help="bands of MIRI")
    parser.add_argument("--seeds", type=int, default=1, help="draws that are put together")
    args = parser.parse_args()
    cases = {name: CASES[name] for name in args.cases or CASES}
    if not args.libraries:
        cases = {n: c for n, c in cases.items() if "library" not in (c.dust, c.torus)}
    print(HEADER, flush=True)
    with contextlib.ExitStack() as stack:
        if args.libraries:
            register(args.libraries, stack.enter_context(tempfile.TemporaryDirectory()))
        for name, case in cases.items():
            for frac_agn in args.frac_agn:
                for miri in args.sets:
                    tables = [fit(case, frac_agn, miri, seed) for seed in range(1, args.seeds + 1)]
                    print(line(name, frac_agn, miri, vstack(tables)), flush=True)


if __name__ == "__main__":
    main()
