"""What robots record becomes a recording: bags of both ROS and TUM folders, good ones and bad ones."""

from __future__ import annotations

import json
import shutil
import sqlite3
from dataclasses import replace

import numpy as np
import pytest
from bag_files import (
    BASE,
    DEPTH,
    INFO,
    LENS,
    RGB,
    SECOND,
    START,
    T_BASE_LENS,
    WORLD,
    BagFile,
    compressed_depth,
    jpeg,
    write_bag,
    write_tum,
)
from conftest import run_command
from hypothesis import given
from hypothesis import settings as limits
from hypothesis import strategies as st
from PIL import Image
from scipy.spatial.transform import Rotation
from synthetic import random_motion

from caryatid.config import Config, RecordingConfig
from caryatid.geometry import transforms
from caryatid.io import read_recording
from caryatid.io.images import png
from caryatid.io.importing import choose_views
from caryatid.io.video import TransformTree
from caryatid.sources import open_recording

TOPICS = ("--depth", DEPTH, "--info", INFO)
ALL = (*TOPICS, "--rgb", RGB, "--tf", WORLD)
KINDS = [("one.bag", "sqlite3"), ("two", "sqlite3"), ("three", "mcap")]
EACH_KIND = pytest.mark.parametrize("kind", KINDS, ids=["ROS 1", "sqlite3", "mcap"])


def bag_of(tmp_path, views, kind=KINDS[0], **options):
    """A bag of some views, or an empty one."""
    name, storage = kind
    write_bag(tmp_path / name, views, storage, **options)
    return tmp_path / name


def imported(tmp_path, source, *options):
    assert run_command("import", source, *options, "--out", tmp_path / "out") == 0
    return read_recording(tmp_path / "out")


@pytest.fixture
def unfit(refused):
    """Import what cannot be imported."""
    return lambda source, *options, says: refused("import", source, *options, names="", says=says)


def same_views(recording, views, atol=0.00051):
    assert len(recording) == len(views)
    for view, original in zip(recording, views, strict=True):
        assert np.allclose(view.depth, original.depth, atol=atol)
        assert np.allclose(view.T_world_camera, original.T_world_camera, atol=1e-6)
        assert np.array_equal(view.K, original.K)
        assert np.array_equal(view.rgb, original.rgb)


# What is in a bag comes out


@EACH_KIND
def test_a_bag_becomes_the_views_it_holds(tmp_path, views, kind):
    recording = imported(tmp_path, bag_of(tmp_path, views, kind), *ALL)
    same_views(recording, views)


def test_a_bag_that_does_not_say_how_messages_are_laid_out(tmp_path, views):
    """As ROS 2 wrote them before Iron."""
    folder = bag_of(tmp_path, views, ("two", "sqlite3"))
    (file,) = folder.glob("*.db3")
    with sqlite3.connect(file) as database:
        database.execute("DELETE FROM message_definitions")
    same_views(imported(tmp_path, folder, *ALL), views)


def test_without_a_world_a_single_frame_without_a_pose_is_taken(tmp_path, views, capsys):
    recording = imported(tmp_path, bag_of(tmp_path, views), *TOPICS)
    assert len(recording) == 1
    assert not recording.has_poses
    told = capsys.readouterr().err
    assert "no --tf FRAME: poses are unknown, so only one frame is imported" in told
    options = ("--out", tmp_path / "run", "--quiet", "--no-report")
    assert run_command("extract", tmp_path / "out", *options) == 0


# Encodings


@pytest.mark.parametrize(
    ("encoding", "big", "padding"),
    [("16UC1", False, 0), ("mono16", True, 6), ("32FC1", False, 8), ("32FC1", True, 0)],
)
def test_raw_depth_omits_invalid_readings(tmp_path, views, encoding, big, padding):
    pixels = views[0].depth.astype(np.float32)
    if encoding == "32FC1":
        pixels[:2], pixels[2:4], pixels[4:6], pixels[6:8] = np.nan, np.inf, -1.0, 30.0
    else:
        pixels[:8] = 0.0
        pixels = np.rint(pixels * 1000.0).astype(np.uint16)
    bag = bag_of(
        tmp_path, views[:1], depth=lambda b, t: b.image(t, pixels, encoding, padding=padding, big=big)
    )
    (view,) = imported(tmp_path, bag, *TOPICS)
    assert not view.depth[:8].any()
    metres = views[0].depth if encoding == "32FC1" else pixels * 0.001
    assert np.allclose(view.depth[8:], metres[8:], atol=0.00006)


