"""Emission of dust in galaxies; the energy is what attenuation took."""

import numpy as np

from miricigale.refdata.libraries.table import open_library
from miricigale.refdata.tables import read_images
from miricigale.sed import _core
from miricigale.sed.component import Component, register
from miricigale.sed.parameter import Parameter, default_values
from miricigale.utils.caching import cached
from miricigale.utils.files import cached_by_file
from miricigale.utils.units import frozen_array


class DustEmission(Component):
    """
    Base: `template` gives a spectrum that integrates to 1.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.sed.components import Casey2012
    >>> dust = Casey2012()
    >>> round(float(np.trapezoid(dust.template(dust.nodes()), dust.nodes())), 3)  # W
    1.0
    """

    role = "dust"

    def spectrum(self, values):
        """
        Spectrum at `nodes`.

        Parameters
        ----------
        values : dict of str to float
            Values of all parameters.

        Returns
        -------
        spectrum : `~numpy.ndarray`
            L_lambda, not negative, arbitrary scale.
        """
        raise NotImplementedError

    def spectra(self, columns):
        """Return row by row what `spectrum` gives, for columns of values of shape (n,): shape (n, n_node)."""
        rows = zip(*(column.tolist() for column in columns.values()), strict=True)
        return np.array([self.spectrum(dict(zip(columns, row, strict=True))) for row in rows])

    def template(self, wave, **values):
        """
        Return the spectrum for one watt.

        Parameters
        ----------
        wave : `~numpy.ndarray`
            Rest wavelengths in um.
        **values
            Values of the parameters; defaults where not given.

        Returns
        -------
        spectrum : `~numpy.ndarray`
            L_lambda in W/um; the integral over `nodes`, by trapezoids, is 1 W.
        """
        full = default_values(self.parameters) | values
        nodes = self.nodes()
        spectrum = self.spectrum(full)
        return np.interp(wave, nodes, spectrum / np.trapezoid(spectrum, nodes), left=0, right=0)


class _Mixture(DustEmission):
    """
    Base: weighted sums of tabulated spectra.

    ``mixture`` of a subclass gives weights, shape (n, n_table), for columns of values, and the spectra, shape
    (n_table, n_node).
    """

    def spectra(self, columns):
        return _core.weighted_sums(*self.mixture(columns))

    def spectrum(self, values):
        return self.spectra({name: np.array([value]) for name, value in values.items()})[0]


def _interpolation_weights(axis, values):
    """Return the weights, shape (n, n_axis), of the linear interpolation between ascending nodes."""
    cell, part = _core.cells(axis, values)
    out = np.zeros((values.size, axis.size))
    rows = np.arange(values.size)
    part = np.clip(part, 0, 1)
    out[rows, cell] = 1.0 - part
    out[rows, cell + 1] = part
    return out


@cached(maxsize=4)
def _sequence(library, column):
    """Return the alphas and spectra of an open library, in memory."""
    order = np.argsort(library.axes["alpha"])
    return library.axes["alpha"][order], frozen_array(library.spectra[column][order])


@register
class Dale2014(_Mixture):
    """
    Dale et al. 2014 without AGN: dust mass goes as dM ~ U^-alpha dU in the intensity U.

    The 64 templates (alpha in steps of 1/16) are those of the distributed files, normalized to
    1 W; between them a spectrum is the linear interpolation of its neighbors. The option
    ``starlight`` says whether the starlight that CIGALE's builder takes away near 2 um is
    taken away here (``"removed"``) or not (``"kept"``). The files are the user's to bring:
    ``miricigale data add dust.dale2014 PATH``.

    Examples
    --------
    >>> from miricigale.sed.components import Dale2014
    >>> Dale2014(alpha=2.5)
    Dale2014(alpha=2.5, starlight='removed')
    >>> Dale2014().template([7.7, 100.0], alpha=2.5)  # doctest: +SKIP
    """

    name = "dale2014"
    reference = "Dale et al. 2014, ApJ 784, 83"
    resource = "dust.dale2014"
    options = {"starlight": ("removed", "kept")}
    alpha = Parameter(2.0, (0.0625, 4.0), "Slope of dust mass in intensity, dM ~ U^-alpha dU.")

    def nodes(self):
        return open_library(self.path, self.resource).wave

    def mixture(self, columns):
        alphas, spectra = _sequence(open_library(self.path, self.resource), self.starlight)
        return _interpolation_weights(alphas, columns["alpha"]), spectra


