"""Hostile input at every door, made up by hypothesis: `make fuzz`, or `make fuzz SEED=1` for other cases.

Every case damages something that is whole: a file, a setting or a request. The door must take it or refuse it
in one sentence, within 10 s and 2 GB. What fails becomes a small test beside the others of its reader.
"""

from __future__ import annotations

import base64
import copy
import faulthandler
import io
import json
import os
import random
import re
import shutil
import signal
import struct
import sys
import time
import zlib
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from arms import SLIDES, gantry
from bag_files import DEPTH, INFO, RGB, WORLD, write_bag, write_tum
from conftest import SMALL, SMALL_SENSOR, npy, pcd_text, run_command, write_view_files
from hypothesis import HealthCheck, given, note
from hypothesis import settings as limits
from hypothesis import strategies as st
from phone_files import write_nerfstudio, write_record3d, write_stray
from test_benchmark import fill
from test_service import body, serving

from caryatid.benchmark.store import RESULTS, ResultStore
from caryatid.cli import NOT_SAFE
from caryatid.config import Config, RecordingConfig, SessionConfig
from caryatid.config.settings import changed_settings, read_settings, write_settings
from caryatid.errors import CaryatidError, in_one_line
from caryatid.exports import ENDINGS, export_graph
from caryatid.geometry.shapes import Box
from caryatid.io import OpenOptions, graph_text, import_recording, read_graph, read_stored_cloud
from caryatid.io.mask_sources import mask_source
from caryatid.robots.reachability import read_reachability, sample_reachability, write_reachability
from caryatid.scene import Scene
from caryatid.sessions import Capture, Session
from caryatid.simulation.scenes import load_scene
from caryatid.simulation.setup import make_simulation
from caryatid.simulation.truth import read_truth
from caryatid.sources import open_recording
from caryatid.steps import read_run, read_steps

PATIENCE, MEMORY = 10.0, 2e9
"""Most that a case may take [s], and that the process may ever hold [bytes]."""
NUMBERS = (
    0, -1, 1, 2, 0.5, 1e-9, -1e-300, 1e-300, 255, 256, 65535, 65536, 1e6, 2**31, 2**63, 1e18, 10**20, 10**400,
    1e300, -1e300, float("nan"), float("inf"), -float("inf"),
)  # fmt: skip
WORDS = (
    "", "\n", "a\nb", "table", "world", "o0", "o1", "\ud800", "\0", "..", "../x", "/", "é", "<b>&\"'",
    "x" * 5000,
)  # fmt: skip
VALUES = (None, True, False, [], {}, [[]], [1, "a"], {"a": 1})


