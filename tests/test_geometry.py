"""Transforms, shapes, solids, polygons and rays, tried against SciPy, shapely and plain sums."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import shapely
from synthetic import random_motion

from caryatid.config import Config
from caryatid.errors import InputError
from caryatid.evaluation.scores import as_scene, score
from caryatid.exports import export_graph
from caryatid.geometry import transforms
from caryatid.geometry.polygons import area, cap, fill, hull, intersection, signed_distance
from caryatid.geometry.rays import room, traverse
from caryatid.geometry.shapes import (
    Box,
    Cylinder,
    Primitives,
    Sphere,
    fibonacci_sphere,
)
from caryatid.geometry.solids import Polytope, Solid, hollowed
from caryatid.graph import SceneObject, SupportGraph
from caryatid.simulation.generation import generate
from caryatid.simulation.truth import ground_truth
from caryatid.simulation.world import true_shapes
from caryatid.support.contacts import find_contacts
from caryatid.support.relations import infer

# Transforms


@pytest.fixture
def rng():
    return np.random.default_rng(3)


@pytest.fixture
def T_a_b(rng):
    return transforms.rigid(transforms.random_rotation(rng), rng.normal(size=3))


def test_a_rigid_transform_is_taken_as_it_is_also_from_lists(T_a_b):
    taken = transforms.as_rigid(T_a_b.tolist())
    assert taken.dtype == np.float64
    np.testing.assert_array_equal(taken, T_a_b)
    transforms.as_rigid(np.round(T_a_b, 6))  # A text file rounds.


def broken(change):
    T = np.eye(4)
    change(T)
    return T


@pytest.mark.parametrize(
    ("T", "reason"),
    [
        (np.eye(3), r"shape \(3, 3\)"),
        (broken(lambda T: T.__setitem__((0, 3), np.nan)), "NaN"),
        (broken(lambda T: T.__setitem__((0, 3), np.inf)), "infinity"),
        (broken(lambda T: T.__setitem__((3, 0), 0.1)), "last row"),
        (broken(lambda T: T.__setitem__((0, 0), 1.01)), "not a rotation"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "mirrored"),
        (np.zeros((4, 4)), "last row"),
    ],
)
def test_other_matrices_than_rigid_transforms_are_refused_by_name_and_reason(T, reason):
    with pytest.raises(InputError, match=reason) as caught:
        transforms.as_rigid(T, "frame 7")
    assert str(caught.value).startswith("frame 7: ")
    assert caught.value.remedy


def test_looking_at_a_point_puts_it_on_the_axis_with_up_upwards(rng):
    for _ in range(20):
        eye, target = rng.normal(size=(2, 3))
        T_world_camera = transforms.as_rigid(transforms.look_at(eye, target))
        target_camera = transforms.transform(transforms.invert(T_world_camera), target)
        np.testing.assert_allclose(target_camera, [0.0, 0.0, np.linalg.norm(target - eye)], atol=1e-12)
        np.testing.assert_allclose(T_world_camera[:3, 3], eye)
        up_camera = transforms.rotate(transforms.invert(T_world_camera), np.array([0.0, 0.0, 1.0]))
        assert abs(up_camera[0]) < 1e-12
        assert up_camera[1] < 0.0


@pytest.mark.parametrize("target", [(0.0, 0.0, -1.0), (0.0, 0.0, 1.0)])
def test_looking_straight_down_or_up_has_a_roll_all_the_same(target):
    T_world_camera = transforms.as_rigid(transforms.look_at((0.0, 0.0, 0.0), target))
    np.testing.assert_allclose(T_world_camera[:3, 2], target)
    np.testing.assert_allclose(-T_world_camera[:3, 1], (1.0, 0.0, 0.0), atol=1e-12)
    along_up = transforms.as_rigid(transforms.look_at((0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (1.0, 0.0, 0.0)))
    np.testing.assert_allclose(along_up[:3, 2], (1.0, 0.0, 0.0))
    with pytest.raises(InputError, match="same point"):
        transforms.look_at((1.0, 2.0, 3.0), (1.0, 2.0, 3.0))


# Shapes


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
def test_gradients_point_away_from_the_surface(shape):
    points, _ = around(shape, 200)
    distances, outward = Primitives.of([shape]).gradient(0, points)
    np.testing.assert_allclose(distances, shape.signed_distance(points), atol=1e-12)
    steps = shape.signed_distance(points + 1e-7 * outward) - distances
    np.testing.assert_allclose(steps, 1e-7, atol=1e-9)


@each
def test_meshes_and_lines_lie_on_the_surface(shape):
    corners = transforms.transform(shape.T_world_object, shape.mesh().vertices)
    lines = np.concatenate(shape.lines(np.array([1.0, 2.0, 3.0])))
    for points in (corners, lines):
        np.testing.assert_allclose(shape.signed_distance(points), 0.0, atol=1e-9)
    assert shape.mesh().volume == pytest.approx(shape.volume, rel=0.02)


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
def test_the_squares_in_a_polygon_are_those_of_shapely(seed):
    rng = np.random.default_rng(seed)
    for _ in range(100):
        corners = hull(rng.integers(0, 30, (rng.integers(3, 12), 2)).astype(np.float64))
        if len(corners) < 3:
            continue
        squares, places = np.zeros((30, 30), dtype=np.bool_), np.indices((30, 30))
        fill(corners, squares)
        inside = shapely.contains_xy(shapely.Polygon(corners), *places.reshape(2, -1).astype(np.float64))
        np.testing.assert_array_equal(squares.ravel(), inside)


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


# Solids


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


@pytest.mark.parametrize("name", ["tray.xml", "tray.urdf", "tray.glb", "tray.dot"])
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