#: Constants of L(alpha, T) in um^1/2, um^1/2, 1 / (um K), 1 / (um K), of Casey 2012.
B = (26.68, 6.246, 1.905e-4, 7.243e-5)


#: Steps of 0.014 in ln(wavelength) where there is only the power law, of 0.0052 where the
#: spectrum bends: see docs/accuracy/sed_components.rst for what straight lines between them cost.
NODES = np.append(np.geomspace(1.0, 3.0, 80)[:-1], np.geomspace(3.0, 3000.0, 1330))
NODES.flags.writeable = False


@register
class Casey2012(DustEmission):
    """
    Casey 2012: one blackbody of general opacity and a mid-infrared power law (her equation 3).

    S_nu = [1 - exp(-(200 um / l)^beta)] B_nu(T) + N l^alpha exp(-(l / l_c)^2); l_c is 3/4 of
    L(alpha, T), the wavelength where the slope of the blackbody is alpha, and N is such that
    the power law without its cut-off meets the blackbody at l_c, as in CIGALE.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.sed.components import Casey2012
    >>> dust = Casey2012(temperature_dust=45.0)
    >>> print(f"power law below {dust.turnover(alpha_mir=2.0, temperature_dust=45.0):.1f} um")
    power law below 47.6 um
    >>> dust.template(np.array([24.0, 100.0, 350.0]), temperature_dust=45.0)  # W/um for 1 W
    array([5.39931252e-03, 5.47689776e-03, 5.68961165e-05])
    """

    name = "casey2012"
    reference = "Casey 2012, MNRAS 425, 3094"
    temperature_dust = Parameter(35.0, (10.0, 150.0), "Temperature of the dust.", unit="K")
    emissivity_dust = Parameter(1.6, (0.5, 3.0), "Slope beta of the opacity in frequency.")
    alpha_mir = Parameter(2.0, (1.0, 5.0), "Slope of S_nu in wavelength in the mid-infrared.")

    def nodes(self):
        return NODES

    @staticmethod
    def turnover(alpha_mir, temperature_dust):
        """Wavelength l_c in um above which the power law is cut off, 3/4 of L(alpha, T) of Casey 2012."""
        slope = (B[0] + B[1] * alpha_mir) ** -2.0
        return 0.75 / (slope + (B[2] + B[3] * alpha_mir) * temperature_dust)

    def parts(self, values):
        """Return the blackbody and power law on one, arbitrary scale: L_lambda at `nodes`."""
        temperature = values["temperature_dust"]
        beta = values["emissivity_dust"]
        alpha = values["alpha_mir"]
        turn = self.turnover(alpha, temperature)
        # L_lambda goes as S_nu / lambda^2
        at_turn = _core.modified_blackbody(turn, temperature, beta) * turn**2
        power_law = at_turn * (NODES / turn) ** alpha * np.exp(-((NODES / turn) ** 2)) / NODES**2
        return _core.modified_blackbody(NODES, temperature, beta), power_law

    def spectrum(self, values):
        blackbody, power_law = self.parts(values)
        return blackbody + power_law


U_MAX = 1e6  # of the power law dM/dU ~ U^-2


@cached_by_file(maxsize=2)
def load_dl07(path):
    """
    Read the bundled Draine & Li 2007 table: dict of arrays.

    ``wave`` (um), ``qpah`` (per cent), ``u`` and ``umin``; ``single`` (n_q, n_u, n_wave) and
    ``powerlaw`` (n_q, n_umin, n_wave) in W/um with integral 1; ``single_power`` and
    ``powerlaw_power``: power per dust mass in units of that at U = 1.
    """
    names = ["wave", "qpah", "u", "umin", "single", "powerlaw", "single_power", "powerlaw_power"]
    return read_images(path, names, wanted="a Draine & Li table")