@contextmanager
def hostile():
    """One case: no fault, no hang, and bounded memory."""

    def hang(*_):
        raise AssertionError(f"still at work after {PATIENCE:.0f} s")

    clear = Path("/proc/self/clear_refs")
    clear.write_text("5")  # the peak of the memory counts from here
    began = time.monotonic()
    signal.signal(signal.SIGALRM, hang)
    signal.setitimer(signal.ITIMER_REAL, PATIENCE)
    faulthandler.dump_traceback_later(12 * PATIENCE, exit=True, file=sys.__stderr__)
    try:
        yield
    except CaryatidError as error:
        note(in_one_line(error))
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        faulthandler.cancel_dump_traceback_later()
    assert time.monotonic() - began < PATIENCE
    (peak,) = re.findall(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert int(peak) * 1024 < MEMORY


def cases(number):
    """Run a test with so many made-up generators of random numbers."""

    def decorated(test):
        options = {"deadline": None, "database": None, "suppress_health_check": list(HealthCheck)}
        made = st.integers(0, 2**32 - 1).map(random.Random)
        return limits(max_examples=number, **options)(given(rng=made)(test))

    return decorated


# Damage


def hostile_value(rng):
    return rng.choice((*NUMBERS, *NUMBERS, *WORDS, *VALUES))


def damaged_document(document, rng):
    """A document with one to three values replaced, taken out, doubled or nested."""
    document = copy.deepcopy(document)
    for _ in range(rng.randint(1, 3)):
        place, holder, key = document, None, None
        while isinstance(place, dict | list) and place and (holder is None or rng.random() < 0.8):
            holder, key = place, rng.choice([*place] if isinstance(place, dict) else range(len(place)))
            place = holder[key]
        if holder is None:
            return hostile_value(rng)
        how = rng.randrange(10)
        note(f"{key}: {how}")
        if how == 0:
            del holder[key]
        elif how == 1 and isinstance(holder, list):
            holder.insert(key, copy.deepcopy(place))
        elif how == 1:
            holder[str(hostile_value(rng))[:50]] = place
        elif how == 2:
            holder[key] = [place]
        elif how == 3 and isinstance(place, int | float) and abs(place) < 1e300:
            holder[key] = place * rng.choice((-1, 1e-3, 1e3, 1.01, 1e9))
        else:
            holder[key] = hostile_value(rng)
    return document


def damaged_text(text, rng):
    """A text with words replaced, or lines taken out, doubled or exchanged; rarely very deep."""
    for _ in range(rng.randint(1, 3)):
        how = rng.randrange(8)
        lines = text.split("\n")
        line, other = rng.randrange(len(lines)), rng.randrange(len(lines))
        if how == 0:
            del lines[line]
        elif how == 1:
            lines.insert(other, lines[line])
        elif how == 2:
            lines[line], lines[other] = lines[other], lines[line]
        elif how == 3 and rng.random() < 0.2:
            lines[line] += rng.choice(("[" * 5000, "{" * 5000, "<a>" * 5000, "(" * 5000))
        else:
            words = list(re.finditer(r"[^\s=<>\"',/\[\]{}()]+", lines[line]))
            if words:
                word, new = rng.choice(words), str(hostile_value(rng))
                lines[line] = lines[line][: word.start()] + new + lines[line][word.end() :]
        text = "\n".join(lines)
    return text


def damaged_bytes(content, rng):
    """Bytes cut off, changed, taken out or put in."""
    changed = bytearray(content)
    for _ in range(rng.randint(1, 4)):
        near = rng.random() < 0.5
        start = min(int(rng.expovariate(1 / 60)), len(changed)) if near else rng.randrange(len(changed) + 1)
        how = rng.randrange(6)
        if how == 0:
            del changed[start:]
        elif how == 1:
            del changed[start : start + rng.choice((1, 4, 100))]
        elif how == 2:
            changed[start:start] = rng.randbytes(rng.choice((1, 4, 100)))
        elif how == 3:
            ends = (b"\xff\xff\xff\x7f", b"\0\0\0\0", b"\xff" * 4, b"\0\0\0\x80")
            changed[start : start + 4] = rng.choice(ends)
        else:
            changed[start : start + 1] = rng.randbytes(1)
    return bytes(changed)


def damaged_png(content, rng):
    """A PNG whose header or chunks lie, with checksums that are right."""
    chunks, place = [], 8
    while place + 8 <= len(content):
        length = int.from_bytes(content[place : place + 4], "big")
        chunks.append((content[place + 4 : place + 8], content[place + 8 : place + 8 + length]))
        place += 12 + length
    which = rng.randrange(len(chunks))
    how = rng.randrange(5)
    if how == 0:
        del chunks[which]
    elif how == 1:
        chunks.insert(which, rng.choice(chunks))
    elif how == 2:
        width, height = (rng.choice((0, 1, 159, 8000, 9000, 2**31 - 1)) for _ in range(2))
        chunks[0] = (b"IHDR", struct.pack(">II", width, height) + chunks[0][1][8:])
    elif how == 3:
        form = bytes([rng.choice((1, 2, 8, 16)), rng.choice((0, 2, 3, 4, 6)), 0, 0, 0])
        chunks[0] = (b"IHDR", chunks[0][1][:8] + form)
    else:
        chunks[which] = (chunks[which][0], damaged_bytes(chunks[which][1], rng))
    packed = (struct.pack(">I", len(d)) + n + d + struct.pack(">I", zlib.crc32(n + d)) for n, d in chunks)
    return content[:8] + b"".join(packed)


def damaged_npy(content, rng):
    """Another array, or another header."""
    if rng.random() < 0.5:
        return damaged_bytes(content, rng)
    array = np.load(io.BytesIO(content), allow_pickle=False)
    shape = rng.choice(((0, 0), (1, 1), array.shape[::-1], (*array.shape, 1), (array.size,), ()))
    kind = rng.choice(("f2", "f4", "f8", "c8", "i1", "u2", "i8", "u8", "?", "U3", "S2"))
    return npy(np.resize(array, shape).astype(kind))


def damaged(name, content, rng):
    """The content of a file, damaged as its kind suggests, or as bytes."""
    kind = Path(name).suffix
    if not content or rng.random() < 0.2:
        return damaged_bytes(content, rng)
    if kind == ".json" or name == "metadata":
        return json.dumps(damaged_document(json.loads(content), rng)).encode()
    if kind == ".jsonl":
        lines = content.splitlines()
        which = rng.randrange(len(lines))
        lines[which] = json.dumps(damaged_document(json.loads(lines[which]), rng)).encode()
        return b"\n".join(lines) + b"\n"
    if kind == ".png":
        return damaged_png(content, rng)
    if kind == ".npy":
        return damaged_npy(content, rng)
    if kind in (".txt", ".csv", ".xml", ".toml", ".yaml"):
        return damaged_text(content.decode(), rng).encode(errors="surrogatepass")
    if kind in (".pcd", ".ply"):
        end = re.search(rb"^(DATA|end_header)\b.*\n", content, re.MULTILINE).end()
        if b"ascii" in content[:end] and rng.random() < 0.3:
            return damaged_text(content.decode(), rng).encode(errors="surrogatepass")
        header = damaged_text(content[:end].decode(), rng).encode(errors="surrogatepass")
        return header + content[end:]
    return damaged_bytes(content, rng)


@contextmanager
def one_damaged(folder, rng):
    """One file of a folder damaged, missing, a folder, or a link to itself; whole again afterwards."""
    file = rng.choice(sorted(p for p in folder.rglob("*") if p.is_file() and p.suffix != ".lock"))
    content, how = file.read_bytes(), rng.randrange(20)
    note(f"{file.relative_to(folder)}: {how}")
    file.unlink()
    if how == 1:
        file.mkdir()
    elif how == 2:
        file.symlink_to(file.name)
    elif how > 2:
        file.write_bytes(damaged(file.name, content, rng))
    try:
        yield
    finally:
        shutil.rmtree(file) if file.is_dir() and not file.is_symlink() else file.unlink(missing_ok=True)
        file.write_bytes(content)


# Doors that take a file or a folder

CONFIG = replace(Config(), sensor=SMALL_SENSOR)


def open_bop(folder):
    assert len(open_recording(str(folder), CONFIG, None)) > 0


def open_tum(folder):
    options = OpenOptions(camera_file=folder / "camera.json")
    import_recording(folder, folder.with_name("imported"), options, level=False, config=CONFIG)


def open_bag(folder):
    (bag,) = [p for p in folder.iterdir() if p.suffix == ".bag"] or [folder]
    options = OpenOptions(DEPTH, INFO, RGB, WORLD)
    import_recording(bag, folder.with_name("imported"), options, level=False, config=CONFIG)


def open_phone(folder):
    import_recording(folder, folder.with_name("imported"), level=False, config=CONFIG)


def open_clouds(folder):
    for file in sorted(folder.iterdir()):
        if file.suffix in (".pcd", ".ply"):
            read_stored_cloud(file, 2).to_cloud(CONFIG.cloud)


def open_mjcf(folder):
    scene = load_scene(folder)
    read_truth(folder / "gt.json")
    make_simulation(scene, CONFIG, noise="none", seed=0)


def open_graph(folder):
    graph = read_graph(folder / "graph.json")
    assert graph_text(graph)
    for ending in ENDINGS:
        try:
            export_graph(graph, folder.with_name(f"exported{ending}"))
        except CaryatidError as error:
            note(str(error))


def open_run(folder):
    run = read_run(folder)
    for view in run.views:
        view.load_labels()
    assert list(read_steps(run))


def open_settings(folder):
    config = read_settings(folder / "settings.toml", [])
    assert changed_settings(Config(), asdict(config), "again") == config


def open_session(folder):
    with Session.open(folder) as session:
        assert graph_text(session.graph)
        session.next()


def open_capture(folder):
    files = {"depth": folder / "depth.png", "labels": folder / "labels.png"}
    Capture.from_files(files, folder / "camera.json", SessionConfig()).decode(RecordingConfig().max_pixels)


def open_masks(folder):
    give = mask_source(str(folder), CONFIG)
    for name in ("image", "array"):
        give(replace(VIEW[0], name=name))


def open_store(folder):
    store = ResultStore(folder / RESULTS)
    for suite in store.suites:
        store.table(suite)


def open_arm(folder):
    read_reachability(folder / "arm.npz")


MORE = """
  <compiler angle="degree"/>
  <option timestep="0.002" gravity="0 0 -9.81" impratio="10" iterations="100" density="0"/>
  <size memory="1M"/>
  <default><geom density="600" friction="0.8 0.005 0.001" solref="0.02 1"/></default>
  <asset><hfield name="hills" nrow="9" ncol="9" size="1 1 0.1 0.1"/></asset>
  <worldbody>
    <geom name="ground" type="hfield" hfield="hills" pos="3 0 0"/>
    <flexcomp name="cloth" type="grid" count="3 3 1" spacing="0.05 0.05 0.05" pos="3 3 2" radius="0.01"/>
    <replicate count="2" offset="1 0 0"><geom size="0.1" pos="3 1 0"/></replicate>
"""
"""What a scene may have besides."""
VIEW: list = []
"""The first of the views."""


@pytest.fixture(scope="session")
def whole(tmp_path_factory, views, kept_recording, kept_run, scene_file):
    """A folder for each door, of files that it takes."""
    root = tmp_path_factory.mktemp("whole")
    VIEW[:] = views[:1]
    shutil.copytree(kept_recording, root / "bop")
    shutil.copytree(kept_run, root / "run")
    (root / "run/report.html").unlink()
    shutil.copytree(scene_file.parent, root / "mjcf")
    (root / "mjcf/scene.xml").write_text(scene_file.read_text().replace("<worldbody>", MORE))
    write_tum(root / "tum", views)
    K = views[0].K
    camera = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "depth_scale": 0.2}
    (root / "tum/camera.json").write_text(json.dumps(camera))
    for name in ("graph", "settings", "capture", "masks", "clouds", "arm", "bag1"):
        (root / name).mkdir()
    write_bag(root / "bag1/a.bag", views)
    write_bag(root / "bag2", views)
    write_bag(root / "mcap", views, "mcap")
    write_nerfstudio(root / "nerfstudio", views)
    write_record3d(root / "record3d", views)
    write_stray(root / "stray", views)
    shutil.copy(kept_run / "graph.json", root / "graph/graph.json")
    (root / "settings/settings.toml").write_text(write_settings(Config()))
    write_view_files(root / "capture", views[0])
    (root / "masks/image.png").write_bytes((root / "capture/labels.png").read_bytes())
    (root / "masks/array.npy").write_bytes(npy(views[0].labels))
    write_clouds(root / "clouds", views[0])
    reach = sample_reachability(gantry, SLIDES, 2000, np.random.default_rng(0))
    write_reachability(root / "arm/arm.npz", reach)
    fill(root / "store" / RESULTS)
    with Session.begin(root / "session") as session:
        session.add(views[0])
        session.add(views[1])
    return root


