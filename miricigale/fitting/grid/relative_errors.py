"""
Errors of bands that are a part of the flux, where the measured flux is too uncertain to say how large they are.

Forced photometry in MIRI images scatters by a part of the flux (`miricigale.fitting.survey.band_errors`). A part
of the *measured* flux is smallest where a flux came out too low, so that low fluxes would count more than high
ones and pull redshifts. The part is therefore of the flux that the other bands and the band itself say together.
"""

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from miricigale.fitting.grid.grid import GridEngine
from miricigale.fitting.grid.node_fluxes import FluxMoments
from miricigale.fitting.grid.node_scan import NodeScan
from miricigale.utils.units import Frozen

#: Models drawn for each object: means are good to a tenth of the standard deviation.
_N_DRAWS = 128
#: Least number of other bands from which a flux is predicted.
_LEAST_BANDS = 4


@dataclass(frozen=True, eq=False)
class RelativeErrors(Frozen):
    r"""
    Adds errors that are a part of the flux in some bands to those of photometry.

    The other bands predict the flux m with the standard deviation s, by a scan of the nodes. The measured flux is
    d, its error :math:`\sigma`, and t and p are the errors of the models and of the band as parts of the flux.
    Then p is a part of the mean of m and d, weighted with their variances :math:`s^2 + (t m)^2` and
    :math:`\sigma^2 + (p m)^2`; it is not below 0.

    Parameters
    ----------
    engine : `~miricigale.fitting.grid.grid.GridEngine`
        Models, priors and errors of models.
    part : `~numpy.ndarray`, shape (nb,)
        Errors as parts of the flux, 0 in the bands that predict.
    """

    engine: GridEngine
    part: np.ndarray

    @cached_property
    def _scan(self):
        # neither wrong fluxes nor a prior of rates: a flux within some per cent is enough
        engine = dataclasses.replace(self.engine, mixture=None, mass_prior=None)
        # tables depend on neither
        engine.__dict__["tables"] = self.engine.tables
        return NodeScan(engine, _N_DRAWS)

    def add_to(self, data, log_prior):
        """
        Add the errors to those of photometry.

        Parameters
        ----------
        data : `~miricigale.fitting.data.likelihood.FitData`
            Photometry of n objects without these errors.
        log_prior : `~numpy.ndarray`, shape (n, nz)
            Ln of the prior of each redshift of the grid.

        Returns
        -------
        data : `~miricigale.fitting.data.likelihood.FitData`
            With larger errors in the bands with a part. It is one of the measured flux for objects that have fewer
            than four other fluxes or that no model fits. Upper limits keep their errors.
        """
        has_part = data.measured & (self.part > 0)
        if not has_part.any():
            return data
        size = np.where(has_part, np.abs(data.flux), 0.0)
        is_other = data.measured & (self.part == 0)
        rows = has_part.any(axis=1)
        rows &= np.count_nonzero(is_other, axis=1) >= _LEAST_BANDS
        rows &= np.isfinite(log_prior).any(axis=1)
        rows = np.flatnonzero(rows)
        if rows.size:
            expected = self._expected(data[rows], log_prior[rows], is_other[rows])
            predicted = np.isfinite(expected)
            size[rows] = np.where(has_part[rows] & predicted, expected, size[rows])
        return data._changed(sigma=np.hypot(data.sigma, self.part * size))

    def _expected(self, data, log_prior, is_other):
        """Return the fluxes that all bands say together, shape (n, nb); NaN of objects that no model fits."""
        other_bands = data._changed(
            sigma=np.where(is_other, data.sigma, np.inf), limit=np.zeros_like(data.limit)
        )
        moments = FluxMoments.of_data(other_bands, self.engine.grid.filters)
        nodes = None
        if data.redshift is not None and self.engine.grid.redshift.size > 1:
            nodes = np.argmax(log_prior, axis=1)

        def put(object_on_nodes):
            start = object_on_nodes.start
            # draws for larger errors: no model fits
            if start.larger_errors:
                return
            row = object_on_nodes.row
            if nodes is not None:
                # the scan counts redshifts from that of the object on
                start.index[:, 0] = nodes[row]
            moments.put_draws(self.engine, row, start)

        self._scan.fit(**other_bands.of_engine(log_prior), each=put, nodes=nodes)
        return self._weighted(data, moments)

    def _weighted(self, data, moments):
        """Return the means of predicted and measured fluxes, weighted with their variances."""
        predicted = moments.model_flux
        z = np.nan_to_num(moments.redshift)
        node = np.abs(self.engine.grid.redshift - z[:, None]).argmin(axis=1)
        model_error = self.engine.template_error[node] * predicted
        variance_predicted = np.square(moments.model_flux_std) + np.square(model_error)
        variance_measured = np.square(data.sigma) + np.square(self.part * predicted)
        total = variance_predicted + variance_measured
        with np.errstate(invalid="ignore"):
            mean = predicted * variance_measured + data.flux * variance_predicted
            return np.maximum(mean / total, 0.0)
