from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from planning_states import CONFIG, CUBE, HOME, ON_TABLE, OPEN, TABLE, box, candidates, known, state

from caryatid.config import VoxelConfig
from caryatid.geometry import transforms
from caryatid.planning.decision import PlanningState
from caryatid.planning.expected_visibility import space_above
from caryatid.planning.planners import VOLUMETRIC, make_planner
from caryatid.planning.planners.volumetric import gather, image_rays, layers, ray_information
from caryatid.sensing.voxel_map import FREE, OCCUPIED, UNKNOWN, VoxelMap

SIZE = 0.01
STRAIGHT = np.array([[0.0, 0.0, 1.0]])
OF_FREE, OF_OCCUPIED = 0.12, 0.97
"""Occupancy of voxels of one reading's kind seen often enough for the clamp."""
SCREEN = box(1, (0.0, 0.0, 0.9), (0.02, 0.6, 0.3))


def entropy(p: float) -> float:
    return float(-p * np.log2(p) - (1.0 - p) * np.log2(1.0 - p))


def map_of(states: np.ndarray, **settings: object) -> VoxelMap:
    """A map whose voxels have these states (X, Y, Z), each of five views' evidence."""
    states = np.asarray(states)
    hits, passes = (5 * (states == s).astype(np.uint8) for s in (OCCUPIED, FREE))
    return VoxelMap(np.zeros(3), hits, passes, VoxelConfig(size=SIZE, **settings))


def line(*states: int) -> VoxelMap:
    return map_of(np.array(states)[:, None, None])


def along(voxels: VoxelMap, proximity: float = 0.1, backwards: bool = False) -> dict[str, float]:
    """What a single ray along +x, or −x, through the row of voxels gathers."""
    eye, target = (-0.5, 0.005, 0.005), (1.0, 0.005, 0.005)
    T_world_camera = transforms.look_at(target, eye) if backwards else transforms.look_at(eye, target)
    gathered = gather(
        voxels.states, layers(voxels, proximity), T_world_camera[None], STRAIGHT, np.zeros(3), SIZE
    )
    return dict(zip(VOLUMETRIC, gathered[0], strict=True))


class TestFormulas:
    def test_occlusion_aware_is_entropy_by_visibility(self):
        found = along(line(FREE, UNKNOWN, FREE, OCCUPIED, UNKNOWN))["occlusion-aware"]
        free, occupied = entropy(OF_FREE), entropy(OF_OCCUPIED)
        visible = np.cumprod([1.0, 1.0 - OF_FREE, 0.5, 1.0 - OF_FREE])
        assert found == pytest.approx(visible @ [free, 1.0, free, occupied], rel=1e-5)
        unknown, seen = along(line(UNKNOWN, OCCUPIED)), along(line(FREE, OCCUPIED))
        assert unknown["occlusion-aware"] > seen["occlusion-aware"] + 0.3

    def test_unobserved_voxel_is_the_same_over_unknown_voxels(self):
        found = along(line(FREE, UNKNOWN, UNKNOWN, OCCUPIED, UNKNOWN))["unobserved-voxel"]
        assert found == pytest.approx((1.0 - OF_FREE) * (1.0 + 0.5), rel=1e-5)

    def test_a_rear_side_is_an_occupied_voxel_met_from_an_unknown_one(self):
        back = line(OCCUPIED, UNKNOWN, UNKNOWN, FREE)
        assert along(back)["rear-side-voxel"] == 0.0
        assert along(back, backwards=True)["rear-side-voxel"] == 1.0
        assert along(line(UNKNOWN, FREE, OCCUPIED))["rear-side-voxel"] == 0.0
        assert along(line(UNKNOWN, UNKNOWN, FREE))["rear-side-voxel"] == 0.0

    def test_rear_side_entropy_is_that_of_the_run_before_it(self):
        assert along(line(UNKNOWN, FREE, UNKNOWN, UNKNOWN, OCCUPIED))["rear-side-entropy"] == pytest.approx(
            2.0
        )
        assert along(line(UNKNOWN, UNKNOWN, FREE, OCCUPIED))["rear-side-entropy"] == 0.0
        assert along(line(UNKNOWN, UNKNOWN))["rear-side-entropy"] == 0.0

    def test_proximity_count_falls_off_from_the_surface(self):
        voxels = line(FREE, UNKNOWN, UNKNOWN, UNKNOWN, OCCUPIED, UNKNOWN)
        found = along(voxels, proximity=0.025)["proximity-count"]
        assert found == pytest.approx((0.025 - 0.01) + (0.025 - 0.02), rel=1e-5)
        assert along(line(UNKNOWN, UNKNOWN, FREE))["proximity-count"] == 0.0

    def test_nothing_behind_an_occupied_voxel_counts(self):
        for start in ((FREE, OCCUPIED), (UNKNOWN, OCCUPIED)):
            plain, more = along(line(*start)), along(line(*start, UNKNOWN, UNKNOWN, OCCUPIED))
            assert plain == pytest.approx(more)

    def test_a_wall_is_worth_looking_at_from_behind(self):
        states = np.full((30, 30, 30), FREE)
        states[15] = OCCUPIED
        states[16:] = UNKNOWN
        voxels = map_of(states)
        middle = np.full(3, 0.15)
        poses = np.stack([transforms.look_at(middle + (x, 0.0, 0.0), middle) for x in (-1.0, 1.0)])
        found = gather(voxels.states, layers(voxels, 0.1), poses, image_rays(CONFIG), np.zeros(3), SIZE)
        for name in SHOWN:
            front, back = found[:, VOLUMETRIC.index(name)]
            assert front == 0.0
            assert back > 100.0 * (SIZE if name == "proximity-count" else 1.0)