@pytest.mark.parametrize(
    ("form", "atol"),
    [("16UC1; compressedDepth", 0.00051), ("32FC1; compressedDepth png", 0.0015), ("png", 0.00051)],
)
def test_compressed_depth(tmp_path, views, form, atol):
    depth = views[0].depth
    millimetres = np.rint(depth * 1000.0).astype(np.uint16)
    data = compressed_depth(depth, form[:5]) if "compressedDepth" in form else png(millimetres)
    bag = bag_of(tmp_path, views[:1], depth=lambda b, t: b.compressed(t, data, form))
    (view,) = imported(tmp_path, bag, *TOPICS)
    assert ((view.depth > 0.0) == (depth > 0.0)).all()
    assert np.allclose(view.depth, depth, atol=atol)


def rgba(rgb):
    return np.dstack([rgb, np.full(rgb.shape[:2], 9, dtype=np.uint8)])


@pytest.mark.parametrize(
    ("pack", "encoding"),
    [
        (lambda rgb: rgb, "rgb8"),
        (lambda rgb: rgb[:, :, ::-1], "bgr8"),
        (rgba, "rgba8"),
        (lambda rgb: rgba(rgb[:, :, ::-1]), "bgra8"),
        (png, "rgb8; png compressed bgr8"),
        (jpeg, "jpeg"),
    ],
)
def test_colour(tmp_path, views, pack, encoding):
    rgb = views[0].rgb
    packed = pack(rgb)

    def message(bag, time):
        if isinstance(packed, bytes):
            return bag.compressed(time, packed, encoding)
        return bag.image(time, np.ascontiguousarray(packed), encoding, padding=5)

    (view,) = imported(tmp_path, bag_of(tmp_path, views[:1], colour=message), *TOPICS, "--rgb", RGB)
    assert np.abs(view.rgb.astype(int) - rgb).mean() < (3.0 if encoding == "jpeg" else 1e-9)


def test_lens_distortion_is_reported(tmp_path, views, capsys):
    imported(tmp_path, bag_of(tmp_path, views[:1], D=(0.1, 0.0, 0.0, 0.0, 0.0)), *TOPICS)
    assert "the lens has distortion" in capsys.readouterr().err


def info_bag(tmp_path, view, topic, depth=None, D=(0.0,) * 5, **fields):
    """A bag of one depth image whose camera info has these fields; K and D are those of another lens."""
    with BagFile(tmp_path / "lens") as bag:
        K = view.K * [[1.25], [1.25], [1.0]]
        info = bag.camera(START, K, view.depth.shape[::-1], D=D)
        info.p = np.column_stack([view.K, np.zeros(3)]).ravel()
        for name, value in fields.items():
            setattr(info, name, value)
        bag.write(INFO, info, START)
        bag.write(topic, bag.image(START, (view.depth if depth is None else depth), "32FC1"), START)
    return tmp_path / "lens"


BENT = (-0.3, 0.1, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("topic", "D", "P", "scale", "said"),
    [
        ("/depth/image_rect_raw", BENT, 1.0, 1.0, False),
        ("/depth/image_rect/compressed", BENT, 1.0, 1.0, False),
        ("/direct/depth", (0.0,) * 5, 1.0, 1.0, False),
        ("/direct/depth", BENT, 1.0, 1.0, True),
        ("/depth/image_rect", BENT, 0.0, 1.25, False),
        ("/depth/image_raw", BENT, 1.0, 1.25, True),
    ],
)
def test_the_camera_is_p_where_images_are_rectified_and_k_where_they_are_raw(
    tmp_path, views, capsys, topic, D, P, scale, said
):
    P = np.column_stack([P * views[0].K, np.zeros(3)]).ravel()
    (view,) = imported(
        tmp_path, info_bag(tmp_path, views[0], topic, D=D, p=P), "--depth", topic, "--info", INFO
    )
    np.testing.assert_allclose(view.K, views[0].K * [[scale], [scale], [1.0]])
    assert ("the lens has distortion" in capsys.readouterr().err) == said


