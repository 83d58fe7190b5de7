"""Errors as a function of flux: from simulations, from an exposure, from survey depths."""

import dataclasses
import itertools
import types

import astropy.units as u
import numpy as np
from astropy.table import QTable
from scipy.ndimage import gaussian_filter
from scipy.optimize import brentq

from miricigale.instrument import background_level, miri_detector, photmjsr
from miricigale.psf import MIRI_PIXEL_SCALE, miri_psf, psf_image
from miricigale.utils.exceptions import argument_error, unknown_name
from miricigale.utils.meta import provenance
from miricigale.utils.random import check_seed, stream
from miricigale.utils.tables import error_column, require_columns
from miricigale.utils.units import ANGLE, FNU, SURFACE_BRIGHTNESS, to_array

__all__ = ["YANG2021_DEPTHS", "ErrorModel"]

#: 5-sigma AB depths of the paper's 15 existing bands (after Stefanon 2017 and FIDEL).
YANG2021_DEPTHS = types.MappingProxyType(
    {
        "megacam.u": 27.1,
        "megacam.g": 27.3,
        "megacam.r": 27.2,
        "megacam.i": 27.0,
        "megacam.z": 26.1,
        "acs.f606w": 28.8,
        "acs.f814w": 28.2,
        "wfc3.f125w": 27.6,
        "wfc3.f140w": 26.8,
        "wfc3.f160w": 27.6,
        "irac.ch1": 23.9,
        "irac.ch2": 24.2,
        "irac.ch3": 22.5,
        "irac.ch4": 22.8,
        "mips.24": 19.3,
    }
)

#: What turns the median of absolute values into a standard deviation.
_STATISTICS = {"mad": 1.482602218505602, "median_abs": 1.0}


@dataclasses.dataclass(frozen=True, eq=False)
class _Binned:
    """Errors at nodes in flux, joined by straight lines in asinh(flux)."""

    flux: np.ndarray
    error: np.ndarray
    low: float
    high: float
    kind = "binned"

    def sigma(self, flux):
        scale = self.error[0] if self.error[0] > 0 else 1.0
        return np.interp(np.arcsinh(flux / scale), np.arcsinh(self.flux / scale), self.error)

    def outside(self, flux):
        return (flux < self.low) | (flux > self.high)

    def rows(self):
        nan = np.full(len(self.flux), np.nan)
        ends = [np.full(len(self.flux), v) for v in (self.low, self.high)]
        return [self.flux, self.error, *ends, nan, nan]


