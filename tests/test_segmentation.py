"""What a scene makes of one view without masks: which readings are the table, which are one object each."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from raycast import TABLE, from_the_side, table_scene
from scipy import ndimage
from scipy.optimize import linear_sum_assignment
from synthetic import TABLE_TOP, model_of, simulated_cloud, simulated_scene, simulated_views

from caryatid.config import CloudConfig, Config
from caryatid.errors import InputError, PerceptionError
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Cylinder
from caryatid.segmentation.observation import level_transform, observe
from caryatid.sensing.clouds import oriented_points
from caryatid.sensing.views import MAX_LABEL, Cloud, View
from caryatid.simulation.camera import SimulatedCamera
from caryatid.simulation.generation import bowl, mug
from caryatid.simulation.world import Body, build_spec, scene_from_spec

UP = np.array([0.0, 0.0, 1.0])


def solid(x, y, z, *extents):
    """A box; z is over the table [m]."""
    return np.array([x, y, TABLE + z]), np.array(extents)


def open_box(width=0.2, height=0.1, wall=0.01):
    """Four walls on the table."""
    aside, z = (width - wall) / 2.0, height / 2.0
    across = [solid(x, 0.0, z, wall, width, height) for x in (-aside, aside)]
    return [*across, *(solid(0.0, y, z, width, wall, height) for y in (-aside, aside))]


STACK = [solid(0.0, -0.1, 0.04, 0.18, 0.2, 0.08), solid(-0.02, -0.1, 0.12, 0.08, 0.1, 0.08)]
BALL = (np.array([0.05, 0.18, TABLE + 0.06]), 0.06)
CONTENTS = [solid(-0.06, 0.05, 0.04, 0.1, 0.08, 0.08), solid(0.06, -0.06, 0.03, 0.08, 0.1, 0.06)]
BIN = [*CONTENTS, *open_box(width=0.5, height=0.18)]
BACK = [*CONTENTS, solid(-0.26, 0.1, 0.05, 0.08, 0.1, 0.1), solid(-0.31, 0.0, 0.0, 0.02, 3.0, 1.5)]
BESIDE = [*STACK, (np.array([0.38, 0.0, 0.45]), np.array([0.12, 0.3, 0.9]))]
POST, HALF = solid(0.15, 0.0, 0.13, 0.05, 0.08, 0.26), solid(0.0, -0.1, 0.05, 0.06, 0.13, 0.1)
FRONT = from_the_side(0.0, elevation=35.0, distance=1.1)


def labels_of(source):
    """Labels that a scene gives to a view or cloud; 0 = no object."""
    labels = model_of([source], segmentation="auto").labels
    return np.where(labels > MAX_LABEL, 0, labels)


def found(labels, truth):
    """True masks paired one-to-one with a part at IoU ≥ 0.5, all true masks, all parts."""
    parts, masks = (np.setdiff1d(image, 0) for image in (labels, truth))
    own, true = labels.ravel() == parts[:, None], truth.ravel() == masks[:, None]
    both = own.astype(np.float32) @ true.T.astype(np.float32)
    iou = both / (own.sum(axis=1)[:, None] + true.sum(axis=1) - both)
    rows, columns = linear_sum_assignment(-iou)
    return int(np.sum(iou[rows, columns] >= 0.5)), len(masks), len(parts)


SCENES = {
    "a stack and a ball": (from_the_side(20.0), STACK, [BALL]),
    "a stack and a ball seen sideways": (from_the_side(65.0), STACK, [BALL]),
    "a grazing face": (from_the_side(0.0, 29.0, 1.0), [solid(0.0, 0.0, 0.1, 0.2, 0.2, 0.2)]),
    "a box behind a post": (FRONT, [POST, solid(0.0, 0.0, 0.05, 0.06, 0.3, 0.1)]),
    "boxes with nothing nearer in between": (FRONT, [HALF, solid(0.0, 0.1, 0.05, 0.06, 0.13, 0.1)]),
    # One box would fill what was seen empty.
    "boxes of other heights behind a post": (FRONT, [POST, HALF, solid(0.0, 0.1, 0.08, 0.06, 0.13, 0.16)]),
    "boxes of other depths behind a post": (FRONT, [POST, HALF, solid(0.05, 0.1, 0.05, 0.16, 0.13, 0.1)]),
    "a board beyond the edge of the table": (
        from_the_side(20.0, 60.0, 1.4),
        [solid(-0.1, 0.5, 0.03, 0.1, 0.4, 0.06), STACK[0]],
    ),
}


@pytest.mark.parametrize("sigma", [0.0, 0.0015])
@pytest.mark.parametrize("name", SCENES)
def test_each_object_is_one_part(name, sigma):
    view = table_scene(*SCENES[name], sigma=sigma)
    labels, objects = labels_of(view), view.labels.max()
    assert (labels.shape, labels.dtype) == (view.depth.shape, np.int32)
    assert found(labels, view.labels) == (objects, objects, objects)
    assert np.mean(labels[view.labels == 0] > 0) < 0.005
    assert min((labels[view.labels == k] > 0).mean() for k in range(1, objects + 1)) > 0.8


@pytest.mark.parametrize(
    ("T", "boxes", "half_table", "objects"),
    [
        # The table top is the floor of the bin, and at most 5 cm of it lie outside; below is another floor.
        *((from_the_side(azimuth, 60.0, 1.0), BIN, (0.25, 0.25), 2) for azimuth in (0.0, 20.0, 40.0)),
        (from_the_side(40.0, 85.0, 1.0), BIN, (0.3, 0.3), 2),
        *((from_the_side(0.0, elevation), BACK, (0.3, 0.45), 3) for elevation in (20.0, 40.0)),
        (from_the_side(180.0), BESIDE, (0.3, 0.45), 2),
        (from_the_side(), [], (0.3, 0.45), 0),
    ],
    ids=["bin 0°", "bin 20°", "bin 40°", "bin from above", "wall 20°", "wall 40°", "beside", "nothing"],
)
def test_walls_and_what_stands_beside_the_table_are_no_objects(T, boxes, half_table, objects):
    view = table_scene(T, boxes, sigma=0.001, half_table=half_table)
    labels = labels_of(view)
    assert found(labels, np.where(view.labels > objects, 0, view.labels)) == (objects,) * 3
    assert boxes is not BACK or (labels[view.labels > objects] > 0).mean() < 0.002


def test_stray_readings_and_ramps_beside_an_edge_are_no_objects():
    """Ten pixels beside the box mix its top and the table 30 cm below it."""
    view = table_scene(from_the_side())
    depth = view.depth.copy()
    for row, column in ((200, 300), (240, 320), (260, 340)):
        depth[row - 4 : row + 5, column - 4 : column + 5] = 0.0
        depth[row, column] = 0.85 * view.depth[row, column]
    assert not labels_of(replace(view, depth=depth)).any()
    view = table_scene(from_the_side(0.0, 75.0, 1.4), [solid(0.0, 0.0, 0.15, 0.15, 0.2, 0.3)], sigma=0.001)
    beyond, (row, column) = ndimage.distance_transform_edt(view.labels == 0, return_indices=True)
    share = np.minimum(beyond / 11.0, 1.0)
    mixed = 1.0 / ((1.0 - share) / view.depth[row, column] + share / view.depth)
    assert found(labels_of(replace(view, depth=mixed.astype(np.float32))), view.labels) == (1, 1, 1)


def test_a_board_over_the_edge_stays_whole_where_a_weight_covers_the_rest():
    """35 cm long, of which 14 cm are over the table; a crate on these leaves little of them to see."""
    view = simulated_views("overhang-4-418", vga=True)[0]
    (board,) = (k for k, body in simulated_scene("overhang-4-418").object_bodies.items() if body == "object0")
    labels = labels_of(view)
    own = view.labels == board
    most = np.bincount(labels[own & (labels > 0)]).argmax()
    assert (labels[own] == most).mean() > 0.8
    assert (view.labels[labels == most] == board).mean() > 0.95


@pytest.mark.parametrize(("elevation", "width"), [(55.0, 0.2), (85.0, 0.3)])
def test_an_open_box_is_one_object_with_its_bottom_and_its_content_is_another(elevation, width):
    """The content's top is 4 cm under the rim, and the bottom lies as low as the table."""
    T = from_the_side(elevation=elevation, distance=1.0)
    view = table_scene(T, [*open_box(width), solid(0.03, 0.0, 0.03, 0.06, 0.06, 0.06)], sigma=0.0005)
    points = transforms.transform(T, view.points_camera)
    within = np.abs(points[..., :2]).max(axis=-1) < width / 2.0 - 0.02
    bottom = within & (np.abs(points[..., 2] - TABLE) < 0.002)
    truth = np.where(view.labels == 5, 2, np.minimum(view.labels, 1) | bottom)
    labels = labels_of(view)
    assert found(labels, truth) == (2, 2, 2)
    assert (labels[bottom] == np.bincount(labels[truth == 1]).argmax()).mean() > 0.9