def test_binning_divides_the_camera_and_a_region_of_interest_shifts_it(tmp_path, views, unfit):
    view = views[0]
    part = {"x_offset": 40, "y_offset": 20, "width": 100, "height": 80}
    with BagFile(tmp_path / "any") as bag:
        bag.write("/any", bag.camera(START, view.K, (1, 1)), START)
        region = bag.type("sensor_msgs/msg/RegionOfInterest")(**part, do_rectify=False)
    depth = view.depth[20:100:2, 40:140:2]
    bag = info_bag(tmp_path, view, DEPTH, depth, roi=region, binning_x=2, binning_y=2)
    (cut,) = imported(tmp_path, bag, *TOPICS)
    np.testing.assert_allclose(cut.K, (view.K - [[0, 0, 40], [0, 0, 20], [0, 0, 0]]) / [[2], [2], [1]])
    shutil.rmtree(bag)
    bag = info_bag(tmp_path, view, DEPTH, binning_x=2, binning_y=2)
    unfit(bag, *TOPICS, says="camera_info has binning 2 × 2: its images (80×60 pixels")


def test_bags_of_the_realsense_sdk_have_no_frames_and_their_own_unit(tmp_path, views, capsys, unfit):
    view, sensor = views[0], "/device_0/sensor_0"
    depth, info, rgb = f"{sensor}/Depth_0/image/data", f"{sensor}/Depth_0/info/camera_info", "/rgb"
    other = "/device_0/sensor_1/Color_0/image/data"
    with BagFile(tmp_path / "viewer.bag") as bag:
        unit = bag.type("std_msgs/msg/Float32")(data=np.float32(0.00025))
        bag.write(f"{sensor}/option/Depth_Units/value", unit, START)
        bag.write(info, bag.camera(0, view.K, view.depth.shape[::-1], frame=""), START)
        units = np.rint(view.depth / 0.00025).astype(np.uint16)
        bag.write(depth, bag.image(START, units, "mono16", frame="0"), START)
        for topic in (rgb, other):
            bag.write(topic, bag.image(START, view.rgb, "rgb8", frame="0"), START)
        bag.write("/tf_static", bag.transform(START, WORLD, LENS, np.eye(4)), START)
    topics = (tmp_path / "viewer.bag", "--depth", depth, "--info", info)
    (read,) = imported(tmp_path, *topics, "--rgb", rgb)
    assert np.abs(read.depth - view.depth).max() < 0.00018
    assert "units of 0.00025 m" in capsys.readouterr().err
    said = "/device_0/sensor_0 is not registered to the colour of another sensor, /device_0/sensor_1"
    unfit(*topics, "--rgb", other, says=said)
    unfit(*topics, "--tf", WORLD, says="frame_id is empty")


# What is left out is counted


def summary(tmp_path, capsys, source, *options):
    capsys.readouterr()
    assert run_command("import", source, *options, "--out", tmp_path / "out", "--json") == 0
    told = capsys.readouterr()
    assert told.err == ""
    document = json.loads(told.out)
    assert document["frames"] == len(document["views"]) + sum(document["skipped"].values())
    assert len(read_recording(tmp_path / "out")) == len(document["views"])
    return document


def test_frames_without_a_pose_or_colour_are_counted(tmp_path, views, capsys):
    bag = bag_of(tmp_path, [*views, views[0]], without_pose=(1,), without_colour=(3,))
    document = summary(tmp_path, capsys, bag, *ALL)
    assert document["skipped"] == {"no colour image at that time": 1, "no pose": 1}
    assert [view["frame"] for view in document["views"]] == [0, 2]
    assert document["views"][1]["time"] == START + 2 * SECOND


def test_dark_blurred_and_equal_frames_are_counted(tmp_path, views, capsys):
    dark = replace(views[1], depth=np.where(np.arange(160) < 8, views[1].depth, np.float32(0.0)))
    grey = replace(views[2], rgb=np.full_like(views[2].rgb, 90))
    bag = bag_of(tmp_path, [views[0], dark, views[0], grey, views[2]])
    options = ("--set", "recording.sharp_window=1.5")
    document = summary(tmp_path, capsys, bag, *ALL, *options)
    assert document["skipped"] == {
        "too few depth readings": 1,
        "same viewpoint as another view": 1,
        "blurred": 1,
    }
    assert [view["frame"] for view in document["views"]] == [0, 4]


