from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from raycast import TABLE, from_the_side, table_scene
from scipy import ndimage
from scipy.optimize import linear_sum_assignment

from caryatid.config import CloudConfig, Config, FitConfig, SegmentationConfig, SurfaceConfig
from caryatid.errors import PerceptionError
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Cylinder
from caryatid.scene import Scene
from caryatid.segmentation.observation import observe
from caryatid.segmentation.seams import GAP, cut_at_seams, find_seams
from caryatid.segmentation.segments import cut_by_colour, segment, segment_cloud
from caryatid.segmentation.support_plane import find_support_surface
from caryatid.sensing.clouds import oriented_points, thin
from caryatid.sensing.views import Cloud
from caryatid.simulation.camera import SimulatedCamera
from caryatid.simulation.generation import _bowl
from caryatid.simulation.world import Body, build_spec, scene_from_spec

UP = np.array([0.0, 0.0, 1.0])
STACK = [
    (np.array([0.0, -0.1, TABLE + 0.04]), np.array([0.18, 0.2, 0.08])),
    (np.array([-0.02, -0.1, TABLE + 0.12]), np.array([0.08, 0.1, 0.08])),
]
BALL = (np.array([0.05, 0.18, TABLE + 0.06]), 0.06)


def surface_of(view, up=UP, seed=0):
    points, normals, _ = oriented_points(view, CloudConfig())
    points, normals = points[::4], normals[::4]
    return find_support_surface(points, normals, up, SurfaceConfig(), np.random.default_rng(seed))


def parts(view, surface=None, seed=0):
    rng = np.random.default_rng(seed)
    surface = surface or surface_of(view)
    return segment(view, surface, SegmentationConfig(), CloudConfig(), FitConfig(), rng)[0]


def found(labels, truth):
    """True masks paired one-to-one with a part at IoU ≥ 0.5, all true masks, all parts."""
    iou = np.zeros((labels.max(), truth.max()))
    for part in range(1, labels.max() + 1):
        for mask in range(1, truth.max() + 1):
            both = np.sum((labels == part) & (truth == mask))
            iou[part - 1, mask - 1] = both / np.sum((labels == part) | (truth == mask))
    rows, columns = linear_sum_assignment(-iou)
    return int(np.sum(iou[rows, columns] >= 0.5)), int(truth.max()), int(labels.max())


@pytest.mark.parametrize("sigma", [0.0, 0.001])
def test_the_table_is_found_not_the_floor(sigma):
    screen = (np.array([0.27, 0.1, TABLE + 0.15]), np.array([0.03, 0.3, 0.3]))
    behind = surface_of(table_scene(from_the_side(elevation=30.0), [screen, *STACK], sigma=sigma))
    assert abs(behind.point_world[2] - TABLE) < 0.001
    assert behind.over(np.array([[-0.2, -0.3, TABLE], [-0.2, 0.35, TABLE]]), -0.01, 0.01, 0.0).all()
    surface = surface_of(table_scene(from_the_side(distance=1.6), STACK, [BALL], sigma))
    assert abs(surface.point_world[2] - TABLE) < 0.003
    assert np.degrees(transforms.angle_between(surface.normal_world, UP)) < 0.5
    np.testing.assert_allclose(sorted(surface.shape.extents), [0.04, 0.6, 0.9], atol=0.03)


@pytest.mark.parametrize("up", [UP, None])
def test_a_view_without_a_surface_is_a_clear_error(up):
    rng = np.random.default_rng(0)
    points, normals = rng.uniform(-1, 1, size=(3000, 3)), transforms.unit(rng.normal(size=(3000, 3)))
    config = SurfaceConfig(min_points=400)
    with pytest.raises(PerceptionError, match="no support surface"):
        find_support_surface(points, normals, up, config, rng)
    with pytest.raises(PerceptionError, match="no support surface"):
        find_support_surface(np.zeros((0, 3)), np.zeros((0, 3)), up, config, rng)


