"""
No masked value enters a number, in whatever form the mask comes.

Public functions that take arrays are called with two different numbers behind one mask, and with NaN in its place:
the three answers are the same, or all are refused.
"""

import functools
import importlib
import inspect
import re
import tempfile
import warnings
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, StdDevUncertainty
from astropy.table import MaskedColumn, QTable, Table
from astropy.utils.masked import Masked
from matplotlib import pyplot

from helpers.arguments import documented_arguments
from helpers.errors import refuses
from miricigale import (
    agn,
    cigale,
    depth,
    detector,
    evaluation,
    filters,
    fitting,
    instrument,
    photometry,
    profiles,
    psf,
    reduction,
    scene,
    sed,
)
from miricigale.fitting import MassFunction, TemplateError
from miricigale.injection import CompletenessCurve
from miricigale.instrument import Exposure, north_up_wcs
from miricigale.utils.exceptions import MiricigaleWarning
from miricigale.utils.missing_values import floats, mask_of, without_mask
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


PIXEL = 0.1 * u.arcsec
CENTER = SkyCoord(0.0, 0.0, unit="deg")
EXPOSURE = Exposure("F770W", n_groups=5, subarray="SUB64")
LEVELS = np.array([0.1, 0.3, 0.5, 0.7, 0.9])
CURVES = {"a": agn.NoiseCurve(np.array([1.0, 9.0]), np.array([0.1, 0.9]))}
CURVE = CompletenessCurve.fit(np.tile(X + 24, 3), np.tile([1, 1, 1, 0, 0], 3))
BINS = fitting.AGNBins(redshift=(0, 1, 3), log_luminosity=(36, 37, 38))
KERNEL = psf.MatchingKernel(np.eye(3), 0.1 * u.arcsec, source=np.eye(3), target=np.eye(3))
SKY = SkyCoord(X / 1e4, Y / 1e4, unit="deg")
FIELD = psf.KernelField((KERNEL,) * 5, SKY)
GRID = psf.psf_grid([POINT] * 4, [(0, 0), (0, 3), (3, 0), (3, 3)])
MAPS = reduction.DetectorMaps(gain=5.0, read_noise=3.0)
IMAGE = CCDData(
    np.random.default_rng(1).normal(1, 0.1, (61, 61)),
    unit="uJy",
    wcs=north_up_wcs(CENTER, 0.1 * u.arcsec, (61, 61)),
)
TABLE = QTable({"id": np.arange(5)})
for _band_name in ("acs.f606w", "wfc3.f160w"):
    TABLE[_band_name] = FLUX
    TABLE[f"{_band_name}_err"] = FLUX / 9
NUCLEI = sed.SEDModel.yang2021(libraries="bundled")


# fits are made by the tests that need them, not where all tests are collected
@functools.cache
def _fitter():
    axes = {"redshift": [0.3, 0.6, 1.0, 1.5, 2.2], "age": [1.0, 2.0]}
    return fitting.BayesFitter(GALAXY, ["acs.f606w", "wfc3.f160w"], axes=axes)


@functools.cache
def _results():
    return _fitter().fit(TABLE)


@functools.cache
def _draws():
    return _fitter().sample(TABLE, 3, seed=1)


@functools.cache
def _hosts():
    axes = {"redshift": [0.5, 1.0], "age": [1.0, 2.0], "frac_agn": [0.0, 0.5]}
    return fitting.BayesFitter(NUCLEI, ["acs.f606w", "wfc3.f160w"], axes=axes).fit(TABLE)


@functools.cache
def _fixed():
    """Fits at given redshifts of what are no fluxes of galaxies."""
    many = TABLE[np.arange(40) % 5]
    many["id"] = np.arange(40)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MiricigaleWarning)
        return _fitter().fit(many, redshift=np.tile(X, 8))


BLANK = CCDData(IMAGE.data - 1, unit="uJy", wcs=IMAGE.wcs)
EVEN = CCDData(
    np.ones((61, 61)),
    unit="MJy/sr",
    wcs=IMAGE.wcs,
    uncertainty=StdDevUncertainty(np.ones((61, 61))),
)

GROUPS = np.tile(1e3 * X[:, None, None], (1, 5, 5))[None]


def _groups(values):
    return _image(values)[None, :, None].repeat(5, axis=2)


def _slopes(maps):
    return reduction.fit_groups(GROUPS, maps, group_time=3.0).rate


SHARP = psf.gaussian_psf(
    0.3 * u.arcsec, pixel_scale=0.1 * u.arcsec, fov=2.1 * u.arcsec
).data.ravel()
WIDE = psf.gaussian_psf(0.5 * u.arcsec, pixel_scale=0.1 * u.arcsec, fov=2.1 * u.arcsec).data.ravel()


def _square(values):
    return _image(values)[0].reshape(85, 85)


def _matching(sharp, wide):
    return psf.MatchingKernel.from_psfs(sharp, wide, pixel_scale=0.1 * u.arcsec).array


def _curve(flux, error):
    curve = agn.NoiseCurve.of_band(flux, error)
    return [curve.flux, curve.error]


def _feature(residual, redshift):
    band = {"feature": 6.2 * u.um, "pivot": 15 * u.um, "filter_width": 3 * u.um}
    return [part.value for part in evaluation.feature_residuals(residual, redshift, seed=1, **band)]


def _plane(values):
    return _image(values)[0, np.arange(61 * 61) % 5].reshape(61, 61)


def _with_xrays(bands, slopes):
    grid = GALAXY.grid({"redshift": [1.0], "age": X}, ["acs.f606w"])
    return sed.with_xray_bands(grid, GALAXY, bands, alpha_ox=slopes).galaxy


