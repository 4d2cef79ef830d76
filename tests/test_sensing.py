"""Views, masks, normals and the voxel map: what is sensible input, and what is made of it."""

from __future__ import annotations

import numpy as np
import pytest
from raycast import K as RAYCAST_K

from caryatid.config import CloudConfig, MaskConfig, VoxelConfig
from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Sphere
from caryatid.sensing.clouds import average_pixels, estimate_normals, oriented_points
from caryatid.sensing.masks import labels_from_masks
from caryatid.sensing.views import MAX_LABEL, View
from caryatid.sensing.voxel_map import FREE, OCCUPIED, UNKNOWN, VoxelMap

# Views


K = np.array([[500.0, 0.0, 2.0], [0.0, 400.0, 1.0], [0.0, 0.0, 1.0]])
DEPTH = np.linspace(0.5, 1.5, 20).reshape(4, 5)


def image(value: float, *at: int):
    changed = DEPTH.copy()
    changed[at] = value
    return changed


def test_missing_readings_are_zero_whether_given_as_zero_or_nan():
    given = image(np.nan, 0, 1)
    given[2, 3] = 0.0
    view = View(given, K)
    assert view.depth.dtype == np.float32
    assert view.depth[0, 1] == 0.0
    assert view.valid.sum() == 18
    assert np.isnan(given[0, 1]), "the depth handed in must stay as it was"


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"depth": np.ones(5)}, r"shape \(5,\)"),
        ({"depth": np.ones((0, 5))}, r"shape \(0, 5\)"),
        ({"depth": image(np.inf, 1, 1)}, "infinite"),
        ({"depth": image(-0.1, 1, 1)}, "negative"),
        ({"K": np.diag([0.0, 400.0, 1.0])}, "focal lengths 0, 400"),
        ({"K": np.diag([500.0, -1.0, 1.0])}, "focal lengths 500, -1"),
        ({"K": np.full((3, 3), np.nan)}, "finite 3×3"),
        ({"K": np.eye(4)}, "finite 3×3"),
        ({"T_world_camera": 2.0 * np.eye(4)}, "T_world_camera"),
        ({"rgb": np.zeros((5, 4, 3), dtype=np.uint8)}, "rgb is 4×5, depth is 5×4"),
        ({"labels": np.zeros((4, 4), dtype=np.int32)}, "labels is 4×4, depth is 5×4"),
        ({"normals_camera": np.zeros((3, 5, 3))}, "normals_camera is 5×3"),
        ({"labels": np.full((4, 5), -2)}, "labels exceed"),
        ({"labels": np.full((4, 5), MAX_LABEL + 1)}, "labels exceed"),
    ],
)
def test_a_view_that_makes_no_sense_is_refused_by_name_and_reason(fields, reason):
    with pytest.raises(InputError, match=reason) as caught:
        View(**{"depth": DEPTH, "K": K, "name": "frame 3", **fields})
    assert str(caught.value).startswith("frame 3")
    assert caught.value.remedy


def test_the_highest_label_below_the_support_surfaces_is_allowed_and_a_missing_pose_is_asked_for_by_name():
    view = View(DEPTH, K, labels=np.full((4, 5), MAX_LABEL, dtype=np.uint16), name="frame 3")
    assert view.labels.dtype == np.int32
    assert (view.labels == MAX_LABEL).all()
    with pytest.raises(InputError, match="frame 3: has no camera pose"):
        _ = view.pose


# Masks


LEAST = 200 * 640 * 480 // 60**2
"""Minimum of a mask that is 200 pixels in an image of 60 × 60."""


def square(first, last, size=60):
    mask = np.zeros((size, size), dtype=bool)
    mask[first:last, first:last] = True
    return mask


def test_the_smallest_mask_is_on_top_in_whatever_order():
    large, small = square(5, 40), square(10, 30)
    for masks, on_top, below in (([large, small], 2, 1), ([small, large], 1, 2)):
        labels = labels_from_masks(masks)
        assert labels.dtype == np.int32
        assert labels[20, 20] == on_top
        assert labels[6, 6] == below
        assert labels[50, 50] == 0


def test_background_crumbs_and_doubtful_masks_are_left_out():
    masks = [square(0, 60), square(0, 5), square(5, 30), square(32, 55)]
    labels = labels_from_masks(masks, [0.9, 0.9, 0.9, 0.3], MaskConfig(LEAST, min_score=0.5))
    assert np.unique(labels).tolist() == [0, 3]