def write_clouds(folder, view):
    """A PCD of each encoding and two PLY files."""
    from pypcd4 import Encoding, PointCloud

    points, labels = view.points_camera[view.valid][::40], view.labels[view.valid][::40]
    (folder / "ascii.pcd").write_text(pcd_text(points, labels))
    cloud = PointCloud.from_xyzl_points(np.column_stack([points, labels]), label_type=np.uint32)
    cloud.save(folder / "binary.pcd", encoding=Encoding.BINARY)
    cloud.save(folder / "compressed.pcd", encoding=Encoding.BINARY_COMPRESSED)
    mesh = Box(np.eye(4), np.ones(3)).mesh(8)
    (folder / "ascii.ply").write_bytes(mesh.export(file_type="ply", encoding="ascii"))
    (folder / "binary.ply").write_bytes(mesh.export(file_type="ply"))


def door(name, open_, number):
    """A test of one door with so many cases."""

    @cases(number)
    def test(whole, rng):
        before = {p.name for p in whole.iterdir()}
        with one_damaged(whole / name, rng), hostile():
            open_(whole / name)
        for path in whole.iterdir():
            assert not path.name.startswith(".partial"), path
            if path.name not in before:
                shutil.rmtree(path) if path.is_dir() else path.unlink()

    return test