THREADED = """
import sys
import numpy as np
import numba
from planning_states import CUBE, OPEN, SPHERE, state
from caryatid.planning.planners.volumetric import ray_information
from caryatid.sensing.voxel_map import VoxelMap
from dataclasses import replace
situation = state([CUBE])
rng = np.random.default_rng(0)
passes = rng.integers(0, 2, situation.voxels.passes.shape).astype(np.uint8)
voxels = VoxelMap(situation.voxels.origin_world, situation.voxels.hits, passes, situation.voxels.config)
found = ray_information(replace(situation, voxels=voxels), OPEN.T_world_camera[::200])
sys.stdout.write(f"{numba.get_num_threads()} {found.tobytes().hex()}")
"""


def test_the_number_of_threads_changes_no_bit():
    said = []
    for threads in ("1", "3"):
        env = os.environ | {"NUMBA_NUM_THREADS": threads, "PYTHONPATH": os.pathsep.join(sys.path)}
        run = subprocess.run(
            [sys.executable, "-c", THREADED], env=env, capture_output=True, text=True, check=True
        )
        said.append(run.stdout.split())
    assert [n for n, _ in said] == ["1", "3"]
    assert said[0][1] == said[1][1]
    assert float(np.frombuffer(bytes.fromhex(said[0][1])).max()) > 0.0


def test_rays_fill_the_image_two_voxels_apart():
    rays_camera = image_rays(CONFIG)
    np.testing.assert_allclose(np.linalg.norm(rays_camera, axis=1), 1.0)
    angle = np.rad2deg(np.arccos(rays_camera[:, 2]))
    assert 29.0 < angle.max() <= 30.0
    at_centre = np.sort(np.unique((CONFIG.sphere_radius * rays_camera[:, 0] / rays_camera[:, 2]).round(6)))
    np.testing.assert_allclose(np.diff(at_centre), 0.02, atol=1e-6)
    assert (angle < 1e-6).sum() == 1


@cache
def unseen_beside_screen(side: float) -> VoxelMap:
    """A screen across the table; what is on one side of it, +1 or −1 along x, has not been seen."""
    voxels = known([TABLE, SCREEN])
    x, y, z = np.moveaxis(voxels.centres_world(np.moveaxis(np.indices(voxels.hits.shape), 0, -1)), -1, 0)
    unseen = (side * x > 0.01) & (side * x < 0.3) & (np.abs(y) < 0.3) & (z > 0.75) & (z < 1.05)
    passes = np.where(unseen, 0, voxels.passes).astype(np.uint8)
    return VoxelMap(voxels.origin_world, voxels.hits, passes, voxels.config)


def beside_screen(side: float, **settings: object) -> PlanningState:
    return replace(state([SCREEN], (ON_TABLE,), **settings), voxels=unseen_beside_screen(side))


SHOWN = [name for name in VOLUMETRIC if name != "occlusion-aware"]
"""Those that count nothing of what has been seen free."""


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("name", SHOWN)
def test_it_goes_to_the_side_that_shows_unknown_space(name: str, side: float):
    decision = make_planner(name).plan(beside_screen(side, path_cost="none"), np.random.default_rng(0))
    assert side * OPEN.directions[decision.index][0] > 0.3
    assert decision.saliency == 1.0


