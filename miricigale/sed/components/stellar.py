"""Light of stars from simple stellar populations."""

import numpy as np

from miricigale.refdata.libraries.table import open_library
from miricigale.refdata.tables import load_ssp
from miricigale.sed import _core
from miricigale.sed.component import Component, register
from miricigale.sed.parameter import Parameter
from miricigale.utils.caching import cached
from miricigale.utils.named_values import subset
from miricigale.utils.options import check_that
from miricigale.utils.units import frozen_array

_OLDEST = 14000  # Myr, more steps than any history has


class StellarPopulations(Component):
    """
    Base: a table of SSPs by metallicity, age and wavelength.

    Examples
    --------
    >>> from miricigale.sed.components import BC03, ConstantSFH
    >>> stars, history = BC03(), ConstantSFH().history({"age": 0.1})
    >>> young, old = stars.age_weights(history, {"metallicity": 0.02, "separation_age": 10.0})
    >>> print(f"{young.sum():.1f} of the mass is younger than 10 Myr")
    0.1 of the mass is younger than 10 Myr
    """

    role = "stellar"

    #: Initial mass function, in words.
    imf = ""

    separation_age = Parameter(
        _core.YOUNG,
        (0.0, 1000.0),
        "Age that parts young from old stars; rounded to 1 Myr.",
        unit="Myr",
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
        surviving : `~numpy.ndarray`, shape (n_age,)
            Mass in surviving stars for one solar mass formed, without remnants.
        """
        raise NotImplementedError

    def ionizing(self, metallicity):
        """
        Return the photons that ionize hydrogen, of one metallicity.

        Returns
        -------
        rate : `~numpy.ndarray`, shape (n_age,)
            Photons below 0.0912 um per second for one solar mass formed, at the ages of
            `table`; the integral is exact for spectra that are straight lines between `nodes`.
        """
        weights = _core.photon_weights(np.asarray(self.nodes()), _core.LYMAN_LIMIT)
        used_ages = np.flatnonzero(weights)
        part = slice(0, used_ages[-1] + 1 if used_ages.size else 0)
        return self.table(metallicity)[1][:, part] @ weights[part]

    def age_weights(self, history, values):
        """
        Return the weights of the tabulated ages for a history.

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
        return tuple(self.masses(history, np.array([history.size]), values)[:, 0])

    def masses(self, histories, end, values):
        """`age_weights` of n histories one after the other, each until one of ``end``: shape (2, n, n_age)."""
        age = self.table(values["metallicity"])[0]
        longest = np.diff(end, prepend=0).max()
        check_that(longest <= _OLDEST, "history", f"of at most {_OLDEST} steps", longest)
        young = round(values["separation_age"])
        return _core.split_by_age(histories, end, young, age, *_steps(age.tobytes()))

    def nearest(self, metallicity):
        """Of `metallicities`, the nearest in the logarithm."""
        return _nearest(self.metallicities(), metallicity)

    def invalid(self, values):
        wanted = values["metallicity"]
        if abs(self.nearest(wanted) / wanted - 1.0) > 1e-3:
            available = ", ".join(f"{z:g}" for z in self.metallicities())
            return f"'metallicity' must be one of {available}, got {wanted:g}"
        return None


@cached(maxsize=256)
def _nearest(nodes, metallicity):
    return min(nodes, key=lambda z: abs(np.log(z / metallicity)))


@cached(maxsize=16)
def _steps(age_bytes):
    """Return the steps of 1 Myr among these ages, as many as a history may have."""
    return _core.age_steps(np.frombuffer(age_bytes, dtype=float), _OLDEST)


@register
class BC03(StellarPopulations):
    """
    Bruzual & Charlot 2003 (2016 version, MILES), bundled, thinned; Kroupa IMF (inferred).

    Six metallicities; others are refused rather than interpolated, and so is the source's
    seventh, 0.1, whose populations below 300 Myr lack most of their light. The surviving mass
    leaves out remnants. Yang et al. 2021 use BC03 of 2003 with a Chabrier IMF: light for each
    solar mass differs by 0.03 dex, ionizing photons by 0.12 dex.

    Examples
    --------
    >>> from miricigale.sed.components import BC03
    >>> stars = BC03()
    >>> stars.metallicities()
    (0.0001, 0.0004, 0.004, 0.008, 0.02, 0.05)
    >>> age, spectra, surviving = stars.table(0.02)
    >>> print(f"{surviving[-1]:.2f} Msun of 1 Msun survive {age[-1] / 1e3:.1f} Gyr")
    0.44 Msun of 1 Msun survive 14.0 Gyr
    """

    name = "bc03"
    reference = "Bruzual & Charlot 2003, MNRAS 344, 1000"
    resource = "ssp.bc03"
    imf = "Kroupa (inferred)"
    metallicity = Parameter(
        0.02,
        (0.0001, 0.05),
        "Mass fraction of metals: 0.0001, 0.0004, 0.004, 0.008, 0.02 (solar) or 0.05.",
        label=True,
    )

    def nodes(self):
        return load_ssp(self.path)[0]

    def metallicities(self):
        highest = type(self).metallicity.bounds[1]
        return tuple(z for z in load_ssp(self.path)[2] if z <= highest)

    def table(self, metallicity):
        _, age, spectra, surviving = load_ssp(self.path)
        key = self.nearest(metallicity)
        return age, spectra[key], surviving[key]


@register
class BC03Library(StellarPopulations):
    """
    Bruzual & Charlot 2003 or 2016 as distributed, any IMF; the files are the user's to bring.

    ``miricigale data add ssp.bc03_user PATH`` reads them. Metallicities that the files do not
    have are refused rather than interpolated. The surviving mass leaves out remnants.

    Examples
    --------
    >>> from miricigale.sed.components import BC03Library
    >>> BC03Library(metallicity=0.008)
    BC03Library(separation_age=10, metallicity=0.008)
    >>> BC03Library().table(0.008)  # doctest: +SKIP
    """

    name = "bc03_library"
    reference = "Bruzual & Charlot 2003, MNRAS 344, 1000"
    resource = "ssp.bc03_user"
    metallicity = Parameter(
        0.02,
        (0.0001, 0.1),
        "Mass fraction of metals, one of those that the files have.",
        label=True,
    )

    def _library(self):
        return open_library(self.path, self.resource)

    @property
    def imf(self):
        """Initial mass function of the files."""
        return self._library().meta["imf"]

    @property
    def settings(self):
        return subset(self._library().meta, ("imf", "models", "version"))

    @property
    def library(self):
        meta = self._library().meta
        return f"{self.resource}: {meta['models']}, {meta['imf']} IMF"

    def nodes(self):
        return self._library().wave

    def metallicities(self):
        return tuple(self._library().levels["metallicity"].tolist())

    def table(self, metallicity):
        return _library_table(self._library(), self.nearest(metallicity))

    def __repr__(self):
        # the files need not be there
        values = [f"{n}={p.default:g}" for n, p in self.parameters.items()]
        return f"{type(self).__name__}({', '.join(values)})"


@cached(maxsize=8)
def _library_table(library, metallicity):
    """Return the ages, spectra in memory and surviving masses of one metallicity of an open library."""
    rows = np.flatnonzero(library.axes["metallicity"] == metallicity)
    rows = rows[np.argsort(library.axes["age"][rows])]
    # the name in files made before
    if "surviving" in library.values:
        name = "surviving"
    else:
        name = "living"
    columns = library.axes["age"], library.spectra["luminosity"], library.values[name]
    return tuple(frozen_array(column[rows]) for column in columns)
