"""Two labels of one object become one: where a single shape explains both at a lower cost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from synthetic import box, cylinder, surface_points

from caryatid.config import ExplanationConfig, FitConfig, VoxelConfig
from caryatid.objects.description_length import explain, gather
from caryatid.objects.model_merge import united
from caryatid.sensing.views import Cloud
from caryatid.sensing.voxel_map import VoxelMap

COSTS, FIT = ExplanationConfig(), FitConfig()
EYE = (-1.2, -0.6, 1.0)


def cloud_of(shape, eye=EYE, seed=0):
    points, normals = surface_points(shape, np.random.default_rng(seed), eye=eye, spacing=0.006, sigma=0.001)
    return Cloud(points, normals)


def alone_in(evidence, costs=COSTS):
    """The explanation of some points as one object."""
    return explain([evidence], costs, FIT, [np.random.default_rng(0)])[0]


def pair_of(clouds, changed=None, apart=None, voxels=None):
    evidence = {k: gather(c, 0.003, voxels, COSTS) for k, c in clouds.items()}
    alone = {k: alone_in(e) for k, e in evidence.items()}
    everything = set(clouds) if changed is None else changed
    seen = {} if apart is None else apart
    return united(evidence, alone, everything, seen, costs=COSTS, fit_config=FIT, seed=0)


def halves(shape):
    """A box's points left and right of a gap, as something in front leaves them."""
    cloud = cloud_of(shape)
    y = cloud.points_world[:, 1]
    return cloud.select(y < -0.01), cloud.select(y > 0.01)


CRATE = box((0.0, 0.0, 0.05), (0.1, 0.2, 0.1))


def test_what_something_in_front_cut_in_two_is_one_object():
    left, right = halves(CRATE)
    assert pair_of({1: left, 2: right}) in {(1, 2), (2, 1)}


def test_not_where_the_space_between_was_seen_free():
    left = cloud_of(box((0.0, -0.09, 0.05), (0.1, 0.12, 0.1)))
    right = cloud_of(box((0.0, 0.09, 0.05), (0.1, 0.12, 0.1)))
    nothing = VoxelMap.around((0.0, 0.0, 0.0), VoxelConfig())
    index = np.indices(nothing.hits.shape)
    between = np.abs(nothing.centres_world(index.reshape(3, -1).T)[:, 1]) < 0.025
    free = VoxelMap(
        nothing.origin_world,
        nothing.hits,
        between.reshape(nothing.hits.shape).astype(np.uint8),
        VoxelConfig(),
    )
    near = ExplanationConfig(reach=0.1)
    evidence = {k: gather(c, 0.003, free, near) for k, c in {1: left, 2: right}.items()}
    alone = {k: alone_in(e, near) for k, e in evidence.items()}
    assert united(evidence, alone, {1, 2}, {}, costs=near, fit_config=FIT, seed=0) is None


def test_a_few_points_of_an_object_are_given_to_it_whatever_the_labels():
    whole, again = cloud_of(CRATE), cloud_of(CRATE, seed=1)
    few = again.select(again.points_world[:, 1] > 0.05)
    assert pair_of({1: few, 2: whole}) == (2, 1)
    assert pair_of({1: whole, 2: few}) == (1, 2)


def test_neighbours_that_touch_are_two_objects():
    can = cloud_of(cylinder((0.0, 0.0, 0.16), 0.03, 0.12))
    beside = cloud_of(box((0.0, 0.16, 0.03), (0.08, 0.12, 0.06)))
    assert pair_of({1: cloud_of(CRATE), 2: can, 3: beside}) is None


def test_what_did_not_change_is_not_looked_at():
    left, right = halves(CRATE)
    assert pair_of({1: left, 2: right}, changed=set()) is None


def test_two_are_looked_at_again_when_they_have_grown():
    left, right = halves(CRATE)
    apart = {(1, 2): 10 * len(left)}
    assert pair_of({1: left, 2: right}, apart=apart) is None
    assert pair_of({1: left, 2: right}, apart={(1, 2): 10}) is not None


def test_two_that_have_shapes_do_not_become_one_without():
    can = cloud_of(cylinder((0.0, 0.0, 0.16), 0.03, 0.12))
    dear = replace(COSTS, parameter_cost=20.0)
    evidence = {1: gather(cloud_of(CRATE), 0.003, None, dear), 2: gather(can, 0.003, None, dear)}
    alone = {k: alone_in(e, dear) for k, e in evidence.items()}
    assert all(e.shape is not None for e in alone.values())
    assert united(evidence, alone, {1, 2}, {}, costs=dear, fit_config=FIT, seed=0) is None


def bowl(azimuths, seed=0):
    """Outside of a bowl that widens upwards, of the directions [rad] given: none of the shapes."""
    rng = np.random.default_rng(seed)
    azimuth, height = rng.uniform(*azimuths, 2500), rng.uniform(0.0, 0.06, 2500)
    radius = 0.03 + height * (1.0 + 0.5 * np.sin(4.0 * azimuth))
    across = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    normals = np.concatenate([across, np.full((2500, 1), -1.0)], axis=1) / np.sqrt(2.0)
    return Cloud(np.column_stack([radius[:, None] * across, height]), normals)


def test_an_irregular_object_in_two_parts_is_one_where_its_surface_goes_on():
    assert pair_of({1: bowl((-np.pi, 0.3)), 2: bowl((0.3, np.pi))}) is not None


def test_irregular_neighbours_stay_two_where_a_crease_parts_them():
    rng = np.random.default_rng(1)
    xy = rng.uniform(-0.15, 0.15, (6000, 2))
    xy = xy[np.hypot(*xy.T) > 0.035]
    crumpled = np.column_stack([xy, 0.02 * np.sin(70.0 * xy[:, 0]) * np.sin(50.0 * xy[:, 1]) - 0.02])
    paper = Cloud(crumpled, np.tile((0.0, 0.0, 1.0), (len(xy), 1)))
    standing = bowl((-np.pi, np.pi))
    for cloud in (paper, standing):
        assert alone_in(gather(cloud, 0.003, None, COSTS)).shape is None
    assert pair_of({1: standing, 2: paper}) is None
