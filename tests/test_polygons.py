from __future__ import annotations

import numpy as np
import pytest
import shapely

from caryatid.geometry import transforms
from caryatid.geometry.polygons import area, cap, hull, intersection, nearest_on_border

SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
CUBE = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
CUBE_EDGES = np.array([(i, i + bit) for i in range(8) for bit in (1, 2, 4) if not i & bit])


def random_polygon(rng, middle=(0.0, 0.0)):
    return hull(rng.normal(size=(int(rng.integers(3, 40)), 2)) + middle)


def turned(polygon):
    """The same polygon, its corners counted from another one."""
    return np.roll(polygon, len(polygon) // 2, axis=0)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 7, 50, 300])
def test_the_hull_is_the_one_of_shapely(count):
    rng = np.random.default_rng(count)
    points = rng.normal(size=(count, 2))
    points = np.concatenate([points, points[: count // 2]])
    expected = shapely.MultiPoint(points).convex_hull
    corners = hull(points)
    assert {tuple(c) for c in corners} == {tuple(c) for c in shapely.get_coordinates(expected)}
    assert area(corners) == pytest.approx(expected.area)
    if count > 2:
        assert shapely.LinearRing(corners).is_ccw


def test_the_hull_looks_at_the_ground_only_and_leaves_the_points_alone():
    points = np.random.default_rng(0).normal(size=(20, 3))
    before = points.copy()
    np.testing.assert_array_equal(hull(points), hull(points[:, :2].copy()))
    np.testing.assert_array_equal(points, before)


def test_hulls_without_area():
    line = np.arange(9)[:, None] * (0.5, 0.25)
    for often in (1, 2, 30):
        assert {tuple(c) for c in hull(np.tile(line, (often, 1)))} == {(0.0, 0.0), (4.0, 2.0)}
        assert hull(np.ones((5 * often, 2))).tolist() == [[1.0, 1.0]]
    assert hull(np.empty((0, 2))).shape == (0, 2)
    assert area(hull(line)) == area(hull(np.ones((5, 2)))) == area(np.empty((0, 2))) == 0.0


def test_the_hull_goes_round_a_square_with_points_on_its_sides():
    grid = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, 5)] * 2), axis=-1).reshape(-1, 2)
    assert {tuple(c) for c in hull(grid)} == {tuple(c) for c in SQUARE}
    assert len(hull(grid)) == 4


@pytest.mark.parametrize("seed", range(30))
def test_the_intersection_is_the_one_of_shapely(seed):
    rng = np.random.default_rng(seed)
    a, b = random_polygon(rng), random_polygon(rng, rng.uniform(-3.0, 3.0, 2))
    expected = shapely.Polygon(a).intersection(shapely.Polygon(b))
    for common in (intersection(a, b), intersection(b, a), intersection(turned(a), turned(b))):
        assert area(common) == pytest.approx(expected.area, abs=1e-12)
        if expected.area > 0.0:
            assert shapely.Polygon(common).symmetric_difference(expected).area < 1e-9


def test_intersections_of_polygons_inside_beside_and_equal():
    inner = 0.5 * SQUARE + 0.2
    for common in (intersection(SQUARE, inner), intersection(inner, SQUARE)):
        assert area(common) == pytest.approx(0.25)
    assert area(intersection(SQUARE, SQUARE)) == pytest.approx(1.0)
    assert area(intersection(SQUARE, SQUARE + (1.0, 0.0))) == 0.0
    assert len(intersection(SQUARE, SQUARE + 2.0)) == 0
    for nothing in (SQUARE[:0], SQUARE[:1], SQUARE[:2]):
        assert area(intersection(SQUARE, nothing)) == area(intersection(nothing, SQUARE)) == 0.0


@pytest.mark.parametrize("seed", range(10))
def test_the_nearest_point_of_the_border_is_the_one_of_shapely(seed):
    rng = np.random.default_rng(seed)
    polygon = random_polygon(rng)
    for corners in (polygon, polygon[:2], polygon[:1]):
        exact = shapely.Polygon(corners) if len(corners) > 2 else shapely.MultiPoint(corners).convex_hull
        border = exact.exterior if len(corners) > 2 else exact
        for x, y in rng.normal(size=(20, 2)):
            distance, near_x, near_y, inside = nearest_on_border(corners, x, y)
            point = shapely.Point(x, y)
            assert distance == pytest.approx(border.distance(point))
            assert np.hypot(near_x - x, near_y - y) == pytest.approx(distance)
            assert border.distance(shapely.Point(near_x, near_y)) < 1e-12
            assert inside == (len(corners) > 2 and exact.contains(point))


@pytest.mark.parametrize("seed", range(20))
def test_the_cap_is_what_lies_near_the_outermost_point(seed):
    """Against the hull of all segments between corners, cut off by the plane."""
    rng = np.random.default_rng(seed)
    corners = (CUBE * rng.uniform(0.02, 0.2, 3)) @ transforms.random_rotation(rng).T + rng.normal(size=3)
    direction = transforms.unit(rng.normal(size=3))
    depth = rng.uniform(0.001, 0.2)
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


def test_a_cap_deeper_than_the_solid_is_all_of_it():
    whole = cap(CUBE, CUBE_EDGES, np.array([0.6, 0.0, 0.8]), np.inf)
    assert area(whole) == pytest.approx(4.0)
