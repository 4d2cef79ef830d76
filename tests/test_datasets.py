"""An input format is one Dataset: a package outside caryatid adds one, and every command reads it."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import run_command

from caryatid.errors import InputError
from caryatid.io import open_dataset, read_recording
from caryatid.steps import read_run

FORMAT = """
from functools import partial

import numpy as np

from caryatid import View
from caryatid.io import Dataset, Frame


def recognises(path):
    return (path / "frames.npzs").is_file()


def load(path):
    with np.load(path) as members:
        arrays = {key: members[key] for key in ("depth", "K", "T_world_camera", "labels")}
    return View(**arrays, name=path.name)


def open_dataset(path, config, options):
    files = sorted(path.glob("*.npz"))
    poses = [np.load(file)["T_world_camera"] for file in files]
    frames = [
        Frame(file.name, n, partial(load, file), T, time=10**9 * n, has_labels=True)
        for n, (file, T) in enumerate(zip(files, poses))
    ]
    return Dataset(path, frames)
"""


@pytest.fixture
def package(tmp_path, monkeypatch):
    """An installed package that offers the format."""
    site = tmp_path / "site"
    about = site / "elsewhere-1.0.dist-info"
    about.mkdir(parents=True)
    (site / "elsewhere_format.py").write_text(FORMAT)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: elsewhere\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[caryatid.datasets]\nnpzs = elsewhere_format\n")
    monkeypatch.syspath_prepend(site)


@pytest.fixture
def folder(tmp_path, views):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/frames.npzs").touch()
    for number, view in enumerate(views):
        members = {"depth": view.depth, "K": view.K, "T_world_camera": view.pose, "labels": view.labels}
        np.savez(tmp_path / f"mine/{number}.npz", **members)
    return tmp_path / "mine"


def test_a_format_of_another_package_is_extracted_from_and_imported(
    tmp_path, package, folder, recording, views
):
    assert open_dataset(folder).has_poses
    for source, run in ((folder, "a"), (recording, "b")):
        assert run_command("extract", source, "--out", tmp_path / run, "--quiet", "--no-report") == 0
    found, expected = (read_run(tmp_path / run).graph for run in ("a", "b"))
    assert [s.pair for s in found.supports] == [s.pair for s in expected.supports]
    assert run_command("import", folder, "--out", tmp_path / "out") == 0
    for view, original in zip(read_recording(tmp_path / "out"), views, strict=True):
        assert np.allclose(view.depth, original.depth, atol=1e-4)
        assert np.array_equal(view.labels, original.labels)


def test_without_the_package_the_format_is_not_known(folder, monkeypatch):
    with pytest.raises(InputError, match="unknown format"):
        open_dataset(folder)
    with pytest.raises(InputError, match="no such file"):
        open_dataset(folder / "nowhere")
