"""Draine & Li 2007, with its own parameters and as a sequence in alpha."""

import numpy as np

from miricigale.sed import _core
from miricigale.sed.component import register
from miricigale.sed.components.dust.base import DustEmission
from miricigale.sed.parameter import Parameter
from miricigale.utils.exceptions import DataError
from miricigale.utils.files import cached_by_file, open_fits

__all__ = ["DraineLi2007", "DraineLi2007Alpha", "load_dl07"]

U_MAX = 1e6  # of the power law dM/dU ~ U^-2


@cached_by_file(maxsize=2)
def load_dl07(path):
    """
    Read the bundled Draine & Li 2007 table.

    Returns
    -------
    table : dict
        ``wave`` (um), ``qpah`` (per cent), ``u`` and ``umin``; ``single`` (n_q, n_u, n_wave) and
        ``powerlaw`` (n_q, n_umin, n_wave) in W/um with integral 1; ``single_power`` and
        ``powerlaw_power``: power per dust mass in units of that at U = 1.
    """
    names = ["wave", "qpah", "u", "umin", "single", "powerlaw", "single_power", "powerlaw_power"]
    try:
        with open_fits(path, wanted="a Draine & Li table") as hdus:
            table = {name: hdus[name].data.astype(float) for name in names}
    except KeyError as err:
        msg = f"{path} is not a Draine & Li table: {err}"
        raise DataError(msg) from err
    for array in table.values():
        array.flags.writeable = False
    return table


class _DraineLi(DustEmission):
    reference = "Draine & Li 2007, ApJ 657, 810"
    resource = "dust.dl07"

    def _table(self):
        return load_dl07(self.path)

    def nodes(self):
        return self._table()["wave"]


@register
class DraineLi2007(_DraineLi):
    """
    Draine & Li 2007 with its own parameters.

    The mass fraction 1 - gamma is heated by U_min, gamma by dM/dU ~ U^-2 from U_min to 1e6.
    Between tabulated q_PAH and U_min the spectra per dust mass are interpolated (linear in
    q_PAH, linear in log U with the power scaled by U).
    """

    name = "dl07"
    u_min = Parameter(default=1.0, bounds=(0.1, 25.0), doc="Least intensity of starlight.")
    gamma = Parameter(default=0.02, bounds=(0.0, 1.0), doc="Mass fraction heated by more.")
    q_pah = Parameter(default=2.5, bounds=(0.47, 4.58), doc="Mass fraction in PAHs, per cent.")

    @staticmethod
    def mean_intensity(values):
        """
        Mean intensity <U> over the dust mass, Draine & Li 2007, equation 33.

        The power per dust mass is P0 <U>, P0 being that at U = 1 (135 to 139 L_sun / M_sun in
        the table's source, by q_PAH).

        Parameters
        ----------
        values : dict of str to float
            Values of all parameters.

        Returns
        -------
        mean : float
            In units of the starlight near the Sun.
        """
        least, gamma = values["u_min"], values["gamma"]
        lump = least * np.log(U_MAX / least) / (1.0 - least / U_MAX)
        return float((1.0 - gamma) * least + gamma * lump)

    def spectrum(self, values):
        table = self._table()
        q_low, q_part = _cell(table["qpah"], values["q_pah"])
        u_low, u_part = _cell(np.log(table["umin"]), np.log(values["u_min"]))
        out = 0.0
        for j, weight in ((u_low, 1.0 - u_part), (u_low + 1, u_part)):
            scale = weight * values["u_min"] / table["umin"][j]
            for i, share in ((q_low, 1.0 - q_part), (q_low + 1, q_part)):
                single = table["single"][i, j] * table["single_power"][i, j]
                lump = table["powerlaw"][i, j] * table["powerlaw_power"][i, j]
                mixture = (1.0 - values["gamma"]) * single + values["gamma"] * lump
                out = out + share * scale * mixture
        return out


@register
class DraineLi2007Alpha(_DraineLi):
    """
    Draine & Li 2007 arranged as a sequence in the slope alpha of dM/dU ~ U^-alpha.

    A mapping with eight constants, fitted to the sequence of Dale et al. 2014 and scored on
    it: 0.10 dex rms in 5-25 um and 0.06 dex beyond for alpha from 1 to 3.5. MIRI bands differ
    by up to 0.4 mag, the 3.3 um feature by 1 mag. It is **no substitute for Dale et al. 2014**
    in a paper.
    """

    name = "dl07_alpha"
    reference = "Draine & Li 2007, ApJ 657, 810; alpha after Dale et al. 2014, ApJ 784, 83"
    alpha = Parameter(
        default=2.0, bounds=(1.0, 3.5), doc="Slope of dust mass in intensity, as Dale's alpha."
    )

    def spectrum(self, values):
        path = self.path
        intensity, cool, warm = _alpha_tables(path)
        step = values["alpha"] - 2.0
        slope = ALPHA_SLOPE[0] + ALPHA_SLOPE[1] * step + ALPHA_SLOPE[2] * step**2
        log_u = np.log10(intensity)
        edges = _logistic((log_u - ALPHA_U[0]) / 0.05) * _logistic((ALPHA_U[1] - log_u) / 0.05)
        weight = intensity ** (1.0 - slope) * edges
        rich = _logistic((ALPHA_U_PAH - log_u) / 0.1)
        return (weight * rich) @ cool + (weight * (1.0 - rich)) @ warm


#: Ends of log U, where PAHs are destroyed (log U), and the slope's polynomial in alpha - 2.
ALPHA_U = (0.20, 3.19)
ALPHA_U_PAH = 1.373
ALPHA_SLOPE = (2.415, 1.425, 0.5)


def _logistic(x):
    return 1.0 / (1.0 + np.exp(-np.clip(x, -500, 500)))


def _cell(axis, value):
    low = int(np.clip(np.searchsorted(axis, value, side="right") - 1, 0, axis.size - 2))
    part = (value - axis[low]) / (axis[low + 1] - axis[low])
    return low, float(np.clip(part, 0.0, 1.0))


@cached_by_file(maxsize=2)
def _alpha_tables(path):
    """Spectra per dust mass on an even grid in log U, PAH-rich and PAH-poor."""
    table = load_dl07(path)
    intensity = np.geomspace(0.1, U_MAX, 141)
    matrix = _core.hat_matrix(np.log(table["u"]), np.clip(np.log(intensity), None, np.log(U_MAX)))
    out = [intensity]
    for q in (-1, 0):
        mass = table["single"][q] * table["single_power"][q][:, None]
        out.append(np.exp(matrix @ np.log(np.maximum(mass, 1e-300))))
    return out
