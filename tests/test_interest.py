from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from caryatid.config import ActiveVisionConfig
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Sphere
from caryatid.graph import SceneObject, Support, SupportGraph
from caryatid.planning.points_of_interest import (
    inhibition_of_return,
    largest_arc,
    painted,
    points_of_doubt,
    points_of_interest,
    relation_saliency,
    surface_point,
)
from caryatid.sensing.view_sphere import ViewSphere, direction

CONFIG = ActiveVisionConfig(sphere_points=500)
PAPER = replace(CONFIG, saliency="paper", edge_point="midpoint")
SPHERE = ViewSphere.around((0.0, 0.0, 0.75), CONFIG)
HOME = direction(np.pi, np.deg2rad(35.0))[None]


def box(label: int, centre: tuple[float, float, float], extents: tuple[float, float, float]) -> SceneObject:
    shape = Box(transforms.rigid(np.eye(3), centre), np.array(extents))
    return SceneObject(f"o{label}", label, shape, "object" if label else "support_surface")


TABLE = box(0, (0.0, 0.0, 0.73), (0.7, 1.0, 0.04))
LOWER = box(1, (0.1, 0.1, 0.80), (0.1, 0.1, 0.1))
UPPER = box(2, (0.1, 0.2, 0.90), (0.2, 0.2, 0.1))
FLOATING = box(3, (-0.2, -0.1, 0.85), (0.08, 0.08, 0.08))
GRAPH = SupportGraph(
    (TABLE, LOWER, UPPER, FLOATING),
    (
        Support("o0", "o1", occurrences=2),
        Support("o1", "o2", contact_world=np.array([0.1, 0.13, 0.85])),
    ),
)


def at(degrees: float) -> np.ndarray:
    return direction(np.deg2rad(degrees), 0.6)


@pytest.mark.parametrize(
    ("views", "middle"),
    [
        ([180.0], 0.0),
        ([30.0], -150.0),
        ([180.0, 90.0], -45.0),
        ([170.0, -170.0], 0.0),
        ([0.0, 120.0, 200.0], -80.0),
    ],
)
def test_the_largest_arc_has_its_middle_far_from_all_views(views: list[float], middle: float):
    azimuth = np.rad2deg(largest_arc(np.stack([at(v) for v in views])))
    assert (azimuth - middle + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=1e-6)


def test_the_largest_arc_does_not_depend_on_the_order_of_views():
    views = np.stack([at(v) for v in (10.0, 80.0, 200.0, 290.0)])
    assert largest_arc(views) == largest_arc(views[::-1])


def test_equation_2_as_printed_has_a_full_period():
    values = [relation_saliency(k, 4, PAPER) for k in range(5)]
    np.testing.assert_allclose(values, [1.0, 0.75, 0.5, 0.75, 1.0])


def test_equation_2_decreasing_falls_to_two_lambda_minus_one():
    values = [relation_saliency(k, 4, CONFIG) for k in range(5)]
    assert (np.diff(values) < 0.0).all()
    assert values[0] == 1.0
    assert values[-1] == pytest.approx(0.5)
    assert relation_saliency(9, 4, CONFIG) == pytest.approx(0.5), "more occurrences than views"


@pytest.mark.parametrize(
    "shape",
    [
        Box(
            transforms.rigid(transforms.rotation_from_vector((0.3, 0.2, 0.9)), (0.1, 0.0, 0.8)),
            np.array([0.1, 0.2, 0.05]),
        ),
        Cylinder(transforms.rigid(np.eye(3), (0.1, 0.0, 0.8)), 0.04, 0.12),
        Sphere(transforms.rigid(np.eye(3), (0.1, 0.0, 0.8)), 0.05),
    ],
)
def test_surface_point_is_on_the_surface_and_on_the_line(shape: Box | Cylinder | Sphere):
    target = np.array([1.5, 0.4, 0.75])
    point = surface_point(shape, target)
    centre = shape.T_world_object[:3, 3]
    assert shape.signed_distance(point[None])[0] == pytest.approx(0.0, abs=1e-6)
    assert transforms.angle_between(point - centre, target - centre) == pytest.approx(0.0, abs=1e-6)


