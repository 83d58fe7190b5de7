"""The cosmology of Yang et al. 2021, and luminosity distances."""

import astropy.units as u
import numpy as np
from astropy.cosmology import FlatLambdaCDM

from miricigale.utils.missing_values import floats

#: WMAP7, as in Yang et al. 2021.
COSMOLOGY = FlatLambdaCDM(H0=70.4, Om0=0.272, name="yang2021")


def distance(redshift, cosmology):
    """
    Return the luminosity distance in meters; 10 pc at redshift 0, as for absolute magnitudes.

    Parameters
    ----------
    redshift : float or `~numpy.ndarray`
        Redshifts >= 0.
    cosmology : `~astropy.cosmology.Cosmology`
        The cosmology.
    """
    z = floats(redshift)
    far = cosmology.luminosity_distance(np.where(z > 0, z, 1.0)).to_value(u.m)
    return np.where(z > 0, far, (10.0 * u.pc).to_value(u.m))