class _DraineLi(_Mixture):
    """Base: mixtures of the bundled spectra, whose feature at 3.3 um is scaled by the parameter ``pah_33``."""

    reference = "Draine & Li 2007, ApJ 657, 810"
    resource = "dust.dl07"

    def nodes(self):
        return load_dl07(self.path)["wave"]

    def _weights(self, columns):
        """Weights of the spectra of `_tables`, by rows of columns."""
        raise NotImplementedError

    def _tables(self):
        """Spectra per dust mass, and the same without the 3.3 um feature."""
        raise NotImplementedError

    def mixture(self, columns):
        weight = self._weights(columns)
        spectra, minimum_spectra = self._tables()
        strength = columns["pah_33"][:, None]
        if np.all(strength == 1.0):
            return weight, spectra
        both_weights = np.hstack([strength * weight, (1.0 - strength) * weight])
        return both_weights, np.concatenate([spectra, minimum_spectra])


@register
class DraineLi2007(_DraineLi):
    """
    Draine & Li 2007 with its own parameters.

    The mass fraction 1 - gamma is heated by U_min, gamma by dM/dU ~ U^-2 from U_min to 1e6.
    Between tabulated q_PAH and U_min the spectra per dust mass are interpolated (linear in
    q_PAH, linear in log U with the power scaled by U).

    The feature at 3.3 um has 0.59 % of the power at 8-1000 um for q_PAH 3.4 %. Star-forming galaxies have about
    0.1 % (Lai et al. 2020, ApJ 905, 55), as ``pah_33=0.2`` gives; the rest of the spectrum takes up the power.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.sed.components import DraineLi2007
    >>> wave = np.array([7.7, 100.0])
    >>> for q_pah in (0.47, 4.58):
    ...     print(q_pah, DraineLi2007().template(wave, q_pah=q_pah))  # W/um for 1 W
    0.47 [0.01031519 0.00605012]
    4.58 [0.0669307  0.00467543]
    """

    name = "dl07"
    u_min = Parameter(1.0, (0.1, 25.0), "Least intensity of starlight.")
    gamma = Parameter(0.02, (0.0, 1.0), "Mass fraction heated by more.")
    q_pah = Parameter(2.5, (0.47, 4.58), "Mass fraction in PAHs, per cent.")
    pah_33 = Parameter(1.0, (0.0, 2.0), "Strength of the 3.3 um feature.")

    @staticmethod
    def mean_intensity(values):
        """
        Return the mean intensity <U> over the dust mass, Draine & Li 2007, equation 33.

        In units of the starlight near the Sun. The power per dust mass is P0 <U>, P0 being that at
        U = 1 (135 to 139 L_sun / M_sun in the table's source, by q_PAH).
        """
        minimum = values["u_min"]
        gamma = values["gamma"]
        return float(
            minimum * (1.0 + gamma * (np.log(U_MAX / minimum) / (1.0 - minimum / U_MAX) - 1.0))
        )

    def _tables(self):
        return _by_mass(self.path)

    def _weights(self, columns):
        table = load_dl07(self.path)
        u_min = columns["u_min"]
        share = _interpolation_weights(table["qpah"], columns["q_pah"])
        scale = (
            _interpolation_weights(np.log(table["umin"]), np.log(u_min))
            * u_min[:, None]
            / table["umin"]
        )
        weight = (share[:, :, None] * scale[:, None]).reshape(u_min.size, -1)
        gamma = columns["gamma"][:, None]
        return np.hstack([(1.0 - gamma) * weight, gamma * weight])


