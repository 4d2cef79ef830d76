"""Names of masks: objects keep them, and reports, exports and descriptions show them."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from conftest import refusal, run_command
from test_service import body, serving

from caryatid.exports import export_graph
from caryatid.geometry.shapes import Box
from caryatid.geometry.transforms import rigid
from caryatid.graph import Support, SupportGraph
from caryatid.io import graph_from_json, graph_to_json
from caryatid.io.bop import read_recording, write_recording
from caryatid.io.images import png
from caryatid.scene import Scene
from caryatid.sensing.views import View
from caryatid.sessions import Session
from caryatid.viewer.panels import describe_object
from caryatid.viz.tables import describe

NAMES = {1: "mug", 2: "tray"}


def names_of(graph):
    return {o.id: o.name for o in graph.objects if o.role == "object"}


def test_objects_of_a_recording_have_the_names_of_their_labels(tmp_path, recording, capsys):
    assert names_of_run(recording, tmp_path / "without") == {"o1": None, "o2": None}
    before = (tmp_path / "without/graph.json").read_text()
    (recording / "names.json").write_text(json.dumps({"1": "mug", "2": "two\nlines", "9": "ghost"}))
    assert names_of_run(recording, tmp_path / "run") == {"o1": "mug", "o2": "two lines"}
    assert "name" not in before
    write_recording(tmp_path / "copy", read_recording(recording))
    assert json.loads((tmp_path / "copy/names.json").read_text()) == {"1": "mug", "2": "two lines"}
    assert "mug (o1)" in (tmp_path / "run/report.html").read_text()
    capsys.readouterr()
    assert run_command("describe", tmp_path / "run") == 0
    assert "- mug (o1): " in capsys.readouterr().out


def names_of_run(recording, run):
    assert run_command("extract", recording, "--out", run) == 0
    return {o["id"]: o.get("name") for o in json.loads((run / "graph.json").read_text())["objects"][1:]}


def test_segments_with_other_numbers_in_each_view_give_objects_their_names(tmp_path, recording):
    """The masks are a folder's; in the second view the numbers of both objects are swapped."""
    masks = tmp_path / "masks"
    masks.mkdir()
    scene = Scene()
    for view in read_recording(recording).frames:
        seen = view.load()
        swapped = {1: 2, 2: 1} if view.number == 1 else {1: 1, 2: 2}
        labels = np.select([seen.labels == k for k in swapped], list(swapped.values())).astype(np.int32)
        names = {swapped[k]: name for k, name in NAMES.items()}
        scene.update(replace(seen, labels=labels, labels_are="segments", names=names))
        (masks / f"{view.number:06d}.png").write_bytes(png(seen.labels.astype(np.uint16)))
    shown = {name: o for o in scene.graph.objects if (name := o.name)}
    truth = read_recording(recording).frames[0].load()
    first = {
        k: np.median(truth.points_camera[truth.labels == k] @ truth.pose[:3, :3].T, axis=0) for k in NAMES
    }
    for k, name in NAMES.items():
        place = first[k] + truth.pose[:3, 3]
        assert min(shown.values(), key=lambda o: np.linalg.norm(o.centre_world - place)).name == name
    (masks / "names.json").write_text(json.dumps(NAMES))
    assert run_command("extract", recording, "--masks", masks, "--out", tmp_path / "run") == 0
    objects = json.loads((tmp_path / "run/graph.json").read_text())["objects"]
    assert {o.get("name") for o in objects} == {None, "mug", "tray"}


def test_what_happens_to_an_object_does_not_change_its_name(views):
    scene = Scene(segmentation="labels")
    for view in views[:2]:
        scene.update(replace(view, names=NAMES))
    scene.update(views[2])
    assert names_of(scene.graph) == {"o1": "mug", "o2": "tray"}
    scene.moved("o2", np.eye(4))
    assert names_of(scene.copy().graph) == {"o1": "mug", "o2": "tray"}
    scene.removed("o2")
    assert names_of(scene.graph) == {"o1": "mug"}
    ignored = Scene(segmentation="auto")
    ignored.update(replace(views[0], names=NAMES))
    assert set(names_of(ignored.graph).values()) == {None}


def test_a_session_keeps_names(tmp_path, views):
    with serving(tmp_path) as client:
        client.post("/sessions", json={"name": "a"})
        for view in views[:2]:
            sent = body(view)
            sent["camera"]["names"] = NAMES
            assert client.post("/sessions/a/views", json=sent).status_code == 201
        graph = graph_from_json(client.get("/sessions/a/graph").json(), "graph")
    with Session.open(tmp_path / "a", read_only=True) as session:
        replayed = [step.graph for step in session.replay()][-1]
        assert names_of(graph) == names_of(session.graph) == names_of(replayed) == {"o1": "mug", "o2": "tray"}


def test_tables_and_exports_show_names(tmp_path, views):
    scene = Scene(segmentation="labels")
    graph = scene.update(replace(views[0], names={1: 'the "mug"'}))
    assert graph["o1"].title == 'the "mug" (o1)'
    assert names_of(graph_from_json(graph_to_json(graph), "graph")) == {"o1": 'the "mug"', "o2": None}
    assert "(o1)" in describe_object(graph, "o1", scene.config.support)
    export_graph(graph, tmp_path / "s.dot")
    assert 'label="the \\"mug\\" (o1)"' in (tmp_path / "s.dot").read_text()


def test_a_description_says_what_supports_what_and_what_is_free(views):
    known = Scene(segmentation="labels").update(views[0])
    objects = tuple(replace(o, name=NAMES.get(o.label), doubt="", probability=0.95) for o in known.objects)
    supports = (Support("o0", "o2", probability=0.99), Support("o2", "o1", probability=0.6, why="it rests"))
    lines = describe(SupportGraph(objects, supports)).splitlines()
    assert lines[0].startswith("2 objects, 2 supports, 1 of them doubtful")
    (mug,) = (line for line in lines if line.startswith("- mug (o1)"))
    assert mug.endswith("supported by tray (o2) (0.60)")
    lying = replace(
        objects[1], shape=Box(rigid([[0, 0, 1], [0, 1, 0], [-1, 0, 0]], np.ones(3)), [0.2, 0.06, 0.1])
    )
    assert "box 200 × 60 × 100, 200 high" in describe(SupportGraph((lying,)))
    assert "support nothing (`caryatid order` rehearses lifting them): mug (o1)" in lines
    assert lines[lines.index("doubtful:") + 1].startswith(
        "- tray (o2) → mug (o1), probability 0.60: it rests"
    )


@pytest.mark.parametrize("content", ['{"mug": "1"}', '{"1": 2}', '["mug"]', "{"])
def test_a_broken_file_of_names_is_named(recording, content):
    (recording / "names.json").write_text(content)
    with refusal(recording / "names.json"):
        read_recording(recording)
    with refusal("names"):
        View(np.ones((4, 4)), np.eye(3), names=["mug"])
