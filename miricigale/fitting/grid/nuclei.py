"""
Fits to the flux of the nucleus of a galaxy beside its total flux, by band.

In band b the galaxy has the total T = G + A and the point in its center P = A + u H, with A the flux of the AGN, G
that of its host, and u H the light of stars and dust in the center that the template of the galaxy does not
show. It has the color of the host: H is the measured smooth light T - P, and u, the same in all bands, has a
normal prior of mean 0. Integrated over u the points of all bands have the covariance
C = D + sigma_u^2 H H^T, with D their own variances. T and P of a band have the measured covariance c.

Fits take data without covariance. The points become L^-1 P with C = L L^T, and totals become T - K P with
K = c C^-1, whose errors do not depend on P. (What u does to the covariance of T - K P between bands is left out:
it is of second order in the correlation of T and P, and 0 with one band, sigma_u = 0 or c = 0.) Models are the
same linear combinations of their fluxes: galaxies have none of the points, so that only the few fluxes of AGN
differ from object to object.
"""

from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy.linalg import solve_triangular

from miricigale.fitting import _core
from miricigale.fitting.data.likelihood import FitData
from miricigale.fitting.data.nuclei import COVARIANCE, FLUX, LIMIT, SIGMA
from miricigale.fitting.grid.between_results import between_results, with_axis_summaries
from miricigale.fitting.grid.continuation import N_START
from miricigale.fitting.grid.grid import GridEngine
from miricigale.fitting.grid.mixture import BandMixture
from miricigale.fitting.posterior.posterior import joint_names
from miricigale.fitting.results.results import FitResults
from miricigale.utils.units import Frozen
from miricigale.utils.values import value_class

#: Least rest of a total as a part of it: errors of templates are parts of what is there.
_LEAST_REST = 1e-9
#: Width of the broad part of a nucleus that may be wrong, in units of its error.
_WIDE = 10.0


@value_class
class NuclearMixture(BandMixture):
    """
    `BandMixture` of bands, of the rests of their totals, and of nuclei.

    Parameters
    ----------
    bands : `~numpy.ndarray` of int, shape (n_nuclei,)
        Bands of the nuclei.
    """

    bands: np.ndarray

    @classmethod
    def of_mixture(cls, mixture, bands):
        """Extend a mixture: nuclei are wrong as often as the fluxes of their bands; None without a mixture."""
        if mixture is None:
            return None
        part = np.concatenate([mixture.part, mixture.part[bands], mixture.part[bands]])
        return cls(part, mixture.order, bands)

    def broad(self, flux, sigma):
        """Compute the widths of the broad parts; see `BandMixture.broad`."""
        n_bands = len(self.order)
        end = n_bands + len(self.bands)
        out = np.full(np.shape(flux), np.inf)
        total = np.array(flux[:, :n_bands])
        error = np.array(sigma[:, :n_bands])
        remainder_sigma = sigma[:, n_bands:end]
        paired = np.isfinite(remainder_sigma)
        total[:, self.bands] = np.where(paired, flux[:, n_bands:end], total[:, self.bands])
        error[:, self.bands] = np.where(paired, remainder_sigma, error[:, self.bands])
        width = super().broad(total, error)
        out[:, :n_bands] = np.where(np.isfinite(sigma[:, :n_bands]), width, np.inf)
        out[:, n_bands:end] = np.where(paired, width[:, self.bands], np.inf)
        wide = np.hypot(_WIDE * sigma[:, end:], flux[:, end:])
        out[:, end:] = np.where(np.isfinite(sigma[:, end:]), wide, np.inf)
        return out


