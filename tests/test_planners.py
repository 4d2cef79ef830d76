from __future__ import annotations

from dataclasses import replace
from importlib.metadata import EntryPoint

import numpy as np
import pytest
from planning_states import CONFIG, CUBE, HOME, ON_TABLE, OPEN, SPHERE, TABLE, box, candidates, known, state

from caryatid.config import VoxelConfig
from caryatid.errors import InputError, PlanningError
from caryatid.geometry import transforms
from caryatid.graph import Support, SupportGraph
from caryatid.planning import planners
from caryatid.planning.candidates import Candidates
from caryatid.planning.expected_visibility import (
    SPACE,
    space_samples,
    surface_samples,
    unseen_shares,
    visibility,
)
from caryatid.planning.planners import BUILT_IN, make_planner
from caryatid.planning.planners.baselines import RandomPlanner
from caryatid.robots.recording import RecordingRobot
from caryatid.sensing.view_sphere import direction
from caryatid.sensing.voxel_map import VoxelMap

CORNERS = ((0.12, 0.12), (0.12, -0.12), (-0.12, 0.12), (-0.12, -0.12))
"""Where four objects stand around the middle of the table [m]."""


@pytest.mark.parametrize("name", BUILT_IN)
class TestEveryPlanner:
    def test_it_chooses_a_candidate_and_gives_a_reason(self, name: str):
        decision = make_planner(name).plan(state([CUBE], (ON_TABLE,)), np.random.default_rng(0))
        np.testing.assert_array_equal(decision.T_world_camera, OPEN.T_world_camera[decision.index])
        assert decision.why
        assert np.isfinite([decision.saliency, decision.cost, decision.score]).all()

    def test_the_same_seed_gives_the_same_choice(self, name: str):
        first, second = (
            make_planner(name).plan(state([CUBE], (ON_TABLE,)), np.random.default_rng(7)) for _ in range(2)
        )
        assert first.index == second.index
        assert first.score == second.score

    def test_without_candidates_it_says_so(self, name: str):
        none = Candidates(np.zeros((0, 4, 4)), np.zeros((0, 3)), np.zeros(0), {"a wall stands": 3})
        with pytest.raises(PlanningError, match=r"a wall stands \(3\)"):
            make_planner(name).plan(state([CUBE], offered=none), np.random.default_rng(0))

    def test_an_empty_table_is_no_failure(self, name: str):
        decision = make_planner(name).plan(state([]), np.random.default_rng(0))
        assert 0 <= decision.index < len(OPEN)

    def test_it_works_with_the_few_views_of_a_recording(self, name: str):
        poses = SPHERE.poses(np.stack([HOME, direction(0.0, 0.5), direction(1.5, 0.5)]))
        offered = RecordingRobot(poses).candidates(SPHERE)
        decision = make_planner(name).plan(
            state([CUBE], (ON_TABLE,), offered=offered), np.random.default_rng(0)
        )
        assert decision.index in (0, 1)

    def test_what_it_paints_fits_the_sphere_and_the_candidates(self, name: str):
        decision = make_planner(name).plan(state([CUBE], (ON_TABLE,)), np.random.default_rng(0))
        if name in ("random", "ring", "farthest"):
            assert decision.candidate_saliency is None
            assert decision.sphere_saliency is None
            return
        assert decision.candidate_saliency.shape == (len(OPEN),)
        assert decision.sphere_saliency.shape == (40_000,)
        np.testing.assert_array_equal(decision.sphere_saliency[OPEN.indices], decision.candidate_saliency)
        assert decision.saliency == decision.candidate_saliency[decision.index]


def test_an_unknown_planner_lists_those_there_are():
    with pytest.raises(InputError, match=f"no planner 'best'.*{', '.join(BUILT_IN)}"):
        make_planner("best")


def test_other_packages_offer_planners_by_entry_point(monkeypatch: pytest.MonkeyPatch):
    offer = EntryPoint("mine", "caryatid.planning.planners.baselines:RandomPlanner", planners.ENTRY_POINTS)
    monkeypatch.setattr(planners, "entry_points", lambda group: [offer] if group == offer.group else [])
    assert isinstance(make_planner("mine"), RandomPlanner)
    with pytest.raises(InputError, match=f"{', '.join(BUILT_IN)}, mine"):
        make_planner("best")


