from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
import pytest

from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Primitives, Shape, Sphere
from caryatid.geometry.transforms import Array, rigid
from caryatid.support.contacts import find_contacts, find_gap, local_frames


def at(x: float, y: float, z: float, turn: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Array:
    return rigid(transforms.rotation_from_vector(np.radians(turn)), (x, y, z))


def cube(x: float, y: float, z: float, side: float = 0.1) -> Box:
    return Box(at(x, y, z), np.full(3, side))


def random_shapes(count: int, rng: np.random.Generator, side: float) -> list[Shape]:
    shapes: list[Shape] = []
    for k in range(count):
        T = rigid(transforms.random_rotation(rng), rng.uniform(-side, side, 3))
        a, b, c = rng.uniform(0.04, 0.15, 3)
        shapes.append([Box(T, np.array([a, b, c])), Cylinder(T, a / 2.0, b), Sphere(T, a / 2.0)][k % 3])
    return shapes


def compiled_for(shapes: list[Shape], margins: Array) -> list[tuple[int, int, float]]:
    """What MuJoCo finds in a model made of these very shapes: (a, b, smallest distance)."""
    spec = mujoco.MjSpec()
    for shape, extra in zip(shapes, margins, strict=True):
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, shape.T_world_object[:3, :3].ravel())
        body = spec.worldbody.add_body(pos=shape.T_world_object[:3, 3], quat=quaternion)
        body.add_freejoint()
        half = shape.extents / 2.0
        size = {"box": half, "cylinder": (half[0], half[2], 0.0), "sphere": half}[shape.kind]
        kind = {"box": mujoco.mjtGeom.mjGEOM_BOX, "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER}
        body.add_geom(type=kind.get(shape.kind, mujoco.mjtGeom.mjGEOM_SPHERE), size=size, margin=extra / 2.0)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    found: dict[tuple[int, int], float] = {}
    for geoms, distance in zip(np.sort(data.contact.geom, axis=1).tolist(), data.contact.dist, strict=True):
        pair = (geoms[0], geoms[1])
        found[pair] = min(found.get(pair, np.inf), float(distance))
    return [(a, b, found[a, b]) for a, b in sorted(found)]


def gaps(shapes: list[Shape], margin: float | Array) -> list[tuple[int, int, float]]:
    return [(c.a, c.b, c.distance) for c in find_contacts(shapes, margin)]


def pairs(shapes: list[Shape], margin: float | list[float]) -> list[tuple[int, int]]:
    return [(c.a, c.b) for c in find_contacts(shapes, margin)]


@pytest.mark.parametrize(
    ("upper", "lower"),
    [
        (cube(0, 0, 0.1), cube(0, 0, 0)),
        (Cylinder(at(0, 0, 0.1), 0.03, 0.1), cube(0, 0, 0)),
        (Sphere(at(0, 0, 0.08), 0.03), cube(0, 0, 0)),
        (Sphere(at(0, 0, 0.08), 0.03), Cylinder(at(0, 0, 0), 0.04, 0.1)),
        (Cylinder(at(0, 0, 0.1), 0.03, 0.1), Cylinder(at(0, 0, 0), 0.04, 0.1)),
        (Sphere(at(0, 0, 0.08), 0.03), Sphere(at(0, 0, 0), 0.05)),
    ],
)
def test_every_pair_of_kinds_touches_with_the_normal_from_a_to_b(upper: Shape, lower: Shape) -> None:
    for gap in (0.004, -0.004):
        lifted = upper.moved(at(0, 0, gap))
        (up,) = find_contacts([lower, lifted], 0.01)
        (down,) = find_contacts([lifted, lower], 0.01)
        np.testing.assert_allclose(up.normal_world, (0, 0, 1), atol=1e-3)
        np.testing.assert_allclose(down.normal_world, (0, 0, -1), atol=1e-3)
        assert up.distance == pytest.approx(gap, abs=1e-4)
        np.testing.assert_allclose(up.points_world[:, 2].mean(), 0.05 + gap / 2.0, atol=1e-3)


@pytest.mark.parametrize("margin", [0.001, 0.005, 0.02])
def test_margin_is_the_largest_gap(margin: float) -> None:
    near, far = cube(0, 0, 0.1 + 0.95 * margin), cube(0, 0, 0.1 + 1.05 * margin)
    assert pairs([cube(0, 0, 0), near], margin) == [(0, 1)]
    assert pairs([cube(0, 0, 0), far], margin) == []


def test_margins_of_each_shape_count_by_their_mean() -> None:
    shapes: list[Shape] = [cube(0, 0, 0), cube(0, 0, 0.109)]
    assert pairs(shapes, [0.002, 0.018]) == [(0, 1)]
    assert pairs(shapes, [0.002, 0.014]) == []


def test_zero_margin_still_finds_overlap() -> None:
    assert pairs([cube(0, 0, 0), cube(0, 0, 0.099)], 0.0) == [(0, 1)]
    assert pairs([cube(0, 0, 0), cube(0, 0, 0.101)], 0.0) == []


def test_all_pairs_are_checked_and_sorted() -> None:
    shapes: list[Shape] = [cube(0.03 * k, 0, 0) for k in range(4)]
    assert pairs(shapes, 0.0) == [(i, j) for i in range(4) for j in range(i + 1, 4)]


def test_deep_overlap_of_noisy_fits_keeps_the_plane() -> None:
    base = Box(at(0, 0, 0), np.array([0.3, 0.3, 0.04]))
    for upper in (
        Box(at(0.05, 0.02, 0.05, (2, 1, 30)), np.array([0.1, 0.08, 0.09])),
        Cylinder(at(0.05, 0.02, 0.05, (2, 1, 0)), 0.04, 0.09),
        Sphere(at(0.05, 0.02, 0.045), 0.04),
    ):
        (contact,) = find_contacts([base, upper], 0.005)
        assert contact.distance < -0.01
        assert np.degrees(transforms.angle_between(contact.normal_world, (0, 0, 1))) < 5.0


def test_distance_and_points_agree_with_signed_distance() -> None:
    rng = np.random.default_rng(3)
    seen = 0
    for _ in range(10):
        shapes = random_shapes(8, rng, 0.15)
        for contact in find_contacts(shapes, 0.02):
            a, b = shapes[contact.a], shapes[contact.b]
            assert contact.points_world.shape[1:] == (3,)
            assert np.linalg.norm(contact.normal_world) == pytest.approx(1.0)
            if contact.distance > 0.0:
                seen += 1
                apart = a.signed_distance(contact.points_world) + b.signed_distance(contact.points_world)
                assert apart.min() == pytest.approx(contact.distance, abs=5e-4)
    assert seen > 10


def test_one_search_after_another_finds_what_a_model_of_the_shapes_alone_does() -> None:
    rng = np.random.default_rng(11)
    touching = 0
    for count in (30, 3, 17, 2, 70, 16):
        shapes = random_shapes(count, rng, 0.05 * count ** (1.0 / 3.0))
        margins = rng.uniform(0.0, 0.02, count)
        expected = compiled_for(shapes, margins)
        found = gaps(shapes, margins)
        assert [f[:2] for f in found] == [e[:2] for e in expected]
        np.testing.assert_allclose([f[2] for f in found], [e[2] for e in expected], atol=1e-12)
        touching += len(found)
    assert touching > 100


def test_threads_do_not_disturb_each_other() -> None:
    rng = np.random.default_rng(12)
    scenes = [random_shapes(25, rng, 0.15) for _ in range(40)]
    alone = [gaps(shapes, 0.01) for shapes in scenes]
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(lambda shapes: gaps(shapes, 0.01), scenes)) == alone


