import astropy.units as u
import numpy as np
from numpy.testing import assert_array_equal

from miricigale import SEDModel
from miricigale.plotting.axes import new_figure
from miricigale.plotting.curves import plot_spectrum
from miricigale.plotting.posteriors import plot_sed_fit


def test_a_spectrum_on_logarithmic_axes_leaves_out_what_is_not_positive(ax):
    assert plot_spectrum([1.0, 2.0, 4.0], [3.0, -1.0, 0.0], ax=ax, label="model") is ax
    (line,) = ax.lines
    assert_array_equal(line.get_xdata(), [1.0, 2.0, 4.0])
    assert_array_equal(line.get_ydata(), [3.0, np.nan, np.nan])
    assert line.get_label() == "model"


def test_a_spectrum_is_shown_where_its_light_is():
    model = SEDModel.yang2021(libraries="bundled")
    sed = model.evaluate(redshift=1.0)
    figure, axes = new_figure(1, 3)
    plain, banded, rest = axes[0]
    sed.plot(plain)
    low, high = plain.get_xlim()
    # the Lyman limit and a millimeter, as observed
    assert 0.18 <= low < 0.3
    assert 100.0 < high <= 2000.0
    sed.plot(banded, filters=["F770W", "F1500W"])
    low, high = banded.get_xlim()
    assert 2.0 < low < 5.6
    assert 18.0 < high < 50.0
    inside = (sed.wave.value > low) & (sed.wave.value < high)
    assert banded.get_ylim()[1] > sed.fnu.value[inside].max()
    sed.plot(rest, rest_frame=True)
    assert rest.get_xlim()[1] <= 1000.0
    figure.draw_without_rendering()
    labels = [label.get_text() for label in banded.get_xticklabels(which="both")]
    assert "10" in labels
    assert not any("10^" in label for label in labels)


def test_emission_lines_are_not_cut():
    wave = np.geomspace(0.3, 20.0, 400) * u.um
    flux = np.ones(400) * u.uJy
    flux[200] = 40 * u.uJy
    bands = [1.0, 10.0] * u.um
    flat = [1, 1] * u.uJy
    _, axes = new_figure(2, 1)
    axes = plot_sed_fit(bands, flat, 0.1 * flat, flat, spectrum=(wave, flux), ax=axes.ravel())
    assert axes[0].get_ylim()[1] > 40.0
