"""Points of interest, candidates, what views are expected to show, and the planners that choose."""

from __future__ import annotations

import pickle
import re
import tomllib
from dataclasses import replace
from functools import cache
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
from conftest import SMALL, run_command
from synthetic import shelf_graph

from caryatid.config import ActiveVisionConfig, RobotConfig, SupportConfig, VoxelConfig
from caryatid.errors import InputError, PlanningError
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box
from caryatid.graph import SceneObject, Support, SupportGraph
from caryatid.planning import planners
from caryatid.planning.candidates import Candidates
from caryatid.planning.decision import PlanningState
from caryatid.planning.expected_visibility import (
    SPACE,
    predict_goal,
    settled,
    space_above,
    space_samples,
)
from caryatid.planning.planners import BUILT_IN, VOLUMETRIC, make_planner
from caryatid.planning.planners.baselines import STOPS, RandomPlanner
from caryatid.planning.planners.volumetric import ray_information
from caryatid.planning.points_of_interest import (
    points_of_doubt,
    points_of_interest,
    relation_saliency,
)
from caryatid.robots.floor import FloorGrid
from caryatid.robots.humanoid import HumanoidRobot
from caryatid.robots.protocol import RecordingRobot
from caryatid.sensing.view_sphere import ViewSphere, direction
from caryatid.sensing.voxel_map import FREE, OCCUPIED, UNKNOWN, VoxelMap
from caryatid.support.relations import Effect, Removal

CONFIG = ActiveVisionConfig()
PAPER = replace(CONFIG, saliency="paper", edge_point="midpoint")
SPHERE = ViewSphere.around((0.0, 0.0, 0.75), CONFIG)
HOME = direction(np.pi, np.deg2rad(35.0))
TWICE = np.stack([HOME, HOME])


def box(label, centre, extents, yaw=0.0):
    T = transforms.rigid(transforms.rotation_from_vector((0.0, 0.0, np.deg2rad(yaw))), centre)
    role = "object" if label else "support_surface"
    return SceneObject(f"o{label}", label, Box(T, np.array(extents)), role)


TABLE = box(0, (0.0, 0.0, 0.73), (0.7, 1.0, 0.04))
CUBE = box(1, (0.0, 0.0, 0.80), (0.1, 0.1, 0.1))
ON_TABLE = Support("o0", "o1")


FLOOR = FloorGrid.from_boxes([TABLE.shape], RobotConfig())
ROBOT = HumanoidRobot(FLOOR, RobotConfig())
ROBOT.move_to(SPHERE.poses(HOME[None])[0])
OPEN = ROBOT.candidates(SPHERE)


@cache
def known(*objects):
    """A map that has seen every voxel: the objects occupied, the rest free."""
    voxels = VoxelMap.around(SPHERE.centre_world, VoxelConfig())
    occluders = voxels.occluders([o.shape for o in objects])
    low = np.rint((occluders.origin_world - voxels.origin_world) / voxels.config.size).astype(int)
    hits = np.zeros_like(voxels.hits)
    hits[tuple(slice(a, a + n) for a, n in zip(low, occluders.grid.shape, strict=True))] = occluders.grid
    return VoxelMap(voxels.origin_world, hits, 1 - hits, voxels.config)


@cache
def half_known(unseen, *objects):
    """A map in which space has not been seen where a function of its voxels' centres says so."""
    voxels = known(*objects)
    x, y, z = np.moveaxis(voxels.centres_world(np.moveaxis(np.indices(voxels.hits.shape), 0, -1)), -1, 0)
    passes = np.where(unseen(x, y, z), 0, voxels.passes).astype(np.uint8)
    return VoxelMap(voxels.origin_world, voxels.hits, passes, voxels.config)


def state(objects, supports=(), visited=HOME[None], offered=OPEN, **settings):
    graph, voxels = SupportGraph((TABLE, *objects), supports), known(TABLE, *objects)
    return PlanningState(graph, SPHERE, voxels, visited, offered, replace(CONFIG, **settings))


def decide(name, situation, seed=0):
    return make_planner(name).plan(situation, np.random.default_rng(seed))


def plan(name, objects, supports=(), seed=0, **settings):
    return decide(name, state(objects, supports, **settings), seed)


def degrees_between(a, b):
    return np.rad2deg(transforms.angle_between(a, b))


