"""Keywords that are usual elsewhere: each is one of ours, or ends in a sentence with the right call."""

import inspect
import operator
import re

import astropy.units as u
import numpy as np
import pytest

import miricigale
from helpers.errors import refuses, warned
from miricigale import (
    BayesFitter,
    Detector,
    Exposure,
    Filter,
    ForcedPhotometer,
    Reducer,
    Scene,
    depth,
    photometry,
    psf,
)
from miricigale.reduction import MosaicSettings
from miricigale.utils.exceptions import MiricigaleWarning, argument_error, warn
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.package_tables import declared, hint_sentences

DECLARED = declared("miricigale.utils", "other_keywords.toml")
OTHER_KEYWORDS = {
    label: names for label, names in DECLARED.items() if label not in ("hints", "values", "common")
}


def called(label):
    """Return what a label of the table stands for: a class or one of its methods."""
    owner = miricigale
    for module in (psf, depth, photometry):
        if label in module.__all__:
            owner = module
    return operator.attrgetter(label)(owner)


@pytest.mark.parametrize("label", OTHER_KEYWORDS)
def test_other_keywords_are_of_arguments(label):
    target = called(label)
    call = target
    if inspect.isclass(target):
        call = target.__init__
    # what is declared is taken
    assert hasattr(call, "__wrapped__"), label
    parameters = inspect.signature(target).parameters
    for other, ours in OTHER_KEYWORDS[label].items():
        assert other not in parameters, other
        is_setting = label == "Reducer" and ours in MosaicSettings.__dataclass_fields__
        assert ours in parameters or is_setting, (other, ours)


@pytest.mark.parametrize("label", DECLARED["values"])
def test_keywords_of_dicts_are_of_arguments_too(label):
    parameters = inspect.signature(called(label)).parameters
    for other, ours in DECLARED["values"][label].items():
        assert other in OTHER_KEYWORDS[label]
        assert ours in parameters


@pytest.mark.parametrize("label", DECLARED["hints"])
def test_sentences_are_of_keywords_that_there_are_not(label):
    parameters = inspect.signature(called(label)).parameters
    for wrong, sentence in hint_sentences(DECLARED["hints"][label]).items():
        assert wrong not in parameters, wrong
        assert wrong not in OTHER_KEYWORDS.get(label, {}), wrong
        for path in re.findall(r"miricigale((?:\.\w+)+)", sentence):
            operator.attrgetter(path[1:])(miricigale)


def test_calls_with_other_keywords_are_those_with_ours():
    ours = Exposure("F770W", readout="SLOWR1", n_groups=10, n_integrations=2, roll=3 * u.deg,
                    pointing="53 -27")  # fmt: skip
    theirs = Exposure("F770W", readpatt="SLOWR1", ngroups=10, nints=2, pa=3 * u.deg, coord="53 -27")
    assert repr(theirs) == repr(ours)
    curve = np.array([0.0, 1.0, 0.0])
    wave = np.array([9.0, 10.0, 11.0]) * u.um
    band = Filter(wavelength=wave, transmission=curve, name="box")
    assert band.pivot == Filter(wave, curve, "box").pivot
    flat = {"frac_agn": np.ones_like}
    fitter = BayesFitter(bands=["F770W", "F1500W"], prior=flat)
    assert repr(fitter.priors) == repr(BayesFitter(["F770W"], priors=flat).priors)


def test_functions_take_other_keywords_too():
    model = psf.miri_psf("F1500W", oversampling=2, fov=2 * u.arcsec)
    same = psf.miri_psf(band="F1500W", oversample=2, field_of_view=2 * u.arcsec)
    np.testing.assert_array_equal(same.data, model.data)
    hour = 1 * u.hour
    limit = depth.sensitivity("F770W", hour, n_sigma=10)
    assert depth.sensitivity("F770W", exptime=hour, snr=10) == limit
    # options go through several functions
    assert (
        psf.miri_psf_grid("F1500W", n_psfs=4, oversample=2, fov=2 * u.arcsec).oversampling[0] == 2
    )
    stamp = np.outer(*[np.exp(-0.5 * np.linspace(-3, 3, 9) ** 2)] * 2)
    refuses(r"make_psf\(\) has no argument 'normalize'; enclosed=0.95 says", psf.make_psf, stamp,
            0.1 * u.arcsec, normalize=True, error=TypeError)  # fmt: skip
    refuses(r"miri_psf\(\) has no argument 'fov_arcsec'; did you mean 'fov'", psf.miri_psf, "F770W",
            fov_arcsec=3, error=TypeError)  # fmt: skip


