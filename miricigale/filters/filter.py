"""Passbands."""

import dataclasses
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.filters import _core
from miricigale.filters.band_names import find_filter, unknown_filter
from miricigale.filters.curve_files import read_curve
from miricigale.filters.filter_search import searched_wavelength
from miricigale.filters.library import FILTERS, load_curve
from miricigale.filters.spectra import are_spectra, check_wave, spectrum_arrays
from miricigale.utils.caching import cached, cached_property
from miricigale.utils.exceptions import argument_error, data_error
from miricigale.utils.files import reading
from miricigale.utils.interactive import WithTable
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.table_files import write_table
from miricigale.utils.table_formats import check_keeps_units
from miricigale.utils.units import (
    FNU,
    WAVE,
    Frozen,
    frozen_array,
    frozen_quantity,
    is_ascending,
    is_number,
    to_array,
)
from miricigale.utils.values import value_class

#: Version of the band averages: raised when the same curve gives other numbers.
VERSION = 1

#: Share of a band that a spectrum may leave uncovered.
UNCOVERED = 1e-4


@takes_other_keywords
@value_class
class Filter(Frozen, WithTable):
    """
    A passband: the response to photons against wavelength.

    ``Filter("F770W")`` is a filter of the library (`from_name`); ``filter(wave)`` is its throughput at
    wavelengths.

    Parameters
    ----------
    wave : `~astropy.units.Quantity`, shape (n,), or str
        Strictly ascending wavelengths; or a name for `from_name`, alone.
    throughput : array_like, shape (n,)
        Detected share of the photons, or anything in proportion; not negative. Between
        the wavelengths it is linear. Zeros beyond the first at each end are trimmed, and
        a curve that does not end in zero gets a step there.
    name : str
        Name of the filter, and of its flux columns.
    meta : dict, optional
        Source, citation, flux convention of the catalogs, in words.
    reference_wavelength : `~astropy.units.Quantity`, optional
        Wavelength at which catalogs quote fluxes, if these are not AB means; see `catalog_factor`.
    reference_temperature : `~astropy.units.Quantity`, optional
        Temperature of the black body whose flux is quoted; None stands for nu F_nu = const.

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
    >>> Filter("JWST/MIRI.F770W").name
    'miri.f770w'
    """

    wave: u.Quantity | str
    throughput: np.ndarray | None = None
    name: str | None = None
    _: dataclasses.KW_ONLY
    meta: dict | None = None
    reference_wavelength: u.Quantity | None = None
    reference_temperature: u.Quantity | None = None

    def __post_init__(self):
        wave = self.wave
        throughput = self.throughput
        name = self.name
        if isinstance(wave, str):
            if throughput is None:
                self.__dict__.update(Filter.from_name(wave).__dict__)
                return
            # the name first, as in sedpy
            wave, throughput, name = throughput, name, wave
        for argument, value in (("throughput", throughput), ("name", name)):
            check_that(value is not None, argument, "given with 'wave'", "None")
        wave, throughput = _checked_curve(wave, throughput)
        meta = dict(self.meta or {})
        self.__dict__.update(wave=wave, throughput=throughput, name=str(name), meta=meta)
        for argument, unit in (("reference_wavelength", WAVE), ("reference_temperature", u.K)):
            value = getattr(self, argument)
            if value is not None:
                value = frozen_quantity(value, unit, argument, ndim=0, finite=True)
                object.__setattr__(self, argument, value)

    def __repr__(self):
        return f"<Filter {self.name}: pivot {self.pivot:.4f}, width {self.width:.3f}>"

    def _facts(self):
        return {
            "Filter": self.name,
            "pivot": f"{self.pivot:.4f}",
            "width": f"{self.width:.4f}",
            "source": self.meta.get("source", ""),
        }

    def _key(self):
        """Return what makes two filters equal: name and curve, and how catalogs quote its fluxes."""
        curve = self.wave.value.tobytes(), self.throughput.tobytes()
        return self.name, *curve, self.reference_wavelength, self.reference_temperature

    def __eq__(self, other):
        if isinstance(other, Filter):
            return self._key() == other._key()
        return NotImplemented

    def __hash__(self):
        # filters that differ in their references alone may share a hash
        return hash(self._key()[:3])

    def __call__(self, wave):
        """Return the throughput at wavelengths, linear between the points and 0 outside."""
        x = to_array(wave, WAVE, "wave")
        return np.interp(x, self.wave.value, self.throughput, left=0.0, right=0.0)

    def __mul__(self, other):
        """Return the filter times a number, or times the throughput of another filter (mirrors, a window)."""
        if is_number(other):
            return self.replace(throughput=self.throughput * other)
        if not isinstance(other, Filter):
            return NotImplemented
        wave = np.union1d(self.wave.value, other.wave.value) * WAVE
        # between points of both the product of straight lines is a parabola: halves follow it closely
        wave = np.union1d(wave.value, 0.5 * (wave.value[1:] + wave.value[:-1])) * WAVE
        name = f"{self.name}*{other.name}"
        return self.replace(wave=wave, throughput=self(wave) * other(wave), name=name)

    __rmul__ = __mul__

    def replace(self, **changes):
        """Return a copy with other values of the constructor's arguments."""
        return dataclasses.replace(self, **changes)

    @classmethod
    def from_name(cls, name):
        """
        Make a filter of the library.

        Parameters
        ----------
        name : str
            One of `names`, such as ``"miri.f770w"``, in any usual form (``"F770W"``, ``"JWST/MIRI.F770W"``,
            ``"wfc3_ir_f160w"``, ``"IRAC1"``, ``"SDSS r"``), or ``"sedpy."`` and any curve of astro-sedpy.

        Returns
        -------
        filter : `Filter`
            The same object for the same name.

        Raises
        ------
        KeyError
            If there is no such filter; the message lists the nearest ones.
        """
        full_name = find_filter(str(name))
        if full_name is None and Path(str(name)).expanduser().is_file():
            msg = f"no filter {str(name)!r}, which is a file: Filter.read({str(name)!r}) reads it"
            raise KeyError(msg)
        if full_name is None and not str(name).startswith("sedpy."):
            raise unknown_filter(str(name))
        return _from_name(full_name or str(name))

    @staticmethod
    def names():
        """Return the names of the library, sorted, as a tuple."""
        return tuple(FILTERS.names())

    @staticmethod
    def search(text):
        """
        Find filters of the library by a part of their name, or by a wavelength.

        Parameters
        ----------
        text : str or `~astropy.units.Quantity`
            Part of a name, such as ``"miri"``, or a wavelength, such as ``"1.6 um"`` or ``"16000 A"``.

        Returns
        -------
        names : tuple of str
            Sorted; at a wavelength the filters with at least half of their highest throughput there, the nearest
            pivot first. Empty if there are none.

        Raises
        ------
        `~astropy.units.UnitsError`
            If a quantity is no wavelength.

        Examples
        --------
        >>> from miricigale.filters import Filter
        >>> Filter.search("miri.f1")
        ('miri.f1000w', 'miri.f1130w', 'miri.f1280w', 'miri.f1500w', 'miri.f1800w')
        >>> Filter.search("25.5 um")
        ('miri.f2550w', 'mips.24')
        """
        wave = searched_wavelength(text)
        if wave is None:
            return tuple(name for name in FILTERS.names() if str(text).lower() in name)
        matches = []
        for name in FILTERS.names():
            band = Filter.from_name(name)
            if band(wave * WAVE) >= 0.5 * band.throughput.max():
                matches.append((abs(band.pivot.value - wave), name))
        return tuple(name for _, name in sorted(matches))

    @classmethod
    @takes_other_keywords
    def read(cls, path, *, name=None, unit=None):
        r"""
        Read a filter from a file.

        Parameters
        ----------
        path : path-like
            Wavelength and throughput in the first two columns: a table with units (ECSV, FITS, VOTable as of the
            SVO, whose ``DetectorType`` counts), or text. Its comments start with ``#``; those at the top may hold,
            as in CIGALE's files, the name, the word ``photon`` or ``energy`` (what the throughput counts, else
            photons) and a description, or name the unit of the wavelengths, best in the line of the columns.
            A first column that counts the rows is left out, as in files of EAZY.
        name : str, optional
            Name of the filter; else the one in the file, else that of the file.
        unit : `~astropy.units.Unit`, optional
            Unit of the wavelengths; else the one in the file, Angstrom in CIGALE's.

        Returns
        -------
        filter : `Filter`

        Raises
        ------
        `~miricigale.utils.exceptions.DataError`
            If the file is missing, has not two columns of numbers, names no unit of the wavelengths or several,
            has a wavelength more than twice, or a throughput below -5 % of the peak. Smaller negative ones are
            set to zero and counted in ``meta["n_negative"]``.
        ValueError
            If a value is missing.

        Examples
        --------
        >>> import pathlib, tempfile
        >>> import astropy.units as u
        >>> from miricigale.filters import Filter
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "mine.txt"
        >>> _ = path.write_text("9.0 0\n9.5 0.8\n10.5 0.8\n11.0 0\n")
        >>> Filter.read(path, unit=u.um)
        <Filter mine: pivot 9.9896 um, width 1.500 um>
        """
        with reading(path, "a filter"):
            curve = read_curve(path, unit)
            options = curve.options | {"meta": {"source": Path(path).name, **curve.options["meta"]}}
            return cls(curve.wave, curve.throughput, name or curve.name, **options)

    #: Other name of `read`.
    from_file = read

    @classmethod
    def from_svo(cls, path, *, name=None):
        """
        Make a filter of a file of the SVO Filter Profile Service; nothing is downloaded.

        Parameters
        ----------
        path : path-like
            The file, as the service gives it: a VOTable, or its ASCII table, whose wavelengths are in Angstrom.
        name : str, optional
            As for `read`, which does the same.

        Returns
        -------
        filter : `Filter`

        Raises
        ------
        `~miricigale.utils.exceptions.DataError`
            If there is no such file, or it is none of a filter; the message says where the service has it.
        """
        if not Path(path).is_file():
            # the service has most curves of the library under its own names
            problem = "is no file; nothing is downloaded: save the VOTable of http://svo2.cab.inta-csic.es/theory/fps"
            raise data_error(path, f"{problem}, or take Filter({str(path)!r}) of the library")
        with Path(path).open("rb") as file:
            is_votable = file.read(256).lstrip().startswith(b"<")
        unit = None
        if not is_votable:
            # the ASCII table does not state its unit
            unit = u.AA
        return cls.read(path, name=name, unit=unit)

    @classmethod
    def from_synphot(cls, bandpass, *, name=None):
        """
        Make a filter of a synphot bandpass.

        Parameters
        ----------
        bandpass : `synphot.SpectralElement`
            With a finite wavelength set.
        name : str, optional
            Name of the filter; the bandpass's expression if not given.

        Returns
        -------
        filter : `Filter`
        """
        wave = bandpass.waveset
        check_that(wave is not None, "bandpass", "one with a wavelength set", bandpass)
        throughput = np.asarray(bandpass(wave).value, dtype=float)
        name = name or str(bandpass.meta.get("expr") or "synphot")
        return cls(wave, throughput, name=name, meta={"source": "synphot"})

    @classmethod
    def from_sedpy(cls, band, *, name=None):
        """
        Make a filter of one of astro-sedpy.

        Parameters
        ----------
        band : `sedpy.observate.Filter`
            With its wavelengths (Angstrom) and transmission (counted in photons).
        name : str, optional
            Name of the filter; else that of the same curve in the library, or of sedpy.

        Returns
        -------
        filter : `Filter`
            Noise of the curve below zero is set to zero and counted in ``meta["n_negative"]``.
        """
        name = name or find_filter(band.name) or band.name
        throughput = np.asarray(band.transmission, dtype=float)
        meta = {"source": "sedpy"}
        n_negative = int(np.count_nonzero(throughput < 0))
        if n_negative:
            meta["n_negative"] = n_negative
        return cls(band.wavelength * u.AA, np.maximum(throughput, 0.0), str(name), meta=meta)

    def to_synphot(self):
        """Return the filter as a `synphot.SpectralElement` (photon response, linear between points)."""
        from synphot import Empirical1D, SpectralElement

        return SpectralElement(
            Empirical1D,
            points=self.wave.to(u.AA),
            lookup_table=self.throughput,
            meta={"expr": self.name},
        )

    def to_table(self):
        """
        Return the curve as a `~astropy.table.QTable` of ``wave`` (um) and ``throughput``.

        Its meta has what else makes the filter: ``reference_wavelength`` (um), ``reference_temperature`` (K).
        """
        meta = {"name": self.name, **self.meta}
        if self.reference_wavelength is not None:
            meta["reference_wavelength"] = float(self.reference_wavelength.value)
        if self.reference_temperature is not None:
            meta["reference_temperature"] = float(self.reference_temperature.value)
        return QTable({"wave": self.wave, "throughput": self.throughput}, meta=meta)

    def write(self, path, *, overwrite=False):
        """
        Write the curve as a table, in the format of the suffix (``.ecsv``, ``.fits``, ...).

        CSV is refused, which keeps neither units nor the wavelength at which catalogs quote fluxes.
        """
        check_keeps_units(path)
        write_table(self.to_table(), path, overwrite=overwrite)

    @cached_property
    def _fine(self):
        """Refined wavelengths (um) and throughput, and their photon integral."""
        wave, throughput = _core.refine(self.wave.value, self.throughput)
        return wave, throughput, _core.photon_integral(wave, throughput)

    @cached_property
    def pivot(self):
        """Pivot wavelength, sqrt(int T lam dlam / int T dlam / lam), um."""
        wave, throughput, norm = self._fine
        return np.sqrt(_core.photon_integral(wave, throughput, 2) / norm) * WAVE

    @cached_property
    def effective_wavelength(self):
        """Mean wavelength of the photons of a source with constant F_nu, um."""
        wave, throughput, norm = self._fine
        return _core.photon_integral(wave, throughput, 1) / norm * WAVE

    @cached_property
    def width(self):
        """Rectangular width, int T dlam / max T, um."""
        wave, throughput, _ = self._fine
        return _core.photon_integral(wave, throughput, 1) / throughput.max() * WAVE

    @cached_property
    def fwhm(self):
        """Full width at half of the highest throughput, um."""
        wave, throughput, _ = self._fine
        high = wave[throughput >= 0.5 * throughput.max()]
        return (high[-1] - high[0]) * WAVE

    @property
    def bounds(self):
        """Wavelengths beyond which the throughput is 0, um, shape (2,)."""
        return self.wave[[0, -1]]

    @property
    def min_wavelength(self):
        """Shortest wavelength of `bounds`."""
        return self.bounds[0]

    @property
    def max_wavelength(self):
        """Longest wavelength of `bounds`."""
        return self.bounds[1]

    @cached_property
    def catalog_factor(self):
        """
        Factor from the AB flux of a band to the flux that catalogs quote.

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
            return float(self.reference_wavelength.value / self.effective_wavelength.value)
        from astropy.modeling.physical_models import BlackBody

        body = BlackBody(temperature=self.reference_temperature)
        spectrum = body(wave * WAVE).value / body(self.reference_wavelength).value
        return float(norm / _core.photon_integral(wave, throughput * spectrum))

    def integrate(self):
        """Return the integral of the throughput over wavelength, um: the equivalent width."""
        return self.width * self.throughput.max()

    def weights(self, wave, *, tolerance=UNCOVERED):
        """
        Compute the weights of the values of a spectrum in this band.

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
            Sum 1, or all 0 for a band that lies wholly outside (with ``tolerance=1``). ``weights @ fnu`` is the
            photon-counting mean, exact for F_nu that is linear in wavelength between the points.

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
        """Compute the weights that are not 0, and the place of the first of them in ``wave`` (um)."""
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

    def synthetic_flux(self, sed, flux=None):
        """
        Compute the mean flux density of a spectrum in this band, uJy (photon-counting, AB convention).

        Parameters
        ----------
        sed : object
            An `~miricigale.sed.SED`, a pair of wavelengths and flux densities (F_nu or F_lambda) or a table of
            them, a spectrum of specutils or synphot, or an astropy model of a flux density; or a list of spectra.
            F_nu is taken as linear between the wavelengths.
        flux : `~astropy.units.Quantity`, optional
            Flux densities, if ``sed`` is the wavelengths.

        Returns
        -------
        flux : `~astropy.units.Quantity`
            In uJy, shape (); (n,) of a list of n spectra.

        Raises
        ------
        ValueError
            If it is no spectrum, or leaves more than 1e-4 of the band uncovered.

        References
        ----------
        Bessell & Murphy 2012, PASP, 124, 140, equation A15.

        Examples
        --------
        >>> import astropy.units as u
        >>> import numpy as np
        >>> from miricigale import Filter
        >>> wave = np.linspace(5.0, 12.0, 300) * u.um
        >>> Filter("F770W").synthetic_flux(wave, wave.value**2 * u.uJy).round(2)
        <Quantity 58.36 uJy>
        """
        if are_spectra(sed):
            return u.Quantity([self.synthetic_flux(spectrum) for spectrum in sed])
        wave, fnu = spectrum_arrays(sed if flux is None else (sed, flux), [self])
        first, part = self._weights(wave, UNCOVERED)
        return float(part @ fnu[first : first + part.size]) * FNU

    def synthetic_magnitude(self, sed, flux=None):
        """Compute the AB magnitude of a spectrum in this band; see `synthetic_flux`."""
        return self.synthetic_flux(sed, flux).to(u.ABmag)

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
        from miricigale.plotting.curves import plot_filters

        return plot_filters([(self.wave.value, self.throughput, self.name)], ax=ax, **kwargs)


@cached(maxsize=512)
def _from_name(name):
    wave, throughput, options = load_curve(name)
    return Filter(wave, throughput, name=name, **options)


def _checked_curve(wave, throughput):
    """Return wavelengths (um) and throughput of a filter, read-only and with a zero at each end."""
    wave = to_array(wave, WAVE, "wave", ndim=1, finite=True)
    throughput = to_array(throughput, u.one, "throughput", ndim=1, finite=True)
    if wave.size < 2 or wave.shape != throughput.shape:
        shapes = f"{wave.shape} and {throughput.shape}"
        raise argument_error("throughput", "as many values as 'wave', two or more", shapes)
    check_that(wave[0] > 0 and is_ascending(wave), "wave", "positive and strictly ascending", wave)
    if np.any(throughput < 0) or not np.any(throughput > 0):
        raise argument_error("throughput", "not negative, and somewhere positive", throughput)
    wave, throughput = _core.padded(wave, throughput)
    return frozen_quantity(wave * WAVE, WAVE, "wave"), frozen_array(throughput)
