"""Every example runs, says something, and is short enough to read."""

from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("[0-9]*.py"))
MOSD = ROOT.parent / "shared/data/mosd"


def run_example(path, monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", [str(path), *map(str, arguments)])
    runpy.run_path(str(path), run_name="__main__")


def test_the_client_is_one_small_file_that_needs_nothing_but_python():
    text = (ROOT / "examples/robot_client.py").read_text()
    imported = re.findall(r"^ *(?:import|from) (\w+)", text, re.M)
    assert len(imported) > 5
    assert set(imported) <= sys.stdlib_module_names
    assert len(text.splitlines()) < 120


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs_and_says_what_it_found(path, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    run_example(path, monkeypatch)
    assert len(capsys.readouterr().out.splitlines()) >= 5
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short_typed_and_proves_what_it_says(path):
    text = path.read_text()
    assert len(text.splitlines()) < 60
    assert "-> None:" in text
    assert "assert " in text


@pytest.mark.skipif(not MOSD.is_dir(), reason="the recorded frames of ../shared are not here")
def test_the_real_frame_example_reads_a_recording(monkeypatch, capsys):
    folder = sorted(path for path in MOSD.iterdir() if path.is_dir())[0]
    run_example(EXAMPLES[2], monkeypatch, folder)
    said = capsys.readouterr().out
    assert folder.name in said
    assert "of the true graph: precision" in said
