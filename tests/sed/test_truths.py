"""
Fluxes against what is known from outside: synphot, closed forms, conservation of energy.

synphot joins the points of a spectrum by straight lines in photons for each wavelength, this
package by straight lines in F_nu. Sampled densely enough that the two are one, all 21 bands
agree to 3e-8, and to 3e-6 at redshift 6, where bands bluer than Lyman alpha hold next to nothing.
Straight from `SED.to_synphot` they agree to 2e-4, and to 3e-4 in u at redshift 6.
"""

import astropy.constants as const
import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from astropy.tests.helper import assert_quantity_allclose
from scipy.special import hyp2f1

from miricigale.filters import FilterSet
from miricigale.sed import COSMOLOGY, SED, SEDModel
from miricigale.sed.cosmology import distance

BANDS = [
    *(f"megacam.{band}" for band in "ugriz"),
    *("acs.f606w", "acs.f814w", "wfc3.f125w", "wfc3.f140w", "wfc3.f160w"),
    *("irac.ch1", "irac.ch2", "irac.ch3", "irac.ch4", "mips.24"),
    *("miri.f770w", "miri.f1000w", "miri.f1280w", "miri.f1500w", "miri.f1800w", "miri.f2100w"),
]
REDSHIFTS = (0.0, 0.5, 2.0, 6.0)
GALAXY, NUCLEUS = {"frac_agn": 0.0}, {"frac_agn": 0.95, "ebv_polar": 0.3}


@pytest.fixture(scope="module")
def bundled():
    return SEDModel.yang2021(libraries="bundled")


@pytest.fixture(scope="module")
def clear(bundled):
    """The same without absorption between the galaxies."""
    return SEDModel([c for c in bundled.components if c.role != "igm"])


@pytest.fixture(scope="module")
def all_bands():
    return FilterSet.from_names(BANDS)


def luminosity(sed, far):
    """4 pi d^2 times the integral of F_lambda, straight lines in wavelength, in W."""
    wave = sed.wave.to(u.m)
    flam = (sed.fnu * const.c / wave**2).to(u.W / u.m**3)
    return (4 * np.pi * far**2 * np.trapezoid(flam, wave)).to(u.W)


# -------------------------------------------------------------------------------- synphot


def photon_means(seds, band, wave):
    """Fluxes of a flat F_nu that send synphot as many photons through a band, in uJy."""
    from synphot import Observation, SourceSpectrum
    from synphot.models import ConstFlux1D

    flat = SourceSpectrum(ConstFlux1D, amplitude=1 * u.uJy)
    *counts, unit = (
        Observation(source, band.to_synphot(), binset=wave, force="none").integrate(wave)
        for source in (*(sed.to_synphot() for sed in seds), flat)
    )
    return [float(count / unit) for count in counts]


def dense(sed, band):
    """The spectrum on a grid that holds its points and the band's, and that grid in the band."""
    x, ends = sed.wave.to_value(u.AA), band.wave.to_value(u.AA)
    low, high = ends[[0, -1]]
    parts = [x, ends, np.linspace(low, high, 20_001)]
    grid = np.unique(np.round(np.concatenate(parts), 5))
    inside = grid[(grid >= low) & (grid <= high)]
    around = np.concatenate([[0.99 * low], inside, [1.01 * high]])
    return SED(around * u.AA, np.interp(around, x, sed.fnu.value) * u.uJy), inside * u.AA


@pytest.mark.parametrize(
    ("z", "agn"), [(0.0, GALAXY), (0.5, NUCLEUS), (2.0, NUCLEUS), (6.0, GALAXY)]
)
def test_fluxes_are_those_of_synphot(bundled, all_bands, agn, z):
    values = {"age": 0.5, "ebv": 0.2, "redshift": z} | agn
    sed = bundled.evaluate(**values)
    table = bundled.fluxes(QTable({n: [v] for n, v in values.items()}), all_bands)
    for band in all_bands:
        mine = table[band.name][0].to_value(u.uJy)
        sampled, wave = dense(sed, band)
        theirs, handed_over = photon_means((sampled, sed), band, wave)
        magnitude = [(f * u.uJy).to_value(u.ABmag) for f in (mine, theirs)]
        assert mine == pytest.approx(theirs, rel=1e-5, abs=0), band.name
        assert magnitude[0] == pytest.approx(magnitude[1], abs=2e-5), band.name
        # the spectrum as it is handed over, its lines straight in photons
        assert mine == pytest.approx(handed_over, rel=4e-4 if z == 6 else 2e-4)


# ------------------------------------------------------------------------------ distances


