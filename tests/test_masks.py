"""
No masked value enters a number, in whatever form the mask comes.

Public functions that take arrays are called with two different numbers behind one mask, and with NaN in its place:
the three answers are the same, or all are refused.
"""

import warnings

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import MaskedColumn, QTable, Table
from astropy.utils.masked import Masked

from miricigale import (
    evaluation,
    filters,
    fitting,
    instrument,
    photometry,
    profiles,
    psf,
    scene,
    sed,
)
from miricigale.fitting import MassFunction, TemplateError
from miricigale.injection import CompletenessCurve
from miricigale.utils.exceptions import MiricigaleWarning
from miricigale.utils.missing_values import floats
from miricigale.utils.positions import as_positions
from miricigale.utils.table_files import read_table
from miricigale.utils.tables import as_table
from miricigale.utils.units import ab_magnitude, to_array

HIDDEN = 1


def _masked(values, mask):
    if isinstance(getattr(values, "unit", None), u.MagUnit):
        return _ma(values, mask)
    return Masked(values, mask=mask)


def _ma(values, mask):
    data = np.ma.MaskedArray(getattr(values, "value", values), mask=mask)
    return data if not hasattr(values, "unit") else MaskedColumn(data, unit=values.unit)


def _column(values, mask):
    if isinstance(getattr(values, "unit", None), u.MagUnit):
        # astropy has no masked magnitudes
        return _ma(values, mask)
    table = Table({"x": MaskedColumn(getattr(values, "value", values), mask=mask)})
    table["x"].unit = getattr(values, "unit", None)
    return QTable(table)["x"]


def _objects(values, mask):
    if hasattr(values, "unit"):
        return _masked(values, mask)
    return [None if hidden else value for value, hidden in zip(values.tolist(), mask, strict=True)]


def _pandas(values, mask):
    pandas = pytest.importorskip("pandas")
    if hasattr(values, "unit"):
        return _ma(values, mask)
    return pandas.array(_objects(values, mask), dtype="Float64")


KINDS = {"Masked": _masked, "np.ma": _ma, "QTable": _column, "None": _objects, "pandas": _pandas}

X = np.array([0.3, 0.5, 0.9, 1.4, 2.2])
Y = np.array([0.35, 0.45, 1.2, 1.5, 2.0])
LUMINOSITY = np.array([1e37, 3e37, 1e38, 2e38, 4e38]) * u.W
MASS = np.array([1e9, 1e10, 2e10, 5e10, 1e11]) * u.Msun
WAVE = np.array([4.0, 6.0, 7.0, 9.0, 12.0]) * u.um
FLUX = np.array([1.0, 2.0, 4.0, 5.0, 7.0]) * u.uJy
FOUND = np.array([0.0, 1.0, 0.0, 1.0, 1.0])
ERRORS = photometry.ErrorModel.from_depths({"miri.f770w": 26.0})
GALAXY = sed.SEDModel.yang2021(agn=False)
LINE = sed.SED([1, 40] * u.um, [1, 2] * u.uJy)
POINT = psf.gaussian_psf(0.3 * u.arcsec, pixel_scale=0.1 * u.arcsec, fov=9 * u.arcsec)


def _image(values):
    """Five rows of the same values, masked as they are."""
    if isinstance(values, Masked):
        return Masked(np.tile(values.unmasked, (5, 1)), mask=np.tile(values.mask, (5, 1)))
    if hasattr(values, "mask"):
        return np.ma.MaskedArray(np.tile(values.data, (5, 1)), mask=np.tile(values.mask, (5, 1)))
    return np.tile(floats(values), (5, 1))


def _band():
    return filters.Filter(WAVE, [0.0, 0.5, 1.0, 0.5, 0.0], name="mine")


