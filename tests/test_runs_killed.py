"""Killed at any moment, a command leaves the older run or the new one, whole, and the next run cleans up."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import SMALL, run_command

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import durability
from durability import seed_of

from caryatid.cli.output import Output
from caryatid.io.graph_json import graph_text
from caryatid.steps import read_run

pytestmark = pytest.mark.slow

DIES = """
import os, shutil, signal, sys
from pathlib import Path
from caryatid.cli import main
from caryatid.io.staging import StagedFolder

left = int(sys.argv[1])

def or_die(step):
    def taken(*arguments, **options):
        global left
        if left == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        left -= 1
        return step(*arguments, **options)
    return taken

def publish(self):
    Path.rename, shutil.rmtree = or_die(Path.rename), or_die(shutil.rmtree)
    published(self)

published, StagedFolder.publish = StagedFolder.publish, publish
main(sys.argv[2:])
"""
"""A command that is killed in the middle of publishing: after so many of its steps."""


@pytest.mark.parametrize(("steps", "found"), [(0, 1), (1, 1), (2, 2)])
def test_killed_while_it_gives_way(tmp_path, scene_file, steps, found):
    folder = tmp_path / "runs/run"
    words = ["explore", str(scene_file), "--views", "2", *SMALL, "--out", str(folder), "--quiet"]
    assert run_command(*words, "--seed", 1) == 0
    done = subprocess.run([sys.executable, "-c", DIES, str(steps), *words, "--seed", "2"], check=False)
    assert done.returncode == -9
    assert seed_of(folder) == found
    assert run_command(*words, "--seed", 3) == 0
    assert os.listdir(folder.parent) == [folder.name]
    assert seed_of(folder) == 3


def test_killed_at_any_moment(tmp_path):
    tally = durability.kill_runs(tmp_path, durability.views_around("tower", 2), kills=12, seed=0)
    assert tally["killed"]


def test_however_a_clearing_is_killed_the_same_command_continues(tmp_path, scene_file, monkeypatch):
    """Keep what a kill would leave before each file appears, and before and after the result is printed."""
    folder, left = tmp_path / "run", []
    words = ["clear", scene_file, "--views", 2, "--risk", 0.5, "--set=rehearsal.draws=2", *SMALL, "--quiet"]

    def keep_before(owner, name):
        known = getattr(owner, name)

        def step(*arguments, **options):
            if folder.exists():
                left.append(shutil.copytree(folder, tmp_path / f"left-{len(left)}"))
            return known(*arguments, **options)

        monkeypatch.setattr(owner, name, step)

    keep_before(Path, "replace")
    keep_before(Output, "result")
    assert run_command(*words, "--out", folder) == 0
    monkeypatch.undo()
    whole, views = read_run(folder), 1
    for each in left:
        run = read_run(each)
        assert run.record["unfinished"]
        assert views <= len(run.views) <= views + 1
        views = len(run.views)
        assert graph_text(run.graph) == graph_text(run.views[-1].graph)
    assert views == len(whole.views) > 2
    assert "unfinished" not in whole.record
    assert run_command(*words, "--out", left[-1]) == 0
    again = read_run(left[-1])
    assert "unfinished" not in again.record
    for name in ("steps", "lifts"):  # the times in `steps` show that no view was taken again
        assert again.record[name] == whole.record[name]
