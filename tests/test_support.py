from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import shapely

from caryatid.config import SupportConfig
from caryatid.errors import InputError
from caryatid.fitting.uncertainty import Uncertainty
from caryatid.geometry import transforms
from caryatid.geometry.polygons import area, hull
from caryatid.geometry.shapes import Box, Cylinder, Primitives, Sphere
from caryatid.geometry.transforms import Array, rigid
from caryatid.graph import SceneObject, SupportGraph
from caryatid.support.relations import explain, infer
from caryatid.support.stability import (
    assess,
    beneath,
    centroid,
    contact_patch,
    drop_distance,
    find_tipping,
    ground_outline,
    support_polygon,
)

CONFIG = SupportConfig()
PAPER = replace(CONFIG, top_down="paper")
TABLE = Box(rigid(np.eye(3), (0.0, 0.0, -0.02)), np.array([1.0, 1.0, 0.04]))


def at(x: float, y: float, z: float, turn: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Array:
    return rigid(transforms.rotation_from_vector(np.radians(turn)), (x, y, z))


def block(
    x: float,
    y: float,
    z: float,
    size: tuple[float, float, float],
    turn: tuple[float, float, float] = (0, 0, 0),
) -> Box:
    """A box whose centre is at x, y and whose bottom, if level, is at z."""
    return Box(at(x, y, z + size[2] / 2.0, turn), np.array(size))


def scene(*shapes: Box | Cylinder | Sphere) -> list[SceneObject]:
    objects = [SceneObject(f"o{k}", k, shape) for k, shape in enumerate(shapes, 1)]
    return [SceneObject("o0", 0, TABLE, "support_surface"), *objects]


def edges(graph: SupportGraph) -> dict[tuple[str, str], str]:
    return {s.pair: s.kind for s in graph.supports}


def tower() -> list[SceneObject]:
    return scene(
        block(0, 0, 0, (0.1, 0.1, 0.08)),
        Cylinder(at(0.01, 0, 0.13), 0.04, 0.1),
        Sphere(at(0.01, 0, 0.21), 0.03),
        block(0.2, 0, 0, (0.08, 0.08, 0.08)),
    )


def bridge(left: float = 0.0, right: float = 0.0, deck_x: float = 0.0) -> list[SceneObject]:
    return scene(
        block(-0.12, 0, 0, (0.06, 0.06, 0.1 + left)),
        block(0.12, 0, 0, (0.06, 0.06, 0.1 + right)),
        block(deck_x, 0, 0.1, (0.32, 0.06, 0.02)),
    )


def counterweight(load_x: float = 0.0) -> list[SceneObject]:
    return scene(
        block(0, 0, 0, (0.1, 0.1, 0.1)),
        block(0.14, 0, 0.1, (0.36, 0.06, 0.02)),
        Cylinder(at(load_x, 0, 0.165), 0.04, 0.09),
    )


def leaning_plank(gap: float = 0.0) -> list[SceneObject]:
    """A thin board that stands 12° off the upright with its upper part against the edge of a block."""
    board = Box(at(0, 0, 0, (0, 12, 0)), np.array([0.01, 0.08, 0.24]))
    board = board.moved(at(0, 0, board.support(np.array([[0.0, 0.0, -1.0]]))[0]))
    top = board.T_world_object[:3] @ np.array([0.005, 0.0, 0.1, 1.0])
    wall = block(top[0] + gap + 0.03, 0, 0, (0.06, 0.1, top[2]))
    return scene(board, wall)


def test_a_tower_stands_bottom_up() -> None:
    graph = infer(tower(), CONFIG)
    assert edges(graph) == dict.fromkeys(
        [("o0", "o1"), ("o1", "o2"), ("o2", "o3"), ("o0", "o4")], "bottom-up"
    )
    assert all(s.certain and s.occurrences == s.opportunities == 1 for s in graph.supports)
    assert [o.id for o in graph.objects] == ["o0", "o1", "o2", "o3", "o4"]
    assert set(graph.stability) == {"o1", "o2", "o3", "o4"}
    assert all(s.stable for s in graph.stability.values())


def test_order_of_the_objects_does_not_matter() -> None:
    graph = infer(tower(), CONFIG)
    assert edges(infer(tower()[::-1], CONFIG)) == edges(graph)
    assert [s.pair for s in infer(tower()[::-1], CONFIG).supports] == [s.pair for s in graph.supports]


@pytest.mark.parametrize(("left", "right"), [(0.0, 0.0), (-0.009, 0.0), (0.0, -0.009), (0.008, -0.004)])
def test_a_bridge_keeps_both_pillars_at_different_noise_heights(left: float, right: float) -> None:
    found = edges(infer(bridge(left, right), CONFIG))
    assert {("o1", "o3"), ("o2", "o3")} <= set(found)
    assert ("o0", "o3") not in found


def test_a_far_contact_is_believed_only_where_needed() -> None:
    needed = infer(bridge(right=-0.009), CONFIG).support("o2", "o3")
    assert needed is not None
    assert not needed.certain
    assert "without it o3 has its centre of mass" in needed.why
    steady = scene(
        block(-0.04, 0, 0, (0.14, 0.06, 0.1)),
        block(0.1, 0, 0, (0.06, 0.06, 0.091)),
        block(0.0, 0, 0.1, (0.24, 0.06, 0.02)),
    )
    spare = infer(steady, CONFIG)
    assert edges(spare)["o1", "o3"] == "bottom-up"
    assert spare.support("o2", "o3") is None
    assert "gap 9.0 mm, margin 5.0 mm) and not needed" in explain(spare, "o2", "o3", CONFIG)


@pytest.mark.parametrize("overlap", [-0.004, 0.0, 0.004, 0.01])
def test_neighbours_side_by_side_support_nothing(overlap: float) -> None:
    objects = scene(
        block(0, 0, 0, (0.1, 0.1, 0.1)),
        block(0.1 - overlap, 0.01, 0, (0.1, 0.1, 0.14)),
        Cylinder(at(0, 0.09 - overlap, 0.06), 0.04, 0.12),
    )
    assert set(edges(infer(objects, CONFIG))) == {("o0", "o1"), ("o0", "o2"), ("o0", "o3")}


def test_a_counterweight_holds_top_down() -> None:
    graph = infer(counterweight(), CONFIG)
    assert edges(graph)["o3", "o2"] == "top-down"
    assert edges(graph)["o2", "o3"] == "bottom-up"
    held = graph.support("o3", "o2")
    assert held is not None
    assert not held.certain
    assert graph.stability["o2"].tips
    assert graph.stability["o2"].overhang == pytest.approx(0.09, abs=0.002)
    assert "90.0 mm outside" in held.why


def test_a_load_on_the_tipping_side_helps_only_on_paper() -> None:
    objects = counterweight(load_x=0.2)
    assert ("o3", "o2") not in edges(infer(objects, CONFIG))
    assert edges(infer(objects, PAPER))["o3", "o2"] == "top-down"


def test_paper_goes_by_the_area_ratio_too() -> None:
    ball = scene(Sphere(at(0, 0, 0.1), 0.1), block(0, 0, 0.2, (0.1, 0.1, 0.02)))
    by_paper = infer(ball, PAPER)
    assert by_paper.stability["o1"].small_area
    assert not by_paper.stability["o1"].tips
    assert edges(by_paper)["o2", "o1"] == "top-down"
    assert ("o2", "o1") not in edges(infer(ball, CONFIG))


@pytest.mark.parametrize("gap", [0.0, 0.004, 0.01])
def test_a_plank_leans(gap: float) -> None:
    graph = infer(leaning_plank(gap), CONFIG)
    assert edges(graph) == {("o0", "o1"): "bottom-up", ("o0", "o2"): "bottom-up", ("o2", "o1"): "lean"}
    lean = graph.support("o2", "o1")
    assert lean is not None
    assert not lean.certain
    assert "stands in its way" in lean.why


def test_a_plank_does_not_lean_on_what_stands_behind_it() -> None:
    board = leaning_plank()[1].shape
    foot = board.T_world_object[:3] @ np.array([-0.005, 0.0, -0.1, 1.0])
    graph = infer(scene(board, block(foot[0] - 0.032, 0, 0, (0.06, 0.1, 0.06))), CONFIG)
    assert ("o2", "o1") not in edges(graph)
    assert graph.stability["o1"].tips


def test_a_ball_in_a_trough_rests_on_both_sides() -> None:
    objects = scene(
        block(-0.06, 0, 0, (0.06, 0.1, 0.05)),
        block(0.06, 0, 0, (0.06, 0.1, 0.05)),
        Sphere(at(0, 0, 0.05 + np.sqrt(0.04**2 - 0.03**2)), 0.04),
    )
    assert {("o1", "o3"), ("o2", "o3")} <= set(edges(infer(objects, CONFIG)))


def test_what_touches_nothing_is_let_down() -> None:
    objects = scene(block(0, 0, 0, (0.1, 0.1, 0.05)), block(0.02, 0, 0.08, (0.05, 0.05, 0.05)))
    graph = infer(objects, CONFIG)
    support = graph.support("o1", "o2")
    assert support is not None
    assert support.kind == "bottom-up"
    assert not support.certain
    assert "let down 30.0 mm it meets o1" in support.why
    assert ("o0", "o2") not in edges(graph)
    assert [s.pair for s in infer(objects, replace(CONFIG, max_drop=0.02)).supports] == [("o0", "o1")]


@pytest.mark.parametrize("gap", [0.0, 3e-4, 2e-3])
def test_a_wall_beside_does_not_stop_what_is_let_down(gap: float) -> None:
    graph = infer(
        scene(
            block(0, 0, 0, (0.1, 0.1, 0.05)),
            block(0.05 + gap, 0, 0.08, (0.05, 0.05, 0.05)),
            block(0.1 + 2 * gap, 0, 0, (0.05, 0.05, 0.12)),
        ),
        CONFIG,
    )
    assert [s.supporter for s in graph.supporters("o2")] == ["o1"]


def test_an_object_in_the_air_has_no_supporter() -> None:
    graph = infer(scene(Sphere(at(0, 0, 0.4), 0.03)), CONFIG)
    assert graph.supports == ()
    assert graph.stability["o1"].overhang == np.inf
    assert not graph.stability["o1"].stable


def test_the_support_surface_lies_below_everything() -> None:
    sunk = infer(scene(block(0, 0, -0.025, (0.06, 0.06, 0.05))), CONFIG)
    assert edges(sunk) == {("o0", "o1"): "bottom-up"}
    assert "nothing supports it" in explain(sunk, "o1", "o0", CONFIG)


def test_without_a_support_surface_or_objects() -> None:
    assert infer([], CONFIG).supports == ()
    assert set(edges(infer(tower()[1:], CONFIG))) == {("o1", "o2"), ("o2", "o3")}


def test_two_objects_of_the_same_id_are_refused() -> None:
    with pytest.raises(InputError, match="same id"):
        infer([*tower(), tower()[1]], CONFIG)


@pytest.mark.parametrize("make", [tower, bridge, counterweight, leaning_plank])
def test_a_rigid_motion_about_the_vertical_changes_nothing(make) -> None:  # type: ignore[no-untyped-def]
    objects = make()
    graph = infer(objects, CONFIG)
    rng = np.random.default_rng(7)
    for _ in range(8):
        T = rigid(transforms.rotation_from_vector((0, 0, rng.uniform(-np.pi, np.pi))), rng.uniform(-1, 1, 3))
        moved = infer([replace(o, shape=o.shape.moved(T)) for o in objects], CONFIG)
        assert [(s.pair, s.kind, s.certain) for s in moved.supports] == [
            (s.pair, s.kind, s.certain) for s in graph.supports
        ]
        for key, stability in graph.stability.items():
            assert moved.stability[key].ratio == pytest.approx(stability.ratio, abs=0.01)
            assert moved.stability[key].overhang == pytest.approx(stability.overhang, abs=0.001)
        for one, other in zip(graph.supports, moved.supports, strict=True):
            assert one.normal_world is not None
            assert other.normal_world is not None
            np.testing.assert_allclose(other.normal_world, transforms.rotate(T, one.normal_world), atol=0.02)


def test_random_heaps_do_not_change_under_motions_about_the_vertical() -> None:
    rng = np.random.default_rng(11)
    for _ in range(20):
        shapes: list[Box | Cylinder | Sphere] = []
        for k in range(7):
            T = rigid(transforms.random_rotation(rng), (*rng.uniform(-0.1, 0.1, 2), rng.uniform(0.02, 0.15)))
            a, b, c = rng.uniform(0.04, 0.1, 3)
            shapes.append((Box(T, np.array([a, b, c])), Cylinder(T, a / 2, b), Sphere(T, a / 2))[k % 3])
        objects = scene(*shapes)
        T = rigid(transforms.rotation_from_vector((0, 0, rng.uniform(-np.pi, np.pi))), rng.uniform(-1, 1, 3))
        moved = infer([replace(o, shape=o.shape.moved(T)) for o in objects], CONFIG)
        assert edges(moved) == edges(infer(objects, CONFIG))


def test_normals_point_from_supporter_to_supported_and_contacts_lie_between() -> None:
    for support in infer(tower(), CONFIG).supports:
        assert support.normal_world is not None
        assert support.contact_world is not None
        assert support.normal_world[2] > 0.99
    middle = infer(tower(), CONFIG).support("o1", "o2")
    assert middle is not None
    assert middle.contact_world is not None
    np.testing.assert_allclose(middle.contact_world, (0.01, 0.0, 0.08), atol=2e-3)


def test_why_not() -> None:
    objects = [*tower(), SceneObject("o5", 5, block(0.283, 0, 0, (0.08, 0.08, 0.08)))]
    graph = infer(objects, CONFIG)
    assert explain(graph, "o0", "o1", CONFIG) == graph.supports[0].why
    assert "gap 80.0 mm" in explain(graph, "o0", "o2", CONFIG)
    assert "lies above it" in explain(graph, "o2", "o1", CONFIG)
    beside = explain(graph, "o4", "o5", CONFIG)
    assert "side by side (normal 90° from the vertical" in beside
    assert "40.0 mm inside its support polygon" in beside
    with pytest.raises(InputError, match="no such object"):
        explain(graph, "o1", "o9", CONFIG)
    with pytest.raises(InputError, match="itself"):
        explain(graph, "o1", "o1", CONFIG)


def test_inputs_stay_as_they_were() -> None:
    objects = leaning_plank(0.004)
    before = [o.shape.T_world_object.copy() for o in objects]
    infer(objects, CONFIG)
    for o, T in zip(objects, before, strict=True):
        np.testing.assert_array_equal(o.shape.T_world_object, T)


def test_contact_patch_is_the_common_area() -> None:
    lower, upper = block(0, 0, 0, (0.1, 0.1, 0.1)), block(0.06, 0.02, 0.1, (0.1, 0.1, 0.05))
    patch = contact_patch(upper, lower, np.array([0.0, 0.0, 1.0]), np.zeros((1, 3)), CONFIG)
    assert (*patch.min(axis=0), *patch.max(axis=0)) == pytest.approx((0.01, -0.03, 0.05, 0.05))
    assert area(ground_outline(upper)) == pytest.approx(0.01)
    polygon = support_polygon([patch])
    verdict = assess(upper, polygon, find_tipping(upper, polygon), CONFIG)
    assert verdict.ratio == pytest.approx(0.32)
    assert verdict.overhang == pytest.approx(0.01)
    assert verdict.tips
    assert not verdict.small_area


def test_contact_patch_of_a_ball_is_a_small_disc() -> None:
    ball = Sphere(at(0, 0, 0.04), 0.04)
    patch = contact_patch(ball, TABLE, np.array([0.0, 0.0, 1.0]), np.zeros((1, 3)), CONFIG)
    depth = CONFIG.patch_depth
    assert area(patch) == pytest.approx(np.pi * depth * (0.08 - depth), rel=0.01)
    assert find_tipping(ball, patch).overhang < 0.0


def test_tipping_points_away_from_the_polygon() -> None:
    plank = counterweight()[2].shape
    square = np.array([[0.05, -0.03], [0.05, 0.03], [-0.05, 0.03], [-0.05, -0.03]])
    tipping = find_tipping(plank, support_polygon([square]))
    np.testing.assert_allclose(tipping.pivot_xy, (0.05, 0.0), atol=1e-9)
    np.testing.assert_allclose(tipping.direction_xy, (1.0, 0.0), atol=1e-9)
    inside = find_tipping(plank, support_polygon([square * (2.0, 1.0) + (0.1, 0.0)]))
    assert inside.overhang == pytest.approx(-0.03)
    nothing = find_tipping(plank, support_polygon([]))
    assert nothing.overhang == np.inf
    assert not nothing.direction_xy.any()


@pytest.mark.parametrize("count", [1, 2, 3, 8])
def test_the_centre_of_a_polygon_is_that_of_its_area_or_else_of_its_border(count: int) -> None:
    points = np.random.default_rng(count).normal(size=(count, 2))
    exact = shapely.MultiPoint(points).convex_hull
    np.testing.assert_allclose(centroid(hull(points)), exact.centroid.coords[0], atol=1e-12)
    line = np.arange(count)[:, None] * (0.5, 0.25)
    np.testing.assert_allclose(centroid(hull(line)), line.mean(axis=0))


def test_what_a_falling_shape_meets_lies_beneath_it() -> None:
    rng = np.random.default_rng(4)
    met = spared = 0
    for _ in range(10):
        shapes = [
            (Box, Cylinder, Sphere)[k % 3](
                rigid(transforms.random_rotation(rng), rng.uniform(-0.15, 0.15, 3)),
                *((rng.uniform(0.03, 0.1, 3),), (0.03, 0.08), (0.04,))[k % 3],
            )
            for k in range(8)
        ]
        for k, shape in enumerate(shapes):
            below = beneath(Primitives.of(shapes), k, 0.05)
            assert k not in below
            for m, other in enumerate(shapes):
                if m != k and np.isfinite(drop_distance(shape, other, 0.05)):
                    assert m in below
                    met += 1
            spared += len(shapes) - 1 - len(below)
    assert met > 20
    assert spared > met


def test_drop_distance() -> None:
    floor = block(0, 0, 0, (0.1, 0.1, 0.05))
    assert drop_distance(block(0.05, 0, 0.07, (0.06, 0.06, 0.06)), floor, 0.1) == pytest.approx(
        0.02, abs=1e-3
    )
    assert drop_distance(Sphere(at(0, 0, 0.11), 0.03), floor, 0.1) == pytest.approx(0.03, abs=1e-3)
    tip = Sphere(at(0.02, 0.01, -0.02), 0.02)
    assert drop_distance(floor.moved(at(0, 0, 0.03)), tip, 0.1) == pytest.approx(0.03, abs=1e-3)
    assert drop_distance(block(0.09, 0, 0.07, (0.06, 0.06, 0.06)), floor, 0.1) == np.inf
    assert drop_distance(block(0, 0, 0.2, (0.06, 0.06, 0.06)), floor, 0.1) == np.inf


SCENES = Path(__file__).parents[2] / "shared" / "scenes"


@pytest.mark.skipif(not SCENES.is_dir(), reason="needs ../shared/scenes")
def test_true_shapes_of_the_shared_primitive_scenes_give_their_edges() -> None:
    from caryatid.simulation.scenes import load_scene
    from caryatid.simulation.truth import read_truth
    from caryatid.simulation.world import static_boxes, true_shapes

    right = wrong = missed = 0
    folders = [f for f in sorted(SCENES.iterdir()) if not f.name.startswith("ycb")]
    for folder in folders:
        loaded = load_scene(str(folder / "scene.xml"))
        shapes = {0: static_boxes(loaded)[0], **true_shapes(loaded)}
        names = {0: "table", **loaded.object_bodies}
        objects = [
            SceneObject(names[k], k, shape, "object" if k else "support_surface")
            for k, shape in shapes.items()
        ]
        truth = {(e["supporter"], e["supported"]) for e in read_truth(folder / "gt.json").edges}
        found = set(edges(infer(objects, CONFIG)))
        right, wrong, missed = (
            right + len(found & truth),
            wrong + len(found - truth),
            missed + len(truth - found),
        )
    assert right / (right + wrong) >= 0.97
    assert right / (right + missed) >= 0.97


def unsure(side: float) -> Uncertainty:
    """Of a shape all of whose sides may be this far off [m]."""
    return Uncertainty(np.full(3, side), np.zeros(3), np.full(3, side), np.full(6, side))


@pytest.mark.parametrize(("side", "certain"), [(0.0005, False), (0.004, True)])
def test_the_contact_margin_follows_the_uncertainty_of_the_fits(side, certain):
    table = SceneObject("o0", 0, TABLE, "support_surface")
    lower = SceneObject("o1", 1, block(0.0, 0.0, 0.0, (0.2, 0.2, 0.1)), uncertainty=unsure(side))
    upper = SceneObject("o2", 2, block(0.0, 0.0, 0.108, (0.1, 0.1, 0.1)), uncertainty=unsure(side))
    support = infer([table, lower, upper], CONFIG).support("o1", "o2")
    assert support is not None
    assert support.certain == certain
