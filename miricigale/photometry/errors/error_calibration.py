"""Factors by which errors are multiplied, from sources of known flux."""

import dataclasses
from typing import ClassVar

import numpy as np
import scipy.sparse
from astropy.stats import mad_std
from astropy.table import QTable

from miricigale.utils.arrays import quiet_division
from miricigale.utils.file_formats import read_write
from miricigale.utils.meta import provenance
from miricigale.utils.options import check_that
from miricigale.utils.package_tables import column_texts
from miricigale.utils.tables import described_rows, require_columns
from miricigale.utils.units import FNU
from miricigale.utils.values import value_class

#: Least number of sources in a bin, and edges of the bins in flux over the error by noise.
_LEAST = 30
_EDGES = (1.0, 3.0, 5.0, 10.0, 20.0, 50.0)

#: Part of Gaussian values within one standard deviation.
_ONE_SIGMA = 68.27


@value_class
class ErrorCalibration:
    """
    Scatter of sources of known flux in units of their errors; `calibrate_errors` makes it.

    Attributes
    ----------
    sources : `~astropy.table.QTable`
        A row for each source: ``kind`` (``point``, ``galaxy`` or ``empty``), ``flux_true``, ``flux``,
        ``flux_err``, ``flux_err_noise``, ``flags``, ``template`` and ``template_snr``, all as they were
        measured, ``sky`` and ``trial``.
    bins : `~astropy.table.QTable`
        Pulls (measured less true flux, over ``flux_err``) in bins of true flux over ``flux_err_noise``: ``low``,
        ``high``, ``snr`` (median), ``n``, ``std``, ``mad`` (1.4826 times the median absolute deviation),
        ``mean``, ``median``, ``bias`` (median of measured over true flux, less 1; NaN for empty places),
        ``factor`` (within which 68.27 % of the pulls are) and ``factor_err``.
    meta : dict
        Provenance.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropy.table import QTable
    >>> from miricigale.photometry import ErrorCalibration
    >>> rng = np.random.default_rng(1)
    >>> error = np.full(2000, 0.1) * u.uJy
    >>> known = QTable({"flux_true": np.full(2000, 2.0) * u.uJy, "flux_err": error})
    >>> known["flux"] = known["flux_true"] + 1.5 * error * rng.normal(size=2000)
    >>> known["flux_err_noise"] = error
    >>> calibration = ErrorCalibration.from_sources(known)
    >>> calibration.factor([2] * u.uJy, [0.1] * u.uJy).round(1)
    array([1.5])
    """

    io_module: ClassVar[str] = "miricigale.photometry.errors.error_files"
    read, write = read_write("the sources of a calibration")

    sources: QTable
    bins: QTable
    meta: dict = dataclasses.field(default_factory=dict)

    def __repr__(self):
        factors = ", ".join(f"{factor:.2f}" for factor in self.bins["factor"])
        return f"<ErrorCalibration {len(self.sources)} sources, factors {factors}>"

    @classmethod
    def from_sources(cls, sources, **meta):
        """
        Bin sources of known flux.

        Parameters
        ----------
        sources : `~astropy.table.QTable`
            With ``flux_true``, ``flux``, ``flux_err`` and ``flux_err_noise`` at least. Rows without a
            measured flux do not count.
        **meta
            What else is known of them.

        Returns
        -------
        calibration : `ErrorCalibration`

        Raises
        ------
        ValueError
            If fewer than 30 sources have a flux.
        """
        names = ["flux_true", "flux", "flux_err", "flux_err_noise"]
        require_columns(sources, names, "sources", units=dict.fromkeys(names, FNU))
        true = sources["flux_true"].to_value(FNU)
        flux = sources["flux"].to_value(FNU)
        error = sources["flux_err"].to_value(FNU)
        noise = sources["flux_err_noise"].to_value(FNU)
        good = np.flatnonzero(np.isfinite(flux) & (error > 0) & (noise > 0))
        wanted = f"at least {_LEAST} sources that are measured"
        check_that(len(good) >= _LEAST, "sources", wanted, f"{len(good)}")
        # pulls and relative deviations of measured sources
        snr = true[good] / noise[good]
        pull = (flux[good] - true[good]) / error[good]
        with quiet_division():
            ratio = flux[good] / true[good] - 1.0
        texts = column_texts("miricigale.photometry", "calibration")
        rows = (_row(snr, pull, ratio, member) for member in _members(snr))
        return cls(sources, described_rows(rows, texts), provenance(source="injection", **meta))

    def to_table(self):
        """Return the sources, with the meta of the calibration, from which `from_table` makes it again."""
        table = self.sources.copy()
        table.meta = dict(self.meta)
        return table

    @classmethod
    def from_table(cls, table):
        """Make the calibration of a table that `to_table` made."""
        return dataclasses.replace(cls.from_sources(table), meta=dict(table.meta))

    def factor(self, flux, flux_err_noise):
        """
        Return the factor on the errors of fluxes.

        Parameters
        ----------
        flux, flux_err_noise : `~astropy.units.Quantity`
            Measured fluxes and their errors by noise.

        Returns
        -------
        factor : `~numpy.ndarray`
            Between the bins linear in asinh of flux over error, beyond them constant; NaN for NaN.
        """
        snr = np.asarray((flux / flux_err_noise).to_value(""))
        # asinh is linear for faint and logarithmic for bright sources
        nodes = np.arcsinh(np.asarray(self.bins["snr"]))
        return np.interp(np.arcsinh(snr), nodes, np.asarray(self.bins["factor"]))

    def apply(self, result):
        """
        Multiply the errors of a result.

        Parameters
        ----------
        result : `ForcedPhotometryResult`
            Of the same image, or one like it.

        Returns
        -------
        result : `ForcedPhotometryResult`
            A copy, with the errors, each of their terms and the covariances multiplied.

        Raises
        ------
        ValueError
            If the errors were multiplied before.
        """
        wanted = "one with errors as they were measured"
        check_that("error_calibration" not in result.meta, "result", wanted, "a calibrated one")
        factor = self.factor(result.flux, result.flux_err_noise)
        names = ["flux_err", "flux_err_noise", "flux_err_template", "flux_err_psf"]
        scale = scipy.sparse.diags_array(np.nan_to_num(factor, nan=1.0))
        changed = {"covariance": (scale @ result.covariance @ scale).tocsr()}
        if result.joint_covariance is not None:
            names.append("flux_point_err")
            scale = scipy.sparse.block_diag((scale, scale), format="csr")
            changed["joint_covariance"] = (scale @ result.joint_covariance @ scale).tocsr()
        for name in names:
            changed[name] = getattr(result, name) * factor
        bins = {"snr": self.bins["snr"].tolist(), "factor": self.bins["factor"].tolist()}
        meta = {**result.meta, "error_calibration": bins}
        return dataclasses.replace(result, **changed, meta=meta)


