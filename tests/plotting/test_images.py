import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.colors import AsinhNorm, Normalize
from matplotlib.figure import Figure
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from helpers.figures import line_data
from miricigale.plotting.axes import new_figure
from miricigale.plotting.images import (
    add_colorbar,
    asinh_norm,
    asinh_places,
    color_image,
    mark_sky,
    plot_color,
    plot_image,
    plot_model_residual,
    plot_offsets,
    plot_segmentation,
)


@pytest.fixture
def image():
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:40, :60]
    return 50 * np.exp(-((x - 20) ** 2 + (y - 15) ** 2) / 18) + rng.normal(size=(40, 60))


def test_axes_are_in_arcsec_about_the_middle(image, ax):
    assert plot_image(image, ax=ax, pixel_scale=0.11, colorbar="MJy/sr") is ax
    assert ax.images[0].get_extent() == pytest.approx([-3.3, 3.3, -2.2, 2.2])
    other = Figure().subplots()
    kind = {"center": (20, 15), "stretch": "linear", "limits": (-1.0, 4.0)}
    plot_image(image, ax=other, pixel_scale=0.11, **kind)
    norm = other.images[0].norm
    assert (type(norm), norm.vmin, norm.vmax) == (Normalize, -1.0, 4.0)
    # pixel (20, 15) is the origin
    left, _, bottom, _ = other.images[0].get_extent()
    assert left == pytest.approx(-20.5 * 0.11)
    assert bottom == pytest.approx(-15.5 * 0.11)
    refuses("'stretch' must be 'asinh' or 'linear'", plot_image, image, ax=other, stretch="log")


def test_an_image_is_drawn_as_it_is(image, ax):
    plot_image(image, ax=ax, title="F770W", colorbar="MJy/sr", cmap="magma", softening=3.0)
    (drawn,) = ax.images
    assert_array_equal(drawn.get_array(), image)
    assert drawn.origin == "lower"
    assert drawn.get_cmap().name == "magma"
    assert isinstance(drawn.norm, AsinhNorm)
    assert drawn.norm.linear_width == 3.0
    # of unit noise: two sigma below the sky, and what is bright
    assert drawn.norm.vmin == pytest.approx(-2.0, abs=0.4)
    assert drawn.norm.vmax == pytest.approx(np.percentile(image, 99.7))
    assert ax.get_title() == "F770W"


def test_an_empty_field_is_stretched_to_eight_sigma(ax):
    plot_image(np.random.default_rng(1).normal(3.0, 0.5, (200, 200)), ax=ax)
    assert ax.images[0].norm.vmax == pytest.approx(3.0 + 8 * 0.5, rel=0.02)


@pytest.mark.parametrize("top", [2.0, 160.0, 0.0123])
def test_ticks_of_a_color_bar_stand_apart_and_are_plain_numbers(image, ax, top):
    drawn = ax.imshow(image, norm=AsinhNorm(0.05 * top, vmin=-0.1 * top, vmax=top))
    bar = add_colorbar(drawn, "flux")
    places = np.sort([drawn.norm(tick) for tick in bar.get_ticks()])
    assert np.diff(places).min() > 0.08
    texts = [text.get_text() for text in bar.ax.get_yticklabels()]
    assert_allclose(np.array(texts, float), bar.get_ticks(), rtol=0.05)
    assert not any("e" in text for text in texts)


def test_constant_and_empty_images_draw(ax):
    plot_image(np.zeros((5, 5)), ax=ax)
    plot_image(np.full((5, 5), np.nan), ax=ax)


def test_residual_is_image_minus_model(image):
    axes = plot_model_residual(image, image - 1.0, unit="MJy/sr")
    # pyplot's, which a session shows
    assert plt.gcf() is axes[0].figure
    plt.close()
    assert len(axes) == 3
    assert np.allclose(axes[2].images[0].get_array(), 1.0)
    other = Figure().subplots(1, 3)
    norm = plot_model_residual(image, image + 3.0, ax=other)[2].images[0].norm
    assert norm.vmin == -norm.vmax
    assert axes[0].images[0].norm.vmax == axes[1].images[0].norm.vmax
    refuses("'ax' must be three axes", plot_model_residual, image, image, ax=[axes[0]])


def test_color_shows_where_the_light_is_red(image):
    dark = np.random.default_rng(1).normal(size=image.shape)
    rgb = color_image(image, dark, dark)
    assert rgb.shape == (40, 60, 3)
    assert rgb.dtype == np.uint8
    assert rgb[15, 20, 0] > 4 * rgb[15, 20, 2]
    axes = plot_color(image, dark, dark, ax=Figure().subplots())
    assert axes.images[0].get_array().shape == (40, 60, 3)
    # a pixel needs all three
    holed = image.copy()
    holed[3, 4] = np.nan
    assert (color_image(dark, holed, dark)[3, 4] == 0).all()
    refuses("must be of one shape", color_image, image, dark, dark[:5])