@dataclasses.dataclass(frozen=True, eq=False)
class _Analytic:
    """sigma^2 = sky^2 + fraction^2 flux^2 + photon max(flux, 0)."""

    sky: float
    fraction: float = 0.0
    photon: float = 0.0
    kind = "analytic"
    high = np.inf

    def sigma(self, flux):
        return np.sqrt(
            self.sky**2 + (self.fraction * flux) ** 2 + self.photon * np.maximum(flux, 0)
        )

    def outside(self, flux):
        return np.zeros(np.shape(flux), bool)

    def rows(self):
        return [
            np.array([v]) for v in (np.nan, self.sky, np.nan, np.nan, self.fraction, self.photon)
        ]


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class ErrorModel:
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

    curves: dict
    meta: dict = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        object.__setattr__(self, "curves", types.MappingProxyType(dict(self.curves)))
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
        try:
            return self.curves[name]
        except KeyError:
            raise unknown_name("band of this error model", name, self.curves) from None

    @classmethod
    def from_tables(cls, truth, measured, *, filters=None, statistic="mad", bin_size=30):
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
            standard deviation of Gaussian errors. ``"median_abs"`` is that median itself, as
            in the paper: two thirds of it.
        bin_size : int, optional
            Sources per bin, in order of true flux; a remainder joins the faintest bin.

        Returns
        -------
        model : `ErrorModel`
            Errors at the median true flux of each bin, joined in asinh(flux), constant
            beyond the first and last.

        Raises
        ------
        ValueError
            If there are fewer than three sources in a band.

        References
        ----------
        Yang et al. 2021, ApJ 908, 144, section 4.2.
        """
        if statistic not in _STATISTICS:
            raise argument_error("statistic", f"one of {sorted(_STATISTICS)}", repr(statistic))
        if int(bin_size) < 3:
            raise argument_error("bin_size", "at least 3", bin_size)
        if filters is None:
            errors = {error_column(name) for name in truth.colnames}
            filters = [
                name
                for name in truth.colnames
                if name in measured.colnames
                and name not in errors
                and getattr(truth[name], "unit", None) is not None
                and u.Unit(truth[name].unit).is_equivalent(FNU)
            ]
        filters = list(filters)
        for table, argument in ((truth, "truth"), (measured, "measured")):
            require_columns(table, filters, argument, units=dict.fromkeys(filters, FNU))
        rows_true, rows_measured = _same_rows(truth, measured)
        curves = {}
        for name in filters:
            true = to_array(truth[name], FNU, name)[rows_true]
            seen = to_array(measured[name], FNU, name)[rows_measured]
            good = np.isfinite(true) & np.isfinite(seen)
            curves[name] = _bins(name, true[good], seen[good], int(bin_size), statistic)
        return cls(curves, provenance(source="tables", statistic=statistic, bin_size=bin_size))

    @classmethod
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
            depth = depth if hasattr(depth, "unit") else float(depth) * u.ABmag
            limit = float(depth.to_value(FNU))
            part = fractional.get(name, 0.0) if isinstance(fractional, dict) else fractional
            if not (np.isfinite(limit) and limit > 0):
                raise argument_error("depths", "finite depths", f"{depth} for {name!r}")
            if not part >= 0:
                raise argument_error("fractional", "at least 0", f"{part} for {name!r}")
            curves[name] = _Analytic(limit / 5, float(part))
        return cls(curves, provenance(source="depths"))

    @classmethod
    def yang2021(cls):
        """
        Errors of the paper's 15 existing bands.

        Returns
        -------
        model : `ErrorModel`
            A fifth of `YANG2021_DEPTHS`, and 3 % of the flux (10 % for IRAC and MIPS).
        """
        fractional = {
            name: 0.10 if name.startswith(("irac", "mips")) else 0.03 for name in YANG2021_DEPTHS
        }
        return cls.from_depths(YANG2021_DEPTHS, fractional=fractional)

    @classmethod
    def from_exposure(
        cls,
        filter,
        time,
        *,
        background=None,
        size=0.0 * u.arcsec,
        psf=None,
        n_integrations=1,
        frame_time=2.775 * u.s,
        fractional=0.0,
    ):
        """
        Compute photon and read noise of an exposure.

        Parameters
        ----------
        filter : str
            One of the imaging filters.
        time : `~astropy.units.Quantity`
            Total exposure time.
        background : `~astropy.units.Quantity`, optional
            Surface brightness of sky and telescope; the low background by default.
        size : `~astropy.units.Quantity`, optional
            FWHM of the source (a Gaussian) before the PSF; a point by default.
        psf : `~photutils.psf.ImagePSF`, optional
            PSF of the exposure; `~miricigale.psf.miri_psf` by default.
        n_integrations : int, optional
            Ramps into which the time is divided (over all dithers).
        frame_time : `~astropy.units.Quantity`, optional
            Time of one frame.
        fractional : float, optional
            Part of the flux that is added in quadrature.

        Returns
        -------
        model : `ErrorModel`

        Notes
        -----
        Optimal extraction: with P the share of light of each pixel, the sky counts with
        1 / sum(P^2) pixels and the source's own photons with sum(P^3) / sum(P^2)^2. Ramps
        are fitted with equal weights as to read noise. No calibration error, correlated
        residual or crowding is in it: it is a lower limit, by a factor of about two
        below the exposure time calculator's (see the guide).
        """
        seconds = float(to_array(time, u.s, "time"))
        if not seconds > 0:
            raise argument_error("time", "positive", time)
        if int(n_integrations) < 1:
            raise argument_error("n_integrations", "at least 1", n_integrations)
        step = float(to_array(frame_time, u.s, "frame_time"))
        level = background_level(filter) if background is None else background
        level = float(to_array(level, SURFACE_BRIGHTNESS, "background"))
        detector = miri_detector()
        conversion = photmjsr(filter)
        n_frames = seconds / n_integrations / step
        if n_frames < 2:
            raise argument_error(
                "time", f"at least two frames of {step} s in each integration", time
            )
        electrons = level / conversion * detector.gain + detector.dark_current
        variance = electrons / seconds
        read = detector.read_noise * detector.gain
        variance += 12 * read**2 / (n_frames * (n_frames**2 - 1) * step**2) / n_integrations
        pixel_noise = np.sqrt(variance) / detector.gain * conversion
        pixel = u.Quantity(MIRI_PIXEL_SCALE, ANGLE).value
        per_pixel = (pixel * u.arcsec).to_value(u.rad) ** 2 * 1e12  # uJy per MJy/sr
        share = psf_image(
            miri_psf(filter) if psf is None else psf, pixel_scale=pixel * ANGLE, shape=91
        )
        width = float(to_array(size, ANGLE, "size"))
        if not width >= 0:
            raise argument_error("size", "at least 0", size)
        if width > 0:
            share = gaussian_filter(share, width / np.sqrt(8 * np.log(2)) / pixel)
        power = np.sum(share**2)
        sky = pixel_noise * per_pixel / np.sqrt(power)
        photon = np.sum(share**3) / power**2 * per_pixel * conversion / detector.gain / seconds
        return cls(
            {str(filter): _Analytic(float(sky), float(fractional), float(photon))},
            provenance(source="exposure"),
        )

    def sigma(self, flux, filter):
        """
        The error of a flux.

        Parameters
        ----------
        flux : `~astropy.units.Quantity`
            Of any shape and sign.
        filter : str
            Band.

        Returns
        -------
        sigma : `~astropy.units.Quantity`
            In uJy, NaN for NaN. Beyond the bins it is that of the outermost bin: see
            `extrapolated`.
        """
        return self._curve(filter).sigma(to_array(flux, FNU, "flux")) * FNU

    def extrapolated(self, flux, filter):
        """
        Tell which fluxes lie outside of what the model was measured on.

        Parameters are those of `sigma`.

        Returns
        -------
        extrapolated : bool `~numpy.ndarray`
        """
        return self._curve(filter).outside(to_array(flux, FNU, "flux"))

    def limiting_flux(self, filter, n_sigma=5.0):
        """
        The flux above which the signal-to-noise exceeds a value.

        Parameters
        ----------
        filter : str
            Band.
        n_sigma : float, optional
            The value.

        Returns
        -------
        flux : `~astropy.units.Quantity`
            In uJy; NaN if no flux reaches it up to the brightest that was measured.
            Errors are held constant below the faintest.
        """
        if not n_sigma > 0:
            raise argument_error("n_sigma", "positive", n_sigma)
        curve = self._curve(filter)

        def excess(flux):
            return flux - n_sigma * float(curve.sigma(flux))

        grid = np.geomspace(1e-9, 1e9, 3601)
        below = np.flatnonzero(grid < n_sigma * curve.sigma(grid))
        if len(below) == 0:
            return grid[0] * FNU
        last = below[-1]
        if last == len(grid) - 1:
            return np.nan * FNU
        limit = brentq(excess, grid[last], grid[last + 1], rtol=1e-12)
        return (np.nan if limit > curve.high else limit) * FNU

    def limiting_magnitude(self, filter, n_sigma=5.0, *, magnitude_error=None):
        """
        The limit as AB magnitude.

        Parameters
        ----------
        filter : str
            Band.
        n_sigma : float, optional
            Signal-to-noise at the limit.
        magnitude_error : float, optional
            Instead of ``n_sigma``: the error in magnitudes at the limit (the paper takes
            0.217, which is 2.5 / ln(10) / 5).

        Returns
        -------
        limit : `~astropy.units.Magnitude`
            AB; NaN if no flux reaches it.
        """
        if magnitude_error is not None:
            if not magnitude_error > 0:
                raise argument_error("magnitude_error", "positive", magnitude_error)
            n_sigma = 2.5 / np.log(10) / magnitude_error
        return self.limiting_flux(filter, n_sigma).to(u.ABmag)

    def assign(self, photometry, *, filters=None):
        """
        Give fluxes the errors of this model.

        Parameters
        ----------
        photometry : `~astropy.table.QTable`
            With flux columns by filter name.
        filters : iterable of str, optional
            Bands; those of the model that the table has by default.

        Returns
        -------
        table : `~astropy.table.QTable`
            A copy with error columns.
        """
        table, filters = self._prepare(photometry, filters)
        for name in filters:
            table[error_column(name)] = self.sigma(table[name], name)
        return table

    def perturb(self, photometry, *, seed, filters=None):
        """
        Draw what would be measured.

        Parameters
        ----------
        photometry : `~astropy.table.QTable`
            True fluxes, columns by filter name. Draws belong to the ``id`` if there is one,
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
        """
        table, filters = self._prepare(photometry, filters)
        seed = check_seed(seed)
        keys = table["id"] if "id" in table.colnames else np.arange(len(table))
        for name in filters:
            sigma = self.sigma(table[name], name)
            noise = [stream(seed, "photometry", name, str(key)).standard_normal() for key in keys]
            table[name] = table[name] + np.array(noise) * sigma
            table[error_column(name)] = sigma
        return table

    def _prepare(self, photometry, filters):
        if filters is None:
            filters = [name for name in self.filters if name in photometry.colnames]
        filters = list(filters)
        require_columns(photometry, filters, "photometry", units=dict.fromkeys(filters, FNU))
        for name in filters:
            self._curve(name)
        table = QTable(photometry, copy=True)
        for name in filters:
            table[name] = u.Quantity(table[name]).to(FNU)
        return table, filters

    def to_table(self):
        """
        Make a table of all curves, from which `from_table` makes the model again.

        Returns
        -------
        table : `~astropy.table.QTable`
            A row for each node (binned) or filter (analytic).
        """
        names, kinds, rows = [], [], []
        for name, curve in self.curves.items():
            values = np.stack(curve.rows())
            rows.append(values)
            names += [name] * values.shape[1]
            kinds += [curve.kind] * values.shape[1]
        values = np.concatenate(rows, axis=1) if rows else np.empty((6, 0))
        table = QTable({"filter": names, "kind": kinds}, meta=dict(self.meta))
        columns = (
            ("flux", FNU, "Median true flux of the bin"),
            ("sigma", FNU, "1-sigma error there, or that of the sky"),
            ("low", FNU, "Least true flux of all bins"),
            ("high", FNU, "Greatest true flux of all bins"),
            ("fraction", u.dimensionless_unscaled, "Part of the flux added in quadrature"),
            ("photon", FNU, "Variance per flux of the source's own photons"),
        )
        for (name, unit, text), value in zip(columns, values, strict=True):
            table[name] = value * unit
            table[name].info.description = text
        return table

    @classmethod
    def from_table(cls, table):
        """Make the model of a table that `to_table` made."""
        wanted = ["filter", "kind", "flux", "sigma", "low", "high", "fraction", "photon"]
        require_columns(table, wanted, "table")
        curves = {}
        filters = np.asarray(table["filter"]).astype(str)
        for name in dict.fromkeys(filters):
            part = table[filters == name]
            flux, sigma, low, high, photon = (
                u.Quantity(part[c]).to_value(FNU)
                for c in ("flux", "sigma", "low", "high", "photon")
            )
            if part["kind"][0] == "binned":
                curves[name] = _Binned(flux, sigma, float(low[0]), float(high[0]))
            else:
                fraction = float(u.Quantity(part["fraction"][0]).value)
                curves[name] = _Analytic(float(sigma[0]), fraction, float(photon[0]))
        return cls(curves, dict(table.meta))

    def write(self, path, *, overwrite=False):
        """Write the curves as an ECSV table."""
        self.to_table().write(path, format="ascii.ecsv", overwrite=overwrite)

    @classmethod
    def read(cls, path):
        """Read what `write` wrote."""
        return cls.from_table(QTable.read(path, format="ascii.ecsv"))

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

        fluxes, sigmas, limits = {}, {}, {}
        for name in self.filters if filters is None else filters:
            limits[name] = self.limiting_flux(name).value
            middle = limits[name] if np.isfinite(limits[name]) else 1.0
            fluxes[name] = middle * np.geomspace(0.03, 300, 200)
            sigmas[name] = self._curve(name).sigma(fluxes[name])
        return plot_error_function(fluxes, sigmas, limits=limits, ax=ax)


def _same_rows(truth, measured):
    if "id" in truth.colnames and "id" in measured.colnames:
        _, rows, others = np.intersect1d(
            np.asarray(truth["id"]), np.asarray(measured["id"]), return_indices=True
        )
        return rows, others
    if len(truth) != len(measured):
        raise argument_error(
            "measured", f"a table of {len(truth)} rows as 'truth', or ids in both", len(measured)
        )
    rows = np.arange(len(truth))
    return rows, rows


def _bins(name, true, seen, size, statistic):
    if len(true) < 3:
        raise argument_error(
            "measured", f"at least three measured sources in {name!r}", f"{len(true)}"
        )
    order = np.argsort(-true, kind="stable")
    edges = np.arange(0, max(len(true) // size, 1) * size + 1, size)
    edges[-1] = len(true)
    parts = [order[a:b] for a, b in itertools.pairwise(edges)][::-1]
    flux, error = np.transpose([_scatter(true[part], seen[part]) for part in parts])
    return _Binned(flux, error * _STATISTICS[statistic], float(true.min()), float(true.max()))


def _scatter(true, seen):
    """
    Median true flux of a bin and median absolute deviation there.

    Bright sources scatter in proportion to their flux (templates, blends), faint ones by the
    noise of the sky. Where the signal-to-noise is above 5 the deviations are taken relative to
    each flux, or the brightest of a wide bin would set the error of the faintest.
    """
    flux = np.median(true)
    absolute = np.median(np.abs(seen - true))
    if flux > 5 * absolute and np.all(true > 0):
        return flux, flux * np.median(np.abs(seen / true - 1.0))
    return flux, absolute