def _template(array):
    catalog = QTable({"id": [1], "sky": CENTER.reshape(1)})
    return photometry.SourceTemplates.from_arrays([array], [(3, 3)], catalog, wcs=IMAGE.wcs)


def _sky(values):
    numbers, mask = without_mask(values)
    mask = False if mask is None else mask
    return SkyCoord(Masked(np.asarray(numbers), mask=mask) * u.deg, Y / 1e4 * u.deg)


SETUP = cigale.CigaleSetup(
    path=Path("pcigale.ini"),
    data_file=None,
    components=GALAXY.components,
    parameters={"age": np.array([1.0, 2.0])},
    redshift=None,
    modules={},
    frac_agn_definition=GALAXY.frac_agn_definition,
    bands={"acs.f606w": "acs.f606w"},
    predicted={},
    columns=("acs.f606w",),
    variables=("stellar_mass",),
)


def _saved_models(redshifts):
    with tempfile.TemporaryDirectory() as folder:
        SETUP.save_models(Path(folder) / "models.fits", redshifts)
        return Table.read(Path(folder) / "models.fits")["universe.redshift"]


def _plotted_redshifts(redshifts):
    figure, axes = pyplot.subplots()
    _results().plot_redshift(redshifts, ax=axes)
    offsets = [points.get_offsets() for points in axes.collections if len(points.get_offsets())]
    pyplot.close(figure)
    return [*offsets, np.array([len(axes.get_title())])]


def _measured_errors(noise):
    tables = [QTable({"id": np.arange(5), "miri.f770w": factor * FLUX}) for factor in (1.0, 1.1)]
    model = photometry.ErrorModel.from_tables(*tables, noise={"miri.f770w": noise}, bin_size=3)
    return model.sigma(FLUX, "miri.f770w")


DELTA = psf.MatchingKernel(np.pad([[1.0]], 1), PIXEL, target=POINT.data)
POINTS = photometry.SourceTemplates.from_catalog(QTable({"sky": SKY}))
STARS = QTable({"sky": SKY, "wfc3.f160w": FLUX})


def _looked_at(values):
    segments = np.zeros((61, 61), int)
    segments[20:41, 20:41] = 1
    catalog = QTable({"sky": CENTER.reshape(1)})
    templates = photometry.SourceTemplates.from_images(
        EVEN, segments, catalog, psf=_square(values), template="cutout", n_threads=1
    )
    return templates.light[0].data


def _powers(values):
    return np.ones((2, 5, 5)) * _image(values)