def test_the_point_of_a_contact_is_in_the_middle_of_its_points() -> None:
    (contact,) = find_contacts([cube(0, 0, 0), cube(0.03, 0.02, 0.1)], 0.005)
    assert len(contact.points_world) > 1
    np.testing.assert_allclose(contact.point_world, contact.points_world.mean(axis=0))


def test_contacts_in_the_frames_of_both_shapes() -> None:
    rng = np.random.default_rng(13)
    shapes = random_shapes(12, rng, 0.1)
    contacts = find_contacts(shapes, 0.02)
    points, outward = local_frames(
        Primitives.of(shapes),
        np.array([(c.a, c.b) for c in contacts]),
        np.array([c.point_world for c in contacts]),
        np.array([c.normal_world for c in contacts]),
    )
    for k, contact in enumerate(contacts):
        for side, (index, sign) in enumerate(((contact.a, 1.0), (contact.b, -1.0))):
            T = transforms.invert(shapes[index].T_world_object)
            np.testing.assert_allclose(
                points[k, side], transforms.transform(T, contact.point_world), atol=1e-12
            )
            np.testing.assert_allclose(
                outward[k, side], sign * transforms.rotate(T, contact.normal_world), atol=1e-12
            )


def test_gap_of_shapes_far_apart() -> None:
    assert find_gap(cube(0, 0, 0), cube(0.3, 0.02, 0)) == pytest.approx(0.2, abs=1e-4)
    assert find_gap(cube(0, 0, 0), Sphere(at(0.05, 0.0, 0.4), 0.03)) == pytest.approx(0.32, abs=1e-4)
    assert find_gap(cube(0, 0, 0), cube(0, 0, 0.09)) == pytest.approx(-0.01, abs=1e-3)


def test_rigid_motion_moves_contacts_along() -> None:
    rng = np.random.default_rng(5)
    for _ in range(10):
        shapes = random_shapes(9, rng, 0.15)
        T = rigid(transforms.random_rotation(rng), rng.uniform(-1, 1, 3))
        still, moved = find_contacts(shapes, 0.01), find_contacts([s.moved(T) for s in shapes], 0.01)
        assert [(c.a, c.b) for c in moved] == [(c.a, c.b) for c in still]
        for one, other in zip(still, moved, strict=True):
            assert other.distance == pytest.approx(one.distance, abs=1e-4)


def test_inputs_stay_as_they_were() -> None:
    rng = np.random.default_rng(1)
    shapes = random_shapes(6, rng, 0.1)
    before = [s.T_world_object.copy() for s in shapes]
    find_contacts(shapes, 0.01)
    for shape, T in zip(shapes, before, strict=True):
        np.testing.assert_array_equal(shape.T_world_object, T)


def test_few_shapes_and_bad_margins() -> None:
    assert find_contacts([], 0.01) == []
    assert find_contacts([cube(0, 0, 0)], 0.01) == []
    for bad in (-0.001, float("nan"), [0.1]):
        with pytest.raises(InputError, match="margin"):
            find_contacts([cube(0, 0, 0), cube(0, 0, 0.1)], bad)