def test_every_relation_and_every_unsupported_object_gives_one_point():
    points = points_of_interest(GRAPH, SPHERE, HOME, 2, CONFIG)
    assert [p.subject for p in points] == [("o0", "o1"), ("o1", "o2"), ("o3",)]
    for p in points:
        assert np.linalg.norm(p.direction) == pytest.approx(1.0)


def test_an_unsupported_object_is_looked_at_from_the_middle_of_the_largest_arc():
    floating = points_of_interest(GRAPH, SPHERE, HOME, 2, CONFIG)[-1]
    np.testing.assert_allclose(floating.direction, [1.0, 0.0, 0.0], atol=1e-9)
    assert floating.saliency == 1.0
    assert floating.position_world[0] == pytest.approx(-0.2 + 0.04), "the face towards +x"
    assert "o3" in floating.why


def test_an_implausible_object_is_worth_a_look_from_the_largest_arc():
    doubtful = replace(box(1, (0.0, 0.0, 0.8), (0.1, 0.1, 0.1)), doubt="overlaps o2 by 30 mm")
    graph = SupportGraph((box(0, (0.0, 0.0, 0.7), (1.0, 1.0, 0.04)), doubtful))
    (point,) = points_of_doubt(graph, SPHERE, np.array([at(0.0)]))
    assert point.subject == ("o1",)
    assert "overlaps o2 by 30 mm" in point.why
    np.testing.assert_allclose(point.direction, (-1.0, 0.0, 0.0), atol=1e-9)
    assert point.position_world[0] == pytest.approx(-0.05, abs=1e-3)


def test_a_relations_point_is_the_midpoint_or_the_contact():
    middle = points_of_interest(GRAPH, SPHERE, HOME, 2, PAPER)
    contact = points_of_interest(GRAPH, SPHERE, HOME, 2, CONFIG)
    np.testing.assert_allclose(middle[1].position_world, [0.1, 0.15, 0.85])
    np.testing.assert_allclose(contact[1].position_world, [0.1, 0.13, 0.85])
    np.testing.assert_allclose(contact[0].position_world, middle[0].position_world)
    for p in middle[:2]:
        np.testing.assert_allclose(p.direction, transforms.unit(p.position_world - SPHERE.centre_world))


def test_a_relations_saliency_follows_equation_2():
    points = points_of_interest(GRAPH, SPHERE, HOME, 2, CONFIG)
    assert points[0].saliency == relation_saliency(2, 2, CONFIG)
    assert points[1].saliency == relation_saliency(1, 2, CONFIG)


def test_a_point_in_the_spheres_centre_is_projected_upwards():
    pair = SupportGraph((TABLE, box(1, (0.0, 0.0, 0.77), (0.1, 0.1, 0.04))), (Support("o0", "o1"),))
    point = points_of_interest(pair, SPHERE, HOME, 1, PAPER)[0]
    np.testing.assert_allclose(point.direction, [0.0, 0.0, 1.0])


def test_an_empty_graph_has_no_points():
    assert points_of_interest(SupportGraph(), SPHERE, HOME, 1, CONFIG) == []
    assert painted([], SPHERE.directions, 0.3).shape == (500, 0)


def test_painted_saliency_peaks_at_the_points_direction():
    points = points_of_interest(GRAPH, SPHERE, HOME, 2, CONFIG)
    own = painted(points, np.stack([p.direction for p in points]), 0.3)
    np.testing.assert_allclose(np.diag(own), [p.saliency for p in points])
    assert painted(points, SPHERE.directions, 0.3).max() <= 1.0


def test_inhibition_is_deepest_at_earlier_views_and_does_not_add_up():
    twice = np.vstack([HOME, HOME])
    values = inhibition_of_return(twice, np.vstack([HOME, -HOME]), CONFIG)
    np.testing.assert_allclose(values, [-CONFIG.inhibition, 0.0], atol=1e-6)