def with_colours(view, rgb):
    """The view in these colours, with noise."""
    noise = np.random.default_rng(0).normal(scale=2.0, size=(*view.depth.shape, 3))
    return replace(view, rgb=np.clip(rgb + noise, 0, 255).astype(np.uint8))


@pytest.mark.parametrize("tint", [(200, 200, 200), (215, 170, 130)], ids=["plain", "reflecting the table"])
@pytest.mark.parametrize("elevation", [30.0, 40.0])
def test_a_bowl_is_one_object_around_the_can_that_parts_its_inside(elevation, tint):
    dish = bowl(np.random.default_rng(0)).moved(transforms.rigid(np.eye(3), (0.0, 0.0, TABLE)))
    can = Cylinder(transforms.rigid(np.eye(3), (0.0, 0.0, TABLE + 0.065)), 0.03, 0.106)
    scene = scene_from_spec(build_spec([Body(dish), Body(can)], "test"), "test", "test")
    view = SimulatedCamera(scene, "carmine").capture(from_the_side(0.0, elevation, distance=0.9))
    points, normals, pixels = oriented_points(view, CloudConfig())
    outside = np.zeros(view.depth.size, dtype=bool)
    outside[pixels] = np.einsum("ij,ij->i", points[:, :2], normals[:, :2]) > 0.0
    colours = np.where(outside.reshape(view.depth.shape)[..., None], tint, (200, 200, 200))
    view = with_colours(view, np.where(view.labels[..., None] == 1, colours, view.rgb))
    assert found(labels_of(view), view.labels) == (2, 2, 2)


