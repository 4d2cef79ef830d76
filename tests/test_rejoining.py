from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from raycast import TABLE, K, from_the_side, table_scene
from test_segmentation import UP, found, surface_of

from caryatid.config import CloudConfig, FitConfig, SegmentationConfig
from caryatid.geometry import transforms
from caryatid.segmentation.concavity import hollowness
from caryatid.segmentation.occlusion_gaps import hidden_gaps, hidden_gaps_reference
from caryatid.segmentation.segments import segment

POST = (np.array([0.15, 0.0, TABLE + 0.13]), np.array([0.05, 0.08, 0.26]))
LONG = (np.array([0.0, 0.0, TABLE + 0.05]), np.array([0.06, 0.3, 0.1]))
HALVES = [
    (np.array([0.0, -0.1, TABLE + 0.05]), np.array([0.06, 0.13, 0.1])),
    (np.array([0.0, 0.1, TABLE + 0.05]), np.array([0.06, 0.13, 0.1])),
]
FRONT = from_the_side(0.0, elevation=35.0, distance=1.1)


def parts(view, seed=0, rejoined=True):
    rng = np.random.default_rng(seed) if rejoined else None
    return segment(view, surface_of(view), SegmentationConfig(), CloudConfig(), FitConfig(), rng)


def painted(view, *colours):
    """Each labelled object in one colour, the rest white."""
    table = np.array([(255, 255, 255), *colours], dtype=np.uint8)
    return replace(view, rgb=table[view.labels])


def test_a_box_behind_a_post_is_one():
    view = table_scene(FRONT, [POST, LONG], sigma=0.001)
    assert found(parts(view, rejoined=False), view.labels)[2] == 3
    assert found(parts(view), view.labels) == (2, 2, 2)


def test_same_seed_same_parts():
    view = table_scene(FRONT, [POST, LONG], sigma=0.001)
    np.testing.assert_array_equal(parts(view, seed=3), parts(view, seed=3))


@pytest.mark.parametrize("change", [np.array([0.0, 0.0, 0.06]), np.array([0.1, 0.0, 0.0])])
def test_boxes_of_other_sizes_behind_a_post_stay_two(change):
    """One is higher, or comes further forward: one box would fill what was seen empty."""
    centre, extents = HALVES[1]
    view = table_scene(FRONT, [POST, HALVES[0], (centre + change / 2.0, extents + change)], sigma=0.001)
    assert found(parts(view), view.labels) == (3, 3, 3)


def test_equal_boxes_behind_a_post_are_two_where_colours_say_so():
    view = table_scene(FRONT, [POST, *HALVES], sigma=0.001)
    grey, red, blue = (120, 120, 120), (200, 30, 30), (30, 30, 200)
    assert parts(painted(view, grey, red, red)).max() == 2
    assert found(parts(painted(view, grey, red, blue)), view.labels) == (3, 3, 3)
    shaded = painted(view, grey, red, red)
    shaded = replace(shaded, rgb=np.where(view.labels[..., None] == 3, shaded.rgb // 2, shaded.rgb))
    assert parts(shaded).max() == 2
    rng = np.random.default_rng(0)
    printed = rng.integers(0, 255, size=(*view.depth.shape, 3), dtype=np.uint8)
    printed[view.labels == 2, 2] //= 4
    assert parts(replace(view, rgb=printed)).max() == 2


def bowl(T_world_camera, radius=0.09, rim=0.07):
    """A bowl, thin as a shell, upside up on the table: part of a sphere below its rim."""
    view = table_scene(T_world_camera)
    v, u = np.mgrid[0:480, 0:640].astype(np.float64)
    rays = transforms.rotate(
        T_world_camera, np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)
    )
    eye = T_world_camera[:3, 3]
    towards = eye - np.array([0.0, 0.0, TABLE + radius])
    square, half = np.sum(rays**2, axis=-1), rays @ towards
    root = half**2 - square * (towards @ towards - radius**2)
    depth = view.depth.copy()
    with np.errstate(invalid="ignore"):
        for sign in (1.0, -1.0):
            hit = (-half + sign * np.sqrt(root)) / square
            height = eye[2] + hit * rays[..., 2] - TABLE
            depth = np.where((root > 0) & (height < rim) & (hit < depth), hit, depth)
    labels = (np.abs(depth - view.depth) > 1e-4).astype(np.int32)
    inverse = 1.0 / np.where(depth > 0, depth, np.inf) + 0.001 * np.random.default_rng(0).normal(size=u.shape)
    depth = np.where(depth > 0, 1.0 / np.maximum(inverse, 0.1), 0.0)
    return replace(view, depth=depth.astype(np.float32), labels=labels)


def test_the_inside_of_a_bowl_belongs_to_the_bowl():
    view = bowl(from_the_side(distance=0.9))
    assert found(parts(view), view.labels) == (1, 1, 1)


def test_hollowness_knows_inside_from_outside():
    around = np.random.default_rng(0).normal(size=(500, 3)) * (1.0, 1.0, 0.3) + (0.0, 0.0, 2.0)
    outward = transforms.unit(around)
    assert hollowness(np.hstack([0.1 * outward, -outward])) > 0.2
    assert hollowness(np.hstack([0.1 * outward, outward])) < -0.2
    assert abs(hollowness(np.hstack([around * (1.0, 1.0, 0.0), np.tile(UP, (500, 1))]))) < 1e-9


def test_hidden_gaps_are_those_of_the_reference():
    rng = np.random.default_rng(0)
    labels = np.repeat(np.repeat(rng.integers(0, 5, size=(8, 10)), 4, axis=0), 4, axis=1).astype(np.int32)
    inverse = np.repeat(np.repeat(rng.uniform(0.5, 0.6, size=(8, 10)), 4, axis=0), 4, axis=1)
    inverse[rng.random(inverse.shape) < 0.1] = 0.0
    votes = hidden_gaps(labels, inverse, 0.01, 14)
    assert votes[1:, 1:].any()
    np.testing.assert_array_equal(votes, hidden_gaps_reference(labels, inverse, 0.01, 14))
    np.testing.assert_array_equal(votes, votes.T)


def test_a_gap_is_hidden_only_by_what_is_nearer():
    labels = np.repeat([[1, 0, 2]], 10, axis=1).reshape(1, 30).astype(np.int32)
    inverse = np.where(labels > 0, 0.5, 0.6)
    assert hidden_gaps(labels, inverse, 0.01, 20)[1, 2] == 1
    assert hidden_gaps(labels, inverse, 0.01, 5)[1, 2] == 0
    inverse[0, 15] = 0.4
    assert hidden_gaps(labels, inverse, 0.01, 20)[1, 2] == 0
