import numpy as np
import pytest
from numpy.testing import assert_allclose

from miricigale.profiles import ellipse_to_pixels


def through(jacobian, *, direction, **ellipse):
    """An ellipse whose major axis lies in a direction from +x toward +y."""
    return ellipse_to_pixels(jacobian, position_angle=np.pi / 2 - direction, **ellipse)


def rotation(angle):
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def test_rotation():
    radius, ratio, theta = through(rotation(0.4), radius=3.0, axis_ratio=0.2, direction=0.3)
    assert (radius, ratio, theta) == pytest.approx((3.0, 0.2, 0.7))


def test_area_scales_with_the_determinant():
    jacobian = np.array([[1.2, 0.3], [-0.1, -0.8]])
    radius, ratio, _ = through(jacobian, radius=2.0, axis_ratio=0.5, direction=1.0)
    assert radius**2 * ratio == pytest.approx(4 * 0.5 * abs(np.linalg.det(jacobian)))


def test_points_of_the_ellipse_stay_on_it():
    jacobian = np.array([[0.9, 0.4], [0.2, -1.3]])
    t = np.linspace(0, 2 * np.pi, 50)
    moved = jacobian @ rotation(0.7) @ [2 * np.cos(t), 0.6 * np.sin(t)]
    radius, ratio, theta = through(jacobian, radius=2.0, axis_ratio=0.3, direction=0.7)
    along, across = rotation(-theta) @ moved
    assert_allclose(np.hypot(along, across / ratio), radius, rtol=1e-12)


def test_position_angle_on_a_north_up_image():
    # east is left: a galaxy at position angle 30 deg leans to the left of +y
    radius, ratio, theta = ellipse_to_pixels(
        np.diag([-10.0, 10.0]), radius=0.5, axis_ratio=0.5, position_angle=np.radians(30)
    )
    assert (radius, ratio) == (pytest.approx(5), pytest.approx(0.5))
    assert np.degrees(theta) % 180 == pytest.approx(120)
