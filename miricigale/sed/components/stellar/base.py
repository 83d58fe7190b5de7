"""Base of the components that give starlight."""

import functools

import numpy as np

from miricigale.sed import _core
from miricigale.sed.component import Component
from miricigale.sed.parameter import Parameter
from miricigale.utils.exceptions import argument_error

__all__ = ["StellarPopulations"]

_OLDEST = 14000  # Myr, more steps than any history has


class StellarPopulations(Component):
    """Base: a table of SSPs by metallicity, age and wavelength."""

    role = "stellar"

    #: Initial mass function, in words.
    imf = ""

    separation_age = Parameter(
        default=_core.YOUNG,
        bounds=(0.0, 1000.0),
        unit="Myr",
        doc="Age that parts young from old stars; rounded to 1 Myr.",
    )

    def metallicities(self):
        """
        Metallicities that there are.

        Returns
        -------
        values : tuple of float
            Mass fractions of metals, ascending.
        """
        raise NotImplementedError

    def table(self, metallicity):
        """
        One metallicity.

        Parameters
        ----------
        metallicity : float
            One of `metallicities`, within 0.1 %; other values give the nearest one.

        Returns
        -------
        age : `~numpy.ndarray`, shape (n_age,)
            Ages in Myr, from 0.
        spectra : `~numpy.ndarray`, shape (n_age, n_wave)
            L_lambda in W/um for one solar mass formed.
        living : `~numpy.ndarray`, shape (n_age,)
            Mass in stars still alive for one solar mass formed.
        """
        raise NotImplementedError

    def ionizing(self, metallicity):
        """
        Photons that ionise hydrogen, of one metallicity.

        Returns
        -------
        rate : `~numpy.ndarray`, shape (n_age,)
            Photons below 0.0912 um per second for one solar mass formed, at the ages of
            `table`; the integral is exact for spectra that are straight lines between `nodes`.
        """
        weights = _core.photon_weights(np.asarray(self.nodes()), _core.LYMAN_LIMIT)
        some = np.flatnonzero(weights)
        part = slice(0, some[-1] + 1 if some.size else 0)
        return self.table(metallicity)[1][:, part] @ weights[part]

    def age_weights(self, history, values):
        """
        Weights of the tabulated ages for a history.

        Parameters
        ----------
        history : `~numpy.ndarray`, shape (n_steps,)
            Rates in Msun/yr in steps of 1 Myr, oldest first.
        values : dict of str to float
            Among them ``metallicity`` and ``separation_age``.

        Returns
        -------
        young, old : `~numpy.ndarray`, shape (n_age,)
            Solar masses formed less and more than ``separation_age`` ago, spread over the
            table: a step is the mean of ten interpolations in age.
        """
        age = self.table(values["metallicity"])[0]
        if history.size > _OLDEST:
            raise argument_error("history", f"of at most {_OLDEST} steps", history.size)
        steps = _steps(age.tobytes())
        young, old = _core.split_by_age(history, round(values["separation_age"]), age, *steps)
        return young, old

    def nearest(self, metallicity):
        """Of `metallicities`, the nearest in the logarithm."""
        return _nearest(self.metallicities(), metallicity)

    def invalid(self, values):
        wanted = values["metallicity"]
        if abs(self.nearest(wanted) / wanted - 1.0) > 1e-3:
            known = ", ".join(f"{z:g}" for z in self.metallicities())
            return f"'metallicity' must be one of {known}, got {wanted:g}"
        return None


@functools.lru_cache(maxsize=256)
def _nearest(known, metallicity):
    return min(known, key=lambda z: abs(np.log(z / metallicity)))


@functools.lru_cache(maxsize=16)
def _steps(age_bytes):
    """Steps of 1 Myr among these ages, as many as a history may have."""
    return _core.age_steps(np.frombuffer(age_bytes, dtype=float), _OLDEST)
