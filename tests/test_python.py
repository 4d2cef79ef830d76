"""Names at the top of the package: what `dir` shows, and arguments that are wrong."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from conftest import refusal

import caryatid as ct
from caryatid.manipulation.order import plan_order

N3 = np.zeros((20, 3))
NO_RNG = {"config": ct.Config().fit, "rng": 0}


def test_dir_shows_the_public_names_alone():
    assert set(dir(ct)) == {"__version__", *ct.__all__}


def test_own_images_and_poses_give_a_graph_and_the_next_view():
    first, *others = ct.read_recording("sample-recording")
    scene = ct.Scene()
    masks = np.stack([first.labels == k for k in np.unique(first.labels) if k > 0])
    scene.update(ct.View(depth=first.depth, K=first.K, T_world_camera=first.pose, labels=masks))
    chosen = ct.next_best_view(scene, candidates=[view.pose for view in others])
    np.testing.assert_array_equal(chosen.T_world_camera, others[chosen.index].pose)
    # Of all these views the one from the other side shows most.
    assert chosen.T_world_camera[0, 3] * first.pose[0, 3] < 0.0
    mesh = scene.graph["o1"].shape.to_trimesh()
    assert isinstance(mesh, trimesh.Trimesh)
    np.testing.assert_allclose(mesh.centroid, scene.graph["o1"].centre_world, atol=1e-6)


@pytest.fixture(scope="module")
def table():
    return ct.simulate("tower", noise="none")


@pytest.mark.parametrize(
    ("named", "call"),
    [
        ("depth", lambda v, _: ct.View("image.png", v.K)),
        ("K", lambda v, _: ct.View(v.depth, "pinhole")),
        ("T_world_camera", lambda v, _: ct.View(v.depth, v.K, "left")),
        ("rgb", lambda v, _: ct.View(v.depth, v.K, rgb=v.rgb / 255.0)),
        ("labels", lambda v, _: ct.View(v.depth, v.K, labels=v.depth)),
        ("labels_are", lambda v, _: ct.View(v.depth, v.K, labels_are="things")),
        ("ignored", lambda v, _: ct.View(v.depth, v.K, ignored="arm.png")),
        ("points_world", lambda *_: ct.Cloud(None, N3)),
        ("normals_world", lambda *_: ct.Cloud(N3, N3[:5])),
        ("labels", lambda *_: ct.Cloud(N3, N3, labels=N3)),
        ("config", lambda *_: ct.Scene({"fit": {}})),
        ("segmentation", lambda *_: ct.Scene(segmentation="sam")),
        ("seed", lambda *_: ct.Scene(seed=-1)),
        ("source", lambda v, _: ct.Scene().update(v.depth)),
        ("camera", lambda _, table: next(ct.explore(table.robot, table.camera))),
        ("robot", lambda _, table: next(ct.explore(table.camera, "humanoid"))),
        ("planner", lambda _, table: next(ct.explore(table.camera, table.robot, planner=3))),
        ("until", lambda _, table: next(ct.explore(table.camera, table.robot, until="sure"))),
        ("scene", lambda *_: ct.simulate(3)),
        ("noise", lambda *_: ct.simulate("tower", noise="kinect")),
        ("robot", lambda *_: ct.simulate("tower", robot=3)),
        ("folder", lambda *_: ct.read_recording(None)),
        ("points", lambda *_: ct.fit(N3[:, :2], N3, **NO_RNG | {"rng": np.random.default_rng(0)})),
        ("rng", lambda *_: ct.fit(N3, N3, **NO_RNG)),
        ("T_world_object", lambda *_: ct.Sphere(np.eye(3), 0.1)),
        ("extents", lambda *_: ct.Box(np.eye(4), [0.1, 0.1])),
        ("extents", lambda *_: ct.Box(np.eye(4), [1.0, 2.0, -1.0])),
        ("extents", lambda *_: ct.Box(np.eye(4), [1.0, 2.0, np.nan])),
        ("radius", lambda *_: ct.Sphere(np.eye(4), 0.0)),
        ("height", lambda *_: ct.Cylinder(np.eye(4), 0.1, np.inf)),
        ("graph", lambda *_: plan_order(ct.Scene())),
    ],
)
def test_a_wrong_argument_is_named(named, call, views, table):
    with refusal(named):
        call(views[0], table)