#: By the name of the argument, and after a blank what is special: a function of one array and the array.
FUNCTIONS = {
    "utils.units.to_array.value": (lambda x: to_array(x, u.uJy, "x"), FLUX),
    "utils.units.ab_magnitude.flux": (ab_magnitude, FLUX),
    "filters.Filter.wave": (lambda x: filters.Filter(x, [0, 1, 1, 1, 0], name="a").pivot, WAVE),
    "filters.Filter.throughput": (lambda x: filters.Filter(WAVE, x, name="a").pivot, X),
    "filters.Filter.__call__.wave": (lambda x: _band()(x), WAVE),
    "filters.Filter.synthetic_flux.sed wave": (lambda x: _band().synthetic_flux((x, FLUX)), WAVE),
    "filters.Filter.synthetic_flux.sed flux": (lambda x: _band().synthetic_flux((WAVE, x)), FLUX),
    "filters.FilterSet.synthetic_fluxes.sed": (
        lambda x: filters.FilterSet([_band()]).synthetic_fluxes((WAVE, x)), FLUX),
    "sed.SED.wave": (lambda x: sed.SED(x, FLUX).fnu, WAVE),
    "sed.SED.fnu": (lambda x: sed.SED(WAVE, x).fnu, FLUX),
    "sed.SED.fnu_at.wave": (lambda x: sed.SED([1, 20] * u.um, [1, 2] * u.uJy).fnu_at(x), WAVE),
    "fitting.TemplateError.wave": (lambda x: TemplateError(x, X).error, WAVE),
    "fitting.TemplateError.error": (lambda x: TemplateError(WAVE, x).error, X),
    "fitting.TemplateError.__call__.wave": (lambda x: TemplateError(WAVE, X)(x), WAVE),
    "fitting.magnitude_prior.magnitude flux": (lambda x: fitting.magnitude_prior(x)[1], FLUX),
    "fitting.magnitude_prior.magnitude": (lambda x: fitting.magnitude_prior(x)[1], X + 24 << u.ABmag),
    "fitting.agn_fraction_prior.frac_agn": (fitting.agn_fraction_prior, X / 3),
    "fitting.MassFunction.__call__.mass": (lambda x: MassFunction()(x, 1.0), MASS),
    "sed.stern2015.l_6um": (sed.stern2015, LUMINOSITY),
    "sed.stern2015_6um.l_x": (sed.stern2015_6um, LUMINOSITY),
    "sed.band_luminosity.l_x": (
        lambda x: sed.band_luminosity(x, from_band=[0.5, 7] * u.keV, to_band=[2, 10] * u.keV), LUMINOSITY),
    "sed.xray_flux.l_x_2_10": (lambda x: sed.xray_flux(x, 1.0), LUMINOSITY),
    "sed.xray_flux.redshift": (lambda x: sed.xray_flux(LUMINOSITY, x), X),
    "evaluation.yang2021_xray_flux.l_6um": (lambda x: evaluation.yang2021_xray_flux(x, 1.0), LUMINOSITY),
    "evaluation.xray_luminosity_at.redshift": (
        lambda x: evaluation.xray_luminosity_at(1e-16 * u.erg / u.s / u.cm**2, x), X),
    "evaluation.classify.frac_agn": (evaluation.classify, X / 3),
    "evaluation.dust_obscured_fraction.stellar_mass": (evaluation.dust_obscured_fraction, MASS),
    "evaluation.main_sequence_sfr.stellar_mass": (lambda x: evaluation.main_sequence_sfr(x, 5 * u.Gyr), MASS),
    "evaluation.main_sequence_sfr.age_of_universe": (
        lambda x: evaluation.main_sequence_sfr(1e10 * u.Msun, x), X << u.Gyr),
    "evaluation.sfr_to_infrared_luminosity.sfr": (evaluation.sfr_to_infrared_luminosity, X << u.Msun / u.yr),
    "evaluation.uvj_quiescent.u_v": (lambda x: evaluation.uvj_quiescent(x, Y * u.mag, X), X << u.mag),
    "evaluation.number_counts.flux": (
        lambda x: evaluation.number_counts(x, 1 * u.deg**2, [23, 24, 25] * u.ABmag), FLUX),
    "evaluation.integrated_light.flux": (lambda x: evaluation.integrated_light(x, 1 * u.deg**2, 8 * u.um), FLUX),
    "evaluation.posterior_ranks.true": (
        lambda x: evaluation.posterior_ranks(x, np.tile(X, (5, 1)), [0.1, 0.3, 0.5, 0.7, 0.9]), Y),
    "evaluation.coverage_table.ranks": (lambda x: evaluation.coverage_table({"x": x}), X / 3),
    "evaluation.bootstrap.columns": (lambda x: evaluation.bootstrap(np.mean, x, seed=1).value, X),
    "evaluation.feature_magnitude.redshift": (lambda x: evaluation.feature_magnitude(0.1 * u.um, x, 2 * u.um), X),
    "evaluation.photoz_metrics.z_fit": (lambda x: evaluation.photoz_metrics(Y, x), X),
    "evaluation.recovery_metrics.measured": (lambda x: evaluation.recovery_metrics(Y, x), X),
    "evaluation.running_median.x": (lambda x: evaluation.running_median(x, Y, size=3), X),
    "evaluation.running_median.y": (lambda x: evaluation.running_median(Y, x, size=3), X),
    "evaluation.sigma_mad.values": (evaluation.sigma_mad, X),
    "evaluation.agn_fraction.l_6um": (lambda x: evaluation.agn_fraction(x, 1e38 * u.W), LUMINOSITY),
    "evaluation.galaxy_mass_function.stellar_mass": (lambda x: evaluation.galaxy_mass_function(x, 1.0), MASS),
    "evaluation.galaxy_mass_function.redshift": (lambda x: evaluation.galaxy_mass_function(1e10 * u.Msun, x), X),
    "evaluation.xray_luminosity_function.l_x": (lambda x: evaluation.xray_luminosity_function(x, 1.0), LUMINOSITY),
    "evaluation.xray_obscured_fraction.l_x": (lambda x: evaluation.xray_obscured_fraction(x, 1.0), LUMINOSITY),
    "evaluation.completeness.values": (
        lambda x: evaluation.completeness(x, np.array([0, 0, 1, 1, 1], bool), [0, 1, 3]), X),
    "evaluation.half_complete.values": (lambda x: evaluation.half_complete(x, np.array([0, 0, 1, 1, 1], bool)), X),
    "evaluation.completeness.found": (lambda x: evaluation.completeness(X, x, [0, 1, 3]), FOUND),
    "evaluation.half_complete.found": (lambda x: evaluation.half_complete(X, x), FOUND),
    "evaluation.selection_quality.wanted": (lambda x: evaluation.selection_quality(x, FOUND > 0), FOUND),
    "injection.CompletenessCurve.fit.magnitude": (
        lambda x: CompletenessCurve.fit(np.tile(x, 3), np.tile([0, 0, 1, 1, 1], 3)), X + 24),
    "injection.CompletenessCurve.fit.recovered": (lambda x: CompletenessCurve.fit(X + 24, x), FOUND),
    "fitting.red_dot_prior.redshift": (fitting.red_dot_prior, X),
    "evaluation.AGNPopulation.probability.stellar_mass": (
        lambda x: evaluation.AGNPopulation().probability(x, X), MASS),
    "evaluation.AGNPopulation.probability.redshift": (
        lambda x: evaluation.AGNPopulation().probability(MASS, x), X),
    "photometry.ErrorModel.sigma.flux": (lambda x: ERRORS.sigma(x, "miri.f770w"), FLUX),
    "photometry.ErrorModel.perturb.photometry": (
        lambda x: ERRORS.perturb(QTable({"id": np.arange(5), "miri.f770w": x}), seed=1), FLUX),
    "sed.SEDModel.fluxes.table": (lambda x: GALAXY.fluxes(
        {"redshift": np.ones(5), "age": x, "mass": np.full(5, 1e10)}, ["acs.f606w"]), X),
    "sed.SEDModel.grid.axes": (lambda x: GALAXY.grid({"redshift": [1.0], "age": x}, ["acs.f606w"]).galaxy, X),
    "sed.template_grid.redshift": (
        lambda x: sed.template_grid({"a": LINE}, ["miri.f770w"], redshift=x).galaxy,
        X),
    "sed.band_extinction.ebv": (lambda x: sed.band_extinction(["acs.f606w"], x), X / 10),
    "sed.deredden.ebv": (
        lambda x: sed.deredden(QTable({"acs.f606w": FLUX, "acs.f606w_err": FLUX}), x, ["acs.f606w"]),
        X / 10),
    "instrument.DetectorProperties.linearize.dn": (lambda x: instrument.miri_detector().linearize(x), 1e4 * X),
    "instrument.DetectorProperties.delinearize.dn": (lambda x: instrument.miri_detector().delinearize(x), 1e4 * X),
    "instrument.pixel_to_v2v3.x": (lambda x: instrument.pixel_to_v2v3(x, 100 * X), 100 * X),
    "instrument.v2v3_to_sky.v2": (lambda x: instrument.v2v3_to_sky(x, X, np.eye(3)), X),
    "instrument.background_spectrum.wave": (instrument.background_spectrum, WAVE),
    "profiles.ellipse_to_pixels.radius": (
        lambda x: profiles.ellipse_to_pixels(np.eye(2), radius=x, axis_ratio=0.5, position_angle=0.3), X),
    "psf.encircled_energy.radius": (lambda x: psf.encircled_energy(POINT, x), X << u.arcsec),
    "photometry.aperture_correction.radius": (lambda x: photometry.aperture_correction(POINT, x), X << u.arcsec),
    "photometry.weight_scale.data": (lambda x: photometry.weight_scale(_image(x), np.ones((5, 5))), X),
    "photometry.weight_scale.weight": (lambda x: photometry.weight_scale(np.eye(5), _image(x)), X),
    "psf.make_psf.data": (lambda x: psf.make_psf(_image(x), pixel_scale=0.1 * u.arcsec, enclosed=1.0).data, X),
    "psf.MatchingKernel.array": (lambda x: psf.MatchingKernel(_image(x), 0.1 * u.arcsec).array, X),
    "scene.Cutout.data": (lambda x: scene.Cutout(_image(x), pixel_scale=0.1 * u.arcsec).data, X),
    "scene.deconvolve.image": (lambda x: scene.deconvolve(_image(x), np.eye(3)), X),
    "profiles.sersic_bn.n": (profiles.sersic_bn, X),
    "profiles.sersic_enclosed_fraction.radius": (lambda x: profiles.sersic_enclosed_fraction(x, 1.0), X),
    "profiles.sersic_radius.fraction": (lambda x: profiles.sersic_radius(x, 1.0), X / 3),
    "instrument.tangent_offset.x_offset": (
        lambda x: instrument.tangent_offset(SkyCoord(53.1, -27.8, unit="deg"), x, Y * u.arcsec, 0 * u.deg).ra.deg,
        X << u.arcsec),
    "utils.positions.as_positions.table": (
        lambda x: as_positions(as_table({"ra": x, "dec": X * u.deg}, "x"), "catalog", missing=True).ra.deg,
        X << u.deg),
    "filters.as_photometry.data": (
        lambda x: filters.as_photometry({"mag_F770W": x, "e_mag_F770W": X}, ["miri.f770w"])["miri.f770w"].value,
        X + 20),
    "scene.depth_to_rms.pixel_area": (lambda x: scene.depth_to_rms(29.0, pixel_area=x), X),
    "photometry.crowded.flux": (
        lambda x: photometry.crowded(SkyCoord(X / 1e3, X / 1e3, unit="deg"), x, radius=9 * u.arcsec), FLUX),
    "agn.NoiseCurve.of_band.flux": (lambda x: _curve(x, Y), X),
    "agn.NoiseCurve.of_band.error": (lambda x: _curve(X, x), X),
    "agn.add_light.photometry": (
        lambda x: agn.add_light(
            QTable({"id": np.arange(5), "a": x, "a_err": FLUX}), {"a": FLUX}, curves=CURVES, seed=1), FLUX),
    "agn.add_light.light": (
        lambda x: agn.add_light(
            QTable({"id": np.arange(5), "a": FLUX, "a_err": FLUX}), {"a": x}, curves=CURVES, seed=1), FLUX),
    "agn.draw_shares.table": (
        lambda x: agn.draw_shares(_image(x).T.reshape(5, 1, 5, 1), np.full(5, 0.2), n_draws=3, seed=1).shares, X),
    "agn.draw_shares.prior": (
        lambda x: agn.draw_shares(np.ones((5, 1, 5, 1)), x, n_draws=3, seed=1).shares, X / X.sum()),
    "depth.aperture_noise.annulus": (lambda x: depth.aperture_noise("F770W", annulus=x[:2]), 2 * X << u.arcsec),
    "depth.SaturationForecast.from_rate.rate": (
        lambda x: depth.SaturationForecast.from_rate(_image(x), EXPOSURE, 1e4).n_pixels, X),
    "evaluation.AGNPopulation.density.stellar_mass": (
        lambda x: evaluation.AGNPopulation().density(x, 1.0, [1e42, 1e43] * u.erg / u.s), MASS),
    "evaluation.AGNPopulation.density.redshift": (
        lambda x: evaluation.AGNPopulation().density(MASS, x, [1e42, 1e43] * u.erg / u.s), X),
    "evaluation.AGNPopulation.density.l_x": (
        lambda x: evaluation.AGNPopulation().density(MASS, 1.0, x), LUMINOSITY),
    "evaluation.completeness.edges": (lambda x: evaluation.completeness(X, FOUND > 0, x), X),
    "evaluation.number_counts.edges": (
        lambda x: evaluation.number_counts(FLUX, 1 * u.deg**2, x), X + 22 << u.ABmag),
    "evaluation.feature_residuals.residual": (lambda x: _feature(x, X), Y),
    "evaluation.feature_residuals.redshift": (lambda x: _feature(Y, x), X),
    "evaluation.photoz_metrics.z_true": (lambda x: evaluation.photoz_metrics(x, Y), X),
    "evaluation.recovery_metrics.true": (lambda x: evaluation.recovery_metrics(x, Y), X),
    "evaluation.posterior_ranks.values": (lambda x: evaluation.posterior_ranks(Y, x, LEVELS), X),
    "evaluation.posterior_ranks.levels": (lambda x: evaluation.posterior_ranks(Y, X, x), LEVELS),
    "evaluation.selection_quality.selected": (lambda x: evaluation.selection_quality(FOUND > 0, x), FOUND),
    "evaluation.uvj_quiescent.v_j": (lambda x: evaluation.uvj_quiescent(Y * u.mag, x, X), X << u.mag),
    "evaluation.uvj_quiescent.redshift": (lambda x: evaluation.uvj_quiescent(Y * u.mag, X * u.mag, x), X),
    "evaluation.xray_luminosity_function.redshift": (
        lambda x: evaluation.xray_luminosity_function(1e37 * u.W, x), X),
    "evaluation.xray_obscured_fraction.redshift": (lambda x: evaluation.xray_obscured_fraction(LUMINOSITY, x), X),
    "evaluation.xray_luminosity_at.flux": (
        lambda x: evaluation.xray_luminosity_at(x, 1.0), LUMINOSITY / u.cm**2 / 1e60),
    "evaluation.yang2021_xray_flux.redshift": (lambda x: evaluation.yang2021_xray_flux(LUMINOSITY, x), X),
    "evaluation.agn_fraction.reference": (lambda x: evaluation.agn_fraction(LUMINOSITY, x), LUMINOSITY),
    "filters.Filter.weights.wave": (lambda x: _band().weights(x), WAVE),
    "filters.Filter.weights.wave numbers": (lambda x: _band().weights(x), WAVE.value),
    "filters.FilterSet.weights.wave": (lambda x: filters.FilterSet([_band()]).weights(x), WAVE),
    "filters.FilterSet.weights.wave numbers": (lambda x: filters.FilterSet([_band()]).weights(x), WAVE.value),
    "fitting.AGNBins.place.redshift": (lambda x: BINS.place(x, X / 3, 1e37 * Y), X),
    "fitting.AGNBins.place.frac_agn": (lambda x: BINS.place(X, x, 1e37 * Y), X / 3),
    "fitting.AGNBins.place.luminosity": (lambda x: BINS.place(X, X / 3, x), 1e37 * Y),
    "fitting.magnitude_prior.redshift": (lambda x: fitting.magnitude_prior(FLUX, x)[1], X),
    "injection.CompletenessCurve.__call__.magnitude": (CURVE, X + 24),
    "instrument.pixel_to_v2v3.y": (lambda x: instrument.pixel_to_v2v3(100 * X, x), 100 * X),
    "instrument.pixel_to_sky.x": (lambda x: instrument.pixel_to_sky(x, Y, CENTER, 0 * u.deg).ra.deg, X),
    "instrument.pixel_to_sky.y": (lambda x: instrument.pixel_to_sky(Y, x, CENTER, 0 * u.deg).ra.deg, X),
    "instrument.v2v3_to_sky.v3": (lambda x: instrument.v2v3_to_sky(X, x, np.eye(3)), X),
    "instrument.tangent_offset.y_offset": (
        lambda x: instrument.tangent_offset(CENTER, Y * u.arcsec, x, 0 * u.deg).ra.deg, X << u.arcsec),
    "photometry.weight_scale.mask": (
        lambda x: photometry.weight_scale(IMAGE.data[28:33, 28:33], np.ones((5, 5)), mask=_image(x)), FOUND),
    "photometry.crowded.sky": (lambda x: photometry.crowded(_sky(x), FLUX, radius=9 * u.arcsec), X / 1e3),
    "photometry.encircled_flux.sky": (
        lambda x: photometry.encircled_flux(IMAGE, _sky(x), FLUX, [0.2, 0.4] * u.arcsec), X / 1e4),
    "photometry.encircled_flux.flux": (
        lambda x: photometry.encircled_flux(IMAGE, SKY, x, [0.2, 0.4] * u.arcsec), FLUX),
    "photometry.encircled_flux.radii": (
        lambda x: photometry.encircled_flux(IMAGE, SKY, FLUX, x), X / 3 << u.arcsec),
    "photometry.aperture_photometry.sky": (
        lambda x: photometry.aperture_photometry(IMAGE, _sky(x), 0.3 * u.arcsec), X / 1e4),
    "photometry.image_errors.diameters": (
        lambda x: photometry.image_errors(IMAGE, diameters=x, psf=POINT, seed=1), X << u.arcsec),
    "photometry.ErrorModel.extrapolated.flux": (lambda x: ERRORS.extrapolated(x, "miri.f770w"), FLUX),
    "profiles.ellipse_to_pixels.axis_ratio": (
        lambda x: profiles.ellipse_to_pixels(np.eye(2), radius=1.0, axis_ratio=x, position_angle=0.3), X / 3),
    "profiles.ellipse_to_pixels.position_angle": (
        lambda x: profiles.ellipse_to_pixels(np.eye(2), radius=1.0, axis_ratio=0.5, position_angle=x), X),
    "profiles.ellipse_to_pixels.jacobian": (
        lambda x: profiles.ellipse_to_pixels(_image(x)[:2, :2], radius=X, axis_ratio=0.5, position_angle=0.3), X),
    "profiles.sersic_enclosed_fraction.n": (lambda x: profiles.sersic_enclosed_fraction(1.0, x), X),
    "profiles.sersic_radius.n": (lambda x: profiles.sersic_radius(0.5, x), X),
    "psf.MatchingKernel.source": (
        lambda x: psf.MatchingKernel(np.eye(5), 0.1 * u.arcsec, source=_image(x)).source, X),
    "psf.MatchingKernel.target": (
        lambda x: psf.MatchingKernel(np.eye(5), 0.1 * u.arcsec, target=_image(x)).target, X),
    "psf.MatchingKernel.__call__.image": (lambda x: KERNEL(_image(x)), X),
    "psf.MatchingKernel.apply.image": (lambda x: KERNEL.apply(_image(x)), X),
    "psf.MatchingKernel.with_psfs.source": (lambda x: KERNEL.with_psfs(_image(x), np.eye(5)).source, X),
    "psf.MatchingKernel.with_psfs.target": (lambda x: KERNEL.with_psfs(np.eye(5), _image(x)).target, X),
    "psf.MatchingKernel.blend.weights": (lambda x: psf.MatchingKernel.blend([KERNEL] * 5, x).array, X),
    "psf.MatchingKernel.from_array.source": (
        lambda x: psf.MatchingKernel.from_array(np.eye(5) / 5, pixel_scale=PIXEL, source=_image(x)).source,
        X),
    "psf.MatchingKernel.from_array.target": (
        lambda x: psf.MatchingKernel.from_array(np.eye(5) / 5, pixel_scale=PIXEL, target=_image(x)).target,
        X),
    "psf.MatchingKernel.from_psfs.hi": (lambda x: _matching(_square(x), _square(WIDE)), SHARP),
    "psf.MatchingKernel.from_psfs.lo": (lambda x: _matching(_square(SHARP), _square(x)), WIDE),
    "psf.as_psf.psf": (lambda x: psf.as_psf(_image(x)).data, X),
    "psf.InstrumentPSF.data": (
        lambda x: psf.InstrumentPSF(_image(x), pixel_scale=0.1 * u.arcsec, frame="detector").data, X),
    "psf.KernelField.weights.sky": (lambda x: FIELD.weights(_sky(x)), X / 1e4),
    "psf.psf_grid.positions": (
        lambda x: psf.psf_grid([POINT] * 4, _image(x)[0].reshape(4, 2)).grid_xypos,
        np.array([1.0, 1, 1, 2, 2, 1, 2, 2])),
    "psf.grid_weights.x": (lambda x: psf.grid_weights(GRID, x, 0.5), X),
    "psf.grid_weights.y": (lambda x: psf.grid_weights(GRID, 0.5, x), X),
    "reduction.calibrate.flat": (
        lambda x: reduction.calibrate(
            CCDData(np.ones((64, 72)), unit="adu/s"), subarray="SUB64",
            flat=_image(x)[:1, 1:2], conversion=1.0).data, X),
    "reduction.fit_groups.data": (
        lambda x: reduction.fit_groups(_image(x).T[None, :, None, :], MAPS, group_time=3.0).rate, 1e3 * X),
    "reduction.fit_groups.drift": (
        lambda x: reduction.fit_groups(
            GROUPS, MAPS, group_time=3.0, drift=_image(x)[:1]).rate, X),
    "reduction.fit_groups.usable": (
        lambda x: reduction.fit_groups(
            GROUPS, MAPS, group_time=3.0, usable=_image(x)).rate, FOUND),
    "psf.MatchingKernel.from_array.array": (
        lambda x: psf.MatchingKernel.from_array(_image(x), pixel_scale=0.1 * u.arcsec).array, X / 5 / X.sum()),
    "reduction.DetectorMaps.gain": (lambda x: _slopes(reduction.DetectorMaps(gain=_image(x), read_noise=1.0)), X),
    "reduction.DetectorMaps.read_noise": (
        lambda x: _slopes(reduction.DetectorMaps(gain=1.0, read_noise=_image(x))), X),
    "reduction.DetectorMaps.bias": (
        lambda x: _slopes(reduction.DetectorMaps(gain=1.0, read_noise=1.0, bias=_image(x))), X),
    "reduction.DetectorMaps.saturation": (
        lambda x: _slopes(reduction.DetectorMaps(gain=1.0, read_noise=1.0, saturation=_image(x))), 1e4 * X),
    "reduction.DetectorMaps.slow_noise": (
        lambda x: _slopes(reduction.DetectorMaps(gain=1.0, read_noise=1.0, slow_noise=_image(x))), X),
    "reduction.DetectorMaps.dark": (
        lambda x: _slopes(reduction.DetectorMaps(gain=1.0, read_noise=1.0, dark=_groups(x))),
        X),
    "reduction.DetectorMaps.reset": (
        lambda x: _slopes(reduction.DetectorMaps(gain=1.0, read_noise=1.0, reset=_groups(x))),
        X),
    "detector.Latent.rate": (
        lambda x: detector.Latent(x.reshape(1, 5), 1e3 * u.s).rate, X << u.electron / u.s),
    "photometry.detection_purity.snr_edges": (lambda x: photometry.detection_purity(BLANK, snr_edges=x), 5 * X),
    "psf.InstrumentPSF.replace.data": (lambda x: POINT.replace(data=_square(x)).data, SHARP),
    "psf.KernelField.sky": (lambda x: psf.KernelField((KERNEL,) * 5, _sky(x)).weights(SKY), X / 1e4),
    "reduction.drizzle_images.weights": (
        lambda x: reduction.drizzle_images([EVEN], EVEN.wcs, weights=[_plane(x)]).weight, X),
    "reduction.drizzle_images.variances": (
        lambda x: reduction.drizzle_images([EVEN], EVEN.wcs, variances=[{"var_rnoise": _plane(x)}]).variances, X),
    "sed.with_xray_bands.alpha_ox": (lambda x: _with_xrays({"hard": [2, 7] * u.keV}, x), X - 3),
    "sed.with_xray_bands.bands": (lambda x: _with_xrays({"hard": x[:2]}, [-1.5]), X << u.keV),
    "fitting.BayesFitter.fit.redshift": (lambda x: _fitter().fit(TABLE, redshift=x).chi2, X),
    "fitting.FitResults.percentile.levels": (lambda x: _results().percentile("redshift", x), X / 3),
    "fitting.Samples.percentile.levels": (lambda x: _draws().percentile("redshift", x), X / 3),
    "fitting.compare_classes.prior": (
        lambda x: fitting.compare_classes(
            {"a": _results(), "b": _results()}, prior={"a": x, "b": 1 - X / 3}), X / 3),
    "photometry.ErrorModel.assign.noise": (
        lambda x: ERRORS.assign(QTable({"id": np.arange(5), "miri.f770w": FLUX}), noise={"miri.f770w": x}), X),
    "agn.agn_light.luminosity": (
        lambda x: agn.agn_light(NUCLEI, _hosts(), x, {}, ["miri.f770w"])[0]["miri.f770w"], LUMINOSITY),
    "photometry.SourceTemplates.from_arrays.arrays": (lambda x: _template(_image(x)).light[0].data, X),
    "scene.deconvolve.psf": (lambda x: scene.deconvolve(np.eye(9), _image(x)), X),
    "sed.Parameter.array.values": (lambda x: sed.Parameter(default=1.0, bounds=(0, 5), doc="a").array(x), X),
    "sed.band_luminosity.from_band": (
        lambda x: sed.band_luminosity(1e37 * u.W, from_band=x[:2], to_band=[2, 10] * u.keV), X << u.keV),
    "sed.band_luminosity.to_band": (
        lambda x: sed.band_luminosity(1e37 * u.W, from_band=[2, 10] * u.keV, to_band=x[:2]), X << u.keV),
    "sed.xray_flux.band": (lambda x: sed.xray_flux(LUMINOSITY, 1.0, band=x[:2]), X << u.keV),
    "cigale.CigaleSetup.axes.redshifts": (lambda x: SETUP.axes(x)["redshift"], X),
    "cigale.CigaleSetup.grid.redshifts": (lambda x: SETUP.grid(["acs.f606w"], x).galaxy, X),
    "cigale.CigaleSetup.save_models.redshifts": (_saved_models, X),
    "agn.agn_light.parameters": (
        lambda x: agn.agn_light(NUCLEI, _hosts(), LUMINOSITY, {"inclination": x}, ["miri.f770w"])[0]["miri.f770w"],
        20 * X),
    "fitting.FitResults.plot_redshift.z_spec": (_plotted_redshifts, X),
    "fitting.measure_template_error.edges": (
        lambda x: fitting.measure_template_error(_fixed(), edges=x).error, X / 2 << u.um),
    "photometry.ErrorModel.from_tables.noise": (_measured_errors, X),
    "photometry.ForcedPhotometer.render.flux": (
        lambda x: photometry.ForcedPhotometer(DELTA).render(IMAGE, POINTS, x).value, FLUX),
    "photometry.SourceTemplates.from_images.psf": (_looked_at, SHARP),
    "reduction.DetectorMaps.linearity": (
        lambda x: _slopes(reduction.DetectorMaps(gain=1.0, read_noise=1.0, linearity=_powers(x))), X),
    "scene.highres_image.noise": (
        lambda x: scene.highres_image(STARS, wcs=IMAGE.wcs, psf=POINT, noise=_plane(x)).data, X),
    "sed.red_dots.axes": (lambda x: list(sed.red_dots({"temperature": x})), 4000 + 1000 * X << u.K),
}  # fmt: skip

