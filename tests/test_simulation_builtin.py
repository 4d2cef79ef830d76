from __future__ import annotations

from functools import cache

import mujoco
import numpy as np
import pytest

from caryatid.errors import InputError
from caryatid.geometry.shapes import Box
from caryatid.simulation import (
    SimulatedScene,
    bounds,
    generate,
    ground_truth,
    list_scenes,
    load_scene,
    static_boxes,
    table_centre,
    table_top,
    true_shapes,
)
from caryatid.simulation.scenes import DESIGNED, is_builtin
from caryatid.simulation.world import palette, state_of

generated = cache(generate)

INTENDED = {
    "tower": {("table", 0), (0, 1), (1, 2), (2, 3), ("table", 4)},
    "bridge": {("table", 0), ("table", 1), ("table", 4), (0, 2), (1, 2), (2, 3)},
    "counterweight": {("table", 0), (0, 1), (1, 2), (2, 1, "top-down"), ("table", 3)},
    "leaning_plank": {("table", 0), ("table", 1), (0, 1, "lean"), ("table", 2), (2, 3)},
    "hidden_stack": {("table", 0), ("table", 1), (1, 2), (2, 3), ("table", 4)},
    "shelf": {("table", 0), ("table", 1), (0, 2), (1, 2), ("table", 3), (3, 4), (2, 5), (2, 6)},
    "clutter": {
        *(("table", k) for k in (0, 3, 4, 5, 7)), (0, 1), (1, 2), (4, 6), (5, 6), (3, 8),
    },
}  # fmt: skip


def edges_of(scene: SimulatedScene) -> set[tuple[str, str, str]]:
    return {(e["supporter"], e["supported"], e["kind"]) for e in ground_truth(scene).edges}


def named(edge: tuple) -> tuple[str, str, str]:
    supporter, supported, kind = (*edge, "bottom-up")[:3]
    return (supporter if supporter == "table" else f"object{supporter}", f"object{supported}", kind)


def assert_settled(scene: SimulatedScene) -> None:
    """At rest, on the table, and still there a second later."""
    half, height = table_top(scene).extents[:2] / 2.0, table_centre(scene)[2]
    assert scene.at_rest
    for label, shape in true_shapes(scene).items():
        assert bounds(scene, label)[0][2] > height - 0.002
        assert (np.abs(shape.T_world_object[:2, 3]) < half).all()
    data = state_of(scene)
    mujoco.mj_step(scene.model, data, nstep=500)
    assert np.abs(data.xpos - scene.data.xpos).max() < 0.01


@pytest.mark.parametrize("name", DESIGNED)
def test_designed_scenes_settle_to_the_intended_graph(name: str):
    scene = load_scene(name)
    assert scene.name == name
    assert_settled(scene)
    assert edges_of(scene) == {named(edge) for edge in INTENDED[name]}


@pytest.mark.parametrize(("size", "seed"), [(1, 0), (4, 1), (8, 3), (12, 0)])
def test_piles_are_settled_and_of_the_size(size: int, seed: int):
    scene = generated("pile", size, seed)
    assert len(scene.object_bodies) == len(true_shapes(scene)) == size
    assert len(static_boxes(scene)) == 5
    assert_settled(scene)


@pytest.mark.parametrize(
    ("kind", "size", "seeds"),
    [("pile", 8, range(3, 6)), pytest.param("dense", 14, range(2), marks=pytest.mark.slow)],
)
def test_much_of_a_heap_lies_on_something_else(kind: str, size: int, seeds: range):
    edges = [edge for seed in seeds for edge in edges_of(generated(kind, size, seed))]
    assert sum(supporter != "table" for supporter, _, _ in edges) >= 6


@pytest.mark.parametrize(("size", "seed"), [(10, 0), pytest.param(25, 2, marks=pytest.mark.slow)])
def test_dense_scenes_have_screens_a_heap_and_walls(size: int, seed: int):
    scene = generated("dense", size, seed)
    shapes = true_shapes(scene)
    assert len(shapes) == size
    assert_settled(scene)
    screens = [
        label for label, s in shapes.items()
        if isinstance(s, Box) and s.extents[2] > 0.2 and s.T_world_object[2, 2] > 0.999
    ]  # fmt: skip
    assert 2 <= len(screens) <= 4
    walls = static_boxes(scene)[5:]
    assert 1 <= len(walls) <= 2
    for wall in walls:
        x, y = wall.T_world_object[:2, 3]
        assert x > 0.5 or abs(y) > 0.7


def test_packed_objects_touch_one_another():
    shapes = list(true_shapes(generate("packed", 6, 3)).values())
    for shape in shapes:
        surface = shape.surface(0.003)[0]
        gaps = [float(other.signed_distance(surface).min()) for other in shapes if other is not shape]
        assert -0.002 < min(gaps) < 0.004


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pile-6-2", "dense-11-4", "packed-5-1"])
def test_generated_names_repeat_byte_for_byte(name: str):
    a, b = load_scene(name), load_scene(name)
    assert a.name == name
    np.testing.assert_array_equal(a.data.qpos, b.data.qpos)
    assert a.spec.to_xml() == b.spec.to_xml()
    assert a.spec.to_xml() != load_scene(f"{name}1").spec.to_xml()


def test_neighbouring_objects_differ_in_colour():
    colours = np.array([palette(k)[:3] for k in range(25)])
    apart = np.abs(colours[:, None] - colours[None]).max(axis=-1) + np.eye(len(colours))
    assert apart.min() > 0.02


@pytest.mark.parametrize("name", ["pile-0-1", "pile-99-1", "dense-3-1", "dense-26-0", "packed-1-0"])
def test_sizes_and_seeds_out_of_range_are_refused(name: str):
    with pytest.raises(InputError, match=r"ask for \d+ to \d+"):
        load_scene(name)
    with pytest.raises(InputError, match="negative"):
        generate("pile", 3, -1)


def test_names():
    assert list_scenes()[: len(DESIGNED)] == list(DESIGNED)
    assert is_builtin("clutter")
    assert is_builtin("pile-8-3")
    assert not is_builtin("scenes/clutter")
    assert not is_builtin("pile-8")
