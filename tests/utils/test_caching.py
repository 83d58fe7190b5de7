"""What is kept for all cannot be changed by any: every cached function of the package is called and tried."""

import copy
import dataclasses
import importlib
import json
import pickle
import pkgutil
import re
from collections import namedtuple
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import QTable, Table

import miricigale
from miricigale.filters import Filter
from miricigale.fitting import SurveyCalibration
from miricigale.psf.telescope import Telescope
from miricigale.refdata import locate
from miricigale.refdata.tables import load_ssp
from miricigale.sed import tables
from miricigale.sed.components import ModifiedStarburst, dust, igm, nebular
from miricigale.utils.caching import FrozenDict, FrozenList, cached, cached_property, frozen
from miricigale.workflow.config import load_config
from miricigale.workflow.stages import grids
from miricigale.workflow.stages.exposures import all_exposures, exposure_sections

ROOT = Path(miricigale.__file__).parent

#: Arguments of cached functions that need some, by module and name.
WAVE = np.geomspace(0.1, 30.0, 50).tobytes()
ARGUMENTS = {
    "filters.band_names.find_filter": ("F770W",),
    "filters.band_names.filter_of_band": ("IRAC1",),
    "filters.band_names.cigale_band": ("miri.f770w",),
    "filters.filter._from_name": ("miri.f770w",),
    "sed.components.stellar._nearest": ((0.008, 0.02), 0.01),
    "sed.components.stellar._steps": (np.array([10.0, 20.0, 50.0]).tobytes(),),
    "sed.components.parametric_torus._planck_by_radius": (WAVE, 1500.0, 0.5, 20.0),
    "sed.components.parametric_torus._gauss": (4,),
    "sed.components.attenuation._exponents": (WAVE, "calzetti"),
    "sed.components.agn._polar_grid": (WAVE, "smc"),
    "sed.gridding._sparse_weights": (
        Filter.from_name("miri.f770w"),
        np.geomspace(1.0, 20.0, 300).tobytes(),
        np.array([1.0, 1.5]).tobytes(),
    ),
    "sed.foreground._table": ("G23", 3.1),
    "sed.parameter_names._cigale_parameters": (("tau", "age"), True),
    "fitting.grid.points.quasi_random": (3, 6, 1),
    "fitting.grid.labels.places_in_cells": (3, 64),
    "fitting.survey.defaults._survey_calibration": (("miri.f770w",),),
    "fitting.posterior.priors._declared": (("delayed",), "f_burst", "absent_at_zero"),
    "instrument.dithers._cycling": ("cycling-small",),
    "instrument.wcs._sip": ("SUB64",),
    "instrument.detector._flat_pixels": (1,),
    "instrument.detector._full_flat": ("miri.f770w", 1),
    "planning.exposures._detector": ("", ""),
    "psf.hst._hst_blur": (0.06,),
    "psf.hst._hst_optics": ("wfc3.f160w", 0.06, 11, 45.0),
    "psf.telescope.band_quantiles": ("miri.f770w",),
    "utils.caching._fields_to_freeze": (Filter,),
    "utils.package_tables.declared": ("miricigale.fitting", "columns.toml"),
    "utils.compilation._digest": ("miricigale",),
    "workflow.background._named": ("miri.f770w", "low", None, None),
    "workflow.engine.stage._parts": ("a/b-1",),
}
#: Those that are tried below in their own way (methods, and functions of files and of configurations), whose
#: objects are pieces of programs (templates of pages), or that return nothing.
ELSEWHERE = {
    "sed.components.stellar._library_table",
    "sed.components.dust._sequence",
    "sed.tables._stack",
    "workflow.patches._inputs_and_grid",
    "workflow.stages.inputs._catalog",
    "workflow.stages.exposures._file_pattern",
    "workflow.stages.exposures._pointings",
    "workflow.stages.exposures.all_exposures",
    "workflow.stages.grids._field_wcs",
    "workflow.stages.grids._patches",
    "psf.miri._miri_data",
    "pages.rendering._environment",
    "pages.rendering.macros",
    "utils.compilation._forget_stale",
    "utils.compilation._warn_of_no_cache",
}
#: Modules that keep what nobody else gets: a function of the caller, transforms within one call.
PRIVATE = {
    "utils/caching.py",
    "utils/parallel.py",
    "photometry/templates/normal_equations.py",
    "photometry/shapes/shape_models.py",
}