def closed_form_distance(z, h0, om):
    """Luminosity distance of a flat universe with Lambda: 2F1 for the integral over a^-2 / E."""

    def chi(a):
        return 2 * np.sqrt(a / om) * hyp2f1(1 / 6, 1 / 2, 7 / 6, -(1 - om) / om * a**3)

    return (1 + z) * (const.c / (h0 * u.km / u.s / u.Mpc)).to(u.m) * (chi(1.0) - chi(1 / (1 + z)))


@pytest.mark.parametrize("z", [1e-3, 0.1, 0.5, 1.0, 2.0, 6.0, 15.0])
def test_distance_by_closed_form(z):
    got = float(distance(z, COSMOLOGY)) * u.m
    assert_quantity_allclose(got, closed_form_distance(z, 70.4, 0.272), rtol=1e-9)


def test_a_galaxy_is_no_older_than_the_universe(bundled):
    """Age in closed form: 2 / (3 H0 sqrt(OL)) asinh(sqrt(OL / Om) (1 + z)^-1.5)."""
    for z in (0.5, 2.0, 5.0):
        t = 2 / (3 * (70.4 * u.km / u.s / u.Mpc) * np.sqrt(0.728))
        t = (t * np.arcsinh(np.sqrt(0.728 / 0.272) * (1 + z) ** -1.5)).to_value(u.Gyr)
        bundled.values({"age": t * 0.9999, "redshift": z})
        with pytest.raises(ValueError, match="'age' must be at most the age of the universe"):
            bundled.values({"age": t * 1.0001, "redshift": z})


# ----------------------------------------------------------------------------- redshifting


@pytest.mark.parametrize("z", [0.01, 0.5, 2.0, 6.0])
def test_a_spectrum_moves_as_the_distance_modulus_says(clear, z):
    """F_nu(l (1 + z)) = (1 + z) (10 pc / d_L)^2 times what is seen at redshift 0."""
    values = {"age": 0.5, "ebv": 0.3, "frac_agn": 0.4, "mass": 3e10}
    near = clear.evaluate(redshift=0.0, **values)
    far = clear.evaluate(redshift=z, **values)
    rest = np.geomspace(0.1, 200.0, 50) * u.um
    ratio = (1 + z) * (10 * u.pc / closed_form_distance(z, 70.4, 0.272)) ** 2
    got = far.fnu_at(rest * (1 + z)) / near.fnu_at(rest)
    assert_quantity_allclose(got, np.full(50, ratio.to_value("")), rtol=1e-9)


def starlight(model, tau, age):
    """Bolometric luminosity (W) of a delayed history, for one solar mass formed, step by step."""
    stellar = model.component("stellar")
    ages, spectra, _ = stellar.table(0.02)
    power = np.trapezoid(spectra, np.asarray(stellar.nodes()), axis=1)
    t = np.arange(round(age * 1000))
    rate = t * np.exp(-t / (tau * 1000))
    rate /= rate.sum()
    # a step k Myr ago: mean of ten SSPs at k + 0.1 ... 1.0 Myr
    steps = np.arange(t.size)[:, None] + np.arange(1, 11) / 10
    return rate[::-1] @ np.interp(steps, ages, power).mean(axis=1)


@pytest.mark.parametrize("z", REDSHIFTS)
@pytest.mark.parametrize(("ebv", "frac_agn"), [(0.0, 0.0), (0.5, 0.0), (0.4, 0.7)])
def test_all_light_is_that_of_the_stars_and_the_nucleus(clear, z, ebv, frac_agn):
    """
    Luminosity from the spectrum as observed, by the distance in closed form.

    Dust sends out what it takes: whatever E(B-V), the sum is the light of the populations, of
    which the truth is a plain loop over the history, and the AGN's.
    """
    values = {"tau": 0.3, "age": 0.8, "ebv": ebv, "frac_agn": frac_agn, "mass": 2e10}
    spectra = clear.evaluate(redshift=z, **values)
    far = closed_form_distance(z, 70.4, 0.272) if z > 0 else 10 * u.pc
    want = 2e10 * starlight(clear, 0.3, 0.8) * u.W
    if frac_agn:
        want = want + spectra.derived["agn_luminosity"]
    assert_quantity_allclose(luminosity(spectra, far), want, rtol=1e-6)
    parts = spectra.components
    names = ("stellar", "stellar_intrinsic", "dust")
    stars, intrinsic, dust = (luminosity(parts[name], far) for name in names)
    assert_quantity_allclose(stars + dust, intrinsic, rtol=1e-6)
    assert_quantity_allclose(dust, spectra.derived["dust_luminosity"], rtol=1e-6, atol=1 * u.W)
