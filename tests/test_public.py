"""What `miricigale` offers: names that import, objects that pickle and copy."""

import copy
import importlib
import pickle
import pkgutil
import re

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData
from astropy.table import QTable

import miricigale
from miricigale.detector import Dark
from miricigale.utils.package_tables import declared, hint_sentences

SUBPACKAGES = [
    item.name
    for item in pkgutil.iter_modules(miricigale.__path__)
    if item.ispkg and item.name not in ("plotting", "utils")
]
BANDS = ["wfc3.f160w", "irac.ch1", "miri.f770w"]


@pytest.mark.parametrize("subpackage", SUBPACKAGES)
def test_a_subpackage_has_the_names_that_it_lists_and_no_others(subpackage):
    module = importlib.import_module(f"miricigale.{subpackage}")
    for name in module.__all__:
        assert getattr(module, name) is not None
    names = [name for name in dir(module) if not name.startswith("__")]
    assert sorted(names) == sorted(module.__all__)


def test_the_classes_of_the_package_import_from_it():
    from miricigale import ErrorModel, FitResults, MatchingKernel, ModelGrid, Ramp

    for cls in (ErrorModel, FitResults, MatchingKernel, ModelGrid, Ramp):
        assert cls.__name__ in dir(miricigale)
    message = "module 'miricigale' has no attribute 'FitResult'; did you mean 'FitResults'"
    with pytest.raises(AttributeError, match=message) as caught:
        miricigale.FitResult  # noqa: B018
    assert caught.value.name == "FitResult"


@pytest.mark.parametrize("subpackage", SUBPACKAGES)
def test_public_classes_say_what_an_object_is(subpackage):
    module = importlib.import_module(f"miricigale.{subpackage}")
    for name in module.__all__:
        cls = getattr(module, name)
        if isinstance(cls, type):
            assert cls.__repr__ is not object.__repr__, f"{subpackage}.{name}"


def test_objects_say_what_they_are(objects, tmp_path):
    results = objects["results"][0]
    assert "results.loc[id] of <FitResults of 3 objects" in repr(results.loc)
    assert repr(results.write) == "<method FitResults.write>"
    assert repr(objects["model"][0].chain).startswith("<Chain of ")
    assert repr(miricigale.workflow.ProductStore(tmp_path)) == f"<ProductStore {tmp_path}>"
    page = miricigale.pages.Page("Depths")
    assert repr(page) == "<Page 'Depths', 0 sections>"
    assert repr(miricigale.pages.SectionWriter(page, {})) == f"<SectionWriter of {page!r}>"
    config = miricigale.workflow.load_config("goodss", quick=True)
    assert repr(miricigale.workflow.Context(config, tmp_path)) == f"<Context in {tmp_path}>"
    exposure = objects["exposure"][0]
    block = miricigale.detector.Block(exposure, None, slice(0, 64), None, None, None)
    assert repr(block) == f"<Block of rows 0 to 64, {exposure!r}>"
    study = miricigale.evaluation.StudyResults((), ("miri.f770w",))
    assert repr(study) == "<StudyResults of no truth: miri.f770w>"


def test_names_that_a_subpackage_lacks_end_in_what_to_write():
    from miricigale import depth, psf

    for module, name, hint in (
        (depth, "sensitivty", r"did you mean 'sensitivity'\?"),
        (depth, "limiting_magnitude", r"miricigale.depth.sensitivity\('F770W', 1 \* u.hour\) is"),
        (depth, "detect_sources", r"did you mean 'miricigale.photometry.detect_sources'\?"),
        (psf, "PSF", r"miricigale.psf.miri_psf\('F770W'\)"),
        (miricigale, "aperture_photometry", "did you mean 'miricigale.photometry.aperture_photom"),
        (miricigale.cigale, "xyzzy", r"miricigale.cigale.fit_cigale\('pcigale.ini'\) fits"),
    ):
        with pytest.raises(AttributeError, match=f"no attribute '{name}'; {hint}") as caught:
            getattr(module, name)
        assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)
    with pytest.raises(ImportError):
        from miricigale import Filtr  # noqa: F401
    assert not hasattr(miricigale, "__wrapped__")


