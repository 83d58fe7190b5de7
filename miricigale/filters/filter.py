"""Passbands."""

import dataclasses
import functools
from pathlib import Path

import astropy.units as u
import numpy as np

from miricigale.filters import _core
from miricigale.filters.library import FILTERS, full_name, load_curve
from miricigale.utils.exceptions import DataError, argument_error
from miricigale.utils.files import unpacked_size
from miricigale.utils.units import FNU, WAVE, Frozen, frozen_array, frozen_quantity, to_array

#: Version of the band averages: raised when the same curve gives other numbers.
VERSION = 1

#: Share of a band that a spectrum may leave uncovered.
UNCOVERED = 1e-4

# relative width of the step to zero at the end of a curve that does not end in zero
_STEP = 1e-6


def _padded(wave, throughput):
    """Trim zeros to one at each end, or add it."""
    inside = np.flatnonzero(throughput)
    first, last = max(inside[0] - 1, 0), min(inside[-1] + 1, wave.size - 1)
    wave, throughput = wave[first : last + 1], throughput[first : last + 1]
    if throughput[0] != 0:
        wave = np.concatenate([[wave[0] * (1 - _STEP)], wave])
        throughput = np.concatenate([[0.0], throughput])
    if throughput[-1] != 0:
        wave = np.concatenate([wave, [wave[-1] * (1 + _STEP)]])
        throughput = np.concatenate([throughput, [0.0]])
    return wave, throughput


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Filter(Frozen):
    """
    A passband: the response to photons against wavelength.

    Parameters
    ----------
    wave : `~astropy.units.Quantity`, shape (n,)
        Strictly ascending wavelengths.
    throughput : array_like, shape (n,)
        Detected share of the photons, or anything in proportion; not negative. Between
        the wavelengths it is linear. Zeros beyond the first at each end are trimmed, and
        a curve that does not end in zero gets a step there.
    name : str
        Name of the filter, and of its flux columns.
    meta : dict, optional
        Source, citation, flux convention of the catalogs, in words.
    reference_wavelength : `~astropy.units.Quantity`, optional
        Where catalogs quote fluxes, if these are not AB means; see `catalog_factor`.
    reference_temperature : `~astropy.units.Quantity`, optional
        Of the black body whose flux is quoted; none: of nu F_nu = const.

    Raises
    ------
    ValueError
        If wavelengths do not ascend, or a throughput is negative, or all are zero.
    `~astropy.units.UnitsError`
        If ``wave`` is no wavelength.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.filters import Filter
    >>> Filter([9, 9.5, 10.5, 11] * u.um, [0, 1, 1, 0], name="mine").pivot
    <Quantity 9.98955573 um>
    """

    wave: u.Quantity
    throughput: np.ndarray
    _: dataclasses.KW_ONLY
    name: str
    meta: dict | None = None
    reference_wavelength: u.Quantity | None = None
    reference_temperature: u.Quantity | None = None

    def __post_init__(self):
        wave = to_array(self.wave, WAVE, "wave", ndim=1, finite=True)
        throughput = to_array(self.throughput, u.one, "throughput", ndim=1, finite=True)
        if wave.size < 2 or wave.shape != throughput.shape:
            shapes = f"{wave.shape} and {throughput.shape}"
            raise argument_error("throughput", "as many values as 'wave', two or more", shapes)
        if not (wave[0] > 0 and np.all(np.diff(wave) > 0)):
            raise argument_error("wave", "positive and strictly ascending", wave)
        if np.any(throughput < 0) or not np.any(throughput > 0):
            raise argument_error("throughput", "not negative, and somewhere positive", throughput)
        wave, throughput = _padded(wave, throughput)
        object.__setattr__(self, "wave", frozen_quantity(wave * WAVE, WAVE, "wave"))
        object.__setattr__(self, "throughput", frozen_array(throughput))
        object.__setattr__(self, "name", str(self.name))
        object.__setattr__(self, "meta", dict(self.meta or {}))
        for argument, unit in (("reference_wavelength", WAVE), ("reference_temperature", u.K)):
            value = getattr(self, argument)
            if value is not None:
                value = frozen_quantity(value, unit, argument, ndim=0, finite=True)
                object.__setattr__(self, argument, value)

    def __repr__(self):
        return f"<Filter {self.name}: pivot {self.pivot:.4f}, width {self.width:.3f}>"

    @classmethod
    def from_name(cls, name):
        """
        Make a filter of the library.

        Parameters
        ----------
        name : str
            One of `names`, such as ``"miri.f770w"``, also written ``"MIRI.F770W"`` or ``"F770W"``,
            or ``"sedpy."`` and the name of any curve of astro-sedpy.

        Returns
        -------
        filter : `Filter`
            The same object for the same name.

        Raises
        ------
        KeyError
            If there is no such filter; the message lists the known ones.
        """
        return _from_name(full_name(name))

    @staticmethod
    def names():
        """Names of the library, sorted, as a tuple."""
        return tuple(FILTERS.names())

    @classmethod
    def read(cls, path, *, name=None, unit=u.AA):
        """
        Read a filter from a text file.

        Parameters
        ----------
        path : path-like
            Two columns, wavelength and throughput. Comment lines start with ``#``; those
            at the top may hold, as in CIGALE's files, the name, the word ``photon`` or
            ``energy`` (what the throughput counts, else photons) and a description.
        name : str, optional
            Name of the filter; else the one in the file, else that of the file.
        unit : `~astropy.units.Unit`, optional
            Unit of the wavelengths.

        Returns
        -------
        filter : `Filter`

        Raises
        ------
        `~miricigale.utils.exceptions.DataError`
            If the file is missing or has not two columns of numbers.
        """
        path = Path(path)
        unpacked_size(path)
        try:
            lines = path.read_text().splitlines()
        except (OSError, UnicodeDecodeError) as err:
            msg = f"filter file {path} cannot be read: {err}"
            raise DataError(msg) from None
        comments = [line.lstrip("# ").strip() for line in lines if line.startswith("#")]
        try:
            data = np.array(
                [line.split()[:2] for line in lines if line[:1] not in ("#", "")], float
            )
            wave, throughput = data.T
        except ValueError:
            msg = f"filter file {path} has not two columns of numbers"
            raise DataError(msg) from None
        kinds = [text.lower() for text in comments[:3] if text.lower() in ("photon", "energy")]
        if name is None:
            name = comments[0] if kinds and comments[0].lower() not in kinds else path.stem
        order = np.argsort(wave)
        wave, throughput = wave[order], throughput[order]
        if kinds[:1] == ["energy"]:
            throughput = throughput / (wave / wave.mean())
        return cls(wave * u.Unit(unit), throughput, name=name, meta={"source": path.name})

    @classmethod
    def from_synphot(cls, bandpass, *, name):
        """
        Make a filter of a synphot bandpass.

        Parameters
        ----------
        bandpass : `synphot.SpectralElement`
            With a finite wavelength set.
        name : str
            Name of the filter.

        Returns
        -------
        filter : `Filter`
        """
        wave = bandpass.waveset
        if wave is None:
            raise argument_error("bandpass", "one with a wavelength set", bandpass)
        throughput = np.asarray(bandpass(wave).value, dtype=float)
        return cls(wave, throughput, name=name, meta={"source": "synphot"})

    def to_synphot(self):
        """This filter as a `synphot.SpectralElement` (photon response, linear between points)."""
        from synphot import Empirical1D, SpectralElement

        return SpectralElement(
            Empirical1D,
            points=self.wave.to(u.AA),
            lookup_table=self.throughput,
            meta={"expr": self.name},
        )

    @functools.cached_property
    def _fine(self):
        """Refined wavelengths (um) and throughput, and their photon integral."""
        wave, throughput = _core.refine(self.wave.value, self.throughput)
        return wave, throughput, _core.photon_integral(wave, throughput)

    @functools.cached_property
    def pivot(self):
        """Pivot wavelength, sqrt(int T lam dlam / int T dlam / lam), um."""
        wave, throughput, norm = self._fine
        return np.sqrt(_core.photon_integral(wave, throughput, 2) / norm) * WAVE

    @functools.cached_property
    def effective_wavelength(self):
        """Mean wavelength of the photons of a source with constant F_nu, um."""
        wave, throughput, norm = self._fine
        return _core.photon_integral(wave, throughput, 1) / norm * WAVE

    @functools.cached_property
    def width(self):
        """Rectangular width, int T dlam / max T, um."""
        wave, throughput, _ = self._fine
        return _core.photon_integral(wave, throughput, 1) / throughput.max() * WAVE

    @functools.cached_property
    def catalog_factor(self):
        """
        What turns the AB flux of a band into the one that catalogs quote.

        1 where they are the same. IRAC fluxes are quoted at a nominal wavelength for
        nu F_nu = const, those of MIPS for a black body of 10^4 K; for a source of
        that spectrum the quoted flux is the true monochromatic one. Multiply
        `synthetic_flux` by this factor to compare with such a catalog.

        References
        ----------
        IRAC Instrument Handbook, section 4.4; MIPS Instrument Handbook, section 4.3.
        """
        if self.reference_wavelength is None:
            return 1.0
        wave, throughput, norm = self._fine
        if self.reference_temperature is None:
            mean = _core.photon_integral(wave, throughput, 1) / norm
            return float(self.reference_wavelength.value / mean)
        from astropy.modeling.physical_models import BlackBody

        body = BlackBody(temperature=self.reference_temperature)
        spectrum = body(wave * WAVE).value / body(self.reference_wavelength).value
        return float(norm / _core.photon_integral(wave, throughput * spectrum))

    def weights(self, wave, *, tolerance=UNCOVERED):
        """
        Weights of the values of a spectrum in this band.

        Parameters
        ----------
        wave : `~astropy.units.Quantity` or `~numpy.ndarray`, shape (n,)
            Strictly ascending wavelengths; an array without unit is in um.
        tolerance : float, optional
            Share of the band that may lie outside ``wave``; what is inside then stands
            for all.

        Returns
        -------
        weights : `~numpy.ndarray`, shape (n,)
            Sum 1. ``weights @ fnu`` is the photon-counting mean, exact for F_nu
            that is linear in wavelength between the points.

        Raises
        ------
        ValueError
            If ``wave`` does not ascend or leaves more of the band uncovered.
        """
        wave = check_wave(wave)
        weights = np.zeros(wave.size)
        first, part = self._weights(wave, tolerance)
        weights[first : first + part.size] = part
        return weights

    def _weights(self, wave, tolerance):
        first, part = _core.band_weights(wave, *self._fine)
        covered = part.sum()
        if not covered >= 1 - tolerance:
            band = f"{self.wave.value[0]:.4g}-{self.wave.value[-1]:.4g} um"
            msg = (
                f"the spectrum ({wave[0]:.4g}-{wave[-1]:.4g} um) leaves {1 - covered:.2%} of "
                f"filter {self.name!r} ({band}) uncovered"
            )
            raise ValueError(msg)
        return first, part / covered if covered > 0 else part

    def synthetic_flux(self, sed):
        """
        Mean flux density of a spectrum in this band (photon-counting, AB convention).

        Parameters
        ----------
        sed : object
            With ``wave`` and ``fnu``, quantities of one dimension; F_nu is taken as
            linear between the wavelengths.

        Returns
        -------
        flux : `~astropy.units.Quantity`
            In uJy.

        Raises
        ------
        ValueError
            If it is no spectrum, or leaves more than 1e-4 of the band uncovered.

        References
        ----------
        Bessell & Murphy 2012, PASP, 124, 140, equation A15.
        """
        wave, fnu = spectrum_arrays(sed)
        first, part = self._weights(wave, UNCOVERED)
        return float(part @ fnu[first : first + part.size]) * FNU

    def plot(self, ax=None, **kwargs):
        """
        Draw the throughput.

        Parameters
        ----------
        ax : `~matplotlib.axes.Axes`, optional
            Where to; the current axes if not given.
        **kwargs
            Passed to `~matplotlib.axes.Axes.plot`.

        Returns
        -------
        ax : `~matplotlib.axes.Axes`
        """
        from miricigale.plotting.filters import plot_filters

        return plot_filters([(self.wave.value, self.throughput, self.name)], ax=ax, **kwargs)


def check_wave(wave):
    """Wavelengths of a spectrum as an array in um."""
    wave = (
        to_array(wave, WAVE, "wave", ndim=1) if hasattr(wave, "unit") else np.asarray(wave, float)
    )
    if wave.ndim != 1 or wave.size < 2 or not np.all(np.diff(wave) > 0):
        raise argument_error("wave", "two or more strictly ascending wavelengths", wave)
    return wave


def spectrum_arrays(sed):
    """Wavelengths (um) and F_nu (uJy) of anything with ``wave`` and ``fnu``."""
    if not (hasattr(sed, "wave") and hasattr(sed, "fnu")):
        raise argument_error("sed", "an object with wave and fnu", type(sed).__name__)
    wave, fnu = check_wave(sed.wave), to_array(sed.fnu, FNU, "sed.fnu", ndim=1)
    if wave.shape != fnu.shape:
        got = f"{fnu.size} for {wave.size} wavelengths"
        raise argument_error("sed.fnu", "as many values as sed.wave", got)
    return wave, fnu


@functools.lru_cache(maxsize=512)
def _from_name(name):
    wave, throughput, options = load_curve(name)
    return Filter(wave, throughput, name=name, **options)
