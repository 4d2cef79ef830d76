"""Frames over time: what is asked between any two of them is what was said, interpolated or refused."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic import random_motion

from caryatid.io.video import SECOND, TransformTree

NOW = 1_700_000_000 * SECOND
"""Large enough that a float would lose the nanoseconds."""


def tree_with(*links, gap=1.0):
    tree = TransformTree(gap)
    for parent, child, time, pose, *fixed in links:
        numbers = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
        tree.add(parent, child, time, numbers, fixed=bool(fixed))
    return tree


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
