"""Frames over time: what is asked between any two of them is what was said, interpolated or refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from synthetic import random_motion

from caryatid.geometry import transforms
from caryatid.io.video import SECOND, TransformTree

NOW = 1_700_000_000 * SECOND
"""Large enough that a float would lose the nanoseconds."""


def tree_with(*links, gap=1.0):
    tree = TransformTree(gap)
    for parent, child, time, pose, *fixed in links:
        numbers = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
        tree.add(parent, child, time, numbers, fixed=bool(fixed))
    return tree


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_chains_up_and_down_the_tree_multiply(seed):
    rng = np.random.default_rng(seed)
    A, B, C, D = (random_motion(rng) for _ in range(4))
    links = ("map", "odom", NOW, A), ("odom", "base", NOW, B), ("odom", "hand", NOW, D)
    tree = tree_with(*links, ("base", "eye", 0, C, True))
    assert np.allclose(tree.between("map", "eye", NOW), A @ B @ C)
    assert np.allclose(tree.between("eye", "map", NOW), np.linalg.inv(A @ B @ C))
    assert np.allclose(tree.between("hand", "eye", NOW), np.linalg.inv(D) @ B @ C)
    assert np.allclose(tree.between("odom", "odom", NOW), np.eye(4))


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 1.0))
@settings(max_examples=30, deadline=None)
def test_between_two_poses_the_path_is_straight_and_the_turn_even(seed, share):
    rng = np.random.default_rng(seed)
    start = random_motion(rng)
    axis, angle, way = transforms.unit(rng.normal(size=3)), rng.uniform(0.0, 3.0), rng.normal(size=3)

    def after(part):
        R = start[:3, :3] @ transforms.rotation_from_vector(part * angle * axis)
        return transforms.rigid(R, start[:3, 3] + part * way)

    tree = tree_with(("map", "eye", NOW, start), ("map", "eye", NOW + SECOND // 2, after(1.0)))
    nanoseconds = round(share * (SECOND // 2))
    exact = after(nanoseconds / (SECOND // 2))
    assert np.allclose(tree.between("map", "eye", NOW + nanoseconds), exact, atol=1e-7)


def test_poses_may_come_in_any_order_and_the_last_of_a_time_counts():
    rng = np.random.default_rng(0)
    first, last, other = (random_motion(rng) for _ in range(3))
    tree = tree_with(
        ("map", "eye", NOW + SECOND, last), ("map", "eye", NOW, other), ("map", "eye", NOW, first)
    )
    assert np.allclose(tree.between("map", "eye", NOW), first)
    assert np.allclose(tree.between("map", "eye", NOW + SECOND), last)


@pytest.mark.parametrize("late", [-1, SECOND + 1, 3 * SECOND])
def test_no_pose_is_invented_outside_the_messages_or_across_a_gap(late):
    rng = np.random.default_rng(1)
    links = [("map", "eye", NOW + k * SECOND, random_motion(rng)) for k in (0, 1)]
    assert tree_with(*links).between("map", "eye", NOW + late) is None
    assert tree_with(*links, gap=1.0).between("map", "eye", NOW + SECOND // 2).shape == (4, 4)
    assert tree_with(*links, gap=0.9).between("map", "eye", NOW + SECOND // 2) is None


def test_a_frame_that_changes_its_parent_has_no_pose_in_between():
    rng = np.random.default_rng(3)
    tree = tree_with(
        ("map", "cup", NOW, random_motion(rng)), ("hand", "cup", NOW + SECOND, random_motion(rng))
    )
    assert tree.between("map", "cup", NOW).shape == (4, 4)
    for target in ("map", "hand"):
        assert tree.between(target, "cup", NOW + 1) is None


def test_frames_in_a_circle_and_frames_apart_are_refused():
    tree = tree_with(("a", "b", NOW, np.eye(4)), ("b", "a", NOW, np.eye(4)), ("c", "d", NOW, np.eye(4)))
    for target in ("c", "nowhere"):
        assert tree.between(target, "a", NOW) is None
    assert tree.frames == ["a", "b", "c", "d"]
