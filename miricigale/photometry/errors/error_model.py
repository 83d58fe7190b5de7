"""Errors as a function of flux: from simulations, from an exposure, from survey depths."""

import dataclasses
import math
import types
from typing import ClassVar

import astropy.units as u
import numpy as np

from miricigale.filters.band_names import find_filter
from miricigale.filters.band_table import BandTable
from miricigale.instrument import Exposure
from miricigale.instrument.published_tables import imager_filter
from miricigale.photometry.errors.error_curves import (
    STATISTICS,
    Analytic,
    common_bands,
    curves_from_table,
    curves_to_table,
    flux_table,
    limiting_flux,
    measured_curve,
    same_rows,
)
from miricigale.utils.exceptions import argument_error, unknown_name
from miricigale.utils.file_formats import read_write
from miricigale.utils.ids import id_column
from miricigale.utils.interactive import WithTable
from miricigale.utils.meta import provenance
from miricigale.utils.options import check_choice, check_least, check_positive, check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.random import check_seed, stream
from miricigale.utils.tables import error_column, read_ids, require_columns
from miricigale.utils.units import FNU, ab_quantity, to_array
from miricigale.utils.values import value_class

#: 5-sigma AB depths of 15 bands of CANDELS/EGS like the paper's (after Stefanon 2017 and FIDEL): the
#: paper states none.
YANG2021_DEPTHS = types.MappingProxyType(
    {
        "megacam.u": 27.1, "megacam.g": 27.3, "megacam.r": 27.2, "megacam.i": 27.0, "megacam.z": 26.1,
        "acs.f606w": 28.8, "acs.f814w": 28.2, "wfc3.f125w": 27.6, "wfc3.f140w": 26.8, "wfc3.f160w": 27.6,
        "irac.ch1": 23.9, "irac.ch2": 24.2, "irac.ch3": 22.5, "irac.ch4": 22.8, "mips.24": 19.3,
    }
)  # fmt: skip

#: 5-sigma AB depths of deep surveys by Herschel, from 3-sigma depths in mJy: 0.6 and 1.3 with PACS in GOODS-South
#: (Magnelli et al. 2013, A&A 553, A132, abstract), and with SPIRE three times the confusion noise of 5.8, 6.3 and
#: 6.8 mJy / beam (Nguyen et al. 2010, A&A 518, L5, abstract), which no exposure goes below without priors.
_HERSCHEL = {
    "pacs_100": 0.6,
    "pacs_160": 1.3,
    "spire_250": 17.4,
    "spire_350": 18.9,
    "spire_500": 20.4,
}
HERSCHEL_DEPTHS = types.MappingProxyType(
    {
        f"sedpy.herschel_{name}": round(16.4 - 2.5 * math.log10(depth * 5 / 3), 2)
        for name, depth in _HERSCHEL.items()
    }
)


def fractional_error(name):
    """
    Return the part of the flux that is added to the error of a band other than MIRI's, in quadrature.

    0.10 for IRAC and MIPS, 0.03 otherwise: the package's own choice, not the paper's.
    """
    if name.startswith(("irac", "mips")):
        return 0.10
    return 0.03


def _band(name):
    """Return the package's name of a band or filter, or its own where there is none."""
    name = str(getattr(name, "name", name))
    return find_filter(name) or name


def add_noise(photometry, name, sigma, seed):
    """Add noise of known errors, shape (n,), to the fluxes of a band in place; draws belong to ids or rows."""
    if id_column(photometry.colnames, "photometry") is None:
        keys = np.arange(len(photometry))
    else:
        keys = read_ids(photometry)
    noise = np.empty(len(keys))
    for k, key in enumerate(keys):
        noise[k] = stream(seed, "photometry", name, str(key)).standard_normal()
    photometry[name] = photometry[name] + noise * sigma
    photometry[error_column(name)] = sigma