def test_random_reaches_all_sides():
    rng = np.random.default_rng(0)
    planner, situation = make_planner("random"), state([CUBE])
    indices = [planner.plan(situation, rng).index for _ in range(200)]
    azimuth = np.arctan2(OPEN.directions[indices, 1], OPEN.directions[indices, 0])
    assert (np.histogram(azimuth, bins=6, range=(-np.pi, np.pi))[0] > 10).all()


class TestPaper:
    def test_its_score_is_the_papers_formula(self):
        decision = make_planner("paper").plan(state([CUBE], (ON_TABLE,)), np.random.default_rng(0))
        chosen = OPEN.directions[decision.index]
        alpha = transforms.angle_between(HOME, chosen)
        midpoint = (TABLE.centre_world + CUBE.centre_world) / 2.0 - SPHERE.centre_world
        sigma = np.deg2rad(CONFIG.spread)

        def bump(top: np.ndarray) -> float:
            return float(np.exp(-0.5 * (transforms.angle_between(top, chosen) / sigma) ** 2))

        assert decision.cost == pytest.approx(np.sin(alpha / 2.0))
        assert decision.score == pytest.approx(decision.saliency - decision.cost)
        seen_always = 1.0
        s = seen_always * bump(midpoint)
        assert abs(decision.saliency + bump(HOME)) == pytest.approx(abs(s), abs=1e-6)

    def test_settings_of_the_support_planner_do_not_touch_it(self):
        plain = make_planner("paper").plan(state([CUBE], (ON_TABLE,)), np.random.default_rng(0))
        other = make_planner("paper").plan(
            state([CUBE], (ON_TABLE,), saliency="decreasing", edge_point="contact", path_cost="none"),
            np.random.default_rng(0),
        )
        assert plain.index == other.index
        assert plain.score == other.score

    def test_an_unsupported_object_draws_the_view_to_the_other_side(self):
        floating = box(1, (0.0, 0.0, 0.9), (0.1, 0.1, 0.1))
        decision = make_planner("paper").plan(state([floating]), np.random.default_rng(0))
        saliency = decision.candidate_saliency
        best = OPEN.directions[int(np.argmax(saliency))]
        assert best[0] > 0.8
        assert saliency.max() > 0.3

    def test_a_hidden_point_counts_against_a_view(self):
        floating = box(1, (0.0, 0.0, 0.9), (0.1, 0.1, 0.1))
        screen = box(2, (0.2, 0.0, 1.0), (0.02, 0.6, 0.5))
        held = Support("o0", "o2", occurrences=1)
        free = make_planner("paper").plan(state([floating]), np.random.default_rng(0))
        hidden = make_planner("paper").plan(state([floating, screen], (held,)), np.random.default_rng(0))
        opposite = int(np.argmax(OPEN.directions @ direction(0.0, 0.4)))
        assert free.candidate_saliency[opposite] > 0.3
        assert hidden.candidate_saliency[opposite] < free.candidate_saliency[opposite] - 0.2


