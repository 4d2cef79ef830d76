"""The notebooks of the documentation: they run, and show what they are stored with."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import nbformat
import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
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
def test_it_is_stored_with_what_it_shows_and_nothing_of_where_or_when(path):
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
def test_it_runs(path, executing):
    before = path.read_bytes()
    notebook = executing.execute(path, QUICK[path.stem])
    stored = nbformat.read(path, as_version=4)
    kinds = [[o.output_type for o in cell.get("outputs", [])] for cell in notebook.cells]
    assert kinds == [[o.output_type for o in cell.get("outputs", [])] for cell in stored.cells]
    assert all("<svg" in shown or "<dl" in shown for shown in html(notebook))
    assert path.read_bytes() == before
