"""Fluxes that the posterior on the nodes of a grid predicts, from models that a scan of the nodes draws."""

import dataclasses

import numpy as np

from miricigale.fitting.grid.node_scan import NodeScan
from miricigale.utils.parallel import chunks, parallel_map, single_threaded
from miricigale.utils.units import Frozen
from miricigale.utils.values import value_class

#: Models drawn for each object: means are good to a thirtieth of the standard deviation.
_N_DRAWS = 1024


@value_class
class FluxMoments:
    """
    Means and standard deviations of the model fluxes of n objects, with the data that were fitted.

    Parameters
    ----------
    filters : tuple of str
        Bands of the models.
    flux, sigma : `~numpy.ndarray`, shape (n, nb)
        Fluxes and errors in uJy, those of the models included; errors are infinite in bands not used.
    limit : `~numpy.ndarray` of bool, shape (n, nb)
        Which of the bands used are upper limits.
    model_flux, model_flux_std : `~numpy.ndarray`, shape (n, nb)
        Moments over the posterior in uJy; NaN of objects without a result.
    chi2 : `~numpy.ndarray`, shape (n,)
        Of the best model; NaN without a result.
    redshift : `~numpy.ndarray`, shape (n,)
        Means of the posterior.
    """

    filters: tuple
    flux: np.ndarray
    sigma: np.ndarray
    limit: np.ndarray
    model_flux: np.ndarray
    model_flux_std: np.ndarray
    chi2: np.ndarray
    redshift: np.ndarray

    @classmethod
    def of_data(cls, data, filters):
        """Make moments without results for `~miricigale.fitting.data.likelihood.FitData`."""
        shape = data.flux.shape
        return cls(
            filters=filters,
            flux=data.flux,
            sigma=data.sigma.copy(),
            limit=data.limit,
            model_flux=np.full(shape, np.nan),
            model_flux_std=np.full(shape, np.nan),
            chi2=np.full(shape[0], np.nan),
            redshift=np.full(shape[0], np.nan),
        )

    @property
    def fitted(self):
        """Which objects have a result, shape (n,)."""
        return np.isfinite(self.chi2)

    @property
    def reduced_chi2(self):
        """Chi2 over the number of bands less one, shape (n,); NaN with a single band."""
        n_others = np.isfinite(self.sigma).sum(axis=1) - 1
        out = np.full(self.chi2.shape, np.nan)
        return np.divide(self.chi2, n_others, out=out, where=n_others > 0)

    def put(self, rows, moments):
        """Put the moments of other objects into these rows."""
        for name in ("sigma", "model_flux", "model_flux_std", "chi2", "redshift"):
            getattr(self, name)[rows] = getattr(moments, name)

    def put_results(self, rows, results):
        """Put the moments of `~miricigale.fitting.FitResults` into these rows."""
        self.sigma[rows] = results.sigma
        self.model_flux[rows] = results.model_flux
        self.model_flux_std[rows] = results.model_flux_std
        self.chi2[rows] = results.chi2
        self.redshift[rows] = results.mean("redshift").value

    def put_draws(self, engine, row, start):
        """
        Put the moments of models that were drawn into a row.

        Each model has a normal distribution of its scale about the best one, if the engine has its error.

        Parameters
        ----------
        engine : `~miricigale.fitting.grid.grid.GridEngine`
            Models, and their errors by redshift.
        row : int
            Row of these moments.
        start : `~miricigale.fitting.grid.grid.Start`
            Draws, and ln of their weights.
        """
        index = start.index
        share = np.exp(start.log_weight - start.log_weight.max())
        share /= share.sum()
        is_used = np.isfinite(self.sigma[row])
        flux = np.where(is_used, self.flux[row], 0.0)
        template_error = engine.template_error[index[:, 0]] * flux
        total_variance = np.square(self.sigma[row]) + np.square(template_error)
        weight = 1.0 / total_variance
        model = model_fluxes(engine, index)
        norm = np.sum(weight * model * model, axis=1)
        scale = np.maximum(np.sum(weight * model * flux, axis=1) / norm, 0.0)
        scaled = scale[:, None] * model
        chi2 = np.sum(weight * np.square(flux - scaled), axis=1)
        # -2 ln(likelihood), for errors differ between redshifts
        best = np.argmin(chi2 + np.sum(np.log(total_variance[:, is_used]), axis=1))
        mean = share @ scaled
        variance = share @ np.square(scaled - mean)
        if engine.scale_error:
            variance += share @ (model * model / norm[:, None])
        self.model_flux[row] = mean
        self.model_flux_std[row] = np.sqrt(variance)
        self.chi2[row] = chi2[best]
        self.redshift[row] = share @ engine.grid.redshift[index[:, 0]]
        self.sigma[row] = np.hypot(self.sigma[row], np.abs(template_error[best]))


