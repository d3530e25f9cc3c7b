"""Matrices move points where geometry says."""

from __future__ import annotations

import numpy as np
import pytest

from psf_cl.scene.transform import (
    look_at,
    rotation_quaternion,
    rotation_xyz_degrees,
    scaling,
    transform_points,
    translation,
    without_scale,
)


def test_points_are_scaled_then_moved_when_composed_from_the_right() -> None:
    matrix = translation([1, 2, 3]) @ scaling([2, 3, -4])
    np.testing.assert_array_equal(transform_points(matrix, np.array([[1, 1, 1]])), [[3, 5, -1]])
    np.testing.assert_array_equal(scaling(2.0), np.diag([2, 2, 2, 1]))


@pytest.mark.parametrize(
    ("angles", "point", "moved"),
    [
        ([90, 0, 0], [0, 1, 0], [0, 0, 1]),
        ([0, 90, 0], [0, 0, 1], [1, 0, 0]),
        ([0, 0, 90], [1, 0, 0], [0, 1, 0]),
        ([90, 0, 90], [0, 1, 0], [0, 0, 1]),  # X first: then Z leaves it alone
        ([90, 90, 0], [0, 1, 0], [1, 0, 0]),
    ],
)
def test_rotation_turns_counter_clockwise_about_x_then_y_then_z(
    angles: list[float], point: list[float], moved: list[float]
) -> None:
    turned = transform_points(rotation_xyz_degrees(angles), np.array([point]))
    np.testing.assert_allclose(turned, [moved], atol=1e-15)


def test_a_quaternion_turns_by_twice_its_angle_whatever_its_length() -> None:
    half = np.radians(35.0) / 2.0
    for length in (1e-200, 1.0, 1e200):
        quaternion = length * np.array([0.0, np.sin(half), 0.0, np.cos(half)])
        np.testing.assert_allclose(
            rotation_quaternion(quaternion), rotation_xyz_degrees([0, 35, 0]), atol=1e-14
        )


@pytest.mark.parametrize("quaternion", [[0, 0, 0, 0], [0, 0, 0, np.nan], [np.inf, 0, 0, 1]])
def test_a_quaternion_without_direction_is_refused(quaternion: list[float]) -> None:
    with pytest.raises(ValueError, match="quaternion"):
        rotation_quaternion(quaternion)


def test_look_at_sends_minus_z_to_the_target_and_keeps_up_in_the_picture() -> None:
    position, target = np.array([1.0, 2.0, 3.0]), np.array([4.0, 2.0, -1.0])
    matrix = look_at(position, target, [0, 1, 0])
    moved = transform_points(matrix, np.array([[0, 0, 0], [0, 0, -5.0], [0, 2.0, 0]]))
    np.testing.assert_allclose(moved, [position, target, [1, 4, 3]], atol=1e-14)
    assert np.linalg.det(matrix) == pytest.approx(1.0)


def test_look_at_is_exact_far_from_the_origin() -> None:
    position = np.array([1e9, 0.0, 0.0])
    matrix = look_at(position, position - np.array([0, 0, 1]), [0, 1, 0])
    np.testing.assert_array_equal(matrix, translation(position))


@pytest.mark.parametrize(
    ("target", "up"), [([0, 0, 0], [0, 1, 0]), ([0, 1, 0], [0, 2, 0]), ([0, 0, 1], [0, 0, 0])]
)
def test_a_view_without_direction_is_refused(target: list[float], up: list[float]) -> None:
    with pytest.raises(ValueError, match="must"):
        look_at([0, 0, 0], target, up)


def test_without_scale_keeps_view_up_and_place_of_a_scaled_mirrored_frame() -> None:
    rigid = translation([1, 2, 3]) @ rotation_xyz_degrees([10, 20, 30])
    np.testing.assert_allclose(without_scale(rigid @ scaling([-2, 3, 1e-6])), rigid, atol=1e-9)
    with pytest.raises(ValueError, match="must"):
        without_scale(scaling([1, 1, 0]))
