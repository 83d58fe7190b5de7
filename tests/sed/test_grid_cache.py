import functools
import json
import logging
import os
import re
from concurrent.futures import ThreadPoolExecutor
from importlib import resources
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.cosmology import Planck18
from numpy.testing import assert_allclose, assert_array_equal

from miricigale import conf
from miricigale.filters import Filter, FilterSet
from miricigale.filters import filter as filter_curves
from miricigale.refdata import resource
from miricigale.sed import COMPONENTS, Component, SEDModel, chain, gridding
from miricigale.sed.components import (
    BC03,
    Attenuation,
    CalzettiLeitherer,
    DelayedSFH,
    DraineLi2007,
    ParametricTorus,
)
from miricigale.sed.grid_cache import grid_key

AXES = {"age": [0.5, 2.0], "ebv": [0.1, 0.4], "redshift": [0.3, 1.0]}
BANDS = FilterSet.from_names(["wfc3.f160w", "miri.f770w"])


@pytest.fixture
def folder(tmp_path):
    with conf.set_temp("cache_folder", str(tmp_path)):
        yield tmp_path / "grids"


@pytest.fixture
def made(monkeypatch):
    """How many grids were really made."""
    calls = []
    real = gridding.model_grid

    def count(*args):
        calls.append(args)
        return real(*args)

    monkeypatch.setattr(gridding, "model_grid", count)
    return calls


def model(attenuation=None, **options):
    parts = [DelayedSFH(), BC03(), attenuation or CalzettiLeitherer(), DraineLi2007()]
    return SEDModel(parts, **options)


def same(a, b):
    for name in ("galaxy", "agn", "redshift", "dust_luminosity", "frac_agn", "allowed"):
        assert_array_equal(getattr(a, name), getattr(b, name))
    assert (a.filters, a.n_models) == (b.filters, b.n_models)
    assert {**a.meta, "created": 0} == {**b.meta, "created": 0}
    for name in ("galaxy_properties", "galaxy_shape", "galaxy_parameters"):
        one, two = getattr(a, name), getattr(b, name)
        assert one.colnames == two.colnames
        for column in one.colnames:
            assert one[column].unit == two[column].unit
            assert one[column].info.description == two[column].info.description
            assert_array_equal(one[column].value, two[column].value)


def test_a_grid_is_made_once_and_read_back_bit_for_bit(folder, made):
    first = model().grid(AXES, BANDS)
    again = model().grid(AXES, BANDS)
    assert len(made) == 1
    same(first, again)
    same(first, model().grid(AXES, BANDS, cache=False))
    assert len(made) == 2


def test_everything_that_shapes_a_grid_is_in_its_name(folder):
    axes = gridding.check_axes(model(), AXES)
    changed = gridding.check_axes(model(), AXES | {"ebv": [0.1, 0.4 + 1e-15]})
    band = BANDS[0]
    dimmed = band.throughput * np.linspace(1, 0.99, band.wave.size)
    curve = Filter(band.wave, dimmed, name=band.name)
    keys = [
        grid_key(model(), axes, BANDS),
        grid_key(model(), changed, BANDS),
        grid_key(model(), axes, BANDS[:1]),
        grid_key(model(), axes, FilterSet([curve, BANDS[1]])),
        grid_key(model(cosmology=Planck18), axes, BANDS),
        grid_key(model(frac_agn_definition="3-1000um"), axes, BANDS),
        grid_key(model(CalzettiLeitherer(slope=0.1)), axes, BANDS),
        grid_key(model(CalzettiLeitherer(ebv_scaling="cigale")), axes, BANDS),
    ]
    assert len(set(keys)) == len(keys)
    assert grid_key(model(), axes, BANDS) == keys[0]


def test_code_is_known_by_the_versions_that_it_states(monkeypatch):
    """A docstring, a comment or another module changes nothing; numbers that change say so."""
    axes = gridding.check_axes(model(), AXES)
    key = functools.partial(grid_key, model(), axes, BANDS)
    before = key()
    monkeypatch.setattr(CalzettiLeitherer, "__doc__", "In other words.")
    monkeypatch.setattr(CalzettiLeitherer, "__module__", "miricigale.sed.elsewhere")
    assert key() == before
    keys = [before]
    # of the class, of its bases, and of what all components share
    owners = {CalzettiLeitherer: 2, Attenuation: 3, Component: 4, chain: 2, filter_curves: 2}
    for owner, version in owners.items():
        name = "version" if isinstance(owner, type) else "VERSION"
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, version, raising=False)
            keys.append(key())
    assert len(set(keys)) == len(keys)
    assert key() == before


def numbers(name):
    """Some numbers of a component of a role in an otherwise simple chain."""
    cls = COMPONENTS.get(name)
    parts = {"sfh": "delayed", "stellar": "bc03", "attenuation": "calzetti", "dust": "dl07"}
    parts |= {"agn": "parametric_torus"} if cls.role == "xray" else {}
    parts[cls.role] = name
    chosen = [COMPONENTS.get(part)() for part in parts.values()]
    chain = SEDModel(chosen)
    values = {"age": 0.5, "redshift": 3.0}
    values |= {"frac_agn": 0.5} if chain.has_agn else {}
    table = chain.fluxes({key: [value] for key, value in values.items()}, NUMBER_BANDS)
    skip = ("flags", "stellar_mass_formed")
    return [table[column][0] for column in table.colnames if column not in skip]