@value_class
class ObjectNuclei:
    """
    Nuclei of one object, and the data and models without covariance that they make.

    Such data are the nb bands, the rests T - K P of the n bands with nuclei, in place of the total where K is not
    0, and the points L^-1 P; a point that is an upper limit stays as it is.

    Parameters
    ----------
    bands : `~numpy.ndarray` of int, shape (n,)
        Bands of the nuclei.
    mix, root : `~numpy.ndarray`, shape (n, n)
        K, and the inverse of L.
    paired : `~numpy.ndarray` of bool, shape (n,)
        Bands whose total is replaced by its rest.
    flux, sigma, limit : `~numpy.ndarray`, shape (nb + 2 n,)
        Fluxes, errors (infinite where there is none) and whether fluxes are limits.
    total : `~numpy.ndarray`, shape (n,)
        Total fluxes of the bands.
    log_errors : float
        Ln of the product of the errors of the nuclei and rests over that of the totals.
    n_used : int
        Number of nuclei with data.
    """

    bands: np.ndarray
    mix: np.ndarray
    root: np.ndarray
    paired: np.ndarray
    flux: np.ndarray
    sigma: np.ndarray
    limit: np.ndarray
    total: np.ndarray
    log_errors: float
    n_used: int

    @classmethod
    def of_values(cls, bands, values, data, stars, agn_error):
        """
        Return the nuclei of an object.

        Parameters
        ----------
        bands : `~numpy.ndarray` of int, shape (n,)
            Bands of the nuclei.
        values : `~numpy.ndarray`, shape (n, 4)
            As of `~miricigale.fitting.data.nuclei.read_nuclei`.
        data : `~miricigale.fitting.data.likelihood.FitData`
            Photometry of the object, as of one row.
        stars : float
            Standard deviation of u.
        agn_error : float
            Error of the AGN's light as a part of it.
        """
        n = len(bands)
        flux = data.flux
        sigma = data.sigma
        limit = data.limit
        point = values[:, FLUX]
        limited = values[:, LIMIT] > 0
        usable = np.isfinite(values[:, SIGMA])
        index = np.flatnonzero(usable & ~limited)
        total = flux[bands]
        mix = np.zeros((n, n))
        root = np.diag(np.where(usable & limited, 1.0, 0.0))
        covariance = values[index, COVARIANCE]
        point_variance = np.square(values[index, SIGMA]) + np.square(agn_error * point[index])
        host = np.clip(total[index] - point[index], 0.0, np.maximum(total[index], 0.0))
        # covariance L L^T of the points, so that L^-1 P has unit errors
        lower = _cholesky(np.sqrt(point_variance), stars * host)
        block = np.ix_(index, index)
        root[block] = solve_triangular(lower, np.eye(len(index)), lower=True)
        # K = cov(T, P) cov(P)^-1: the rest T - K P is not correlated with P
        mix[block] = covariance[:, None] * (root[block].T @ root[block])
        paired = np.any(mix != 0.0, axis=1)
        remainder = total - mix @ np.where(usable, point, 0.0)
        # not 0, for errors of templates are parts of what is there
        small = np.abs(remainder) < _LEAST_REST * np.abs(total)
        remainder = np.where(small, _LEAST_REST * total, remainder)
        of_totals = np.square(sigma[bands[index]])
        # variance of the rest: var(T) - K cov(P, T)
        of_rests = of_totals - np.diag(mix)[index] * covariance
        remainder_sigma = np.full(n, np.inf)
        remainder_sigma[index] = np.sqrt(of_rests)
        remainder_sigma[~paired] = np.inf
        own_sigma = np.array(sigma)
        own_sigma[bands[paired]] = np.inf
        point_sigma = np.where(limited, values[:, SIGMA], np.where(usable, 1.0, np.inf))
        log_errors = np.log(np.diag(lower)).sum() + 0.5 * len(index) * np.log(2.0 * np.pi)
        log_errors += 0.5 * np.log(of_rests / of_totals)[paired[index]].sum()
        return cls(
            bands=bands,
            mix=mix,
            root=root,
            paired=paired,
            flux=np.concatenate([flux, remainder, root @ point]),
            sigma=np.concatenate([own_sigma, remainder_sigma, point_sigma]),
            limit=np.concatenate([limit, np.zeros(n, bool), usable & limited]),
            total=total,
            log_errors=float(log_errors),
            n_used=int(usable.sum()),
        )

    @property
    def n_bands(self):
        """Number of bands."""
        return len(self.flux) - 2 * len(self.bands)

    def extended(self, flux, agn):
        """Compute all data of models, (..., nb + 2 n), from fluxes and those of their AGN, both (..., nb)."""
        light = agn[..., self.bands]
        # not matrix products, whose last digits depend on how many rows there are
        remainder = flux[..., self.bands] - np.einsum("...k,jk->...j", light, self.mix)
        nuclei = np.einsum("...k,jk->...j", light, self.root)
        return np.concatenate([flux, remainder, nuclei], axis=-1)

    def template_errors(self, errors):
        """Convert errors of templates, (nz, nb), to parts of all data: those of the totals in the rests."""
        n = len(self.bands)
        remainder = self.flux[self.n_bands : self.n_bands + n]
        ratio = np.divide(
            np.abs(self.total), np.abs(remainder), out=np.ones(n), where=remainder != 0.0
        )
        nuclei = np.zeros((len(errors), n))
        return np.concatenate([errors, errors[:, self.bands] * ratio, nuclei], axis=1)

    def photometry(self, data, log_prior):
        """Make the keywords of `GridEngine.fit` for the object, the one row of ``data``."""
        row = {"flux": self.flux, "sigma": self.sigma, "limit": self.limit}
        arrays = {name: value[None] for name, value in row.items()}
        extended = FitData(data.ids, flux_err=None, flags=data.flags, **arrays)
        return extended.of_engine(log_prior)

    def mixture(self, mixture):
        """Make the `NuclearMixture` of the `BandMixture` of the bands; None without."""
        return NuclearMixture.of_mixture(mixture, self.bands)

    def kernel(self):
        """Make `_core.Nuclei` with memory."""
        memory = np.zeros((3, len(self.flux) + 1))
        return _core.Nuclei(self.bands, self.mix, self.root, memory)

    def of_bands(self, values):
        """Select values of all data, (..., nb + 2 n), for the bands: of rests where these replace totals."""
        n_bands = self.n_bands
        out = np.array(values[..., :n_bands])
        remainder = values[..., n_bands : n_bands + len(self.bands)]
        out[..., self.bands[self.paired]] = remainder[..., self.paired]
        return out