# Bags that will not do


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ((), "--depth TOPIC is required; topics with images: /camera/depth/image, /camera/rgb/image; other"),
        (("--depth", "/no", "--info", INFO), "'/no' holds nothing, not images; topics with images:"),
        (("--depth", DEPTH, "--info", "/cam"), "not cameras; topics with cameras: /camera/depth/camera_info"),
        (("--depth", DEPTH), "--info TOPIC is required; topics with cameras: /camera/depth/camera_info;"),
        (("--depth", "/chatter", "--info", INFO), "'/chatter' holds std_msgs/msg/String, not images"),
        ((*TOPICS, "--rgb", "/tf"), "--rgb: '/tf' holds tf2_msgs/msg/TFMessage, not images"),
        ((*TOPICS, "--tf", "earth"), "unknown frame 'earth'; known frames: base, map, optical"),
        ((*TOPICS, "--camera", "x.json"), "--camera: applies only to TUM RGB-D folders"),
        ((*TOPICS, "--set", "recording.min_readings=0.999"), "of its 3 depth images is usable: 3 too few"),
        ((*TOPICS, "--rgb", RGB, "--set", "recording.colour_gap=0.001"), "3 no colour image at that time"),
        ((*TOPICS, "--tf", WORLD, "--set", "recording.pose_gap=0.01"), "3 no pose; record poses"),
    ],
)  # fmt: skip
def test_options_that_do_not_fit_the_bag_are_refused(tmp_path, views, unfit, options, said):
    unfit(bag_of(tmp_path, views), *options, says=said)