@takes_other_keywords
def draw(filter, *, seed=0, **options):
    """Return what a function with options of any name gets."""
    return filter, seed, options


def test_open_options_are_handed_on():
    assert draw(band="F770W", rng=2, alpha=0.5) == ("F770W", 2, {"alpha": 0.5})


@pytest.mark.parametrize("ours", sorted(set(DECLARED["common"].values())))
def test_common_keywords_are_of_some_call(ours):
    functions = [getattr(module, n) for module in (psf, depth, photometry) for n in module.__all__]
    classes = [getattr(miricigale, name) for name in miricigale.__all__]
    names = set()
    for target in functions + classes:
        if callable(target):
            names |= set(inspect.signature(target).parameters)
    names |= set(inspect.signature(BayesFitter.fit).parameters)
    assert ours in names


def test_settings_of_parts_are_keywords_of_the_whole():
    assert Reducer(pixfrac=0.8).mosaics == MosaicSettings(pixfrac=0.8)
    assert Reducer(outlier_snr=4.0).mosaics.outlier_threshold == 4.0
    refuses("got 'pixfrac' besides 'mosaics': give mosaics=MosaicSettings", Reducer, pixfrac=0.8,
            mosaics=MosaicSettings(), error=TypeError)  # fmt: skip
    refuses("'pixfrac' must be", Reducer, pixfrac=-1)


def test_other_calls_say_what_is_meant():
    refuses(r"no argument 'ndither'; Exposure\(.*\).dithered\(4\)", Exposure, "F770W", n_groups=9,
            ndither=4, error=TypeError)  # fmt: skip
    refuses("got 'n_groups' twice, once as 'ngroups'", Exposure, "F770W", n_groups=9, ngroups=9,
            error=TypeError)  # fmt: skip
    refuses("no argument 'jump_thresold'; did you mean 'jump_threshold'", Reducer, jump_thresold=4,
            error=TypeError)  # fmt: skip
    refuses(r"got 3 without; .*measure\(image, positions\)", ForcedPhotometer, 1, 2, 3,
            error=TypeError)  # fmt: skip
    refuses("expose.scene, seed=1. takes the seed", Detector, seed=1, error=TypeError)

    @takes_other_keywords
    def width(wave, *, power=1):
        return wave * power

    assert width(2, power=3) == 6
    refuses("has no argument 'n'; it has wave, power", width, 2, n=3, error=TypeError)
    refuses("takes wave without a keyword, got 2 without$", width, 2, 3, error=TypeError)


def test_errors_and_warnings_name_arguments_as_they_were_written():
    @takes_other_keywords
    def draw(n_dithers, *, seed=0):
        if seed < 0:
            raise argument_error("seed", "positive", seed)
        warn("'n_dithers' is large", MiricigaleWarning)

    refuses("^'rng' must be positive", draw, 3, rng=-1)
    refuses("^'seed' must be positive", draw, 3, seed=-1)
    warned("^'ndither' is large", draw, ndither=3)
    warned("^'n_dithers' is large", draw, 3, rng=1)


def test_classes_say_what_is_meant_too():
    assert Scene.from_catalog is Scene
    with pytest.raises(AttributeError, match=r"class 'Reducer' has no .*; run takes files: Red"):
        operator.attrgetter("from_files")(Reducer)
    assert not hasattr(Reducer, "_any")
    assert set(declared("miricigale.utils", "other_names.toml")["constructors"]) <= set(
        miricigale.__all__
    )
