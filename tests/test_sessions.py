"""Sessions: what was added stays, what cannot be used changes nothing."""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from conftest import npy, run_command

from caryatid.config import Config
from caryatid.errors import CaryatidError, InputError, PlanningError
from caryatid.geometry import transforms
from caryatid.io.graph_json import graph_text
from caryatid.io.images import png
from caryatid.scene import Scene
from caryatid.sensing.views import View
from caryatid.sessions import Capture, Session
from caryatid.sessions.captures import CameraRecord
from caryatid.sessions.session import SessionBusyError, WrongNumberError


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "session"


@pytest.fixture
def begun(folder, views):
    """A session of two views, closed."""
    with Session.begin(folder, segmentation="labels", seed=7) as session:
        for view in views[:2]:
            session.add(view)
    return folder


def graph_after(views, count, **options):
    scene = Scene(**{"segmentation": "labels", "seed": 7} | options)
    for view in views[:count]:
        scene.update(view)
    return graph_text(scene.graph)


def contents(folder):
    """All files of a session but the lock, which says nothing."""
    paths = sorted(p for p in folder.rglob("*") if p.is_file() and p.name != "lock")
    return {str(p.relative_to(folder)): p.read_bytes() for p in paths}


# What a session does


def test_views_one_by_one_give_the_graph_of_all_of_them(folder, views):
    with Session.begin(folder, segmentation="labels", seed=7) as session:
        for number, view in enumerate(views):
            added = session.add(view)
            assert added.number == number
            assert graph_text(added.graph) == graph_text(session.graph) == graph_after(views, number + 1)
        assert session.views == len(views)


def test_a_session_that_is_opened_again_is_the_same(begun, views):
    with Session.open(begun) as session:
        assert session.views == 2
        assert session.beginning.seed == 7
        assert graph_text(session.graph) == graph_after(views, 2)
        session.add(views[2])
        assert graph_text(session.graph) == graph_after(views, 3)


def test_settings_are_kept(folder, views):
    config = replace(Config(), fusion=replace(Config().fusion, method="sg"))
    with Session.begin(folder, config, planner="random"):
        pass
    with Session.open(folder) as session:
        assert session.beginning.settings == config
        assert session.beginning.planner == "random"


def test_the_next_view_is_where_the_robot_can_be(begun):
    with Session.open(begun, read_only=True) as session:
        told = session.next().to_json()
    robot = Config().robot
    assert told["view"] == 2
    transforms.as_rigid(told["T_world_camera"])
    assert robot.camera_height[0] <= told["camera_height"] <= robot.camera_height[1]
    assert told["camera_height"] == told["T_world_camera"][2][3]
    yaw = told["platform"][2] + told["gaze"]["yaw"]
    forward = np.array(told["T_world_camera"])[:2, 2]
    assert np.allclose(forward / np.linalg.norm(forward), (np.cos(yaw), np.sin(yaw)))
    assert robot.pitch[0] <= np.degrees(told["gaze"]["pitch"]) <= robot.pitch[1]
    assert told["why"]
    # The platform stands beside the table, which reaches 0.4 m along x and 0.5 m along y.
    outside = np.abs(told["platform"][:2]) - (0.4, 0.5)
    assert outside.max() > robot.footprint - robot.cell - 0.02


def test_a_robot_may_say_itself_what_it_reaches(begun, views):
    centre = np.array([0.0, 0.0, 0.7])
    poses = [
        transforms.look_at(centre + at, centre) for at in ((1.0, 0.0, 0.5), (0.0, -0.8, 0.9), (0.0, 0.8, 0.9))
    ]
    with Session.open(begun, read_only=True) as session:
        told = session.next(poses, [1.0, 2.0, 0.5]).to_json()
        assert np.allclose(told["T_world_camera"], poses[told["candidate"]])
        assert told["platform"] is None
        assert told["gaze"] is None
        costs = [
            session.next([pose], [way]).decision.cost
            for pose, way in zip(poses, (1.0, 2.0, 0.5), strict=True)
        ]
        assert np.allclose(np.array(costs) / costs[0], (1.0, 2.0, 0.5))
        with pytest.raises(PlanningError, match="no view is left"):
            session.next([])
        with pytest.raises(InputError, match="path_length"):
            session.next(poses, [1.0])


