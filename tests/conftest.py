"""Small scenes and recordings, made for every test that changes them."""

from __future__ import annotations

import io
import json
import logging
import os
import shutil
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

# OpenBLAS picks its kernels by processor, and their last bits decide ties between the axes of a box, for one.
# Golden runs are equal where the kernels are; this has to be set before NumPy is loaded.
os.environ.setdefault("OPENBLAS_CORETYPE", "Haswell")

import numba
import numpy as np
import pytest
from browser import chromium

from caryatid import cli
from caryatid.config import Config, SensorConfig
from caryatid.errors import InputError
from caryatid.exploration import Step
from caryatid.geometry import transforms
from caryatid.io import write_recording
from caryatid.io.images import png
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.sensing.views import Cloud
from caryatid.simulation.camera import SimulatedCamera
from caryatid.simulation.scenes import load_scene
from caryatid.simulation.truth import ground_truth, write_truth
from caryatid.viz.report import find_chromium

if "PYTEST_XDIST_WORKER" in os.environ:
    # The workers share the cores: threads that wait for one that is taken hold up every parallel loop.
    numba.set_num_threads(1)

# Tests ask whether something unusual was said; a command in the same process sets the level of its loggers.
logging.getLogger("caryatid.progress").setLevel(logging.WARNING)

SMALL_SENSOR = SensorConfig(width=160, height=120, focal=131.25)
"""A quarter of the usual image: what tests of the commands need, in a tenth of the time."""

SMALL = [
    f"--set=sensor.width={SMALL_SENSOR.width}",
    f"--set=sensor.height={SMALL_SENSOR.height}",
    f"--set=sensor.focal={SMALL_SENSOR.focal}",
]

TWO_ON_A_TABLE = """
<mujoco>
  <worldbody>
    <body name="table" pos="0 0 0.35">
      <geom type="box" size="0.4 0.5 0.35"/>
    </body>
    <body name="crate" pos="0 0 0.75">
      <freejoint/>
      <geom type="box" size="0.08 0.09 0.05"/>
    </body>
    <body name="can" pos="0.01 0 0.85">
      <freejoint/>
      <geom type="cylinder" size="0.035 0.05"/>
    </body>
  </worldbody>
</mujoco>
"""
"""The table holds a crate, label 1, and the crate a can, label 2."""


def capture(scene_file: Path, azimuths_deg: tuple[float, ...]):
    """Small noise-free views of a scene from around the table, 40° up."""
    camera = SimulatedCamera(load_scene(scene_file), sensor=SMALL_SENSOR)
    centre_world = np.array([0.0, 0.0, 0.7])
    views = []
    for azimuth in np.radians(azimuths_deg):
        up, out = np.sin(np.radians(40.0)), np.cos(np.radians(40.0))
        eye_world = centre_world + 1.2 * np.array([out * np.cos(azimuth), out * np.sin(azimuth), up])
        view = camera.capture(transforms.look_at(eye_world, centre_world))
        views.append(replace(view, normals_camera=None))
    return views


def npy(array: np.ndarray, **options) -> bytes:
    """The content of a .npy file."""
    file = io.BytesIO()
    np.save(file, array, **options)
    return file.getvalue()


def write_view_files(folder: Path, view, **camera) -> None:
    """`depth.png` in units of 0.1 mm, `labels.png` and `camera.json` of a view."""
    (folder / "depth.png").write_bytes(png(np.round(1e4 * view.depth).astype(np.uint16)))
    (folder / "labels.png").write_bytes(png(view.labels.astype(np.uint8)))
    known = {"K": view.K.tolist(), "T_world_camera": view.pose.tolist(), "depth_scale": 0.1}
    (folder / "camera.json").write_text(json.dumps(known | camera))


def wall_of(view):
    """A view of nothing but a wall 1 m ahead, by the camera of another view."""
    depth, nothing = np.ones_like(view.depth), np.zeros_like(view.labels)
    away = transforms.look_at((-1.2, 0.0, 1.2), (-2.0, 0.0, 1.2))
    return replace(view, depth=depth, labels=nothing, normals_camera=None, T_world_camera=away)


def without_poses(views):
    return [replace(view, T_world_camera=None) for view in views]


def without_labels(views):
    return [replace(view, labels=None) for view in views]


def step_of(graph, labels, name="a") -> Step:
    """A step of which only the graph and the labels matter."""
    none = np.zeros((0, 3))
    sphere, cloud = ViewSphere(np.zeros(3), 1.0, none), Cloud(none, none)
    return Step(0, name, None, labels, graph, cloud, sphere, none, None, None, {}, 0.0, 0.0, None)


