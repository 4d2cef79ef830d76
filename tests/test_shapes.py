from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import ConvexHull, cKDTree
from synthetic import random_motion

from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Sphere, fibonacci_sphere, from_size

T = random_motion(np.random.default_rng(1))
SHAPES = [Box(T, np.array([0.06, 0.1, 0.14])), Cylinder(T, 0.04, 0.11), Sphere(T, 0.05)]

each = pytest.mark.parametrize("shape", SHAPES, ids=lambda s: s.kind)


def around(shape, count: int = 20_000, seed: int = 0):
    """Points in a cube about the shape, and its volume."""
    side = 1.4 * float(np.linalg.norm(shape.extents))
    local = np.random.default_rng(seed).uniform(-side / 2, side / 2, (count, 3))
    return local + shape.T_world_object[:3, 3], side**3


@each
def test_the_surface_lies_at_distance_zero_with_outward_normals(shape):
    points, normals = shape.surface(0.005)
    np.testing.assert_allclose(shape.signed_distance(points), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    for step in (-1e-4, 0.002):
        np.testing.assert_allclose(shape.signed_distance(points + step * normals), step, atol=1e-12)


@each
def test_the_surface_is_sampled_all_over_as_densely_as_asked(shape):
    spacing = 0.006
    coarse, _ = shape.surface(spacing)
    fine, _ = shape.surface(spacing / 8.0)
    gap, _ = cKDTree(coarse).query(fine)
    assert gap.max() < 1.1 * spacing
    nearest, _ = cKDTree(coarse).query(coarse, k=2)
    assert np.median(nearest[:, 1]) > 0.5 * spacing


@each
def test_distances_are_those_to_the_nearest_point_of_the_surface(shape):
    surface, _ = shape.surface(0.002)
    points, _ = around(shape, 400)
    gap, _ = cKDTree(surface).query(points)
    np.testing.assert_allclose(np.abs(shape.signed_distance(points)), gap, atol=0.0021)


@each
def test_the_volume_is_that_of_the_points_inside(shape):
    points, cube = around(shape)
    share = (shape.signed_distance(points) < 0.0).mean()
    sigma = np.sqrt(share * (1.0 - share) / len(points))
    assert shape.volume == pytest.approx(cube * share, abs=4.0 * sigma * cube)


@each
def test_the_support_function_reaches_as_far_as_the_surface(shape):
    directions = fibonacci_sphere(100)
    points, _ = shape.surface(0.001)
    reach = ((points - shape.T_world_object[:3, 3]) @ directions.T).max(axis=0)
    np.testing.assert_allclose(shape.support(directions), reach, atol=0.0012)
    assert (shape.support(directions) >= reach - 1e-12).all()


@each
def test_the_extents_are_the_reach_along_its_own_axes(shape):
    axes = shape.T_world_object[:3, :3].T
    np.testing.assert_allclose(2.0 * shape.support(axes), shape.extents)


@each
def test_the_outline_spans_the_shape(shape):
    hull = ConvexHull(shape.outline())
    assert hull.volume == pytest.approx(shape.volume, rel=0.03)
    assert shape.signed_distance(shape.outline()).max() < 1e-9


@each
def test_a_moved_shape_is_the_same_shape_elsewhere(shape):
    motion = random_motion(np.random.default_rng(2))
    points, _ = around(shape, 100)
    there = shape.moved(motion)
    assert there.size == shape.size
    np.testing.assert_allclose(
        there.signed_distance(transforms.transform(motion, points)), shape.signed_distance(points), atol=1e-12
    )


@each
def test_name_and_size_give_the_shape_again(shape):
    again = from_size(shape.kind, shape.T_world_object, shape.size, "graph.json")
    assert type(again) is type(shape)
    np.testing.assert_array_equal(again.extents, shape.extents)
    np.testing.assert_array_equal(again.T_world_object, shape.T_world_object)


@pytest.mark.parametrize(
    ("kind", "size"),
    [
        ("cone", {"radius": 0.1, "height": 0.1}),
        ("box", [0.1, 0.2]),
        ("box", ["wide", 0.1, 0.1]),
        ("box", {"radius": 0.1}),
        ("cylinder", {"radius": 0.1}),
        ("sphere", [0.1]),
        ("sphere", {"radius": None}),
    ],
)
def test_sizes_that_do_not_fit_the_shape_are_refused(kind, size):
    with pytest.raises(InputError, match=f"no shape '{kind}'") as caught:
        from_size(kind, np.eye(4), size, "graph.json")
    assert "a cylinder {radius, height}" in str(caught.value)


def test_a_shape_is_not_put_at_a_pose_that_is_none():
    with pytest.raises(InputError, match="T_world_object"):
        from_size("sphere", 2.0 * np.eye(4), {"radius": 0.1}, "graph.json")


def test_the_fibonacci_sphere_is_even():
    directions = fibonacci_sphere(2000)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)
    gap, _ = cKDTree(directions).query(directions, k=2)
    # Each has a cell of 4π/2000: neighbours are about its width apart, nowhere half or twice that.
    width = np.sqrt(4.0 * np.pi / 2000)
    assert gap[:, 1].min() > 0.5 * width
    assert gap[:, 1].max() < 1.2 * width
