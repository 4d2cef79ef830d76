"""Front ends do alike: the same views give the same graph, and what cannot be used changes nothing."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from conftest import npy, run_command, wall_of
from test_ros import camera_info, image, make, packed, transform_message
from test_service import body, serving
from test_sessions import contents

from caryatid.config import Config
from caryatid.errors import CaryatidError, in_one_line
from caryatid.exploration import next_best_view
from caryatid.geometry import transforms
from caryatid.io.graph_json import graph_text
from caryatid.scene import Scene
from caryatid.sessions import Session
from caryatid.simulation.scenes import load_scene
from caryatid.simulation.setup import make_simulation
from caryatid.sources import Source
from caryatid.viewer.loop import LoopPage
from caryatid_ros.exploration import Exploration
from caryatid_ros.messages import matrix_of
from caryatid_ros.parameters import Settings

NEW = {"segmentation": "labels", "seed": 3}
ASIDE = transforms.rigid(np.eye(3), (0.0, 0.1, 0.0))


class Door:
    """A front end, which raises what it refuses; all its graphs are as text.

    Attributes:
        seen: The views as they arrived.
    """

    def __init__(self, folder, scene_file, listen):
        self.folder, self.scene_file, self.listen = folder, scene_file, listen
        self.seen = []
        self.open()

    def open(self):
        """Begin, or go on where it was closed."""

    def close(self):
        """Leave what is kept to others."""


class Keeping(Door):
    """A front end of a session in the folder `s`; `told` is its answer to the newest view."""

    def add(self, view):
        self.seen.append(view)
        self.told = self.added(view)
        return as_text(self.told["graph"])


class InPython(Keeping):
    def open(self):
        folder = self.folder / "s"
        self.session = Session.open(folder) if folder.exists() else Session.begin(folder, **NEW)

    def close(self):
        self.session.close()

    def added(self, view):
        return self.session.add(view).to_json()

    def next(self, poses, lengths=None):
        return self.session.next(poses, lengths).to_json()

    def take(self, object_id, T=None):
        return graph_text(self.session.take(object_id, T))

    def undo(self):
        self.session.undo()
        return self.graph()

    def graph(self):
        return graph_text(self.session.graph)


class CommandLine(Keeping):
    def open(self):
        if not (self.folder / "s").exists():
            self.run("new", "--segmentation", NEW["segmentation"], "--seed", NEW["seed"], "--json")

    def run(self, step, *words):
        self.listen()
        status, (out, err) = run_command("session", step, self.folder / "s", *words), self.listen()
        if status == 0:
            return json.loads(out)
        *_, said = err.splitlines()  # after warnings of views that are kept
        assert (status, out, err.count("error: ")) == (1, "", 1)
        raise CaryatidError(said.removeprefix("error: "))

    def file(self, name, document):
        path = self.folder / name
        path.write_text(json.dumps(document))
        return path

    def added(self, view):
        camera = {"K": view.K.tolist(), "T_world_camera": view.pose.tolist()}
        words = ["--camera", self.file("camera.json", camera)]
        for name in ("depth", "labels"):
            (self.folder / f"{name}.npy").write_bytes(npy(getattr(view, name)))
            words += [f"--{name}", self.folder / f"{name}.npy"]
        return self.run("add", *words, "--json")

    def next(self, poses, lengths=None):
        document = {"T_world_camera": [T.tolist() for T in poses], "path_length": lengths}
        return self.run("next", "--candidates", self.file("poses.json", document))

    def take(self, object_id, T=None):
        moved = [] if T is None else ["--moved", self.file("moved.json", {"T": T.tolist()})]
        return as_text(self.run("take", object_id, *moved, "--json")["graph"])

    def undo(self):
        return as_text(self.run("undo", "--json")["graph"])

    def graph(self):
        return as_text(self.run("graph"))


class Service(Keeping):
    def open(self):
        self.serving = serving(self.folder)
        self.client = self.serving.__enter__()
        if not (self.folder / "s").exists():
            self.ask("post", "/sessions", {"name": "s", **NEW})

    def close(self):
        self.serving.__exit__(None, None, None)

    def ask(self, method, page, document=None):
        given = {} if document is None else {"json": document}
        answer = getattr(self.client, method)(page, **given)
        if answer.status_code in (409, 422):
            raise CaryatidError(answer.json()["detail"])
        assert answer.status_code == (201 if method == "post" and not page.endswith("next") else 200)
        return answer.json()

    def added(self, view):
        return self.ask("post", "/sessions/s/views", body(view))

    def next(self, poses, lengths=None):
        document = {"T_world_camera": [T.tolist() for T in poses], "path_length": lengths}
        return self.ask("post", "/sessions/s/next", document)

    def take(self, object_id, T=None):
        document = {"object": object_id, "T": None if T is None else T.tolist()}
        return as_text(self.ask("post", "/sessions/s/reports", document)["graph"])

    def undo(self):
        return as_text(self.ask("delete", "/sessions/s/views/last")["graph"])

    def graph(self):
        return as_text(self.ask("get", "/sessions/s/graph"))


class Node(Door):
    """What the ROS node does with messages; each view is a goal."""

    budget = 0.0

    def open(self):
        self.masks, self.published = self.folder / "masks", []
        self.masks.mkdir()
        tell = lambda name, message: self.published.append((name, packed(message)))  # noqa: E731
        self.exploration = Exploration(
            Settings(masks=str(self.masks), seed=3, budget=self.budget), tell, make
        )

    def add(self, view):
        time, transform = 100.0 + len(list(self.masks.iterdir())), transform_message(view.pose)
        np.save(self.masks / f"{time:.3f}.npy", view.labels)
        # Masks say nothing of other views, and poses are quaternions, which differ in the last digits.
        T_world_camera = matrix_of(transform.rotation, transform.translation, "view")
        self.seen.append(replace(view, T_world_camera=T_world_camera, labels_are="segments"))
        self.exploration.begin(make("caryatid_msgs/action/Explore/Goal"))
        depth, colour = image(view.depth, "32FC1", time), image(view.rgb, "rgb8", time)
        self.exploration.look(depth, camera_info(view), {"colour": colour}, transform)
        return self.graph()

    def take(self, object_id, T=None):
        fields = {} if T is None else {"moved": True, "motion": transform_message(T)}
        request = make("caryatid_msgs/srv/Removed/Request", object=object_id, **fields)
        self.exploration.remove(request, make("caryatid_msgs/srv/Removed/Response"))
        return self.graph()

    def graph(self):
        """The graph that the node has; of what it sends, only the names are checked here."""
        graph = self.exploration.scene.graph
        (newest,) = [m for name, m in self.published if name == "support_graph"][-1:]
        assert [o.id for o in newest.objects] == [o.id for o in graph.objects]
        return graph_text(graph)


class HurriedNode(Node):
    """The same with a budget, which takes in what is open before it tells its graph."""

    budget = 0.001

    def graph(self):
        self.exploration.finish()
        return super().graph()


class Viewer(Door):
    def open(self):
        robot = make_simulation(load_scene(self.scene_file), Config(), noise="none", seed=0).robot
        opening = lambda _: Source("two", self, robot, None)  # noqa: E731
        self.page = LoopPage(opening, Config(), **NEW)

    def close(self):
        self.page.close()

    def capture(self, _):
        """What the page sees, as a camera."""
        return self.seen[-1]

    def add(self, view):
        self.seen.append(view)
        before = len(self.page.steps)
        self.page.start()
        self.page.wait()
        if len(self.page.steps) == before:
            raise CaryatidError(re.sub("<[^>]*>|\n", "", self.page._notice.content))
        return self.graph()

    def graph(self):
        return graph_text(self.page.steps[-1].graph)


KEEPING = InPython, CommandLine, Service


@pytest.fixture
def door(request, tmp_path, scene_file, capsys):
    door = request.param(tmp_path, scene_file, capsys.readouterr)
    yield door
    door.close()


def to(*doors):
    return pytest.mark.parametrize("door", doors, indirect=True)


def as_text(document):
    return json.dumps(document, indent=1, ensure_ascii=False) + "\n"


def refusal(work):
    """The sentence with which a front end refuses something."""
    with pytest.raises(CaryatidError) as caught:
        work()
    said = in_one_line(caught.value)
    assert "\n" not in str(caught.value)
    assert "internal error" not in said
    return said


def posed(change):
    """Make a view into one with another pose."""
    return lambda view: view.with_pose(change(view.pose))


def shifted(x, y, z):
    return posed(lambda T: transforms.rigid(T[:3, :3], T[:3, 3] + (x, y, z)))


USELESS = [
    (lambda v: replace(v, depth=0.0 * v.depth), "has no depth readings"),
    (lambda v: replace(v, depth=1e6 * v.depth), "give depth in metres"),
    (posed(lambda T: transforms.rigid(T[:3, :3], 1e3 * T[:3, 3])), "as if in millimetres"),
    (posed(transforms.invert), "wrong camera pose"),
    (shifted(9.0, 0.0, 0.0), "none of its points are near the table"),
    (shifted(1e9, 0.0, 0.0), "from the world's origin"),
    (shifted(0.0, 0.0, -1.2), "below the table top"),
    (shifted(0.0, 0.0, 0.4), "of its points lie on surfaces of earlier views"),
]


def graph_of(views):
    scene = Scene(**NEW)
    for view in views:
        scene.update(view)
    return graph_text(scene.graph)


@to(InPython, CommandLine, Service, Node, HurriedNode, Viewer)
def test_views_give_the_graph_of_python_and_what_cannot_be_used_changes_nothing(door, views):
    for number, view in enumerate(views[:2], start=1):
        assert door.add(view) == graph_of(door.seen) == door.graph()
        assert len(door.seen) == number
    graph, seen, kept = door.graph(), list(door.seen), contents(door.folder / "s")
    for change, said in USELESS:
        assert said in refusal(lambda change=change: door.add(change(views[2])))
        assert (door.graph(), contents(door.folder / "s")) == (graph, kept)
    door.seen[:] = seen
    assert door.add(views[2]) == graph_of(door.seen) != graph


@to(*KEEPING)
def test_the_next_view_is_one_that_can_be_reached(door, views):
    poses = [view.pose for view in views[1:]]
    assert "no view" in refusal(lambda: door.next(poses))
    door.add(views[0])
    assert (door.told["warnings"], door.told["changes"]) == ([], [])
    np.testing.assert_allclose(door.told["T_world_camera"], views[0].pose, atol=0.02)
    scene = Scene(**NEW)
    scene.update(views[0])
    for lengths in (None, [9.0, 0.0], [0.0, 9.0]):
        told, chosen = door.next(poses, lengths), next_best_view(scene, candidates=poses, path_length=lengths)
        np.testing.assert_allclose(told["T_world_camera"], chosen.T_world_camera, atol=1e-8)
        assert (told["view"], told["candidate"], told["platform"]) == (1, chosen.index, None)
    far = [transforms.rigid(T[:3, :3], 1e3 * T[:3, 3]) for T in poses]
    assert "give camera poses in metres" in refusal(lambda: door.next(far))


@to(*KEEPING, Node, HurriedNode)
def test_what_the_robot_reports_is_in_the_graph_and_in_that_of_the_next_view(door, views):
    door.add(views[0])
    scene = Scene(**NEW)
    scene.update(door.seen[0])
    assert door.take("o1", ASIDE) == graph_text(scene.moved("o1", ASIDE))
    assert door.take("o2") == graph_text(scene.removed("o2")) == door.graph()
    assert "o2: is not an object of the graph; known objects: o1" in refusal(lambda: door.take("o2"))
    assert door.graph() == graph_text(scene.graph)
    graph = door.add(views[1])
    assert graph == graph_text(scene.update(door.seen[1]))


@to(*KEEPING)
def test_what_was_added_is_there_after_reopening_and_undone_step_by_step(door, views):
    graphs = [door.graph(), door.add(views[0]), door.take("o2"), door.add(views[1]), door.take("o1", ASIDE)]
    door.close()
    with Session.open(door.folder / "s", read_only=True) as session:
        assert (session.views, session.reports) == (2, 2)
        assert graph_text(session.graph) == graphs[-1]
    door.open()
    assert door.graph() == graphs.pop()
    while graphs:
        assert door.undo() == graphs.pop() == door.graph()
    assert "nothing to undo" in refusal(door.undo)
    graph = door.add(views[1])
    door.close()
    door.open()
    assert door.graph() == graph == graph_of(views[1:2])


@to(*KEEPING)
def test_a_view_without_a_table_is_kept_with_a_word_until_one_shows_it(door, views):
    wall = wall_of(views[0])
    nothing = door.add(wall)
    assert (door.told["view"], door.told["changed"]) == (0, False)
    assert door.told["warnings"][0].endswith("this view is kept until a later one shows the table top")
    door.close()
    door.open()
    assert door.graph() == nothing
    assert "no view shows a table top" in refusal(lambda: door.next([view.pose for view in views]))
    for _ in range(2):
        assert door.add(views[0]) == graph_of([wall, views[0]])
        assert (door.told["view"], door.told["changed"], door.told["warnings"]) == (1, True, [])
        assert door.undo() == nothing