def test_hints_of_subpackages_name_what_there_is():
    hints = declared("miricigale.utils", "module_hints.toml")
    assert set(SUBPACKAGES) - {"cli", "pages", "workflow"} <= set(hints["subpackages"])
    for sentence in [*hint_sentences(hints["sentences"]).values(), *hints["subpackages"].values()]:
        for path in re.findall(r"miricigale((?:\.\w+)+)", sentence):
            value = miricigale
            for part in path[1:].split("."):
                value = getattr(value, part)
        for name in re.findall(r"\b(?:[A-Z][a-z]+[A-Z]\w+|Exposure|Reducer)\b", sentence):
            assert name in miricigale.__all__ or f".{name}" in sentence, name


@pytest.fixture(scope="module")
def objects():
    """Public objects that other tests do not pickle, by name, and what shows that they are whole."""
    from miricigale import BayesFitter, Detector, Exposure, Filter, FilterSet, Reducer, SEDModel

    model = SEDModel.yang2021(libraries="bundled")
    axes = SEDModel.yang2021_axes("quick") | {"redshift": [0.5, 1.0, 1.5]}
    fitter = BayesFitter(model, BANDS, axes=axes)
    table = QTable({"id": ["a", "b", "c"]})
    for name in BANDS:
        table[name] = [1.0, 2.0, np.nan] * u.uJy
        table[f"{name}_err"] = [0.1, 0.1, np.nan] * u.uJy
    results = fitter.fit(table)
    pointing = SkyCoord(53.1, -27.8, unit="deg")
    exposure = Exposure(
        "miri.f770w", n_groups=4, subarray="SUB64", pointing=pointing, roll=0 * u.deg
    )
    detector = Detector.miri_imager().without(Dark)
    image = CCDData(np.full(exposure.shape, 5.0), unit="MJy/sr", meta={})
    ramp = detector.expose(image, exposure, seed=1)
    reducer = Reducer()

    def fit(fitter):
        return fitter.fit(table).pdf["redshift"]

    def table_of(results):
        return [np.asarray(column) for column in results.to_table().itercols()]

    return {
        "filter": (Filter.from_name("F770W"), lambda x: x.throughput),
        "filters": (FilterSet(BANDS), lambda x: x.weights(np.geomspace(0.5, 20, 99))),
        "SED": (model.evaluate(redshift=1.0), lambda x: x.fnu.value),
        "model": (model, lambda x: x.evaluate(redshift=1.0).fnu.value),
        "grid": (fitter.grid, lambda x: x.galaxy),
        "fitter": (fitter, fit),
        "results": (results, table_of),
        "rows": (results[[2, 0]], table_of),
        "object": (results["b"], table_of),
        "samples": (fitter.sample(table, 3, seed=1), table_of),
        "drawn object": (fitter.sample(table, 3, seed=1)["a"], table_of),
        "exposure": (exposure, lambda x: x.exposure_time.value),
        "detector": (detector, lambda x: x.expose(image, exposure, seed=1).data),
        "ramp": (ramp, lambda x: x.data),
        "reducer": (reducer, lambda x: x.fit_ramp(ramp).data),
    }


NAMES = [
    "filter",
    "filters",
    "SED",
    "model",
    "grid",
    "fitter",
    "results",
    "rows",
    "object",
    "samples",
]
NAMES += ["drawn object", "exposure", "detector", "ramp", "reducer"]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    "again", [lambda x: pickle.loads(pickle.dumps(x)), copy.copy, copy.deepcopy],
    ids=["pickle", "copy", "deepcopy"],
)  # fmt: skip
def test_public_objects_pickle_and_copy(objects, name, again):
    obj, content = objects[name]
    other = again(obj)
    assert type(other) is type(obj)
    assert repr(other) == repr(obj)
    np.testing.assert_equal(content(other), content(obj))


def test_copies_of_results_are_read_only(objects):
    results = objects["results"][0]
    for other in (pickle.loads(pickle.dumps(results)), copy.deepcopy(results), results[:2]):
        with pytest.raises(ValueError, match="read-only"):
            other.chi2[0] = 0.0
        with pytest.raises(ValueError, match="read-only"):
            other.pdf["redshift"][0] = 0.0


def test_results_show_themselves_in_notebooks(objects):
    html = objects["results"][0]._repr_html_()
    assert "redshift_mean" in html
    assert "&lt;FitResults of 3 objects, 2 fitted, 3 bands&gt;" in html