NUMBER_BANDS = ["acs.f435w", "wfc3.f160w", "miri.f770w", "miri.f2550w"]
KEPT = Path(__file__).with_name("numbers.json")


@pytest.mark.parametrize("name", sorted(json.loads(KEPT.read_text())))
def test_numbers_do_not_change_without_a_new_version(name):
    """Where this fails by intent: raise ``version`` of the component and note the new numbers."""
    kept = json.loads(KEPT.read_text())[name]
    cls = COMPONENTS.get(name)
    versions = [vars(base)["version"] for base in cls.__mro__ if "version" in vars(base)]
    assert versions == kept["versions"], f"note the new numbers of {name} in {KEPT.name}"
    got = [float(u.Quantity(value).value) for value in numbers(name)]
    assert_allclose(got, kept["numbers"], rtol=1e-9, err_msg=f"raise {name}.version")


def change_torus(folder, width):
    """A torus of other constants in the data folder, which goes before the bundled one."""
    target = folder / resource("torus.parametric").file
    target.parent.mkdir(parents=True, exist_ok=True)
    bundled = resources.files("miricigale.refdata") / "files" / resource("torus.parametric").file
    text, n = re.subn(r"(?m)^b = .*$", f"b = {width}", bundled.read_text())
    assert n == 1
    target.write_text(text)


AGN_AXES = {"age": [1.0], "frac_agn": [0.0, 0.5], "redshift": [0.3]}


def with_agn():
    return SEDModel([*model().components, ParametricTorus()])


@pytest.mark.filterwarnings("ignore:resource 'torus.parametric' is taken from")
def test_other_data_make_another_grid(folder, made, tmp_path):
    """A model goes on with what it has read; nobody else gets its grid for the new data's."""
    with conf.set_temp("data_folder", str(tmp_path / "data")):
        old = with_agn()
        before = old.grid(AGN_AXES, BANDS)
        change_torus(tmp_path / "data", 1.3)
        after = with_agn().grid(AGN_AXES, BANDS)
        assert len(made) == 2
        assert not np.allclose(before.agn / after.agn, 1.0, rtol=1e-3)
        same(after, with_agn().grid(AGN_AXES, BANDS, cache=False))
        axes = AGN_AXES | {"redshift": [0.4]}
        old.grid(axes, BANDS)
        same(with_agn().grid(axes, BANDS), with_agn().grid(axes, BANDS, cache=False))


def test_components_from_elsewhere_are_not_cached(folder, made):
    """Their code may change under the same name, as in a notebook."""

    class Grey(CalzettiLeitherer):
        def factors(self, wave, values):
            dim = np.full(wave.size, 0.5)
            return dim, dim

    for _ in range(2):
        model(Grey()).grid(AXES, BANDS)
    assert len(made) == 2
    assert not folder.exists()


def test_the_words_are_those_of_whoever_asks(folder, made):
    axes = {"age": [1.0], "redshift": [0.3]}
    SEDModel.yang2021(agn=False, libraries="bundled").grid(axes, BANDS)
    grid = SEDModel.yang2021(agn=False).grid(axes, BANDS)
    assert len(made) == 1
    assert all("not registered" in note for note in grid.meta["libraries"])
    assert {n: v.tolist() for n, v in grid.axes.items()} == {"age": [1.0], "redshift": [0.3]}


def test_threads_at_the_same_grid_get_the_same_numbers(folder):
    with ThreadPoolExecutor(4) as pool:
        grids = list(pool.map(lambda _: model().grid(AXES, BANDS), range(8)))
    for grid in grids[1:]:
        same(grids[0], grid)
    assert len(list(folder.iterdir())) == 1


def test_a_damaged_file_is_made_again_and_said(folder, made, caplog):
    first = model().grid(AXES, BANDS)
    (path,) = folder.glob("*.fits")
    path.write_bytes(path.read_bytes()[:2000])
    with caplog.at_level(logging.WARNING):
        again = model().grid(AXES, BANDS)
    assert "cached grid not used" in caplog.text
    assert len(made) == 2
    same(first, again)
    model().grid(AXES, BANDS)
    assert len(made) == 2


@pytest.mark.skipif(os.name != "posix", reason="needs a file in the way of a folder")
def test_a_folder_that_cannot_be_written_is_done_without(tmp_path, made, caplog):
    (tmp_path / "grids").write_text("in the way")
    with conf.set_temp("cache_folder", str(tmp_path)), caplog.at_level(logging.WARNING):
        grid = model().grid(AXES, BANDS)
    assert grid.n_galaxies == 4
    assert "not kept in the cache" in caplog.text


def test_the_cache_keeps_to_its_size(folder, made):
    model().grid(AXES, BANDS)
    (old,) = folder.glob("*.fits")
    os.utime(old, (1, 1))
    # room for one and a half of them, in MB
    with conf.set_temp("grid_cache_size", 1):
        limit = conf.grid_cache_size * 1e6
        filler = folder / "filler.fits"
        filler.write_bytes(b"0" * int(limit - 1.5 * old.stat().st_size))
        os.utime(filler, (2, 2))
        model().grid(AXES | {"ebv": [0.2]}, BANDS)
    names = {path.name for path in folder.glob("*.fits")}
    assert old.name not in names
    assert "filler.fits" in names
    assert len(names) == 2
    with conf.set_temp("grid_cache_size", 0):
        model().grid(AXES | {"ebv": [0.3]}, BANDS)
    assert len(list(folder.glob("*.fits"))) == 2
