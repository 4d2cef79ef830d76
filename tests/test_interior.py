from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic import box, cylinder, sphere, surface_points

from caryatid.config import FitConfig, VoxelConfig
from caryatid.fitting.free_space import free_inside, free_share
from caryatid.fitting.primitives import Oriented, candidates, fit
from caryatid.sensing.voxel_map import VoxelMap

INSET = 0.012


def map_with(free) -> VoxelMap:
    """A map around the origin whose voxels are free where `free` says so of their centres, else unknown."""
    nothing = VoxelMap.around((0.0, 0.0, 0.0), VoxelConfig())
    centres = nothing.centres_world(np.indices(nothing.hits.shape).reshape(3, -1).T)
    passes = free(centres).reshape(nothing.hits.shape).astype(np.uint8)
    return replace(nothing, passes=passes)


@pytest.mark.parametrize("kind", ["box", "cylinder", "sphere"])
def test_half_of_a_shape_in_free_space_is_half_free(kind):
    at = (0.0, 0.0, 0.2)
    shape = {
        "box": box(at, (0.2, 0.1, 0.12)),
        "cylinder": cylinder(at, 0.07, 0.12),
        "sphere": sphere(at, 0.08),
    }[kind]
    assert free_share(shape, map_with(lambda p: p[:, 0] > 0.0), INSET) == pytest.approx(0.5, abs=0.1)
    assert free_share(shape, map_with(lambda p: p[:, 0] > 1.0), INSET) == 0.0
    assert free_share(shape, map_with(lambda p: p[:, 0] > -9.0), INSET) == 1.0


def test_the_surface_says_nothing():
    shape = box((0.0, 0.0, 0.2), (0.2, 0.2, 0.2))
    skin = map_with(lambda p: np.abs(shape.signed_distance(p)) < 0.005)
    inside, free = free_inside(shape, skin, INSET)
    assert inside > 1000
    assert free == 0
    assert free_inside(box((0.0, 0.0, 0.2), (0.2, 0.2, 0.02)), skin, INSET) == (0, 0)
    assert free_share(box((0.0, 0.0, 0.2), (0.2, 0.2, 0.02)), skin, INSET) == 0.0


def test_of_shapes_that_explain_the_points_the_one_that_fills_no_space_seen_free():
    can = cylinder((0.0, 0.0, 0.2), 0.06, 0.12)
    points, normals = surface_points(can, np.random.default_rng(0), eye=(-1.0, 0.3, 0.6), sigma=0.001)
    config = FitConfig(free_weight=1.0)
    ((best, *others),) = candidates(
        [Oriented(points, normals)], config=config, rngs=[np.random.default_rng(0)]
    )
    inside_best_alone = map_with(
        lambda p: (best.shape.signed_distance(p) < 0.0) & (others[0].shape.signed_distance(p) > -0.012)
    )
    assert free_share(best.shape, inside_best_alone, INSET) > free_share(
        others[0].shape, inside_best_alone, INSET
    )
    options = {"config": config, "rng": np.random.default_rng(0)}
    assert fit(points, normals, **options).shape.kind == best.shape.kind
    options = {"config": config, "rng": np.random.default_rng(0), "space": inside_best_alone}
    assert fit(points, normals, **options).shape.kind != best.shape.kind


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_the_choice_weighs_what_is_filled_against_how_well_points_are_explained(weight):
    config = FitConfig(free_weight=weight)
    inset = config.free_inset * VoxelConfig().size
    kinds = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        shape = box((0.0, 0.0, 0.2), rng.uniform(0.06, 0.12, 3), turn_deg=30.0)
        if seed % 2:
            shape = cylinder((0.0, 0.0, 0.2), rng.uniform(0.03, 0.06), rng.uniform(0.06, 0.12))
        points, normals = surface_points(shape, rng, eye=(-1.0, 0.3, 0.6), sigma=0.001)
        direction = rng.normal(size=3)
        space = map_with(lambda p, d=direction: (p - (0.0, 0.0, 0.2)) @ d > 0.01)
        (found,) = candidates([Oriented(points, normals)], config=config, rngs=[np.random.default_rng(0)])
        costs = [f.cost + weight * free_share(f.shape, space, inset) for f in found]
        result = fit(points, normals, config=config, rng=np.random.default_rng(0), space=space)
        assert result.shape.kind == found[int(np.argmin(costs))].shape.kind
        kinds.append(result.shape.kind == found[0].shape.kind)
    assert all(kinds) == (weight == 0.0)