def test_unseen_space_is_sought_over_every_support_surface_up_to_the_next():
    """As high as the highest heap, 0.2 m; over the table, a board 0.1 m higher ends it."""
    *surfaces, board = shelf_graph().support_surfaces
    lower = replace(board, shape=replace(board.shape, T_world_object=board.shape.T_world_object.copy()))
    lower.shape.T_world_object[2, 3] -= 0.3
    objects = [o for o in shelf_graph().objects if o.id in ("o1", "o2", "o3")]
    graph = SupportGraph((*surfaces, lower, *objects))
    nothing = VoxelMap.around((0.2, 0.0, 0.08), VoxelConfig())
    found = space_samples(graph, nothing.occluders([o.shape for o in graph.objects]))
    x, y, z = found.points_world.T
    on_board = (np.abs(x) < 0.15) & (np.abs(y - 0.3) < 0.1)
    beside = (np.abs(x) < 0.3) & (y < 0.0)
    floor, table, over = ({round(top + 0.02 + 0.04 * k, 2) for k in range(5)} for top in (0.0, 0.45, 0.55))
    assert {*z[beside].round(2).tolist()} == floor | table
    assert {*z[on_board].round(2).tolist()} == floor | {0.47} | over
    low, high = space_above(graph, nothing)
    assert (low[2], high[2]) == pytest.approx((0.02, 0.75))


class TestPointsOfInterest:
    LOWER, UPPER = box(1, (0.1, 0.1, 0.80), (0.1, 0.1, 0.1)), box(2, (0.1, 0.2, 0.90), (0.2, 0.2, 0.1))
    FLOATING = box(3, (-0.2, -0.1, 0.85), (0.08, 0.08, 0.08))
    CONTACT = np.array([0.1, 0.13, 0.85])
    GRAPH = SupportGraph(
        (TABLE, LOWER, UPPER, FLOATING),
        (Support("o0", "o1", occurrences=2), Support("o1", "o2", contact_world=CONTACT)),
    )

    def test_equation_2_as_printed_and_decreasing(self):
        """λ_s = 0.75, found in k of 4 views: 0.75 + 0.25·cos(2πk/4) = 1, 0.75, 0.5, 0.75, 1 as printed.

        With π in place of 2π it falls: 0.75 + 0.25·cos(πk/4) = 1, …, 0.75, …, 0.5 = 2λ_s − 1.
        """
        np.testing.assert_allclose(
            [relation_saliency(k, 4, PAPER) for k in range(5)], [1, 0.75, 0.5, 0.75, 1]
        )
        values = [relation_saliency(k, 4, CONFIG) for k in range(6)]
        np.testing.assert_allclose(values[::2], [1.0, 0.75, 0.5], err_msg="1 … 2λ − 1")
        assert values[4] == values[5], "more occurrences than views"
        assert relation_saliency(0, 0, CONFIG) == 1.0
        assert relation_saliency(1, 1, CONFIG) == pytest.approx(0.5)

    def test_every_relation_and_every_unsupported_object_gives_one_point(self):
        """Algorithm 1 goes over the objects: o1 and o2 have a supporter each, o3 has none.

        A = (0.1, 0.2, 0.9) and B = (0.1, 0.1, 0.8) have their midpoint at (0.1, 0.15, 0.85). With π, edges
        found in 2 and 1 of 2 views are worth 0.5 and 0.75, and an object without supporter the most, 1.
        """
        points = points_of_interest(self.GRAPH, SPHERE, TWICE, CONFIG)
        assert [p.subject for p in points] == [("o0", "o1"), ("o1", "o2"), ("o3",)]
        assert [p.saliency for p in points] == pytest.approx([0.5, 0.75, 1.0])
        assert points[1].why == "o1 supports o2: found in 1 of 2 views"
        midpoints = points_of_interest(self.GRAPH, SPHERE, TWICE, PAPER)
        np.testing.assert_allclose(midpoints[1].position_world, [0.1, 0.15, 0.85])
        np.testing.assert_allclose(points[1].position_world, self.CONTACT)
        np.testing.assert_allclose(points[0].position_world, midpoints[0].position_world)
        for p in (*points[:2], *midpoints[:2]):
            np.testing.assert_allclose(p.direction, transforms.unit(p.position_world - SPHERE.centre_world))
        assert points_of_interest(SupportGraph(), SPHERE, HOME[None], CONFIG) == []

    def test_what_is_unsupported_or_implausible_is_looked_at_from_the_largest_arc(self):
        """Algorithm 1: both views are at 180°, so the arc's middle is at 0°.

        From there the line to the middle of o3, a cube of 8 cm at (−0.2, −0.1, 0.85), meets its side 4 cm
        before it.
        """
        floating = points_of_interest(self.GRAPH, SPHERE, TWICE, CONFIG)[-1]
        np.testing.assert_allclose(floating.direction, [1.0, 0.0, 0.0], atol=1e-9)
        outwards = SPHERE.centre_world + (SPHERE.radius, 0.0, 0.0) - self.FLOATING.centre_world
        at_face = self.FLOATING.centre_world + outwards * (0.04 / outwards[0])
        np.testing.assert_allclose(floating.position_world, at_face, atol=1e-9)
        assert floating.why == "the supporter of o3 is unknown; the largest gap between views is at 0°"
        doubtful = SupportGraph((TABLE, replace(self.LOWER, doubt="overlaps o2 by 30 mm"), self.UPPER))
        (point,) = points_of_doubt(doubtful, SPHERE, direction(0.0, 0.6)[None])
        assert (point.subject, point.saliency) == (("o1",), 1.0)
        assert "overlaps o2 by 30 mm" in point.why
        np.testing.assert_allclose(point.direction, (-1.0, 0.0, 0.0), atol=1e-9)


