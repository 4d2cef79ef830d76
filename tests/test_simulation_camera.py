"""The simulated depth camera: what its rays meet, and the noise of a Carmine."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from conftest import SMALL_SENSOR, TWO_ON_A_TABLE

from caryatid.config import NoiseConfig
from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.simulation import SimulatedCamera, load_scene, true_shapes
from caryatid.simulation.camera import add_depth_noise, axial_sigma
from caryatid.simulation.world import SimulatedScene, scene_from_spec

FROM_THE_ROBOT = transforms.look_at((-1.2, 0.1, 1.6), (0.0, 0.0, 0.8))
CONFIG = NoiseConfig()


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
    return add_depth_noise(depth, angles, CONFIG, np.random.default_rng(0))


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


def test_carmine_has_no_normals_a_wrong_pose_after_the_first_and_all_labels(clutter):
    clean = camera(clutter).capture(FROM_THE_ROBOT)
    noisy_camera = camera(clutter, "carmine")
    first, second = noisy_camera.capture(FROM_THE_ROBOT), noisy_camera.capture(FROM_THE_ROBOT)
    assert first.normals_camera is None
    np.testing.assert_array_equal(first.pose, FROM_THE_ROBOT)
    assert not np.allclose(second.pose, FROM_THE_ROBOT)
    np.testing.assert_array_equal(second.labels, clean.labels)
    assert (clean.valid & ~second.valid & (clean.labels > 0)).any()


@pytest.mark.parametrize("z", [0.6, 1.5, 2.5])
def test_axial_noise_has_the_published_size_and_depths_are_quantised(z):
    found = noisy(np.full((200, 200), z))
    step = CONFIG.disparity_step * z * z
    expected = np.hypot(axial_sigma(np.array(z), CONFIG), step / np.sqrt(12.0))
    assert found.std() == pytest.approx(float(expected), rel=0.03)
    levels = 1.0 / (found * CONFIG.disparity_step)
    np.testing.assert_allclose(levels, np.round(levels), atol=1e-6)
    assert axial_sigma(np.array(1.4), CONFIG) == pytest.approx(0.0031)


def test_no_return_at_grazing_angles_edges_and_out_of_range():
    depth, incidence = np.full((20, 40), 1.0), np.zeros((20, 40))
    depth[:, 20:] = 1.5
    incidence[:5] = np.deg2rad(CONFIG.grazing + 1.0)
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
