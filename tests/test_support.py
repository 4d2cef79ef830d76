"""Contacts, support relations with their reasons, what a removal does, and shapes made plausible."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import norm
from synthetic import motion_about_vertical

from caryatid.config import PlausibilityConfig, SupportConfig
from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.polygons import area
from caryatid.geometry.shapes import Box, Cylinder, Sphere, Uncertainty
from caryatid.geometry.transforms import UP, rigid
from caryatid.graph import SceneObject, Support
from caryatid.support.contacts import Contact, find_contacts, find_gap
from caryatid.support.equilibrium import support_forces
from caryatid.support.plausibility import closing, drawn, reconcile
from caryatid.support.relations import Effect, Removal, explain, infer, predict_removal, removal_of
from caryatid.support.stability import contact_patch

CONFIG = SupportConfig()
PAPER = replace(CONFIG, stability="area")
PLAUSIBLE = PlausibilityConfig()
TABLE = Box(rigid(np.eye(3), (0.0, 0.0, -0.02)), np.array([1.0, 1.0, 0.04]))
SURFACE = SceneObject("o0", 0, TABLE, "support_surface")


def at(x, y, z, turn=(0.0, 0.0, 0.0)):
    return rigid(transforms.rotation_from_vector(np.radians(turn)), (x, y, z))


def block(x, y, z, size, turn=(0, 0, 0)):
    """A box whose centre is at x, y and whose bottom, if level, is at z."""
    return Box(at(x, y, z + size[2] / 2.0, turn), np.array(size))


def cube(x, y, z, side=0.1):
    return Box(at(x, y, z), np.full(3, side))


def unsure(sigma=0.001, turn=0.001, **sides):
    """All sides this unsure [m], but for those named (`low_z` is −z, `high_z` +z)."""
    names = ("low_x", "high_x", "low_y", "high_y", "low_z", "high_z")
    each = np.array([sides.get(name, sigma) for name in names])
    position = np.sqrt((each.reshape(3, 2) ** 2).sum(axis=1)) / 2.0
    return Uncertainty(position, np.full(3, turn), 2.0 * position, each)


def scene(*shapes, uncertainty=None):
    objects = [SceneObject(f"o{k}", k, shape, uncertainty=uncertainty) for k, shape in enumerate(shapes, 1)]
    return [SURFACE, *objects]


def edges(graph):
    return {s.pair: s.kind for s in graph.supports}


def random_shapes(count, rng, side):
    shapes = []
    for k in range(count):
        T = rigid(transforms.random_rotation(rng), rng.uniform(-side, side, 3))
        a, b, c = rng.uniform(0.04, 0.15, 3)
        shapes.append([Box(T, np.array([a, b, c])), Cylinder(T, a / 2.0, b), Sphere(T, a / 2.0)][k % 3])
    return shapes


def about_vertical(objects, T):
    return [replace(o, shape=o.shape.moved(T)) for o in objects]


def tower():
    return scene(
        block(0, 0, 0, (0.1, 0.1, 0.08)),
        Cylinder(at(0.01, 0, 0.13), 0.04, 0.1),
        Sphere(at(0.01, 0, 0.21), 0.03),
        block(0.2, 0, 0, (0.08, 0.08, 0.08)),
    )


def bridge(left=0.0, right=0.0):
    return scene(
        block(-0.12, 0, 0, (0.06, 0.06, 0.1 + left)),
        block(0.12, 0, 0, (0.06, 0.06, 0.1 + right)),
        block(0, 0, 0.1, (0.32, 0.06, 0.02)),
    )


def counterweight(load_x=0.0, **fields):
    return scene(
        block(0, 0, 0, (0.1, 0.1, 0.1)),
        block(0.14, 0, 0.1, (0.36, 0.06, 0.02)),
        Cylinder(at(load_x, 0, 0.165), 0.04, 0.09),
        **fields,
    )


def leaning_plank(gap=0.0):
    """A thin board that stands 12° off the upright with its upper part against the edge of a block."""
    board = Box(at(0, 0, 0, (0, 12, 0)), np.array([0.01, 0.08, 0.24]))
    board = board.moved(at(0, 0, board.support(np.array([[0.0, 0.0, -1.0]]))[0]))
    top = board.T_world_object[:3] @ np.array([0.005, 0.0, 0.1, 1.0])
    return scene(board, block(top[0] + gap + 0.03, 0, 0, (0.06, 0.1, top[2])))


class TestContacts:
    @pytest.mark.parametrize("margin", [0.001, 0.005, 0.02])
    def test_margin_is_the_largest_gap(self, margin):
        near, far = cube(0, 0, 0.1 + 0.95 * margin), cube(0, 0, 0.1 + 1.05 * margin)
        assert [(c.a, c.b) for c in find_contacts([cube(0, 0, 0), near], margin)] == [(0, 1)]
        assert find_contacts([cube(0, 0, 0), far], margin) == []

    @pytest.mark.parametrize(
        ("upper", "lower"),
        [
            (cube(0, 0, 0.1), cube(0, 0, 0)),
            (Cylinder(at(0, 0, 0.1), 0.03, 0.1), cube(0, 0, 0)),
            (Sphere(at(0, 0, 0.08), 0.03), Cylinder(at(0, 0, 0), 0.04, 0.1)),
            (Cylinder(at(0, 0, 0.1), 0.03, 0.1), Cylinder(at(0, 0, 0), 0.04, 0.1)),
            (Sphere(at(0, 0, 0.08), 0.03), Sphere(at(0, 0, 0), 0.05)),
        ],
    )
    def test_every_pair_of_kinds_touches_with_the_normal_from_a_to_b(self, upper, lower):
        for gap in (0.004, -0.004):
            lifted = upper.moved(at(0, 0, gap))
            (up,) = find_contacts([lower, lifted], 0.01)
            (down,) = find_contacts([lifted, lower], 0.01)
            np.testing.assert_allclose(up.normal_world, (0, 0, 1), atol=1e-3)
            np.testing.assert_allclose(down.normal_world, (0, 0, -1), atol=1e-3)
            assert up.distance == pytest.approx(gap, abs=1e-4)
            np.testing.assert_allclose(up.points_world[:, 2].mean(), 0.05 + gap / 2.0, atol=1e-3)
            np.testing.assert_allclose(up.point_world, up.points_world.mean(axis=0), atol=1e-12)

    def test_distances_agree_with_the_signed_distance_whatever_was_asked_before(self):
        rng = np.random.default_rng(3)
        seen = 0
        for count in (9, 30, 3, 17, 2, 70, 16):
            shapes = random_shapes(count, rng, 0.05 * count ** (1.0 / 3.0))
            found = find_contacts(shapes, 0.02)
            assert [(c.a, c.b) for c in found] == sorted((c.a, c.b) for c in found if c.a < c.b)
            for c in found:
                assert np.linalg.norm(c.normal_world) == pytest.approx(1.0)
                if c.distance > 0.0:
                    seen += 1
                    apart = [shapes[k].signed_distance(c.points_world) for k in (c.a, c.b)]
                    assert sum(apart).min() == pytest.approx(c.distance, abs=5e-4)
        assert seen > 30

    def test_threads_do_not_disturb_each_other(self):
        rng = np.random.default_rng(12)
        scenes = [random_shapes(25, rng, 0.15) for _ in range(20)]

        def gaps(shapes):
            return [(c.a, c.b, c.distance) for c in find_contacts(shapes, 0.01)]

        alone = [gaps(shapes) for shapes in scenes]
        with ThreadPoolExecutor(4) as pool:
            assert list(pool.map(gaps, scenes)) == alone

    def test_few_shapes_and_bad_margins(self):
        assert find_contacts([], 0.01) == find_contacts([cube(0, 0, 0)], 0.01) == []
        for bad in (-0.001, float("nan")):
            with pytest.raises(InputError, match="margin"):
                find_contacts([cube(0, 0, 0), cube(0, 0, 0.1)], bad)


def patch_of(shape, other, normal_world, points=((0.0, 0.0, 0.0),)):
    points = np.array(points)
    contact = Contact(0, 1, (other, shape), points, points.mean(axis=0), normal_world, 0.0)
    return contact_patch(contact, CONFIG)


class TestPolygons:
    def test_contact_patch_of_a_ball_is_a_small_disc_and_its_outline_a_large_one(self):
        ball = Sphere(at(0.1, 0.2, 0.04), 0.04)
        patch = patch_of(ball, TABLE, UP)
        depth = CONFIG.patch_depth
        assert area(patch) == pytest.approx(np.pi * depth * (0.08 - depth), rel=0.01)
        np.testing.assert_allclose(patch.mean(axis=0), (0.1, 0.2), atol=1e-9)
        assert area(ball.footprint()) == pytest.approx(np.pi * 0.04**2, rel=0.01)
        slope = block(0, 0, 0, (0.4, 0.4, 0.02), (40, 30, 0))
        normal_world = slope.T_world_object[:3, 2]
        steep = Sphere(rigid(np.eye(3), slope.T_world_object[:3, 3] + 0.05 * normal_world), 0.04)
        disc = patch_of(steep, slope, normal_world)
        assert area(disc) == pytest.approx(area(patch) * normal_world[2], rel=1e-6)
        touching = steep.T_world_object[:3, 3] - (0.04 - depth) * normal_world
        np.testing.assert_allclose(disc.mean(axis=0), touching[:2], atol=1e-9)
        lying = Cylinder(at(0, 0, 0.03, (90, 0, 0)), 0.03, 0.2)
        np.testing.assert_allclose(np.ptp(lying.footprint(), axis=0), (0.06, 0.2), atol=1e-3)

    def test_a_long_face_that_is_turned_still_touches_all_over(self):
        long = block(0, 0, 0, (0.3, 0.05, 0.05), (0, 0.9, 0))
        steep = block(0, 0, 0, (0.3, 0.05, 0.05), (0, 3, 0))
        assert np.ptp(patch_of(long, TABLE, UP)[:, 0]) > 0.29
        assert np.ptp(patch_of(steep, TABLE, UP)[:, 0]) < 0.15

    def test_where_the_caps_do_not_overlap_the_contact_points_stand_in(self):
        points = np.array([[0.0, 0.0, 0.1], [0.1, 0.0, 0.1], [0.0, 0.1, 0.1]])
        apart = patch_of(cube(1, 0, 0.1), cube(0, 0, 0), UP, points)
        assert area(apart) == pytest.approx(0.005)


class TestInfer:
    def test_a_tower_stands_bottom_up_whatever_the_order_of_its_objects(self):
        graph = infer(tower(), CONFIG)
        assert edges(graph) == dict.fromkeys(
            [("o0", "o1"), ("o1", "o2"), ("o2", "o3"), ("o0", "o4")], "bottom-up"
        )
        assert all(s.certain and s.occurrences == s.opportunities == 1 for s in graph.supports)
        assert [o.id for o in graph.objects] == ["o0", "o1", "o2", "o3", "o4"]
        assert set(graph.stability) == {"o1", "o2", "o3", "o4"}
        assert all(s.stable for s in graph.stability.values())
        assert [s.pair for s in infer(tower()[::-1], CONFIG).supports] == [s.pair for s in graph.supports]
        for support in graph.supports:
            np.testing.assert_allclose(support.normal_world, (0.0, 0.0, 1.0), atol=0.01)
        np.testing.assert_allclose(graph.support("o1", "o2").contact_world, (0.01, 0.0, 0.08), atol=2e-3)

    @pytest.mark.parametrize(("left", "right"), [(0.0, 0.0), (-0.009, 0.0), (0.0, -0.009), (0.008, -0.004)])
    def test_a_bridge_keeps_both_pillars_at_different_noise_heights(self, left, right):
        found = edges(infer(bridge(left, right), CONFIG))
        assert {("o1", "o3"), ("o2", "o3")} <= set(found)
        assert ("o0", "o3") not in found

    def test_a_far_contact_is_believed_only_where_needed(self):
        """The bridges above need one as far away as this."""
        steady = scene(
            block(-0.04, 0, 0, (0.14, 0.06, 0.1)),
            block(0.1, 0, 0, (0.06, 0.06, 0.091)),
            block(0.0, 0, 0.1, (0.24, 0.06, 0.02)),
        )
        spare = infer(steady, CONFIG)
        assert edges(spare)["o1", "o3"] == "bottom-up"
        assert spare.support("o2", "o3") is None
        assert "o3 rests without it (gap 9.0 mm" in explain(spare, "o2", "o3", CONFIG)

    @pytest.mark.parametrize("overlap", [-0.004, 0.0, 0.004, 0.01])
    def test_neighbours_side_by_side_support_nothing(self, overlap):
        objects = scene(
            block(0, 0, 0, (0.1, 0.1, 0.1)),
            block(0.1 - overlap, 0.01, 0, (0.1, 0.1, 0.14)),
            Cylinder(at(0, 0.09 - overlap, 0.06), 0.04, 0.12),
        )
        assert set(edges(infer(objects, CONFIG))) == {("o0", "o1"), ("o0", "o2"), ("o0", "o3")}

    def test_a_counterweight_holds_top_down(self):
        graph = infer(counterweight(), replace(CONFIG, draws=60))
        assert edges(graph)["o3", "o2"] == "top-down"
        assert edges(graph)["o2", "o3"] == "bottom-up"
        assert graph.support("o3", "o2").doubtful
        assert graph.stability["o2"].tips
        assert graph.stability["o2"].overhang == pytest.approx(0.09, abs=0.002)
        assert graph.support("o3", "o2").why.startswith("o3 holds o2 down (")

    def test_on_paper_only_the_support_area_ratio_counts(self):
        """The plank, 36 cm × 6 cm, touches its block over 9 cm × 6 cm: r_s = 9/36 = 0.25, eq. 1."""
        objects = counterweight(load_x=0.2)
        assert ("o3", "o2") not in edges(infer(objects, CONFIG))
        stable = infer(objects, PAPER)
        assert stable.stability["o2"].ratio == pytest.approx(0.25)
        assert stable.stability["o2"].stable
        assert ("o3", "o2") not in edges(stable)
        unstable = infer(objects, replace(PAPER, min_area_ratio=0.26))
        assert edges(unstable)["o3", "o2"] == "top-down"
        assert not unstable.support("o3", "o2").certain

    def test_a_plank_leans_on_what_it_touches_not_on_what_is_near(self):
        board, block_ahead = (o.shape for o in leaning_plank()[1:])
        near, beside = (block_ahead.moved(at(*by)) for by in ((0.008, 0.06, 0), (0.0, -0.06, 0)))
        held = edges(infer(scene(board, near, beside), CONFIG))
        assert held["o3", "o1"] == "lean"
        assert ("o2", "o1") not in held

    @pytest.mark.parametrize("gap", [0.0, 0.004, 0.008])
    def test_a_plank_leans(self, gap):
        graph = infer(leaning_plank(gap), CONFIG)
        assert edges(graph) == {
            ("o0", "o1"): "bottom-up",
            ("o0", "o2"): "bottom-up",
            ("o2", "o1"): "lean",
        }
        assert "o1 leans on o2 with" in graph.support("o2", "o1").why

    def test_a_plank_does_not_lean_on_what_stands_behind_or_beside_it(self):
        board = leaning_plank()[1].shape
        foot = board.T_world_object[:3] @ np.array([-0.005, 0.0, -0.1, 1.0])
        behind = block(foot[0] - 0.032, 0, 0, (0.06, 0.1, 0.06))
        beside = block(board.T_world_object[0, 3], 0.072, 0, (0.1, 0.06, 0.2))
        graph = infer(scene(board, behind, beside), CONFIG)
        assert {s.supporter for s in graph.supporters("o1")} == {"o0"}
        assert graph.stability["o1"].tips

    @pytest.mark.parametrize("gap", [0.015, -0.02])
    def test_what_no_uncertainty_explains_is_doubtful(self, gap):
        """A gap, and an overlap, of five standard deviations and more."""
        known = unsure(0.002, 0.0)
        objects = [SURFACE, thing(1, (0, 0, 0.05), known), thing(2, (0, 0, 0.15 + gap), known)]
        support = infer(objects, CONFIG).support("o1", "o2")
        assert support.doubtful
        assert support.kind == "bottom-up"

    def test_what_could_carry_a_floating_board_shares_the_probability(self):
        """A ball is nearest, two pillars are a little further below, and any of them may be hidden higher."""
        pillars = [block(0, y, 0, (0.06, 0.06, 0.11)) for y in (-0.15, 0.15)]
        ball, board = Sphere(at(0.01, 0.0, 0.085), 0.03), block(0, 0, 0.13, (0.16, 0.42, 0.02))
        graph = infer(scene(*pillars, ball, board, uncertainty=unsure(0.002, 0.0)), replace(CONFIG, draws=60))
        assert {s.supporter for s in graph.supporters("o4")} >= {"o1", "o2"}
        assert all(s.doubtful for s in graph.supporters("o4"))

    def test_what_touches_nothing_is_let_down(self):
        objects = scene(block(0, 0, 0, (0.1, 0.1, 0.05)), block(0.02, 0, 0.08, (0.05, 0.05, 0.05)))
        graph = infer(objects, CONFIG)
        support = graph.support("o1", "o2")
        assert support.kind == "bottom-up"
        assert ("o0", "o2") not in edges(graph)
        assert graph.stability["o2"].overhang == pytest.approx(-0.025, abs=1e-3)
        assert [s.pair for s in infer(objects, replace(CONFIG, max_drop=0.02)).supports] == [("o0", "o1")]

    def test_what_is_let_down_rests_on_all_it_meets_at_once(self):
        def over(right):
            pillars = [block(x, 0, 0, (0.06, 0.06, z)) for x, z in ((-0.12, 0.1), (0.12, right))]
            return infer(scene(*pillars, block(0, 0, 0.12, (0.32, 0.06, 0.02))), CONFIG)

        assert {("o1", "o3"), ("o2", "o3")} <= set(edges(over(0.099)))
        assert ("o2", "o3") not in edges(over(0.06))

    @pytest.mark.parametrize("gap", [1.5e-3, 4e-3])
    def test_a_wall_beside_does_not_stop_what_is_let_down(self, gap):
        graph = infer(
            scene(
                block(0, 0, 0, (0.1, 0.1, 0.05)),
                block(0.04 + gap, 0, 0.08, (0.05, 0.05, 0.05)),
                block(0.09 + 2 * gap, 0, 0, (0.05, 0.05, 0.12)),
            ),
            CONFIG,
        )
        assert [s.supporter for s in graph.supporters("o2")] == ["o1"]

    def test_what_steep_faces_hold_by_friction_does_not_reach_the_table(self):
        held = Box(at(-0.0371, 0.0598, 0.0932, (40.59, 0.11, 86.58)), np.array([0.0648, 0.1042, 0.1174]))
        turned = Box(at(-0.0263, -0.0127, 0.0534, (6.74, 121.27, 126.69)), np.array([0.0958, 0.1048, 0.0627]))
        upright = Box(at(-0.0698, 0.1592, 0.0322, (-168.09, -64.4, 0.0)), np.array([0.1224, 0.072, 0.0648]))
        graph = infer(scene(turned, upright, held), CONFIG)
        assert {s.supporter for s in graph.supporters("o3")} == {"o1", "o2"}

    def test_an_object_in_the_air_has_no_supporter(self):
        graph = infer(scene(Sphere(at(0, 0, 0.4), 0.03)), CONFIG)
        assert graph.supports == ()
        assert graph.stability["o1"].overhang == np.inf
        assert not graph.stability["o1"].stable
        assert "they do not touch, gap 370.0 mm" in explain(graph, "o0", "o1", CONFIG)

    def test_the_support_surface_lies_below_everything(self):
        sunk = infer(scene(block(0, 0, -0.025, (0.06, 0.06, 0.05))), CONFIG)
        assert edges(sunk) == {("o0", "o1"): "bottom-up"}
        assert "nothing supports it" in explain(sunk, "o1", "o0", CONFIG)

    def test_no_objects_no_support_surface_or_the_same_id_twice(self):
        assert infer([], CONFIG).supports == infer([SURFACE], CONFIG).supports == ()
        assert set(edges(infer(tower()[1:], CONFIG))) == {("o1", "o2"), ("o2", "o3")}
        with pytest.raises(InputError, match="same id"):
            infer([*tower(), tower()[1]], CONFIG)

    def test_a_motion_about_the_vertical_changes_nothing(self):
        rng = np.random.default_rng(11)
        for objects in (tower(), bridge(), counterweight(), leaning_plank()):
            moved = about_vertical(objects, motion_about_vertical(rng))
            assert edges(infer(moved, CONFIG)) == edges(infer(objects, CONFIG))
        changed = 0
        for _ in range(6):
            heap = scene(*random_shapes(7, rng, 0.1))
            shares, others = (
                support_forces(objects, CONFIG, np.random.default_rng(0)).shares
                for objects in (heap, about_vertical(heap, motion_about_vertical(rng)))
            )
            changed += np.sum(np.abs(shares - others) > 2.01 / CONFIG.draws)
        # Rounding decides where a force lies at a threshold; in the first draw, it decides for all.
        assert changed <= 3

    def test_why_not(self):
        objects = [*tower(), SceneObject("o5", 5, block(0.281, 0, 0, (0.08, 0.08, 0.08)))]
        graph = infer(objects, CONFIG)
        assert explain(graph, "o0", "o1", CONFIG) == f"{graph.supports[0].why} Probability 1.00."
        assert graph.supports[0].why.startswith("o1 rests on o0 with ")
        assert "they do not touch, gap 80.0 mm" in explain(graph, "o0", "o2", CONFIG)
        assert explain(graph, "o2", "o1", CONFIG).startswith("o2 does not support o1: o1 rests without it (")
        beside = explain(graph, "o4", "o5", CONFIG)
        assert "o5 rests without it (gap 1.0 mm, normal 90° from the vertical). Probability 0.00." in beside
        assert explain(infer(objects, PAPER), "o2", "o1", PAPER).startswith(
            "o2 does not support o1: o2 is not"
        )
        with pytest.raises(InputError, match="not an object of the graph"):
            explain(graph, "o1", "o9", CONFIG)
        with pytest.raises(InputError, match="itself"):
            explain(graph, "o1", "o1", CONFIG)


SCENES = Path(__file__).parents[2] / "shared" / "scenes"


@pytest.mark.slow
@pytest.mark.skipif(not SCENES.is_dir(), reason="needs ../shared/scenes")
def test_true_shapes_of_the_shared_primitive_scenes_give_their_edges():
    from caryatid.simulation.scenes import load_scene
    from caryatid.simulation.truth import read_truth
    from caryatid.simulation.world import static_boxes, true_shapes

    right = wrong = missed = 0
    for folder in [f for f in sorted(SCENES.iterdir()) if not f.name.startswith(("ycb", "house", "storey"))]:
        loaded = load_scene(str(folder / "scene.xml"))
        names = {0: "table", **loaded.object_bodies}
        objects = [
            SceneObject(names[k], k, shape, "object" if k else "support_surface")
            for k, shape in {0: static_boxes(loaded)[0], **true_shapes(loaded)}.items()
        ]
        truth = read_truth(folder / "gt.json").pairs
        found = set(edges(infer(objects, CONFIG)))
        right += len(found & truth)
        wrong += len(found - truth)
        missed += len(truth - found)
    assert right / (right + wrong) >= 0.97
    assert right / (right + missed) >= 0.97


class TestProbabilities:
    def likely(self, objects, config=CONFIG, seed=0):
        return {s.pair: s.probability for s in infer(objects, config, np.random.default_rng(seed)).supports}

    def test_what_nothing_speaks_against_is_certain(self):
        assert set(self.likely(tower()).values()) == {1.0}
        graph = infer(tower(), CONFIG)
        assert [o.probability for o in graph.objects] == [1.0] * 5
        assert all(s.probability is None for s in infer(tower(), PAPER).supports)

    def test_a_counterweight_of_unknown_weight_holds_as_often_as_it_is_heavy_enough(self):
        """The plank's moment is 4.32·10⁻⁴·0.09 m⁴, the weight's 4.52·10⁻⁴·0.05 m⁴.

        So the weight must be 1.72 times as dense. Of two densities from 100 to 8000 kg/m³ that is so in 28 %
        of all draws, and these count ten times the others.
        """
        many = replace(CONFIG, draws=300)
        heavy = 0.28 / (0.28 + 0.72 * many.unexplained)
        assert self.likely(counterweight(), many)["o3", "o2"] == pytest.approx(heavy, abs=0.06)

    def test_a_contact_that_would_open_by_the_uncertainty_is_less_likely(self):
        """A slab that one block carries alone lies 2 mm over a second one: it may rest on that, or not."""

        def shown(sigma):
            known = unsure(sigma, 0.0)
            first = thing(1, (0, 0, 0.05), known, (0.16, 0.2, 0.1))
            second = thing(2, (0.12, 0, 0.0485), known, (0.06, 0.2, 0.097))
            slab = thing(3, (0.05, 0, 0.11), known, (0.24, 0.1, 0.02))
            return self.likely([SURFACE, first, second, slab], replace(CONFIG, draws=60)).get(("o2", "o3"))

        assert shown(0.0002) is None
        assert 0.5 < shown(0.003) < 0.98

    def test_an_object_whose_size_is_a_guess_is_less_likely_the_one_it_is_taken_for(self):
        sides = scene(cube(0, 0, 0.05), uncertainty=unsure(0.001, high_x=0.1))
        _, guessed = infer(sides, replace(CONFIG, draws=60)).objects
        _, sure = infer(scene(cube(0, 0, 0.05), uncertainty=unsure(0.001)), CONFIG).objects
        assert sure.probability == 1.0
        assert 0.3 < guessed.probability < 0.9

    def test_draws_come_from_the_generator(self):
        objects = [replace(o, uncertainty=unsure(0.003, 0.01)) for o in counterweight()[1:]]
        objects = [SURFACE, *objects]
        assert self.likely(objects, seed=1) == self.likely(objects, seed=1)
        assert self.likely(objects, seed=1) != self.likely(objects, seed=2)


class TestRemoval:
    def effects(self, objects, taken):
        found = predict_removal(infer(objects, CONFIG), taken, CONFIG)
        return {e.object_id: e.probability > 0.95 for e in found}

    def test_all_that_stands_on_it_falls_for_certain(self):
        assert self.effects(tower(), "o1") == {"o2": True, "o3": True}
        assert self.effects(tower(), "o2") == {"o3": True}
        assert self.effects(tower(), "o3") == self.effects(tower(), "o4") == {}
        (effect,) = predict_removal(infer(tower(), CONFIG), "o2", CONFIG)
        assert effect.why == "it loses the support of o2"

    def test_a_bridge_falls_with_one_pillar_but_a_slab_on_four_legs_stays(self):
        assert self.effects(bridge(), "o1") == {"o3": True}
        legs = [block(x, y, 0, (0.05, 0.05, 0.1)) for x in (-0.1, 0.1) for y in (-0.1, 0.1)]
        middle = block(0, 0, 0, (0.08, 0.08, 0.1))
        assert self.effects(scene(*legs, middle, block(0, 0, 0.1, (0.3, 0.3, 0.02))), "o5") == {}

    def test_what_the_fits_do_not_tell_for_sure_may_fall(self):
        """Without o2 the slab's centre is 5 mm outside what is left, and unsure by 10 mm: 69 % tip at all."""
        pillars = [thing(k, (x, 0, 0.05), None, (0.06, 0.06, 0.1)) for k, x in ((1, -0.035), (2, 0.1))]
        slab = thing(3, (0, 0, 0.11), unsure(0.0, 0.0, low_x=0.02), (0.3, 0.06, 0.02))
        graph, many = infer([SURFACE, *pillars, slab], CONFIG), replace(CONFIG, draws=300)
        (effect,) = predict_removal(graph, "o2", many)
        assert effect.object_id == "o3"
        assert 0.4 < effect.probability < norm.cdf(0.5)

    def test_that_nothing_else_moves_is_less_likely_than_that_each_stays(self):
        """Without o2, each of two slabs has its centre 12 mm inside what is left, and unsure by 10 mm."""
        objects = [SURFACE, thing(2, (0.1, 0, 0.05), None, (0.06, 0.4, 0.1))]
        for k, y in ((3, -0.15), (5, 0.15)):
            objects.append(thing(k, (-0.018, y, 0.05), None, (0.06, 0.06, 0.1)))
            objects.append(thing(k + 1, (0, y, 0.11), unsure(0.0, 0.0, low_x=0.02), (0.3, 0.06, 0.02)))
        many = replace(CONFIG, draws=300)
        removal = removal_of(infer(objects, many), "o2", many)
        assert {e.object_id for e in removal.effects} == {"o4", "o6"}
        assert removal.moving == ()
        stay = [1.0 - e.probability for e in removal.effects]
        assert removal.rest == pytest.approx(np.prod(stay), abs=0.02)
        assert removal.rest < min(stay) - 0.02
        few = removal_of(infer(tower(), CONFIG), "o2", CONFIG)
        assert [e.object_id for e in few.moving] == ["o3"]
        assert 0.9 < few.rest < 1.0, "a few draws make nothing certain"

    def test_a_removal_is_told_in_a_sentence(self):
        effects = tuple(Effect(i, "", p) for i, p in (("o2", 1.0), ("o3", 1.0), ("o5", 0.4), ("o6", 0.04)))
        text = "o2 and o3 move (1.00), o5 moves (0.40), nothing else moves (0.93)"
        assert str(Removal("o1", effects, 0.93, 0.02)) == text
        assert str(Removal("o1", effects[3:], 0.93, 0.5)) == (
            "nothing else moves (0.93), 50% of the space on o1 is unseen"
        )

    def test_what_is_held_down_moves_without_its_weight_and_takes_others_along(self):
        assert self.effects(counterweight(), "o3") == {"o2": True}
        rider = SceneObject("o4", 4, Sphere(at(0.24, 0.0, 0.14), 0.02))
        assert "o4" in self.effects([*counterweight(), rider], "o3")

    def test_what_an_earlier_view_was_surer_of_still_counts(self):
        graph = infer(scene(*(o.shape for o in tower()[1:])), CONFIG)
        assert predict_removal(graph, "o4", CONFIG) == ()
        earlier = Support("o4", "o3", probability=0.6)
        (effect,) = predict_removal(replace(graph, supports=(*graph.supports, earlier)), "o4", CONFIG)
        assert (effect.object_id, effect.probability) == ("o3", pytest.approx(0.6))

    def test_unknown_objects_and_the_table_are_refused(self):
        graph = infer(tower(), CONFIG)
        with pytest.raises(InputError, match="not an object of the graph"):
            predict_removal(graph, "o9", CONFIG)
        with pytest.raises(InputError, match="support surface"):
            predict_removal(graph, "o0", CONFIG)