@pytest.mark.parametrize("name", BUILT_IN)
class TestEveryPlanner:
    def test_it_chooses_a_candidate_gives_a_reason_and_paints_the_sphere(self, name):
        decision, again = (plan(name, [CUBE], (ON_TABLE,), seed=7) for _ in range(2))
        assert (decision.index, decision.score) == (again.index, again.score)
        np.testing.assert_array_equal(decision.T_world_camera, OPEN.T_world_camera[decision.index])
        assert decision.why
        assert decision.score == pytest.approx(decision.saliency - decision.cost)
        assert f"candidate {decision.index}, score {decision.score:.3f}: {decision.why}" in repr(decision)
        assert name != "occlusion-aware" or f"times the mean {name} information of all views" in decision.why
        assert name != "farthest" or decision.why.startswith("farthest from earlier views: ")
        if name in ("random", "ring", "farthest"):
            assert decision.candidate_saliency is decision.sphere_saliency is None
            return
        assert decision.sphere_saliency.shape == (40_000,)
        assert decision.sphere_saliency is decision.sphere_saliency
        np.testing.assert_array_equal(decision.sphere_saliency[OPEN.indices], decision.candidate_saliency)
        assert decision.saliency == decision.candidate_saliency[decision.index]

    def test_few_views_no_views_and_an_empty_table(self, name):
        none = Candidates(np.zeros((0, 4, 4)), np.zeros((0, 3)), np.zeros(0), {"a wall stands": 3})
        with pytest.raises(PlanningError, match=r"a wall stands \(3\)"):
            plan(name, [CUBE], offered=none)
        with pytest.raises(PlanningError, match="the robot offers no candidates"):
            plan(name, [CUBE], offered=replace(none, rejected={}))
        empty = plan(name, [])
        if name in ("support", *VOLUMETRIC):
            assert empty.why.endswith("this one is the cheapest")
            assert degrees_between(HOME, OPEN.directions[empty.index]) > 5.0
        recorded = RecordingRobot(SPHERE.poses(np.stack([HOME, direction(0.0, 0.5), direction(1.5, 0.5)])))
        offered = recorded.candidates(SPHERE)
        assert plan(name, [CUBE], (ON_TABLE,), offered=offered).index in (0, 1)
        beside = Candidates(SPHERE.poses(HOME[None]), HOME[None], np.zeros(1), {})
        assert plan(name, [CUBE], offered=beside).index == 0, "where nothing else is left"


def test_the_path_costs_an_angle_a_length_or_nothing():
    index = plan("farthest", [CUBE]).index
    alpha = transforms.angle_between(HOME, OPEN.directions[index])
    assert plan("farthest", [CUBE], path_cost="angle").cost == pytest.approx(np.sin(alpha / 2.0))
    assert plan("farthest", [CUBE], path_cost="path").cost == pytest.approx(OPEN.path_length[index] / 3.0)
    assert plan("farthest", [CUBE], path_cost="none").cost == 0.0
    said = repr(state([CUBE], visited=TWICE))
    assert f"views=2, candidates={len(OPEN)}, graph=" in said


