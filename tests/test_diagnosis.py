"""What is said of recordings whose units, camera, axes or poses are not ours, and that following it helps."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from conftest import run_command
from raycast import TABLE, from_the_side, table_scene
from scipy.spatial.transform import Rotation

import caryatid as ct
from caryatid.config.settings import read_settings
from caryatid.config.stages import Config
from caryatid.geometry import transforms
from caryatid.io import write_recording
from caryatid.io.datasets import SAMPLES, open_dataset
from caryatid.segmentation.diagnosis import BODY, GL, Y_UP, diagnose, ray_lengths

K_ROWS = np.array([[2.0], [2.0], [1.0]])


@pytest.fixture(scope="module")
def sound():
    return list(open_dataset(SAMPLES / "sample-recording"))[:5]


def posed(change):
    return lambda view: view.with_pose(change(view.pose))


def deep(change):
    return lambda view: replace(view, depth=change(view).astype(np.float32))


FAULTS = {
    "the distance along the ray": deep(lambda v: v.depth * ray_lengths(v)),
    "inverse depth": deep(lambda v: np.where(v.valid, 1.0 / np.maximum(v.depth, 0.1), 0.0)),
    "K is for a resolution of 640×480, multiply its first two rows by 0.5": lambda v: replace(
        v, K=K_ROWS * v.K
    ),
    "camera axes are OpenGL's .*recording.axes=opengl": posed(lambda T: T @ GL),
    "camera's body .*recording.axes=body": posed(lambda T: T @ BODY.T),
    "is the inverse": posed(transforms.invert),
    "y axis points up.*--level": posed(lambda T: Y_UP.T @ T),
    "as long as depth says, as if in millimetres": posed(
        lambda T: transforms.rigid(T[:3, :3], 1e3 * T[:3, 3])
    ),
    "only the rotation of T_world_camera is inverse": posed(
        lambda T: transforms.rigid(T[:3, :3].T, T[:3, 3])
    ),
    "all views have the same pose": posed(lambda T: from_the_side()),
    r"multiply the focal lengths by 0\.8": lambda v: replace(
        v, K=v.K * [[1.25, 1, 1], [1, 1.25, 1], [1, 1, 1]]
    ),
    "mirrored": lambda v: replace(v, depth=v.depth[:, ::-1].copy(), rgb=None, labels=None),
}


def test_of_a_sound_recording_nothing_is_said(sound):
    found = diagnose(sound, Config())
    assert found.problems == []
    assert [row["view"] for row in found.views] == [view.name for view in sound]
    assert max(row["tilt"] for row in found.views) < 1.0


@pytest.mark.parametrize("said", FAULTS)
def test_a_fault_is_named_with_its_remedy(sound, said):
    problems = diagnose([FAULTS[said](view) for view in sound], Config()).problems
    assert any(re.search(said, problem) for problem in problems), problems


@pytest.mark.parametrize("factor", [0.7, 1.25])
def test_focal_lengths_are_right_once_multiplied(sound, factor):
    spoilt = [replace(view, K=view.K * [[factor, 1, 1], [1, factor, 1], [1, 1, 1]]) for view in sound]
    remedy = re.search(r"multiply the focal lengths by ([\d.]+)", diagnose(spoilt, Config()).problems[0])
    f = float(remedy[1])
    mended = [replace(view, K=view.K * [[f, 1, 1], [1, f, 1], [1, 1, 1]]) for view in spoilt]
    assert diagnose(mended, Config()).problems == []


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_turned_images_are_right_once_their_poses_are_turned(sound, quarters):
    def quarter_turned(view):
        (height, width), (cx, cy), K = view.depth.shape, view.K[:2, 2], view.K.copy()
        K[:2, 2] = ((cy, width - 1 - cx), (width - 1 - cx, height - 1 - cy), (height - 1 - cy, cx))[
            quarters - 1
        ]
        K[[0, 1], [0, 1]] = K[[0, 1], [0, 1]] if quarters % 2 == 0 else K[[1, 0], [1, 0]]
        return replace(view, depth=np.rot90(view.depth, quarters).copy(), rgb=None, labels=None, K=K)

    spoilt = [quarter_turned(view) for view in sound]
    (problem,) = diagnose(spoilt, Config()).problems
    R = eval(problem.partition("T_world_camera @ ")[2], {"np": np})
    assert diagnose([view.with_pose(view.pose @ R) for view in spoilt], Config()).problems == []


def turned(*vector):
    return transforms.rigid(Rotation.from_rotvec(vector, degrees=True).as_matrix(), np.zeros(3))


@pytest.fixture(scope="module")
def wrist():
    """Views from several heights, with a rolled camera."""
    boxes = [((x, y, TABLE + h / 2), (0.08, 0.1, h)) for x, y, h in [(0, 0, 0.2), (0.15, 0.2, 0.1)]]
    turns = zip(
        range(0, 360, 60), [42.0, 65.0, 50.0, 60.0, 45.0, 55.0], [-30, 20, 0, 30, -10, 40], strict=True
    )
    poses = [from_the_side(azimuth, elevation) @ turned(0, 0, roll) for azimuth, elevation, roll in turns]
    return [replace(table_scene(T, boxes, sigma=0.002, half_table=(1.0, 1.0)), labels=None) for T in poses]


@pytest.mark.parametrize("hand_eye", [(5, 0, 0), (0, -3, 4), (27, 4, 91), (-49, -7, -120)])
def test_a_wrong_hand_eye_calibration_is_found_and_can_be_mended(wrist, hand_eye):
    spoilt = [view.with_pose(view.pose @ turned(*hand_eye)) for view in wrist]
    (problem,) = diagnose(spoilt, Config()).problems
    assert f"the same turn of the camera, {np.linalg.norm(hand_eye):.1f}°" in problem
    assert ("forgotten or inverted" in problem) == (np.linalg.norm(hand_eye) > 45.0)
    assert "focal lengths" not in problem
    X = turned(*map(float, re.search(r"from_rotvec\(\[(.*?)\]", problem)[1].split(",")))
    mended = diagnose([view.with_pose(view.pose @ X) for view in spoilt], Config())
    assert mended.problems == mended.doubts == []


def test_views_alike_tell_only_a_part_of_a_turn(sound):
    spoilt = [view.with_pose(view.pose @ turned(0.0, 0.0, 5.0)) for view in sound]
    (problem,) = diagnose(spoilt, Config()).problems
    assert "at least 3.9°" in problem
    assert problem.endswith("calibrate again")


def test_a_slight_tilt_is_a_doubt_about_what_is_turned(wrist):
    found = diagnose([view.with_pose(turned(1.5, 1.5, 0.0) @ view.pose) for view in wrist], Config())
    assert found.problems == []
    assert any(re.search(r"world is tilted by 2\.1° .*--level", doubt) for doubt in found.doubts)
    found = diagnose([view.with_pose(view.pose @ turned(1.5, 0.0, 0.0)) for view in wrist], Config())
    assert found.problems == []
    (doubt,) = found.doubts
    assert "same turn of the camera, 1.5°" in doubt
    assert "focal" not in doubt


@pytest.mark.parametrize("seed", range(5))
def test_poses_wrong_one_by_one_are_no_common_turn(wrist, seed):
    rng = np.random.default_rng(seed)
    spoilt = [view.with_pose(view.pose @ turned(*rng.normal(0.0, 0.5, 3))) for view in wrist]
    found = diagnose(spoilt, Config())
    assert found.problems == []
    assert not any("tables" in doubt for doubt in found.doubts)


def test_a_view_with_a_wrong_pose_is_named(wrist):
    bad = replace(wrist[2].with_pose(wrist[2].pose @ turned(12.0, 0.0, 0.0)), name="bad")
    found = diagnose([*wrist[:2], bad, *wrist[3:]], Config())
    (doubt,) = (doubt for doubt in found.doubts if "single poses" in doubt)
    assert re.search(r": bad by 1[12]\.\d°$", doubt)


def test_a_table_tilted_in_all_views_is_not_passed_over(sound):
    turn = transforms.rigid(transforms.rotation_from_vector(np.array([1.9, 0.0, 0.0])), np.zeros(3))
    assert diagnose([view.with_pose(turn @ view.pose) for view in sound], Config()).problems


def test_the_report_says_what_is_wrong_above_the_pictures(sound, tmp_path, capsys):
    write_recording(tmp_path / "spoilt", [FAULTS["is the inverse"](view) for view in sound])
    assert run_command("check", tmp_path / "spoilt", "--report", tmp_path / "check.html") == 1
    assert capsys.readouterr().out.count("wrong: ") == 1
    page = (tmp_path / "check.html").read_text()
    assert page.index("is the inverse, world to camera") < page.index("<svg")
    assert page.count("<figure") == len(sound) + 2
    assert run_command("check", "sample-cloud") == 1
    assert "run `caryatid extract`" in capsys.readouterr().err


def test_a_wall_larger_than_the_table_is_no_fault():
    behind = (np.array([-0.4, 0.0, TABLE + 0.5]), np.array([0.02, 3.0, 1.5]))
    view = table_scene(from_the_side(0.0, 20.0), [behind])
    found = diagnose([view], Config())
    assert found.views[0]["tilt"] > 80.0
    assert found.problems == []


@pytest.mark.parametrize("factor", [5.0, 0.2, 10.0, 39.37])
def test_units_that_do_not_fit_are_told_as_a_ratio(sound, factor):
    spoilt = [replace(view, depth=np.float32(factor) * view.depth) for view in sound]
    problems = diagnose(spoilt, Config()).problems
    assert any(f"is {1 / factor:.4g} times as long" in p or f", {factor:.4g} times as" in p for p in problems)


def test_what_cannot_be_judged_is_not_called_right(sound):
    moved = [v.with_pose(transforms.rigid(np.eye(3), (n % 2, 0, 0)) @ v.pose) for n, v in enumerate(sound)]
    found = diagnose(moved, Config())
    assert not found.problems
    assert found.doubts[0].startswith("poses, because consecutive views share only")
    noise = np.random.default_rng(0).uniform(0.5, 3.0, sound[0].depth.shape).astype(np.float32)
    found = diagnose([replace(sound[0], depth=noise)], Config())
    assert found.doubts[0].startswith("depth and axes, because most views show no plane")


def test_a_part_of_an_image_is_no_fault(sound):
    K = sound[0].K - [[0.0, 0.0, 100.0], [0.0, 0.0, 70.0], [0.0, 0.0, 0.0]]
    part = replace(sound[0], depth=sound[0].depth[70:, 100:].copy(), K=K, rgb=None, labels=None)
    assert diagnose([part], Config()).problems == []


def test_a_principal_point_outside_the_image_is_said(sound):
    K = sound[0].K.copy()
    K[:2, 2] = -0.5, -0.5
    problems = diagnose([replace(sound[0], K=K)], Config()).problems
    assert "K has its principal point at (-0, -0) in 320×240 pixels; is K for another resolution?" in problems


def test_a_scene_refuses_what_no_pose_can_mend(sound):
    view = deep(lambda v: v.depth * ray_lengths(v))(sound[0])
    with pytest.raises(ct.InputError, match=r"along the ray of each pixel.*recording\.depth=ray"):
        ct.Scene().update(view)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "setting"),
    [
        (posed(lambda T: T @ GL), "recording.axes=opengl"),
        (posed(lambda T: T @ BODY.T), "recording.axes=body"),
        (deep(lambda v: v.depth * ray_lengths(v)), "recording.depth=ray"),
    ],
    ids=["opengl", "body", "ray"],
)
def test_following_what_check_says_gives_the_same_recording(sound, spoil, setting, tmp_path, capsys):
    write_recording(tmp_path / "spoilt", [spoil(view) for view in sound])
    assert run_command("check", tmp_path / "spoilt", "--json") == 1
    document = json.loads(capsys.readouterr().out)
    assert any(f"--set {setting}" in problem for problem in document["problems"])
    assert run_command("check", tmp_path / "spoilt", "--set", setting) == 0
    assert capsys.readouterr().out.endswith("nothing is wrong\n")
    config = read_settings(None, [setting])
    for view, right in zip(open_dataset(tmp_path / "spoilt", config.recording), sound, strict=True):
        assert np.allclose(view.pose, right.pose, atol=1e-6)
        assert np.allclose(view.depth, right.depth, atol=1e-3)


def test_a_tilted_world_is_right_once_levelled(sound, tmp_path, capsys):
    turn = transforms.rigid(transforms.rotation_from_vector(np.array([0.5, 0.0, 0.0])), np.zeros(3))
    write_recording(tmp_path / "tilted", [posed(lambda T: turn @ T)(view) for view in sound])
    assert run_command("check", tmp_path / "tilted") == 1
    assert "--level" in capsys.readouterr().out
    assert run_command("check", tmp_path / "tilted", "--level") == 0
