"""Masks of other programs and of learned models, given to views as they are taken."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import onnx
import pytest
from conftest import run_command
from onnx import TensorProto, helper
from synthetic import AROUND, SENSOR, look_from, simulated_scene, simulated_views

from caryatid.config import Config
from caryatid.errors import InputError
from caryatid.io.bop import read_recording, write_recording
from caryatid.io.graph_json import graph_text
from caryatid.io.images import png
from caryatid.io.mask_sources import mask_source
from caryatid.scene import Scene
from caryatid.sensing.views import SUPPORT_LABEL
from caryatid.sessions import Session
from caryatid.simulation.camera import SimulatedCamera
from caryatid.steps import read_run

HEIGHT, WIDTH = 90, 120


def write_model(path, nodes, inputs, constants=()):
    """A model with float inputs of these shapes and one output `masks`."""
    given = [helper.make_tensor_value_info(n, TensorProto.FLOAT, shape) for n, shape in inputs.items()]
    masks = helper.make_tensor_value_info("masks", TensorProto.BOOL, None)
    arrays = [onnx.numpy_helper.from_array(value, name) for name, value in constants]
    graph = helper.make_graph(nodes, "tiny", given, [masks], arrays)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.save(model, path)
    return f"onnx:{path}"


@pytest.fixture
def channels(tmp_path):
    """A model whose three masks are where an image is red, green and blue."""
    greater = helper.make_node("Greater", ["image", "half"], ["masks"])
    constants = [("half", np.float32(0.5))]
    return write_model(tmp_path / "channels.onnx", [greater], {"image": (1, 3, HEIGHT, WIDTH)}, constants)


@pytest.fixture
def boxed(tmp_path):
    """A model whose masks are the boxes it is prompted with."""
    rows = np.arange(HEIGHT, dtype=np.float32)[None, :, None]
    columns = np.arange(WIDTH, dtype=np.float32)[None, None, :]
    nodes = [
        helper.make_node("Unsqueeze", ["boxes", "one"], ["sides"]),
        helper.make_node("Split", ["sides"], [f"side{k}" for k in range(4)], axis=2),
        helper.make_node("GreaterOrEqual", ["columns", "side0"], ["right"]),
        helper.make_node("GreaterOrEqual", ["rows", "side1"], ["below"]),
        helper.make_node("Less", ["columns", "side2"], ["left"]),
        helper.make_node("Less", ["rows", "side3"], ["above"]),
        helper.make_node("And", ["right", "left"], ["across"]),
        helper.make_node("And", ["below", "above"], ["along"]),
        helper.make_node("And", ["across", "along"], ["masks"]),
    ]
    inputs = {"image": (1, 3, HEIGHT, WIDTH), "boxes": ("N", 4)}
    constants = [("rows", rows), ("columns", columns), ("one", np.array([1]))]
    return write_model(tmp_path / "boxed.onnx", nodes, inputs, constants)


def test_a_models_masks_are_segments_of_the_view_at_its_own_size(channels):
    """The model works at 120 × 90; the view is twice as large, and so are its masks."""
    view = simulated_views("tower")[0]
    rgb = np.zeros((*view.depth.shape, 3), dtype=np.uint8)
    rgb[20:80, 20:100, 0] = rgb[100:160, 140:220, 2] = 255
    masked = mask_source(channels, Config())(replace(view, rgb=rgb, labels=None))
    assert masked.labels_are == "segments"
    assert masked.labels.shape == view.depth.shape == (180, 240)
    assert masked.labels[50, 60] == 1
    assert masked.labels[130, 180] == 3
    np.testing.assert_allclose(np.count_nonzero(masked.labels), 2 * 60 * 80, rtol=0.05)
    black = mask_source(channels, Config())(replace(view, rgb=np.zeros_like(rgb), labels=None))
    assert not black.labels.any()


@pytest.mark.parametrize("name", ["depth", "xyz"])
def test_a_model_may_need_no_colour(name, tmp_path):
    """Its only mask is the nearest fifth of the image."""
    view = replace(simulated_views("tower")[0], rgb=None, labels=None)
    most = np.quantile(view.depth, 0.2)
    split = helper.make_node("Split", ["xyz"], ["x", "y", "z"], axis=1)
    less = helper.make_node("Less", ["depth" if name == "depth" else "z", "most"], ["masks"])
    nodes, channels = ([less], 1) if name == "depth" else ([split, less], 3)
    size = (1, channels, HEIGHT, WIDTH)
    model = write_model(tmp_path / "model.onnx", nodes, {name: size}, [("most", most)])
    masked = mask_source(model, Config())(view)
    assert np.mean((masked.labels > 0) == (view.depth < most)) > 0.98


def test_our_own_segments_are_a_models_prompts(boxed):
    view = simulated_views("tower", vga=True)[0]
    masked = mask_source(boxed, Config())(replace(view, labels=None))
    true = set(np.unique(view.labels)) - {0, SUPPORT_LABEL}
    for label in true:
        rows, columns = np.nonzero(view.labels == label)
        middle = masked.labels[int(np.median(rows)), int(np.median(columns))]
        assert middle > 0, "each object lies in the box of a segment"


def test_a_folder_gives_the_masks_and_numbers_mean_nothing_between_views(tmp_path, recording, views):
    rng, folder = np.random.default_rng(0), tmp_path / "masks"
    folder.mkdir()
    for number, view in enumerate(views):
        objects = np.unique(view.labels[(view.labels > 0) & (view.labels != SUPPORT_LABEL)])
        names = rng.permutation(np.arange(1, len(objects) + 1))
        stack = np.stack([view.labels == k for k in objects[np.argsort(names)]])
        said = {int(n): f"thing {k}" for k, n in zip(objects, names, strict=True)}
        (folder / f"{number:06d}.json").write_text(json.dumps(said))
        if number % 2:
            np.save(folder / f"{number:06d}.npy", stack)
        else:
            labels = np.zeros(view.labels.shape, dtype=np.uint16)
            for k, mask in enumerate(stack, start=1):
                labels[mask] = k
            (folder / f"{number:06d}.png").write_bytes(png(labels))
    (folder / "names.json").write_text('{"1": "for views without names of their own"}')
    out = ("--no-report", "--quiet", "--out")
    assert run_command("extract", recording, *out, tmp_path / "named") == 0
    assert run_command("extract", recording, "--masks", folder, *out, tmp_path / "from") == 0
    named, given = (read_run(tmp_path / name).graph for name in ("named", "from"))
    assert len(given.objects) == len(named.objects)
    assert len(given.supports) == len(named.supports)
    shown = {f"thing {k}" for view in views for k in np.unique(view.labels) if 0 < k < SUPPORT_LABEL}
    things = [o.name for o in given.objects if o.role == "object"]
    assert len(things) == len(set(things)), "an object has one name, from the file of each view"
    assert set(things) <= shown
    (folder / "000001.npy").unlink()
    assert run_command("extract", recording, "--masks", folder, *out, tmp_path / "broken") == 1


def test_what_gives_no_masks_is_refused(tmp_path, channels, capsys):
    view = simulated_views("tower")[0]
    with pytest.raises(InputError, match="has no colour image"):
        mask_source(channels, Config())(replace(view, rgb=None))
    with pytest.raises(InputError, match="no such folder"):
        mask_source(str(tmp_path / "nowhere"), Config())
    with pytest.raises(InputError, match="has no masks for"):
        mask_source(str(tmp_path), Config())(view)
    (tmp_path / "bad.onnx").write_bytes(b"no model")
    for name, said in (("bad.onnx", "onnxruntime cannot read"), ("none.onnx", "is missing")):
        with pytest.raises(InputError, match=said):
            mask_source(f"onnx:{tmp_path / name}", Config())
    add = helper.make_node("Greater", ["picture", "image"], ["masks"])
    shape = (1, 3, HEIGHT, WIDTH)
    other = write_model(tmp_path / "other.onnx", [add], {"picture": shape, "image": shape})
    with pytest.raises(InputError, match="has inputs picture, image and outputs masks"):
        mask_source(other, Config())
    assert run_command("config", "--masks", "onnx:model.onnx") == 1
    assert "reads no views" in capsys.readouterr().err


@pytest.fixture(scope="module")
def with_arm(tmp_path_factory):
    """A folder with a recording near a tower, the same with an arm in front of the camera, and its mask."""
    folder = tmp_path_factory.mktemp("arm")
    camera = SimulatedCamera(simulated_scene("tower"), sensor=SENSOR)
    views = [camera.capture(look_from(azimuth, 45.0, 0.9)) for azimuth in AROUND]
    views = [replace(view, labels=None, normals_camera=None) for view in views]
    arm = np.zeros(views[0].depth.shape, dtype=np.uint8)
    arm[126:, 96:156] = 255
    write_recording(folder / "clean", views)
    write_recording(folder / "arm", [replace(v, depth=np.where(arm, 0.6, v.depth)) for v in views])
    (folder / "masks").mkdir()
    for name in ("mask", "masks/000000", "masks/000001", "masks/000002"):
        (folder / f"{name}.png").write_bytes(png(arm))
    (folder / "small.png").write_bytes(png(arm[126:]))
    return folder


def test_the_robots_own_arm_is_not_an_object(with_arm, tmp_path, capsys):
    def objects(recording, *options):
        out = ("--no-report", "--quiet", "--out", tmp_path / "run")
        assert run_command("extract", with_arm / recording, *options, *out) == 0
        return len(read_run(tmp_path / "run").graph.objects)

    without = objects("clean")
    assert objects("arm") > without
    assert objects("arm", "--ignore", with_arm / "mask.png") <= without
    assert objects("arm", "--ignore", with_arm / "masks") <= without
    for source, mask, said in (
        (with_arm / "arm", "small.png", "ignored is 240×54, depth is 240×180"),
        (with_arm / "arm", "none.png", "the file is missing"),
        ("tower", "mask.png", "--ignore is for recordings"),
    ):
        given = ("--ignore", with_arm / mask, "--out", tmp_path / "none")
        assert run_command("explore", source, *given) == 1
        assert said in capsys.readouterr().err


def test_a_session_ignores_the_arm_in_every_view(with_arm, tmp_path):
    """Also in views from its folder: what it knows is made again from those."""
    options = ("--ignore", with_arm / "mask.png", "--quiet")
    assert run_command("session", "new", tmp_path / "s", *options) == 0
    graphs = []
    for remake in (False, True):
        with Session.open(tmp_path / "s") as session:
            for view in [] if remake else read_recording(with_arm / "arm"):
                session.add(view)
            graphs.append(graph_text(session.graph))
    scene = Scene()
    for view in read_recording(with_arm / "arm"):
        ignored = np.zeros(view.depth.shape, dtype=bool)
        ignored[126:, 96:156] = True
        scene.update(replace(view, ignored=ignored))
    assert graphs == [graph_text(scene.graph)] * 2