class TestSupport:
    def test_after_one_view_it_looks_at_the_other_sides(self):
        decision = make_planner("support").plan(state([CUBE], (ON_TABLE,)), np.random.default_rng(0))
        assert OPEN.directions[decision.index] @ HOME < 0.5
        assert "o1" in decision.why

    def test_it_looks_past_a_screen(self):
        screen = box(2, (0.0, 0.16, 0.95), (0.5, 0.02, 0.4))
        other_side = direction(np.pi / 2.0, np.deg2rad(35.0))
        decision = make_planner("support").plan(
            state([CUBE, screen], visited=np.stack([HOME, other_side])), np.random.default_rng(0)
        )
        solid = known([TABLE, CUBE, screen]).solid()
        samples = surface_samples(SupportGraph((TABLE, CUBE)), solid, CONFIG)
        shown = visibility(samples, decision.T_world_camera[None], solid, CONFIG)[:, 0]
        assert decision.T_world_camera[1, 3] < 0.0
        assert (shown > 0.5).mean() > 0.2

    def test_views_it_has_taken_are_not_taken_again(self):
        rng = np.random.default_rng(0)
        visited = HOME[None]
        for _ in range(4):
            decision = make_planner("support").plan(state([CUBE], (ON_TABLE,), visited=visited), rng)
            chosen = OPEN.directions[decision.index]
            assert np.rad2deg(transforms.angle_between(visited, chosen)).min() > 15.0
            visited = np.vstack([visited, chosen])

    def test_what_cannot_be_reached_is_not_wanted(self):
        offered = candidates(((0.62, 0.0, 1.0), (0.03, 1.6, 1.0)))
        decision = make_planner("support").plan(
            state([CUBE], (ON_TABLE,), offered=offered), np.random.default_rng(0)
        )
        assert abs(np.arctan2(*offered.directions[decision.index][1::-1])) > np.deg2rad(30.0)

    def test_unseen_space_behind_a_screen_draws_the_view(self):
        screen = box(1, (0.0, 0.0, 0.9), (0.02, 0.6, 0.3))
        everything = [TABLE, screen]
        voxels = known(everything)
        centres = voxels.centres_world(np.argwhere(voxels.states >= 0))
        behind = (centres[:, 0] > 0.03) & (np.abs(centres[:, 1]) < 0.3) & (centres[:, 2] < 1.0)
        passes = np.where(behind.reshape(voxels.hits.shape), 0, voxels.passes).astype(np.uint8)
        unseen = VoxelMap(voxels.origin_world, voxels.hits, passes, voxels.config)
        before = state([screen], (ON_TABLE,))
        decision = make_planner("support").plan(replace(before, voxels=unseen), np.random.default_rng(0))
        assert OPEN.directions[decision.index][0] > 0.3
        assert SPACE in decision.why

    def test_space_that_has_been_seen_is_worth_nothing(self):
        graph = SupportGraph((TABLE, CUBE))
        seen = space_samples(graph, known([TABLE, CUBE]).solid(), CONFIG)
        nothing_known = VoxelMap.around(SPHERE.centre_world, VoxelConfig()).solid([CUBE.shape])
        unseen = space_samples(graph, nothing_known, CONFIG)
        assert len(seen.points_world) == 0
        assert 0.9 * CONFIG.space_weight < unseen.weights.sum() <= CONFIG.space_weight + CONFIG.heap_weight
        assert (CUBE.shape.signed_distance(unseen.points_world) >= -0.01).all()

    def test_space_among_the_objects_weighs_most(self):
        corners = [box(i, (x, y, 0.8), (0.06, 0.06, 0.1)) for i, (x, y) in enumerate(CORNERS, start=1)]
        nothing_known = VoxelMap.around(SPHERE.centre_world, VoxelConfig()).solid([o.shape for o in corners])
        samples = space_samples(SupportGraph((TABLE, *corners)), nothing_known, CONFIG)
        among = np.abs(samples.points_world[:, :2]).max(axis=1) < 0.1
        beyond = np.abs(samples.points_world[:, :2]).max(axis=1) > 0.15
        assert samples.weights[among].mean() > 10.0 * samples.weights[beyond].mean() > 0.0
        assert samples.weights.sum() <= CONFIG.space_weight + CONFIG.heap_weight

    def test_objects_of_which_little_was_seen_are_worth_more(self):
        graph = SupportGraph((TABLE, CUBE, box(2, (0.0, 0.3, 0.8), (0.1, 0.1, 0.1))))
        samples = surface_samples(graph, known(list(graph.objects)).solid(), CONFIG)
        seen = np.where(samples.subjects == 0, 1.0, 0.25)
        np.testing.assert_allclose(unseen_shares(samples, seen), np.where(samples.subjects == 0, 0.0, 0.75))

    def test_the_more_a_way_costs_the_shorter_it_is(self):
        ways = []
        for effort in (0.0, 0.05, 0.5, 100.0):
            situation = state([CUBE], (ON_TABLE,), effort=effort, inhibition=0.0)
            decision = make_planner("support").plan(situation, np.random.default_rng(0))
            ways.append(float(OPEN.path_length[decision.index]))
        assert ways == sorted(ways, reverse=True)
        assert ways[0] > 2.0 * ways[2] > 0.0
        assert ways[3] < 0.1

    def test_surfaces_in_contact_are_not_asked_for(self):
        graph = SupportGraph((TABLE, CUBE))
        samples = surface_samples(graph, known([TABLE, CUBE]).solid(), CONFIG)
        assert len(samples.points_world) > 100
        assert samples.normals_world[:, 2].min() > -0.5, "the face on the table"
        assert samples.weights.sum() == pytest.approx(5.0 / 6.0, abs=0.01)

    def test_a_surface_is_seen_from_before_and_not_from_behind(self):
        solid = known([TABLE, CUBE]).solid()
        samples = surface_samples(SupportGraph((TABLE, CUBE)), solid, CONFIG)
        seen = visibility(samples, SPHERE.poses(HOME[None]), solid, CONFIG)[:, 0]
        front = samples.normals_world[:, 0] < -0.9
        back = samples.normals_world[:, 0] > 0.9
        assert seen[front].min() == 1.0
        assert seen[back].max() == 0.0