#: Arguments that are not in the matrix, by reason; ``*`` stands for any name without a dot.
EXEMPT = {
    "results and records, which the package makes itself": [
        "agn.NoiseCurve.*",
        "agn.ShareDraws.*",
        "cigale.CigaleSetup.*",
        "evaluation.TruthResults.*",
        "fitting.FitResults.*",
        "fitting.LeaveOutResult.*",
        "fitting.Samples.*",
        "fitting.SurveyCalibration.*",
        "reduction.Background.*",
        "reduction.ImageFile.*",
        "reduction.Mosaic.*",
        "reduction.RampFit.*",
        "reduction.ReductionResult.*",
        "psf.PSFGrid.*",
        "psf.Pupil.*",
        "sed.ModelGrid.*",
    ],
    "state of a simulation, which `Detector` hands to its effects": [
        "detector.Block.*",
        "detector.Charge.*",
        "detector.*.expected.array",
        "detector.*.apply.array",
    ],
    "values that a `SEDModel` hands to its components": [
        "sed.GalacticExtinction.transmission.wave",
        "sed.XRay.derived.*",
    ],
    "truth values, flags, labels and indices, which have no NaN to stand for no value": [
        "agn.AGNImages.add_agn.hosts",
        "detector.Latent.saturated",
        "detector.Ramp.*_dq",
        "evaluation.confusion.*",
        "instrument.dq_planes.flags",
        "photometry.*.segmentation",
        "photometry.*.*.segmentation",
        "photometry.SourceTemplates.from_arrays.corners",
        "photometry.SourceTemplates.from_arrays.convolved",
        "photometry.dilate_segments.mask",
        "planning.Planner.accuracy.chosen",
        "reduction.DetectorMaps.pixel_dq",
        "reduction.calibrate.flags",
        "reduction.fit_groups.group_dq",
        "reduction.*.reference",
        "reduction.*.usable",
        "sed.ModelGrid.flux.*",
    ],
    "arrays between stages of the package: planes, pixels and matrices that it computes itself": [
        "agn.AGNImages.add_agn.light",
        "instrument.pixel_area_map.out",
        "instrument.v2v3_to_sky.matrix",
        "instrument.write_image.planes",
        "photometry.MosaicFile.read.added",
        "photometry.MosaicFile.read.added_variance",
        "photometry.SourceTemplates.drawn.xy",
        "reduction.RampFit.noise_correction.kernel",
        "reduction.Reducer.combine.planes",
        "reduction.write_image.planes",
        "scene.Cutout.pieces.jacobian",
        "scene.Painter.paint.*",
    ],
    "counts of a `Ramp`, which refuses a mask (tested below)": [
        "detector.Ramp.data",
        "reduction.reference_channels.data",
        "reduction.reference_channels.offsets",
        "reduction.reference_drift.data",
        "reduction.reference_drift.offsets",
        "reduction.settling_groups.data",
    ],
    "passed on to an argument of the matrix": [
        "fitting.calibrate.redshift",
        "fitting.BayesFitter.__call__.redshift",
        "psf.KernelField.from_psfs.hi",
    ],
    "tested below: positions in a `SkyCoord`": ["sed.color_excess.sky"],
}