@value_class
class NuclearGrid(Frozen):
    """
    A grid for data with nuclei; picklable.

    Parameters
    ----------
    engine : `~miricigale.fitting.grid.grid.GridEngine`
        The grid.
    bands : tuple of int
        Bands of the nuclei.
    stars : float
        Standard deviation of the part u of the host's light.
    agn_error : float
        Error of the AGN's light as a part of it.
    """

    engine: GridEngine
    bands: tuple
    stars: float
    agn_error: float = 0.0

    @property
    def index(self):
        """The bands as an array of int, shape (n,)."""
        return np.array(self.bands, np.int64)

    @cached_property
    def extended(self):
        """`GridEngine` with places for rests and nuclei, the rests being totals yet."""
        return extended_engine(self.engine, self.index)

    def of_object(self, data):
        """Make the `ObjectNuclei` of the object in the one row of ``data``."""
        return ObjectNuclei.of_values(
            self.index, data.nuclei[0], data[0], self.stars, self.agn_error
        )


def _cholesky(sigma, light):
    """
    Calculate L of the covariance L L^T = D + h h^T of points, D being their own variances.

    With v = h / sigma and t_j the sum of 1 and of v_k^2 up to k = j, the diagonal of L over sigma is
    sqrt(t_j / t_(j-1)), and what stands below it v_i v_j / sqrt(t_j t_(j-1)). No difference is taken, so that
    errors may be as small as they like beside h.

    Parameters
    ----------
    sigma, light : `~numpy.ndarray`, shape (n,)
        Errors of the points, and h.

    Returns
    -------
    lower : `~numpy.ndarray`, shape (n, n)
    """
    ratio = light / sigma
    total = 1.0 + np.cumsum(np.square(ratio))
    before = np.concatenate([[1.0], total])[:-1]
    below = np.tril(np.outer(ratio, ratio / np.sqrt(total * before)), -1)
    return sigma[:, None] * (below + np.diag(np.sqrt(total / before)))


def extended_engine(engine, bands):
    """Make an engine with places for the rests of totals and for nuclei of bands, (n,), which are 0 yet."""

    def with_places(flux):
        return np.concatenate([flux, flux[..., bands], 0.0 * flux[..., bands]], axis=-1)

    errors = engine.template_error
    return replace(
        engine,
        galaxy=with_places(engine.galaxy),
        agn=with_places(engine.agn),
        template_error=with_places(errors),
        mixture=NuclearMixture.of_mixture(engine.mixture, bands),
    )


def object_engine(extended, nuclei):
    """
    Make an engine for one object.

    Parameters
    ----------
    extended : `~miricigale.fitting.grid.grid.GridEngine`
        As of `extended_engine`; the tables of galaxies are shared with it.
    nuclei : `ObjectNuclei`
        Nuclei of the object.

    Returns
    -------
    engine : `~miricigale.fitting.grid.grid.GridEngine`
    """
    n_bands = nuclei.n_bands
    of_bands = extended.agn[..., :n_bands]
    agn = nuclei.extended(of_bands, of_bands)
    tables = extended.tables
    unit = tables.agn_unit[:, : agn.shape[1], None]
    tables = tables._replace(agn=agn, agn32=(agn / unit).astype(np.float32, order="C"))
    errors = nuclei.template_errors(extended.template_error[:, :n_bands])
    new = {"agn": agn, "template_error": errors, "tables": tables}
    if extended.mixture is not None:
        new["tangents"] = replace(extended.tangents, tables=tables)
    engine = object.__new__(type(extended))
    # what else is worked out once is shared
    engine.__dict__.update(extended.__dict__ | new)
    return engine