def cached_functions():
    """Functions of the package with a cache, by module and name."""
    found = {}
    for module in pkgutil.walk_packages(miricigale.__path__, "miricigale."):
        name = module.name.removeprefix("miricigale.")
        path = ROOT / f"{name.replace('.', '/')}.py"
        if name == "__main__" or not path.is_file() or "@cached" not in path.read_text():
            continue
        loaded = importlib.import_module(module.name)
        for key, value in vars(loaded).items():
            own = getattr(value, "__module__", None) == module.name
            if own and hasattr(value, "cache_info") and not isinstance(value, type):
                found[f"{name}.{key}"] = value
    return found


FUNCTIONS = cached_functions()


def snapshot(value):
    """Numbers and text of a value, for comparison."""
    if isinstance(value, np.ndarray):
        return repr(value.tolist()) if value.dtype.kind == "O" else np.asarray(value).tobytes()
    if isinstance(value, Table):
        return {name: repr(np.asarray(value[name]).tolist()) for name in value.colnames}
    if isinstance(value, dict):
        return {key: snapshot(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [snapshot(entry) for entry in value]
    if dataclasses.is_dataclass(value):
        return {f.name: snapshot(getattr(value, f.name)) for f in dataclasses.fields(value)}
    return repr(value)


def attempt(change):
    """Whether a change is carried out."""
    try:
        change()
    except (TypeError, ValueError, AttributeError, RuntimeError):
        return False
    return True


def try_to_change(value):
    """Change all that can be changed in a value, as a caller might."""
    if isinstance(value, np.ndarray):
        attempt(
            lambda: value.fill(np.zeros((), value.dtype)[()] if value.dtype.kind != "O" else None)
        )
        attempt(lambda: np.multiply(value, 3, out=value))
        attempt(lambda: value.__setitem__(..., value[...] * 2 + 1))
    elif isinstance(value, Table):
        for name in value.colnames:
            attempt(lambda n=name: value.__setitem__(n, np.zeros(len(value))))
        value.meta["changed"] = True
    elif isinstance(value, dict):
        for entry in list(value.values()):
            try_to_change(entry)
        attempt(lambda: value.update(changed=True))
        attempt(value.clear)
    elif isinstance(value, (list, tuple)):
        for entry in value:
            try_to_change(entry)
        attempt(lambda: value.append(0))
        attempt(lambda: value.__setitem__(0, None))
    elif isinstance(value, set):
        value.add("changed")
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            try_to_change(getattr(value, field.name))
            attempt(lambda n=field.name: setattr(value, n, None))


def test_every_cached_function_is_tried():
    assert len(FUNCTIONS) > 40
    free = {
        name
        for name, function in FUNCTIONS.items()
        if not re.search(r"\((\w|\*)", str(importlib.import_module("inspect").signature(function)))
    }
    known = free | set(ARGUMENTS) | ELSEWHERE
    with_defaults = {
        "instrument.siaf.aperture",
        "instrument.published_tables.table",
        "psf.optics.jwst_pupil",
    }
    with_defaults |= {"psf.optics.hst_pupil"}
    assert set(FUNCTIONS) - known - with_defaults == set()


@pytest.mark.parametrize("name", sorted(set(FUNCTIONS) - ELSEWHERE))
def test_what_is_cached_cannot_be_changed(name):
    function, arguments = FUNCTIONS[name], ARGUMENTS.get(name, ())
    before = snapshot(function(*arguments))
    try_to_change(function(*arguments))
    assert snapshot(function(*arguments)) == before


BAND = Filter.from_name("miri.f770w")
#: Cached methods and properties, and functions of files and of objects.
CALLS = {
    "SurveyCalibration.survey": SurveyCalibration.survey,
    "Component.declared": ModifiedStarburst.declared,
    "Filter.pivot": lambda: BAND.pivot,
    "Filter.width": lambda: BAND.width,
    "Filter.fwhm": lambda: BAND.fwhm,
    "Filter.effective_wavelength": lambda: BAND.effective_wavelength,
    "Telescope.image": lambda: Telescope("miri.f770w", 4.8, 0.0, 1, 2, 128).image(0.1, 11),
    "tables._stack": lambda: tables._stack((BAND, Filter.from_name("miri.f1000w"))),
    "load_ssp": lambda: load_ssp(locate("ssp.bc03")),
    "load_dl07": lambda: dust.load_dl07(locate("dust.dl07")),
    "dust._by_mass": lambda: dust._by_mass(locate("dust.dl07")),
    "dust._alpha_tables": lambda: dust._alpha_tables(locate("dust.dl07")),
    "load_lines": lambda: igm.load_lines(locate("igm.inoue2014")),
    "load_nebular": lambda: nebular.load_nebular(locate("nebular.cloudy")),
    "grids._field_wcs": lambda: grids._field_wcs(exposure_sections(load_config("goodss")), 0.11),
    "all_exposures": lambda: all_exposures(*exposure_sections(load_config("goodss"))),
}


@pytest.mark.parametrize("name", sorted(CALLS))
def test_methods_and_tables_of_files_are_safe_too(name):
    call = CALLS[name]
    before = snapshot(call())
    try_to_change(call())
    assert snapshot(call()) == before


def test_a_changed_calibration_changes_no_later_fit():
    """Priors of the calibration that one caller has changed are not those of the next."""
    name, (_, weights) = next(iter(SurveyCalibration.survey().priors.items()))
    before = weights.copy()
    mine = SurveyCalibration.survey()
    mine.priors[name][1][:] = 1e-9
    mine.bands["error_part"] = 0.5
    assert np.array_equal(SurveyCalibration.survey().priors[name][1], before)
    assert not np.any(SurveyCalibration.survey().bands["error_part"] == 0.5)


def test_nothing_is_cached_in_another_way():
    found = set()
    for path in ROOT.rglob("*.py"):
        name = path.relative_to(ROOT).as_posix()
        if re.search(r"functools\.(lru_cache|cache)\b|import (lru_)?cache\b", path.read_text()):
            found.add(name)
    # and the readers of results of one stage, who are given no one else
    assert found - PRIVATE == {"workflow/stages/inputs.py"}


def test_values_are_frozen_throughout():
    pair = namedtuple("Pair", "a b")
    value = {"a": [np.arange(3), {"b": {1, 2}}], "c": pair(np.ma.masked_equal([1, 2], 2), 3 * u.um)}
    made = frozen(value)
    before = snapshot(made)
    try_to_change(made)
    assert snapshot(made) == before
    assert type(made["c"]) is pair
    assert made["a"][1]["b"] == frozenset({1, 2})
    # they are dicts and lists for everybody else
    assert isinstance(made, dict)
    assert isinstance(made["a"], list)
    assert made | {"d": 1} == {**made, "d": 1}
    assert type(made | {}) is dict
    assert json.dumps(FrozenDict(x=FrozenList([1, 2]))) == '{"x": [1, 2]}'
    for kind in (FrozenDict(x=1), FrozenList([1])):
        assert type(pickle.loads(pickle.dumps(kind))) is type(kind)
        assert pickle.loads(pickle.dumps(kind)) == kind
        for plain in (kind.copy(), copy.copy(kind), copy.deepcopy(kind)):
            assert type(plain) in (dict, list)
            assert plain == kind
    mine = copy.deepcopy(made)
    mine["a"].append(1)
    mine["a"][1]["x"] = 2


def test_tables_are_handed_out_as_copies():
    calls = []

    @cached(copies=True)
    def table(n):
        calls.append(n)
        return QTable({"x": np.arange(n), "sky": SkyCoord(np.arange(n), 0, unit="deg")})

    first = table(3)
    first["x"][:] = -1
    first["y"] = 2
    assert table(3).colnames == ["x", "sky"]
    assert table(3)["x"].tolist() == [0, 1, 2]
    assert calls == [3]
    assert table.cache_info().hits == 2


def test_properties_that_are_kept_are_frozen():
    class Shared:
        @cached_property
        def levels(self):
            """Levels."""
            return {"a": np.arange(3.0)}

    shared = Shared()
    assert shared.levels is shared.levels
    try_to_change(shared.levels)
    assert shared.levels["a"].tolist() == [0.0, 1.0, 2.0]
    assert Shared.levels.__doc__ == "Levels."