@pytest.mark.parametrize("name", VOLUMETRIC)
class TestPlanner:
    def test_its_score_is_the_utility(self, name: str):
        situation = beside_screen(1.0, cost_weight=0.7, path_cost="angle")
        decision = make_planner(name).plan(situation, np.random.default_rng(0))
        alpha = transforms.angle_between(HOME, OPEN.directions[decision.index])
        assert decision.score == pytest.approx(decision.saliency - decision.cost)
        double = make_planner(name).plan(
            beside_screen(1.0, cost_weight=1.4, path_cost="angle"), np.random.default_rng(0)
        )
        other = transforms.angle_between(HOME, OPEN.directions[double.index])
        ratio = np.sin(other / 2.0) / np.sin(alpha / 2.0)
        assert double.cost == pytest.approx(2.0 * ratio * decision.cost)

    def test_dear_ways_are_not_gone(self, name: str):
        situation = beside_screen(1.0, cost_weight=1000.0)
        decision = make_planner(name).plan(situation, np.random.default_rng(0))
        assert np.rad2deg(transforms.angle_between(HOME, OPEN.directions[decision.index])) < 15.0

    def test_it_does_not_stay_where_it_is(self, name: str):
        situation = beside_screen(-1.0)
        decision = make_planner(name).plan(situation, np.random.default_rng(0))
        assert np.rad2deg(transforms.angle_between(HOME, OPEN.directions[decision.index])) > 5.0

    def test_what_cannot_be_reached_is_not_wanted(self, name: str):
        offered = candidates(((0.62, 0.0, 1.0), (0.03, 1.6, 1.0)))
        situation = replace(beside_screen(1.0, path_cost="none"), candidates=offered)
        decision = make_planner(name).plan(situation, np.random.default_rng(0))
        assert 0 <= decision.index < len(offered)
        assert decision.candidate_saliency.shape == (len(offered),)


def test_unknown_space_outside_the_box_over_the_table_counts_for_nothing():
    inside = beside_screen(1.0)
    low, high = space_above(inside.graph, inside.voxels)
    centres = inside.voxels.centres_world(np.moveaxis(np.indices(inside.voxels.hits.shape), 0, -1))
    outside = ((centres < low - SIZE) | (centres > high + SIZE)).any(axis=-1)
    nothing_there = VoxelMap(
        inside.voxels.origin_world,
        np.where(outside, 0, inside.voxels.hits).astype(np.uint8),
        np.where(outside, 0, inside.voxels.passes).astype(np.uint8),
        inside.voxels.config,
    )
    poses = OPEN.T_world_camera[::300]
    np.testing.assert_array_equal(
        ray_information(inside, poses, 0.1),
        ray_information(replace(inside, voxels=nothing_there), poses, 0.1),
    )
    assert ray_information(state([]), poses).max() == 0.0


def test_a_part_of_the_map_lies_where_it_lay():
    whole = known([CUBE])
    part = whole.cut(np.array([-0.1, -0.203, 0.8]), np.array([0.2, 0.1, 9.0]))
    index = np.argwhere(part.states >= 0)
    np.testing.assert_array_equal(part.states.ravel(), whole.state_at(part.centres_world(index)))
    np.testing.assert_allclose(part.origin_world, (-0.1, -0.21, 0.8))
    assert part.hits.shape[:2] == (30, 31)
    assert whole.cut(np.full(3, 5.0), np.full(3, 6.0)).hits.size == 0


def test_occupancy_follows_the_evidence_within_the_clamp():
    hits, passes = np.zeros((2, 6, 1, 1), dtype=np.uint8)
    hits[:, 0, 0], passes[:, 0, 0] = [0, 1, 0, 1, 200, 0], [0, 0, 1, 1, 0, 200]
    found = VoxelMap(np.zeros(3), hits, passes, VoxelConfig(readings=1)).occupancy[:, 0, 0]
    both = 0.7 / 0.3 * 0.4 / 0.6
    np.testing.assert_allclose(found, [0.5, 0.7, 0.4, both / (1.0 + both), 0.97, 0.12], rtol=1e-6)
    often = VoxelMap(np.zeros(3), hits, passes, VoxelConfig(readings=5)).occupancy[:, 0, 0]
    np.testing.assert_allclose(often[[0, 1, 2]], [0.5, 0.97, 0.12], atol=0.005)


def test_nearness_is_reckoned_for_those_who_ask_for_it():
    situation, poses = beside_screen(1.0), OPEN.T_world_camera[::300]
    near, asked = ray_information(situation, poses, 0.1), ray_information(situation, poses)
    column = VOLUMETRIC.index("proximity-count")
    np.testing.assert_array_equal(np.delete(near, column, axis=1), np.delete(asked, column, axis=1))
    assert near[:, column].max() > 0.0 == asked[:, column].max()
