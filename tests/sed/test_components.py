import numpy as np
import pytest
from astropy.io import fits

from helpers.components import values_of
from helpers.errors import refuses
from miricigale.refdata.libraries.ised import read_ised
from miricigale.sed.components import BC03, DelayedSFH
from miricigale.utils.exceptions import DataError

# ----------------------------------------------------------------------------- stars


@pytest.mark.parametrize("name", ["delayed0.5", "delayed1", "delayed3"])
def test_delayed_composites_agree_with_those_of_bc03(data_file, name):
    """
    BC03's own composites (2003, low resolution, Chabrier) against ours (2016, MILES, Kroupa).

    The histories are the same; with a Kroupa IMF a solar mass gives 0.034 dex less light at
    every wavelength than with Chabrier's. What remains is below 0.02 dex.
    """
    part = read_ised(data_file(f"bc03/bc2003_lr_m62_chab_{name}_dust00.ised.gz"))
    age, lam = part.age, part.wave / 1e4
    stars, sfh = BC03(), DelayedSFH()
    tau = float(name.removeprefix("delayed"))
    for target in (1e9, 4e9):
        row = int(np.argmin(np.abs(age - target)))
        flux = part.spectra[row].astype(float)
        history = sfh.history(values_of(sfh, age=age[row] / 1e9, tau=tau))
        _, spectra, _ = stars.table(0.02)
        mine = sum(stars.age_weights(history, values_of(stars))) @ spectra / (3.828e26 * 1e4)
        formed = 1 - (1 + age[row] / 1e9 / tau) * np.exp(-age[row] / 1e9 / tau)
        for center in (0.44, 0.55, 0.7, 0.9, 1.25, 1.65, 2.2):
            band = np.linspace(0.95 * center, 1.05 * center, 200)
            theirs = np.interp(band, lam, flux).mean()
            ours = np.interp(band, stars.nodes(), mine).mean() * formed
            assert np.log10(ours / theirs) == pytest.approx(-0.034, abs=0.02), (target, center)


# ------------------------------------------------------------------------------ files


def test_foreign_files_are_refused(tmp_path):
    from miricigale.refdata.tables import load_ssp

    path = tmp_path / "other.fits"
    fits.PrimaryHDU(np.zeros((2, 2))).writeto(path)
    refuses("not a table of simple stellar populations", load_ssp, str(path), error=DataError)