@value_class
class ErrorModel(WithTable):
    """
    The 1-sigma error of a flux, band by band; make it with one of the class methods.

    Parameters
    ----------
    curves : dict
        Filter name to the curve of its error.
    meta : dict, optional
        Where it came from.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.photometry import ErrorModel
    >>> model = ErrorModel.from_depths({"wfc3.f160w": 27.6}, fractional=0.03)
    >>> print(f"{model.sigma(10 * u.uJy, 'wfc3.f160w'):.4f}")
    0.3001 uJy
    """

    io_module: ClassVar[str] = "miricigale.photometry.errors.error_files"
    read, write = read_write("the curves of all bands")

    curves: dict
    meta: dict = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        curves = {_band(name): curve for name, curve in self.curves.items()}
        object.__setattr__(self, "curves", types.MappingProxyType(curves))
        object.__setattr__(self, "meta", dict(self.meta))

    def __repr__(self):
        return f"<ErrorModel of {', '.join(self.curves)}>"

    def __reduce__(self):
        return type(self), (dict(self.curves), self.meta)

    def __or__(self, other):
        """Join two models; where both know a band the right one counts."""
        if not isinstance(other, ErrorModel):
            return NotImplemented
        return ErrorModel({**self.curves, **other.curves}, {**self.meta, **other.meta})

    @property
    def filters(self):
        """Names of the bands."""
        return tuple(self.curves)

    def _curve(self, name):
        """Return the curve of a band, which may be left out if there is only one."""
        if name is None and len(self.curves) == 1:
            (curve,) = self.curves.values()
            return curve
        try:
            return self.curves[_band(name)]
        except KeyError:
            raise unknown_name("band of this error model", name, self.curves) from None

    @classmethod
    def from_tables(
        cls, truth, measured, *, filters=None, statistic="mad", bin_size=30, noise=None
    ):
        """
        Measure errors on simulated photometry.

        Parameters
        ----------
        truth, measured : `~astropy.table.QTable`
            True and measured fluxes, columns by filter name. Rows are matched by ``id`` if
            both have it, otherwise by place. Sources whose measured flux is NaN do not count.
        filters : iterable of str, optional
            Bands; those that both tables have by default.
        statistic : {"mad", "median_abs"}, optional
            ``"mad"`` is 1.4826 times the median of abs(measured - true) in a bin, the
            standard deviation of Gaussian errors. ``"median_abs"`` is that median itself, two thirds
            of it, bin by bin as in the paper.
        bin_size : int, optional
            Sources per bin, in order of true flux; a remainder joins the faintest bin.
        noise : dict of str to `~numpy.ndarray`, optional
            By filter name: noise at the place of each row of ``measured`` in units of that which the
            model describes, such as the root of a reference time over the exposure time there. Sources
            where it is not positive and finite do not count.

        Returns
        -------
        model : `ErrorModel`
            Errors at the median true flux of each bin, joined in asinh(flux), constant
            beyond the first and last. With ``"mad"`` bins are pooled until both the error and
            the signal-to-noise rise with flux (isotonic regression); with ``"median_abs"`` each is
            used as it is, and the limit may be that of an unlucky one.

        Raises
        ------
        ValueError
            If there are fewer than three sources in a band, or the noise has another number of rows.

        References
        ----------
        Yang et al. 2021, ApJ 908, 144, section 4.2.
        """
        check_choice(statistic, "statistic", STATISTICS)
        check_least(bin_size, "bin_size", 3)
        if filters is None:
            filters = common_bands(truth, measured)
        filters = list(filters)
        for table, argument in ((truth, "truth"), (measured, "measured")):
            require_columns(table, filters, argument, units=dict.fromkeys(filters, FNU))
        # the same sources of both tables
        rows_true, rows_measured = same_rows(truth, measured)
        curves = {}
        for name in filters:
            true = to_array(truth[name], FNU, name)[rows_true]
            fluxes = to_array(measured[name], FNU, name)[rows_measured]
            relative = _relative_noise(noise, name, len(measured))[rows_measured]
            good = np.isfinite(true) & np.isfinite(fluxes) & np.isfinite(relative)
            # the scatter as it would be with the noise that the model describes
            scatter = (fluxes - true)[good] / relative[good]
            true = true[good]
            curves[name] = measured_curve(name, true, true + scatter, int(bin_size), statistic)
        return cls(curves, provenance(source="tables", statistic=statistic, bin_size=bin_size))

    @classmethod
    @takes_other_keywords
    def from_depths(cls, depths, *, fractional=0.0):
        """
        Take errors from survey depths.

        Parameters
        ----------
        depths : dict
            Filter name to the 5-sigma depth: AB magnitude as number, or a quantity.
        fractional : float or dict, optional
            Part of the flux that is added in quadrature, for all or by filter name.

        Returns
        -------
        model : `ErrorModel`
        """
        curves = {}
        for name, depth in depths.items():
            limit = ab_quantity(depth).to_value(FNU)
            part = fractional
            if isinstance(fractional, dict):
                part = fractional.get(name, 0.0)
            if not (np.isfinite(limit) and limit > 0):
                raise argument_error("depths", "finite depths", f"{depth} for {name!r}")
            check_that(part >= 0, "fractional", "at least 0", f"{part} for {name!r}")
            curves[name] = Analytic(limit / 5, float(part))
        return cls(curves, provenance(source="depths"))

    @classmethod
    def yang2021(cls):
        """
        Make the errors of 15 existing bands like the paper's; depths and fractions are the package's choice.

        Returns
        -------
        model : `ErrorModel`
            A fifth of `YANG2021_DEPTHS`, and 3 % of the flux (10 % for IRAC and MIPS).
        """
        fractional = {name: fractional_error(name) for name in YANG2021_DEPTHS}
        return cls.from_depths(YANG2021_DEPTHS, fractional=fractional)

    @classmethod
    def from_exposure(cls, filter, time=None, *, fractional=0.0, excess="flight", **options):
        """
        Compute the noise of sources fitted on the mosaic of an exposure.

        Parameters
        ----------
        filter : str, `~miricigale.instrument.Exposure` or list of `~miricigale.instrument.Exposure`
            Any name of one of the imaging filters; or an exposure, which has the time, integrations and frames; or
            exposures of several filters, of which those of one filter, such as dithers, add up.
        time : `~astropy.units.Quantity`, optional
            Total exposure time.
        fractional : float, optional
            Part of the flux that is added in quadrature.
        excess : {"flight", "ideal"} or float, optional
            Factor on the noise of the sky: by default that of surveys in flight, 1.4; ``"ideal"`` is a fit of a
            source of known shape on a clean sky.
        **options
            ``background``, ``size``, ``psf``, ``n_integrations``, ``frame_time``, ``n_frames``, ``n_dithers``,
            ``residual``, ``mosaic``, ``subarray`` and ``detector``, as for `~miricigale.depth.fitted_noise`.

        Returns
        -------
        model : `ErrorModel`

        Raises
        ------
        ValueError
            If a number is out of its range, or an integration has less than two frames.

        Notes
        -----
        Scatter of simulated, reduced and fitted point sources over ideal errors, nine filters at three
        depths: see ``benchmarks/exposure_errors.py``. Galaxies have larger errors, by
        ``size`` and by what is not known of their templates (``flux_err_template`` of
        `ForcedPhotometryResult`).
        """
        # loads photutils, which a command that reads depths does without
        from miricigale.depth import fitted_noise

        if isinstance(filter, (list, tuple)):
            check_that(time is None, "time", "left out for a list of exposures", time)
            options |= {"fractional": fractional, "excess": excess}
            return cls._of_exposures(filter, options)
        if isinstance(filter, Exposure):
            for name in ("n_integrations", "frame_time", "n_frames", "subarray"):
                options.setdefault(name, getattr(filter, name))
            time = filter.exposure_time if time is None else time
            filter = filter.filter
        check_that(time is not None, "time", "given, or an Exposure", "None")
        filter = imager_filter(filter)
        # noise of the sky, and variance by the source's own photons for a unit flux
        sky, photon = fitted_noise(filter, time, excess=excess, **options)
        curve = Analytic(sky, float(fractional), photon)
        return cls({str(filter): curve}, provenance(source="exposure"))

    @classmethod
    def _of_exposures(cls, exposures, options):
        """Compute the noise of each filter of some exposures; those of one filter are dithers."""
        dithers = {}
        for exposure in exposures:
            if not isinstance(exposure, Exposure):
                raise argument_error("filter", "a list of exposures", repr(exposure))
            dithers.setdefault(exposure.filter, []).append(exposure)
        check_that(dithers, "filter", "one exposure or more", "none")
        curves = {}
        for name, parts in dithers.items():
            first = parts[0]
            for setting in ("n_integrations", "frame_time", "n_frames", "subarray", "n_groups"):
                values = {str(getattr(part, setting)) for part in parts}
                wanted = f"exposures in {name} of one {setting}"
                check_that(len(values) == 1, "filter", wanted, ", ".join(sorted(values)))
            time = sum(part.exposure_time for part in parts)
            own = {"n_dithers": len(parts)} | options
            curves |= cls.from_exposure(first, time, **own).curves
        return cls(curves, provenance(source="exposure"))

    def sigma(self, flux, filter=None):
        """
        Return the 1-sigma error of a flux in uJy.

        Parameters
        ----------
        flux : `~astropy.units.Quantity`
            Of any shape and sign.
        filter : str, optional
            Band; needed if there are several.

        Returns
        -------
        sigma : `~astropy.units.Quantity`
            In uJy, NaN for NaN. Beyond the bins it is that of the outermost bin: see
            `extrapolated`.
        """
        return self._curve(filter).sigma(to_array(flux, FNU, "flux")) * FNU

    def snr(self, flux, filter=None):
        """Return the signal-to-noise ratio of a flux; parameters are those of `sigma`."""
        return (flux / self.sigma(flux, filter)).to_value(u.dimensionless_unscaled)

    def extrapolated(self, flux, filter=None):
        """
        Find fluxes outside of the range in which the model was measured.

        Parameters are those of `sigma`.

        Returns
        -------
        extrapolated : bool `~numpy.ndarray`
        """
        return self._curve(filter).outside(to_array(flux, FNU, "flux"))

    @takes_other_keywords
    def limiting_flux(self, filter=None, n_sigma=5.0):
        """
        Find the flux (uJy) above which the signal-to-noise exceeds a value.

        Parameters
        ----------
        filter : str or list of str, optional
            Band, or bands, of which each has its limit; all of the model by default.
        n_sigma : float, optional
            The value.

        Returns
        -------
        flux : `~astropy.units.Quantity`, scalar or shape (n_filters,)
            In uJy; NaN if no flux reaches it up to the brightest that was measured.
            Errors are held constant below the faintest.
        """
        check_positive(n_sigma, "n_sigma")
        if filter is None and len(self.curves) > 1:
            filter = list(self.curves)
        if isinstance(filter, (list, tuple)):
            return u.Quantity([self.limiting_flux(band, n_sigma) for band in filter])
        return limiting_flux(self._curve(filter), n_sigma) * FNU

    @takes_other_keywords
    def limiting_magnitude(self, filter=None, n_sigma=5.0):
        """
        Find the AB magnitude at which the signal-to-noise reaches a value.

        Parameters
        ----------
        filter : str or list of str, optional
            Band, or bands, of which each has its limit; all of the model by default.
        n_sigma : float, optional
            Signal-to-noise at the limit (the paper's error of 0.217 mag is one of 5.003).

        Returns
        -------
        limit : `~astropy.units.Magnitude`, scalar or shape (n_filters,)
            AB; NaN if no flux reaches it.
        """
        return self.limiting_flux(filter, n_sigma).to(u.ABmag)

    def assign(self, photometry, *, filters=None, noise=None):
        """
        Give fluxes the errors of this model.

        Parameters
        ----------
        photometry : `~astropy.table.QTable`
            With flux columns by filter name.
        filters : iterable of str or `~miricigale.filters.Filter`, optional
            Bands; those of the model that the table has by default.
        noise : dict of str to `~numpy.ndarray`, optional
            As in `from_tables`: by filter name, a factor for each row. Where it is not positive and
            finite there is no error (NaN).

        Returns
        -------
        table : `~astropy.table.QTable`
            A copy with error columns.

        Raises
        ------
        ValueError
            If the table has no band that the model knows, or lacks one of ``filters``, or the noise has
            another number of rows.
        """
        table, filters = flux_table(photometry, filters, self.filters)
        for name in filters:
            relative = _relative_noise(noise, name, len(table))
            table[error_column(name)] = relative * self.sigma(table[name], name)
        return BandTable(table, copy=False)

    def perturb(self, photometry, *, seed, filters=None):
        """
        Draw what would be measured.

        Parameters
        ----------
        photometry : `~astropy.table.QTable`
            True fluxes, columns by filter name. Draws belong to the ids if there are any,
            otherwise to the row, so that a cut in the table does not change them.
        seed : int
            Seed.
        filters : iterable of str, optional
            As in `assign`.

        Returns
        -------
        table : `~astropy.table.QTable`
            A copy with Gaussian noise of the error at the true flux added to the fluxes, and
            that error in the error columns.

        Raises
        ------
        ValueError
            As `assign`.
        """
        table, filters = flux_table(photometry, filters, self.filters)
        seed = check_seed(seed)
        for name in filters:
            add_noise(table, name, self.sigma(table[name], name), seed)
        return BandTable(table, copy=False)

    def to_table(self):
        """
        Make a table of all curves, from which `from_table` makes the model again.

        Returns
        -------
        table : `~astropy.table.QTable`
            A row for each node (binned) or filter (analytic).
        """
        return curves_to_table(self.curves, self.meta)

    @classmethod
    def from_table(cls, table):
        """Make the model of a table that `to_table` made."""
        return cls(curves_from_table(table), dict(table.meta))

    def plot(self, ax=None, *, filters=None):
        """
        Draw error against flux, with the 5-sigma limits.

        Parameters
        ----------
        ax : `~matplotlib.axes.Axes`, optional
            Where to draw.
        filters : iterable of str, optional
            Bands; all by default.

        Returns
        -------
        ax : `~matplotlib.axes.Axes`
        """
        from miricigale.plotting.comparison import plot_error_function

        fluxes = {}
        sigmas = {}
        limits = {}
        for name in self.filters if filters is None else filters:
            limits[name] = self.limiting_flux(name).value
            middle = limits[name] if np.isfinite(limits[name]) else 1.0
            fluxes[name] = middle * np.geomspace(0.03, 300, 200)
            sigmas[name] = self._curve(name).sigma(fluxes[name])
        return plot_error_function(fluxes, sigmas, limits=limits, ax=ax)


def _relative_noise(noise, name, n):
    """Return noise factors of ``n`` rows in a band: 1 without any, NaN where not positive and finite."""
    if noise is None:
        return np.ones(n)
    values = to_array(noise[name], u.one, "noise", ndim=1)
    check_that(len(values) == n, "noise", f"a factor for each of {n} rows in {name!r}", len(values))
    return np.where(np.isfinite(values) & (values > 0), values, np.nan)
