"""Errors of models by rest wavelength, as a part of the flux."""

import astropy.units as u
import numpy as np

from miricigale.filters import FilterSet
from miricigale.utils.missing_values import floats
from miricigale.utils.options import check_kind, check_that
from miricigale.utils.units import WAVE, are_not_negative, frozen_array, is_ascending, to_array
from miricigale.utils.values import value_class


@value_class
class TemplateError:
    """
    How well models represent real galaxies, by rest wavelength (Brammer et al. 2008, ApJ 686, 1503).

    At every redshift of a grid the flux of a band has this part of it added to its error in quadrature, at
    the band's pivot wavelength over 1 + z. The likelihood keeps its normalization: a redshift is not
    preferred for putting bands where errors are large.

    Parameters
    ----------
    wave : `~astropy.units.Quantity`, shape (n,)
        Ascending rest wavelengths.
    error : array_like, shape (n,)
        Error as a part of the flux; linear between logarithms of wavelength, constant outside.

    Raises
    ------
    `~astropy.units.UnitsError`
        If wavelengths have no unit of length.
    ValueError
        If wavelengths do not ascend from above 0, or errors are negative, not finite or not as many.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.fitting import SurveyCalibration, TemplateError
    >>> error = TemplateError([0.1, 1.0, 10.0] * u.um, [0.15, 0.05, 0.30])
    >>> error([0.1, 3.0] * u.um).round(3)
    array([0.15 , 0.169])
    >>> SurveyCalibration.survey().template_error([0.5, 8.0] * u.um).round(3)
    array([0.072, 0.574])
    """

    wave: u.Quantity
    error: np.ndarray

    def __post_init__(self):
        wave = to_array(self.wave, WAVE, "wave", ndim=1)
        error = floats(self.error)
        check_that(is_ascending(wave) and wave[0] > 0, "wave", "ascending values above 0", wave)
        good = error.shape == wave.shape and are_not_negative(error)
        check_that(good, "error", f"{wave.size} finite values, 0 or more", error)
        self.__dict__.update(wave=frozen_array(wave) * WAVE, error=frozen_array(error))

    def __call__(self, wave):
        """Interpolate the error at rest wavelengths (`~astropy.units.Quantity`): an array of their shape."""
        wave = to_array(wave, WAVE, "wave")
        return np.interp(np.log(wave), np.log(self.wave.to_value(WAVE)), self.error)

    @classmethod
    def from_meta(cls, values):
        """Make the template error of the values ``um`` and ``error`` in the file of a `SurveyCalibration`."""
        return cls(values["um"] * WAVE, values["error"])


def pivots(filters):
    """Return the pivot wavelengths (um) of a `FilterSet`, or of bands by name: Quantity, shape (nb,)."""
    if not isinstance(filters, FilterSet):
        filters = FilterSet.from_names(filters)
    return u.Quantity([band.pivot for band in filters]).to(WAVE)


def grid_errors(template_error, filters, redshift):
    """Evaluate the template error, as a part of the flux, at the redshifts of a grid: shape (nz, nb)."""
    if template_error is None:
        return np.zeros((len(redshift), len(filters)))
    check_kind(template_error, "template_error", TemplateError)
    return template_error(pivots(filters) / (1.0 + np.asarray(redshift)[:, None]))