def model_fluxes(engine, index):
    """Compute the fluxes in uJy of models of one solar mass formed, (n, nb)."""
    grid = engine.grid
    z, galaxy, agn, fraction = index.T
    model = engine.galaxy[z, galaxy].copy()
    frac = grid.frac_agn[fraction]
    with_agn = frac > 0
    power = grid.dust_luminosity[galaxy] * frac / np.maximum(1.0 - frac, 1e-12)
    model[with_agn] += power[with_agn, None] * engine.agn[z[with_agn], agn[with_agn]]
    return model


@value_class
class _ScanTask(Frozen):
    """Scans pieces of a catalog, in other processes too."""

    scan: NodeScan
    filters: tuple

    def __call__(self, piece):
        """Compute the `FluxMoments` of a piece: photometry without limits, and ln of the prior of redshifts."""
        data, log_prior = piece
        moments = FluxMoments.of_data(data, self.filters)

        def put(object_on_nodes):
            # draws for larger errors are not of the posterior
            if not object_on_nodes.start.larger_errors:
                row = object_on_nodes.row
                moments.put_draws(self.scan.engine, row, object_on_nodes.start)

        self.scan.fit(**data.of_engine(log_prior), each=put)
        return moments


def _without_wrong_bands(engine, has_data):
    """
    Return the engine for photometry none of whose bands may be wrong; None if some of them may be.

    Bands of the grid that are not fitted may have a share of wrong fluxes, which would cost time only.
    """
    if engine.mixture is None:
        return engine
    if np.any(engine.mixture.part[has_data] > 0):
        return None
    plain_engine = dataclasses.replace(engine, mixture=None)
    # tables do not depend on it
    plain_engine.__dict__["tables"] = engine.tables
    return plain_engine


def flux_moments(fitter, table, *, redshift=None, redshift_prior=None, executor=None):
    """
    Predict the fluxes of all bands of a grid from the posterior on its nodes.

    At free redshifts models are drawn by `~miricigale.fitting.grid.node_scan.NodeScan`, at a fifth of the time of
    the sum over all nodes. That sum serves for all else: known redshifts, limits, bands that may be wrong, and
    objects whose best model is farther off than their errors.

    Parameters
    ----------
    fitter : `~miricigale.fitting.BayesFitter`
        Of the nodes of a grid.
    table : `~astropy.table.QTable`
        Photometry.
    redshift : array_like, shape (n,), optional
        Known redshifts.
    redshift_prior : tuple, optional
        Redshifts, and densities at them of shape (n, n_z).
    executor : `concurrent.futures.Executor`, optional
        As for `~miricigale.fitting.BayesFitter.fit`.

    Returns
    -------
    moments : `FluxMoments`
    """
    data, log_prior, _ = fitter._prepare(table, redshift, redshift_prior)
    backend = fitter.backend
    data = backend.with_all_errors(data, log_prior)
    moments = FluxMoments.of_data(data, backend.filters)
    rows = np.flatnonzero(np.isfinite(log_prior).any(axis=1) & ~data.limit.any(axis=1))
    engine = _without_wrong_bands(backend.engine, data.used.any(axis=0))
    # a prior of rates has no kernel that scans
    if redshift is None and engine is not None and engine.mass_prior is None:
        pieces = [rows[piece] for piece in chunks(rows.size, backend.chunk_size)]
        task = _ScanTask(NodeScan(engine, _N_DRAWS), backend.filters)
        items = [(data[piece], log_prior[piece]) for piece in pieces]
        with single_threaded():
            scanned = parallel_map(task, items, executor=executor)
        for piece, piece_moments in zip(pieces, scanned, strict=True):
            moments.put(piece, piece_moments)
    other_rows = np.flatnonzero(~moments.fitted)
    if other_rows.size:
        options = {"executor": executor}
        if redshift is not None:
            options["redshift"] = np.asarray(redshift)[other_rows]
        if redshift_prior is not None:
            nodes, density = redshift_prior
            options["redshift_prior"] = (nodes, np.asarray(density)[other_rows])
        moments.put_results(other_rows, fitter.fit(table[other_rows], **options))
    return moments