#: By name: a function of one array and the array.
FUNCTIONS = {
    "to_array": (lambda x: to_array(x, u.uJy, "x"), FLUX),
    "ab_magnitude": (ab_magnitude, FLUX),
    "Filter wave": (lambda x: filters.Filter(x, [0, 1, 1, 1, 0], name="a").pivot, WAVE),
    "Filter throughput": (lambda x: filters.Filter(WAVE, x, name="a").pivot, X),
    "Filter(wave)": (lambda x: _band()(x), WAVE),
    "synthetic_flux wave": (lambda x: _band().synthetic_flux((x, FLUX)), WAVE),
    "synthetic_flux flux": (lambda x: _band().synthetic_flux((WAVE, x)), FLUX),
    "FilterSet": (lambda x: filters.FilterSet([_band()]).synthetic_fluxes((WAVE, x)), FLUX),
    "SED wave": (lambda x: sed.SED(x, FLUX).fnu, WAVE),
    "SED fnu": (lambda x: sed.SED(WAVE, x).fnu, FLUX),
    "fnu_at": (lambda x: sed.SED([1, 20] * u.um, [1, 2] * u.uJy).fnu_at(x), WAVE),
    "TemplateError wave": (lambda x: TemplateError(x, X).error, WAVE),
    "TemplateError error": (lambda x: TemplateError(WAVE, x).error, X),
    "TemplateError(wave)": (lambda x: TemplateError(WAVE, X)(x), WAVE),
    "magnitude_prior": (lambda x: fitting.magnitude_prior(x)[1], FLUX),
    "magnitude_prior magnitudes": (lambda x: fitting.magnitude_prior(x)[1], X + 24 << u.ABmag),
    "agn_fraction_prior": (fitting.agn_fraction_prior, X / 3),
    "MassFunction": (lambda x: MassFunction()(x, 1.0), MASS),
    "stern2015": (sed.stern2015, LUMINOSITY),
    "stern2015_6um": (sed.stern2015_6um, LUMINOSITY),
    "band_luminosity": (
        lambda x: sed.band_luminosity(x, from_band=[0.5, 7] * u.keV, to_band=[2, 10] * u.keV), LUMINOSITY),
    "xray_flux": (lambda x: sed.xray_flux(x, 1.0), LUMINOSITY),
    "xray_flux redshift": (lambda x: sed.xray_flux(LUMINOSITY, x), X),
    "yang2021_xray_flux": (lambda x: evaluation.yang2021_xray_flux(x, 1.0), LUMINOSITY),
    "xray_luminosity_at": (lambda x: evaluation.xray_luminosity_at(1e-16 * u.erg / u.s / u.cm**2, x), X),
    "classify": (evaluation.classify, X / 3),
    "dust_obscured_fraction": (evaluation.dust_obscured_fraction, MASS),
    "main_sequence_sfr": (lambda x: evaluation.main_sequence_sfr(x, 5 * u.Gyr), MASS),
    "main_sequence_sfr age": (lambda x: evaluation.main_sequence_sfr(1e10 * u.Msun, x), X << u.Gyr),
    "sfr_to_infrared_luminosity": (evaluation.sfr_to_infrared_luminosity, X << u.Msun / u.yr),
    "uvj_quiescent": (lambda x: evaluation.uvj_quiescent(x, Y * u.mag, X), X << u.mag),
    "number_counts": (lambda x: evaluation.number_counts(x, 1 * u.deg**2, [23, 24, 25] * u.ABmag), FLUX),
    "integrated_light": (lambda x: evaluation.integrated_light(x, 1 * u.deg**2, 8 * u.um), FLUX),
    "posterior_ranks": (lambda x: evaluation.posterior_ranks(x, np.tile(X, (5, 1)), [0.1, 0.3, 0.5, 0.7, 0.9]), Y),
    "coverage_table": (lambda x: evaluation.coverage_table({"x": x}), X / 3),
    "bootstrap": (lambda x: evaluation.bootstrap(np.mean, x, seed=1).value, X),
    "feature_magnitude": (lambda x: evaluation.feature_magnitude(0.1 * u.um, x, 2 * u.um), X),
    "photoz_metrics": (lambda x: evaluation.photoz_metrics(Y, x), X),
    "recovery_metrics": (lambda x: evaluation.recovery_metrics(Y, x), X),
    "running_median": (lambda x: evaluation.running_median(x, Y, size=3), X),
    "running_median y": (lambda x: evaluation.running_median(Y, x, size=3), X),
    "sigma_mad": (evaluation.sigma_mad, X),
    "agn_fraction": (lambda x: evaluation.agn_fraction(x, 1e38 * u.W), LUMINOSITY),
    "galaxy_mass_function": (lambda x: evaluation.galaxy_mass_function(x, 1.0), MASS),
    "galaxy_mass_function redshift": (lambda x: evaluation.galaxy_mass_function(1e10 * u.Msun, x), X),
    "xray_luminosity_function": (lambda x: evaluation.xray_luminosity_function(x, 1.0), LUMINOSITY),
    "xray_obscured_fraction": (lambda x: evaluation.xray_obscured_fraction(x, 1.0), LUMINOSITY),
    "completeness": (lambda x: evaluation.completeness(x, np.array([0, 0, 1, 1, 1], bool), [0, 1, 3]), X),
    "half_complete": (lambda x: evaluation.half_complete(x, np.array([0, 0, 1, 1, 1], bool)), X),
    "completeness found": (lambda x: evaluation.completeness(X, x, [0, 1, 3]), FOUND),
    "half_complete found": (lambda x: evaluation.half_complete(X, x), FOUND),
    "selection_quality": (lambda x: evaluation.selection_quality(x, FOUND > 0), FOUND),
    "CompletenessCurve": (lambda x: CompletenessCurve.fit(np.tile(x, 3), np.tile([0, 0, 1, 1, 1], 3)), X + 24),
    "CompletenessCurve recovered": (lambda x: CompletenessCurve.fit(X + 24, x), FOUND),
    "red_dot_prior": (fitting.red_dot_prior, X),
    "AGNPopulation": (lambda x: evaluation.AGNPopulation().probability(x, X), MASS),
    "AGNPopulation redshift": (lambda x: evaluation.AGNPopulation().probability(MASS, x), X),
    "ErrorModel": (lambda x: ERRORS.sigma(x, "miri.f770w"), FLUX),
    "ErrorModel.perturb": (lambda x: ERRORS.perturb(QTable({"id": np.arange(5), "miri.f770w": x}), seed=1), FLUX),
    "fluxes": (lambda x: GALAXY.fluxes(
        {"redshift": np.ones(5), "age": x, "mass": np.full(5, 1e10)}, ["acs.f606w"]), X),
    "grid": (lambda x: GALAXY.grid({"redshift": [1.0], "age": x}, ["acs.f606w"]).galaxy, X),
    "template_grid": (
        lambda x: sed.template_grid({"a": LINE}, ["miri.f770w"], redshift=x).galaxy,
        X),
    "band_extinction": (lambda x: sed.band_extinction(["acs.f606w"], x), X / 10),
    "deredden": (
        lambda x: sed.deredden(QTable({"acs.f606w": FLUX, "acs.f606w_err": FLUX}), x, ["acs.f606w"]),
        X / 10),
    "linearize": (lambda x: instrument.miri_detector().linearize(x), 1e4 * X),
    "delinearize": (lambda x: instrument.miri_detector().delinearize(x), 1e4 * X),
    "pixel_to_v2v3": (lambda x: instrument.pixel_to_v2v3(x, 100 * X), 100 * X),
    "v2v3_to_sky": (lambda x: instrument.v2v3_to_sky(x, X, np.eye(3)), X),
    "background_spectrum": (instrument.background_spectrum, WAVE),
    "ellipse_to_pixels": (
        lambda x: profiles.ellipse_to_pixels(np.eye(2), radius=x, axis_ratio=0.5, position_angle=0.3), X),
    "encircled_energy": (lambda x: psf.encircled_energy(POINT, x), X << u.arcsec),
    "aperture_correction": (lambda x: photometry.aperture_correction(POINT, x), X << u.arcsec),
    "weight_scale": (lambda x: photometry.weight_scale(_image(x), np.ones((5, 5))), X),
    "weight_scale weight": (lambda x: photometry.weight_scale(np.eye(5), _image(x)), X),
    "make_psf": (lambda x: psf.make_psf(_image(x), pixel_scale=0.1 * u.arcsec, enclosed=1.0).data, X),
    "MatchingKernel": (lambda x: psf.MatchingKernel(_image(x), 0.1 * u.arcsec).array, X),
    "Cutout": (lambda x: scene.Cutout(_image(x), pixel_scale=0.1 * u.arcsec).data, X),
    "deconvolve": (lambda x: scene.deconvolve(_image(x), np.eye(3)), X),
    "sersic_bn": (profiles.sersic_bn, X),
    "sersic_enclosed_fraction": (lambda x: profiles.sersic_enclosed_fraction(x, 1.0), X),
    "sersic_radius": (lambda x: profiles.sersic_radius(x, 1.0), X / 3),
    "tangent_offset": (
        lambda x: instrument.tangent_offset(SkyCoord(53.1, -27.8, unit="deg"), x, Y * u.arcsec, 0 * u.deg).ra.deg,
        X << u.arcsec),
    "as_positions": (
        lambda x: as_positions(as_table({"ra": x, "dec": X * u.deg}, "x"), "catalog", missing=True).ra.deg,
        X << u.deg),
    "as_photometry": (
        lambda x: filters.as_photometry({"mag_F770W": x, "e_mag_F770W": X}, ["miri.f770w"])["miri.f770w"].value,
        X + 20),
    "depth_to_rms": (lambda x: scene.depth_to_rms(29.0, pixel_area=x), X),
    "crowded": (
        lambda x: photometry.crowded(SkyCoord(X / 1e3, X / 1e3, unit="deg"), x, radius=9 * u.arcsec), FLUX),
}  # fmt: skip