def _pattern(names):
    """Expression of names in which ``*`` is any name without a dot."""
    return "|".join(re.escape(name).replace(r"\*", r"\w+") for name in names)


def _exempt_patterns():
    return [name for names in EXEMPT.values() for name in names]


@pytest.fixture(scope="module")
def arrays():
    """Arguments of public functions, classes and methods that their docstrings call arrays."""
    arguments = documented_arguments()
    return [name for name, stated in arguments.items() if re.search("array|shape", stated)]


def test_every_array_argument_is_in_the_matrix_or_has_a_reason_not_to_be(arrays):
    tried = {name.split()[0] for name in FUNCTIONS}
    exempt = _pattern(_exempt_patterns())
    missing = [name for name in arrays if name not in tried and not re.fullmatch(exempt, name)]
    assert missing == []


def test_every_exemption_is_of_an_array_argument_outside_of_the_matrix(arrays):
    tried = {name.split()[0] for name in FUNCTIONS}
    outside = [name for name in arrays if name not in tried]
    for name in _exempt_patterns():
        assert any(re.fullmatch(_pattern([name]), other) for other in outside), name


@pytest.mark.parametrize("name", FUNCTIONS)
def test_the_matrix_names_arguments_that_there_are(name):
    path = name.split()[0].split(".")
    # of a function in a module, of a class or of a method
    owner = importlib.import_module(f"miricigale.{path[0]}")
    if path[0] == "utils":
        owner = importlib.import_module(f"miricigale.utils.{path[1]}")
        path = path[1:]
    for part in path[1:-1]:
        owner = getattr(owner, part)
    assert path[-1] in inspect.signature(owner).parameters


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


