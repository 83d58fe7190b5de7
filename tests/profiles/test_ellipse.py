import numpy as np
import pytest
from numpy.testing import assert_allclose

from miricigale.profiles import ellipse_to_pixels


def through(jacobian, *, direction, **ellipse):
    """An ellipse whose major axis lies in a direction from +x toward +y."""
    return ellipse_to_pixels(jacobian, position_angle=np.pi / 2 - direction, **ellipse)


def test_identity_and_rotation():
    turn = np.radians(25)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    radius, ratio, theta = through(rotation, radius=3.0, axis_ratio=0.2, direction=0.3)
    assert (radius, ratio) == (pytest.approx(3), pytest.approx(0.2))
    assert theta == pytest.approx(0.3 + turn)


def test_area_scales_with_the_determinant():
    jacobian = np.array([[1.2, 0.3], [-0.1, -0.8]])
    radius, ratio, _ = through(jacobian, radius=2.0, axis_ratio=0.5, direction=1.0)
    assert radius**2 * ratio == pytest.approx(4 * 0.5 * abs(np.linalg.det(jacobian)))


def test_points_of_the_ellipse_stay_on_it():
    jacobian = np.array([[0.9, 0.4], [0.2, -1.3]])
    t = np.linspace(0, 2 * np.pi, 50)
    major, minor = (
        2 * np.array([np.cos(0.7), np.sin(0.7)]),
        0.6 * np.array([-np.sin(0.7), np.cos(0.7)]),
    )
    moved = jacobian @ (np.outer(major, np.cos(t)) + np.outer(minor, np.sin(t)))
    radius, ratio, theta = through(jacobian, radius=2.0, axis_ratio=0.3, direction=0.7)
    along = moved[0] * np.cos(theta) + moved[1] * np.sin(theta)
    across = -moved[0] * np.sin(theta) + moved[1] * np.cos(theta)
    assert_allclose(np.hypot(along, across / ratio), radius, rtol=1e-12)


def test_position_angle_on_a_north_up_image():
    # east is left: a galaxy at position angle 30 deg leans to the left of +y
    radius, ratio, theta = ellipse_to_pixels(
        np.diag([-10.0, 10.0]), radius=0.5, axis_ratio=0.5, position_angle=np.radians(30)
    )
    assert (radius, ratio) == (pytest.approx(5), pytest.approx(0.5))
    assert np.degrees(theta) % 180 == pytest.approx(120)
