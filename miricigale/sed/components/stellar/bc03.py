"""The bundled simple stellar populations."""

from miricigale.sed.component import register
from miricigale.sed.components.stellar.base import StellarPopulations
from miricigale.sed.parameter import Parameter
from miricigale.utils.exceptions import DataError
from miricigale.utils.files import cached_by_file, open_fits

__all__ = ["BC03", "load_ssp"]

SOLAR_LUMINOSITY = 3.828e26  # W, IAU 2015


@cached_by_file(maxsize=2)
def load_ssp(path):
    """
    Read a bundled SSP file.

    Returns
    -------
    wave : `~numpy.ndarray`, shape (n_wave,)
        Wavelengths in um.
    age : `~numpy.ndarray`, shape (n_age,)
        Ages in Myr.
    spectra : dict of float to `~numpy.ndarray`, shape (n_age, n_wave)
        W/um for one solar mass formed, by metallicity.
    living : dict of float to `~numpy.ndarray`, shape (n_age,)
        Mass fraction still alive.
    """
    spectra, living = {}, {}
    try:
        with open_fits(path, wanted="a table of simple stellar populations") as hdus:
            wave = hdus["WAVE"].data.astype(float) / 1e4
            age = hdus["AGE"].data.astype(float) / 1e6
            alive = hdus["LIVING"].data
            for k in range(len(alive)):
                hdu = hdus[f"Z{k + 1}"]
                value = float(hdu.header["METAL"])
                spectra[value] = hdu.data.astype(float) * (SOLAR_LUMINOSITY * 1e4)
                living[value] = alive[k].astype(float)
    except KeyError as err:
        msg = f"{path} is not a table of simple stellar populations: {err}"
        raise DataError(msg) from err
    for array in (wave, age, *spectra.values(), *living.values()):
        array.flags.writeable = False
    return wave, age, spectra, living


@register
class BC03(StellarPopulations):
    """
    Bruzual & Charlot 2003 (2016 version, MILES), bundled, thinned; Kroupa IMF (inferred).

    Six metallicities; others are refused rather than interpolated, and so is the source's
    seventh, 0.1, whose populations below 300 Myr lack most of their light. The living mass
    leaves out remnants. Yang et al. 2021 use BC03 of 2003 with a Chabrier IMF: light for each
    solar mass differs by 0.03 dex, ionising photons by 0.12 dex.
    """

    name = "bc03"
    reference = "Bruzual & Charlot 2003, MNRAS 344, 1000"
    resource = "ssp.bc03"
    imf = "Kroupa (inferred)"
    metallicity = Parameter(
        default=0.02,
        bounds=(0.0001, 0.05),
        doc="Mass fraction of metals: 0.0001, 0.0004, 0.004, 0.008, 0.02 (solar) or 0.05.",
    )

    def nodes(self):
        return load_ssp(self.path)[0]

    def metallicities(self):
        highest = type(self).metallicity.bounds[1]
        return tuple(z for z in load_ssp(self.path)[2] if z <= highest)

    def table(self, metallicity):
        _, age, spectra, living = load_ssp(self.path)
        key = self.nearest(metallicity)
        return age, spectra[key], living[key]
