import functools

import astropy.units as u
import numpy as np
import pytest

from helpers.figures import legend_texts
from miricigale.plotting.examples import fit_figure, sequence_figure
from miricigale.plotting.posteriors import plot_sed_fit

Z, F = np.linspace(0, 4, 41), np.linspace(0, 1, 11)


def joint(width):
    z, f = (0.5 * (edges[1:] + edges[:-1]) for edges in (Z, F))
    weights = np.exp(-0.5 * ((z[:, None] - 1.5) / width) ** 2 - 0.5 * ((f - 0.4) / width) ** 2)
    return weights / weights.sum()


def test_a_fit_has_residuals_and_posteriors_with_one_range():
    wave = np.array([1.0, 5.0, 10.0]) * u.um
    flux = [1.0, 2.0, 3.0] * u.uJy
    photometry = {"wave": wave, "flux": flux, "flux_err": 0.1 * flux, "model_flux": 1.1 * flux}
    planes = {"with MIRI": joint(0.1), "without MIRI": joint(0.5)}
    posteriors = {
        name: ((Z * u.one, w.sum(axis=1)), (F, w.sum(axis=0))) for name, w in planes.items()
    }
    draw = functools.partial(plot_sed_fit, **photometry, title="source 7")
    figure = fit_figure(draw, posteriors, planes, truth=(1.5, 0.4))
    upper, lower, redshift, fraction, first, second = figure.axes
    assert upper.get_title() == "source 7"
    assert lower.get_ylabel().startswith("residual")
    for ax in (redshift, fraction):
        peaks = [patch.get_data().values.max() for patch in ax.patches]
        assert peaks == pytest.approx([1.0, 1.0, 1.0])
    assert legend_texts(redshift) == ["with MIRI", "without MIRI", "truth"]
    # as wide as the wider of the two
    low, high = redshift.get_xlim()
    assert low < 0.5
    assert high > 2.5
    assert first.get_xlim() == second.get_xlim()
    assert first.get_ylim() == second.get_ylim()
    assert first.get_title() == "with MIRI"


def test_spectra_are_in_order_of_their_fraction():
    wave = np.geomspace(1, 100, 50)
    spectra = {0.6: 3 * wave, 0.0: wave, 0.2: 2 * wave}
    figure = sequence_figure(
        wave, spectra, bands={"F770W": (6.6, 8.6)}, features=[6.2, 90.0], redshift=1.0
    )
    (ax,) = figure.axes
    assert legend_texts(ax) == ["fracAGN 0", "fracAGN 0.2", "fracAGN 0.6"]
    curves = [line for line in ax.lines if len(line.get_xdata()) == 50]
    for line, factor in zip(curves, (1, 2, 3), strict=True):
        np.testing.assert_allclose(line.get_ydata(), factor * wave)
    # features are redshifted, and left out beyond the spectrum
    assert "6.2" in [text.get_text() for text in ax.texts]
    assert "90" not in [text.get_text() for text in ax.texts]
    marks = [line.get_xdata()[0] for line in ax.lines if line.get_ls() == ":"]
    assert marks == [12.4]
    assert ax.get_title() == "z = 1"
