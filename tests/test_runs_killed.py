"""Killed at any moment, a command leaves the older run or the new one, whole, and the next run cleans up."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import SMALL, run_command

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import durability
from durability import seed_of

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
