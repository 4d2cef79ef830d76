from __future__ import annotations

import numpy as np
import pytest

from caryatid.geometry.rays import room, traverse, traversed_reference

SHAPE = (13, 17, 11)


def rays(rng: np.random.Generator) -> np.ndarray:
    """Starts and directions (N, 2, 3) in voxels: any, along the axes, within one voxel."""
    starts, ends = rng.uniform(-8.0, 25.0, (2, 600, 3))
    ends[:60] = starts[:60]
    ends[np.arange(60), np.arange(60) % 3] += rng.uniform(-30.0, 30.0, 60)
    starts[:60, 0] = starts[:60, 0] % 13
    ends[60:90] = starts[60:90] + rng.uniform(-1e-3, 1e-3, (30, 3))
    return np.stack([starts, ends - starts], axis=1)


def voxels(start: np.ndarray, ray: np.ndarray, t_from: float, t_to: float) -> np.ndarray:
    """Flat indices of the voxels a ray traverses, in its order, each once."""
    found = room(SHAPE)
    slabs = traverse(found, SHAPE, tuple(start.tolist()), tuple(ray.tolist()), t_from, t_to)
    met = found[:, :slabs].T.ravel()
    return met[np.sort(np.unique(met, return_index=True)[1])]


@pytest.mark.parametrize(("t_from", "t_to"), [(0.0, 1.0), (0.3, 0.8), (0.6, 0.6)])
def test_a_ray_meets_the_voxels_of_the_reference_one_after_the_other(t_from: float, t_to: float):
    met = 0
    for start, ray in rays(np.random.default_rng(0)):
        reference = traversed_reference(SHAPE, start, start + ray, t_from, t_to, np.zeros(3), 1.0)
        right = np.ravel_multi_index(tuple(reference.T), SHAPE)
        np.testing.assert_array_equal(voxels(start, ray, t_from, t_to), right)
        met += len(right)
    assert met > 2000 or t_from == t_to


def test_a_ray_without_length_meets_nothing():
    assert len(voxels(np.full(3, 4.5), np.zeros(3), 0.2, 0.2)) == 0
    assert len(voxels(np.full(3, -4.5), np.zeros(3), 0.0, 1.0)) == 0


def test_rays_out_of_the_far_corner_stay_within_the_grid():
    for ray in ([-13.0, -17.0, -11.0], [-13.0, -1.0, -1.0], [0.0, -17.0, 0.0], [-1e-9, -1.0, -11.0]):
        met = voxels(np.array(SHAPE, dtype=float), np.array(ray), 0.0, 2.0)
        assert met.min(initial=0) >= 0
        assert met.max(initial=0) < np.prod(SHAPE)