def fit_with_nuclei(fit, data, log_prior, pairs):
    """
    Fit a piece of a catalog with nuclei; objects without any are fitted as they are without this.

    Parameters
    ----------
    fit : `~miricigale.fitting.grid.grid_fit.GridFit`
        The fit, with its `NuclearGrid`.
    data : `~miricigale.fitting.data.likelihood.FitData`
        Photometry of n objects with nuclei.
    log_prior : `~numpy.ndarray`, shape (n, nz)
        Priors of redshift.
    pairs : tuple of tuple of str
        Parameters whose joint posteriors are asked for.

    Returns
    -------
    results : `~miricigale.fitting.FitResults`
    """
    has_nuclei = np.isfinite(data.nuclei[:, :, SIGMA]).any(axis=1)
    has_nuclei &= np.isfinite(log_prior).any(axis=1)
    rows = np.flatnonzero(has_nuclei)
    rows_without = np.flatnonzero(~has_nuclei)
    parts = []
    if rows_without.size or not rows.size:
        totals = data._changed(nuclei=None)[rows_without]
        parts.append(fit.fit_piece(pairs, (totals, log_prior[rows_without])))
    workspaces = {}
    for i in rows:
        row = slice(i, i + 1)
        parts.append(_fit_object(fit, data[row], log_prior[row], pairs, workspaces))
    order = np.argsort(np.concatenate([rows_without, rows]), kind="stable")
    return FitResults.concatenate(parts)[order]


def _fit_object(fit, data, log_prior, pairs, workspaces):
    """Fit one object; ``workspaces`` keeps memory for the next."""
    grid = fit.nuclei
    nuclei = grid.of_object(data)
    totals = data._changed(nuclei=None)
    z = 0.0
    node = None
    at_redshift = fit.between is not None and data.redshift is not None
    if at_redshift and fit.grid.redshift.size > 1:
        z = float(data.redshift[0])
        node = int(np.argmax(log_prior[0]))
        extended = extended_engine(fit.between.at_redshift(z, node), grid.index)
        photometry = nuclei.photometry(totals, log_prior[:, node : node + 1])
    else:
        extended = grid.extended
        photometry = nuclei.photometry(totals, log_prior)
    engine = object_engine(extended, nuclei)

    def memory(kind, **options):
        key = kind, node is None
        if node is not None:
            return engine.workspace(**options)
        if key not in workspaces:
            workspaces[key] = engine.workspace(**options)
        return workspaces[key]

    results = None
    if fit.between is not None:
        posteriors = []

        def place(known):
            posterior = fit.between.place(fit.given.interpolate, known, node, z, nuclei)
            if posterior is not None:
                posteriors.append(posterior)

        if fit.between.scan is not None and node is None and not nuclei.limit.any():
            scan = replace(fit.between.scan, engine=engine)
            scan.share(workspaces.setdefault("scan", scan))
            scan.fit(**photometry, each=place)
        else:
            workspace = memory("draws", n_draws=N_START)
            engine.fit(**photometry, n_draws=N_START, each=place, workspace=workspace)
        if posteriors:
            results = between_results(fit, totals, posteriors, pairs)
    if results is None:
        joint = joint_names(pairs, fit.priors.axes)
        out = engine.fit(**photometry, joint=joint, workspace=memory("joint", joint=joint))
        out = out._replace(
            best_flux=out.best_flux[:, : nuclei.n_bands],
            band=out.band[:, :, : nuclei.n_bands],
            outlier=nuclei.of_bands(out.outlier),
        )
        if node is not None:
            results = fit.results_at_redshift(totals, out, log_prior, pairs)
        else:
            results = fit.results_on_nodes(totals, out, pairs)
        if fit.between is not None:
            results = with_axis_summaries(results)
    return results._changed(
        n_bands=results.n_bands + nuclei.n_used,
        log_evidence=results.log_evidence - nuclei.log_errors,
    )