def tf_bag(path, views, *fixed, late=0):
    """A bag with transforms of its own: fixed ones, and the base in the world, later by a time [ns]."""
    with BagFile(path) as bag:
        for parent, child, T in fixed:
            bag.write("/tf_static", bag.transform(START, parent, child, T), START)
        for index, view in enumerate(views):
            time = START + index * SECOND
            T = view.T_world_camera @ transforms.invert(T_BASE_LENS)
            for when in (time, time + SECOND // 100):
                bag.write("/tf", bag.transform(when + late, WORLD, BASE, T), when)
            bag.write(INFO, bag.camera(time, view.K, view.depth.shape[::-1]), time)
            bag.write(DEPTH, bag.image(time, view.depth, "32FC1"), time)
    return path


MOUNT, DRIVER = (BASE, LENS, T_BASE_LENS), ("camera_link", LENS, np.eye(4))
TF = (*TOPICS, "--tf", WORLD)


@pytest.mark.parametrize("fixed", [(MOUNT, DRIVER), (DRIVER, MOUNT)])
def test_of_two_parents_the_one_in_the_world_is_used_whatever_the_order(tmp_path, views, fixed):
    read = imported(tmp_path, tf_bag(tmp_path / "tf.bag", views, *fixed), *TF)
    for view, before in zip(read, views, strict=True):
        assert np.allclose(view.T_world_camera, before.T_world_camera, atol=1e-6)


def test_transforms_that_contradict_each_other_do_not_meet_or_have_another_clock(tmp_path, views, unfit):
    shifted = transforms.rigid(np.eye(3), (0.0, 0.0, 0.02))
    loop = [(BASE, "camera_link", T_BASE_LENS @ shifted), MOUNT, DRIVER]
    said = "frame 'optical' has two parents, 'base' and 'camera_link', that place it differently"
    for number, fixed in enumerate((loop, loop[::-1])):
        unfit(tf_bag(tmp_path / f"{number}.bag", views, *fixed), *TF, says=said)
    loop[0] = (BASE, "camera_link", T_BASE_LENS)
    assert len(imported(tmp_path, tf_bag(tmp_path / "same.bag", views, *loop), *TF)) == 3
    said = "no transform connects 'map' with 'optical': the roots are 'map' and 'camera_link'"
    unfit(tf_bag(tmp_path / "apart.bag", views, DRIVER), *TF, says=said)
    moved = tf_bag(tmp_path / "moved.bag", views, (BASE, LENS, T_BASE_LENS @ shifted), MOUNT)
    shutil.rmtree(tmp_path / "out")
    assert np.allclose(imported(tmp_path, moved, *TF)[0].T_world_camera, views[0].T_world_camera, atol=1e-6)
    said = "transforms of 'base' share no time: the former begin 3600.0 s earlier"
    unfit(tf_bag(tmp_path / "late.bag", views, MOUNT, late=3600 * SECOND), *TF, says=said)


def test_two_cameras_of_one_bag_and_two_recordings_of_one_scene(tmp_path, views, capsys, unfit):
    path, flags = tmp_path / "two.bag", []
    with BagFile(path) as bag:
        for number, view in enumerate(views[:2]):
            frame, depth, info = f"eye{number}", f"/{number}/depth", f"/{number}/info"
            flags += ["--depth", depth, "--info", info]
            bag.write("/tf_static", bag.transform(START, WORLD, frame, view.T_world_camera), START)
            for time in (START, START + SECOND):
                bag.write(info, bag.camera(time, view.K, view.depth.shape[::-1], frame=frame), time)
                bag.write(depth, bag.image(time + number, view.depth, "32FC1", frame=frame), time)
    document = summary(tmp_path, capsys, path, *flags, "--tf", WORLD)
    assert document["frames"] == 4
    both = read_recording(tmp_path / "out")
    unfit(path, *flags, says="has no camera poses, so it cannot be joined with others")
    unfit(path, *flags[:6], "--tf", WORLD, says="--info: is given for 1 of 2 cameras")
    for number in (0, 1):
        options = (*flags[4 * number : 4 * number + 4], "--tf", WORLD, "--out", tmp_path / f"eye{number}")
        assert run_command("import", path, *options) == 0
    alone = [str(tmp_path / f"eye{number}") for number in (0, 1)]
    joined = open_recording(alone[0], Config(), None, more=alone[1:])
    assert [view.name for view in joined] == ["eye0+eye1/000000", "eye0+eye1/000001"]
    for read in (both, joined):
        for view, before in zip(read, views[:2], strict=True):
            assert np.allclose(view.depth, before.depth, atol=0.0001)
            assert np.allclose(view.T_world_camera, before.T_world_camera, atol=1e-6)
    options = ("--out", tmp_path / "run", "--no-report", "--segmentation", "auto")
    assert run_command("extract", *alone, *options) == 0
    assert json.loads((tmp_path / "run/run.json").read_text())["options"]["more"] == alone[1:]


def depth_of(make):
    return {"depth": lambda bag, time: make(bag, time, np.full((120, 160), 90, np.uint8))}


def colour_of(columns, frame):
    rgb = np.zeros((120, 160 * columns, 3), np.uint8)
    return {"colour": lambda bag, time: bag.image(time, rgb, "rgb8", frame=frame)}


@pytest.mark.parametrize(
    ("odd", "said"),
    [
        (colour_of(2, LENS), "is not registered to colour (320×120 pixels, frame 'optical')"),
        (colour_of(1, "other"), "is not registered to colour (160×120 pixels, frame 'other')"),
        ({"K": np.zeros((3, 3))}, "K has focal lengths 0, 0"),
        ({"size": (320, 240)}, "(320×240 pixels, frame 'optical') differ from the depth images (160×120"),
        ({"frame": "infra"}, "(160×120 pixels, frame 'infra') differ from the depth images (160×120"),
        (depth_of(lambda b, t, d: b.image(t, d, "mono8")), "encoding 'mono8' is not supported"),
        (depth_of(lambda b, t, d: b.compressed(t, jpeg(d), "jpeg")), "its depth is compressed as 'jpeg'"),
        (depth_of(lambda b, t, d: b.compressed(t, b"", "16UC1; compressedDepth rvl")), "compressedDepth rvl"),
        (depth_of(lambda b, t, d: b.compressed(t, b"", "16UC1; compressedDepth png")), "usable: 1 broken"),
        (depth_of(lambda b, t, d: b.compressed(t, jpeg(d), "16UC1")), "images is usable: 1 broken"),
    ],
)
def test_images_and_cameras_that_do_not_fit_or_cannot_be_decoded(tmp_path, views, unfit, odd, said):
    colour = ("--rgb", RGB) if "colour" in odd else ()
    unfit(bag_of(tmp_path, views[:1], **odd), *TOPICS, *colour, says=said)


@EACH_KIND
def test_an_empty_bag(tmp_path, kind, unfit):
    unfit(bag_of(tmp_path, [], kind), *TOPICS, says="the bag has no messages")


@EACH_KIND
def test_a_bag_that_was_cut_off(tmp_path, views, kind, unfit):
    bag = bag_of(tmp_path, views, kind)
    (file,) = [bag] if bag.is_file() else [p for p in bag.iterdir() if p.suffix in (".db3", ".mcap")]
    whole = file.read_bytes()
    for share in (0.001, 0.3, 0.99):
        file.write_bytes(whole[: int(share * len(whole))])
        unfit(bag, *ALL, says="rosbags cannot read it (")


# Folders of the TUM RGB-D benchmark


def tum_folder(tmp_path, views, name="mine"):
    write_tum(tmp_path / name, views)
    return tmp_path / name


def camera_file(tmp_path, K):
    path = tmp_path / "camera.json"
    values = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "depth_scale": 0.2}
    path.write_text(json.dumps(values))
    return path