def thing(label, centre, known, size=(0.1, 0.1, 0.1)):
    return SceneObject(f"o{label}", label, Box(rigid(np.eye(3), centre), np.array(size)), uncertainty=known)


def ramp(degrees):
    """A board whose upper face goes through the lower edge of a beam, x = 0.15 m and z = 4 mm, this steep."""
    face = at(0.15, 0.0, 0.004, (0, -degrees, 0))
    return Box(face @ at(0.0, 0.0, -0.005), np.array([0.06, 0.2, 0.01]))


HOVERING = (0.0, 0.0, 0.055)
CAN = Cylinder(at(0, 0, 0.05), 0.04, 0.1)


class TestReconcile:
    def test_what_neither_overlaps_nor_floats_stays_the_object_it_is(self):
        right = [SURFACE, thing(1, (0, 0, 0.05), unsure()), thing(2, (0.3, 0, 0.05), unsure())]
        assert all(a is b for a, b in zip(reconcile(right, PLAUSIBLE), right, strict=True))
        sunk = thing(1, (0.0, 0.0, 0.048), unsure(0.003))
        _, moved, same = reconcile([SURFACE, sunk, right[2]], PLAUSIBLE)
        assert moved.shape is not sunk.shape
        assert same is right[2]

    @pytest.mark.parametrize(
        "shape", [cube(*HOVERING), Cylinder(at(*HOVERING), 0.03, 0.1), Sphere(at(*HOVERING), 0.05)]
    )
    def test_what_hovers_is_let_down_onto_what_carries_it(self, shape):
        hovering = SceneObject("o1", 1, shape, uncertainty=unsure(0.004))
        _, after = reconcile([SURFACE, hovering], PLAUSIBLE)
        assert -0.0012 < find_gap(TABLE, after.shape) < 0.0012
        assert after.shape.kind == shape.kind
        beyond = replace(hovering, shape=hovering.shape.moved(at(0, 0, 0.007)))
        assert reconcile([SURFACE, beyond], PLAUSIBLE)[1] is beyond

    @pytest.mark.parametrize(
        ("shape", "degrees", "away", "thinner"),
        [
            *((shape, a, 2.56, 1.28) for shape in (CAN, Sphere(at(0, 0, 0.04), 0.04)) for a in (0, 30, 90)),
            *((cube(0, 0, 0.04, 0.08), a, 1.92, 1.92) for a in (0, 90)),
        ],
    )
    def test_an_overlap_is_shared_out_by_variance(self, shape, degrees, away, thinner):
        """4 mm in a wall that is sure, contact sure to 1 mm²: of round shapes centre 16, radius 8 mm².

        The centre takes 4·16/25 = 2.56 mm, the radius 4·8/25 = 1.28 mm, to whichever side the wall is. A side
        of a box, 24 mm², takes 4·24/25 = 3.84 mm, by which the box is thinner, its centre half as far away.
        """
        towards = transforms.rotation_from_vector((0, 0, np.radians(degrees)))[:, 0]
        wall = Box(at(*(0.136 * towards[:2]), 0.1, (0, 0, degrees)), np.array([0.2, 0.4, 0.2]))
        level, radius = np.array([1.0, 1.0, 0.0]), np.sqrt(8e-6)
        known = Uncertainty(
            0.004 * level, np.zeros(3), 2.0 * radius * level, np.repeat(level, 2) * 24e-6**0.5
        )
        before = SceneObject("o1", 1, shape, uncertainty=known)
        once = replace(PLAUSIBLE, rounds=1)
        _, after, _ = reconcile([SURFACE, before, SceneObject("o2", 2, wall)], once)
        moved = before.centre_world - after.centre_world
        np.testing.assert_allclose(1000.0 * moved, away * towards, atol=0.05)
        reach = [s.support(np.stack([towards, (0.0, 0.0, 1.0)])) for s in (shape, after.shape)]
        assert 1000.0 * (reach[0] - reach[1])[0] == pytest.approx(thinner, abs=0.05)

    @pytest.mark.parametrize(
        ("others", "bottom", "down"),
        [
            ([block(-0.12, 0, 0, (0.06, 0.06, 0.1)), block(0.12, 0, 0, (0.06, 0.06, 0.103))], 0.106, 3.0),
            ([ramp(20.0)], 0.004, 0.0),
            ([ramp(40.0)], 0.004, 4.0),
        ],
    )
    def test_what_hangs_comes_down_on_the_nearest_thing_level_enough_to_carry_it(self, others, bottom, down):
        """Of the way down an unseen lower side, 25 mm², takes 25/26 where a contact is sure to 1 mm²."""
        beam = block(0, 0, bottom, (0.3, 0.1, 0.05))
        hanging = SceneObject("o9", 9, beam, uncertainty=unsure(0.0, 0.0, low_z=0.005))
        objects = [*scene(*others), hanging]
        for order in (objects, objects[::-1]):
            (after,) = (o for o in reconcile(order, replace(PLAUSIBLE, rounds=1)) if o.id == "o9")
            lower, upper = after.centre_world[2] + np.array([-0.5, 0.5]) * after.shape.extents[2]
            assert 1000.0 * (bottom - lower) == pytest.approx(down * 25.0 / 26.0, abs=0.05)
            assert upper == pytest.approx(bottom + 0.05)

    def test_what_uncertainty_cannot_explain_stays_and_is_reported(self):
        first, second = (thing(k, (x, 0, 0.05), unsure(0.0005)) for k, x in ((1, 0.0), (2, 0.06)))
        for before, after in zip(
            [first, second], reconcile([SURFACE, first, second], PLAUSIBLE)[1:], strict=True
        ):
            np.testing.assert_array_equal(before.shape.T_world_object, after.shape.T_world_object)
            other = "o2" if after.id == "o1" else "o1"
            assert after.doubt == f"overlaps {other} by 40 mm, more than both fits explain"
        floating = thing(1, (0.0, 0, 0.058), unsure(0.0005))
        table, after = reconcile([SURFACE, floating], PLAUSIBLE)
        assert after.doubt == "floats over o0 by 8 mm, more than both fits explain"
        assert table.doubt == ""

    def test_without_uncertainty_or_rounds_nothing_moves(self):
        unknown = [SURFACE, thing(1, (0, 0, 0.045), None)]
        np.testing.assert_array_equal(reconcile(unknown, PLAUSIBLE)[1].centre_world, (0, 0, 0.045))
        sure = [SURFACE, thing(1, (0, 0, 0.048), unsure(0.01))]
        assert reconcile(sure, replace(PLAUSIBLE, rounds=0))[1] is sure[1]

    def test_gaps_close_as_the_dense_filter_says(self):
        rng, count, objects = np.random.default_rng(0), 50, 27
        first = rng.integers(0, objects - 1, count)
        pairs = np.stack([first, first + rng.integers(1, objects - first)], axis=1)
        rows, gaps = rng.normal(size=(count, 2, 9)), rng.normal(0.0, 0.003, count)
        variance = rng.uniform(0.0, 1e-5, (objects, 9))
        variance[0] = 0.0
        J = np.zeros((count, objects, 9))
        for k, pair in enumerate(pairs):
            J[k, pair] = rows[k]
        J = J.reshape(count, -1)
        scatter = (J * variance.ravel()) @ J.T + 1e-6 * np.eye(count)
        expected = variance * (J.T @ np.linalg.solve(scatter, gaps)).reshape(objects, 9)
        np.testing.assert_allclose(closing(pairs, rows, variance, gaps, 1e-6), expected, atol=1e-12)

    def test_the_correction_moves_with_the_scene(self):
        objects = [
            SURFACE,
            thing(1, (0.0, 0, 0.05), unsure(0.002, turn=0.03)),
            thing(2, (0.097, 0.01, 0.052), unsure(0.003, turn=0.03)),
        ]
        T = motion_about_vertical(np.random.default_rng(5))
        moved = about_vertical(objects, T)
        for here, there in zip(reconcile(objects, PLAUSIBLE), reconcile(moved, PLAUSIBLE), strict=True):
            np.testing.assert_allclose(T @ here.shape.T_world_object, there.shape.T_world_object, atol=2e-4)
            np.testing.assert_allclose(here.shape.extents, there.shape.extents, atol=2e-4)

    def test_draws_follow_the_uncertainty(self):
        known = unsure(0.002, turn=0.03, high_z=0.006)
        shapes = [cube(0, 0, 0), Cylinder(at(0, 0, 0), 0.04, 0.1), Sphere(at(0, 0, 0), 0.05)]
        for shape in shapes:
            rng = np.random.default_rng(0)
            draws = [
                drawn(SceneObject("o1", 1, shape, uncertainty=known), rng, PLAUSIBLE).shape
                for _ in range(400)
            ]
            turns = Rotation.from_matrix([d.T_world_object[:3, :3] for d in draws]).as_rotvec()
            np.testing.assert_allclose(turns.std(axis=0), 0.03, rtol=0.12)
            top = np.array([d.T_world_object[2, 3] + d.extents[2] / 2.0 for d in draws])
            if shape.kind != "sphere":
                assert top.std() == pytest.approx(0.006, rel=0.12)
            assert np.std([d.extents[0] for d in draws]) == pytest.approx(known.sizes[0], rel=0.12)
        still = SceneObject("o1", 1, shapes[0])
        np.testing.assert_array_equal(drawn(still, np.random.default_rng(0), PLAUSIBLE).shape.extents, 0.1)
