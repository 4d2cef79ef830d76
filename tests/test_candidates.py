from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from planning_states import CONFIG, HOME, OPEN, SPHERE, candidates

from caryatid.config import RobotConfig
from caryatid.geometry import transforms
from caryatid.planning.candidates import looks_among
from caryatid.robots.floor import FloorGrid
from caryatid.robots.humanoid import HumanoidRobot
from caryatid.sensing.view_sphere import ViewSphere, direction

COUNT = CONFIG.look_directions


def test_looks_are_evenly_spread_and_every_view_has_one_near():
    looks = OPEN.looks(COUNT)
    apart = np.sqrt(4.0 * np.pi / COUNT)
    assert 0.2 * COUNT < len(looks.chosen) < 0.4 * COUNT
    assert (np.diff(looks.chosen) > 0).all()
    chosen = OPEN.directions[looks.chosen]
    nearest = np.argmax(OPEN.directions @ chosen.T, axis=1)
    np.testing.assert_array_equal(looks.nearest, nearest)
    assert transforms.angle_between(OPEN.directions, chosen[looks.nearest]).max() < 1.2 * apart


def test_of_few_views_all_are_looks():
    few = looks_among(OPEN.directions[:20], COUNT)
    assert few.chosen.tolist() == few.nearest.tolist() == list(range(20))


def test_looks_left_out_are_stood_for_by_the_nearest_that_stay():
    looks = OPEN.looks(COUNT)
    left_out = np.random.default_rng(0).random(len(looks.chosen)) < 0.3
    fewer = looks.without(left_out, OPEN.directions)
    np.testing.assert_array_equal(fewer.chosen, looks.chosen[~left_out])
    right = np.argmax(OPEN.directions @ OPEN.directions[fewer.chosen].T, axis=1)
    np.testing.assert_array_equal(fewer.nearest, right)


class TestARobotThatMoves:
    BOXES = (((0.0, 0.0, 0.73), (0.35, 0.5, 0.02)), ((0.0, 2.2, 1.0), (3.0, 0.05, 1.0)))

    def robot(self, *boxes) -> HumanoidRobot:
        floor = FloorGrid.from_boxes(
            [b[0] for b in boxes], [b[1] for b in boxes], [np.eye(3)] * len(boxes), RobotConfig()
        )
        return HumanoidRobot(floor, RobotConfig(), SPHERE.poses(HOME[None])[0])

    def test_it_is_offered_the_same_views_by_other_ways(self):
        moved = self.robot(*self.BOXES)
        before = moved.candidates(SPHERE)
        there = int(np.argmax(before.directions @ direction(0.0, 0.6)))
        moved.move_to(before.T_world_camera[there])
        after = moved.candidates(SPHERE)
        fresh = HumanoidRobot(moved._floor, RobotConfig(), before.T_world_camera[there]).candidates(SPHERE)
        for field in ("T_world_camera", "directions", "path_length", "indices"):
            np.testing.assert_array_equal(getattr(after, field), getattr(fresh, field))
        assert after.rejected == fresh.rejected
        np.testing.assert_array_equal(after.directions, before.directions)
        assert after.path_length[there] == 0.0 < before.path_length[there]
        assert after.looks(COUNT) is moved.candidates(SPHERE).looks(COUNT)

    def test_another_sphere_is_looked_at_anew(self):
        robot = self.robot(*self.BOXES)
        robot.candidates(SPHERE)
        other = ViewSphere.around((0.1, 0.0, 0.85), CONFIG)
        offered = robot.candidates(other)
        np.testing.assert_allclose(other.poses(offered.directions), offered.T_world_camera)
        assert offered.indices.min() > robot.candidates(SPHERE).indices.min()

    def test_other_directions_have_looks_of_their_own(self):
        offered = candidates()
        looks = offered.looks(COUNT)
        half = replace(
            offered, directions=offered.directions[::2], T_world_camera=offered.T_world_camera[::2]
        )
        assert half.looks(COUNT) is not looks
        assert half.looks(COUNT).nearest.shape == (len(half),)
        with pytest.raises(ValueError, match="_looks"):
            replace(offered, _looks={})
