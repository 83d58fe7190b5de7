"""Results of fits with continuous parameters: exact moments, and the samples themselves."""

from dataclasses import dataclass

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.fitting.flags import FitFlags
from miricigale.fitting.posterior import check_levels
from miricigale.fitting.quantities import kept_percentiles
from miricigale.fitting.results import FitResults
from miricigale.utils.exceptions import argument_error

__all__ = ["ContinuousResults"]


@dataclass(frozen=True, eq=False, repr=False)
class ContinuousResults(FitResults):
    """
    Posteriors that a sampler found, with everything that `FitResults` offers.

    ``axes`` are cells of the priors, ``pdf`` the weight of the sample in each; means, standard
    deviations and percentiles come from the sample itself and not from the cells.
    ``best_index`` is -1, there being no grid, and ``log_evidence`` is the sampler's.

    Parameters
    ----------
    axis_moments : `~numpy.ndarray`, shape (n, n_axes, 2)
        Mean and standard deviation of the parameters of ``axes``.
    axis_quantiles : `~numpy.ndarray`, shape (n, n_axes, n_levels)
        Their quantiles at `miricigale.fitting.quantities.DERIVED_LEVELS`.
    draws : `~numpy.ndarray`, shape (n, n_draws, n_parameters)
        Draws of equal weight of all `parameters`.
    log_evidence_err : `~numpy.ndarray`, shape (n,)
        Error of ``log_evidence``.
    n_calls : `~numpy.ndarray` of int, shape (n,)
        Models evaluated.
    n_effective : `~numpy.ndarray`, shape (n,)
        Effective sizes of the samples.
    converged : `~numpy.ndarray` of bool, shape (n,)
        Whether the sampler finished before ``max_calls``.
    """

    axis_moments: np.ndarray = None
    axis_quantiles: np.ndarray = None
    draws: np.ndarray = None
    log_evidence_err: np.ndarray = None
    n_calls: np.ndarray = None
    n_effective: np.ndarray = None
    converged: np.ndarray = None

    def _axis(self, name):
        return list(self.axes).index(name)

    def _moments(self, name):
        if name not in self.axes:
            return super()._moments(name)
        return tuple(self.axis_moments[:, self._axis(name)].T)

    def percentile(self, name, levels):
        """
        Posterior percentiles.

        Parameters
        ----------
        name : str
            A parameter or derived quantity.
        levels : array_like
            Levels from 0.001 to 0.999, between which the distributions are kept.

        Returns
        -------
        percentiles : `~astropy.units.Quantity`, shape (n, n_levels)

        Raises
        ------
        KeyError
            If there is no such parameter.
        ValueError
            If a level is outside.
        """
        if name not in self.axes:
            return super().percentile(name, levels)
        kept = self.axis_quantiles[:, self._axis(name)]
        return kept_percentiles(name, check_levels(levels), kept) * self.unit(name)

    def samples(self, key):
        """
        Draws from the posterior of one object.

        Parameters
        ----------
        key : object
            Its id.

        Returns
        -------
        table : `~astropy.table.QTable`
            A row for each draw, all of the same weight; a column for each parameter and derived
            quantity.

        Raises
        ------
        ValueError
            If the object was not fitted.
        """
        row = self.row(key)
        if not np.isfinite(self.chi2[row]):
            names = ", ".join(FitFlags.names(self.flags[row]))
            raise argument_error("key", "the id of an object that was fitted", f"{key!r} ({names})")
        out = QTable(meta=dict(self.meta) | {"id": str(key)})
        for i, name in enumerate(self.parameters):
            out[name] = u.Quantity(self.draws[row, :, i], self.unit(name))
            out[name].info.description = self._meaning(name)
        return out

    def to_table(self):
        """
        Results as a table.

        Returns
        -------
        table : `~astropy.table.QTable`
            As of `FitResults.to_table`, and ``log_evidence_err``, ``n_calls``, ``n_effective``
            and ``converged``.
        """
        out = super().to_table()
        at = out.colnames.index("log_evidence") + 1
        columns = {
            "log_evidence_err": (self.log_evidence_err, "its 1-sigma error"),
            "n_calls": (self.n_calls, "models evaluated"),
            "n_effective": (self.n_effective, "effective size of the sample"),
            "converged": (self.converged, "whether the sampler finished"),
        }
        for i, (name, (values, text)) in enumerate(columns.items()):
            out.add_column(np.array(values), name=name, index=at + i)
            out[name].info.description = text
        return out
