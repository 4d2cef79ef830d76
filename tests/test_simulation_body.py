"""The simulated humanoid's body: it drives its waypoints, touches nothing, and its camera sees it."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import mujoco
import numpy as np
import pytest
from conftest import SMALL_SENSOR
from synthetic import simulated_scene

from caryatid.config import Config, RobotConfig
from caryatid.geometry import transforms
from caryatid.planning.candidates import Posture
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.simulation.scenes import DESIGNED
from caryatid.simulation.setup import HumanoidBody, make_simulation
from caryatid.simulation.world import table_centre

CONFIG = replace(Config(), sensor=SMALL_SENSOR)
SLOW = pytest.mark.slow


def stage(name: str, config: Config = CONFIG):
    """A simulation, the body of its robot, and the view sphere."""
    scene = simulated_scene(name)
    made = make_simulation(scene, config, noise="none", seed=0)
    body = HumanoidBody(scene, made.robot, config.robot)
    return made, body, ViewSphere.around(table_centre(scene), config.active)


def between(one: Posture, other: Posture):
    """Postures at most 5 mm apart on the straight line between two."""
    length = np.linalg.norm((other.platform_world - one.platform_world)[:2])
    for share in np.linspace(0.0, 1.0, 2 + int(length / 0.005)):
        platform, height = (
            (1.0 - share) * np.asarray(getattr(one, name)) + share * np.asarray(getattr(other, name))
            for name in ("platform_world", "camera_height")
        )
        yield Posture(platform, float(height), 0.0, 0.0)


def clearance(body: HumanoidBody) -> float:
    """How near a body is to anything but the floor [m], negative inside."""
    model, data = body.scene.model, body.scene.data
    mine = np.flatnonzero(model.geom_bodyid == model.body("robot").id).tolist()
    others = [g for g in range(model.ngeom) if g not in mine and model.geom(g).name != "floor"]
    return min(mujoco.mj_geomDistance(model, data, a, b, 10.0, None) for a in mine for b in others)


@pytest.mark.parametrize(
    "name",
    [*DESIGNED, *(pytest.param(n, marks=SLOW) for n in ("pile-8-3", "dense-12-0", "packed-20-0"))],
)
def test_the_platform_follows_the_waypoints_and_touches_nothing(name):
    made, body, sphere = stage(name)
    rng, nearest, driven = np.random.default_rng(0), np.inf, 0.0
    for _ in range(6):
        candidates = made.robot.candidates(sphere)
        chosen = int(rng.integers(len(candidates)))
        T = candidates.T_world_camera[chosen]
        waypoints = made.robot.waypoints(T)
        legs = np.diff([p.platform_world[:2] for p in waypoints], axis=0)
        for one, other in pairwise(waypoints):
            for posture in between(one, other):
                body.place(posture)
                nearest = min(nearest, clearance(body))
        length = float(np.linalg.norm(legs, axis=1).sum())
        assert length == pytest.approx(candidates.path_length[chosen], abs=1e-9)
        assert made.robot.move_to(T) == pytest.approx(length, abs=1e-9)
        driven += length
    assert nearest > 0.0
    assert driven > 2.0


def test_its_camera_sees_nothing_of_it_from_any_view_of_the_sphere():
    made, _, sphere = stage("clutter")
    candidates = made.robot.candidates(sphere)
    solved = [made.robot.solve(T) for T in candidates.T_world_camera[::40]]
    extremes = [np.argmin([p.head_pitch for p in solved]), np.argmax([abs(p.head_yaw) for p in solved])]
    floating = replace_body(made.camera)
    for index in {*extremes, *range(0, len(solved), 40)}:
        T = candidates.T_world_camera[40 * int(index)]
        with_body, without = made.camera.capture(T), floating.capture(T)
        np.testing.assert_array_equal(with_body.depth, without.depth)
        np.testing.assert_array_equal(with_body.rgb, without.rgb)


def replace_body(camera):
    """The same camera without a body."""
    floating = camera.fork()
    floating._around = None
    return floating


def test_its_camera_sees_the_platform_straight_down():
    """From 1.5 m the top of the platform, 0.3 m high, is 1.2 m deep, that of the mast 0.15 m."""
    config = replace(CONFIG, robot=RobotConfig(pitch=(-90.0, 20.0)))
    made, _, _ = stage("clutter", config)
    T = transforms.look_at((-1.5, 0.0, 1.5), (-1.499, 0.0, 0.0))
    view, floor = made.camera.capture(T), replace_body(made.camera).capture(T)
    seen = view.depth != floor.depth
    assert 0.1 < seen.mean() < 0.9
    assert np.median(view.depth[seen]) == pytest.approx(1.2, abs=2e-3)
    assert view.depth[seen].min() == pytest.approx(0.15, abs=0.01)
    assert (view.labels[seen] == 0).all()
    unreachable = transforms.look_at((0.0, 0.0, 2.5), (0.001, 0.0, 0.0))
    plain = replace_body(made.camera).capture(unreachable)
    np.testing.assert_array_equal(made.camera.capture(unreachable).depth, plain.depth)