@register
class DraineLi2007Alpha(_DraineLi):
    """
    Draine & Li 2007 arranged as a sequence in the slope alpha of dM/dU ~ U^-alpha.

    A mapping with eight constants, fitted to the sequence of Dale et al. 2014 and scored on
    it: 0.10 dex rms in 5-25 um and 0.06 dex beyond for alpha from 1 to 3.5. MIRI bands differ
    by up to 0.45 mag, by 0.56 mag at the 3.3 um feature. It is **no substitute for Dale et al. 2014**
    in a paper. Dale's templates have 0.23 to 0.30 of its 3.3 um feature, galaxies of CEERS a tenth:
    ``pah_33`` scales that.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.sed.components import DraineLi2007Alpha
    >>> dust = DraineLi2007Alpha()
    >>> warm, cold = (dust.template(np.array([24.0, 160.0]), alpha=a) for a in (1.0, 2.5))
    >>> print(f"24 over 160 um: {warm[0] / warm[1]:.1f} (warm), {cold[0] / cold[1]:.1f} (cold)")
    24 over 160 um: 35.4 (warm), 1.1 (cold)
    """

    name = "dl07_alpha"
    reference = "Draine & Li 2007, ApJ 657, 810; alpha after Dale et al. 2014, ApJ 784, 83"
    alpha = Parameter(2.0, (1.0, 3.5), "Slope of dust mass in intensity, as Dale's alpha.")
    pah_33 = Parameter(1.0, (0.0, 2.0), "Strength of the 3.3 um feature.")

    def _tables(self):
        return _alpha_tables(self.path)[1:]

    def _weights(self, columns):
        intensity = _alpha_tables(self.path)[0]
        step = columns["alpha"][:, None] - 2.0
        slope = ALPHA_SLOPE[0] + ALPHA_SLOPE[1] * step + ALPHA_SLOPE[2] * step**2
        log_u = np.log10(intensity)
        edges = _logistic((log_u - ALPHA_U[0]) / 0.05) * _logistic((ALPHA_U[1] - log_u) / 0.05)
        weight = intensity ** (1.0 - slope) * edges
        rich = _logistic((ALPHA_U_PAH - log_u) / 0.1)
        return np.hstack([weight * rich, weight * (1.0 - rich)])


#: Ends of log U, where PAHs are destroyed (log U), and the slope's polynomial in alpha - 2.
ALPHA_U = (0.20, 3.19)
ALPHA_U_PAH = 1.373
ALPHA_SLOPE = (2.415, 1.425, 0.5)
#: Ends of the 3.3 um feature in um, between which its continuum is a power law.
PAH_33 = (3.0, 3.65)


def _logistic(x):
    return 1.0 / (1.0 + np.exp(-np.clip(x, -500, 500)))


def _without_feature(wave, spectra):
    """Return the spectra whose 3.3 um feature is replaced by the power law through its ends."""
    feature = slice(*np.searchsorted(wave, PAH_33))
    ends = [feature.start, feature.stop]
    log_wave = np.log(wave)
    share = (log_wave[feature] - log_wave[ends[0]]) / np.ptp(log_wave[ends])
    low, high = np.log(np.maximum(spectra[:, ends], 1e-300)).T[:, :, None]
    smooth = spectra.copy()
    smooth[:, feature] = np.exp(low + share * (high - low))
    return smooth


@cached_by_file(maxsize=2)
def _by_mass(path):
    """Spectra per dust mass: of single U at each q_PAH and U_min, then power laws; and all without the feature."""
    table = load_dl07(path)
    parts = []
    for kind in ("single", "powerlaw"):
        spectra = (table[kind] * table[f"{kind}_power"][..., None])[:, : table["umin"].size]
        parts.append(spectra.reshape(-1, spectra.shape[-1]))
    spectra = np.concatenate(parts)
    return spectra, _without_feature(table["wave"], spectra)


@cached_by_file(maxsize=2)
def _alpha_tables(path):
    """Spectra per dust mass on an even grid in log U, PAH-rich and PAH-poor, then without the 3.3 um feature."""
    table = load_dl07(path)
    intensity = np.geomspace(0.1, U_MAX, 141)
    matrix = _core.hat_matrix(np.log(table["u"]), np.clip(np.log(intensity), None, np.log(U_MAX)))
    ends = table["single"][[-1, 0]] * table["single_power"][[-1, 0]][..., None]
    logs = np.log(np.maximum(ends, 1e-300))
    spectra = np.concatenate([np.exp(matrix @ q) for q in logs])
    return intensity, spectra, _without_feature(table["wave"], spectra)