test_recordings = door("bop", open_bop, 500)
test_tum = door("tum", open_tum, 400)
test_bags_of_ros_1 = door("bag1", open_bag, 150)
test_bags_of_ros_2 = door("bag2", open_bag, 150)
test_bags_of_mcap = door("mcap", open_bag, 150)
test_nerfstudio = door("nerfstudio", open_phone, 300)
test_record3d = door("record3d", open_phone, 200)
test_stray_scanner = door("stray", open_phone, 200)
test_clouds = door("clouds", open_clouds, 600)
test_scenes = door("mjcf", open_mjcf, 700)
test_graphs = door("graph", open_graph, 600)
test_runs = door("run", open_run, 300)
test_settings_files = door("settings", open_settings, 500)
test_sessions = door("session", open_session, 200)
test_captures = door("capture", open_capture, 400)
test_masks = door("masks", open_masks, 200)
test_stores = door("store", open_store, 300)
test_arms = door("arm", open_arm, 200)


# Settings at work


@cases(600)
def test_settings_at_work(whole, views, rng):
    """Whatever settings are taken, views are taken or refused with them."""
    document = asdict(CONFIG)
    changed = copy.deepcopy(document)
    for _ in range(rng.randint(1, 2)):
        stage = rng.choice([*document])
        name = rng.choice([*document[stage]])
        value = document[stage][name]
        scaled = value * rng.choice((1e-3, 0.1, 10.0, 1e3)) if isinstance(value, float) else None
        changed[stage][name] = rng.choice((scaled, rng.choice(NUMBERS), hostile_value(rng)))
        note(f"{stage}.{name} = {changed[stage][name]!r}")
    with hostile():
        settings = changed_settings(Config(), changed, "settings")
        scene = Scene(settings, segmentation=rng.choice((None, "auto")))
        for view in views[:2]:
            scene.update(view)
        assert graph_text(scene.graph)


