"""Spectra as observed: wavelengths and flux densities, of a whole and of its parts."""

import dataclasses
from dataclasses import dataclass, field

import astropy.units as u
import numpy as np
from astropy.cosmology import FlatLambdaCDM

from miricigale.utils.exceptions import argument_error
from miricigale.utils.units import FNU, WAVE, Frozen, frozen_quantity, to_array

#: WMAP7, as in Yang et al. 2021.
COSMOLOGY = FlatLambdaCDM(H0=70.4, Om0=0.272, name="yang2021")


def distance(redshift, cosmology):
    """
    Luminosity distance in meters; 10 pc at redshift 0, as for absolute magnitudes.

    Parameters
    ----------
    redshift : float or `~numpy.ndarray`
        Redshifts >= 0.
    cosmology : `~astropy.cosmology.Cosmology`
        The cosmology.
    """
    z = np.asarray(redshift, dtype=float)
    far = cosmology.luminosity_distance(np.where(z > 0, z, 1.0)).to_value(u.m)
    return np.where(z > 0, far, (10.0 * u.pc).to_value(u.m))


@dataclass(frozen=True, eq=False, repr=False)
class SED(Frozen):
    """
    Spectral energy distribution: flux density against observed wavelength.

    Parameters
    ----------
    wave : `~astropy.units.Quantity`, shape (n,)
        Wavelengths in vacuum, strictly ascending; kept in um.
    fnu : `~astropy.units.Quantity`, shape (n,)
        Flux density F_nu; kept in uJy. Straight lines in wavelength join the points.
    redshift : float, optional
        Redshift at which the source is seen.
    meta : dict, optional
        Anything that should stay with it.

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

    def __post_init__(self):
        if not hasattr(self.fnu, "unit"):
            to_array(self.fnu, FNU, "fnu")
        # slow to make, and needed by other units than F_nu's own only
        plain = self.fnu.unit == FNU
        spectral = [] if plain else u.spectral_density(u.Quantity(self.wave, copy=False))
        wave = frozen_quantity(self.wave, WAVE, "wave", ndim=1, finite=True)
        fnu = to_array(self.fnu, FNU, "fnu", ndim=1, finite=True, equivalencies=spectral)
        fnu = frozen_quantity(fnu * FNU, FNU, "fnu")
        if wave.size < 2 or wave.shape != fnu.shape:
            raise argument_error(
                "fnu", f"of the shape of 'wave', two points or more ({wave.shape})", fnu.shape
            )
        if np.any(np.diff(wave.value) <= 0) or wave.value[0] <= 0:
            raise argument_error("wave", "positive and strictly ascending", "something else")
        if not (np.isfinite(self.redshift) and self.redshift >= 0):
            raise argument_error("redshift", ">= 0", self.redshift)
        object.__setattr__(self, "wave", wave)
        object.__setattr__(self, "fnu", fnu)
        object.__setattr__(self, "redshift", float(self.redshift))
        object.__setattr__(self, "meta", dict(self.meta))

    def replace(self, **changes):
        """Copy with other values of the constructor's arguments."""
        return dataclasses.replace(self, **changes)

    def fnu_at(self, wave):
        """
        Flux density at observed wavelengths, by straight lines.

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

    def redshifted(self, redshift, *, cosmology=COSMOLOGY):
        """
        The same source at another redshift.

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
        """
        stretch = (1.0 + redshift) / (1.0 + self.redshift)
        ratio = distance(self.redshift, cosmology) / distance(redshift, cosmology)
        fnu = self.fnu * float(stretch * ratio**2)
        return self.replace(wave=self.wave * stretch, fnu=fnu, redshift=redshift)

    @classmethod
    def from_synphot(cls, spectrum, *, wave=None, redshift=None):
        """
        Make an SED from a synphot spectrum.

        Parameters
        ----------
        spectrum : `synphot.SourceSpectrum`
            The spectrum.
        wave : `~astropy.units.Quantity`, optional
            Where it is sampled; its own ``waveset`` if not given.
        redshift : float, optional
            Redshift of the source; the spectrum's ``z`` if not given.
        """
        wave = spectrum.waveset if wave is None else u.Quantity(wave)
        if wave is None:
            raise argument_error("wave", "given for a spectrum without waveset", "None")
        fnu = spectrum(wave, flux_unit=u.Jy)
        order = np.argsort(wave)
        redshift = spectrum.z if redshift is None else redshift
        return cls(wave[order], fnu[order], redshift=redshift)

    def to_synphot(self):
        """
        Make a synphot spectrum.

        Returns
        -------
        spectrum : `synphot.SourceSpectrum`
            As observed (its ``z`` is 0: the wavelengths are shifted already). Between the
            points synphot interpolates in photons, not in F_nu.
        """
        from synphot import SourceSpectrum
        from synphot.models import Empirical1D

        return SourceSpectrum(
            Empirical1D, points=self.wave.to(u.AA), lookup_table=self.fnu, meta=self.meta
        )

    def plot(self, ax=None, **kwargs):
        """Draw the spectrum (`miricigale.plotting.spectra.plot_spectrum`) and return the axes."""
        from miricigale.plotting.spectra import plot_spectrum

        return plot_spectrum(self.wave.value, self.fnu.value, ax=ax, **kwargs)

    def __repr__(self):
        return (
            f"<SED {self.wave.size} points, {self.wave[0]:.4g} to {self.wave[-1]:.4g}, "
            f"redshift {self.redshift:.4g}>"
        )


@dataclass(frozen=True, eq=False)
class ModelSpectra:
    """
    Spectra of one model, part by part.

    Parameters
    ----------
    total : `SED`
        The whole, as observed.
    components : dict of str to `SED`
        ``stellar`` (attenuated), ``dust``, with gas ``nebular`` (attenuated) and with an AGN
        ``agn_disk``, ``agn_torus`` and ``agn_polar``: they sum to ``total``.
        ``stellar_intrinsic`` is the light of stars and gas before dust.
    derived : dict of str to `~astropy.units.Quantity`
        See `SEDModel.derived_columns`.
    parameters : dict of str to `~astropy.units.Quantity`
        All parameters.
    """

    total: SED
    components: dict
    derived: dict
    parameters: dict