@pytest.mark.parametrize("fits", [_fitter, _results, _draws, _hosts, _fixed])
def test_fits_that_masks_are_tried_on_can_be_made(fits):
    """What is refused below is not refused for want of them."""
    assert fits() is fits()


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


@pytest.mark.parametrize("dtype", ["float64", "Float64", "Int64"])
def test_numbers_of_pandas_are_masked_by_their_missing_values_alone(dtype):
    # the method ``mask`` of a Series is no mask: redshift=frame["z"] left all galaxies unfitted
    from miricigale.fitting.posterior.priors import known_redshifts

    pandas = pytest.importorskip("pandas")
    table = QTable({"id": np.arange(3)})
    whole = pandas.Series([1, 2, 3], index=[7, 5, 6]).astype(dtype)
    assert mask_of(whole).tolist() == [False] * 3
    assert known_redshifts(table, whole).tolist() == [1, 2, 3]
    part = pandas.Series([1, None, 3], dtype=dtype)
    for values in (part, part.array):
        assert mask_of(values).tolist() == [False, True, False]
        assert np.isnan(known_redshifts(table, values)).tolist() == [False, True, False]


def test_positions_behind_a_mask_have_no_color_excess():
    class Map:
        def query(self, sky):
            return np.full(sky.shape, 0.01)

    mask = np.arange(X.size) == HIDDEN
    sky = SkyCoord(X * u.deg, Masked(X * u.deg, mask=mask))
    with pytest.raises(ValueError, match="'sky' must be positions with a color excess, got 1 of 5"):
        sed.color_excess(sky, Map())


@pytest.mark.parametrize("kind", ["Masked", "np.ma"])
def test_a_ramp_refuses_masked_counts(kind):
    counts = np.full((1, 5, *EXPOSURE.shape), 100, np.uint16)
    mask = np.zeros(counts.shape, bool)
    assert detector.Ramp(KINDS[kind](counts, mask), EXPOSURE).data.dtype == np.uint16
    mask[0, 2, 3, 4] = True
    refuses(
        "'data' must be without a mask .* 1 masked",
        detector.Ramp,
        KINDS[kind](counts, mask),
        EXPOSURE,
    )


@pytest.mark.parametrize("method", ["linear", "nearest"])
def test_no_kernel_has_a_weight_at_a_masked_position(method):
    field = psf.KernelField((KERNEL,) * 5, SKY, method)
    place = SkyCoord(Masked(X / 1e4, mask=np.arange(5) == HIDDEN) * u.deg, Y / 1e4 * u.deg)
    weights = field.weights(place)
    assert np.isnan(weights[HIDDEN]).all()
    np.testing.assert_allclose(np.delete(weights.sum(axis=1), HIDDEN), 1.0)