# HTTP


@pytest.fixture(scope="module")
def client(tmp_path_factory, views):
    with serving(tmp_path_factory.mktemp("service")) as client:
        client.post("/sessions", json={"name": "a"})
        client.post("/sessions/a/views", json=body(views[0]))
        yield client


@cases(600)
def test_requests(client, views, rng):
    reach = {"T_world_camera": [v.pose.tolist() for v in views], "path_length": [0.0, 1.0, 2.0]}
    options = {"name": "b", "seed": 1, "settings": {"fit": {"hypotheses": 3}}, "planner": "support"}
    requests = {"/sessions/a/views": body(views[1]), "/sessions/a/next": reach, "/sessions": options}
    page, document = rng.choice([*requests.items()])
    if rng.random() < 0.3 and "depth" in document:
        key = rng.choice(("depth", "labels"))
        content = base64.b64decode(document[key])
        kind = "a.png" if content.startswith(b"\x89PNG") else "a.npy"
        document[key] = base64.b64encode(damaged(kind, content, rng)).decode()
    else:
        document = damaged_document(document, rng)
    content = json.dumps(document).encode()
    if rng.random() < 0.1:
        content = damaged_bytes(content, rng)
    with hostile():
        answer = client.post(page, content=content, headers={"Content-Type": "application/json"})
        assert answer.status_code in (200, 201, 400, 404, 409, 413, 422), answer.text
        assert answer.status_code == 413 or answer.json()
        if answer.status_code == 201 and page.endswith("views"):
            assert client.delete("/sessions/a/views/last").status_code == 200
    if answer.status_code == 201 and page == "/sessions":
        shutil.rmtree(client.pool.folder / answer.json()["name"])
        client.pool._open.clear()


# Whole commands


@cases(200)
def test_commands(whole, tmp_path_factory, capsys, rng):
    """Status 0 and a whole run, or status 1, one line and nothing left behind; `order` may find none safe."""
    words = rng.choice(
        (
            ("extract", whole / "bop", "bop"), ("extract", whole / "clouds/binary.pcd", "clouds"),
            ("explore", whole / "bop", "bop"), ("explore", whole / "mjcf", "mjcf"),
            ("report", whole / "run", "run"), ("order", whole / "run", "run"),
        )
    )  # fmt: skip
    command, source, folder = words
    out = tmp_path_factory.mktemp("out") / "run"
    options = {
        "explore": ["--out", out, "--no-report", "--views", "2", *SMALL],
        "extract": ["--out", out, "--no-report"],
        "order": ["--set=rehearsal.draws=1"],
    }.get(command, [])
    with one_damaged(whole / folder, rng), hostile():
        capsys.readouterr()
        status = run_command(command, source, *options, "--quiet")
    said = capsys.readouterr().err
    assert "internal error" not in said
    assert status in ((0, 1, NOT_SAFE) if command == "order" else (0, 1))
    assert (said.count("\n"), said[:7]) == (1, "error: ") if status == 1 else said == ""
    assert os.listdir(out.parent) == (["run"] if out.exists() else [])
    if out.exists():
        assert status == 0
        assert read_run(out).views
    (whole / "run/report.html").unlink(missing_ok=True)
