"""Figures of the report from mock studies and made-up posteriors."""

from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from helpers.figures import error_bars, legend_texts, line_data
from helpers.runs import made_up_kernel, noise_image
from helpers.studies import BANDS, mock_study
from miricigale.evaluation import completeness, study_confusion, xray_fluxes
from miricigale.instrument import north_up_wcs
from miricigale.psf import gaussian_psf, psf_image
from miricigale.sed import SED
from miricigale.workflow.page import band_figures, pictures, source_figures, study_figures


@pytest.fixture(scope="module")
def study():
    return mock_study()


@pytest.mark.parametrize("quantity", ["redshift", "fraction", "width"])
def test_every_truth_has_a_panel_with_a_step_line_for_each_set(study, quantity):
    figure = study_figures.histogram_figure(study, quantity)
    assert [ax.get_title() for ax in figure.axes] == [
        "fracAGN 0", "fracAGN 0.2", "fracAGN 0.6", "fracAGN 0.99"
    ]  # fmt: skip
    for one, ax in zip(study.truths, figure.axes, strict=True):
        for patch in ax.patches:
            # each source once, those beyond the bins in the outermost ones
            x, y = patch.get_xy().T
            steps = np.r_[0.0, y[2::2]][: len(x) // 2]
            assert np.sum(steps) == pytest.approx(np.count_nonzero(one.sample))
    known = {"redshift": [0, 0, 0, 0], "fraction": [0, 0.2, 0.6, 0.99], "width": []}[quantity]
    marks = [line[0, 0] for ax in figure.axes for line in line_data(ax, "--")]
    assert marks == pytest.approx(known)
    # one legend, and numbers in each panel
    assert [text.get_text() for text in figure.legends[0].texts][:2] == [
        "with MIRI",
        "without MIRI",
    ]
    assert all(len(ax.texts) == 2 for ax in figure.axes)


def test_differences_by_redshift_have_their_median(study):
    one, figure = study.truths[0], study_figures.histogram_figure(study, "difference")
    z, found = one.true("redshift"), one.fitted("none", "frac_agn_mean")
    texts = [ax.texts[1].get_text() for ax in figure.axes if len(ax.texts) > 1]
    spans = [(0, 0.2), (0.2, 1), (1, 2), (2, 3), (3, np.inf)]
    medians = [np.median(found[(z >= low) & (z < high)]) for low, high in spans]
    assert [float(text.split()[0]) for text in texts] == pytest.approx(medians, abs=6e-4)


def test_recovered_luminosities_lie_about_the_line_of_equality(study):
    figure = study_figures.disk_figure(study)
    assert len(figure.axes) == 3
    for one, ax in zip(study.with_agn, figure.axes, strict=True):
        true = one.truth["accretion_power"][one.sample].to_value(u.erg / u.s)
        assert_allclose(line_data(ax, ".")[0][:, 0], true)
        (equality,) = (line.get_xydata() for line in ax.lines if line.get_marker() == "None")
        assert_array_equal(equality[:, 0], equality[:, 1])
        assert ax.texts[0].get_text().startswith("median -0.")
    assert study_figures.disk_figure(mock_study((0.0,))) is None


@pytest.mark.slow
def test_xray_counts_stand_above_the_shares_found(study):
    figure = study_figures.xray_figure(study, 1)
    upper, lower = figure.axes
    bins = upper.patches[0].get_data().edges
    values = np.concatenate([xray_fluxes(one)[one.field] for one in study.with_agn])
    found = np.concatenate([one.sample[one.field] for one in study.with_agn])
    table = completeness(values, found, bins)
    assert_array_equal(upper.patches[0].get_data().values, table["n"])
    assert_array_equal(upper.patches[1].get_data().values, table["n_found"])
    some = table[table["n"] > 0]
    assert_allclose(line_data(lower, "o")[0][:, 1], some["share"])
    # estimates are dotted
    assert len(line_data(upper, ":")) == 2
    assert "50 % of these" in legend_texts(upper)
    assert study_figures.xray_figure(mock_study((0.0,)), 1) is None


def test_luminosities_with_an_axis_of_star_formation(study):
    figure = study_figures.detection_figure(study)
    (ax,), one = figure.axes, study.truths[0]
    seen = one.field & (np.asarray(one.matched["n_detected"]) >= 2)
    drawn = line_data(ax, "o")[0]
    assert_allclose(drawn[:, 0], one.truth["redshift"][seen])
    assert_allclose(drawn[:, 1], one.truth["ir_luminosity"][seen].value)
    labels = ["not detected", "detected in two or more MIRI bands", "MIPS 24 µm above its limit"]
    assert legend_texts(ax) == labels
    (right,) = ax.child_axes
    figure.draw_without_rendering()
    # Kennicutt 1998: 4.5e-44 Msun / yr for each erg / s
    rate = 4.5e-44 * (1 * u.Lsun).to_value(u.erg / u.s)
    assert_allclose(right.get_ylim(), np.array(ax.get_ylim()) * rate)


def test_offsets_by_shape_have_their_median_and_circles(study):
    figure, one = study_figures.shape_figure(study), study.truths[0]
    assert len(figure.axes) == 3 * len(BANDS)
    rows = one.field & one.is_bright(BANDS[0]) & one.shapes["point"]
    ax = figure.axes[0]
    assert ax.get_title() == f"F770W, points ({np.count_nonzero(rows)})"
    error = one.magnitude_error(BANDS[0])
    assert ax.texts[0].get_text() == f"median {np.median(error[rows]):+.3f}"
    (circles,) = line_data(ax, "o")
    expected = np.clip(error[rows & one.crowded[BANDS[0]]], -0.97, 0.97)
    assert_allclose(circles[:, 1], expected)


def test_classes_say_shares_and_numbers(study):
    table = study_confusion(study)
    (ax,) = study_figures.class_figure({"with MIRI": table}).axes
    n = table["galaxy"][0]
    whole = sum(table[name][0] for name in ("galaxy", "composite", "agn", "unknown"))
    assert ax.texts[0].get_text() == f"{100 * n / whole:.0f} %\n{n}"
    labels = ["galaxy", "composite", "AGN", "not in the fit"]
    assert [t.get_text() for t in ax.get_xticklabels()] == labels


def test_uniform_ranks_have_the_density_one():
    ranks = {("all", "redshift"): np.r_[np.arange(0.05, 1, 0.1), np.nan]}
    ranks |= {("all", "frac_agn"): np.zeros(8), ("blue", "frac_agn"): np.zeros(8)}
    first, second = study_figures.rank_figure(ranks).axes
    assert_allclose(first.patches[0].get_data().values, 1.0)
    assert second.patches[0].get_data().values[0] == pytest.approx(10)
    assert second.get_ylim()[1] > 10
    assert (first.get_title(), second.get_title()) == ("redshift", "fracAGN")


def test_features_are_shaded_with_the_median_inside():
    z = np.linspace(0.0, 2.9, 300)
    inside = (z > 1.2) & (z < 1.7)
    (ax,) = study_figures.residual_figure(z, {"miri.f1500w": np.where(inside, 0.2, 0.0)}).axes
    shades = {patch.get_label(): patch for patch in ax.patches}
    # 15.06 um over 6.2 and 7.7, and the width of the band
    for name, rest in (("6.2 µm", 6.2), ("7.7 µm", 7.7)):
        low, high = shades[name].get_x(), shades[name].get_x() + shades[name].get_width()
        assert 0.5 * (low + high) == pytest.approx(15.06 / rest - 1, abs=0.02)
    medians = [line.get_ydata() for line in ax.lines if line.get_linewidth() == 2]
    assert [list(y) for y in medians] == [[0.2, 0.2], [0.0, 0.0]]


def test_magnitudes_and_counts_are_those_of_the_sources():
    flux = np.array([1.0, 10.0, 100.0, -1.0]) * u.uJy
    table = QTable({"miri.f770w": flux, "miri.f770w_true": np.abs(flux)})
    (ax,) = band_figures.magnitude_figure(table, ["miri.f770w"]).axes
    magnitudes = [[23.9, 23.9], [21.4, 21.4], [18.9, 18.9]]
    assert_allclose(line_data(ax, ".")[0][:3], magnitudes)
    # a source without a positive flux is a tick
    assert line_data(ax, "|")[0][0, 0] == pytest.approx(23.9)
    # bright sources are at the top
    assert ax.get_ylim()[0] > ax.get_ylim()[1]
    (ax,) = band_figures.counts_figure(table[:3], ["miri.f770w"], 1 * u.deg**2).axes
    ((xy, low, high),) = error_bars(ax)
    assert_allclose(xy, [[18.75, 2.0], [21.25, 2.0], [23.75, 2.0]])
    assert_allclose((low, high), (np.zeros(3), np.full(3, 4.0)), atol=1e-12)


def test_encircled_energy_is_in_percent():
    kernel = made_up_kernel()
    left, right = pictures.convolution_figure({"miri.f770w": kernel}).axes
    radius, percent = right.lines[0].get_xydata().T
    expected = kernel.encircled_energy_error(radius * u.arcsec)
    assert_allclose(percent, 100 * expected)
    assert legend_texts(left) == ["F770W"]


def test_background_has_profiles_that_leave_sources_out():
    cal, _ = noise_image(rim=0)
    middle = cal.shape[1] // 2
    cal.data[10:20, middle - 16 : middle + 16] += 1e4
    slope = cal.data + np.arange(cal.shape[1])
    reducer = SimpleNamespace(calibrate=lambda rate: rate)
    reducer.replace = lambda **_: reducer
    rate = SimpleNamespace(data=slope, mask=None)
    first, second, last = pictures.subtraction_figure(rate, cal, reducer).axes[:3]
    assert (first.get_title(), second.get_title()) == ("before", "after")
    # one per pixel across, and nothing along
    along_x, along_y = (line.get_ydata() for line in last.lines[:2])
    assert np.ptp(along_x) == pytest.approx(cal.shape[1], rel=0.1)
    assert np.ptp(along_y) < 10
    assert all(np.ptp(line.get_ydata()) < 1 for line in last.lines[2:4])


def test_spectra_are_in_order_of_their_fraction(study):
    wave = np.geomspace(0.5, 38, 50)

    def evaluate(redshift, frac_agn):
        return SED(wave * u.um, (1 + frac_agn) * wave * u.uJy)

    model = SimpleNamespace(parameters=("redshift", "frac_agn"), evaluate=evaluate)
    ax, filters = source_figures.spectra_figure(study, 3, model).axes
    curves = [line for line in ax.lines if len(line.get_xdata()) == 50]
    for line, fraction in zip(curves, (0, 0.2, 0.4, 0.6, 0.8, 0.99), strict=True):
        assert_allclose(line.get_ydata(), (1 + fraction) * wave)
    # features are redshifted, and left out beyond the spectrum
    redshift = study.truths[0].truth["redshift"][3]
    features = np.array([3.3, 6.2, 7.7, 8.6, 11.3, 12.7]) * (1 + redshift)
    marks = [line[0, 0] for line in line_data(ax, ":")]
    assert_allclose(marks, features[features < 38])
    assert {"F770W", "F2100W"} < set(legend_texts(filters))


def test_source_extractor_stands_beside_the_template_fit():
    """0.1 mag too faint everywhere; template fits are right."""
    true = np.geomspace(1, 100, 60)
    table = QTable({"flux_true": true * u.uJy, "yang2021": true * u.uJy})
    table["source_extractor"] = true * 10**-0.04 * u.uJy
    table["field"], table["edge"], table["snr"] = np.ones(60, bool), np.zeros(60, bool), true
    table["shape"] = np.where(np.arange(60) % 3 == 0, "n >= 2", "n < 2")
    offset, sizes, disks, spheroids = band_figures.rival_figure(table).axes
    bright = [
        np.count_nonzero((true > 5) & (table["shape"] == name)) for name in ("n < 2", "n >= 2")
    ]
    for ax, n in zip((offset, disks, spheroids), (60, *bright), strict=True):
        assert ax.get_title().endswith(f"({n})")
        assert ax.texts[0].get_text() == "median +0.100 mag"
    assert_allclose(sizes.lines[3].get_ydata(), 0.1)


def test_point_sources_of_the_psf_have_its_energy():
    psf = gaussian_psf(0.4 * u.arcsec, pixel_scale=0.1 * u.arcsec, fov=6 * u.arcsec)
    wcs = north_up_wcs(SkyCoord(53.1, -27.8, unit="deg"), 0.1 * u.arcsec, (81, 81))
    image = CCDData(2 * psf_image(psf, pixel_scale=0.1 * u.arcsec, shape=81), unit="uJy", wcs=wcs)
    sources = {"flux_true": [2] * u.uJy, "sky": wcs.pixel_to_world([40], [40])}
    table = QTable(sources, meta={"f_scaling": 1.02})
    figure = pictures.energy_figure(*({"miri.f770w": one} for one in (image, table, psf)))
    # in percent; a Gaussian's light within r is 1 - 2 ** -(r / half width)^2
    assert_allclose(figure.axes[2].lines[0].get_ydata()[5:], 0, atol=0.5)
    radius, scaled = figure.axes[1].lines[1].get_xydata().T
    assert_allclose(scaled[5:], 1.02 * (1 - 2 ** -((radius / 0.2) ** 2))[5:], atol=0.02)
