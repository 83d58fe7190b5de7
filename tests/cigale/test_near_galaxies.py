"""Near galaxies: a redshift of 0, or a little below, with a distance of their own."""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import Table
from numpy.testing import assert_allclose

from helpers.errors import refuses
from miricigale import BayesFitter, SEDModel
from miricigale.cigale import read_cigale_catalog
from miricigale.cigale.distances import at_their_distances
from miricigale.filters.band_names import find_filter
from miricigale.fitting import GridSettings

BANDS = ["acs.f606w", "acs.f814w", "wfc3.f160w", "irac.ch1"]


@pytest.fixture(scope="module")
def model():
    return SEDModel.yang2021(agn=False, libraries="bundled")


def test_masses_at_redshift_zero_are_those_of_the_distance(model):
    """10^9 solar masses at 3 Mpc: the model at 10 pc, by the inverse square of the distance."""
    fluxes = model.fluxes({"redshift": [0.0], "age": [1.0], "ebv": [0.1], "mass": [1e9]}, BANDS)
    table = Table({"id": [7]})
    for name in BANDS:
        table[name] = fluxes[name] * float((10 * u.pc / (3 * u.Mpc)) ** 2)
        table[f"{name}_err"] = 0.02 * table[name]
    axes = {"redshift": [0.0, 0.5], "age": [1.0, 3.0], "ebv": [0.1, 0.3]}
    settings = GridSettings(interpolate=0)
    fitter = BayesFitter(model, BANDS, axes=axes, model_error=0.0, settings=settings)
    results = fitter.fit(table, redshift=0.0)
    assert results.fitted.all()
    scaled = at_their_distances(results, np.zeros(1), [3.0] * u.Mpc, model.cosmology)
    assert_allclose(scaled.best["mass"].value, 1e9, rtol=1e-6)
    between = BayesFitter(model, BANDS, axes=axes, model_error=0.0)
    refuses(r"'redshift' must be above 0 \(for a near galaxy", between.fit, table, redshift=0.0)


@pytest.mark.parametrize("distance", [None, 150.0])
def test_mass_at_another_distance_keeps_the_flux(model, distance):
    """A flux is mass (1 + z) / d^2: models at 0.05, the galaxy at 0.03, or at a distance of its own."""
    table = model.fluxes({"redshift": [0.05], "age": [1.0], "ebv": [0.1], "mass": [1e9]}, BANDS)
    table["id"] = [7]
    for name in BANDS:
        table[f"{name}_err"] = 0.02 * table[name]
    axes = {"redshift": [0.05, 0.5], "age": [1.0, 3.0], "ebv": [0.1, 0.3]}
    settings = GridSettings(interpolate=0)
    fitter = BayesFitter(model, BANDS, axes=axes, model_error=0.0, settings=settings)
    results = fitter.fit(table, redshift=0.05)
    given = None if distance is None else [distance] * u.Mpc
    scaled = at_their_distances(results, np.array([0.03]), given, model.cosmology)
    there, here = model.cosmology.luminosity_distance([0.05, 0.03]).to_value(u.Mpc)
    here = here if distance is None else distance
    wanted = 1e9 * (here / there) ** 2 * 1.05 / 1.03
    assert_allclose(scaled.best["mass"].value, wanted, rtol=1e-5)
    assert_allclose(scaled.best["redshift"], 0.03)


def test_a_galaxy_with_a_distance_may_approach(tmp_path):
    """M31 has -0.001, and 0.78 Mpc."""
    rows = Table(
        {
            "id": ["M31", "far", "bad"],
            "redshift": [-0.001, 1.0, -9999.0],
            "distance": [0.78, np.nan, 1.0],
        }
    )
    rows["IRAC1"] = [1.0, 1.0, 1.0]
    rows["IRAC1_err"] = [0.1, 0.1, 0.1]
    rows.write(tmp_path / "c.txt", format="ascii")
    table = read_cigale_catalog(tmp_path / "c.txt")
    assert_allclose(table["redshift"], [0.0, 1.0, np.nan])


@pytest.mark.parametrize(
    ("name", "ours"),
    [
        ("SUBARU_B", "sedpy.subaru_suprimecam_B"),
        ("SUBARU_r", "sedpy.subaru_suprimecam_rp"),
        ("SUBARU_IA427", "sedpy.subaru_suprimecam_ia427"),
        ("Subaru/Suprime-Cam.IB484", "sedpy.subaru_suprimecam_ia484"),
        ("B_SUBARU", "sedpy.subaru_suprimecam_B"),
        ("ISAAC_Ks", "sedpy.vlt_isaac_Ks"),
        ("VLT/ISAAC.H", "sedpy.vlt_isaac_H"),
        ("MOIRCS_J", "sedpy.subaru_moircs_J"),
        ("VIMOS_R", "sedpy.vlt_vimos_R"),
    ],
)
def test_names_of_the_subaru_telescope_and_the_vlt(name, ours):
    assert find_filter(name) == ours