def _answer(function, values):
    """The numbers that a function gives, or the error that it raises."""
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", MiricigaleWarning)
        warnings.simplefilter("ignore", RuntimeWarning)
        try:
            answer = function(values)
        except (ValueError, u.UnitsError) as err:
            return str(err)
    if hasattr(answer, "__dataclass_fields__"):
        answer = [getattr(answer, name) for name in answer.__dataclass_fields__]
    if isinstance(answer, QTable | Table):
        answer = [answer[name] for name in answer.colnames]
    if isinstance(answer, (tuple, list)):
        return [np.asarray(getattr(one, "value", one)) for one in answer]
    return [np.asarray(getattr(answer, "value", answer))]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", FUNCTIONS)
def test_what_a_mask_hides_is_in_no_number(name, kind):
    function, values = FUNCTIONS[name]
    mask = np.arange(values.size) == HIDDEN
    inputs = []
    for factor in (1.0, 1.1):
        hidden = values.copy()
        hidden.view(np.ndarray)[HIDDEN] *= factor
        inputs.append(KINDS[kind](hidden, mask))
    nothing = values.copy()
    nothing.view(np.ndarray)[HIDDEN] = np.nan
    answers = [_answer(function, one) for one in (*inputs, nothing)]
    refused = [isinstance(answer, str) for answer in answers]
    assert refused in ([True] * 3, [False] * 3), answers
    if refused[0]:
        return
    for first, second, of_nan in zip(*answers, strict=True):
        np.testing.assert_array_equal(first, second)
        np.testing.assert_array_equal(first, of_nan)