def test_what_is_nearly_the_same_nearly_covered_too_small_or_nothing_is_left_out():
    masks = [square(5, 30), square(5, 31)]
    assert np.unique(labels_from_masks(masks, [0.7, 0.9])).tolist() == [0, 2]
    assert np.unique(labels_from_masks(masks)).tolist() == [0, 1]
    cover = square(5, 30)
    low, high = cover.copy(), cover.copy()
    low[:18], high[17:] = False, False
    labels = labels_from_masks([cover, low, high], config=MaskConfig(LEAST))
    assert np.unique(labels).tolist() == [0, 2, 3]
    for size, kept in ((60, True), (600, False)):
        mask = np.zeros((1, size, size), dtype=bool)
        mask[:, :10, :10] = True
        assert labels_from_masks(mask).any() == kept
    assert not labels_from_masks(np.zeros((0, 60, 60), dtype=bool)).any()


def test_of_overlapping_scores_the_largest_is_on_top():
    """Columns 22 to 27 are in both, where the second is surer; a pixel below one half is in neither."""
    scores = np.zeros((2, 60, 60))
    scores[0, :, 5:28], scores[1, :, 22:45], scores[1, :, 45:] = 0.7, 0.8, 0.4
    labels = labels_from_masks(scores)
    assert labels[30, [4, 5, 21, 22, 44, 45]].tolist() == [0, 1, 1, 2, 2, 0]
    view = View(np.ones((60, 60)), np.array([[60.0, 0, 30], [0, 60, 30], [0, 0, 1]]), labels=scores)
    np.testing.assert_array_equal(view.labels, labels)
    assert view.labels_are == "segments"


@pytest.mark.parametrize(
    ("masks", "scores", "what"),
    [
        ([], None, "shape"),
        (square(5, 30), None, "shape"),
        ([square(5, 30), square(5, 30, size=50)], None, "size"),
        ([square(5, 30) * 7], None, "threshold"),
        ([square(5, 30)], [0.5, 0.6], "scores"),
        ([square(5, 30)], [np.nan], "scores"),
    ],
)
def test_bad_masks_are_errors_that_say_so(masks, scores, what):
    with pytest.raises(InputError, match=what):
        labels_from_masks(masks, scores)


# Normals


CLOUDS = CloudConfig()


def test_averaged_pixels_stay_on_their_surface_and_do_not_mix_both_sides_of_an_edge():
    u, v = np.meshgrid(np.arange(65), np.arange(50))
    inverse = 1.0 + 0.002 * (u - 32) + 0.001 * (v - 25)
    depth = np.where(u < 31, 1.0 / inverse, 2.0 / inverse)
    view = View(depth, np.array([[100.0, 0.0, 32.0], [0.0, 100.0, 25.0], [0.0, 0.0, 1.0]]))
    few = average_pixels(view, 3, CloudConfig())
    assert few.depth.shape == (17, 22)
    # Each side is a plane n·p = d, which no pixel leaves.
    for whole, reduced in ((view.points_camera[:, :30], few.points_camera[:, :10]),
                           (view.points_camera[:, 31:], few.points_camera[:, 11:-1])):  # fmt: skip
        plane = np.linalg.lstsq(whole.reshape(-1, 3), np.ones(whole[..., 0].size))[0]
        assert np.abs(reduced[:-1].reshape(-1, 3) @ plane - 1.0).max() < 1e-3
    edge = few.depth[:-1, 10] * (1.0 + 0.002 * (31 - 32) + 0.001 * (3.0 * np.arange(16) + 1.0 - 25))
    assert (np.minimum(np.abs(edge - 1.0), np.abs(edge - 2.0)) < 0.01).all()


def test_normals_do_not_smooth_over_depth_edges_and_need_readings():
    depth = np.full((60, 80), 1.0, dtype=np.float32)
    depth[:, 40:], depth[:20], depth[10, 10], depth[:5] = 1.1, 0.0, 1.0, 5.0
    _, normals, pixels = oriented_points(View(depth=depth, K=RAYCAST_K), CLOUDS)
    assert pixels.min() >= 20 * 80
    beside = np.isin(pixels % 80, range(38, 42))
    assert beside.sum() == 4 * 40
    np.testing.assert_allclose(normals[beside], np.broadcast_to((0.0, 0.0, -1.0), (160, 3)), atol=1e-3)


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_normals_of_degenerate_clouds_face_the_viewpoint(count):
    points = np.outer(np.arange(count), (0.01, 0.0, 0.0))
    normals = estimate_normals(points, np.array([0.0, 0.0, 1.0]), 8)
    assert normals.shape == (count, 3)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1.0)
    assert (normals[:, 2] > 0.9).all()


