"""Sessions: what was added stays, what cannot be used changes nothing."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from conftest import npy, refusal, wall_of
from filelock import FileLock

from caryatid.config import Config
from caryatid.errors import CaryatidError, InputError, PlanningError
from caryatid.exploration import Explorer
from caryatid.geometry import transforms
from caryatid.io.graph_json import graph_text
from caryatid.io.images import png
from caryatid.io.staging import BusyError
from caryatid.robots import HUMANOID, find_robot
from caryatid.scene import Scene
from caryatid.sensing.views import View
from caryatid.sessions import Capture, Session
from caryatid.sessions.carried_camera import CarriedCamera
from caryatid.sessions.messages import CameraRecord
from caryatid.sessions.session import SessionConflictError

LOG = "session.jsonl"


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "session"


@pytest.fixture(scope="module")
def kept_session(tmp_path_factory, views):
    folder = tmp_path_factory.mktemp("sessions") / "session"
    with Session.begin(folder, segmentation="labels", seed=7) as session:
        for view in views[:2]:
            session.add(view)
    return folder


@pytest.fixture
def begun(folder, kept_session):
    """A session of two views, closed."""
    return shutil.copytree(kept_session, folder)


@pytest.fixture(scope="module")
def graph_after(views):
    """The graph a session should have after views given by their numbers."""
    known = {}

    def graph(*numbers):
        if numbers not in known:
            scene = Scene(segmentation="labels", seed=7)
            for number in numbers:
                scene.update(views[number])
            known[numbers] = graph_text(scene.graph)
        return known[numbers]

    return graph


def contents(folder):
    """All files of a session but the lock, which says nothing."""
    paths = sorted(p for p in folder.rglob("*") if p.is_file() and p.suffix != ".lock")
    return {str(p.relative_to(folder)): p.read_bytes() for p in paths}


# What a session does


def test_a_session_keeps_its_options(folder, views):
    config = replace(Config(), report=replace(Config().report, image_width=100))
    Session.begin(folder, config, planner="random", seed=np.int64(3)).close()
    with Session.open(folder) as session, pytest.raises(SessionConflictError, match="the next view is 0"):
        session.add(views[0], number=-1)
    beginning = session.beginning
    assert (beginning.settings, beginning.planner, beginning.seed) == (config, "random", 3)


def test_a_session_keeps_a_view_with_which_an_explorer_updated_a_copy(begun, graph_after, views):
    robot = CarriedCamera(find_robot(HUMANOID))
    explorer = Explorer(robot=robot, segmentation="labels", seed=7)
    with Session.open(begun) as session:
        explorer.scene = robot.scene = session.scene.copy()
        robot.T_world_camera = views[2].pose
        explorer.look(views[2])
        assert session.views == 2
        with pytest.raises(InputError, match="its camera has"):
            session.keep(replace(views[2], K=2.0 * views[2].K), explorer.scene)
        session.keep(views[2], explorer.scene)
        assert explorer.plan().candidates is not None
    with Session.open(begun, read_only=True) as session:
        assert (session.views, graph_text(session.graph)) == (3, graph_after(0, 1, 2))


def test_the_next_view_is_where_the_robot_can_be(begun):
    with Session.open(begun, read_only=True) as session:
        told, now = session.next().to_json(), session.scene.T_world_camera
    robot, T = Config().robot, transforms.as_rigid(told["T_world_camera"])
    assert told["view"] == 2
    assert told["why"]
    assert robot.camera_height[0] <= told["camera_height"] == T[2, 3] <= robot.camera_height[1]
    yaw = told["platform"][2] + told["gaze"]["yaw"]
    assert np.allclose(transforms.unit(T[:2, 2]), (np.cos(yaw), np.sin(yaw)))
    assert robot.pitch[0] <= np.degrees(told["gaze"]["pitch"]) <= robot.pitch[1]
    first, *_, last = told["waypoints"]
    assert {name: told[name] for name in last} == last
    assert np.hypot(*(np.array(first["platform"][:2]) - now[:2, 3])) < 0.15
    # The platform stands beside the table, which reaches 0.4 m along x and 0.5 m along y.
    outside = np.abs(told["platform"][:2]) - (0.4, 0.5)
    assert outside.max() > robot.footprint - robot.cell - 0.02


def test_a_view_to_which_the_robot_cannot_go_is_not_chosen_again(begun):
    refused = []
    with Session.open(begun, read_only=True) as session:
        for _ in range(3):
            answer = json.loads(json.dumps(session.next(refused=refused).to_json()))
            refused.append(answer["T_world_camera"])
    assert len({str(T) for T in refused}) == 3


def test_a_robot_may_say_itself_what_it_reaches(begun):
    centre, lengths = np.array([0.0, 0.0, 0.7]), (1.0, 2.0, 0.5)
    offsets = ((1.0, 0.0, 0.5), (0.0, -0.8, 0.9), (0.0, 0.8, 0.9))
    poses = [transforms.look_at(centre + offset, centre) for offset in offsets]
    with Session.open(begun, read_only=True) as session:
        told = session.next(poses, lengths).to_json()
        assert np.allclose(told["T_world_camera"], poses[told["candidate"]])
        assert told["platform"] is told["gaze"] is None
        assert told["waypoints"] == []
        costs = [session.next([T], [length]).decision.cost for T, length in zip(poses, lengths, strict=True)]
        assert np.allclose(np.array(costs) / costs[0], lengths)
        with pytest.raises(PlanningError, match="no candidate views left"):
            session.next([])
        with refusal("refused", "omit them"):
            session.next(poses, refused=poses[:1])
        for wrong in ([1.0], [1.0, 2.0, -0.5]):
            with pytest.raises(InputError, match="path_length"):
                session.next(poses, wrong)


def test_a_kept_view_that_does_not_fit_later_is_ignored_also_after_opening(folder, views, caplog):
    """The first view is tilted too much to show a table, and the wall is far from it."""
    first, centre = views[0], np.array([0.0, 0.0, 0.75])
    R = transforms.rotation_from_vector((0.0, np.radians(11.0), 0.0))
    tilted = replace(first, T_world_camera=transforms.rigid(R, centre - R @ centre) @ first.pose)
    with Session.begin(folder, segmentation="labels", seed=7) as session:
        for view in (tilted, wall_of(first), views[1], views[2]):
            session.add(view)
        assert (session.views, session.scene.views, len(session.scene.waiting)) == (4, 3, 0)
        poses, graph = session.scene.T_world_cameras, graph_text(session.graph)
    assert caplog.messages
    caplog.clear()
    with Session.open(folder) as session:
        assert caplog.messages == [], "what was logged then is not logged again"
        assert graph_text(session.graph) == graph
        np.testing.assert_array_equal(session.scene.T_world_cameras, poses)


def test_looking_on_stops_when_a_view_changes_nothing(folder, views):
    settings = replace(Config(), active=replace(Config().active, stop="unchanged"))
    with Session.begin(folder, settings, segmentation="labels") as session:
        with pytest.raises(PlanningError, match="no view shows a table top"):
            session.next()
        changed = [session.add(views[0]).changed for _ in range(3)]
        assert (changed[0], changed[-1]) == (True, False)
    with Session.open(folder, read_only=True) as session:
        assert session.next().stop == "the last view did not change the graph"


def test_views_are_counted_since_the_last_report(folder, views):
    settings = replace(Config(), active=replace(Config().active, max_views=1))
    with Session.begin(folder, settings, segmentation="labels") as session:
        session.add(views[0])
        assert session.next().stop == "maximum of 1 views reached"
        session.take("o1")
        assert session.next().stop != "maximum of 1 views reached"


def test_a_report_counts_once_and_only_if_it_can_be(begun):
    with Session.open(begun) as session:
        for _ in range(2):
            session.take("o2", number=0)
        with pytest.raises(SessionConflictError, match="has number 0, but the next report is 1"):
            session.take("o1", number=0)
        before, changes = contents(begun), session.scene.changes
        with pytest.raises(InputError):
            session.take("o1", np.diag([2.0, 1.0, 1.0, 1.0]))
        assert contents(begun) == before
    with Session.open(begun) as session:
        assert (session.reports, session.scene.changes) == (1, changes)


# Disks, deaths, damage


def flip(content):
    """Change one byte in the middle."""
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 0xFF]) + content[middle + 1 :]


def full(*arguments, **named):
    raise OSError(28, "No space left on device")


def test_a_view_that_cannot_be_written_changes_nothing(begun, views, monkeypatch):
    def refuse(graph):
        raise ValueError("a number is NaN")

    before = contents(begun)
    with Session.open(begun) as session:
        for place, fault, error, said in (
            ("caryatid.io.staging.os.fsync", full, InputError, "the disk is full"),
            ("caryatid.sessions.session.graph_text", refuse, ValueError, "NaN"),
        ):
            monkeypatch.setattr(place, fault)
            with pytest.raises(error, match=said):
                session.add(views[2])
            monkeypatch.undo()
            assert session.views == 2
            assert contents(begun) == before
        assert session.add(views[2]).number == 2


def test_what_a_death_left_does_not_count(begun, views, graph_after):
    dead = subprocess.Popen(["true"])
    dead.wait()
    left = begun / f"views/.partial-000002.npz-{dead.pid}-0123abcd"
    left.write_bytes(b"half")
    (begun / "views/000002.npz").write_bytes(b"whole, but not in the log")
    with (begun / LOG).open("a") as log:
        log.write('{"kind": "view", "na')
    with Session.open(begun, read_only=True) as session:
        assert session.views == 2
        assert left.exists()
    with Session.open(begun) as session:
        assert session.views == 2
        assert not left.exists()
        session.add(views[2])
    with Session.open(begun) as session:
        assert graph_text(session.graph) == graph_after(0, 1, 2)


DAMAGE = {
    "flipped": ("views/000000.npz", flip, "has changed since it was written; restore"),
    "gone": ("views/000000.npz", None, "the file is missing; restore"),
    "no JSON": (LOG, lambda c: c.replace(b"\n{", b"\nx", 1), "line 2 is damaged; delete this line and"),
    "another kind": (LOG, lambda c: c.replace(b'"view"', b'"vein"', 1), "line 2: 'kind' is"),
    "another digest": (LOG, lambda c: c.replace(b'digest": "', b'digest": "0', 1), "npz: has changed"),
    "the first line": (LOG, lambda c: b"x" + c, "is not a session"),
}


@pytest.mark.parametrize(("name", "change", "said"), DAMAGE.values(), ids=DAMAGE)
def test_damage_is_named(begun, name, change, said):
    path = begun / name
    if change is None:
        path.unlink()
    else:
        path.write_bytes(change(path.read_bytes()))
    with pytest.raises(InputError, match=said) as caught:
        Session.open(begun)
    assert "views/000000.npz" in str(caught.value) or LOG in str(caught.value)


def test_a_log_that_cannot_be_written_is_as_before(begun, views, monkeypatch):
    """Also if a part of the line is on disk already."""
    before = (begun / LOG).read_bytes()
    with Session.open(begun) as session:
        synced = os.fsync

        def full_log(handle):
            if os.fstat(handle).st_ino == (begun / LOG).stat().st_ino:
                full()
            synced(handle)

        monkeypatch.setattr("os.fsync", full_log)
        for change in (lambda: session.add(views[2]), lambda: session.take("o1"), session.undo):
            with pytest.raises(InputError, match="the disk is full"):
                change()
            assert (begun / LOG).read_bytes() == before
        monkeypatch.undo()
        assert session.add(views[2]).number == 2


# One writer


def test_a_second_writer_is_refused_and_a_reader_is_not(begun, views):
    with Session.open(begun) as session:
        for _ in range(2):
            with pytest.raises(BusyError, match="in use by another process"):
                Session.open(begun)
        with Session.open(begun, read_only=True) as reader:
            assert graph_text(reader.graph) == graph_text(session.graph)
            for change in (reader.undo, lambda: reader.add(views[2])):
                with pytest.raises(InputError, match="read-only"):
                    change()
        session.add(views[2])
    with Session.open(begun) as session:
        assert session.views == 3


def test_a_lock_that_cannot_be_taken_is_an_error(begun):
    (begun / f"{LOG}.lock").unlink(missing_ok=True)
    (begun / f"{LOG}.lock").mkdir()
    with pytest.raises(InputError, match="lock"):
        Session.open(begun)


def test_a_view_whose_answer_was_lost_may_be_sent_again(begun, views):
    with Session.open(begun) as session:
        first = session.add(views[2], number=2)
        again = session.add(views[2], number=2)
        assert (again.number, again.changed, again.graph) == (first.number, first.changed, first.graph)
        for number, view in ((2, views[0]), (0, views[0]), (4, views[0])):
            with pytest.raises(SessionConflictError, match="the next view is 3"):
                session.add(view, number=number)
        assert session.views == 3


# Views that cannot be used


def small(view):
    K = view.K * [[0.5], [0.5], [1.0]]
    return View(view.depth[::2, ::2], K, view.pose, labels=view.labels[::2, ::2])


def with_K(change):
    return lambda v: replace(v, K=change(v.K))


UNUSABLE = {
    "another size": (small, "has 80×60 pixels, .* that of earlier views has 160×120 pixels"),
    "another camera": (with_K(lambda K: K * [[1.2], [1.2], [1.0]]), "that of earlier views has"),
    "no camera": (with_K(lambda K: K * [[1e-9], [1e-9], [1.0]]), "that of earlier views has"),
    "no pose": (lambda v: replace(v, T_world_camera=None), "has no camera pose"),
    "no labels": (lambda v: replace(v, labels=None), "has no labels"),
}


def given(**images):
    """Make a view into one whose images are these files."""

    def change(view):
        usual = {"depth": npy(view.depth), "labels": png(view.labels.astype(np.uint16))}
        return Capture(usual | images, CameraRecord(view.K, view.pose))

    return change


BOMB = png(np.zeros((5000, 5000), np.uint16))
HUGE = npy(np.zeros((1, 1), np.float32)).replace(b"(1, 1), }        ", b"(50000, 50000), }")
BROKEN = {
    "no image": (given(depth=b"hello"), "not an image"),
    "8 bit depth": (given(depth=png(np.full((120, 160), 90, np.uint8))), "not a 16-bit grey PNG"),
    "a pickle": (given(depth=npy(np.array([[{}]]), allow_pickle=True)), "not a valid .npy"),
    "whole numbers for metres": (given(depth=npy(np.ones((120, 160), int))), "floats in metres"),
    "endless depth": (given(depth=npy(np.full((120, 160), np.inf))), "infinite"),
    "labels of another size": (given(labels=png(np.ones((60, 80), np.uint16))), "labels is 80×60, depth is"),
    "labels that are no numbers": (given(labels=npy(np.full((120, 160), 0.5))), "not integers"),
    "rgb of floats": (given(rgb=npy(np.ones((120, 160, 3)))), "uint8"),
    "an image too large to decode": (given(depth=BOMB), "16000000"),
    "an array too large": (given(labels=npy(np.zeros((5000, 5000), np.uint8))), "16000000"),
    "a header of a huge array": (given(depth=HUGE), "not a valid .npy"),
}


def test_views_that_cannot_be_used_change_nothing(begun, views, graph_after):
    with Session.open(begun) as session:
        before, graph = contents(begun), session.graph
        for case, (change, said) in (UNUSABLE | BROKEN).items():
            with pytest.raises(CaryatidError, match=said) as caught:
                session.add(change(views[2]))
            assert "\n" not in str(caught.value), case
            assert session.graph is graph, case
            assert contents(begun) == before, case
        session.add(views[2])
        assert graph_text(session.graph) == graph_after(0, 1, 2)


def test_the_first_view_needs_no_pose(folder, views):
    with Session.begin(folder) as session:
        added = session.add(replace(views[0], T_world_camera=None))
        assert added.graph.supports
        assert added.T_world_camera is not None
        T = added.T_world_camera @ np.linalg.inv(views[0].pose)
        session.add(views[1].with_pose(T @ views[1].pose))
    with Session.open(folder) as session:
        assert session.views == 2
        assert np.allclose(session.next([T @ views[2].pose]).decision.T_world_camera, T @ views[2].pose)


def test_labels_come_with_all_views_or_with_none(folder, views):
    with Session.begin(folder) as session:
        session.add(views[0])
        with pytest.raises(InputError, match="has no labels, unlike earlier views"):
            session.add(replace(views[1], labels=None))
        session.undo()
        session.add(replace(views[0], labels=None))
        with pytest.raises(InputError, match="has labels, unlike earlier views"):
            session.add(views[1])


def test_a_pose_that_is_slightly_off_is_not_a_jump(begun, views):
    turn = transforms.rotation_from_vector((0.0, 0.0, 0.05))
    T = views[2].pose @ transforms.rigid(turn, (0.02, -0.02, 0.03))
    with Session.open(begun) as session:
        assert session.add(views[2].with_pose(T)).number == 2


def test_a_view_comes_back_bit_by_bit(folder, views, monkeypatch, caplog):
    caplog.set_level("CRITICAL", "caryatid")  # pytest's workers cannot send a warning with such a name
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (120, 160, 3), dtype=np.uint8)
    normals = rng.random((120, 160, 3), np.float32)
    view = replace(views[0], rgb=rgb, normals_camera=normals, labels_are="segments", name="first\udcff")
    with Session.begin(folder) as session:
        session.add(view)
    seen, original = [], Scene.update
    monkeypatch.setattr(Scene, "update", lambda scene, view: seen.append(view) or original(scene, view))
    Session.open(folder, read_only=True).close()
    (again,) = seen
    for field in ("depth", "K", "T_world_camera", "rgb", "labels", "normals_camera"):
        assert np.array_equal(getattr(again, field), getattr(view, field))
    assert (again.name, again.labels_are) == ("first?", "segments")


# Folders


def test_a_folder_without_a_session_is_an_error(tmp_path):
    for path in (tmp_path, tmp_path / "nothing"):
        with pytest.raises(InputError, match="not a session; create one"):
            Session.open(path)
    assert list(tmp_path.iterdir()) == []


def test_a_session_is_not_begun_where_something_is(begun, tmp_path):
    before = contents(begun)
    (tmp_path / "thesis.txt").write_text("all")
    for taken in (begun, tmp_path):
        with pytest.raises(SessionConflictError, match="contains a session or other files"):
            Session.begin(taken)
    assert contents(begun) == before
    (tmp_path / "soon").mkdir()
    with FileLock(tmp_path / f"soon/{LOG}.lock"), pytest.raises(BusyError):
        Session.begin(tmp_path / "soon")
    assert not (tmp_path / "soon" / LOG).exists()
    for wrong in ({"planner": "juggler"}, {"seed": -1}, {"segmentation": "magic"}):
        with pytest.raises(InputError):
            Session.begin(tmp_path / "new", **wrong)
        assert not (tmp_path / "new").exists()
    (begun / LOG).unlink()
    with pytest.raises(SessionConflictError):
        Session.begin(begun)


BEGUN_OTHERWISE = {
    "another format": ({"format": "other"}, "wrong format, expected"),
    "another version": ({"version": 3}, "wrong format, expected"),
    "no such segmentation": ({"segmentation": "magic"}, "'segmentation' is"),
    "a seed below 0": ({"seed": -1}, "'seed' is -1"),
    "settings out of range": ({"settings": {"fit": {"hypotheses": 0}}}, "'hypotheses' is 0"),
    "settings that are gone": ({"settings": {"fit": {"glue": 1.0}}}, "glue"),
}


def test_a_session_of_another_release_is_refused_by_its_name(begun):
    path = begun / LOG
    first, *others = path.read_text().splitlines()
    document = json.loads(first)
    for change, said in BEGUN_OTHERWISE.values():
        path.write_text("\n".join([json.dumps(document | {"caryatid": "9.9.9"} | change), *others, ""]))
        with pytest.raises(InputError, match=rf"caryatid 9.9.9, .*{said}") as caught:
            Session.open(begun)
        assert "\n" not in str(caught.value)
    path.rename(begun / "session.json")
    with refusal(begun, "a session of an earlier caryatid", "add its views to a new session"):
        Session.open(begun)