RED, BLUE, GREY = (200, 30, 30), (30, 30, 200), (150, 150, 150)
PRINTS = np.kron(np.random.default_rng(0).integers(0, 255, (32, 43, 3)), np.ones((15, 15, 1)))[:480, :640]


def flush_boxes(left, right, line=0.0):
    """Two boxes side by side, and a dark line along a share of the border between them."""
    boxes = [solid(0.0, y, 0.05, 0.12, 0.1, 0.1) for y in (-0.0505, 0.0505)]
    view = table_scene(from_the_side(elevation=60.0, distance=1.0), boxes, sigma=0.001)
    own = [view.labels == k for k in (1, 2)]
    rgb = np.where(own[0][..., None], left, np.where(own[1][..., None], right, 200.0))
    border = np.argwhere(np.logical_and(*(ndimage.binary_dilation(mask, iterations=2) for mask in own)))
    rgb[tuple(border[: int(line * len(border))].T)] = 110.0
    return with_colours(view, rgb)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_table_past_a_handle_is_not_the_bottom_of_the_mug(seed):
    base = Cylinder(transforms.rigid(np.eye(3), (0.0, 0.0, TABLE + 0.1)), 0.035, 0.2)
    high = mug(np.random.default_rng(seed)).moved(transforms.rigid(np.eye(3), (0.0, 0.0, TABLE + 0.2)))
    scene = scene_from_spec(build_spec([Body(base), Body(high)], "test"), "test", "test")
    view = SimulatedCamera(scene, "carmine").capture(from_the_side(90.0, elevation=40.0, distance=1.0))
    points, _, pixels = oriented_points(view, CloudConfig())
    table = (view.labels.flat[pixels] == 0) & (points[:, 2] < TABLE + 0.01)
    assert not labels_of(view).flat[pixels][table].any()


def test_the_fringe_of_a_surface_has_its_colour_and_not_that_of_the_background():
    view = table_scene(FRONT, [POST], sigma=0.001)
    post = view.labels == 1
    inside = ndimage.binary_erosion(post, np.ones((3, 3)), iterations=2)
    view = with_colours(view, np.where(inside[..., None], BLUE, RED))
    cloud = observe(view, Config(), segmentation="labels", known=(), rng=np.random.default_rng(0)).cloud
    high = cloud.select((cloud.labels == 1) & (cloud.points_world[:, 2] > TABLE + 0.05))
    assert np.count_nonzero(post & ~inside) > 0.1 * np.count_nonzero(post)
    assert (high.rgb[:, 0] > high.rgb[:, 2]).mean() < 0.01


@pytest.mark.parametrize(
    ("left", "right", "line", "number"),
    [
        (GREY, GREY, 0.0, 1),
        (GREY, GREY, 0.5, 1),
        (GREY, GREY, 1.0, 2),
        (RED, BLUE, 0.0, 2),
        (RED, (120, 18, 18), 0.0, 1),
        (PRINTS, PRINTS, 0.0, 1),
    ],
    ids=["alike", "half a line", "a dark line", "two colours", "two shades", "printed"],
)
def test_flush_boxes_are_two_where_their_colours_or_a_dark_line_say_so(left, right, line, number):
    view = flush_boxes(left, right, line)
    scene = model_of([view], segmentation="auto")
    assert sum(o.role == "object" for o in scene.graph.objects) == number
    labels = np.where(scene.labels > MAX_LABEL, 0, scene.labels)
    assert number == 1 or found(labels, view.labels) == (2, 2, 2)


def test_one_side_of_a_seam_may_be_furniture(monkeypatch):
    def find_first(points, index, stands_on, *_):
        return np.arange(len(stands_on)) == 0

    monkeypatch.setattr("caryatid.segmentation.observation.find_furniture", find_first)
    graph = model_of([flush_boxes(GREY, GREY, 1.0)], segmentation="auto").graph
    assert sum(o.role == "object" for o in graph.objects) == 1