def test_a_folder_of_the_benchmark_becomes_the_views_it_holds(tmp_path, views):
    folder = tum_folder(tmp_path, views)
    recording = imported(tmp_path, folder, "--camera", camera_file(tmp_path, views[0].K))
    same_views(recording, views, atol=0.00011)


def test_lists_as_others_write_them_and_another_unit_of_depth(tmp_path, views, refused):
    folder = tum_folder(tmp_path, views)
    for name, first in (
        ("depth", "timestamp,filename"),
        ("rgb", ""),
        ("groundtruth", "#time x y z and more"),
    ):
        rows = (folder / f"{name}.txt").read_text().splitlines()[2:]
        lines = [first, *(f"{', '.join(row.split())}, 7" for row in rows)]
        (folder / f"{name}.txt").write_text("\n".join(lines))
    for path in (folder / "depth").iterdir():
        Image.fromarray((np.array(Image.open(path)) // 5).astype(np.uint16)).save(path)
    camera = camera_file(tmp_path, views[0].K)
    values = json.loads(camera.read_text())
    camera.write_text(json.dumps(values | {"depth_scale": 1.0}))
    same_views(imported(tmp_path, folder, "--camera", camera), views, atol=0.0011)
    camera.write_text(json.dumps(values | {"depth_scale": 1000.0}))
    refused("import", folder, "--camera", camera, names="camera.json", says="0.2 if 5000 are a metre")


@pytest.mark.parametrize(("number", "fx"), [(1, 517.3), (2, 520.9), (3, 535.4)])
def test_the_name_of_the_folder_says_which_camera(tmp_path, views, capsys, caplog, number, fx):
    view = views[0]
    depth, rgb = np.kron(view.depth, np.ones((4, 4))), np.kron(view.rgb, np.ones((4, 4, 1), np.uint8))
    large = replace(view, depth=depth, rgb=rgb, labels=None)
    folder, note = tum_folder(tmp_path, [large], f"rgbd_dataset_freiburg{number}_xyz"), "published camera"
    (read,) = imported(tmp_path, folder)
    assert read.K[0, 0] == fx
    assert f"{note} of freiburg{number}: fx {fx:g}" in capsys.readouterr().err
    with caplog.at_level("INFO"):
        open_recording(str(folder), Config(), None)
    assert note in caplog.text


def spoil(name, text):
    return lambda folder: (folder / name).write_bytes(text)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (spoil("depth.txt", b""), "has no depth images"),
        (spoil("depth.txt", b"noon depth/x.png\n"), "a row does not start with a time in seconds"),
        (spoil("depth.txt", b"1.0\n"), "'1.0' has 1 columns, not 2"),
        (spoil("depth.txt", b"nan depth/x.png\n"), "a row does not start with a time in seconds"),
        (spoil("depth.txt", b"1e999999999 depth/x.png\n"), "a row does not start with a time in seconds"),
        (spoil("groundtruth.txt", b"1e18 0 0 0 0 0 0 1\n"), "a row does not start with a time in seconds"),
        (spoil("depth.txt", b"\xff\xfe"), "depth.txt: cannot be read"),
        (spoil("groundtruth.txt", b"1.0 0 0 0 0 0 0 0\n"), "is not a pose"),
        (spoil("groundtruth.txt", b"1.0 0 0 0 0 0 0 one\n"), "is not a pose"),
        (spoil("groundtruth.txt", b"# none\n"), "none of its 3 depth images is usable: 3 no pose"),
        (spoil("rgb.txt", b"# none\n"), "3 no colour image at that time"),
        (
            spoil("rgb.txt", b"1305031000.0 rgb/x.png\n"),
            "colour images share no time: the former begin 102.2 s",
        ),
        (lambda folder: shutil.rmtree(folder / "depth"), "3 broken"),
    ],
)
def test_a_folder_that_is_broken(tmp_path, views, unfit, change, said):
    folder = tum_folder(tmp_path, views)
    change(folder)
    unfit(folder, "--camera", camera_file(tmp_path, views[0].K), says=said)