def test_marks_have_their_length_and_direction(image, ax):
    plot_image(image, ax=ax, pixel_scale=0.5)
    # north along x, east along y: rolled by 90 degrees
    mark_sky(ax, 10, north=(2, 0), east=(0, 3))
    x = ax.lines[0].get_xdata()
    assert x[1] - x[0] == pytest.approx(10)
    places = {text.get_text(): np.array(text.get_position()) for text in ax.texts}
    assert places['10"'][0] == pytest.approx(np.mean(x))
    step = places["N"] - places["E"]
    assert step[0] > 0
    assert step[1] < 0
    assert len(ax.get_xticks()) == 0


def test_outlines_enclose_their_segments(image, ax):
    labels = np.zeros((40, 60), int)
    labels[10:20, 15:25] = 1
    plot_segmentation(image, labels, ax=ax, pixel_scale=0.5)
    lines = np.array(ax.collections[0].get_segments())
    # a square of 10 pixels: 40 edges of half an arcsec
    assert lines.shape == (40, 2, 2)
    assert np.ptp(lines[..., 0]) == pytest.approx(5.0)
    assert lines[..., 1].min() == pytest.approx((10 - 20) * 0.5)


class Field:
    """A map of offsets that grow along x, arcsec."""

    shape = (60, 120)

    def __call__(self, x, y):
        return np.stack([0.01 + 1e-4 * np.asarray(x), np.full(np.shape(x), -0.02)], axis=-1)


def test_offsets_are_arrows_over_those_of_the_map(ax):
    xy, offset = [[10.0, 20.0], [50.0, 30.0], [70.0, 40.0]], [[0.01, 0.0], [0.0, 0.02], [9.0, 9.0]]
    assert plot_offsets(xy, offset, Field(), used=[True, True, False], ax=ax, title="map") is ax
    smooth, arrows = ax.collections
    assert_allclose(smooth.U, 0.01 + 1e-4 * smooth.X)
    assert_allclose(smooth.V, -0.02)
    # every tenth pixel of the longer side
    assert np.diff(np.unique(smooth.X)) == pytest.approx(10.0)
    assert_allclose(arrows.get_offsets(), xy[:2])
    assert_allclose(np.transpose([arrows.U, arrows.V]), offset[:2])
    # one scale for both
    assert arrows.scale == smooth.scale
    assert_allclose(line_data(ax, "x"), [xy[2:]])
    assert (ax.get_xlim(), ax.get_ylim()) == ((-0.5, 119.5), (-0.5, 59.5))
    (key,) = ax.artists
    assert key.text.get_text() == f"{1e3 * key.U:.0f} mas"
    # its arrow is as long as the map's step
    assert key.U / arrows.scale == pytest.approx(10.0)


def test_segments_must_be_of_the_images_pixels(image, ax):
    with pytest.raises(ValueError, match=r"'labels' must be of the image's shape \(40, 60\)"):
        plot_segmentation(image, np.zeros((4, 5), int), ax=ax)


def test_touching_segments_have_a_border_between_them(ax):
    labels = np.zeros((4, 6), int)
    labels[1:3, 1:3], labels[1:3, 3:5] = 1, 2
    plot_segmentation(np.zeros((4, 6)), labels, ax=ax, center=(0.0, 0.0))
    lines = {tuple(map(tuple, line)) for line in ax.collections[0].get_segments()}
    assert len(lines) == 4 + 8 + 2
    assert ((2.5, 0.5), (2.5, 1.5)) in lines


def test_all_images_have_one_stretch():
    """Matplotlib has the same; that of astropy is linear about the lower limit, not about 0."""
    values = np.linspace(-3.0, 40.0, 50)
    places = asinh_places(values, -3.0, 40.0, 2.0)
    assert_allclose(asinh_norm(-3.0, 40.0, 2.0)(values).filled(), places, atol=1e-12)
    assert_allclose(places[[0, -1]], [0.0, 1.0], atol=1e-12)
    # between these limits symmetric about 0
    assert_allclose(
        asinh_places([-1.0, 0.0, 1.0], -3.0, 3.0, 2.0),
        0.5 + np.array([-1, 0, 1]) * (0.5 * np.arcsinh(0.5) / np.arcsinh(1.5)),
    )


def test_a_color_bar_is_as_high_as_its_image():
    figure, axes = new_figure()
    drawn = axes[0, 0].imshow(np.arange(40.0).reshape(4, 10))
    bar = add_colorbar(drawn, "flux")
    figure.draw_without_rendering()
    of_image = drawn.axes.get_window_extent()
    of_bar = bar.ax.get_window_extent()
    assert_allclose([of_bar.y0, of_bar.y1], [of_image.y0, of_image.y1], atol=1.0)
