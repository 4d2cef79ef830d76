from __future__ import annotations

import numpy as np
import pytest

from caryatid.errors import InputError
from caryatid.geometry import transforms


@pytest.fixture
def rng():
    return np.random.default_rng(3)


@pytest.fixture
def T_a_b(rng):
    return transforms.rigid(transforms.random_rotation(rng), rng.normal(size=3))


def test_a_rigid_transform_is_taken_as_it_is_also_from_lists(T_a_b):
    taken = transforms.as_rigid(T_a_b.tolist())
    assert taken.dtype == np.float64
    np.testing.assert_array_equal(taken, T_a_b)
    transforms.as_rigid(np.round(T_a_b, 6))  # A text file rounds.


def broken(change):
    T = np.eye(4)
    change(T)
    return T


@pytest.mark.parametrize(
    ("T", "reason"),
    [
        (np.eye(3), r"shape \(3, 3\)"),
        (broken(lambda T: T.__setitem__((0, 3), np.nan)), "NaN"),
        (broken(lambda T: T.__setitem__((0, 3), np.inf)), "infinity"),
        (broken(lambda T: T.__setitem__((3, 0), 0.1)), "last row"),
        (broken(lambda T: T.__setitem__((0, 0), 1.01)), "not a rotation"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "mirrored"),
        (np.zeros((4, 4)), "last row"),
    ],
)
def test_other_matrices_than_rigid_transforms_are_refused_by_name_and_reason(T, reason):
    with pytest.raises(InputError, match=reason) as caught:
        transforms.as_rigid(T, "frame 7")
    assert str(caught.value).startswith("frame 7: ")
    assert caught.value.remedy


def test_looking_at_a_point_puts_it_on_the_axis_with_up_upwards(rng):
    for _ in range(20):
        eye, target = rng.normal(size=(2, 3))
        T_world_camera = transforms.as_rigid(transforms.look_at(eye, target))
        target_camera = transforms.transform(transforms.invert(T_world_camera), target)
        np.testing.assert_allclose(target_camera, [0.0, 0.0, np.linalg.norm(target - eye)], atol=1e-12)
        np.testing.assert_allclose(T_world_camera[:3, 3], eye)
        up_camera = transforms.rotate(transforms.invert(T_world_camera), np.array([0.0, 0.0, 1.0]))
        assert abs(up_camera[0]) < 1e-12
        assert up_camera[1] < 0.0


@pytest.mark.parametrize("target", [(0.0, 0.0, -1.0), (0.0, 0.0, 1.0)])
def test_looking_straight_down_or_up_has_a_roll_all_the_same(target):
    T_world_camera = transforms.as_rigid(transforms.look_at((0.0, 0.0, 0.0), target))
    np.testing.assert_allclose(T_world_camera[:3, 2], target)
    np.testing.assert_allclose(-T_world_camera[:3, 1], (1.0, 0.0, 0.0), atol=1e-12)
    along_up = transforms.as_rigid(transforms.look_at((0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (1.0, 0.0, 0.0)))
    np.testing.assert_allclose(along_up[:3, 2], (1.0, 0.0, 0.0))
    with pytest.raises(InputError, match="same point"):
        transforms.look_at((1.0, 2.0, 3.0), (1.0, 2.0, 3.0))