def test_a_camera_that_is_not_known_or_does_not_fit(tmp_path, views, unfit):
    folder = tum_folder(tmp_path, views)
    unfit(folder, says="name contains none of freiburg1, freiburg2, freiburg3")
    (tmp_path / "camera.json").write_text('{"fx": 500, "fy": 500, "cx": 320}')
    unfit(folder, "--camera", tmp_path / "camera.json", says="the key 'cy' is missing")
    unfit(tum_folder(tmp_path, views, "freiburg1"), says="its images (640×480 pixels")
    unfit(folder, *TOPICS, says="apply only to bags")


def test_a_world_that_lies_on_its_side_is_levelled_by_the_table(tmp_path, views, capsys):
    T = transforms.rigid(transforms.rotation_from_vector((1.4, 0.5, 0.0)), (0.3, -0.2, 1.0))
    folder = tum_folder(tmp_path, [replace(view, T_world_camera=T @ view.pose) for view in views])
    options = ("--camera", camera_file(tmp_path, views[0].K), "--level")
    levelled = list(imported(tmp_path, folder, *options))
    assert "to level the table" in capsys.readouterr().err
    for view, upright in zip(levelled, views, strict=True):
        assert np.rad2deg(transforms.angle_between(view.pose[2, :3], upright.pose[2, :3])) < 0.5
    before, after = (transforms.invert(a.pose) @ b.pose for a, b in (views[:2], levelled[:2]))
    assert np.allclose(before, after, atol=1e-5)


def flipped(number, view):
    return view.pose @ np.diag([1.0, -1.0, -1.0, 1.0])


def turned(number, view):
    R = transforms.rotation_from_vector((0.8 * number, 0.3 * number, 0.0))
    return transforms.rigid(R, (number, 0.0, 0.0)) @ view.pose


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (flipped, "look away from what they show: the camera axes are OpenGL's"),
        (turned, "1 of 3 views agree on which way is up"),
    ],
)
def test_where_views_do_not_agree_on_a_table_nothing_is_written(tmp_path, views, unfit, change, said):
    folder = tum_folder(tmp_path, [v.with_pose(change(n, v)) for n, v in enumerate(views)])
    unfit(folder, "--camera", camera_file(tmp_path, views[0].K), "--level", says=said)


# Which frames become views


def poses(positions):
    """Cameras along a line [m]."""
    return np.stack([transforms.rigid(np.eye(3), (x, 0.0, 0.0)) for x in positions])


def test_of_too_many_views_those_farthest_apart_stay():
    along = poses([*np.linspace(0.0, 2.0, 11), 10.0, 20.0])
    chosen = choose_views(np.arange(13) * 1.0, np.ones(13), along, RecordingConfig(max_views=3))
    assert chosen == ([0, 11, 12], {"more than max_views": 10})


@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.integers(1, 12))
@limits(max_examples=50, deadline=None)
def test_views_are_few_apart_and_every_frame_is_accounted_for(seed, count, most):
    rng = np.random.default_rng(seed)
    times = np.sort(rng.uniform(0.0, 10.0, count))
    walk = np.cumsum(rng.normal(0.0, 0.05, (count, 3)), axis=0)
    poses = np.array([transforms.rigid(transforms.random_rotation(rng), p) for p in walk]).reshape(-1, 4, 4)
    if seed % 2:
        poses[:, :3, :3] = np.eye(3)
    config = RecordingConfig(max_views=most)
    kept, others = choose_views(times, rng.uniform(0.5, 1.0, count), poses, config)
    assert len(kept) + sum(others.values()) == count
    assert 1 <= len(kept) <= most
    assert kept == sorted(set(kept))
    for k in kept:
        rest = poses[[j for j in kept if j != k]]
        moved = np.linalg.norm(rest[:, :3, 3] - poses[k, :3, 3], axis=1) > config.min_distance
        turns = Rotation.from_matrix(rest[:, :3, :3] @ poses[k, :3, :3].T) if len(rest) else []
        assert all(
            m or t.magnitude() > np.radians(config.min_angle) for m, t in zip(moved, turns, strict=True)
        )


