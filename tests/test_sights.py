from __future__ import annotations

import numpy as np
import shapely

from caryatid.geometry import transforms
from caryatid.planning.expected_visibility import unseen_space, unseen_space_reference
from caryatid.sensing.visibility import shown, shown_reference


def sights(rng: np.random.Generator, points: int, cameras: int) -> tuple[np.ndarray, ...]:
    """Random arguments of `shown`: points without a side, worth nothing, seen before are among them."""
    normals = transforms.unit(rng.normal(size=(points, 3)))
    normals[::3] = 0.0
    before = np.where(rng.random(points) < 0.5, 0.0, rng.random(points))
    weights = np.where(rng.random(points) < 0.2, 0.0, rng.random(points))
    eyes = rng.uniform(-1.0, 1.0, (cameras, 3))
    axes = transforms.unit(rng.uniform(-0.3, 0.3, (cameras, 3)) - eyes)
    solid = (rng.random((13, 17, 11)) < 0.02).astype(np.uint8)
    return (
        solid, np.array([-0.3, -0.4, -0.2]), 0.05, rng.uniform(-0.6, 0.6, (points, 3)), normals, before,
        weights, eyes.T.copy(), axes.T.copy(),
    )  # fmt: skip


def test_what_is_shown_agrees_with_its_reference():
    rng = np.random.default_rng(0)
    for clearance in (0.0, 0.3):
        args = (*sights(rng, 25, 150), clearance, 0.5, 0.7)
        compiled, reference = shown(*args), shown_reference(*args)
        np.testing.assert_allclose(compiled, reference, atol=1e-12)
        assert 500 < np.count_nonzero(reference) < 2000
        free = (np.zeros_like(args[0]), *args[1:])
        assert np.count_nonzero(shown(*free)) > np.count_nonzero(reference) + 50


def test_without_anything_solid_nothing_is_hidden():
    args = (*sights(np.random.default_rng(1), 10, 20), 0.0, 0.5, -1.0)
    nothing = (np.zeros((0, 0, 0), dtype=np.uint8), *args[1:])
    np.testing.assert_array_equal(shown(*nothing), shown(np.zeros_like(args[0]), *args[1:]))
    assert shown(*(a[:0] if n in (3, 4, 5, 6) else a for n, a in enumerate(args))).shape == (0, 20)
    assert shown(*(a[:, :0].copy() if n in (7, 8) else a for n, a in enumerate(args))).shape == (10, 0)


def test_the_unseen_space_over_a_table_agrees_with_its_reference():
    rng = np.random.default_rng(3)
    T_world_table = transforms.rigid(transforms.rotation_from_vector((0.02, -0.03, 0.6)), (0.02, -0.03, 0.0))
    x, y, z = np.arange(-0.5, 0.5, 0.04), np.arange(-0.4, 0.6, 0.04), np.arange(0.03, 0.3, 0.04)
    corners = rng.uniform(-0.3, 0.3, (12, 2))
    states = rng.choice(np.array([0, 1, 2], dtype=np.int8), (13, 17, 5), p=(0.3, 0.5, 0.2))
    solid = (rng.random((8, 9, 4)) < 0.3).astype(np.int8)
    hull = shapely.get_coordinates(shapely.MultiPoint(corners).convex_hull)
    for heap in (hull, hull[::-1], hull[:0], hull[:1], hull[:2]):
        args = (
            x, y, z, 0.29, T_world_table, np.array([0.3, 0.4]), np.ascontiguousarray(heap), states,
            np.array([-0.31, -0.41, -0.1]), solid, np.array([-0.2, -0.2, 0.01]), 0.06,
        )  # fmt: skip
        compiled, reference = unseen_space(*args), unseen_space_reference(*args)
        for ours, theirs in zip(compiled, reference, strict=True):
            np.testing.assert_allclose(ours, theirs, atol=1e-12)
        assert 300 < len(compiled[0]) < 0.7 * len(x) * len(y) * len(z)
        assert (compiled[2] > 0.0).any() == (len(heap) > 2)
