"""Recordings for Rerun and Foxglove, read back by the readers of their own libraries."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import replace
from socket import create_connection

import numpy as np
import pytest
from conftest import SMALL, refusal, run_command
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from rerun.chunk import RrdReader
from scipy.spatial.transform import Rotation

from caryatid.exports.streams import Stream
from caryatid.geometry import transforms
from caryatid.graph import Change, Support, SupportGraph
from caryatid.steps import read_run, read_steps
from caryatid.viz.colours import label_colours, object_colour, rgb

BOTH = pytest.mark.parametrize("ending", ["rrd", "mcap"])


def read_rrd(path):
    """What is shown at each view, by name: of an entity its components, those of `NAME/name` with it."""
    rows, static = {}, {}
    for chunk in RrdReader(path).stream():
        columns = chunk.to_record_batch().to_pydict()
        for row in range(chunk.num_rows):
            found = {key: values[row] for key, values in columns.items() if values[row] is not None}
            place = chunk.entity_path.removeprefix("/world/").removeprefix("/")
            if chunk.is_static:
                static |= found
            else:
                known = rows.setdefault(found["view"], {})
                found["texts"] = [*known.get(place, {}).get("texts", ()), *found.get("TextLog:text", ())]
                known[place] = found
    shown, views = {}, {}
    for view, entities in sorted(rows.items()):
        for place, found in entities.items():
            if "Clear:is_recursive" in found:
                shown = {p: f for p, f in shown.items() if p != place and not p.startswith(f"{place}/")}
            else:
                shown[place] = found
        views[view] = {place: rerun_item(place, found, shown) for place, found in shown.items()}
        views[view]["classes"] = static["AnnotationContext:context"]
    return views


def rerun_item(place, found, shown):
    if "Transform3D:translation" in found:
        R = np.reshape(found["Transform3D:mat3x3"], (3, 3)).T
        T = transforms.rigid(R, np.ravel(found["Transform3D:translation"]))
        if "Pinhole:image_from_camera" in found:
            return (
                T,
                np.reshape(found["Pinhole:image_from_camera"], (3, 3)).T,
                *found["Pinhole:resolution"][0],
            )
        (paint,) = found["Mesh3D:albedo_factor"]
        (text,) = shown[f"{place}/name"]["Points3D:labels"]
        colour = [paint >> shift & 255 for shift in (24, 16, 8)]
        return T, np.array(found["Mesh3D:vertex_positions"]), colour, text
    for kind, dtype in (("Image", np.uint8), ("DepthImage", np.float32), ("SegmentationImage", np.uint16)):
        if f"{kind}:buffer" in found:
            (form,) = found[f"{kind}:format"]
            assert found.get("DepthImage:meter", [1.0]) == [1.0]
            image = np.array(found[f"{kind}:buffer"][0], np.uint8).view(dtype)
            image = image.reshape(form["height"], form["width"], -1).squeeze()
            return label_colours(image.astype(np.int32)) if kind == "SegmentationImage" else image
    if "Points3D:positions" in found:
        return np.array(found["Points3D:positions"])
    return found["texts"] or found["Scalars:scalars"][0]


def read_mcap(path):
    """What a player shows at each view, by name: the newest message of each topic."""
    newest, views, factory = {}, {}, DecoderFactory()
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            decode = factory.decoder_for(channel.message_encoding, schema) or json.loads
            known, view = decode(message.data), message.log_time // 10**9
            said = newest.get("/log", []) if view in views else []
            newest |= {"/log": said, channel.topic: known}
            if channel.topic == "/log":
                newest["/log"] = [*said, known.message]
            views[view] = dict(newest)
            if hasattr(known, "timestamp"):
                assert known.timestamp.ToNanoseconds() == message.log_time
    return {view: foxglove_items(topics) for view, topics in views.items()}


def foxglove_items(topics):
    def pose(place, turn):
        R = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
        return transforms.rigid(R, (place.x, place.y, place.z))

    shown, frame, eye, scene = {}, topics["/tf"], topics["/camera"], topics["/scene"]
    assert (frame.parent_frame_id, frame.child_frame_id, eye.frame_id) == ("world", "camera", "camera")
    T_world_camera = pose(frame.translation, frame.rotation)
    shown["camera"] = T_world_camera, np.reshape(eye.K, (3, 3)), eye.width, eye.height
    assert scene.deletions[0].type == scene.deletions[0].ALL
    for entity in scene.entities:
        (body,), (plate,) = entity.triangles, entity.texts
        corners = np.array([(p.x, p.y, p.z) for p in body.points])
        colour = np.rint(255.0 * np.array([body.color.r, body.color.g, body.color.b])).tolist()
        T = pose(body.pose.position, body.pose.orientation)
        shown[entity.id] = T, corners, colour, plate.text
        assert entity.frame_id == "world"
    for name in ("colour", "depth", "segments"):
        if (image := topics.get(f"/camera/{name}")) is not None:
            dtype = {"32FC1": np.float32, "rgb8": np.uint8}[image.encoding]
            pixels = np.frombuffer(image.data, dtype).reshape(image.height, image.width, -1)
            shown[f"camera/{name}"] = pixels.squeeze()
    cloud = topics["/cloud"]
    kinds = {field.type: dtype for field, dtype in zip(cloud.fields, ("<f4",) * 3 + ("u1",) * 4, strict=True)}
    packed = {"names": [f.name for f in cloud.fields], "formats": [kinds[f.type] for f in cloud.fields]}
    packed |= {"offsets": [f.offset for f in cloud.fields], "itemsize": cloud.point_stride}
    points = np.frombuffer(cloud.data, np.dtype(packed))
    shown["cloud"] = np.stack([points[axis] for axis in "xyz"], axis=1)
    shown["cloud/colours"] = np.stack([points[channel] for channel in ("red", "green", "blue")], axis=1)
    assert (points["alpha"] == 255).all()
    shown["log"] = topics["/log"]
    return shown | ({"f1": topics["/f1"]["f1"]} if "/f1" in topics else {})


READERS = {"rrd": read_rrd, "mcap": read_mcap}


@pytest.fixture(scope="module")
def steps(kept_run):
    """Two steps: before the second, the can o2 was taken off the crate o1, which is doubtfully supported."""
    first, second = read_steps(read_run(kept_run))
    graph, gone = second.graph, Change("removed", "o2", 1, "its place is empty")
    left = SupportGraph(
        tuple(o for o in graph.objects if o.id != "o2"), (Support("o0", "o1", probability=0.6),)
    )
    return first, replace(second, graph=left, changes=(gone,), decision=None, stop="enough")


@BOTH
def test_each_view_shows_what_its_step_holds(tmp_path, steps, ending):
    path = tmp_path / f"two.{ending}"
    with Stream(path) as stream:
        for step, f1 in zip(steps, (None, 0.75), strict=True):
            stream.add(step, f1)
    views = READERS[ending](path)
    assert list(views) == [1, 2]
    for step, shown in zip(steps, views.values(), strict=True):
        T_world_camera, K, width, height = shown["camera"]
        np.testing.assert_allclose(T_world_camera, step.view.pose, atol=1e-6)
        np.testing.assert_allclose(K, step.view.K, rtol=1e-6)
        assert (height, width) == step.view.depth.shape
        np.testing.assert_array_equal(shown["camera/depth"], step.view.depth)
        np.testing.assert_array_equal(shown["camera/segments"], label_colours(step.labels))
        np.testing.assert_array_equal(shown["camera/colour"], step.view.rgb)
        np.testing.assert_allclose(shown["cloud"], step.cloud.points_world, atol=1e-6)
        if ending == "mcap":
            np.testing.assert_array_equal(shown["cloud/colours"], label_colours(step.cloud.labels))
        for item in step.graph.objects:
            T, corners, colour, text = shown[f"objects/{item.id}"]
            np.testing.assert_allclose(T, item.shape.T_world_object, atol=1e-3)
            assert np.abs(item.shape.signed_distance(transforms.transform(T, corners))).max() < 1e-3
            assert (tuple(colour), text) == (rgb(object_colour(item.label)), item.id)
    first, second = views.values()
    assert set(first) - set(second) == {
        name for name in first if name.startswith(("next", "objects/o2", "supports/o1/o2"))
    }
    assert {"next", "objects/o2", "supports/o1/o2"} <= set(first)
    np.testing.assert_allclose(first["next"][0], steps[0].decision.T_world_camera, atol=1e-6)
    assert ("f1" in first, second["f1"]) == (False, 0.75)
    assert first["log"] == [f"next: {steps[0].decision.why}"]
    assert second["log"] == ["removed: o2: its place is empty", "finished: enough"]


@BOTH
def test_an_arrow_runs_up_and_a_doubtful_one_has_another_colour(tmp_path, steps, ending):
    with Stream(tmp_path / f"two.{ending}") as stream:
        for step in steps:
            stream.add(step)
    first, second = READERS[ending](tmp_path / f"two.{ending}").values()
    (_, _, sure, _), (T, corners, doubtful, text) = first["supports/o0/o1"], second["supports/o0/o1"]
    assert text == "0.60"
    assert sure != doubtful
    points = transforms.transform(T, corners)
    tip, crate = points[points[:, 2].argmax()], steps[1].graph["o1"]
    np.testing.assert_allclose(tip, crate.centre_world, atol=2e-3)


def test_rerun_knows_the_classes_of_all_views(tmp_path, steps):
    with Stream(tmp_path / "two.rrd") as stream:
        for step in steps:
            stream.add(step)
    shown = read_rrd(tmp_path / "two.rrd")[2]
    names = {each["class_id"]: each["class_description"]["info"]["label"] for each in shown["classes"][0]}
    assert names == {0: "nothing"} | {o.label: o.id for o in steps[0].graph.objects}


@BOTH
def test_a_run_is_recorded_while_it_goes_on_and_afterwards(tmp_path, scene_file, ending):
    live, later, run = tmp_path / f"live.{ending}", tmp_path / f"later.{ending}", tmp_path / "run"
    options = ("--views", 2, "--no-report", *SMALL)
    assert run_command("explore", scene_file, "--out", run, "--stream", live, *options) == 0
    assert run_command("export", run, "--out", later) == 0
    known = read_run(run)
    for views in (READERS[ending](live), READERS[ending](later)):
        assert [shown["f1"] for shown in views.values()] == [s["f1"] for s in known.record["scores"]]
        for view, shown in zip(known.views, views.values(), strict=True):
            assert {f"objects/{o}" for o in view.graph} <= set(shown)


@BOTH
def test_what_cannot_be_recorded_is_said(tmp_path, ending):
    with refusal("wrong.txt", ".rrd or .mcap"):
        Stream(tmp_path / "wrong.txt")
    (tmp_path / f"folder.{ending}").mkdir()
    with refusal(f"folder.{ending}", "folder"):
        Stream(tmp_path / f"folder.{ending}")


def test_without_a_viewer_the_remedy_is_to_start_one(monkeypatch):
    with suppress(OSError), create_connection(("127.0.0.1", 9876), timeout=1.0):
        pytest.skip("a viewer of Rerun runs here")
    monkeypatch.setenv("PATH", "")
    with refusal("rerun", "start `rerun`"):
        Stream("rerun")
