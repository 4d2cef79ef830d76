"""Scenes and their ground truth, the depth camera, and the body of the humanoid."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import mujoco
import numpy as np
import pytest
import shapely
from conftest import SMALL_SENSOR, TWO_ON_A_TABLE
from synthetic import simulated_scene

from caryatid.config import Config, LiftConfig, NoiseConfig, PhysicsConfig, RobotConfig
from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Shape
from caryatid.geometry.transforms import unit
from caryatid.planning.candidates import Posture
from caryatid.robots import view_sphere_of
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.simulation import (
    SimulatedCamera,
    SimulatedScene,
    generate,
    ground_truth,
    list_scenes,
    load_scene,
    read_truth,
    static_boxes,
    table_centre,
    true_shapes,
)
from caryatid.simulation.camera import add_depth_noise, axial_sigma
from caryatid.simulation.lifting import Lifting
from caryatid.simulation.scenes import DESIGNED, is_builtin
from caryatid.simulation.setup import BODY, HumanoidBody, make_simulation
from caryatid.simulation.world import (
    bounds,
    mean_contact_forces,
    poses_of,
    scene_from_spec,
    state_of,
    surface_of,
)

# Scenes


SHARED = Path(__file__).parents[2] / "shared" / "scenes"
NEEDS_SHARED = pytest.mark.skipif(not SHARED.is_dir(), reason="../shared is absent")

TABLE = '<body name="table"><geom name="top" type="box" size="0.3 0.45 0.02" pos="0 0 0.73"/></body>'
CUBE = '<body name="cube" pos="0 0 0.78"><freejoint/><geom type="box" size="0.03 0.02 0.03"/></body>'
INTENDED = {
    "tower": {("table", 0), (0, 1), (1, 2), (2, 3), ("table", 4)},
    "bridge": {("table", 0), ("table", 1), ("table", 4), (0, 2), (1, 2), (2, 3)},
    "counterweight": {("table", 0), (0, 1), (1, 2), (2, 1, "top-down"), ("table", 3)},
    "leaning_plank": {("table", 0), ("table", 1), (0, 1, "lean"), ("table", 2), (2, 3)},
    "hidden_stack": {("table", 0), ("table", 1), (1, 2), (2, 3), ("table", 4)},
    "shelf": {("table", 0), ("table", 1), (0, 2), (1, 2), ("table", 3), (3, 4), (2, 5), (2, 6)},
    "clutter": {*(("table", k) for k in (0, 3, 4, 5, 7)), (0, 1), (1, 2), (4, 6), (5, 6), (3, 8)},
}


def mjcf(body: str, asset: str = "") -> str:
    floor = '<geom name="floor" type="plane" size="5 5 0.1"/>'
    return f"<mujoco><asset>{asset}</asset><worldbody>{floor}{body}</worldbody></mujoco>"


def scene_of(body: str, asset: str = "") -> SimulatedScene:
    return scene_from_spec(mujoco.MjSpec.from_string(mjcf(body, asset)), "test", "test.xml")


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


# MJCF


def test_what_falls_off_or_does_not_come_to_rest_is_warned_of(tmp_path, caplog):
    beside = '<body name="apple" pos="0.5 0 0.8"><freejoint/><geom type="sphere" size="0.03"/></body>'
    high = mjcf(TABLE + CUBE.replace("0 0 0.78", "0 0 1.3"))
    lying = '<body name="pear" pos="0.5 0 0.03"><freejoint/><geom type="sphere" size="0.03"/></body>'
    load_scene(write(tmp_path / "still.xml", mjcf(TABLE + CUBE + lying)))
    load_scene(write(tmp_path / "high.xml", high), PhysicsConfig(settle_time=6.0))
    assert not caplog.messages
    load_scene(write(tmp_path / "fallen.xml", mjcf(TABLE + CUBE + beside)))
    assert "fallen.xml: apple fell off the table before the first view" in caplog.text
    load_scene(write(tmp_path / "high.xml", high), PhysicsConfig(settle_time=0.3))
    assert "high.xml: the scene still moves" in caplog.text


def test_a_body_welded_to_an_object_belongs_to_it():
    mug = (
        '<body name="mug" pos="0 0 0.8"><freejoint/><geom type="cylinder" size="0.04 0.05"/>'
        '<body name="handle" pos="0.05 0 0"><geom type="box" size="0.02 0.005 0.02"/></body></body>'
    )
    scene = scene_of(TABLE + mug)
    assert list(scene.object_bodies.values()) == ["mug"]
    handle = np.array([[0.065, 0.0, 0.8]])
    (shape,) = true_shapes(scene).values()
    assert shape.kind == "solid"
    assert shape.signed_distance(handle) < 0.0


@pytest.mark.parametrize(
    ("geom", "volume"),
    [
        ('type="box" size="0.05 0.03 0.02"', 8.0 * 0.05 * 0.03 * 0.02),
        ('type="cylinder" size="0.03 0.05"', np.pi * 0.03**2 * 0.1),
        ('type="sphere" size="0.04"', 4.0 / 3.0 * np.pi * 0.04**3),
        ('type="ellipsoid" size="0.05 0.03 0.02"', 4.0 / 3.0 * np.pi * 0.05 * 0.03 * 0.02),
        ('type="capsule" size="0.02 0.04"', np.pi * 0.02**2 * 0.08 + 4.0 / 3.0 * np.pi * 0.02**3),
        ('type="mesh" mesh="wedge"', 0.5 * 0.08 * 0.06 * 0.04),
    ],
)
def test_volumes_of_shapes_in_their_bounds(geom: str, volume: float):
    wedge = '<mesh name="wedge" vertex="0 0 0 0.08 0 0 0 0.06 0 0.08 0.06 0 0 0 0.04 0 0.06 0.04"/>'
    body = f'<body name="thing" pos="0 0 0.79"><freejoint/><geom {geom} euler="10 20 30"/></body>'
    scene = scene_of(TABLE + body, wedge)
    low, high = bounds(scene, 1)
    points = np.random.default_rng(0).uniform(low, high, (40_000, 3))
    distance = true_shapes(scene)[1].signed_distance
    assert (distance(points) < 0.0).mean() * np.prod(high - low) == pytest.approx(volume, rel=0.03)
    assert (distance(points + (high - low) * [1.0, 0.0, 0.0]) > 0.0).all()


# Support surfaces


ROUGH = 'friction="0.5 0.005 0.0001"'
FURNITURE = (
    f'<geom name="wall" type="box" size="0.01 1 1" pos="0.41 0 1" {ROUGH}/>'
    f'<body name="board"><geom type="box" size="0.2 0.3 0.01" pos="0.2 0 0.49" {ROUGH}/>'
    '<geom type="box" size="0.02 0.02 0.24" pos="0.2 0 0.24"/></body>'
)


def cube(name: str, at: str) -> str:
    return f'<body name="{name}" pos="{at}"><freejoint/><geom type="box" size="0.03 0.03 0.03"/></body>'


def test_the_surface_that_most_objects_stand_on_is_the_main_one():
    on_the_board = cube("low", "0.1 0 0.53") + cube("high", "0.1 0 0.59")
    scene = scene_of(FURNITURE + cube("aside", "-1 2 0.03") + on_the_board)
    assert scene.table == "board"
    truth = ground_truth(scene)
    assert truth.vertices == ("board", "floor", "aside", "low", "high")
    assert truth.pairs == {("board", "low"), ("low", "high"), ("floor", "aside")}
    assert surface_of(scene, "board") == pytest.approx((0.5, 0.2, 0.0, 0.2, 0.3))
    assert surface_of(scene, "floor") == pytest.approx((0.0, 0.0, 0.0, 5.0, 5.0))


def test_a_wall_on_which_an_object_leans_is_no_vertex():
    """It slides until friction holds it, on the wall by a sixth of its weight."""
    plank = (
        '<body name="plank" pos="0.27 0 0.64" euler="0 40 0"><freejoint/>'
        f'<geom type="box" size="0.01 0.05 0.16" {ROUGH}/></body>'
    )
    scene = scene_of(FURNITURE + plank)
    wall = -list(scene.surfaces).index("wall")
    assert mean_contact_forces(scene)[wall, 1][2] > 0.5
    assert ground_truth(scene).vertices == ("board", "plank")


@pytest.mark.parametrize("floor", ["", '<geom name="slab" type="box" size="4 4 0.1" pos="0 0 -0.09995"/>'])
def test_the_robot_looks_at_objects_on_the_ground_and_drives_around_them(floor):
    scene = scene_of(floor + cube("one", "1 2 0.031") + cube("other", "1.2 2.1 0.031"))
    centre = table_centre(scene)
    assert centre == pytest.approx((1.1, 2.05, 0.0), abs=1e-3)
    robot = make_simulation(scene, FEW_PIXELS, noise="none", seed=0).robot
    found = robot.candidates(view_sphere_of(robot, ViewSphere.around(centre, FEW_PIXELS.active)))
    assert len(found) > 100
    opposite = found.T_world_camera[np.argmin(found.directions @ unit(robot.T_world_camera[:3, 3] - centre))]
    way = shapely.LineString([p.platform_world[:2] for p in robot.waypoints(opposite)])
    for label in scene.object_bodies:
        (x, y, _), (right, far, _) = bounds(scene, label)
        assert way.distance(shapely.box(x, y, right, far)) >= RobotConfig().footprint


# Built-in and generated scenes


def edges_of(scene: SimulatedScene) -> set[tuple[str, str, str]]:
    return {(e.supporter, e.supported, e.kind) for e in ground_truth(scene).edges}


def named(supporter, supported, kind="bottom-up") -> tuple[str, str, str]:
    return supporter if supporter == "table" else f"object{supporter}", f"object{supported}", kind


def assert_settled(scene: SimulatedScene) -> None:
    """At rest, on the table, and still there a second later."""
    half, height = static_boxes(scene)[0].extents[:2] / 2.0, table_centre(scene)[2]
    assert scene.at_rest
    for label, shape in true_shapes(scene).items():
        assert bounds(scene, label)[0][2] > height - 0.002
        assert (np.abs(shape.T_world_object[:2, 3]) < half).all()
    data = state_of(scene)
    mujoco.mj_step(scene.model, data, nstep=500)
    assert np.abs(data.xpos - scene.data.xpos).max() < 0.01


@pytest.mark.parametrize("name", DESIGNED)
def test_designed_scenes_settle_to_the_intended_graph(name: str):
    scene = load_scene(name)
    assert scene.name == name
    assert_settled(scene)
    assert edges_of(scene) == {named(*edge) for edge in INTENDED[name]}


@pytest.mark.parametrize(("size", "seed"), [(1, 0), (4, 1), (8, 4), (12, 0)])
def test_piles_are_settled_and_of_the_size(size: int, seed: int):
    scene = generate("pile", size, seed)
    assert len(scene.object_bodies) == len(true_shapes(scene)) == size
    assert len(static_boxes(scene)) == 5
    assert_settled(scene)
    assert sum(supporter != "table" for supporter, _, _ in edges_of(scene)) >= size // 3


@pytest.mark.parametrize(("size", "seed"), [(10, 0), (14, 2)])
def test_dense_scenes_have_screens_a_heap_and_walls(size: int, seed: int):
    scene = generate("dense", size, seed)
    shapes = true_shapes(scene).values()
    assert len(shapes) == size
    assert_settled(scene)
    tall = [s for s in shapes if isinstance(s, Box) and s.extents[2] > 0.2 and s.T_world_object[2, 2] > 0.999]
    assert 2 <= len(tall) <= 4
    walls = [wall.T_world_object[:2, 3] for wall in static_boxes(scene)[5:]]
    assert 1 <= len(walls) <= 2
    assert all(x > 0.5 or abs(y) > 0.7 for x, y in walls)


def assert_close(shapes: list[Shape], most: float) -> None:
    """Every shape touches another one, or is at most this far from it [m]."""
    for shape in shapes:
        surface = shape.surface(0.003)[0]
        gaps = [float(other.signed_distance(surface).min()) for other in shapes if other is not shape]
        assert -0.002 < min(gaps) < most


def test_packed_objects_touch_one_another():
    assert_close(list(true_shapes(generate("packed", 6, 3)).values()), 0.004)


@pytest.mark.parametrize("seed", range(3))
def test_blocks_are_equal_boxes_close_to_one_another(seed: int):
    scene = generate("blocks", 6, seed)
    assert_settled(scene)
    shapes = list(true_shapes(scene).values())
    assert all(isinstance(s, Box) and (s.extents == shapes[0].extents).all() for s in shapes)
    assert_close(shapes, 0.016)


@pytest.mark.parametrize("seed", range(4))
def test_boards_over_an_edge_stand_only_with_their_weight(seed: int):
    scene = generate("overhang", 4, seed)
    assert_settled(scene)
    board = int(np.argmax([shape.extents.max() for shape in true_shapes(scene).values()]))
    lifting = Lifting(scene.spec, list(scene.object_bodies.values()))
    assert lifting.lift(poses_of(scene), board + 1, LiftConfig()).disturbed[board]


@pytest.mark.parametrize("name", ["tower", "bridge", "pile-6-2", "dense-10-4"])
def test_a_lift_that_ends_early_disturbs_the_same(name: str):
    scene = load_scene(name)
    lifting = Lifting(scene.spec, list(scene.object_bodies.values()))
    for index in range(len(scene.object_bodies)):
        whole, short = (
            lifting.lift(poses_of(scene), index, LiftConfig(), to_the_end=end).disturbed
            for end in (True, False)
        )
        assert short.any() == whole.any()
        assert not (short & ~whole).any()


@pytest.mark.parametrize("seed", [0, 1, 2, 4, 8, 11, 25])
def test_storeys_carry_objects_on_every_level(seed: int):
    scene = generate("storeys", 6, seed)
    truth = ground_truth(scene)
    assert scene.at_rest
    assert len(scene.object_bodies) == 6
    carrying = {name for name in truth.vertices if name in scene.surfaces}
    furniture = set(scene.surfaces) - {"floor", "uprights", "case", "posts", "bin_walls"}
    assert carrying - {"floor"} == furniture
    assert {edge.supported for edge in truth.edges} == set(scene.object_bodies.values())
    assert all(4.0 * np.prod(surface_of(scene, name)[3:]) >= 0.1 for name in carrying)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pile-6-2", "dense-11-4", "packed-5-1", "storeys-5-1"])
def test_generated_names_repeat_byte_for_byte(name: str):
    a, b = load_scene(name), load_scene(name)
    np.testing.assert_array_equal(a.data.qpos, b.data.qpos)
    assert a.spec.to_xml() == b.spec.to_xml() != load_scene(f"{name}1").spec.to_xml()


@pytest.mark.parametrize("name", ["pile-0-1", "pile-99-1", "dense-3-1", "dense-26-0", "packed-1-0"])
def test_sizes_and_seeds_out_of_range_are_refused(name: str):
    with pytest.raises(InputError, match=r"give \d+ to \d+"):
        load_scene(name)
    with pytest.raises(InputError, match="negative"):
        generate("pile", 3, -1)


def test_built_in_scenes_are_listed_and_no_path_is_one():
    assert list(list_scenes())[: len(DESIGNED)] == list(DESIGNED)
    assert [is_builtin(n) for n in ("clutter", "pile-8-3", "scenes/clutter", "pile-8")] == [True] * 2 + [
        False
    ] * 2


# Ground truth


@NEEDS_SHARED
@pytest.mark.slow
def test_physics_agrees_with_the_given_ground_truth():
    given, found, common = 0, 0, 0
    for path in sorted(SHARED.glob("*/gt.json")):
        scene = load_scene(path.parent)
        reference, computed = read_truth(path), ground_truth(scene)
        assert computed.vertices[0] == scene.table
        assert {*computed.vertices} == {*reference.vertices}
        for name, top in reference.surfaces.items():
            assert surface_of(scene, name) == pytest.approx(top, abs=1e-5)
        given += len(reference.edges)
        found += len(computed.edges)
        common += len({*reference.edges} & {*computed.edges})
    assert given > 100
    assert common >= 0.98 * given
    assert found - common <= 0.02 * given


# Camera


FROM_THE_ROBOT = transforms.look_at((-1.2, 0.1, 1.6), (0.0, 0.0, 0.8))
NOISE = NoiseConfig()


@pytest.fixture(scope="module")
def clutter() -> SimulatedScene:
    return load_scene("clutter")


def camera(scene: SimulatedScene, noise="none", seed: int = 0) -> SimulatedCamera:
    return SimulatedCamera(scene, noise, rng=np.random.default_rng(seed), sensor=SMALL_SENSOR)


def table_scene(extra: str = "") -> SimulatedScene:
    xml = TWO_ON_A_TABLE.replace("</worldbody>", f"{extra}</worldbody>")
    return scene_from_spec(mujoco.MjSpec.from_string(xml), "test", "test.xml")


def noisy(depth, incidence=0.0) -> np.ndarray:
    depth = np.asarray(depth, dtype=float)
    angles = np.broadcast_to(incidence, depth.shape)
    return add_depth_noise(depth, angles, NOISE, np.random.default_rng(0))


def assert_same(one, other) -> None:
    np.testing.assert_array_equal(one.depth, other.depth)
    np.testing.assert_array_equal(one.pose, other.pose)


def test_points_lie_on_the_shapes_their_labels_name(clutter):
    view = camera(clutter).capture(FROM_THE_ROBOT)
    np.testing.assert_array_equal(view.pose, FROM_THE_ROBOT)
    points_world = transforms.transform(view.pose, view.points_camera)
    normals_world = transforms.rotate(view.pose, view.normals_camera.astype(np.float64))
    shapes = {label: s for label, s in true_shapes(clutter).items() if (view.labels == label).any()}
    assert len(shapes) >= 6
    for label, shape in shapes.items():
        mask = view.labels == label
        np.testing.assert_allclose(shape.signed_distance(points_world[mask]), 0.0, atol=1e-5)
        step = shape.signed_distance(points_world[mask] + 0.001 * normals_world[mask])
        assert np.median(step) == pytest.approx(0.001, abs=1e-5)
    assert (np.einsum("hwi,hwi->hw", view.points_camera, view.normals_camera)[view.valid] < 1e-9).all()


def test_group_3_is_not_seen_and_nothing_is_nothing():
    cover = '<geom type="box" size="0.3 0.3 0.3" pos="0 0 1.1" group="{}" contype="0" conaffinity="0"/>'
    T = transforms.look_at((-1.2, 0.0, 1.3), (0.0, 0.0, 0.8))
    hidden, shown, plain = (
        camera(table_scene(extra)).capture(T) for extra in (cover.format(3), cover.format(0), "")
    )
    np.testing.assert_array_equal(hidden.depth, plain.depth)
    assert (shown.depth != plain.depth).any()
    assert not plain.valid[0].any()
    assert (plain.labels[~plain.valid] == 0).all()
    assert (plain.normals_camera[~plain.valid] == 0).all()


@pytest.mark.parametrize("noise", ["none", "carmine"])
def test_captures_depend_on_seed_and_number_alone(clutter, noise):
    elsewhere = transforms.look_at((0.0, 1.2, 1.6), (0.0, 0.0, 0.8))

    def captures(seed: int, *poses) -> list:
        taken = camera(clutter, noise, seed)
        return [taken.capture(T) for T in (*poses, FROM_THE_ROBOT)]

    a, b = captures(1, FROM_THE_ROBOT), captures(1, elsewhere)
    assert_same(a[1], b[1])
    other = captures(2, FROM_THE_ROBOT)
    assert (a[0].depth != a[1].depth).any() == (noise == "carmine")
    assert (a[0].depth != other[0].depth).any() == (noise == "carmine")
    assert np.allclose(a[0].pose, a[1].pose) == (noise == "none")


@pytest.mark.parametrize("z", [0.6, 1.5, 2.5])
def test_axial_noise_has_the_published_size_and_depths_are_quantised(z):
    found = noisy(np.full((200, 200), z))
    step = NOISE.disparity_step * z * z
    expected = np.hypot(axial_sigma(np.array(z), NOISE), step / np.sqrt(12.0))
    assert found.std() == pytest.approx(float(expected), rel=0.03)
    levels = 1.0 / (found * NOISE.disparity_step)
    np.testing.assert_allclose(levels, np.round(levels), atol=1e-6)
    assert axial_sigma(np.array(1.4), NOISE) == pytest.approx(0.0031)


def test_no_return_at_grazing_angles_edges_and_out_of_range():
    depth, incidence = np.full((20, 40), 1.0), np.zeros((20, 40))
    depth[:, 20:] = 1.5
    incidence[:5] = np.deg2rad(NOISE.grazing + 1.0)
    seen = noisy(depth, incidence) > 0.0
    assert not seen[:5].any()
    assert not seen[:, 19:21].any()
    assert seen[5:, :19].all()
    assert seen[5:, 21:].all()
    assert not any(noisy(np.full((20, 20), z)).any() for z in (0.2, 3.2, 0.0))


def test_bad_arguments(clutter):
    with pytest.raises(InputError, match="kinect"):
        camera(clutter, "kinect")
    with pytest.raises(InputError, match="rotation"):
        camera(clutter).capture(np.diag([1.0, 2.0, 1.0, 1.0]))


# Body


FEW_PIXELS = replace(Config(), sensor=SMALL_SENSOR)
SLOW = pytest.mark.slow


def stage(name: str, config: Config = FEW_PIXELS):
    """A simulation, the body of its robot, and the view sphere."""
    scene = simulated_scene(name)
    made = make_simulation(scene, config, noise="none", seed=0)
    body = HumanoidBody(scene, made.robot, config.robot)
    return made, body, ViewSphere.around(table_centre(scene), config.active)


def between(one: Posture, other: Posture):
    """Postures at most 5 mm apart on the straight line between two."""
    length = np.linalg.norm((other.platform_world - one.platform_world)[:2])
    for share in np.linspace(0.0, 1.0, 2 + int(length / 0.005)):
        platform, height = (
            (1.0 - share) * np.asarray(getattr(one, name)) + share * np.asarray(getattr(other, name))
            for name in ("platform_world", "camera_height")
        )
        yield Posture(platform, float(height), 0.0, 0.0)


def clearance(body: HumanoidBody) -> float:
    """How near a body is to anything but the floor [m], negative inside."""
    model, data = body.scene.model, body.scene.data
    mine = np.flatnonzero(model.geom_bodyid == model.body(BODY).id).tolist()
    others = [g for g in range(model.ngeom) if g not in mine and model.geom(g).name != "floor"]
    return min(mujoco.mj_geomDistance(model, data, a, b, 10.0, None) for a in mine for b in others)


@pytest.mark.parametrize(
    "name",
    [*DESIGNED, *(pytest.param(n, marks=SLOW) for n in ("pile-8-3", "dense-12-0", "packed-20-0"))],
)
def test_the_platform_follows_the_waypoints_and_touches_nothing(name):
    made, body, sphere = stage(name)
    rng, nearest, driven = np.random.default_rng(0), np.inf, 0.0
    for _ in range(6):
        candidates = made.robot.candidates(sphere)
        chosen = int(rng.integers(len(candidates)))
        T = candidates.T_world_camera[chosen]
        waypoints = made.robot.waypoints(T)
        legs = np.diff([p.platform_world[:2] for p in waypoints], axis=0)
        for one, other in pairwise(waypoints):
            for posture in between(one, other):
                body.place(posture)
                nearest = min(nearest, clearance(body))
        length = float(np.linalg.norm(legs, axis=1).sum())
        assert length == pytest.approx(candidates.path_length[chosen], abs=1e-9)
        assert made.robot.move_to(T) == pytest.approx(length, abs=1e-9)
        driven += length
    assert nearest > 0.0
    assert driven > 2.0


def test_its_camera_sees_nothing_of_it_from_any_view_of_the_sphere():
    made, _, sphere = stage("clutter")
    candidates = made.robot.candidates(sphere)
    solved = [made.robot.solve(T) for T in candidates.T_world_camera[::40]]
    extremes = [np.argmin([p.head_pitch for p in solved]), np.argmax([abs(p.head_yaw) for p in solved])]
    floating = replace_body(made.camera)
    for index in {*extremes, *range(0, len(solved), 40)}:
        T = candidates.T_world_camera[40 * int(index)]
        with_body, without = made.camera.capture(T), floating.capture(T)
        np.testing.assert_array_equal(with_body.depth, without.depth)
        np.testing.assert_array_equal(with_body.rgb, without.rgb)


def replace_body(camera):
    """The same camera without a body."""
    floating = camera.fork()
    floating._around = None
    return floating


def test_its_camera_sees_the_platform_straight_down():
    """From 1.5 m the top of the platform, 0.3 m high, is 1.2 m deep, that of the mast 0.15 m."""
    config = replace(FEW_PIXELS, robot=RobotConfig(pitch=(-90.0, 20.0)))
    made, _, _ = stage("clutter", config)
    T = transforms.look_at((-1.5, 0.0, 1.5), (-1.499, 0.0, 0.0))
    view, floor = made.camera.capture(T), replace_body(made.camera).capture(T)
    seen = view.depth != floor.depth
    assert 0.1 < seen.mean() < 0.9
    assert np.median(view.depth[seen]) == pytest.approx(1.2, abs=2e-3)
    assert view.depth[seen].min() == pytest.approx(0.15, abs=0.01)
    assert (view.labels[seen] == 0).all()
    unreachable = transforms.look_at((0.0, 0.0, 2.5), (0.001, 0.0, 0.0))
    plain = replace_body(made.camera).capture(unreachable)
    np.testing.assert_array_equal(made.camera.capture(unreachable).depth, plain.depth)
