"""Solids: unions of convex parts, hollow ones among them, and what stands in them."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from caryatid.config import Config
from caryatid.evaluation.scores import as_scene, score
from caryatid.exploration import explore
from caryatid.exports import export_graph
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Sphere
from caryatid.geometry.solids import Polytope, Solid, hollowed
from caryatid.graph import SceneObject, SupportGraph
from caryatid.simulation.generation import generate
from caryatid.simulation.setup import make_simulation
from caryatid.simulation.truth import ground_truth
from caryatid.simulation.world import Body, build_spec, scene_from_spec, true_shapes
from caryatid.support.contacts import find_contacts
from caryatid.support.relations import infer

AXES = np.eye(3)
BLOCK = Box(transforms.rigid(AXES, (0.0, 0.0, 0.025)), np.array([0.2, 0.2, 0.05]))


def tray(at=(0.0, 0.0, 0.0)) -> Solid:
    """20 × 20 × 5 cm, walls and floor of 1 cm, its lower side at z = 0 of `at`."""
    block = Polytope.around(BLOCK.outline())
    planes = [(AXES[2], 0.01)] + [(sign * AXES[k], -0.09) for k in (0, 1) for sign in (-1.0, 1.0)]
    return Solid.of(hollowed(block, planes)).moved(transforms.rigid(AXES, at))


def cube(at, edge=0.04) -> Box:
    return Box(transforms.rigid(AXES, at), np.full(3, edge))


def on_a_table(*shapes) -> list[SceneObject]:
    table = Box(transforms.rigid(AXES, (0.0, 0.0, -0.02)), np.array([1.0, 1.0, 0.04]))
    objects = [SceneObject(f"o{k}", k, shape) for k, shape in enumerate(shapes, 1)]
    return [SceneObject("o0", 65535, table, "support_surface"), *objects]


def test_a_tray_is_its_block_without_its_inside():
    """Volume and centre of mass of a floor and four walls.

    0.2 · 0.2 · 0.05 − 0.18 · 0.18 · 0.04 = 0.000704 m³; the floor's is 0.0004 at 5 mm, the walls' 0.000304
    at 30 mm: the centre of mass lies at (0.0004 · 5 + 0.000304 · 30) / 0.000704 = 15.8 mm.
    """
    shape = tray()
    assert len(shape.parts) == 5
    assert shape.volume == pytest.approx(0.000704, rel=1e-9)
    np.testing.assert_allclose(shape.centre_of_mass, [0.0, 0.0, 0.0157955], atol=1e-6)
    inside, in_floor, in_wall, outside = [0, 0, 0.03], [0, 0, 0.005], [0.095, 0, 0.03], [0.13, 0, 0.03]
    distances = shape.signed_distance(np.array([inside, in_floor, in_wall, outside]))
    np.testing.assert_allclose(distances, [0.02, -0.005, -0.005, 0.03], atol=1e-12)
    np.testing.assert_allclose(shape.extents, [0.2, 0.2, 0.05])


def test_the_surface_of_a_tray_is_sampled_inside_and_outside_but_not_between_its_parts():
    """Area: 2 · 0.2² below and above (rims and floor), 4 · 0.2 · 0.05 outside, 4 · 0.18 · 0.04 inside."""
    points, normals = tray().surface(0.004)
    assert np.abs(tray().signed_distance(points)).max() < 1e-9
    assert len(points) * 0.004**2 == pytest.approx(0.08 + 0.04 + 0.0288, rel=0.05)
    assert (tray().signed_distance(points + 0.002 * normals) > 0.0).all()


def test_gaps_of_solids_do_not_depend_on_the_solids_asked_for_before():
    """MuJoCo's model is kept between calls: neither its first meshes nor those of the last call may show."""
    rng = np.random.default_rng(1)
    table = Box(transforms.rigid(AXES, (0.0, 0.0, -0.02)), np.array([6.0, 6.0, 0.04]))
    for size in (0.1, 0.4, 0.1):
        solids = []
        for number in range(12):
            points = size * rng.uniform(size=(12, 3)) * (1.0, 1.0, 0.5)
            points += [number % 4 - 2, number // 4 - 1, 0.001 - points[:, 2].min()]
            solids.append(Solid.of([Polytope.around(points)]))
        contacts = find_contacts([table, *solids], 0.01)
        assert [c.b for c in contacts] == list(range(1, 13))
        np.testing.assert_allclose([c.distance for c in contacts], 0.001, atol=1e-5)


def test_what_stands_in_a_tray_is_supported_by_it_all_over():
    objects = on_a_table(
        tray(), cube((0.05, 0.0, 0.03)), Sphere(transforms.rigid(AXES, (0.0, 0.0, 0.25)), 0.02)
    )
    graph = infer(objects, Config().support)
    assert [s.pair for s in graph.supports] == [("o0", "o1"), ("o1", "o2")]
    assert graph.stability["o2"].ratio == pytest.approx(1.0)
    assert graph.stability["o1"].ratio == pytest.approx(1.0)


def test_a_solid_scores_with_its_inside():
    """The block has the same hull as the tray: IoU 1, though the tray fills a third of it."""
    of_tray, of_block = (SupportGraph(tuple(on_a_table(shape))) for shape in (tray(), BLOCK))
    assert score(of_tray, as_scene(of_block)).mean_iou > 0.99


@pytest.mark.parametrize("name", ["tray.xml", "tray.urdf", "tray.glb", "tray.graphml", "tray.dot"])
def test_solids_are_exported(tmp_path, name):
    graph = SupportGraph(tuple(on_a_table(tray(), cube((0.0, 0.0, 0.03)))))
    export_graph(graph, tmp_path / name)
    if name == "tray.xml":
        model = mujoco.MjModel.from_xml_path(str(tmp_path / name))
        data = mujoco.MjData(model)
        mujoco.mj_step(model, data, nstep=500)
        assert data.body("o2").xpos[2] == pytest.approx(0.03, abs=0.002)
        assert model.body("o1").mass[0] == pytest.approx(0.000704 * Config().export.density, rel=1e-3)
    if name == "tray.urdf":
        assert (tmp_path / name).read_text().count("<collision>") == 1 + 5 + 1


@pytest.mark.slow
def test_household_scenes_are_settled_and_hold_things_in_each_other():
    scene = generate("house", 8, 4)
    shapes = true_shapes(scene)
    assert scene.at_rest
    assert len(shapes) == 8
    assert sum(len(shape.parts) > 1 for shape in shapes.values()) >= 3
    assert sum(edge.supporter != "table" for edge in ground_truth(scene).edges) >= 4


def test_a_tray_is_seen_to_be_hollow_and_carries_what_is_in_it():
    """By a box that is higher than its walls; the floor is at 10 mm over the table."""
    shapes = tray((0.0, 0.0, 0.75)), Box(transforms.rigid(AXES, (0.02, 0.03, 0.80)), np.full(3, 0.08))
    scene = scene_from_spec(build_spec([Body(shape) for shape in shapes], "test"), "test", "test")
    config = replace(Config(), active=replace(Config().active, max_views=3))
    simulation = make_simulation(scene, config, noise="carmine", seed=0)
    step = list(explore(simulation.camera, simulation.robot, config=config, early_stop=False))[-1]
    found, box = step.graph["o1"].shape, step.graph["o2"].shape
    assert (found.kind, box.kind) == ("solid", "box")
    assert {s.pair for s in step.graph.supports} == {("o0", "o1"), ("o1", "o2")}
    in_the_tray = np.array([[-0.05, -0.05, 0.77], [0.07, -0.06, 0.78]])
    in_walls_and_floor = np.array([[0.095, 0.0, 0.775], [0.0, -0.095, 0.775], [-0.05, -0.05, 0.754]])
    assert (found.signed_distance(in_the_tray) > 0.005).all()
    assert (found.signed_distance(in_walls_and_floor) < 0.0).all()