@pytest.mark.parametrize("sigma", [0.0, 0.001])
def test_the_table_is_found_not_the_floor(sigma):
    screen = solid(0.27, 0.1, 0.15, 0.03, 0.3, 0.3)
    behind = model_of([table_scene(from_the_side(elevation=30.0), [screen, *STACK], sigma=sigma)]).surface
    assert abs(behind.point_world[2] - TABLE) < 0.001
    assert behind.over(np.array([[-0.2, -0.3, TABLE], [-0.2, 0.35, TABLE]]), -0.01, 0.01, 0.0).all()
    surface = model_of([table_scene(from_the_side(distance=1.6), STACK, [BALL], sigma)]).surface
    assert abs(surface.point_world[2] - TABLE) < 0.003
    assert np.degrees(transforms.angle_between(surface.normal_world, UP)) < 0.5
    np.testing.assert_allclose(sorted(surface.shape.extents), [0.04, 0.6, 0.9], atol=0.03)


def test_the_tops_of_books_in_the_middle_are_not_the_table():
    books = [(np.array([0.0, y, TABLE + 0.02]), np.array([0.3, 0.24, 0.04])) for y in (-0.13, 0.13)]
    scene = model_of([table_scene(from_the_side(distance=0.8), books, sigma=0.0005)], segmentation="auto")
    assert scene.surface.point_world[2] == pytest.approx(TABLE, abs=0.002)
    assert len(scene.graph.objects) == 3


@pytest.mark.parametrize(("degrees", "level"), [(8.0, True), (12.0, False)])
def test_a_support_surface_leans_by_at_most_ten_degrees(degrees, level):
    R = transforms.rotation_from_vector((np.radians(degrees), 0.0, 0.0))
    grid = np.stack(np.meshgrid(np.arange(-0.3, 0.3, 0.01), np.arange(-0.4, 0.4, 0.01), [0.0]), axis=-1)
    plane = Cloud(grid.reshape(-1, 3) @ R.T, np.tile(R[:, 2], (grid.size // 3, 1)))
    with nullcontext() if level else pytest.raises(PerceptionError, match="no support surface"):
        surface = model_of([plane], segmentation="auto").surface
        np.testing.assert_allclose(surface.normal_world, R[:, 2], atol=1e-6)


# Views and clouds of no use

CONFIG = Config()
VIEW = simulated_views("tower")[0]


def observation_of(source, segmentation=None, known=(), config=CONFIG):
    return observe(source, config, segmentation=segmentation, known=known, rng=np.random.default_rng(0))


@pytest.mark.parametrize("source", [VIEW, simulated_cloud("tower")], ids=["view", "cloud"])
def test_labels_that_are_demanded_and_missing_are_an_error(source):
    with pytest.raises(InputError, match="has no labels") as caught:
        observation_of(replace(source, labels=None), "labels")
    assert source.name in str(caught.value)
    assert "auto" in caught.value.remedy


@pytest.mark.parametrize("pose", [VIEW.T_world_camera, None], ids=["posed", "not posed"])
def test_nothing_is_an_error_that_names_it(pose):
    with pytest.raises(PerceptionError, match="frame 7: has no depth readings"):
        observation_of(View(np.zeros((60, 80)), VIEW.K, pose, name="frame 7"))
    nothing = Cloud(np.zeros((0, 3)), np.zeros((0, 3)), name="cloud 7")
    with pytest.raises(PerceptionError, match="cloud 7: has no points"):
        observation_of(nothing)
    rng = np.random.default_rng(0)
    noise = Cloud(rng.normal(size=(500, 3)), transforms.unit(rng.normal(size=(500, 3))), name="noise")
    for cloud in (nothing, noise):
        with pytest.raises(PerceptionError, match=f"{cloud.name}: "):
            level_transform(cloud, CONFIG, rng)


def test_a_cloud_in_its_sensors_frame_is_levelled():
    observation = observation_of(VIEW, "labels")
    T_camera_world = transforms.invert(VIEW.pose)
    world = replace(observation.cloud, labels=VIEW.labels.ravel()[observation.pixels])
    stored = world.moved(T_camera_world)
    level = stored.moved(level_transform(stored, CONFIG, np.random.default_rng(0), use_labels=True))
    above = world.points_world[:, 2] - TABLE_TOP
    np.testing.assert_allclose(level.points_world[:, 2], above, atol=0.003)
    np.testing.assert_allclose(level.normals_world[:, 2], world.normals_world[:, 2], atol=0.005)
    assert level.viewpoint_world[2] == pytest.approx(VIEW.pose[2, 3] - TABLE_TOP, abs=0.003)
    assert np.array_equal(level.labels, stored.labels)