# Voxels


WALL_K = np.array([[100.0, 0.0, 79.5], [0.0, 100.0, 59.5], [0.0, 0.0, 1.0]])
VOXELS = VoxelConfig(size=0.02, extent=(0.8, 0.8, 0.6), below=0.2, stride=1, margin=0.02)


def wall_view(distance: float = 1.0, noise: np.ndarray | float = 0.0) -> View:
    """A camera 1 m from the origin on the -x side that sees a plane across its axis."""
    T_world_camera = transforms.look_at((-1.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    depth = (np.full((120, 160), distance) + noise).astype(np.float32)
    return View(depth, WALL_K, T_world_camera)


def test_a_view_clears_its_rays_and_fills_their_ends():
    before = VoxelMap.around((0.0, 0.0, 0.0), VOXELS)
    voxels = before.integrate(wall_view(), 3.0)
    points = np.array([[-0.2, 0.01, 0.01], [0.005, 0.01, 0.01], [0.1, 0.01, 0.01], [5.0, 0.0, 0.0]])
    assert voxels.state_at(points).tolist() == [FREE, OCCUPIED, UNKNOWN, UNKNOWN]
    assert (before.states == UNKNOWN).all(), "the map that was given has changed"


def test_readings_beyond_the_range_are_free_space_up_to_it_and_none_say_nothing():
    empty = VoxelMap.around((0.0, 0.0, 0.0), VOXELS)
    voxels = empty.integrate(wall_view(distance=1.3), 1.1)
    assert voxels.state_at(np.array([[0.05, 0.01, 0.01], [0.15, 0.01, 0.01]])).tolist() == [FREE, UNKNOWN]
    assert not (voxels.states == OCCUPIED).any()
    assert (empty.integrate(wall_view(distance=0.0), 3.0).states == UNKNOWN).all()


def test_a_stray_reading_is_gone_after_three_views_through_it():
    voxels = VoxelMap.around((0.0, 0.0, 0.0), VOXELS).integrate(wall_view(0.8), 3.0)
    point = np.array([[-0.195, 0.01, 0.01]])
    states = []
    for _ in range(4):
        states.append(int(voxels.state_at(point)[0]))
        voxels = voxels.integrate(wall_view(1.0), 3.0)
    assert states[:2] == [OCCUPIED, OCCUPIED]
    assert states[3] == FREE


def test_evidence_does_not_overflow():
    empty = VoxelMap.around((0.0, 0.0, 0.0), VOXELS)
    full = np.full_like(empty.hits, 255)
    voxels = VoxelMap(empty.origin_world, full, full, VOXELS).integrate(wall_view(), 3.0)
    assert voxels.hits.min() == voxels.passes.min() == 255


def test_lines_of_sight_stop_at_what_is_solid_and_leave_the_clearance_out():
    box = Box(transforms.rigid(np.eye(3), (0.0, 0.0, 0.0)), np.array([0.1, 0.1, 0.1]))
    occluders = VoxelMap.around((0.0, 0.0, 0.0), VOXELS).occluders([box])
    points = np.array([[-0.2, 0.0, 0.0], [0.0, 0.0, 0.0]])
    targets = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [-0.2, 0.0, 1.0]])
    assert occluders.blocked(points, targets, 0.0).tolist() == [[True, False, False], [True, True, True]]
    assert occluders.blocked(points, targets, 0.12).tolist() == [[True, False, False], [False, False, False]]


def test_shapes_are_solid_inside_and_only_there():
    ball = Sphere(transforms.rigid(np.eye(3), (0.38, 0.0, 0.1)), 0.1)
    voxels = VoxelMap.around((0.0, 0.0, 0.0), VOXELS)
    occluders = voxels.occluders([ball])
    centres = voxels.centres_world(np.argwhere(voxels.states == UNKNOWN))
    inside = occluders.holds(centres)
    assert inside.sum() > 100
    np.testing.assert_array_equal(inside, ball.signed_distance(centres) < 0.0)
    outside = Sphere(transforms.rigid(np.eye(3), (3.0, 0.0, 0.1)), 0.1)
    assert not VoxelMap.around((0.0, 0.0, 0.0), VOXELS).occluders([outside]).grid.any()
