"""Spectra as observed: wavelengths and flux densities, of a whole and of its parts."""

import dataclasses
import numbers
from dataclasses import field

import astropy.units as u
import numpy as np

from miricigale.filters import FilterSet, as_filter
from miricigale.filters.spectra import spectrum_arrays
from miricigale.sed.cosmology import COSMOLOGY, distance
from miricigale.sed.flux_units import flux_density_unit
from miricigale.sed.frequency_integral import integral_at_rest
from miricigale.sed.spectrum_conversions import specutils_spectrum, synphot_spectrum
from miricigale.sed.spectrum_parts import BandFlux, Parts, component_of, points_of
from miricigale.sed.spectrum_tables import spectrum_columns, spectrum_table
from miricigale.utils.exceptions import argument_error
from miricigale.utils.files import reading
from miricigale.utils.interactive import ValuesByName, WithTable
from miricigale.utils.meta import full_meta
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.table_files import read_table, write_table
from miricigale.utils.table_formats import check_keeps_units
from miricigale.utils.units import (
    FLAM,
    FNU,
    WAVE,
    Frozen,
    frozen_quantity,
    is_ascending,
    is_number,
    to_array,
)
from miricigale.utils.values import value_class


@value_class
class SED(Frozen, WithTable):
    """
    Spectral energy distribution: flux density against observed wavelength.

    It can be multiplied by numbers, and added to another one with the same wavelengths.

    Parameters
    ----------
    wave : `~astropy.units.Quantity`, shape (n,)
        Wavelengths in vacuum, strictly ascending; kept in um.
    fnu : `~astropy.units.Quantity`, shape (n,)
        Flux density F_nu; kept in uJy. Straight lines in wavelength join the points.
    redshift : float, optional
        Redshift at which the source is seen.
    meta : dict, optional
        Anything that should stay with it; of a model its ``parameters`` and ``derived`` quantities.
    components : dict of str to `SED`, optional
        Its parts at the same wavelengths. Of a model ``stellar`` (attenuated), ``dust``, with gas ``nebular``
        (attenuated) and with an AGN ``agn_disk``, ``agn_torus`` and ``agn_polar`` sum to the whole;
        ``stellar_intrinsic`` is the light of stars and gas before dust. ``components["agn"]`` and
        ``components["galaxy"]`` are sums of those of the AGN and of the others.

    Raises
    ------
    ValueError
        If wavelengths do not ascend, shapes differ or a value is not finite.
    `~astropy.units.UnitsError`
        If a unit cannot be converted.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.sed import SED
    >>> sed = SED([1.0, 30.0] * u.um, [3.0, 3.0] * u.uJy)
    >>> sed.fnu_at(10 * u.um)
    <Quantity 3. uJy>
    """

    wave: u.Quantity
    fnu: u.Quantity
    _: dataclasses.KW_ONLY
    redshift: float = 0.0
    meta: dict = field(default_factory=dict)
    components: dict = field(default_factory=dict)

    def _value(self, name):
        # half-made copies have no meta yet
        if "meta" not in self.__dict__:
            return None
        if name == "flux":
            return BandFlux.of(self)
        return (self.derived | self.parameters).get(name)

    def _value_names(self):
        return ("flux", *self.derived, *self.parameters)

    def __post_init__(self):
        if not hasattr(self.fnu, "unit"):
            to_array(self.fnu, FNU, "fnu")
        # slow to make, and needed by other units than F_nu's own only
        is_converted = self.fnu.unit == FNU
        if is_converted:
            spectral = []
        else:
            spectral = u.spectral_density(u.Quantity(self.wave, copy=False))
        wave = frozen_quantity(self.wave, WAVE, "wave", ndim=1, finite=True)
        fnu = to_array(self.fnu, FNU, "fnu", ndim=1, finite=True, equivalencies=spectral)
        fnu = frozen_quantity(fnu * FNU, FNU, "fnu")
        wanted = f"of the shape of 'wave', two points or more ({wave.shape})"
        check_that(wave.size >= 2 and wave.shape == fnu.shape, "fnu", wanted, fnu.shape)
        good = is_ascending(wave.value) and wave.value[0] > 0
        check_that(good, "wave", "positive and strictly ascending", "something else")
        check_that(0 <= self.redshift < np.inf, "redshift", ">= 0", self.redshift)
        self.__dict__.update(wave=wave, fnu=fnu, redshift=float(self.redshift))
        self.__dict__.update(meta=dict(self.meta), components=Parts(self.components))

    @property
    def parameters(self):
        """Parameters of the model: dict of name to `~astropy.units.Quantity`, empty of other spectra."""
        return ValuesByName(self.meta.get("parameters", {}))

    @property
    def derived(self):
        """Derived quantities of the model by name, such as ``stellar_mass``; see `SEDModel.derived_columns`."""
        return ValuesByName(self.meta.get("derived", {}))

    @property
    def ssfr(self):
        """Specific star-formation rate of a model, for its living stars, 1/yr."""
        return (self.sfr / self.stellar_mass).to(1 / u.yr)

    @property
    def rest_wavelength(self):
        """Wavelengths at the source, um."""
        return self.wave / (1.0 + self.redshift)

    @property
    def frequency(self):
        """Observed frequencies, Hz."""
        return self.wave.to(u.Hz, u.spectral())

    @property
    def flam(self):
        """Flux density F_lambda, erg/s/cm2/Angstrom."""
        return self.fnu.to(FLAM, u.spectral_density(self.wave))

    @property
    def nu_fnu(self):
        """Flux nu F_nu, the same as lambda F_lambda, erg/s/cm2."""
        return (self.frequency * self.fnu).to(FLAM * u.AA)

    def to(self, unit):
        """Return the flux densities in a unit of F_nu, F_lambda or nu F_nu, `~astropy.units.Quantity`."""
        unit, _ = flux_density_unit(unit)
        return self.fnu.to(unit, u.spectral_density(self.wave))

    def _changed(self, change):
        """Copy with F_nu of the whole and of each part changed."""
        parts = {name: part._changed(change) for name, part in self.components.items()}
        return self.replace(fnu=change(self.fnu), components=parts)

    def __mul__(self, number):
        if not is_number(number):
            return NotImplemented
        return self._changed(lambda fnu: fnu * number)

    __rmul__ = __mul__

    def __truediv__(self, number):
        if is_number(number):
            return self * (1.0 / number)
        return NotImplemented

    def __add__(self, other):
        if not isinstance(other, SED):
            return NotImplemented
        alike = self.redshift == other.redshift and np.array_equal(self.wave, other.wave)
        check_that(alike, "other", "an SED at the same redshift and wavelengths", other)
        return SED(self.wave, self.fnu + other.fnu, redshift=self.redshift)

    def __radd__(self, other):
        # sum(...) begins with 0
        if isinstance(other, int) and other == 0:
            return self
        return NotImplemented

    def __neg__(self):
        return self * -1.0

    def __sub__(self, other):
        if not isinstance(other, SED):
            return NotImplemented
        return self + other * -1.0

    def __getitem__(self, key):
        """
        Return the part between two observed wavelengths, ``sed[5 * u.um:10 * u.um]``, or where a mask is True.

        A whole number gives the flux density at that point, as of ``sed.fnu``, a name the component.
        """
        if isinstance(key, str):
            return component_of(self, key)
        if isinstance(key, numbers.Integral) and not isinstance(key, (bool, np.bool_)):
            return self.fnu[key]
        inside = points_of(key, self.wave.value)
        parts = {name: part[inside] for name, part in self.components.items()}
        return self.replace(wave=self.wave[inside], fnu=self.fnu[inside], components=parts)

    def _ipython_key_completions_(self):
        """Return what a session offers in brackets: names of the parts."""
        return self.components.names

    def _hint_of(self, name):
        """Return the sentence for a part that is asked for as an attribute."""
        # half-made copies have no parts yet
        return vars(self).get("components", Parts()).hint(name)

    def replace(self, **changes):
        """Copy with other values of the constructor's arguments."""
        return dataclasses.replace(self, **changes)

    def fnu_at(self, wave):
        """
        Return the flux density at observed wavelengths, by straight lines.

        Raises
        ------
        ValueError
            If a wavelength is outside the spectrum.
        """
        x = to_array(wave, WAVE, "wave")
        if np.any((x < self.wave.value[0]) | (x > self.wave.value[-1])):
            span = f"within {self.wave[0]:.4g} and {self.wave[-1]:.4g}"
            raise argument_error("wave", span, wave)
        return np.interp(x, self.wave.value, self.fnu.value) * FNU

    __call__ = fnu_at

    def redshifted(self, redshift, *, cosmology=COSMOLOGY):
        """
        Return the same source at another redshift.

        Wavelengths move by the ratio of (1 + z), F_nu by that ratio and the inverse square
        of the luminosity distance (10 pc at redshift 0). Absorption between the galaxies
        stays as it was.

        Parameters
        ----------
        redshift : float
            The new redshift.
        cosmology : `~astropy.cosmology.Cosmology`, optional
            The cosmology.

        Returns
        -------
        sed : `SED`

        Examples
        --------
        >>> from miricigale import SEDModel
        >>> sed = SEDModel.yang2021(libraries="bundled")(redshift=0.5, mass=1e10)
        >>> sed.redshifted(2.0).synthetic_flux("F1500W").round(2)
        <Quantity 1.67 uJy>
        """
        stretch = (1.0 + redshift) / (1.0 + self.redshift)
        ratio = distance(self.redshift, cosmology) / distance(redshift, cosmology)
        fnu = self.fnu * float(stretch * ratio**2)
        parts = {}
        for name, part in self.components.items():
            parts[name] = part.redshifted(redshift, cosmology=cosmology)
        return self.replace(wave=self.wave * stretch, fnu=fnu, redshift=redshift, components=parts)

    def rest_frame(self, *, cosmology=COSMOLOGY):
        """Return the source at redshift 0, at 10 pc; see `redshifted`."""
        return self.redshifted(0.0, cosmology=cosmology)

    def synthetic_flux(self, band):
        """Return the mean flux density in a band; see `~miricigale.filters.Filter.synthetic_flux`."""
        return as_filter(band).synthetic_flux(self)

    def synthetic_magnitude(self, band):
        """Return the AB magnitude in a band."""
        return self.synthetic_flux(band).to(u.ABmag)

    def fluxes(self, bands):
        """Mean flux densities in several bands, uJy, shape (n,); see `~miricigale.filters.FilterSet`."""
        return FilterSet(bands).synthetic_fluxes(self)

    def magnitudes(self, bands):
        """AB magnitudes in several bands, shape (n,), NaN where the flux is not positive; see `fluxes`."""
        flux = self.fluxes(bands)
        return np.where(flux.value > 0, flux.value, np.nan) * flux.unit << u.ABmag

    def normalize(self, flux, band):
        """
        Scale the spectrum to a flux in a band.

        Parameters
        ----------
        flux : `~astropy.units.Quantity`
            The flux in the band that the result has, such as ``10 * u.uJy`` or ``23.5 * u.ABmag``.
        band : str or `~miricigale.filters.Filter`
            The band.

        Returns
        -------
        sed : `SED`
            With its parts scaled too. ``parameters`` and ``derived`` stay those of the model.

        Raises
        ------
        ValueError
            If the spectrum has no light in the band.

        Examples
        --------
        >>> from miricigale import SEDModel
        >>> import astropy.units as u
        >>> sed = SEDModel.yang2021(libraries="bundled")(redshift=1.0, mass=1e10)
        >>> sed.normalize(10 * u.uJy, "F770W").synthetic_flux("F770W").round(3)
        <Quantity 10. uJy>
        """
        if isinstance(flux, u.Magnitude):
            flux = flux.to(FNU)
        flux_before = self.synthetic_flux(band)
        check_that(flux_before > 0, "band", "one in which the spectrum has light", band)
        return self * float(to_array(flux, FNU, "flux", ndim=0) / flux_before.to_value(FNU))

    def color(self, blue, red):
        """Return the AB magnitude in one band less that in another."""
        return self.synthetic_magnitude(blue) - self.synthetic_magnitude(red)

    def absolute_magnitude(self, band, *, cosmology=COSMOLOGY):
        """
        Return the absolute AB magnitude in a band at rest.

        Parameters
        ----------
        band : str or `~miricigale.filters.Filter`
            The band, at the source.
        cosmology : `~astropy.cosmology.Cosmology`, optional
            The cosmology.

        Returns
        -------
        magnitude : `~astropy.units.Magnitude`
            That of the source at 10 pc and redshift 0. Absorption between the galaxies stays in it.

        Examples
        --------
        >>> from miricigale import SEDModel
        >>> sed = SEDModel.yang2021(libraries="bundled")(redshift=1.0, mass=1e10)
        >>> print(f"{sed.absolute_magnitude('2MASS J'):.1f}")
        -21.6 mag(AB)
        """
        return self.rest_frame(cosmology=cosmology).synthetic_magnitude(band)

    @takes_other_keywords
    def luminosity(self, low=None, high=None, *, cosmology=COSMOLOGY):
        """
        Luminosity nu L_nu at the source, at `rest_wavelength` or others, or that between two rest wavelengths.

        nu L_nu is 4 pi times the luminosity distance (10 pc at redshift 0) squared times nu F_nu, which is the
        same at the wavelengths of source and observer. Between two wavelengths L_nu is integrated over frequency,
        F_nu being joined by straight lines.

        Parameters
        ----------
        low, high : `~astropy.units.Quantity`, optional
            Rest wavelengths to integrate between, such as 8 and 1000 um. With ``low`` alone nu L_nu is that at
            these wavelengths.
        cosmology : `~astropy.cosmology.Cosmology`, optional
            The cosmology.

        Returns
        -------
        luminosity : `~astropy.units.Quantity`, shape (n,), or () between two wavelengths
            In solar luminosities; of the shape of ``low`` where that is alone.

        Raises
        ------
        ValueError
            If ``high`` is given without ``low``, they are not in order, or not within the spectrum.

        Examples
        --------
        >>> from miricigale import SEDModel
        >>> import astropy.units as u
        >>> sed = SEDModel.yang2021(libraries="bundled")(redshift=1.0, mass=1e10)
        >>> sed.luminosity().unit
        Unit("solLum")
        >>> sed.luminosity(8 * u.um, 1000 * u.um) < sed.luminosity(3 * u.um, 1000 * u.um)
        np.True_
        """
        far = distance(self.redshift, cosmology) * u.m
        if low is not None and high is None:
            wave = to_array(low, WAVE, "low") * (1.0 + self.redshift) * WAVE
            frequency = wave.to(u.Hz, u.spectral())
            return (4 * np.pi * far**2 * frequency * self.fnu_at(wave)).to(u.Lsun)
        if high is not None:
            return (4 * np.pi * far**2 * integral_at_rest(self, low, high)).to(u.Lsun)
        return (4 * np.pi * far**2 * self.frequency * self.fnu).to(u.Lsun)

    @classmethod
    def from_table(cls, table):
        """
        Make a spectrum of a table; see `read`.

        Parameters
        ----------
        table : `~astropy.table.Table`
            As `to_table` makes it, or with a column of wavelengths and one of flux densities.

        Returns
        -------
        sed : `SED`

        Examples
        --------
        >>> import astropy.units as u
        >>> from astropy.table import QTable
        >>> from miricigale.sed import SED
        >>> SED.from_table(QTable({"wave": [1, 2, 3] * u.um, "flux": [1, 1, 2] * u.mJy}))
        <SED 3 points, 1 um to 3 um, redshift 0>
        """
        return cls._of_table(table, "the table")

    def to_table(self):
        """Return the spectrum as a `~astropy.table.QTable` of ``wave`` (um), ``fnu`` (uJy) and the parts."""
        return spectrum_table(self)

    def write(self, path, *, overwrite=False):
        """
        Write the spectrum as a table, in the format of the suffix (``.ecsv``, ``.fits``, ...).

        The parts are in nJy: readers such as that of specutils take a further column in the unit of the flux for
        its uncertainty. CSV is refused, which keeps neither units nor the redshift.
        """
        check_keeps_units(path)
        table = self.to_table()
        for name in self.components:
            table[name] = table[name].to(u.nJy)
        write_table(table, path, overwrite=overwrite)

    @classmethod
    def read(cls, path):
        """
        Read a spectrum from a table.

        Parameters
        ----------
        path : path-like
            As `write` makes it, or with a column of wavelengths and one of flux densities, both with units. These
            are the columns that are called so, else the first two; errors, weights and flags are left alone.

        Returns
        -------
        sed : `SED`

        Raises
        ------
        `~miricigale.utils.exceptions.DataError`
            If it is no such file.
        ValueError
            If a sample is missing, or not to be used by a column ``DQ`` of JWST or ``mask``.
        """
        return cls._of_table(read_table(path, wanted="a spectrum"), path)

    @classmethod
    def _of_table(cls, table, path):
        """Make a spectrum of a table, named ``path`` in messages."""
        wave, fnu, lights = spectrum_columns(table, path)
        with reading(path, "a spectrum"):
            meta = full_meta(table.meta)
            redshift = float(meta.pop("redshift", 0.0))
            parts = {n: cls(wave, table[n], redshift=redshift) for n in lights}
            return cls(wave, fnu, redshift=redshift, meta=meta, components=parts)

    @classmethod
    def from_synphot(cls, spectrum, *, redshift=None):
        """
        Make an SED from a synphot spectrum.

        Parameters
        ----------
        spectrum : `synphot.SourceSpectrum`
            The spectrum.
        redshift : float, optional
            Redshift of the source; the spectrum's ``z`` if not given.
        """
        check_that(spectrum.waveset is not None, "spectrum", "one with a waveset", spectrum)
        wave, fnu = spectrum_arrays(spectrum, ())
        if redshift is None:
            redshift = spectrum.z
        return cls(wave * WAVE, fnu * FNU, redshift=redshift)

    @classmethod
    def from_specutils(cls, spectrum, *, redshift=None):
        """
        Make an SED from a spectrum of specutils.

        Parameters
        ----------
        spectrum : `specutils.Spectrum`
            One spectrum as observed, in any unit of flux density and wavelength or frequency.
        redshift : float, optional
            Redshift of the source; the spectrum's ``redshift`` if not given.

        Returns
        -------
        sed : `SED`
            Without samples that are masked or NaN, of which a warning tells.

        Raises
        ------
        ValueError
            If it holds several spectra, or fewer than two samples are left.
        `~astropy.units.UnitsError`
            If its flux has other units than a flux density's.
        """
        wave, fnu = spectrum_arrays(spectrum, ())
        if redshift is None:
            redshift = float(spectrum.redshift)
        return cls(wave * WAVE, fnu * FNU, redshift=redshift)

    def to_synphot(self):
        """
        Make a synphot spectrum.

        Returns
        -------
        spectrum : `synphot.SourceSpectrum`
            As observed (its ``z`` is 0: the wavelengths are shifted already). Between the
            points synphot interpolates in photons, not in F_nu.
        """
        return synphot_spectrum(self)

    def to_specutils(self):
        """Return this spectrum for specutils (``Spectrum``, or ``Spectrum1D`` before its version 2)."""
        return specutils_spectrum(self)

    def plot(
        self, ax=None, *, components=False, filters=None, rest_frame=False, unit=FNU, **kwargs
    ):
        """
        Draw the spectrum on logarithmic axes.

        Parameters
        ----------
        ax : `~matplotlib.axes.Axes`, optional
            Where to; the current axes if not given.
        components : bool, optional
            Whether the components are drawn too, with a legend: dashed what no observer sees (light before
            attenuation).
        filters : `~miricigale.filters.FilterSet` or list of `~miricigale.filters.Filter` or str, optional
            Bands whose fluxes are drawn too, each as wide as the band.
        rest_frame : bool, optional
            Whether the wavelengths are those at the source; flux densities stay as observed.
        unit : `~astropy.units.Unit` or str, optional
            Unit of F_nu (``"mJy"``), of F_lambda (``"erg/(s cm2 AA)"``) or of nu F_nu
            (``"erg/(s cm2)"``).
        **kwargs
            Passed to `~matplotlib.axes.Axes.plot` for the spectrum itself.

        Returns
        -------
        ax : `~matplotlib.axes.Axes`

        Raises
        ------
        ValueError
            If components are asked for and the spectrum has none.
        `~astropy.units.UnitsError`
            If the unit is none of these.
        """
        from miricigale.sed.spectrum_plot import plot_sed

        return plot_sed(self, ax, components, filters, rest_frame, unit, **kwargs)

    def __repr__(self):
        return (
            f"<SED {self.wave.size} points, {self.wave[0]:.4g} to {self.wave[-1]:.4g}, "
            f"redshift {self.redshift:.4g}>"
        )

    def _facts(self):
        span = f"{self.wave[0]:.4g} to {self.wave[-1]:.4g}, {self.wave.size} points"
        facts = {"SED": span, "redshift": f"{self.redshift:.4g}"}
        if self.components:
            facts["components"] = ", ".join(self.components)
        return facts | {
            name: f"{u.Quantity(quantity):.4g}" for name, quantity in self.derived.items()
        }
