"""Which points are one object, over several views, and what shape a scene gives it."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from raycast import TABLE, from_the_side, table_scene
from scipy import ndimage
from synthetic import SENSOR, box, cylinder, look_from, model_of, sphere, surface_points

from caryatid.config import FitConfig, VoxelConfig
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box
from caryatid.objects import solids
from caryatid.sensing.views import Cloud
from caryatid.sensing.voxel_map import FREE, UNKNOWN
from caryatid.simulation import generation
from caryatid.simulation.camera import SimulatedCamera
from caryatid.simulation.world import Body, build_spec, scene_from_spec

CRATE = (np.array([0.0, 0.0, TABLE + 0.05]), np.array([0.16, 0.12, 0.1]))
POST = (np.array([0.17, 0.0, TABLE + 0.15]), np.array([0.03, 0.03, 0.3]))
EYE = np.array([-1.2, -0.6, TABLE + 1.0])
STACKED = (box((0.0, 0.0, 0.05), (0.16, 0.12, 0.1)), box((0.03, 0.0, 0.15), (0.06, 0.06, 0.1)))
BESIDE = (box((0.0, -0.06, 0.05), (0.1, 0.12, 0.1)), box((0.0, 0.04, 0.1), (0.1, 0.08, 0.2)))
BRIDGE = (
    *(box((0.0, y, 0.05), (0.06, 0.06, 0.1)) for y in (-0.09, 0.09)),
    box((0.0, 0.0, 0.115), (0.06, 0.26, 0.03)),
)
CAN_ON_BOX = (box((0.0, 0.0, 0.04), (0.14, 0.14, 0.08)), cylinder((0.0, 0.0, 0.14), 0.03, 0.12))


def objects_of(scene):
    return [o for o in scene.graph.objects if o.role == "object"]


def cloud_of(shapes, sigma):
    """What an eye sees of shapes that stand on the table, and which points are of which."""
    rng, on_table = np.random.default_rng(0), transforms.rigid(np.eye(3), (0.0, 0.0, TABLE))
    shapes = [shape.moved(on_table) for shape in shapes]
    parts = [surface_points(shape, rng, eye=EYE, spacing=0.006, sigma=sigma) for shape in shapes]
    top = surface_points(box((0.0, 0.0, TABLE - 0.02), (0.7, 1.0, 0.04)), rng, spacing=0.01, sigma=sigma)
    free = top[1][:, 2] > 0.9
    for shape in shapes:
        free &= shape.signed_distance(top[0]) > 0.01
    points, normals = (np.concatenate([p[k] for p in (*parts, (top[0][free], top[1][free]))]) for k in (0, 1))
    truth = np.repeat(np.arange(1, len(parts) + 2), [*(len(p) for p, _ in parts), np.count_nonzero(free)])
    return Cloud(points, normals, viewpoint_world=EYE), truth


@pytest.mark.parametrize("sigma", [0.0005, 0.002])
@pytest.mark.parametrize(
    "shapes",
    [
        STACKED,
        BESIDE,
        CAN_ON_BOX,
        BRIDGE,
        STACKED[:1],
        (cylinder((0.0, 0.0, 0.06), 0.04, 0.12),),
        (sphere((0.0, 0.0, 0.05), 0.05),),
    ],
    ids=["stacked", "beside", "can on box", "bridge", "box", "cylinder", "sphere"],
)
def test_shapes_are_parted_where_they_meet_and_nowhere_else(shapes, sigma):
    cloud, truth = cloud_of(shapes, sigma)
    scene = model_of([cloud], segmentation="auto")
    assert len(objects_of(scene)) == len(shapes)
    own = [np.bincount(scene.labels[truth == k]).argmax() for k in range(1, len(shapes) + 1)]
    assert sorted(own) == sorted(o.label for o in objects_of(scene))
    assert np.mean([(scene.labels[truth == k] == label).mean() for k, label in enumerate(own, 1)]) > 0.85


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("spread", list(product((0.0, 0.05), repeat=3)))
@pytest.mark.parametrize("directions", ["up", "none", "any way"])
@pytest.mark.parametrize("segmentation", ["labels", "auto"])
def test_points_that_determine_no_shape_do_no_harm(spread, directions, segmentation):
    """On a spot, a line or a plane."""
    table, _ = cloud_of((), 0.001)
    places = np.random.default_rng(0).uniform(-1.0, 1.0, (60, 3)) * spread + (0.0, 0.0, TABLE + 0.08)
    points = np.concatenate([table.points_world, places])
    own = {"up": np.tile((0.0, 0.0, 1.0), (60, 1)), "none": np.zeros((60, 3))}
    own["any way"] = transforms.unit(np.random.default_rng(1).normal(size=(60, 3)))
    normals = np.concatenate([table.normals_world, own[directions]])
    labels = np.repeat(np.int32([0, 1]), [len(table), 60])
    scene = model_of([Cloud(points, normals, labels)], segmentation=segmentation)
    for o in scene.graph.objects:
        assert np.isfinite(o.shape.T_world_object).all()
        assert (o.shape.extents > 0.0).all()


def test_what_something_in_front_cuts_in_two_is_one_object():
    views = [
        table_scene(from_the_side(a, 25.0, 1.1), [CRATE, POST], sigma=0.001).every(2) for a in (0.0, 60.0)
    ]
    _, pieces = ndimage.label(views[0].labels == 1)
    assert pieces == 2
    posts_and_crates = objects_of(model_of(views, segmentation="auto"))
    assert len(posts_and_crates) == 2
    crate = min(posts_and_crates, key=lambda o: abs(o.centre_world[0])).shape
    assert np.sort(crate.extents) == pytest.approx((0.1, 0.12, 0.16), abs=0.005)


@pytest.mark.parametrize(("height", "kind"), [(0.0, "solid"), (0.08, "sphere")])
def test_a_shape_that_the_table_would_fill_is_not_taken(height, kind):
    """The upper half of a ball is a dome."""
    ball = np.array([0.0, 0.0, TABLE + height]), 0.08
    views = [table_scene(from_the_side(a), spheres=[ball], sigma=0.0005).every(2) for a in (20.0, 140.0)]
    (found,) = objects_of(model_of(views))
    assert found.shape.kind == kind


@pytest.mark.parametrize("make", ["tray", "bowl", "mug", "bottle"])
def test_household_things_are_seen_in_their_shape_and_hollow_ones_hollow(make):
    truth = getattr(generation, make)(np.random.default_rng(1))
    truth = truth.moved(transforms.rigid(np.eye(3), (0.0, 0.0, TABLE)))
    scene = scene_from_spec(build_spec([Body(truth)], "test"), "test", "test")
    camera = SimulatedCamera(scene, sensor=SENSOR)
    views = [camera.capture(look_from(azimuth, 55.0, 1.0)) for azimuth in (0.0, 120.0, 240.0)]
    (found,) = objects_of(model_of([replace(view, normals_camera=None) for view in views]))
    low, high = (sign * truth.support(sign * np.eye(3)) + truth.T_world_object[:3, 3] for sign in (-1.0, 1.0))
    points = np.random.default_rng(0).uniform(low, high, (4000, 3))
    true, own = (shape.signed_distance(points) for shape in (truth, found.shape))
    assert (own[true > 0.006] > 0.0).mean() > 0.95
    assert (own[true < 0.0] < 0.004).mean() > 0.8


def test_a_cavity_that_would_leave_nothing_of_an_object_is_none(monkeypatch):
    crate = Box(np.eye(4), np.array([0.2, 0.15, 0.1]))
    points, normals = crate.surface(0.004)
    voxels = SimpleNamespace(
        config=VoxelConfig(size=0.01),
        state_at=lambda p: np.where(crate.signed_distance(p) < 0.0, FREE, UNKNOWN),
    )
    evidence = SimpleNamespace(points=points, normals=-normals, noise=1e-4, voxels=voxels)
    monkeypatch.setattr(solids, "_cavity", lambda *_: [(np.array([0.0, 0.0, 1.0]), -1.0)])
    found = solids._solid(points, -normals, points[:0], evidence, FitConfig())
    assert found.volume == pytest.approx(crate.volume, rel=0.1)
