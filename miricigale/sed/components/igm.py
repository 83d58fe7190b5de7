"""Absorption by the intergalactic medium."""

import tomllib
from pathlib import Path

import numpy as np

from miricigale.sed import _core
from miricigale.sed.component import Component, register
from miricigale.utils.exceptions import data_error, file_errors
from miricigale.utils.files import cached_by_file
from miricigale.utils.units import frozen_array

# n = 2 ... 10: of the lines beyond, each is at most 1.6 % of Lyman alpha in optical depth
_N_LINES = 9

# below the limit light fades within a few per cent in wavelength from z = 4 on, faster than
# the grids of stars resolve: without these bands there are per cents too bright
_BELOW_LIMIT = 1.0 - np.array([0.002, 0.005, 0.01, 0.015, 0.025, 0.035, 0.05, 0.07, 0.09, 0.11])


class IGM(Component):
    """
    Base: `transmission` at observed wavelengths.

    Lines absorb from their rest wavelength to (1 + z) times it, so nothing is absorbed at z = 0 or
    longward of Lyman alpha.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.sed.components import Inoue2014, Madau1995, Meiksin2006
    >>> wave = np.array([0.44])  # um, observed; the source is at z = 3
    >>> laws = (Inoue2014(), Madau1995(), Meiksin2006())
    >>> [round(float(law.transmission(wave, 3.0)[0]), 2) for law in laws]
    [0.76, 0.73, 0.78]
    """

    role = "igm"

    def transmission(self, wave, redshift):
        """
        Mean transmission.

        Parameters
        ----------
        wave : `~numpy.ndarray`, shape (n,)
            Observed wavelengths in um.
        redshift : float
            Redshift of the source.

        Returns
        -------
        transmission : `~numpy.ndarray`, shape (n,)
            From 0 to 1.
        """
        raise NotImplementedError

    def edges(self):
        """Return the rest wavelengths in um of the Lyman lines that jump most, and of the limit."""
        return np.append(_core.lyman_lines(_N_LINES + 2), _core.LYMAN_LIMIT)

    def nodes(self):
        """Return both sides of the Lyman lines and limit, where it jumps, and some below the limit."""
        edges = self.edges()
        blue_edge = edges[-1] * _BELOW_LIMIT
        return np.sort(np.concatenate([edges * (1 - 1e-5), edges * (1 + 1e-5), blue_edge]))


@register
class Meiksin2006(IGM):
    """
    Meiksin 2006 in CIGALE's reading (see ``miricigale.sed._core.meiksin_transmission``).

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.sed.components import Meiksin2006
    >>> Meiksin2006().transmission(np.array([0.36, 0.44, 0.50]), 3.0).round(3)  # um, z = 3
    array([0.497, 0.782, 1.   ])
    """

    name = "meiksin2006"
    reference = "Meiksin 2006, MNRAS 365, 807"

    def transmission(self, wave, redshift):
        return _core.meiksin_transmission(wave, redshift)


@register
class Madau1995(IGM):
    """
    Madau 1995: four Lyman lines and the continuum approximation of footnote 3.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.sed.components import Madau1995
    >>> Madau1995().transmission(np.array([0.36, 0.44, 0.50]), 3.0).round(3)  # um, z = 3
    array([0.466, 0.735, 1.   ])
    """

    name = "madau1995"
    reference = "Madau 1995, ApJ 441, 18"

    def edges(self):
        """Return the rest wavelengths in um of the four lines, and of the limit."""
        return np.append(_core.lyman_lines(6), _core.LYMAN_LIMIT)

    def transmission(self, wave, redshift):
        return _core.madau_transmission(wave, redshift)


@register
class Inoue2014(IGM):
    """
    Inoue et al. 2014: 39 Lyman lines and the continuum, of the forest and of damped systems.

    Table 2 with equations 20 to 22 for the lines, equations 25 to 29 for the continuum.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.sed.components import Inoue2014
    >>> Inoue2014().transmission(np.array([0.36, 0.44, 0.50]), 3.0).round(3)  # um, z = 3
    array([0.546, 0.758, 1.   ])
    """

    name = "inoue2014"
    reference = "Inoue et al. 2014, MNRAS 442, 1805"
    resource = "igm.inoue2014"

    def edges(self):
        """Return the rest wavelengths in um of the first lines of table 2, and of the limit."""
        return np.append(load_lines(self.path)[0][:_N_LINES], _core.INOUE_LIMIT)

    def transmission(self, wave, redshift):
        return _core.inoue_transmission(wave, redshift, load_lines(self.path))


_COLUMNS = ("wavelength", "laf1", "laf2", "laf3", "dla1", "dla2")


@cached_by_file(maxsize=2)
def load_lines(path):
    """
    Read the Lyman series of Inoue et al. 2014, table 2, as `miricigale.sed._core.inoue_lines` gives it.

    A TOML file with the arrays ``wavelength`` (um), ``laf1`` to ``laf3``, ``dla1``, ``dla2``; others are refused.
    """
    with file_errors(path, "is not table 2 of Inoue et al. 2014"):
        columns = tomllib.loads(Path(path).read_text())
        table = np.array([columns[name] for name in _COLUMNS], dtype=float).T
    positive = table.shape == (39, len(_COLUMNS)) and np.all(np.isfinite(table) & (table > 0))
    if not positive or np.any(np.diff(table[:, 0]) >= 0):
        raise data_error(
            path, "must hold six columns of 39 positive numbers, from the longest wavelength on"
        )
    return tuple(map(frozen_array, _core.inoue_lines(table)))