class _Spectrum:
    """As `specutils.Spectrum`, with a mask."""

    spectral_axis = WAVE

    def __init__(self, flux, mask):
        self.flux, self.mask = flux, mask


def test_masked_samples_of_a_spectrum_are_bridged_and_warned_of():
    wrong = FLUX.copy()
    wrong[2] = 1e9 * u.uJy
    mask = np.arange(5) == 2
    with pytest.warns(MiricigaleWarning, match="1 of 5 samples .* from 6 to 9 um"):
        flux = _band().synthetic_flux(_Spectrum(wrong, mask))
    good = [0, 1, 3, 4]
    assert flux == _band().synthetic_flux((WAVE[good], FLUX[good]))


@pytest.mark.parametrize("form", ["xml", "ecsv", "csv", "fits", "parquet"])
def test_blanks_of_files_are_missing_fluxes(tmp_path, form):
    if form == "parquet":
        pytest.importorskip("pyarrow")
    table = Table({"id": [1, 2, 3], "flag": MaskedColumn([1, 2, 3], mask=[0, 1, 0])})
    table["miri.f770w"] = MaskedColumn([1.0, 99.0, 3.0], mask=[0, 1, 0], unit="uJy")
    table["miri.f770w_err"] = MaskedColumn([0.1, 0.1, 0.3], mask=[0, 0, 1], unit="uJy")
    path = tmp_path / f"a.{form}"
    formats = {"xml": "votable", "ecsv": "ascii.ecsv", "csv": "ascii.csv"}
    table.write(path, format=formats.get(form, form))
    found = filters.read_catalog_photometry(path, units={"flux": "uJy"})
    np.testing.assert_array_equal(found["miri.f770w"].value, [1.0, np.nan, 3.0])
    assert np.isnan(found["miri.f770w_err"].value[2])
    assert read_table(path, wanted="a table")["flag"].mask.tolist() == [False, True, False]


@pytest.mark.parametrize("kind", KINDS)
def test_positions_and_redshifts_behind_a_mask_are_missing(kind):
    from miricigale.fitting.posterior.priors import known_redshifts

    mask = np.arange(X.size) == HIDDEN
    table = as_table(
        {"z": KINDS[kind](X, mask), "ra": X * u.deg, "dec": KINDS[kind](X * u.deg, mask)}, "x"
    )
    assert np.isnan(known_redshifts(table, "z")).tolist() == mask.tolist()
    sky = as_positions(table, "catalog", missing=True)
    assert np.isnan(sky.dec.deg).tolist() == mask.tolist()
    masked = SkyCoord(X * u.deg, Masked(X * u.deg, mask=mask))
    sky = as_positions(QTable({"sky": masked}), "catalog", missing=True)
    assert np.isnan(sky.dec.deg).tolist() == mask.tolist()


def test_positions_behind_a_mask_have_no_color_excess():
    class Map:
        def query(self, sky):
            return np.full(sky.shape, 0.01)

    mask = np.arange(X.size) == HIDDEN
    sky = SkyCoord(X * u.deg, Masked(X * u.deg, mask=mask))
    with pytest.raises(ValueError, match="'sky' must be positions with a color excess, got 1 of 5"):
        sed.color_excess(sky, Map())