# Frames over time


def tree_with(*links, gap=1.0):
    tree = TransformTree(gap)
    for parent, child, time, pose, *fixed in links:
        numbers = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat()]
        tree.add(parent, child, time, numbers, fixed=bool(fixed))
    return tree


@pytest.mark.parametrize("seed", range(5))
def test_chains_up_and_down_the_tree_multiply(seed):
    rng = np.random.default_rng(seed)
    A, B, C, D = (random_motion(rng) for _ in range(4))
    links = ("map", "odom", START, A), ("odom", "base", START, B), ("odom", "hand", START, D)
    tree = tree_with(*links, ("base", "eye", 0, C, True))
    assert np.allclose(tree.between("map", "eye", START), A @ B @ C)
    assert np.allclose(tree.between("eye", "map", START), np.linalg.inv(A @ B @ C))
    assert np.allclose(tree.between("hand", "eye", START), np.linalg.inv(D) @ B @ C)
    assert np.allclose(tree.between("odom", "odom", START), np.eye(4))


@pytest.mark.parametrize(("seed", "share"), enumerate((0.0, 0.1, 0.37, 0.5, 1.0)))
def test_between_two_poses_the_path_is_straight_and_the_turn_even(seed, share):
    rng = np.random.default_rng(seed)
    start = random_motion(rng)
    axis, angle, way = transforms.unit(rng.normal(size=3)), rng.uniform(0.0, 3.0), rng.normal(size=3)

    def after(part):
        R = start[:3, :3] @ transforms.rotation_from_vector(part * angle * axis)
        return transforms.rigid(R, start[:3, 3] + part * way)

    tree = tree_with(("map", "eye", START, start), ("map", "eye", START + SECOND // 2, after(1.0)))
    nanoseconds = round(share * (SECOND // 2))
    exact = after(nanoseconds / (SECOND // 2))
    assert np.allclose(tree.between("map", "eye", START + nanoseconds), exact, atol=1e-7)


def test_poses_may_come_in_any_order_and_the_last_of_a_time_counts():
    rng = np.random.default_rng(0)
    first, last, other = (random_motion(rng) for _ in range(3))
    tree = tree_with(
        ("map", "eye", START + SECOND, last), ("map", "eye", START, other), ("map", "eye", START, first)
    )
    assert np.allclose(tree.between("map", "eye", START), first)
    assert np.allclose(tree.between("map", "eye", START + SECOND), last)


@pytest.mark.parametrize("late", [-1, SECOND + 1, 3 * SECOND])
def test_no_pose_is_invented_outside_the_messages_or_across_a_gap(late):
    rng = np.random.default_rng(1)
    links = [("map", "eye", START + k * SECOND, random_motion(rng)) for k in (0, 1)]
    assert tree_with(*links).between("map", "eye", START + late) is None
    assert tree_with(*links, gap=1.0).between("map", "eye", START + SECOND // 2).shape == (4, 4)
    assert tree_with(*links, gap=0.9).between("map", "eye", START + SECOND // 2) is None


def test_a_frame_that_changes_its_parent_has_no_pose_in_between():
    rng = np.random.default_rng(3)
    tree = tree_with(
        ("map", "cup", START, random_motion(rng)), ("hand", "cup", START + SECOND, random_motion(rng))
    )
    assert tree.between("map", "cup", START).shape == (4, 4)
    for target in ("map", "hand"):
        assert tree.between(target, "cup", START + 1) is None


def test_frames_in_a_circle_and_frames_apart_are_refused():
    tree = tree_with(("a", "b", START, np.eye(4)), ("b", "a", START, np.eye(4)), ("c", "d", START, np.eye(4)))
    for target in ("c", "nowhere"):
        assert tree.between(target, "a", START) is None
    assert tree.frames == ["a", "b", "c", "d"]