def test_algorithm_2_as_printed_by_hand():
    """Nothing supports the cube: the middle of the largest arc from 180° is 0°, and its saliency is 1.

    Around it saliency falls as exp(−β²/2σ²), σ = 20°, around the view it is −exp(−α²/2σ²) on top of that,
    and h = sin(α/2). Opposite the view at the same elevation of 35°, α = 110° and h = sin 55° = 0.819.
    """
    decision = plan("paper", [CUBE], inhibition=1.0)
    towards = decision.points_of_interest[0].direction
    beta, alpha = (transforms.angle_between(d, OPEN.directions) for d in (towards, HOME))
    decision = pickle.loads(pickle.dumps(decision))  # a step goes to the viewer's process
    sigma = np.deg2rad(20.0)
    saliency = np.exp(-0.5 * (beta / sigma) ** 2) - np.exp(-0.5 * (alpha / sigma) ** 2)
    np.testing.assert_allclose(decision.candidate_saliency, saliency, atol=1e-9)
    score = saliency - np.sin(alpha / 2.0)
    assert decision.index == np.argmax(score)
    assert decision.score == pytest.approx(score.max())
    opposite = np.argmax(OPEN.directions @ direction(0.0, np.deg2rad(35.0)))
    assert np.sin(alpha[opposite] / 2.0) == pytest.approx(0.819, abs=0.01)


RIDER, ASIDE = box(2, (0.0, 0.0, 0.88), (0.06, 0.06, 0.06)), box(3, (0.2, -0.35, 0.8), (0.1, 0.1, 0.1))


def about_aside(x, y, z):
    return (np.abs(x - 0.2) < 0.1) & (np.abs(y + 0.35) < 0.1)


def over_cube(x, y, z):
    return (np.abs(x) < 0.05) & (np.abs(y) < 0.05) & (z > 0.85) & (z < 0.9)


@pytest.mark.parametrize(
    ("probability", "unseen", "expected"),
    [(0.96, 0.0, True), (0.04, 0.0, True), (0.94, 0.0, False), (0.06, 0.0, False), (1.0, 0.1, False)],
)
def test_a_goal_is_settled_once_it_is_known_what_moves_and_that_nothing_unseen_rests_on_it(
    probability, unseen, expected
):
    supports = (replace(ON_TABLE, probability=0.7), Support("o1", "o2", probability=probability))
    graph = SupportGraph((TABLE, CUBE, RIDER), supports)
    told = Removal("o1", (Effect("o2", "", probability),), 1.0, unseen)
    assert settled(graph, "o1", 0.95, told) is expected
    assert not settled(graph, "o9", 0.95, None)
    assert settled(graph, None, 0.7, None) is (probability >= 0.7)
    for voxels, seen in ((known, True), (lambda *objects: half_known(over_cube, *objects), False)):
        share = predict_goal(graph, "o1", voxels(TABLE, CUBE, RIDER), SupportConfig()).unseen
        assert (share == 0.0) == seen


class TestHiddenSurface:
    def test_it_looks_at_the_other_sides_and_never_twice_the_same(self):
        visited = HOME[None]
        for turn in range(4):
            decision = plan("support", [CUBE], (ON_TABLE,), visited=visited)
            chosen = OPEN.directions[decision.index]
            assert degrees_between(visited, chosen).min() > 15.0
            assert turn or chosen @ HOME < 0.5
            assert turn or decision.why == "expected to reveal the most: o1 (100%)"
            visited = np.vstack([visited, chosen])

    @pytest.mark.parametrize(
        ("goal", "counts"),
        [("o1", {"o1", "o2"}), ("o2", {"o1", "o2"}), ("o3", {"o3", SPACE}), ("o9", None), (None, None)],
    )
    def test_with_a_goal_only_what_its_removal_depends_on_counts(self, goal, counts):
        objects, supports = (CUBE, RIDER, ASIDE), (ON_TABLE, Support("o1", "o2"), Support("o0", "o3"))
        voxels = half_known(about_aside, TABLE, *objects)
        now = replace(state(objects, supports), voxels=voxels)
        alone, decision = (decide("support", replace(now, goal=g)) for g in (None, goal))
        hidden = [p for p in decision.points_of_interest if "support" not in p.why]
        found = {p.subject[0] if p.subject else SPACE for p in hidden}
        assert found == (counts or {"o1", "o2", "o3", SPACE})
        named = re.findall(r"(o\d|unseen space)(?: near o3)? \(\d+%\)", decision.why)
        assert named
        assert set(named) <= found
        assert (decision.candidate_saliency <= alone.candidate_saliency).all(), "nothing is worth more"
        assert counts or (decision.candidate_saliency == alone.candidate_saliency).all()

    def test_the_more_a_path_costs_the_shorter_it_is(self):
        lengths = []
        for effort in (0.0, 0.05, 0.5, 100.0):
            decision = plan("support", [CUBE], (ON_TABLE,), effort=effort, inhibition=0.0)
            lengths.append(float(OPEN.path_length[decision.index]))
        assert lengths == sorted(lengths, reverse=True)
        assert lengths[0] > 2.0 * lengths[2] > 0.0
        assert lengths[3] < 0.1


