"""Keywords that are usual elsewhere: each is one of ours, or ends in a sentence with the right call."""

import inspect
import operator
import re

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits

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
    evaluation,
    instrument,
    photometry,
    planning,
    psf,
    reduction,
    workflow,
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
    for module in (psf, depth, photometry, evaluation, reduction, workflow):
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
    parameters = {*inspect.signature(target).parameters, *call.keyword_names}
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


def test_functions_of_psfs_and_images_take_other_keywords(tmp_path):
    model = psf.gaussian_psf(0.3 * u.arcsec, pixel_scale=0.1 * u.arcsec, fov=2 * u.arcsec)
    radius = 0.3 * u.arcsec
    share = psf.encircled_energy(model, radius)
    assert psf.encircled_energy(psf=model, r=radius) == share
    refuses("no argument 'diameter'; circles have radii", psf.encircled_energy, model,
            diameter=radius, error=TypeError)  # fmt: skip
    assert psf.fwhm(band="F1500W") == psf.fwhm("F1500W")
    assert psf.average_psf(psf_list=[model, model]).fwhm == model.fwhm
    places = [(0, 0), (0, 9), (9, 0), (9, 9)]
    assert psf.psf_grid([model] * 4, xypos=places).data.shape == (4, *model.data.shape)
    refuses("weights'; PSFs have the same weight", psf.average_psf, [model], weights=[1],
            error=TypeError)  # fmt: skip
    for single in (model, None, "F770W", model.data):
        refuses("'psfs' must be a list of PSFs, at least one, got", psf.average_psf, single)
        refuses("'psfs' must be a list of PSFs, at least one, got", psf.psf_grid, single, places)
    refuses("'psfs' must be a list of PSFs, at least one, got none", psf.average_psf, [])
    refuses("'positions' must be pairs of numbers", psf.psf_grid, [model] * 4, "corner")
    refuses("positions are pairs: psf_grid.psfs, list.zip.x, y", psf.psf_grid, [model] * 4, [0],
            [0], error=TypeError)  # fmt: skip
    exposure = Exposure("F770W", n_groups=5)
    assert depth.saturation_time(exposure) == depth.saturation_time(band="F770W", sky="low")
    dark = depth.saturation_time("F770W", background="none")
    assert dark > depth.saturation_time("F770W", background=None)
    data = fits.PrimaryHDU(np.ones((4, 4), np.float32), wcs_header())
    data.writeto(tmp_path / "sci.fits")
    path = tmp_path / "sci.fits"
    image = warned("no map of the noise", photometry.read_mosaic, path, zp=23.9, band="F770W")
    assert image.meta["filter"] == "miri.f770w"
    refuses("'path' must be the path of a file", photometry.read_mosaic, ["sci.fits"])


def wcs_header():
    """Return the WCS of a small image as cards."""
    place = SkyCoord(53, -27, unit="deg")
    return instrument.north_up_wcs(place, 0.1 * u.arcsec, (4, 4)).to_header()


def test_studies_say_what_a_configuration_is():
    for call in (workflow.check_study, workflow.study_cost, workflow.disk_use):
        refuses("'config' must be a StudyConfig .load_config.'goodss'", call, "goodss")
    refuses("'config' must be a StudyConfig", workflow.StudyRunner, {}, "folder", ())
    refuses("needs 'stages'; run_study.load_config", workflow.StudyRunner, {}, "folder",
            error=TypeError)  # fmt: skip
    refuses("needs 'folder'; run_study.load_config", workflow.run_study, {}, error=TypeError)
    refuses("'config' must be a PlanConfig", planning.make_sample, "goodss", ["F770W"])
    refuses("overrides=.... takes a dict", planning.load_plan, {"exposures": {}})


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
