"""Shapes, polygons, rays, points and views on a sphere, tried against SciPy, shapely and plain sums."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
import shapely
from scipy.spatial import ConvexHull, cKDTree
from synthetic import random_motion, table_object, thing

from caryatid.config import SupportConfig
from caryatid.errors import InputError
from caryatid.exports import export_graph
from caryatid.geometry import transforms
from caryatid.geometry.polygons import area, cap, hull, intersection, signed_distance
from caryatid.geometry.rays import room, traverse
from caryatid.geometry.shapes import (
    KINDS,
    Box,
    Cylinder,
    Primitives,
    Shape,
    Sphere,
    fibonacci_sphere,
)
from caryatid.io.graph_json import graph_text, read_graph
from caryatid.support.relations import infer

T = random_motion(np.random.default_rng(1))
SOLIDS = [Box(T, np.array([0.06, 0.1, 0.14])), Cylinder(T, 0.04, 0.11), Sphere(T, 0.05)]

each = pytest.mark.parametrize("shape", SOLIDS, ids=lambda s: s.kind)


def around(shape, count: int = 20_000):
    """Points in a cube about the shape, and its volume."""
    side = 1.4 * float(np.linalg.norm(shape.extents))
    local = np.random.default_rng(0).uniform(-side / 2, side / 2, (count, 3))
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
@pytest.mark.parametrize("spacing", [1e-6, 1e-300])
def test_a_surface_of_too_many_points_is_refused(shape, spacing):
    with pytest.raises(InputError, match="is too fine"):
        shape.surface(spacing)


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
    np.testing.assert_allclose(2.0 * shape.support(shape.T_world_object[:3, :3].T), shape.extents)
    low, high = Primitives.of([shape]).bounds()
    np.testing.assert_allclose(high[0] - low[0], 2.0 * shape.support(np.eye(3)))


@each
def test_the_outline_spans_the_shape(shape):
    hull = ConvexHull(shape.outline())
    assert hull.volume == pytest.approx(shape.volume, rel=0.03)
    assert shape.signed_distance(shape.outline()).max() < 1e-9


@each
def test_meshes_and_lines_lie_on_the_surface(shape):
    corners = transforms.transform(shape.T_world_object, shape.mesh().vertices)
    lines = np.concatenate(shape.lines(np.array([1.0, 2.0, 3.0])))
    for points in (corners, lines):
        np.testing.assert_allclose(shape.signed_distance(points), 0.0, atol=1e-9)
    assert shape.mesh().volume == pytest.approx(shape.volume, rel=0.02)


@pytest.fixture
def prism():
    """A kind of shape from outside the package: a straight hexagonal prism."""

    @dataclass(frozen=True, eq=False, slots=True, repr=False)
    class Prism(Shape):
        T_world_object: np.ndarray
        radius: float
        height: float
        kind: ClassVar[str] = "prism"

        @property
        def extents(self):
            return np.array([2.0 * self.radius, np.sqrt(3.0) * self.radius, self.height])

        @classmethod
        def from_extents(cls, T_world_object, extents):
            return cls(T_world_object, float(extents[0]) / 2.0, float(extents[2]))

        def outline(self):
            angle = np.pi / 3.0 * np.arange(6)
            ring = self.radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(6)], axis=1)
            end = np.array([0.0, 0.0, self.height / 2.0])
            return transforms.transform(self.T_world_object, np.concatenate([ring + end, ring - end]))

    yield Prism(transforms.rigid(np.eye(3), (0.0, 0.0, 0.81)), 0.05, 0.12)
    del KINDS["prism"]


def test_a_kind_of_shape_from_outside_works_in_files_exports_and_drawings(prism, tmp_path):
    graph = infer([table_object(), thing(1, prism)], SupportConfig())
    assert graph.support("o0", "o1") is not None
    (tmp_path / "graph.json").write_text(graph_text(graph))
    again = read_graph(tmp_path / "graph.json").objects[1].shape
    assert type(again) is type(prism)
    assert again.size == {"radius": 0.05, "height": 0.12}
    assert prism.volume == pytest.approx(1.5 * np.sqrt(3.0) * 0.05**2 * 0.12)
    assert "prism" in repr(prism).lower()
    assert len(prism.lines(np.array([1.0, 1.0, 1.0]))) >= 18
    for name in ("scene.glb", "scene.urdf"):
        export_graph(graph, tmp_path / name)
    assert "o1" in (tmp_path / "scene.urdf").read_text()


SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
CUBE = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
CUBE_EDGES = np.array([(i, i + bit) for i in range(8) for bit in (1, 2, 4) if not i & bit])


def random_polygon(rng, middle=(0.0, 0.0)):
    return hull(rng.normal(size=(int(rng.integers(3, 40)), 2)) + middle)


LINE = np.arange(9)[:, None] * (0.5, 0.25)
RASTER = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, 5)] * 2), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize(
    "points",
    [np.empty((0, 2)), np.ones((5, 2)), LINE, np.tile(LINE, (30, 1)), RASTER]
    + [np.random.default_rng(count).normal(size=(count, 2)) for count in (1, 2, 3, 4, 7, 50, 300)],
)
def test_the_hull_is_the_one_of_shapely(points):
    points = np.concatenate([points, points[: len(points) // 2]])
    expected = shapely.MultiPoint(points).convex_hull
    corners = hull(points)
    assert {tuple(c) for c in corners} == {tuple(c) for c in shapely.get_coordinates(expected)}
    assert len(corners) == len({tuple(c) for c in corners})
    assert area(corners) == pytest.approx(expected.area)
    assert len(corners) < 3 or shapely.LinearRing(corners).is_ccw
    above = np.column_stack([points, np.arange(len(points))])
    np.testing.assert_array_equal(hull(above), corners)
    np.testing.assert_array_equal(above[:, :2], points)


def test_the_intersection_is_the_one_of_shapely():
    rng = np.random.default_rng(0)
    polygons = [SQUARE, 0.5 * SQUARE + 0.2, SQUARE + (1.0, 0.0), SQUARE + 2.0]
    polygons += [random_polygon(rng, rng.uniform(-1.5, 1.5, 2)) for _ in range(6)]
    for a in polygons:
        for b in polygons:
            expected = shapely.Polygon(a).intersection(shapely.Polygon(b))
            for common in (intersection(a, b), intersection(np.roll(a, 2, axis=0), np.roll(b, 2, axis=0))):
                assert area(common) == pytest.approx(expected.area, abs=1e-12)
                if expected.area > 0.0:
                    assert shapely.Polygon(common).symmetric_difference(expected).area < 1e-9
        for nothing in (SQUARE[:0], SQUARE[:1], SQUARE[:2]):
            assert area(intersection(a, nothing)) == area(intersection(nothing, a)) == 0.0


@pytest.mark.parametrize("seed", range(3))
def test_the_distance_to_the_border_is_that_of_shapely(seed):
    rng = np.random.default_rng(seed)
    polygon = random_polygon(rng)
    for corners in (polygon, polygon[:2], polygon[:1]):
        exact = shapely.Polygon(corners) if len(corners) > 2 else shapely.MultiPoint(corners).convex_hull
        border = exact.exterior if len(corners) > 2 else exact
        for x, y in rng.normal(size=(20, 2)):
            point = shapely.Point(x, y)
            inside = len(corners) > 2 and exact.contains(point)
            distance = border.distance(point) * (-1.0 if inside else 1.0)
            assert signed_distance(corners, x, y) == pytest.approx(distance)


@pytest.mark.parametrize("seed", range(5))
def test_the_cap_is_what_lies_near_the_outermost_point(seed):
    """Against the hull of all segments between corners, cut off by the plane; one cap is all of the solid."""
    rng = np.random.default_rng(seed)
    corners = (CUBE * rng.uniform(0.02, 0.2, 3)) @ transforms.random_rotation(rng).T + rng.normal(size=3)
    direction = transforms.unit(rng.normal(size=3))
    depth = rng.uniform(0.001, 0.2) if seed else 9.0
    reach = corners @ direction
    kept = [corners[reach >= reach.max() - depth]]
    for i in range(8):
        for j in range(8):
            share = (reach[i] - (reach.max() - depth)) / (reach[i] - reach[j]) if i != j else -1.0
            if 0.0 <= share <= 1.0:
                kept.append(corners[None, i] + share * (corners[j] - corners[i]))
    expected = shapely.MultiPoint(np.concatenate(kept)[:, :2]).convex_hull
    found = shapely.Polygon(cap(corners, CUBE_EDGES, direction, depth))
    assert found.symmetric_difference(expected).area < 1e-9 * expected.area + 1e-15


GRID = (13, 17, 11)


def rays(rng: np.random.Generator) -> np.ndarray:
    """Starts and directions (N, 2, 3) in voxels: any, along the axes, within one voxel."""
    starts, ends = rng.uniform(-8.0, 25.0, (2, 600, 3))
    ends[:60] = starts[:60]
    ends[np.arange(60), np.arange(60) % 3] += rng.uniform(-30.0, 30.0, 60)
    starts[:60, 0] = starts[:60, 0] % 13
    ends[60:90] = starts[60:90] + rng.uniform(-1e-3, 1e-3, (30, 3))
    return np.stack([starts, ends - starts], axis=1)


def traversed(start, ray, t_from, t_to):
    """Voxels (K, 3) a ray traverses: between two neighbouring plane crossings it is inside one voxel."""
    crossings = [np.array([t_from, t_to])]
    for axis in range(3):
        if ray[axis] != 0.0:
            crossings.append((np.arange(GRID[axis] + 1) - start[axis]) / ray[axis])
    t = np.unique(np.concatenate(crossings))
    t = t[(t >= t_from) & (t <= t_to)]
    met = np.floor(start + (t[1:] + t[:-1])[:, None] / 2.0 * ray).astype(int)
    return met[((met >= 0) & (met < GRID)).all(axis=1)]


def voxels(start: np.ndarray, ray: np.ndarray, t_from: float, t_to: float) -> np.ndarray:
    """Flat indices of the voxels a ray traverses, in its order, each once."""
    found = room(GRID)
    slabs = traverse(found, GRID, tuple(start.tolist()), tuple(ray.tolist()), t_from, t_to)
    met = found[:, :slabs].T.ravel()
    return met[np.sort(np.unique(met, return_index=True)[1])]


@pytest.mark.parametrize(("t_from", "t_to"), [(0.0, 1.0), (0.3, 0.8), (0.6, 0.6)])
def test_a_ray_meets_the_voxels_of_the_reference_one_after_the_other(t_from: float, t_to: float):
    met = 0
    for start, ray in rays(np.random.default_rng(0)):
        reference = traversed(start, ray, t_from, t_to)
        right = np.ravel_multi_index(tuple(reference.T), GRID)
        np.testing.assert_array_equal(voxels(start, ray, t_from, t_to), right)
        met += len(right)
    assert met > 2000 or t_from == t_to


def test_rays_out_of_the_far_corner_stay_within_the_grid():
    for ray in ([-13.0, -17.0, -11.0], [-13.0, -1.0, -1.0], [0.0, -17.0, 0.0], [-1e-9, -1.0, -11.0]):
        met = voxels(np.array(GRID, dtype=float), np.array(ray), 0.0, 2.0)
        assert met.min(initial=0) >= 0
        assert met.max(initial=0) < np.prod(GRID)