@pytest.mark.parametrize(("degrees", "found"), [(8.0, True), (12.0, False)])
def test_a_support_surface_leans_by_at_most_ten_degrees(degrees, found):
    R = transforms.rotation_from_vector((np.radians(degrees), 0.0, 0.0))
    grid = np.stack(np.meshgrid(np.arange(-0.3, 0.3, 0.01), np.arange(-0.4, 0.4, 0.01), [0.0]), axis=-1)
    plane = grid.reshape(-1, 3) @ R.T, np.tile(R[:, 2], (grid.size // 3, 1))
    options = UP, SurfaceConfig(), np.random.default_rng(0)
    with nullcontext() if found else pytest.raises(PerceptionError, match="no support surface"):
        np.testing.assert_allclose(find_support_surface(*plane, *options).normal_world, R[:, 2], atol=1e-6)


def test_a_table_without_objects_and_a_view_without_readings_have_no_parts():
    view = table_scene(from_the_side(), sigma=0.0005)
    assert not parts(view).any()
    assert not parts(replace(view, depth=np.zeros_like(view.depth)), surface_of(view)).any()


def test_single_readings_above_the_table_have_no_parts():
    """No plane goes through any of them, so not one sample is left."""
    view = table_scene(from_the_side(), [])
    depth = view.depth.copy()
    for row, column in ((200, 300), (240, 320), (260, 340)):
        depth[row - 4 : row + 5, column - 4 : column + 5] = 0.0
        depth[row, column] = 0.85 * view.depth[row, column]
    assert not parts(replace(view, depth=depth), surface_of(view)).any()


def test_without_a_pose_table_and_parts_are_found_in_the_camera_frame():
    T = from_the_side(distance=1.0)
    view = table_scene(T, STACK, [BALL], sigma=0.001)
    lost = replace(view, T_world_camera=None)
    surface = surface_of(lost, up=None)
    assert np.degrees(transforms.angle_between(transforms.rotate(T, surface.normal_world), UP)) < 0.5
    assert abs(transforms.transform(T, surface.point_world)[2] - TABLE) < 0.003
    assert found(parts(lost.with_pose(np.eye(4)), surface), view.labels) == (3, 3, 3)


def test_a_cloud_comes_apart_like_the_view():
    views = [table_scene(from_the_side(azimuth), STACK, [BALL], sigma=0.001) for azimuth in (0, 120, 240)]
    points, normals, truth = [], [], []
    for view in views:
        p, n, pixels = oriented_points(view, CloudConfig())
        points.append(p)
        normals.append(n)
        truth.append(view.labels.ravel()[pixels])
    index = thin(np.concatenate(points), 0.005)
    cloud = Cloud(np.concatenate(points)[index], np.concatenate(normals)[index])
    labels = segment_cloud(cloud, surface_of(views[0]), SegmentationConfig())
    assert found(labels, np.concatenate(truth)[index]) == (3, 3, 3)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_a_cloud_of_almost_nothing_has_no_parts(count):
    surface = surface_of(table_scene(from_the_side()))
    points = np.tile((0.0, 0.0, 0.8), (count, 1))
    cloud = Cloud(points, np.tile(UP, (count, 1)))
    assert segment_cloud(cloud, surface, SegmentationConfig()).tolist() == [0] * count


@pytest.mark.parametrize("spacing", [0.002, 0.005])
def test_the_area_of_a_segment_does_not_depend_on_the_spacing_of_points(spacing):
    surface = surface_of(table_scene(from_the_side()))
    points, normals = [], []
    for x, side in ((-0.2, 0.06), (0.2, 0.02)):
        steps = np.arange(0.0, side, spacing)
        u, v = (g.ravel() for g in np.meshgrid(steps, steps))
        points.append(np.column_stack([x + u, v, np.full(len(u), 0.8)]))
        normals.append(np.tile(UP, (len(u), 1)))
    cloud = Cloud(np.concatenate(points), np.concatenate(normals))
    labels = segment_cloud(cloud, surface, SegmentationConfig())
    assert set(labels[: len(points[0])]) == {1}
    assert set(labels[len(points[0]) :]) == {0}


def solid(y, z, *extents, x=0.0):
    """A box; z is over the table [m]."""
    return np.array([x, y, TABLE + z]), np.array(extents)


POST, HALF = solid(0.0, 0.13, 0.05, 0.08, 0.26, x=0.15), solid(-0.1, 0.05, 0.06, 0.13, 0.1)
FRONT = from_the_side(0.0, elevation=35.0, distance=1.1)
GRAZING = from_the_side(0.0, elevation=29.0, distance=1.0)


SCENES = {
    "a stack and a ball": (from_the_side(20.0), STACK, [BALL]),
    "a stack and a ball seen sideways": (from_the_side(65.0), STACK, [BALL]),
    "a grazing face": (GRAZING, [solid(0.0, 0.1, 0.2, 0.2, 0.2)]),
    "a box behind a post": (FRONT, [POST, solid(0.0, 0.05, 0.06, 0.3, 0.1)]),
    "boxes with nothing nearer in between": (FRONT, [HALF, solid(0.1, 0.05, 0.06, 0.13, 0.1)]),
    # One box would fill what was seen empty.
    "boxes of other heights behind a post": (FRONT, [POST, HALF, solid(0.1, 0.08, 0.06, 0.13, 0.16)]),
    "boxes of other depths behind a post": (FRONT, [POST, HALF, solid(0.1, 0.05, 0.16, 0.13, 0.1, x=0.05)]),
}


@pytest.mark.parametrize("sigma", [0.0, 0.0015])
@pytest.mark.parametrize("name", SCENES)
def test_each_object_is_one_part(name, sigma):
    view = table_scene(*SCENES[name], sigma=sigma)
    labels, objects = parts(view), view.labels.max()
    assert labels.shape == view.depth.shape
    assert labels.dtype == np.int32
    assert found(labels, view.labels) == (objects, objects, objects)
    assert np.mean(labels[view.labels == 0] > 0) < 0.005


RED, BLUE = np.array([200, 30, 30], np.uint8), np.array([30, 30, 200], np.uint8)
PART = np.zeros((40, 60), dtype=np.int32)
PART[5:35, 5:55] = 1


def halves(slope=0.0, bulge=0.0):
    """An image red left of a line, or of a bulging one, and blue right of it."""
    v, u = np.mgrid[:40, :60].astype(float)
    border = 30.0 + slope * (v - 20.0) + bulge * ((v - 20.0) / 15.0) ** 2
    return np.where((u < border)[..., None], RED, BLUE)


@pytest.mark.parametrize("slope", [0.0, 0.5, -0.7])
def test_plain_halves_with_a_straight_border_are_two_in_any_shade(slope):
    shade = np.linspace(0.6, 1.0, 40)[:, None, None]
    noise = np.random.default_rng(0).normal(scale=2.0, size=(40, 60, 3))
    cut = cut_by_colour(PART, np.clip(halves(slope) * shade + noise, 0, 255).astype(np.uint8), 40)
    assert np.unique(cut).tolist() == [0, 1, 2]
    np.testing.assert_array_equal(cut > 0, PART > 0)
    assert len(np.unique(cut[:, 8])) == len(np.unique(cut[:, 52])) == 2


def test_bent_borders_prints_and_borders_between_parts_cut_nothing():
    printed = halves()
    squares = np.random.default_rng(0).integers(0, 255, size=(8, 12, 3), dtype=np.uint8)
    printed[:, :30] = np.repeat(np.repeat(squares, 5, axis=0), 5, axis=1)[:, :30]
    spotted = np.broadcast_to(RED, (40, 60, 3)).copy()
    spotted[15:25, 20:30] = BLUE
    for image in (halves(bulge=-22.0), printed, spotted):
        np.testing.assert_array_equal(cut_by_colour(PART, image, 40), PART)
    two = PART.copy()
    two[5:35, 30:55] = 2
    np.testing.assert_array_equal(cut_by_colour(two, halves(), 40), two)


def flush_boxes(gap):
    """Two equal grey boxes that stand flush; a share of the border between them is a dark line."""
    boxes = [(np.array([0.0, y, TABLE + 0.05]), np.array([0.12, 0.1, 0.1])) for y in (-0.0505, 0.0505)]
    view = table_scene(from_the_side(elevation=60.0, distance=1.0), boxes, sigma=0.001)
    rgb = np.where(view.labels[..., None] > 0, 150, 200) * np.ones(3)
    first, second = (ndimage.binary_dilation(view.labels == k, iterations=2) for k in (1, 2))
    line = np.argwhere(first & second)
    line = line[: int(gap * len(line))]
    rgb[line[:, 0], line[:, 1]] = 110
    rgb += np.random.default_rng(0).normal(scale=2.0, size=rgb.shape)
    return replace(view, rgb=np.clip(rgb, 0, 255).astype(np.uint8))


@pytest.mark.parametrize(("gap", "number"), [(0.0, 1), (0.5, 1), (1.0, 2)], ids=["none", "half", "whole"])
def test_equal_boxes_are_two_where_a_dark_line_runs_from_edge_to_edge(gap, number):
    view = flush_boxes(gap)
    labels = parts(view)
    assert labels.max() == number
    if number == 2:
        assert found(labels, view.labels) == (2, 2, 2)
    scene = Scene(segmentation="auto")
    scene.update(view)
    assert sum(o.role == "object" for o in scene.graph.objects) == number


def test_a_board_keeps_its_length_beyond_the_edge_of_the_table():
    board = (np.array([-0.1, 0.5, TABLE + 0.03]), np.array([0.1, 0.4, 0.06]))
    view = table_scene(from_the_side(elevation=60.0, distance=1.4), [board, STACK[0]], sigma=0.001)
    for k in (1, 2):
        assert (parts(view)[view.labels == k] > 0).mean() > 0.95


def test_a_seam_is_dark_straight_and_as_long_as_its_border_and_divides_one_face():
    v, u = np.mgrid[:80, :120]
    step = np.where(u < 60, 90, 160)
    bent = np.where(np.abs(u - 60 - 14 * np.sin(v / 12.0)) < 2, 90, 160)
    straight = np.where(np.abs(u - 60 - 0.3 * v) < 2, 90, 160)
    open_end = np.where(v < 59, straight, 160)
    left = (u < 60 + 0.3 * v)[::2, ::2, None]
    one, edge = np.broadcast_to(UP, (40, 60, 3)), np.where(left, UP, UP[[2, 0, 1]])
    neck = PART.copy()
    neck[9:35, 28:36] = 0
    for image, facing, part, number in (
        (straight, one, PART, 2),
        (straight, edge, PART, 1),
        (straight, one, neck, 1),
        (open_end, one, PART, 1),
        (bent, one, PART, 1),
        (step, one, PART, 1),
    ):
        rgb = np.repeat(image[..., None], 3, axis=2).astype(np.uint8)
        seam = find_seams(rgb, (slice(0, 80, 2), slice(0, 120, 2)))
        assert cut_at_seams(part, facing, seam, GAP // 2, 40).max() == number


def open_box(width=0.2, height=0.1, wall=0.01):
    """Four walls on the table."""
    aside, z = (width - wall) / 2.0, TABLE + height / 2.0
    across, along = np.array([wall, width, height]), np.array([width, wall, height])
    return [
        *((np.array([x, 0.0, z]), across) for x in (-aside, aside)),
        *((np.array([0.0, y, z]), along) for y in (-aside, aside)),
    ]


@pytest.mark.parametrize(("elevation", "width"), [(55.0, 0.2), (85.0, 0.3)])
def test_an_open_box_is_one_object_with_its_bottom_and_its_content_is_another(elevation, width):
    """The content's top is 4 cm under the rim, and the bottom lies as low as the table."""
    content = (np.array([0.03, 0.0, TABLE + 0.03]), np.array([0.06, 0.06, 0.06]))
    T = from_the_side(elevation=elevation, distance=1.0)
    view = table_scene(T, [*open_box(width), content], sigma=0.0005)
    points = view.points_camera @ view.T_world_camera[:3, :3].T + view.T_world_camera[:3, 3]
    within = np.abs(points[..., :2]).max(axis=-1) < width / 2.0 - 0.02
    bottom = within & (np.abs(points[..., 2] - TABLE) < 0.002)
    truth = np.where(view.labels == 5, 2, np.minimum(view.labels, 1) | bottom)
    labels = parts(view)
    assert found(labels, truth) == (2, 2, 2)
    box = np.bincount(labels[truth == 1]).argmax()
    assert (labels[bottom] == box).mean() > 0.9


CONTENTS = [
    (np.array([-0.06, 0.05, TABLE + 0.04]), np.array([0.1, 0.08, 0.08])),
    (np.array([0.06, -0.06, TABLE + 0.03]), np.array([0.08, 0.1, 0.06])),
]


@pytest.mark.parametrize(
    ("azimuth", "elevation", "half_table"),
    [(0.0, 60.0, 0.25), (20.0, 60.0, 0.25), (40.0, 60.0, 0.25), (40.0, 85.0, 0.3)],
)
def test_the_walls_of_a_bin_are_no_object(azimuth, elevation, half_table):
    """The table top is the floor of the bin, and at most 5 cm of it lie outside; below is another floor."""
    T = from_the_side(azimuth, elevation, distance=1.0)
    walls = open_box(width=0.5, height=0.18)
    view = table_scene(T, [*CONTENTS, *walls], sigma=0.001, half_table=(half_table, half_table))
    assert found(parts(view), np.where(view.labels > 2, 0, view.labels)) == (2, 2, 2)


@pytest.mark.parametrize("elevation", [20.0, 40.0])
def test_the_wall_behind_a_table_is_neither_an_object_nor_part_of_one(elevation):
    wall = (np.array([-0.31, 0.0, 0.75]), np.array([0.02, 3.0, 1.5]))
    close = (np.array([-0.26, 0.1, TABLE + 0.05]), np.array([0.08, 0.1, 0.1]))
    view = table_scene(from_the_side(0.0, elevation), [*CONTENTS, close, wall], sigma=0.001)
    truth = np.where(view.labels > 3, 0, view.labels)
    labels = parts(view)
    assert found(labels, truth) == (3, 3, 3)
    assert (labels[view.labels == 4] > 0).mean() < 0.002


@pytest.mark.parametrize("tint", [(200, 200, 200), (215, 170, 130)], ids=["plain", "reflecting the table"])
@pytest.mark.parametrize("elevation", [30.0, 40.0])
def test_a_bowl_is_one_object_around_the_can_that_parts_its_inside(elevation, tint):
    bowl = _bowl(np.random.default_rng(0)).moved(transforms.rigid(np.eye(3), (0.0, 0.0, TABLE)))
    can = Cylinder(transforms.rigid(np.eye(3), (0.0, 0.0, TABLE + 0.065)), 0.03, 0.106)
    scene = scene_from_spec(build_spec([Body(bowl), Body(can)], "test"), "test", "test")
    view = SimulatedCamera(scene, "carmine").capture(from_the_side(0.0, elevation, distance=0.9))
    points, normals, pixels = oriented_points(view, CloudConfig())
    outside = np.zeros(view.depth.size, dtype=bool)
    outside[pixels] = np.einsum("ij,ij->i", points[:, :2], normals[:, :2]) > 0.0
    colours = np.where(outside.reshape(view.depth.shape)[..., None], tint, (200, 200, 200))
    rgb = np.where(view.labels[..., None] == 1, colours, view.rgb)
    rgb = rgb + np.random.default_rng(0).normal(scale=2.0, size=rgb.shape)
    labels = parts(replace(view, rgb=np.clip(rgb, 0, 255).astype(np.uint8)))
    assert found(labels, view.labels) == (2, 2, 2)


def test_a_ramp_of_readings_beside_an_edge_is_not_an_object():
    """Ten pixels beside the box mix its top and the table 30 cm below it."""
    tall = (np.array([0.0, 0.0, TABLE + 0.15]), np.array([0.15, 0.2, 0.3]))
    view = table_scene(from_the_side(0.0, elevation=75.0, distance=1.4), [tall], sigma=0.001)
    beyond, (row, column) = ndimage.distance_transform_edt(view.labels == 0, return_indices=True)
    share = np.minimum(beyond / 11.0, 1.0)
    mixed = 1.0 / ((1.0 - share) / view.depth[row, column] + share / view.depth)
    assert found(parts(replace(view, depth=mixed.astype(np.float32))), view.labels) == (1, 1, 1)


def test_a_thing_beside_the_table_is_not_an_object_on_it():
    beside = (np.array([0.38, 0.0, 0.45]), np.array([0.12, 0.3, 0.9]))
    view = table_scene(from_the_side(azimuth=180.0), [*STACK, beside], sigma=0.001)
    assert found(parts(view), np.where(view.labels == 3, 0, view.labels)) == (2, 2, 2)


def test_a_camera_upside_down_finds_the_table():
    T = from_the_side(distance=1.0)
    view = table_scene(T, STACK, sigma=0.001)
    turned = replace(view, depth=view.depth[::-1, ::-1].copy(), labels=None, T_world_camera=None)
    normal = surface_of(turned, up=None).normal_world * (-1.0, -1.0, 1.0)
    assert np.degrees(transforms.angle_between(transforms.rotate(T, normal), UP)) < 0.5


def test_masks_that_are_too_wide_label_nothing_far_behind_their_objects():
    """Three pixels around the tower the masks show the floor, 75 cm below the small table."""
    view = table_scene(from_the_side(elevation=20.0), STACK, half_table=(0.12, 0.25))
    wide = replace(view, labels=ndimage.grey_dilation(view.labels, size=7))
    assert (wide.labels > 0).sum() > 1.05 * (view.labels > 0).sum()
    seen = observe(wide, Config(), segmentation=None, known=None, rng=np.random.default_rng(0))
    shown = seen.cloud.points_world[(seen.labels == 1) | (seen.labels == 2)]
    assert len(shown) > 0.95 * (view.labels > 0).sum()
    assert shown[:, 2].min() > TABLE - 0.05