def test_looking_on_stops_when_a_view_changes_nothing(folder, views):
    with Session.begin(folder, segmentation="labels") as session:
        added = [session.add(view).changed for view in (views[0], views[0], views[0])]
        assert added[0]
        assert not added[-1]
        assert session.next().stop == "the last view changed nothing"
    with Session.open(folder, read_only=True) as session:
        assert session.next().stop == "the last view changed nothing"


# Taking back


def test_undo_goes_back_view_by_view(begun, views):
    with Session.open(begun) as session:
        session.add(views[2])
        for left in (2, 1, 0):
            assert session.undo() == left
            assert graph_text(session.graph) == graph_after(views, left)
        with pytest.raises(InputError, match="no views to take back"):
            session.undo()
        for number, view in enumerate(reversed(views)):
            assert session.add(view).number == number
        assert graph_text(session.graph) == graph_after(views[::-1], 3)
    with Session.open(begun) as session:
        assert graph_text(session.graph) == graph_after(views[::-1], 3)


def test_undone_and_added_anew_otherwise_the_old_state_does_not_count(begun, views):
    """A state of other views, or one that undo left behind, is not taken for that of these."""
    with Session.open(begun) as session:
        old = contents(begun)["state/000002.pickle"]
        session.undo()
        session.add(views[2])
    (begun / "state/000002.pickle").write_bytes(old)
    with Session.open(begun) as session:
        assert graph_text(session.graph) == graph_after([views[0], views[2]], 2)


# States that cannot be trusted


def flip(content):
    """Change one byte in the middle."""
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 0xFF]) + content[middle + 1 :]


