import numpy as np
import pytest
from matplotlib.figure import Figure

from miricigale.plotting.images import (
    color_image,
    mark_sky,
    plot_color,
    plot_image,
    plot_model_residual,
    plot_segmentation,
)


@pytest.fixture
def image():
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:40, :60]
    return 50 * np.exp(-((x - 20) ** 2 + (y - 15) ** 2) / 18) + rng.normal(size=(40, 60))


@pytest.fixture
def ax():
    return Figure().subplots()


def test_axes_are_in_arcsec_about_the_middle(image, ax):
    assert plot_image(image, ax=ax, pixel_scale=0.11, colorbar="MJy/sr") is ax
    assert ax.images[0].get_extent() == pytest.approx([-3.3, 3.3, -2.2, 2.2])
    other = Figure().subplots()
    plot_image(image, ax=other, pixel_scale=0.11, center=(20, 15), stretch="linear")
    # pixel (20, 15) is the origin
    left, _, bottom, _ = other.images[0].get_extent()
    assert left == pytest.approx(-20.5 * 0.11)
    assert bottom == pytest.approx(-15.5 * 0.11)
    with pytest.raises(ValueError, match="'stretch' must be 'asinh' or 'linear'"):
        plot_image(image, ax=other, stretch="log")


def test_constant_and_empty_images_draw(ax):
    plot_image(np.zeros((5, 5)), ax=ax)
    plot_image(np.full((5, 5), np.nan), ax=ax)


def test_residual_is_image_minus_model(image):
    axes = plot_model_residual(image, image - 1.0, unit="MJy/sr")
    assert len(axes) == 3
    assert np.allclose(axes[2].images[0].get_array(), 1.0)
    assert axes[0].images[0].norm.vmax == axes[1].images[0].norm.vmax
    with pytest.raises(ValueError, match="'ax' must be three axes"):
        plot_model_residual(image, image, ax=[axes[0]])


def test_colour_shows_where_the_light_is_red(image):
    dark = np.random.default_rng(1).normal(size=image.shape)
    rgb = color_image(image, dark, dark)
    assert rgb.shape == (40, 60, 3)
    assert rgb.dtype == np.uint8
    assert rgb[15, 20, 0] > 4 * rgb[15, 20, 2]
    axes = plot_color(image, dark, dark, ax=Figure().subplots())
    assert axes.images[0].get_array().shape == (40, 60, 3)
    with pytest.raises(ValueError, match="must be of one shape"):
        color_image(image, dark, dark[:5])


def test_colour_needs_all_three(image):
    dark = np.random.default_rng(1).normal(size=image.shape)
    holed = image.copy()
    holed[3, 4] = np.nan
    assert (color_image(dark, holed, dark)[3, 4] == 0).all()


def test_residuals_are_stretched_evenly(image):
    axes = plot_model_residual(image, image + 3.0)
    norm = axes[2].images[0].norm
    assert norm.vmin == -norm.vmax


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