class TestBaselines:
    def tour(self, name, views, offered=OPEN):
        rng, visited = np.random.default_rng(0), HOME[None]
        while len(visited) < views:
            decision = make_planner(name).plan(state([CUBE], visited=visited, offered=offered), rng)
            visited = np.vstack([visited, offered.directions[decision.index]])
        return visited

    def test_a_ring_goes_around_in_equal_steps_and_further_rounds_fill_the_gaps(self):
        visited = self.tour("ring", 4 * STOPS)
        azimuths = np.rad2deg(np.arctan2(visited[:, 1], visited[:, 0]))
        np.testing.assert_allclose(np.diff(azimuths[:STOPS]) % 360.0, 72.0, atol=3.0)
        np.testing.assert_allclose(np.rad2deg(np.arcsin(visited[:, 2])), 35.0, atol=2.0)
        for rounds in (1, 2, 4):
            part = np.sort(azimuths[: rounds * STOPS])
            np.testing.assert_allclose(np.diff(np.append(part, part[0] + 360.0)), 72.0 / rounds, atol=4.0)
        third = plan("ring", [CUBE], visited=visited[:2])
        assert third.why == "stop 3 of 5 around the scene, 144° from the first view"


SIZE, OF_FREE, OF_OCCUPIED = 0.01, 0.12, 0.97
"""Edge of a voxel [m]; occupancy of voxels of one reading's kind seen often enough for the clamp."""
CORNER = np.array([0.3, -0.2, 0.5])
"""Where the maps of these tests begin [m]."""
AHEAD = np.array([[0.0, 0.0, 1.0]])
"""A single ray, the optical axis."""


def entropy(p):
    return float(-p * np.log2(p) - (1.0 - p) * np.log2(1.0 - p))


def along(*states, backwards=False):
    """What a single ray gathers that goes through a row of voxels, whichever of the axes it goes along."""
    found = []
    for axis in range(3):
        row = np.moveaxis(np.array(states)[:, None, None], 0, axis)
        hits, passes = (5 * (row == kind).astype(np.uint8) for kind in (OCCUPIED, FREE))
        voxels = VoxelMap(CORNER, hits, passes, VoxelConfig(size=SIZE))
        middle, ahead = CORNER + SIZE / 2.0, np.eye(3)[axis]
        ends = [middle - 0.5 * ahead, middle + ahead]
        T = transforms.look_at(*(ends[::-1] if backwards else ends))
        found.append(ray_information(voxels, T[None], AHEAD)[0])
    np.testing.assert_allclose(found[1:], np.stack(found[:1] * 2))
    return dict(zip(VOLUMETRIC, found[0], strict=True))


PASS = 1.0 - OF_FREE
OF_EACH = [entropy(OF_FREE), PASS, 0.5 * PASS * entropy(OF_FREE), 0.5 * PASS**2 * entropy(OF_OCCUPIED)]
"""Entropy by visibility of a free, an unknown, a free and an occupied voxel, one behind the other."""


