"""Examples and notebooks run; examples say something and prove it, notebooks are stored as they show."""

from __future__ import annotations

import importlib.util
import re
import runpy
import sys
from pathlib import Path

import nbformat
import numpy as np
import pytest

from caryatid.config.settings import read_settings

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("[0-9]*.py"))
SENSORS = sorted((ROOT / "examples/sensors").glob("*.toml"))
MOSD = ROOT.parent / "shared/data/mosd"


def run_example(path, monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", [str(path), *map(str, arguments)])
    runpy.run_path(str(path), run_name="__main__")


def test_the_client_is_one_small_file_that_needs_nothing_but_python():
    text = (ROOT / "examples/robot_client.py").read_text()
    imported = re.findall(r"^ *(?:import|from) (\w+)", text, re.M)
    assert len(imported) > 5
    assert set(imported) <= sys.stdlib_module_names
    assert len(text.splitlines()) < 130


@pytest.mark.parametrize(
    "path", sorted((ROOT / "examples/sensors").glob("*.toml")), ids=lambda path: path.stem
)
def test_settings_of_a_sensor_agree_with_each_other(path):
    config = read_settings(path, ())
    assert config.cloud.min_depth == config.noise.range[0]
    half = np.degrees(np.arctan(min(config.sensor.width, config.sensor.height) / 2.0 / config.sensor.focal))
    assert 0.9 * half <= config.active.view_cone <= 1.5 * half


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs_and_says_what_it_found(path, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    run_example(path, monkeypatch)
    assert len(capsys.readouterr().out.splitlines()) >= 5
    assert not list(tmp_path.iterdir())
    assert "assert " in path.read_text()
    assert len(path.read_text().splitlines()) < 60


@pytest.mark.skipif(not MOSD.is_dir(), reason="the recorded frames of ../shared are not here")
def test_the_real_frame_example_reads_a_recording(monkeypatch, capsys):
    folder = sorted(path for path in MOSD.iterdir() if path.is_dir())[0]
    run_example(EXAMPLES[2], monkeypatch, folder)
    said = capsys.readouterr().out
    assert folder.name in said
    assert "of the true graph: precision" in said


# Notebooks

NOTEBOOKS = sorted((ROOT / "docs/notebooks").glob("*.ipynb"))
NAMED = [path.stem for path in NOTEBOOKS]
QUICK = {
    "from-a-frame-to-a-graph": {"SCENE": "tower"},
    "own-planner": {"SCENES": ("hidden_stack",), "VIEWS": 2, "SEEDS": (0,)},
}
"""Small work for each: as long as one exploration takes."""


@pytest.fixture(scope="module")
def executing():
    spec = importlib.util.spec_from_file_location("execute", ROOT / "docs/notebooks/execute.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def outputs(notebook):
    return [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]


def html(notebook):
    return [o.data["text/html"] for o in outputs(notebook) if "text/html" in o.get("data", {})]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=NAMED)
def test_a_notebook_is_stored_with_what_it_shows_and_nothing_of_where_or_when(path):
    text, notebook = path.read_text(), nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert re.match(r"# \w", notebook.cells[0].source)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    assert not [o for o in outputs(notebook) if o.output_type == "error" or o.get("name") == "stderr"]
    assert sum(bool(cell.outputs) for cell in code) >= 3
    assert len(text) < 500_000
    assert not re.search(r'/(tmp|home|root|Users)/|"execution": {', text)
    assert set(notebook.metadata) == {"kernelspec", "language_info"}
    for target in re.findall(r"\]\((?!https?:)([^)#]+)\)", " ".join(cell.source for cell in notebook.cells)):
        assert (path.parent / target).exists(), target


@pytest.mark.parametrize("path", NOTEBOOKS, ids=NAMED)
def test_a_notebook_runs(path, executing):
    before = path.read_bytes()
    notebook = executing.execute(path, QUICK[path.stem])
    stored = nbformat.read(path, as_version=4)
    kinds = [[o.output_type for o in cell.get("outputs", [])] for cell in notebook.cells]
    assert kinds == [[o.output_type for o in cell.get("outputs", [])] for cell in stored.cells]
    assert all("<svg" in shown or "<dl" in shown for shown in html(notebook))
    assert path.read_bytes() == before
