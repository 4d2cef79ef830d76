"""A world that changes between views, by somebody's hand or the robot's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import (
    box,
    config_for,
    edges,
    look_from,
    model_of,
    simulated_scene,
    simulated_views,
    vertices,
)

from caryatid.config import Config, RegistrationConfig
from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.scene import Scene
from caryatid.simulation.camera import SimulatedCamera
from caryatid.simulation.world import posed, poses_of

ASIDE = transforms.rigid(np.eye(3), (0.0, 0.12, 0.0))


def views_of(state, azimuths, noise="none"):
    """Views of the tower in a state (5, 7) of its bodies: a stack of four, and a ball beside it."""
    scene = posed(simulated_scene("tower"), state)
    camera = SimulatedCamera(scene, noise, rng=np.random.default_rng(1))
    camera.capture(look_from(0.0))  # the pose of a first view is exact
    return [camera.capture(look_from(azimuth)) for azimuth in azimuths]


@pytest.fixture
def state():
    return poses_of(simulated_scene("tower")).copy()


@pytest.fixture
def scene():
    return model_of(simulated_views("tower"))


def kinds(scene):
    return [(change.kind, change.object_id) for change in scene.changes]


@pytest.mark.parametrize("method", ["pc", "sg", "pc+sg"])
def test_what_somebody_took_is_gone_with_the_next_view(method, state):
    scene = model_of(simulated_views("tower"), config_for(method))
    state[3, 2] += 50.0
    scene.update(*views_of(state, [50.0]))
    assert kinds(scene) == [("removed", "o4")]
    assert vertices(scene.graph) == {"o0", "o1", "o2", "o3", "o5"}
    assert edges(scene.graph) == {("o0", "o1"), ("o1", "o2"), ("o2", "o3"), ("o0", "o5")}


@pytest.mark.parametrize("segmentation", ["labels", "auto"])
def test_what_somebody_moved_keeps_its_name_and_its_size(segmentation, state):
    scene = model_of(views_of(state, [0.0, 120.0, 240.0], "carmine"), segmentation=segmentation)
    ball = min(scene.graph.objects[1:], key=lambda o: o.centre_world[0])
    state[4, 1] += 0.12
    for view in views_of(state, [50.0, 170.0], "carmine"):
        scene.update(view)
    assert kinds(scene) == [("moved", ball.id)]
    now = scene.graph[ball.id]
    np.testing.assert_allclose(now.centre_world - ball.centre_world, (0.0, 0.12, 0.0), atol=0.01)
    np.testing.assert_allclose(now.shape.extents, ball.shape.extents, atol=0.01)
    assert len(scene.graph.objects) == 6


def test_errors_of_poses_that_are_used_as_reported_are_no_changes():
    config = replace(Config(), registration=RegistrationConfig(enabled=False))
    scene = model_of(simulated_views("bridge", tuple(50.0 * k for k in range(10)), "carmine"), config)
    assert not scene.changes


@pytest.mark.parametrize("segmentation", ["labels", "auto"])
def test_what_somebody_put_down_is_new(segmentation, state):
    without = state.copy()
    without[4, 2] += 50.0
    scene = Scene(segmentation=segmentation)
    for view in views_of(without, [0.0, 120.0, 240.0]):
        scene.update(view)
    scene.update(*views_of(state, [200.0]))
    assert [change.kind for change in scene.changes] == ["added"]
    assert scene.graph[scene.changes[0].object_id].shape.kind == "sphere"


def test_an_object_without_readings_is_not_gone(scene, state):
    (view,) = views_of(state, [50.0])
    scene.update(replace(view, depth=np.where(view.labels == 5, 0.0, view.depth).astype(np.float32)))
    assert scene.changes == ()


def test_what_the_robot_does_is_known_without_a_look(scene):
    before = scene.graph
    scene.removed("o4")
    assert edges(scene.graph) == {("o0", "o1"), ("o1", "o2"), ("o2", "o3"), ("o0", "o5")}
    scene.moved("o5", ASIDE)
    travelled = scene.graph["o5"].centre_world - before["o5"].centre_world
    np.testing.assert_allclose(travelled, ASIDE[:3, 3], atol=1e-3)
    put = scene.added(box((-0.2, -0.2, 0.75 + 0.03), (0.06, 0.06, 0.06)))
    assert ("o0", put) in edges(scene.graph)
    assert kinds(scene) == [("removed", "o4"), ("moved", "o5"), ("added", put)]
    assert scene.added(before["o4"].shape, label=4) == "o4"
    assert ("o3", "o4") in edges(scene.graph)


def test_changes_that_the_robot_reported_hold_when_it_looks_again(scene, state):
    scene.removed("o4")
    scene.moved("o5", ASIDE)
    said = scene.graph
    state[3, 2] += 50.0
    state[4, 1] += 0.12
    for view in views_of(state, [50.0, 170.0], "carmine"):
        scene.update(view)
    assert len(scene.changes) == 2
    assert edges(scene.graph) == edges(said)


@pytest.mark.parametrize("method", ["pc", "sg", "pc+sg"])
def test_an_object_that_the_newest_view_did_not_show_can_be_moved_and_then_taken(method, scene, state):
    views = simulated_views("tower")
    hidden = replace(views[-1], depth=views[-1].depth * (views[-1].labels != 5), labels=views[-1].labels)
    scene = model_of(
        (*views[:-1], replace(hidden, labels=np.where(hidden.labels == 5, 0, hidden.labels))),
        config_for(method),
    )
    before = scene.graph["o5"]
    scene.moved("o5", ASIDE)
    np.testing.assert_allclose(scene.graph["o5"].centre_world - before.centre_world, ASIDE[:3, 3], atol=1e-3)
    state[4, 2] += 50.0
    for view in views_of(state, [50.0, 170.0, 200.0]):
        scene.update(view)
    assert kinds(scene) == [("moved", "o5"), ("removed", "o5")]
    assert "o5" not in vertices(scene.graph)


def test_what_the_robot_puts_down_has_the_number_of_its_masks_and_no_colour(state):
    without = state.copy()
    without[4, 2] += 50.0
    first, second = views_of(without, [0.0, 120.0])
    scene = model_of([first, second])
    ball = model_of(views_of(state, [0.0, 120.0])).graph["o5"].shape
    assert scene.added(ball, label=5) == "o5"
    for view in views_of(state, [240.0, 60.0]):
        scene.update(view)
    assert vertices(scene.graph) == {f"o{k}" for k in range(6)}
    assert kinds(scene) == [("added", "o5")]
    cloud = scene.cloud
    assert cloud.rgb is not None
    assert cloud.rgb[cloud.labels == 1].any()


def test_only_objects_can_be_taken_and_only_what_is_rigid_moves(scene):
    for object_id in ("o0", "o9"):
        with pytest.raises(InputError, match=f"{object_id}.*is not an object"):
            scene.removed(object_id)
    with pytest.raises(InputError, match="T"):
        scene.moved("o5", np.diag([2.0, 1.0, 1.0, 1.0]))
    with pytest.raises(InputError, match="shape"):
        scene.added(box((-0.2, -0.2, 0.78), (0.06, 0.06, 60.0)))
    for label in (0, 3, 65535):
        with pytest.raises(InputError, match=f"label: {label} is not free"):
            scene.added(box((-0.2, -0.2, 0.78), (0.06, 0.06, 0.06)), label)
    with pytest.raises(InputError, match="add a view first"):
        Scene().added(box((0.0, 0.0, 0.8), (0.1, 0.1, 0.1)))
    assert scene.changes == ()
