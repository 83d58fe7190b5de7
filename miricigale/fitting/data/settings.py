"""Settings of the two ways to find a posterior: the sum over a grid, and a sampler."""

from dataclasses import dataclass, field

from miricigale.fitting.data.agn_bins import AGNBins
from miricigale.sed import SEDModel
from miricigale.utils.options import check_that
from miricigale.utils.units import check_count, is_number

#: Largest effective number of models between the nodes for an object.
_MAX_MODELS = 20_000


@dataclass(frozen=True)
class GridSettings:
    """
    How `BayesFitter` sums over a grid.

    Parameters
    ----------
    prior_f : {"grid", "uniform"}, optional
        Prior of a grid's AGN fractions: equal for all values of the grid (so that f = 0, which is
        evaluated once for each galaxy, carries the summed weight of all AGN templates), or by the
        width of their cells.
    redshift_tolerance : float, optional
        How far, in abs(dz) / (1 + z), a fixed redshift may lie from its node of the grid; half the
        distance of the nodes by default.
    rtol : float, optional
        Largest relative error of posterior weights, means and standard deviations that leaving
        out models may cause; 0 evaluates every model.
    sfr_prior : tuple, optional
        A function of stellar mass and redshift (a `~astropy.units.Quantity`, and an array that
        broadcasts with it) to a star-formation rate, and a scatter in dex. The prior of the galaxies of each
        redshift is multiplied by that log-normal distribution of their rate over the last 100 Myr, at the mass
        that fits best without AGN, and keeps its sum.
    mass_function : callable, optional
        A function of stellar mass (a `~astropy.units.Quantity`) and redshift, which broadcast, to a density for
        each dex of mass and comoving volume, with any factor, such as `MassFunction`. Times the comoving volume it
        multiplies the priors of galaxies and redshifts, at the mass of each model between nodes, and at the one
        that fits best without AGN on nodes alone (to 0.01 dex). Priors of redshift (``priors``,
        ``redshift_prior``) multiply it too: leave them flat, or volume counts twice.
    interpolate : int, optional
        Effective number of models between the nodes for each object, with fluxes interpolated from the nodes
        around, by adaptive importance sampling (Cornuet et al. 2012); posteriors and percentiles are theirs. 80
        times as many models are evaluated at most (at least 16,384); objects for which that is not enough are
        flagged ``NOT_CONVERGED``. Percentiles scatter by some 1.5 half-widths over the root of it; where a
        percentile lies between two peaks up to four times the number is taken. Chi2, best
        models and evidences are those of these models too, at known redshifts at those of the catalog. 0: the
        nodes alone, as with ``compat="cigale"`` and for templates.
    finer : `~miricigale.sed.SEDModel`, optional
        With ``interpolate``: the model that made the grid, of which a finer grid is made, between whose nodes
        fluxes are good to 0.5 % along each axis. Not needed where a model is fitted. Without it fluxes are
        interpolated from the grid's own nodes, and intervals are too narrow where its cells are wide.
    agn_error : float, optional
        With ``interpolate``: error of the light of AGN as a part of it. In each band it counts by the share that
        the AGN has of a model, of the measured flux, beside all other errors, in the choice of the best model and
        in evidences too; ``chi2`` is without it, and so are grids of templates, which have no AGN. The shapes of
        tori are known less well than those of galaxies: 0.3 where AGN outshine them.
    agn_bins : `~miricigale.fitting.AGNBins`, optional
        With ``interpolate``: bins in which the joint posterior of redshift, AGN fraction and luminosity is kept,
        ``agn_weights`` of the results.
    nuclear_stars : float, optional
        With fluxes of nuclei: standard deviation of the part of the light of a host, with its color, that is a
        point in the center and not in the template that the total was measured with, such as a bulge redder than
        the disk.

    Raises
    ------
    ValueError
        If a value is of the wrong kind, or goes with another one that was not given.

    Examples
    --------
    >>> from miricigale.fitting import GridSettings
    >>> GridSettings(prior_f="uniform", redshift_tolerance=0.05)
    GridSettings(prior_f='uniform', ...)
    """

    prior_f: str = "grid"
    redshift_tolerance: float | None = None
    rtol: float = 1e-6
    sfr_prior: tuple | None = None
    mass_function: object = None
    interpolate: int = 600
    finer: SEDModel | None = None
    agn_error: float = 0.0
    agn_bins: object = None
    nuclear_stars: float = 0.1

    def __post_init__(self):
        def check(name, good, wanted):
            check_that(good, name, wanted, repr(getattr(self, name)))

        tolerance = self.redshift_tolerance
        agn_err = self.agn_error
        finer = self.finer
        check("rtol", is_number(self.rtol) and 0 <= self.rtol < 0.1, "in [0, 0.1)")
        is_tolerance = tolerance is None or (is_number(tolerance) and tolerance >= 0)
        check("redshift_tolerance", is_tolerance, ">= 0")
        n_models = check_count(self.interpolate, "interpolate", least=0)
        check("interpolate", n_models <= _MAX_MODELS, f"at most {_MAX_MODELS}")
        is_valid = is_number(agn_err) and agn_err >= 0 and (n_models or not agn_err)
        check("agn_error", is_valid, "0 or more, and 0 without 'interpolate'")
        check("agn_bins", isinstance(self.agn_bins, AGNBins | None), "AGNBins or None")
        stars = self.nuclear_stars
        check("nuclear_stars", is_number(stars) and 0 <= stars < 10, "in [0, 10)")
        wanted = "None without 'interpolate'"
        if n_models:
            wanted = "an SEDModel"
        check("finer", finer is None or (n_models and isinstance(finer, SEDModel)), wanted)


@dataclass(frozen=True)
class SamplerSettings:
    """
    How `BayesFitter` samples, and what it keeps of a sample.

    Parameters
    ----------
    predict : list of str or `~miricigale.filters.FilterSet`, optional
        More bands, in which the fluxes of the models are predicted.
    n_live : int, optional
        Number of live points; more for posteriors of several narrow peaks.
    n_effective : int, optional
        Effective size that the sample shall have (nautilus; dynesty's follows from ``n_live``).
    max_calls : int, optional
        Number of models evaluated for one object after which the sampler stops, finished or not (dynesty counts
        the steps of its walkers, some of which leave the prior); see ``converged`` of the results.
    n_draws, n_cells : int, optional
        Draws of equal weight that are kept of a sample (see `FitResults.samples`), and cells of each
        axis, for PDFs and plots.
    options : dict, optional
        Passed to the sampler.

    Raises
    ------
    TypeError, ValueError
        If a number is not a whole number, or too small.

    Examples
    --------
    >>> from miricigale.fitting import SamplerSettings
    >>> SamplerSettings(n_live=1000, options={"n_networks": 4})
    SamplerSettings(..., n_live=1000, ...)
    """

    predict: tuple = ()
    n_live: int = 500
    n_effective: int = 2000
    max_calls: int = 500_000
    n_draws: int = 1000
    n_cells: int = 100
    options: dict = field(default_factory=dict)

    def __post_init__(self):
        minima = {"n_live": 10, "n_effective": 1, "max_calls": 1, "n_draws": 1, "n_cells": 2}
        for name, minimum in minima.items():
            check_count(getattr(self, name), name, minimum)
