"""Clouds in the frames that others store them in: of the sensor, of the world, of several sensors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from raycast import TABLE, from_the_side, table_scene

from caryatid.config import Config
from caryatid.errors import InputError, NoSurfaceError
from caryatid.geometry import transforms
from caryatid.io.cloud_frames import level_cloud
from caryatid.io.point_clouds import StoredCloud
from caryatid.scene import Scene

BOXES = [(np.array([0.0, 0.1, TABLE + 0.05]), np.array([0.2, 0.16, 0.1]))]
BOXES += [(np.array([0.02, 0.1, TABLE + 0.13]), np.array([0.09, 0.08, 0.06]))]
T = from_the_side(130.0)


def stored_views(poses, has_floor=True):
    """Points in the world, as each camera sees them, and normals towards it."""
    points, normals = [], []
    for pose in poses:
        view = table_scene(pose, BOXES, sigma=0.0005).every(3)
        seen = transforms.transform(pose, view.points_camera[view.valid])
        seen = seen if has_floor else seen[seen[:, 2] > 0.4]
        stored = StoredCloud(
            transforms.transform(transforms.invert(pose), seen), None, None, None, np.eye(4), ""
        )
        normals.append(transforms.rotate(pose, stored.to_cloud(Config().cloud, np.eye(4)).normals_world))
        points.append(seen)
    return np.concatenate(points), np.concatenate(normals)


def find_stack(stored):
    """What supports what, and the height of the lower box."""
    scene = Scene(seed=0)
    graph = scene.update(level_cloud(stored, Config(), np.random.default_rng(0)))
    (table, low), (lower, upper) = sorted((s.supporter, s.supported) for s in graph.supports)
    assert (table, low) == ("o0", lower)
    assert len(graph.objects) == 3
    return sorted(graph[low].shape.extents), upper


@pytest.mark.parametrize("has_floor", [True, False])
def test_one_view_gives_the_same_graph_in_each_frame(has_floor):
    world, _ = stored_views([T], has_floor)
    camera = transforms.transform(transforms.invert(T), world)
    for points, pose in ((camera, np.eye(4)), (camera, T), (world, T)):
        extents, _ = find_stack(StoredCloud(points, None, None, None, pose, "cloud.pcd"))
        np.testing.assert_allclose(extents, (0.1, 0.16, 0.2), atol=0.01)


@pytest.mark.parametrize("has_floor", [True, False])
def test_several_views_need_normals_and_are_z_up(has_floor):
    world, normals = stored_views([from_the_side(a, 42.0) for a in (10.0, 130.0, 250.0)], has_floor)
    for shift in (0.0, TABLE, TABLE + 0.7):  # the origin is below, on and above the table
        points = world - (0.0, 0.0, shift)
        stored = StoredCloud(points, normals, None, None, np.eye(4), "cloud.ply")
        np.testing.assert_allclose(find_stack(stored)[0], (0.1, 0.16, 0.2), atol=0.01)
    with pytest.raises(NoSurfaceError, match=r"seen from several places; if they were, save normals"):
        level_cloud(replace(stored, points=world - (0.3, 0.2, TABLE + 0.05), normals=None), Config(), None)


def test_clouds_that_are_not_in_metres_are_refused():
    world, _ = stored_views([T])
    for scale in (100.0, 1000.0):
        with pytest.raises(InputError, match="its unit seems to be millimetres or centimetres"):
            level_cloud(StoredCloud(scale * world, None, None, None, np.eye(4), "a.ply"), Config(), None)
