from __future__ import annotations

import numpy as np

from caryatid.geometry import transforms
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
