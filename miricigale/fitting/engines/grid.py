"""The grid engine: every model of a `~miricigale.sed.ModelGrid`, by factors."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from miricigale.fitting import _core
from miricigale.fitting._core.bounds import BLOCK

__all__ = ["GridEngine"]

#: Pairs listed at once by one worker (12 bytes each).
_CAPACITY = 1 << 22
#: Part of ``rtol`` that the weight of what is left out may have.
_SAFETY = 1e-3


@dataclass(frozen=True, eq=False, repr=False)
class GridEngine:
    """
    Posterior of many objects over a factorised model grid.

    Parameters
    ----------
    galaxy : `~numpy.ndarray`, shape (nz, nG, nb)
        Galaxy fluxes in uJy for each solar mass formed.
    agn : `~numpy.ndarray`, shape (nz, nA, nb)
        AGN fluxes in uJy for each W of AGN power; nA may be 0.
    dust : `~numpy.ndarray`, shape (nG,)
        Dust luminosity in W for each solar mass formed.
    frac : `~numpy.ndarray`, shape (nf,)
        AGN fractions, ascending.
    usable : `~numpy.ndarray` of bool, shape (nz, nG)
        Models that may be used.
    prior_galaxy, prior_agn, prior_frac : `~numpy.ndarray`
        Prior weights of galaxy models, tori and fractions.
    galaxy_scale, agn_scale : `~numpy.ndarray`, shapes (n_qg, nG) and (n_qa, nA)
        Derived quantities for each solar mass formed and for each W.
    mixed_galaxy, mixed_agn : `~numpy.ndarray`, shapes (nG,) and (nA,)
        Parts of galaxy and torus in one quantity that is the sum of both.
    levels : `~numpy.ndarray`
        Ascending levels of the quantiles of derived quantities.
    rtol : float
        Relative error that pruning may cause; posterior weights are bounded to a thousandth of
        it, so that moments of quantities with a long tail hold it too.
    scale_error : bool
        Whether the variance of each model's own scale is part of the posterior.
    """

    galaxy: np.ndarray
    agn: np.ndarray
    dust: np.ndarray
    frac: np.ndarray
    usable: np.ndarray
    prior_galaxy: np.ndarray
    prior_agn: np.ndarray
    prior_frac: np.ndarray
    galaxy_scale: np.ndarray
    agn_scale: np.ndarray
    mixed_galaxy: np.ndarray
    mixed_agn: np.ndarray
    levels: np.ndarray
    rtol: float = 1e-6
    scale_error: bool = True

    @property
    def n_models(self):
        """Number of different models that are evaluated or bounded."""
        n_row = int(np.count_nonzero(self.usable))
        n_zero = int(self.frac[0] == 0.0)
        return n_row * (n_zero + self.agn.shape[1] * (self.frac.size - n_zero))

    @property
    def n_quantities(self):
        """Number of derived quantities: the galaxy's, the torus's and the sum of both."""
        return self.galaxy_scale.shape[0] + self.agn_scale.shape[0] + 1

    @property
    def delta(self):
        """How far 2 ln(posterior) of a model may lie below the best: 2 ln(1000 n_models / rtol)."""
        if self.rtol == 0:
            return 1e9
        return 2.0 * np.log(max(self.n_models, 1) / (_SAFETY * self.rtol))

    @cached_property
    def _tables(self):
        n_z, n_galaxy, n_bands = self.galaxy.shape
        n_padded = -(-n_galaxy // BLOCK) * BLOCK
        galaxy32 = np.ones((n_z, n_bands, n_padded), np.float32)
        galaxy32[:, :, :n_galaxy] = _in_own_unit(self.galaxy).transpose(0, 2, 1)
        frac = self.frac[self.frac > 0]
        ratio = frac / (1.0 - frac)
        log_dust = np.log10(self.dust, where=self.dust > 0, out=np.full(n_galaxy, -400.0))
        prior_galaxy = self.prior_galaxy / self.prior_galaxy.sum()
        prior_frac = self.prior_frac / self.prior_frac.sum()
        prior_agn = self.prior_agn / max(self.prior_agn.sum(), 1e-300)
        # all writable, for the kernels are compiled once more for arrays that are not
        return _core.Tables(
            _writable(self.galaxy),
            _writable(self.agn),
            galaxy32,
            np.ascontiguousarray(_in_own_unit(self.agn)),
            _writable(self.dust),
            log_dust,
            ratio,
            np.log10(ratio) * _core.PER_DEX,
            int(self.frac[0] == 0.0),
            _writable(self.usable),
            prior_galaxy,
            prior_agn,
            prior_frac,
            _two_log(prior_galaxy),
            _two_log(prior_agn),
            _two_log(prior_frac),
            _writable(self.galaxy_scale),
            _writable(self.agn_scale),
            _writable(self.mixed_galaxy),
            _writable(self.mixed_agn),
        )

    def workspace(self):
        """Make the accumulators and work space of one worker (some tens of MB)."""
        n_z, n_galaxy, n_bands = self.galaxy.shape
        n_agn, n_frac = self.agn.shape[1], self.frac.size
        sums = _core.make_sums(n_z, n_galaxy, n_agn, n_frac, n_bands)
        n_padded = self._tables.galaxy32.shape[2]
        return sums, _core.make_scratch(n_z, n_galaxy, n_padded, n_agn, n_frac, n_bands, _CAPACITY)

    def fit(self, flux, sigma, log_prior, *, workspace=None):
        """
        Fit objects.

        Parameters
        ----------
        flux, sigma : `~numpy.ndarray`, shape (n, nb)
            Fluxes and errors in uJy; bands with infinite sigma are not used.
        log_prior : `~numpy.ndarray`, shape (n, nz)
            ln(prior) of the redshifts, -inf where it is 0; rows of -inf are not fitted.
        workspace : tuple, optional
            What `workspace` returned, for use by one thread at a time; made if not given.

        Returns
        -------
        out : `~miricigale.fitting._core.Output`
            Not a number where an object was not fitted.
        """
        tables = self._tables
        n_z, n_galaxy, n_bands = self.galaxy.shape
        n_agn, n_frac = self.agn.shape[1], self.frac.size
        n = flux.shape[0]
        weight = 1.0 / np.square(sigma)
        data = np.where(weight > 0, flux, 0.0)
        log_prior = np.where(np.isfinite(log_prior), 2.0 * log_prior, -1e300)
        out = _core.Output(
            np.full(n, np.nan),
            np.full(n, np.nan),
            np.zeros(n),
            np.full(n, np.nan),
            np.full(n, np.nan),
            np.full((n, 4), -1),
            np.full((n, n_z, n_frac), np.nan),
            np.full((n, n_galaxy), np.nan),
            np.full((n, n_agn), np.nan),
            np.full((n, 2, n_bands), np.nan),
            np.full((n, self.n_quantities, 3), np.nan),
            np.full((n, self.n_quantities, self.levels.size), np.nan),
        )
        request = _core.Request(
            float(self.delta), _SAFETY * self.rtol, float(self.scale_error), self.levels.copy()
        )
        sums, scratch = self.workspace() if workspace is None else workspace
        _core.fit_many(tables, request, data, weight, log_prior, sums, scratch, out)
        return out

    def __getstate__(self):
        # the prepared tables are made again by whoever unpickles
        return {name: value for name, value in self.__dict__.items() if name != "_tables"}


def _in_own_unit(table):
    """Divide the fluxes of every model by the largest, in single precision."""
    top = table.max(axis=-1, keepdims=True, initial=0.0)
    return (table / np.where(top > 0, top, 1.0)).astype(np.float32)


def _writable(array):
    """Copy an array to a contiguous one that may be written to."""
    return np.array(array, order="C", copy=True)


def _two_log(prior):
    """Return 2 ln(prior), -1e300 where it is zero."""
    return 2.0 * np.log(prior, where=prior > 0, out=np.full(prior.shape, -5e299))