def _members(snr):
    """Return the rows of each bin: places without flux, then by the edges; small bins join the next."""
    order = np.argsort(snr, kind="stable")
    # bins of signal-to-noise; empty places are one of their own
    number = np.searchsorted(_EDGES, snr[order], side="right")
    number[snr[order] <= 0] = -1
    members = []
    waiting = np.empty(0, int)
    for k in np.unique(number):
        waiting = np.concatenate([waiting, order[number == k]])
        if len(waiting) >= _LEAST:
            members.append(waiting)
            waiting = np.empty(0, int)
    if not len(waiting):
        return members
    # a last bin that is too small joins the one before
    if members:
        waiting = np.concatenate([members.pop(), waiting])
    return members + [waiting]


def _row(snr, pull, ratio, member):
    pull = pull[member]
    ratio = ratio[member][np.isfinite(ratio[member])]
    # the factor by which errors hold as many pulls as Gaussian ones
    factor = np.percentile(np.abs(pull), _ONE_SIGMA)
    bias = np.nan
    if len(ratio):
        bias = np.median(ratio)
    # of a percentile: root of p (1 - p) / n over the density of |x| there, 0.484
    factor_err = factor * 0.4655 / 0.4839 / np.sqrt(len(member))
    snr = snr[member]
    return {
        "low": snr.min(),
        "high": snr.max(),
        "snr": np.median(snr),
        "n": len(member),
        "std": np.std(pull),
        "mad": mad_std(pull),
        "mean": np.mean(pull),
        "median": np.median(pull),
        "bias": bias,
        "factor": factor,
        "factor_err": factor_err,
    }