class TestVolumetric:
    @pytest.mark.parametrize(
        ("name", "states", "expected"),
        [
            ("occlusion-aware", (FREE, UNKNOWN, FREE, OCCUPIED, UNKNOWN), sum(OF_EACH)),
            ("unobserved-voxel", (FREE, UNKNOWN, UNKNOWN, OCCUPIED, UNKNOWN), PASS * 1.5),
            # A rear side is an occupied voxel met from an unknown one.
            ("rear-side-voxel", (OCCUPIED, UNKNOWN, UNKNOWN, FREE), 0.0),
            ("rear-side-voxel", (FREE, UNKNOWN, UNKNOWN, OCCUPIED), 1.0),
            ("rear-side-voxel", (UNKNOWN, FREE, OCCUPIED), 0.0),
            ("rear-side-voxel", (UNKNOWN, UNKNOWN, FREE), 0.0),
            ("rear-side-entropy", (UNKNOWN, FREE, UNKNOWN, UNKNOWN, OCCUPIED), 2.0),
            ("rear-side-entropy", (UNKNOWN, UNKNOWN, FREE, OCCUPIED), 0.0),
            ("rear-side-entropy", (UNKNOWN, UNKNOWN), 0.0),
            # From the surface it falls off by 1 cm a voxel.
            ("proximity-count", (FREE, *[UNKNOWN] * 12, OCCUPIED, UNKNOWN), 0.45),
            ("proximity-count", (UNKNOWN, FREE, OCCUPIED), 0.08),
            ("proximity-count", (UNKNOWN, UNKNOWN, FREE), 0.0),
        ],
    )
    def test_information_along_a_ray_by_hand_and_nothing_behind_an_occupied_voxel(
        self, name, states, expected
    ):
        assert along(*states)[name] == pytest.approx(expected, rel=1e-5)
        assert along(*states[::-1], backwards=True)[name] == pytest.approx(expected, rel=1e-5)
        if OCCUPIED in states:
            first = states[: states.index(OCCUPIED) + 1]
            assert along(*first) == pytest.approx(along(*first, UNKNOWN, UNKNOWN, OCCUPIED))


PACKAGE = Path(__file__).parents[1] / "examples" / "planner_package"
PROJECT = tomllib.loads((PACKAGE / "pyproject.toml").read_text())["project"]
((NAME, VALUE),) = PROJECT["entry-points"]["caryatid.planners"].items()


class TestAPlannerOfAnotherPackage:
    """One file and its entry point make a planner."""

    def test_it_is_found_by_its_entry_point_and_listed_with_the_others(self, monkeypatch):
        with pytest.raises(InputError, match=f"unknown planner 'best'.*{', '.join(BUILT_IN)}, oracle"):
            make_planner("best")
        assert isinstance(make_planner("caryatid.planning.planners.baselines:RandomPlanner"), RandomPlanner)
        with pytest.raises(InputError, match="'nowhere:Mine' cannot be made: No module named 'nowhere'"):
            make_planner("nowhere:Mine")
        with pytest.raises(InputError, match="'oracle' requires the ground truth of a simulated scene"):
            make_planner("oracle")
        value = "caryatid.planning.planners.baselines:RandomPlanner"
        offers = [EntryPoint(n, value, "caryatid.planners") for n in ("mine", "support", "oracle")]
        monkeypatch.setattr(
            planners, "entry_points", lambda group: offers if group == offers[0].group else []
        )
        assert list(planners.offered()) == ["mine"], "names of ours stay ours"
        assert isinstance(make_planner("mine"), RandomPlanner)
        assert not isinstance(make_planner("support"), RandomPlanner)
        with pytest.raises(InputError, match=f"{', '.join(BUILT_IN)}, mine, oracle"):
            make_planner("best")

    @pytest.mark.slow
    def test_the_command_line_explores_with_it(self, tmp_path, monkeypatch):
        """The package is installed: its metadata is where and as pip writes it."""
        name, version = PROJECT["name"], PROJECT["version"]
        folder = tmp_path / f"site/{name.replace('-', '_')}-{version}.dist-info"
        folder.mkdir(parents=True)
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
        (folder / "entry_points.txt").write_text(f"[caryatid.planners]\n{NAME} = {VALUE}\n")
        for path in (tmp_path / "site", PACKAGE / "src"):
            monkeypatch.syspath_prepend(path)
        options = ["--planner", NAME, "--views", "2", "--no-report", "--quiet", *SMALL]
        assert run_command("explore", "tower", "--out", tmp_path / "run", *options) == 0
        assert "from above" in (tmp_path / "run/views/00/view.json").read_text()
        assert f'"planner": "{NAME}"' in (tmp_path / "run/run.json").read_text()
