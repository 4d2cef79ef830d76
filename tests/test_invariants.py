"""What a scene holds does not depend on where it stands, on who looks how at it, or on the order of views."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic import (
    AROUND,
    SENSOR,
    box,
    config_for,
    cylinder,
    edges,
    hausdorff,
    look_from,
    model_of,
    motion_about_vertical,
    simulated_cloud,
    simulated_scene,
    simulated_views,
    table_object,
    thing,
    vertices,
)

from caryatid.config import SupportConfig
from caryatid.evaluation.scores import score
from caryatid.evaluation.truths import true_scene_from_simulation
from caryatid.geometry import transforms
from caryatid.sensing.views import SUPPORT_LABEL
from caryatid.simulation.camera import SimulatedCamera
from caryatid.support.relations import infer

STAY = np.eye(4)
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
"""To the other side of the plane of x and z."""
RAYS = np.diag([-1.0, 1.0, 1.0, 1.0])
"""From left to right in the image."""
TURN = motion_about_vertical(np.random.default_rng(5))


def views_of(name):
    return [replace(view, normals_camera=None) for view in simulated_views(name)]


def turned(name):
    return [replace(view, T_world_camera=TURN @ view.pose) for view in views_of(name)]


def mirrored(name):
    found = []
    for view in views_of(name):
        K = view.K.copy()
        K[0, 2] = view.depth.shape[1] - 1 - K[0, 2]
        images = {field: getattr(view, field)[:, ::-1].copy() for field in ("depth", "labels", "rgb")}
        found.append(replace(view, K=K, T_world_camera=MIRROR @ view.pose @ RAYS, **images))
    return found


def renumbered(name):
    numbers = np.append(0, 1 + np.random.default_rng(0).permutation(30)).astype(np.int32)
    return [replace(view, labels=numbers[view.labels]) for view in views_of(name)]


def without_floor(name):
    views = views_of(name)
    surface = model_of(views[:1]).surface
    return [replace(v, depth=np.where(surface.pixels_over(v, -0.02, np.inf), v.depth, 0)) for v in views]


def twice_as_fine(name):
    sensor = replace(SENSOR, width=2 * SENSOR.width, height=2 * SENSOR.height, focal=2 * SENSOR.focal)
    camera = SimulatedCamera(simulated_scene(name), sensor=sensor)
    return [replace(camera.capture(look_from(a)), normals_camera=None) for a in AROUND]


CHANGES = {
    "turned and moved": (turned, TURN),
    "mirrored": (mirrored, MIRROR),
    "renumbered": (renumbered, STAY),
    "in another order": (lambda name: [views_of(name)[k] for k in (2, 0, 1)], STAY),
    "without its floor": (without_floor, STAY),
    "twice as fine": (twice_as_fine, STAY),
}
"""How a scene can be seen otherwise, and where that takes the world."""


@cache
def known(name, segmentation):
    return model_of(views_of(name), segmentation=segmentation).graph


def moved(shape, world):
    """A shape where a motion or mirror of the world takes it; each shape is its own mirror image."""
    side = np.diag([np.rint(np.linalg.det(world)), 1.0, 1.0, 1.0])
    return replace(shape, T_world_object=world @ shape.T_world_object @ side)


def counterparts(here, there, world):
    """Ids in one graph of what lies in another where a motion of the world takes it."""
    names = {o.id: o.id for o in here.objects if o.role == "support_surface"}
    others = [o for o in there.objects if o.role == "object"]
    for o in here.objects:
        if o.role == "object":
            place = transforms.transform(world, o.centre_world)
            names[o.id] = min(others, key=lambda other: np.linalg.norm(other.centre_world - place)).id
    return names


@pytest.mark.parametrize("segmentation", ["labels", "auto"])
@pytest.mark.parametrize("name", ["tower", "leaning_plank"])
@pytest.mark.parametrize("change", CHANGES)
def test_a_scene_seen_otherwise_is_the_same_scene(change, name, segmentation):
    views, world = CHANGES[change]
    here, there = known(name, segmentation), model_of(views(name), segmentation=segmentation).graph
    assert len(here.objects) > 4
    names = counterparts(here, there, world)
    assert set(names.values()) == vertices(there)
    assert len(there.objects) == len(here.objects)
    assert edges(there) == {(names[a], names[b]) for a, b in edges(here)}
    off = [hausdorff(there[names[o.id]].shape, moved(o.shape, world)) for o in here.objects[1:]]
    assert max(off) < 0.01, off


@pytest.mark.parametrize("segmentation", ["labels", "auto"])
@pytest.mark.parametrize("name", ["tower", "bridge"])
def test_points_and_ids_are_conserved(name, segmentation):
    """A still world: every point belongs to one object, and what has a mask keeps its name.

    Without masks, a name is given up when a later view shows that two are one.
    """
    scene = model_of([], segmentation=segmentation)
    ids, points = set(), set()
    for view in simulated_views(name):
        graph, cloud = scene.update(view), scene.cloud
        now = {tuple(point) for point in cloud.points_world}
        assert len(now) == len(cloud), "a point counts twice"
        assert points < now, "points were lost"
        assert ids <= vertices(graph) or segmentation == "auto"
        own = {o.label for o in graph.objects if o.role == "object"}
        assert set(np.unique(cloud.labels)) - {SUPPORT_LABEL} == own
        assert set(np.unique(scene.labels)) <= {0, SUPPORT_LABEL, *own}
        ids, points = vertices(graph), now
    assert len(ids) == 1 + len(simulated_scene(name).object_bodies)


@pytest.mark.parametrize("method", ["pc", "sg", "pc+sg"])
@pytest.mark.parametrize(("name", "noise"), [("tower", "none"), ("bridge", "none"), ("tower", "carmine")])
def test_a_view_fused_with_itself_changes_no_vertex_and_no_edge(name, noise, method):
    view = simulated_views(name, noise=noise)[0]
    once, thrice = (model_of([view] * n, config_for(method)).graph for n in (1, 3))
    assert len(once.supports) >= 3
    assert vertices(thrice) == vertices(once)
    assert edges(thrice) == edges(once)
    assert {s.occurrences for s in thrice.supports} == {3}


def test_the_graph_does_not_depend_on_the_order_of_points():
    cloud = simulated_cloud("tower")
    order = np.random.default_rng(0).permutation(len(cloud))
    here, there = (model_of([c]).graph for c in (cloud, cloud.select(order)))
    assert (vertices(there), edges(there)) == (vertices(here), edges(here))


def random_stack(seed):
    """Boxes and cylinders on a table, most of them stacked."""
    rng = np.random.default_rng(seed)
    objects, height = [table_object()], {0: 0.75, 1: 0.75}
    for label in range(1, 6):
        pile = int(rng.integers(2))
        middle = (0.3 * pile + rng.uniform(-0.01, 0.01), rng.uniform(-0.01, 0.01))
        tall = rng.uniform(0.04, 0.1)
        at = (*middle, height[pile] + tall / 2.0)
        size = (rng.uniform(0.06, 0.12), rng.uniform(0.06, 0.12), tall)
        turn = rng.uniform(0.0, 90.0)
        shape = box(at, size, turn) if rng.random() < 0.6 else cylinder(at, rng.uniform(0.03, 0.05), tall)
        objects.append(thing(label, shape))
        height[pile] += tall + rng.uniform(-0.002, 0.002)
    return objects


@settings(max_examples=10, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.randoms(use_true_random=False))
def test_the_support_graph_of_shapes_does_not_depend_on_their_order(seed, random):
    objects = random_stack(seed)
    shuffled = random.sample(objects, len(objects))
    assert edges(infer(shuffled, SupportConfig())) == edges(infer(objects, SupportConfig()))


def test_a_place_seen_often_has_no_more_points():
    scene, counts = model_of([]), []
    for _ in range(12):
        scene.update(simulated_views("tower")[0])
        counts.append(len(scene.cloud))
    assert counts[7] > 6 * counts[0], "eight views are kept whole"
    assert counts[-1] < 0.8 * counts[7]


def test_further_views_of_two_tables_take_nothing_away_and_add_no_legs():
    name = "storeys-7-953"
    views = simulated_views(name, (180.0, 108.0, 252.0, 36.0), "carmine", vga=True)
    graph = model_of(list(views), segmentation="auto").graph
    found = score(graph, true_scene_from_simulation(simulated_scene(name)))
    assert found.f1 == 1.0, found
    assert found.mean_iou > 0.9