@pytest.mark.parametrize("damage", [lambda c: b"", lambda c: c[: len(c) // 2], flip])
def test_a_damaged_state_is_made_anew(begun, views, damage):
    for path in (begun / "state").iterdir():
        path.write_bytes(damage(path.read_bytes()))
    with Session.open(begun) as session:
        assert graph_text(session.graph) == graph_after(views, 2)
        session.add(views[2])
        assert graph_text(session.graph) == graph_after(views, 3)


def test_a_state_of_other_code_is_made_anew(begun, views, monkeypatch):
    monkeypatch.setattr("caryatid.sessions.snapshots.fingerprint", lambda: "other")
    updates = []
    original = Scene.update
    monkeypatch.setattr(Scene, "update", lambda scene, view: updates.append(1) or original(scene, view))
    with Session.open(begun) as session:
        assert session.views == len(updates) == 2
    assert graph_text(session.graph) == graph_after(views, 2)


def test_opening_looks_at_no_view_again(begun, monkeypatch):
    monkeypatch.setattr(Scene, "update", lambda scene, view: pytest.fail("a view was looked at again"))
    with Session.open(begun) as session:
        assert session.views == session.scene.views == 2


@pytest.mark.slow
def test_states_do_not_pile_up(folder, views):
    with Session.begin(folder, segmentation="labels") as session:
        for number in range(18):
            session.add(views[number % 3])
    kept = sorted(int(p.stem) for p in (folder / "state").iterdir())
    assert kept == [16, 17, 18]


def full(*arguments, **named):
    raise OSError(28, "No space left on device")


def test_a_disk_that_refuses_states_loses_no_view(begun, views, monkeypatch):
    monkeypatch.setattr("caryatid.sessions.snapshots.write_file", full)
    with Session.open(begun) as session:
        session.add(views[2])
    monkeypatch.undo()
    assert not list((begun / "state").glob(".*"))
    with Session.open(begun) as session:
        assert session.views == 3
        assert graph_text(session.graph) == graph_after(views, 3)


def test_a_disk_that_refuses_a_view_changes_nothing(begun, views, monkeypatch):
    before = contents(begun)
    with Session.open(begun) as session:
        monkeypatch.setattr("caryatid.io.staging.os.fsync", full)
        with pytest.raises(InputError, match="the disk is full"):
            session.add(views[2])
        assert session.views == 2
        monkeypatch.undo()
        assert contents(begun) == before
        assert session.add(views[2]).number == 2


def test_a_view_whose_graph_cannot_be_written_is_not_kept(begun, views, monkeypatch):
    def refuse(graph):
        raise ValueError("a number is NaN")

    before = contents(begun)
    with Session.open(begun) as session:
        monkeypatch.setattr("caryatid.sessions.session.graph_text", refuse)
        with pytest.raises(ValueError, match="NaN"):
            session.add(views[2])
        assert contents(begun) == before
        assert session.views == 2


class Intruder:
    """Touches a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return type(self.path).touch, (self.path,)


def test_a_snapshot_that_came_from_elsewhere_runs_no_code(begun, views, tmp_path, monkeypatch):
    payload = pickle.dumps(Intruder(tmp_path / "touched"))
    monkeypatch.setattr("caryatid.sessions.snapshots.pickle.dumps", lambda *_, **__: payload)
    with Session.open(begun) as session:
        session.add(views[2])
    monkeypatch.undo()
    with Session.open(begun) as session:
        assert graph_text(session.graph) == graph_after(views, 3)
    assert not (tmp_path / "touched").exists()


def test_what_a_death_left_is_cleared(begun, views):
    left = begun / "views/.partial-000002-abc"
    left.mkdir()
    (left / "depth.npy").write_bytes(b"half")
    (begun / "state/.partial-abc.pickle").write_bytes(b"half")
    with Session.open(begun, read_only=True) as session:
        assert session.views == 2
        assert left.exists()
    with Session.open(begun) as session:
        assert session.views == 2
    assert not list(begun.rglob(".*"))


@pytest.mark.parametrize("damage", ["gap", "camera", "depth", "gone"])
def test_a_damaged_view_is_named(begun, damage):
    match damage:
        case "gap":
            (begun / "views/000000").rename(begun / "views/000005")
        case "camera":
            (begun / "views/000001/camera.json").write_text("{")
        case "depth":
            path = begun / "views/000000/depth.npy"
            path.write_bytes(flip(path.read_bytes()))
        case "gone":
            (begun / "views/000000/depth.npy").unlink()
    with pytest.raises(InputError, match=r"000000|000001"):
        Session.open(begun)
    (begun / "lock").unlink()


# One writer


def test_a_second_writer_is_refused_and_a_reader_is_not(begun, views):
    with Session.open(begun) as session:
        for other in (lambda: Session.open(begun), lambda: Session.open(begun)):
            with pytest.raises(SessionBusyError, match="another writer has this session open"):
                other()
        with Session.open(begun, read_only=True) as reader:
            assert graph_text(reader.graph) == graph_text(session.graph)
            for change in (reader.undo, lambda: reader.add(views[2])):
                with pytest.raises(InputError, match="read only"):
                    change()
        session.add(views[2])
    with Session.open(begun) as session:
        assert session.views == 3


@pytest.mark.slow
def test_another_process_is_refused_and_the_lock_of_a_dead_one_is_gone(begun, views):
    code = (
        "import sys; from caryatid.sessions import Session; s = Session.open(sys.argv[1]);"
        "print('open', flush=True); sys.stdin.read()"
    )
    other = subprocess.Popen(
        [sys.executable, "-c", code, str(begun)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        assert other.stdout.readline() == "open\n"
        before = contents(begun)
        with pytest.raises(SessionBusyError):
            Session.open(begun)
        assert run_command("session", "undo", begun) == 1
        assert contents(begun) == before
    finally:
        other.kill()
        other.communicate()
    with Session.open(begun) as session:
        assert session.undo() == 1


def test_a_lock_that_cannot_be_had_is_said(begun, monkeypatch):
    (begun / "lock").unlink()
    (begun / "lock").mkdir()
    with pytest.raises(InputError, match="lock"):
        Session.open(begun)


# Asked twice


def test_a_view_whose_answer_was_lost_may_be_sent_again(begun, views):
    with Session.open(begun) as session:
        first = session.add(views[2], number=2)
        again = session.add(views[2], number=2)
        assert (again.number, again.changed, again.graph) == (first.number, first.changed, first.graph)
        assert session.views == 3
        for number, view in ((2, views[0]), (0, views[0]), (4, views[0])):
            with pytest.raises(WrongNumberError, match="the next one is view 3"):
                session.add(view, number=number)
        assert session.views == 3


# Views that cannot be used


def small(view):
    return View(
        view.depth[::2, ::2],
        view.K * [[0.5], [0.5], [1.0]],
        view.T_world_camera,
        labels=view.labels[::2, ::2],
    )


def posed(change):
    return lambda v: v.with_pose(change(v.pose))


def shifted(x, y, z):
    return posed(lambda T: transforms.rigid(T[:3, :3], T[:3, 3] + (x, y, z)))


UNUSABLE = {
    "another size": (small, "is 80×60, the views so far are 160×120"),
    "another camera": (lambda v: replace(v, K=v.K * [[1.2], [1.2], [1.0]]), "that of the views so far has"),
    "no camera": (lambda v: replace(v, K=v.K * [[1e-9], [1e-9], [1.0]]), "no camera of 160×120 pixels has"),
    "a sheared camera": (
        lambda v: replace(v, K=v.K + [[0, 40, 0], [0, 0, 0], [0, 0, 0]]),
        "no pinhole matrix",
    ),
    "no pose": (lambda v: replace(v, T_world_camera=None), "has no camera pose"),
    "no labels": (lambda v: replace(v, labels=None), "has no labels"),
    "millimetres": (posed(lambda T: transforms.rigid(T[:3, :3], 1e3 * T[:3, 3])), "the camera would be"),
    "far away": (shifted(9.0, 0.0, 0.0), "too far to see it"),
    "astronomical": (shifted(1e9, 0.0, 0.0), "from the world's origin"),
    "below the table": (shifted(0.0, 0.0, -1.2), "below the table top"),
    "the inverse": (posed(transforms.invert), "its pose cannot be right"),
    "0.4 m too high": (shifted(0.0, 0.0, 0.4), "of what it shows is where earlier views saw anything"),
    "looking away": (posed(lambda T: T @ np.diag((-1.0, 1.0, -1.0, 1.0))), "its pose cannot be right"),
    "depth in millimetres": (lambda v: replace(v, depth=1e6 * v.depth), "give depth in metres"),
    "no readings": (lambda v: replace(v, depth=0.0 * v.depth), "its pose cannot be right"),
}


def test_views_that_cannot_be_used_change_nothing(begun, views):
    with Session.open(begun) as session:
        before, graph = contents(begun), session.graph
        for case, (change, said) in UNUSABLE.items():
            with pytest.raises(CaryatidError, match=said) as caught:
                session.add(change(views[2]))
            assert "\n" not in str(caught.value), case
            assert session.graph is graph, case
            assert contents(begun) == before, case
        session.add(views[2])
        assert graph_text(session.graph) == graph_after(views, 3)


def test_labels_come_with_all_views_or_with_none(folder, views):
    with Session.begin(folder) as session:
        session.add(views[0])
        with pytest.raises(InputError, match="has no labels, the views so far have some"):
            session.add(replace(views[1], labels=None))
        session.undo()
        session.add(replace(views[0], labels=None))
        with pytest.raises(InputError, match="has labels, the views so far have none"):
            session.add(views[1])


@pytest.mark.parametrize("degrees", [0.0, 3.0])
def test_a_pose_that_is_a_little_off_is_no_jump(begun, views, degrees):
    turn = transforms.rotation_from_vector(np.radians([0.0, 0.0, degrees]))
    T = views[2].pose @ transforms.rigid(turn, (0.02, -0.02, 0.03))
    with Session.open(begun) as session:
        assert session.add(views[2].with_pose(T)).number == 2


# Files of images


def capture(view, **images):
    depth = npy(view.depth)
    images = {"depth": depth, "labels": png(view.labels.astype(np.uint16))} | images
    return Capture(images, CameraRecord(view.K, view.pose))


BROKEN = {
    "no image": ({"depth": b"hello"}, "is no image"),
    "nothing": ({"depth": b""}, "is no image"),
    "half a PNG": ({"depth": png(np.full((120, 160), 900, np.uint16))[:-60]}, "truncated or broken"),
    "half an array": ({"depth": npy(np.ones((120, 160)))[:-8]}, "truncated"),
    "a longer array": ({"depth": npy(np.ones((120, 160))) + b"more"}, "has more than it says"),
    "8 bit depth": ({"depth": png(np.full((120, 160), 90, np.uint8))}, "not a 16-bit grey PNG"),
    "a pickle": ({"depth": npy(np.array([[{}]]), allow_pickle=True)}, "floats in metres"),
    "whole numbers for metres": ({"depth": npy(np.ones((120, 160), int))}, "floats in metres"),
    "endless depth": ({"depth": npy(np.full((120, 160), np.inf))}, "infinite"),
    "labels of another size": (
        {"labels": png(np.ones((60, 80), np.uint16))},
        "labels is 80×60, depth is 160×120",
    ),
    "labels in colour": ({"labels": png(np.ones((120, 160, 3), np.uint8))}, "not a grey PNG"),
    "labels that are no numbers": ({"labels": npy(np.ones((120, 160)))}, "whole numbers"),
    "rgb of floats": ({"rgb": npy(np.ones((120, 160, 3)))}, "uint8"),
    "a header of a huge array": (
        {"depth": npy(np.ones((2, 2))).replace(b"(2, 2), }  ", b"(2**3, 2), }")},
        "no .npy",
    ),
}


def test_images_that_cannot_be_used_change_nothing(begun, views):
    before = contents(begun)
    with Session.open(begun) as session:
        for case, (images, said) in BROKEN.items():
            with pytest.raises(InputError, match=said):
                session.add(capture(views[2], **images))
            assert contents(begun) == before, case


def test_an_image_that_is_too_large_is_not_decoded(begun, views):
    bomb = png(np.zeros((5000, 5000), np.uint16))
    assert len(bomb) < 100_000
    header = npy(np.zeros((1, 1), np.float32)).replace(b"(1, 1), }        ", b"(50000, 50000), }")
    with Session.open(begun) as session:
        for content in (bomb, header):
            with pytest.raises(InputError, match="16000000"):
                session.add(capture(views[2], depth=content))


def test_a_view_comes_back_bit_by_bit(tmp_path, views):
    view = replace(views[0], rgb=np.random.default_rng(0).integers(0, 256, (120, 160, 3), dtype=np.uint8))
    first = Capture.of(view)
    for name, content in first.files().items():
        (tmp_path / name).write_bytes(content)
    again = Capture.read(tmp_path).decode(Config().session)
    for field in ("depth", "K", "T_world_camera", "rgb", "labels"):
        assert np.array_equal(getattr(again, field), getattr(view, field))
    assert Capture.read(tmp_path).record.digest == first.record.digest


# Folders


def test_a_folder_that_is_no_session_is_said(tmp_path):
    for path in (tmp_path, tmp_path / "nothing"):
        with pytest.raises(InputError, match="holds no session; begin one"):
            Session.open(path)
    assert not (tmp_path / "lock").exists()


def test_a_session_is_not_begun_where_something_is(begun, tmp_path):
    before = contents(begun)
    with pytest.raises(InputError, match="holds a session already"):
        Session.begin(begun)
    assert contents(begun) == before
    (tmp_path / "thesis.txt").write_text("all")
    with pytest.raises(InputError, match="holds other files"):
        Session.begin(tmp_path)
    with pytest.raises(InputError, match="no planner 'juggler'"):
        Session.begin(tmp_path / "new", planner="juggler")
    assert not (tmp_path / "new").exists()


def test_a_session_of_the_first_release_is_read_or_refused_by_its_name(begun, views):
    path = begun / "session.json"
    document = json.loads(path.read_text())
    del document["caryatid"]
    path.write_text(json.dumps(document))
    with Session.open(begun) as session:
        assert graph_text(session.graph) == graph_after(views, 2)
    document["settings"]["fit"]["glue"] = 1.0
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"begun with caryatid 0\.1\.0") as caught:
        Session.open(begun)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("format", "other", "is no 'caryatid/session'"),
        ("version", 2, "of version 1"),
        ("segmentation", "magic", "'segmentation' is"),
        ("seed", -1, "'seed' is -1"),
        ("settings", {"fit": {"hypotheses": 0}}, "caryatid 9.9.9 .*settings.fit: 'hypotheses' is 0"),
    ],
)
def test_a_session_that_was_begun_otherwise_is_said(begun, key, value, said):
    path = begun / "session.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"caryatid": "9.9.9", key: value}))
    with pytest.raises(InputError, match=said):
        Session.open(begun)
