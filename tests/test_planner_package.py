"""The example of a planner in a package of its own: found by its entry point, and it does what it says."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
from conftest import SMALL
from test_planners import CUBE, HOME, OPEN, state

from caryatid.geometry import transforms
from caryatid.planning.planners import ENTRY_POINTS

PACKAGE = Path(__file__).parents[1] / "examples" / "planner_package"
PROJECT = tomllib.loads((PACKAGE / "pyproject.toml").read_text())["project"]
((NAME, VALUE),) = PROJECT["entry-points"][ENTRY_POINTS].items()


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    """Environment of a process in which the package is installed: its metadata as pip writes it."""
    site = tmp_path_factory.mktemp("site")
    folder = site / f"{PROJECT['name'].replace('-', '_')}-{PROJECT['version']}.dist-info"
    folder.mkdir()
    name, version = PROJECT["name"], PROJECT["version"]
    (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    (folder / "entry_points.txt").write_text(f"[{ENTRY_POINTS}]\n{NAME} = {VALUE}\n")
    path = [str(site), str(PACKAGE / "src"), os.environ.get("PYTHONPATH", "")]
    return os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, path)), "COLUMNS": "200"}


def run(environment, *arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *map(str, arguments)]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)


@pytest.fixture
def planner(monkeypatch):
    monkeypatch.syspath_prepend(PACKAGE / "src")
    return EntryPoint(NAME, VALUE, ENTRY_POINTS).load()()


def test_the_command_line_explores_with_it(environment, tmp_path):
    options = ["--planner", NAME, "--views", 2, "--no-report", "--quiet", *SMALL]
    done = run(environment, "-m", "caryatid", "explore", "tower", "--out", tmp_path / "run", *options)
    assert done.returncode == 0, done.stderr
    assert "from above" in (tmp_path / "run/views/00/view.json").read_text()
    assert f'"planner": "{NAME}"' in (tmp_path / "run/run.json").read_text()


def test_it_is_made_by_its_name_and_listed_with_the_others(environment):
    code = (
        "from caryatid.planning.planners import make_planner\n"
        f"print(type(make_planner('{NAME}')).__name__)\n"
        "make_planner('no-such')"
    )
    done = run(environment, "-c", code)
    assert done.stdout.split() == [VALUE.split(":")[1]]
    assert NAME in done.stderr.splitlines()[-1]


def test_it_looks_from_above_and_then_all_around(planner):
    visited = HOME[None]
    for _ in range(4):
        decision = planner.plan(state([CUBE], visited=visited), np.random.default_rng(0))
        chosen = OPEN.directions[decision.index]
        np.testing.assert_array_equal(decision.T_world_camera, OPEN.T_world_camera[decision.index])
        visited = np.vstack([visited, chosen])
    assert visited[1, 2] == OPEN.directions[:, 2].max()
    flat = transforms.unit(np.delete(visited, 1, axis=0) * (1.0, 1.0, 0.0))
    apart = np.rad2deg(transforms.angle_between(flat[:, None], flat[None]))
    assert apart[~np.eye(len(flat), dtype=bool)].min() > 80.0


def test_the_readme_is_short_and_names_what_it_offers():
    text = (PACKAGE / "README.md").read_text()
    assert len(text.splitlines()) <= 15
    assert f"--planner {NAME}" in text
