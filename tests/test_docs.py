"""What README and docs show works: their Python runs, their commands do, their links lead somewhere."""

from __future__ import annotations

import importlib
import importlib.util
import json
import re
import shlex
import shutil
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arms import SLIDES, gantry
from bag_files import write_bag, write_tum
from conftest import SMALL, run_command, without_labels

import caryatid as ct
from caryatid.formats.images import png
from caryatid.formats.reachability_npz import write_reachability
from caryatid.reachability import sample_reachability
from caryatid.settings import write_settings

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
NAMED = [path.name for path in PAGES]


def blocks(path, language):
    return re.findall(rf"^```{language}\n(.*?)^```", path.read_text(), re.M | re.S)


@pytest.fixture
def workplace(tmp_path, monkeypatch, kept_recording, scene_file, points, views, write_pcd):
    """The files the pages speak of, in the current folder."""
    write_pcd(*points, name="table.pcd")
    write_bag(tmp_path / "pour.bag", views)
    shutil.copytree(kept_recording, tmp_path / "recording")
    shutil.copytree(scene_file.parent, tmp_path / "my-scene")
    write_reachability(
        tmp_path / "arm.npz", sample_reachability(gantry, SLIDES, 100_000, np.random.default_rng(0))
    )
    camera = {"K": views[0].K.tolist(), "T_world_camera": views[0].pose.tolist()}
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    (tmp_path / "depth.png").write_bytes(png(np.round(1e3 * views[0].depth).astype(np.uint16)))
    (tmp_path / "labels.png").write_bytes(png(views[0].labels.astype(np.uint16)))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("page", PAGES, ids=NAMED)
def test_python_blocks_run(page, workplace, capsys):
    for block in blocks(page, "python"):
        exec(compile(block, str(page), "exec"), {"__name__": "__main__"})


@pytest.fixture
def benchmark_folder(workplace, views):
    """A folder of the TUM RGB-D benchmark in the current folder, of 640×480 images."""
    large = [
        replace(v, depth=np.kron(v.depth, np.ones((4, 4))), rgb=np.kron(v.rgb, np.ones((4, 4, 1), np.uint8)))
        for v in without_labels(views)
    ]
    write_tum(workplace / "rgbd_dataset_freiburg1_desk", large)


def test_commands_run(workplace, benchmark_folder, capsys, monkeypatch):
    monkeypatch.setattr("caryatid.commands.benchmarking.run_all", lambda *arguments: None)
    monkeypatch.setattr("caryatid.commands.benchmarking.ClusterExecutor.check", lambda executor: None)
    lines = [line for page in PAGES for block in blocks(page, "sh") for line in block.splitlines()]
    commands = [shlex.split(line)[1:] for line in lines if line.startswith("caryatid ")]
    named = {
        "explore",
        "extract",
        "evaluate",
        "order",
        "dismantle",
        "import",
        "export",
        "benchmark",
        "config",
        "session",
    }
    assert {command[0] for command in commands} == named
    for command in commands:
        redirected = command[command.index(">") + 1] if ">" in command else None
        arguments = command[: command.index(">")] if redirected else command
        small = [*SMALL, "--views=2"] if arguments[0] in ("explore", "demo", "dismantle") else []
        capsys.readouterr()
        assert run_command(*arguments, *small) == 0, command
        if redirected:
            Path(redirected).write_text(capsys.readouterr().out)
    assert (workplace / "run/report.html").is_file()


@pytest.mark.parametrize("page", PAGES, ids=NAMED)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", page.read_text()):
        assert (page.parent / target).exists(), target


def test_the_settings_the_method_page_names_exist():
    settings = tomllib.loads(write_settings(ct.Config()))
    text = (ROOT / "docs/method.md").read_text()
    named = set(re.findall(r"`([a-z]+)\.([a-z_]+)(?: = [^`]+)?`", text))
    known = {(stage, name) for stage in settings for name in settings[stage]}
    assert len(named & known) > 5
    for module, name in named - known:
        home = importlib.import_module(f"caryatid.{module}")
        assert hasattr(home, name) or importlib.util.find_spec(f"{home.__name__}.{name}"), f"{module}.{name}"


def test_the_modules_the_method_page_names_exist():
    text = (ROOT / "docs/method.md").read_text()
    groups = re.findall(r"^(?:\*\*[^*]+\*\*|#+ [^(\n]+) \(([^)]+)\)", text, re.M)
    modules = [name for group in groups for name in re.findall(r"`([a-z_.]+)`", group)]
    assert len(modules) > 15
    for name in modules:
        assert importlib.import_module(f"caryatid.{name}")
