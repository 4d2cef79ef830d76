from __future__ import annotations

import numpy as np
import pytest

from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.sensing.views import SUPPORT_LABEL, Cloud, View

K = np.array([[500.0, 0.0, 2.0], [0.0, 400.0, 1.0], [0.0, 0.0, 1.0]])
DEPTH = np.linspace(0.5, 1.5, 20).reshape(4, 5)


def image(value: float, *at: int):
    changed = DEPTH.copy()
    changed[at] = value
    return changed


def test_missing_readings_are_zero_whether_given_as_zero_or_nan():
    given = image(np.nan, 0, 1)
    given[2, 3] = 0.0
    view = View(given, K)
    assert view.depth.dtype == np.float32
    assert view.depth[0, 1] == 0.0
    assert view.valid.sum() == 18
    assert np.isnan(given[0, 1]), "the depth handed in must stay as it was"


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"depth": np.ones(5)}, r"shape \(5,\)"),
        ({"depth": np.ones((0, 5))}, r"shape \(0, 5\)"),
        ({"depth": image(np.inf, 1, 1)}, "infinite"),
        ({"depth": image(-0.1, 1, 1)}, "negative"),
        ({"K": np.diag([0.0, 400.0, 1.0])}, "focal lengths 0, 400"),
        ({"K": np.diag([500.0, -1.0, 1.0])}, "focal lengths 500, -1"),
        ({"K": np.full((3, 3), np.nan)}, "finite 3×3"),
        ({"K": np.eye(4)}, "finite 3×3"),
        ({"T_world_camera": 2.0 * np.eye(4)}, "T_world_camera"),
        ({"rgb": np.zeros((5, 4, 3), dtype=np.uint8)}, "rgb is 4×5, depth is 5×4"),
        ({"labels": np.zeros((4, 4), dtype=np.int32)}, "labels is 4×4, depth is 5×4"),
        ({"normals_camera": np.zeros((3, 5, 3))}, "normals_camera is 5×3"),
        ({"labels": np.full((4, 5), -2)}, "labels exceed"),
        ({"labels": np.full((4, 5), SUPPORT_LABEL)}, "labels exceed"),
    ],
)
def test_a_view_that_makes_no_sense_is_refused_by_name_and_reason(fields, reason):
    with pytest.raises(InputError, match=reason) as caught:
        View(**{"depth": DEPTH, "K": K, "name": "frame 3", **fields})
    assert str(caught.value).startswith("frame 3")
    assert caught.value.remedy


def test_the_highest_label_below_the_support_surfaces_is_allowed_and_a_missing_pose_is_asked_for_by_name():
    view = View(DEPTH, K, labels=np.full((4, 5), SUPPORT_LABEL - 1, dtype=np.uint16), name="frame 3")
    assert view.labels.dtype == np.int32
    assert (view.labels == SUPPORT_LABEL - 1).all()
    with pytest.raises(InputError, match="frame 3: has no camera pose"):
        _ = view.pose


def test_points_are_picked_with_all_that_belongs_to_them():
    rng = np.random.default_rng(0)
    cloud = Cloud(
        rng.normal(size=(6, 3)),
        transforms.unit(rng.normal(size=(6, 3))),
        np.arange(6, dtype=np.int32),
        rng.integers(0, 255, (6, 3), dtype=np.uint8),
        np.array([0.0, 0.0, 1.0]),
        "heap",
    )
    odd = np.arange(6) % 2 == 1
    for picked in (cloud.select(odd), cloud.select(np.flatnonzero(odd))):
        assert len(picked) == 3
        for field in ("labels", "points_world", "normals_world", "rgb"):
            np.testing.assert_array_equal(getattr(picked, field), getattr(cloud, field)[odd])
        np.testing.assert_array_equal(picked.viewpoint_world, cloud.viewpoint_world)
        assert picked.name == "heap"
    bare = Cloud(cloud.points_world, cloud.normals_world).select(np.array([0, 2]))
    assert (len(bare), bare.labels, bare.rgb, bare.viewpoint_world) == (2, None, None, None)