@contextmanager
def refusal(*said: object):
    """Demand an `InputError` in one line that says all of this, and what to do."""
    with pytest.raises(InputError) as caught:
        yield
    message = str(caught.value)
    assert "\n" not in message
    assert caught.value.remedy
    for text in said:
        assert str(text) in message


def run_command(*arguments: object) -> int:
    """Run one command in this process, as the shell would, and return its exit status."""
    try:
        return cli.main([str(a) for a in arguments])
    except SystemExit as stop:
        return int(stop.code or 0)


@pytest.fixture(scope="session")
def browser():
    """Chromium, as playwright gives it."""
    if find_chromium() is None:
        if os.environ.get("CI"):
            pytest.fail("there is no Chromium: `make chromium` installs it")
        pytest.skip("there is no Chromium")
    pytest.importorskip("playwright.sync_api")
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="session")
def scene_file(tmp_path_factory) -> Path:
    """`scene.xml` of two objects on a table, with its gt.json."""
    folder = tmp_path_factory.mktemp("scenes") / "two"
    folder.mkdir()
    path = folder / "scene.xml"
    path.write_text(TWO_ON_A_TABLE)
    write_truth(ground_truth(load_scene(path)), folder / "gt.json")
    return path


@pytest.fixture(scope="session")
def views(scene_file):
    """Three views of the two objects, with poses and labels."""
    return capture(scene_file, (180.0, 60.0, -60.0))


@pytest.fixture(scope="session")
def kept_recording(tmp_path_factory, views) -> Path:
    folder = tmp_path_factory.mktemp("recordings") / "two"
    write_recording(folder, views)
    return folder


@pytest.fixture(scope="session")
def kept_run(tmp_path_factory, scene_file) -> Path:
    """A run of two views of the two objects, with a report; not to be changed."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    words = ("--out", folder, "--views", 2, "--noise", "none", "--seed", 5)
    assert run_command("explore", scene_file, *words, *SMALL) == 0
    return folder


@pytest.fixture
def recording(tmp_path, kept_recording) -> Path:
    """A recording of three frames with poses and masks, to be changed at will."""
    return Path(shutil.copytree(kept_recording, tmp_path / "recording"))


@pytest.fixture
def single(tmp_path, views) -> Path:
    """A recording of one frame, with masks and without a pose."""
    write_recording(tmp_path / "single", without_poses(views[:1]))
    return tmp_path / "single"


@pytest.fixture(scope="session")
def points(views):
    """Points (N, 3) of the first view in the camera's frame [m], and their labels (N,)."""
    seen = views[0].valid
    return views[0].points_camera[seen], views[0].labels[seen]


def pcd_text(points, labels=None) -> str:
    """An ascii PCD."""
    table, count = points if labels is None else np.column_stack([points, labels]), len(points)
    label = "" if labels is None else " label"
    header = (
        f"VERSION .7\nFIELDS x y z{label}\nSIZE 4 4 4{' 4' if label else ''}\n"
        f"TYPE F F F{' U' if label else ''}\nCOUNT 1 1 1{' 1' if label else ''}\n"
        f"WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA ascii\n"
    )
    return header + "".join(" ".join(f"{v:.6g}" for v in row) + "\n" for row in table)


@pytest.fixture
def write_pcd(tmp_path):
    """Write an ascii PCD, and return its path."""

    def write(*cloud):
        (tmp_path / "cloud.pcd").write_text(pcd_text(*cloud))
        return tmp_path / "cloud.pcd"

    return write


@pytest.fixture
def refused(tmp_path, capsys):
    """Run a command that must fail in one line that names its source, and leave nothing behind."""

    def listed():
        return {p: os.listdir(p) for p in [tmp_path, *tmp_path.rglob("*")] if p.is_dir()}

    def run(command, source, *options, says, names=None):
        before = listed()
        capsys.readouterr()
        assert run_command(command, source, "--out", tmp_path / "runs/run", *options) == 1
        said = capsys.readouterr()
        assert (said.out, said.err.count("\n")) == ("", 1)
        assert said.err.startswith("error: ")
        assert "fault in caryatid" not in said.err
        assert str(source if names is None else names) in said.err
        assert says in said.err
        assert listed() == before, "something was left behind"
        return said.err

    return run


@pytest.fixture(scope="session")
def settings() -> Config:
    """The settings with the small sensor."""
    return replace(Config(), sensor=SMALL_SENSOR)
