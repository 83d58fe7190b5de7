import matplotlib as mpl
import numpy as np
import pytest

mpl.use("Agg")

import astropy.units as u
import matplotlib.pyplot as plt

from miricigale.fitting import BayesFitter
from miricigale.plotting.posteriors import plot_pdf, plot_pdf_2d, plot_sed_fit


@pytest.fixture(autouse=True)
def _close():
    yield
    plt.close("all")


def test_density_integrates_to_one():
    ax = plt.figure().add_subplot()
    assert plot_pdf([0.0, 1.0, 3.0], [0.5, 0.5], ax=ax, label="x", truth=1.0) is ax
    values, edges, _ = ax.patches[0].get_data()
    assert np.sum(values * np.diff(edges)) == pytest.approx(1.0)
    assert ax.get_xlabel() == "x"


def test_outline_holds_the_stated_part():
    ax = plt.figure().add_subplot()
    weights = np.zeros((5, 4))
    weights[2, 1] = 0.7
    weights[2, 2] = 0.3
    plot_pdf_2d(np.arange(6.0), np.arange(5.0), weights, ax=ax, labels=("a", "b"), levels=(0.68,))
    # a single cell: four sides
    assert len(ax.collections[-1].get_segments()) == 4


def test_photometry_with_and_without_residuals():
    wave = np.array([1.0, 4.0, 15.0]) * u.um
    flux = np.array([1.0, -0.5, np.nan]) * u.uJy
    err = np.array([0.1, 1.0, np.nan]) * u.mJy
    model = np.array([1.1, 0.5, 3.0]) * u.uJy
    top, bottom = plot_sed_fit(wave, flux, err, model, title="x")
    assert top.get_yscale() == "log"
    assert "sigma" in bottom.get_ylabel()
    ax = plt.figure().add_subplot()
    assert plot_sed_fit(wave, flux, err, model, ax=ax) is ax


def test_parts_and_groups_stand_in_the_legend():
    wave = np.array([1.0, 4.0, 15.0]) * u.um
    flux = np.array([1.0, 2.0, 3.0]) * u.uJy
    ax = plt.figure().add_subplot()
    spectrum = (wave, flux)
    plot_sed_fit(
        wave,
        flux,
        0.1 * flux,
        flux,
        spectrum=spectrum,
        parts={"AGN": spectrum},
        groups=["old", "old", "MIRI"],
        ax=ax,
    )
    labels = [text.get_text() for text in ax.get_legend().get_texts()]
    assert labels[:2] == ["best model", "AGN"]
    assert {"old", "MIRI"} < set(labels)
    points = {bar.get_label(): bar.lines[0] for bar in ax.containers}
    assert points["old"].get_xdata().tolist() == [1.0, 4.0]
    assert points["MIRI"].get_xdata().tolist() == [15.0]
    assert points["old"].get_color() != points["MIRI"].get_color()


def test_results_draw_themselves(grid, photometry):
    results = BayesFitter(grid).fit(photometry)
    ax = plt.figure().add_subplot()
    assert results[2].plot_pdf("frac_agn", ax=ax) is ax
    ax = plt.figure().add_subplot()
    assert results[2].plot_pdf("mass", ax=ax) is ax
    ax = plt.figure().add_subplot()
    assert results[2].plot_pdf2d(ax=ax) is ax
