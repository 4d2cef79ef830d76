"""Killed at any moment, a command leaves the older run or the new one, whole, and the next run cleans up."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import numpy as np
import pytest
from conftest import SMALL, run_command

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


@pytest.fixture(params=["explore", "extract"])
def words(request, tmp_path, scene_file, kept_recording):
    """A command that writes a run of two or three views; an older run of one seed is there."""
    command = ["explore", scene_file, "--views", 2, *SMALL] if request.param == "explore" else [
        "extract", kept_recording,
    ]  # fmt: skip
    command = [*map(str, command), "--out", str(tmp_path / "runs/run"), "--quiet"]
    assert run_command(*command, "--seed", 1) == 0
    return command


def seed_of(folder):
    """The seed of a run that can be read as a whole."""
    run = read_run(folder)
    assert len(run.views) == len(run.record["steps"])
    assert all(view.load_labels().any() for view in run.views)
    return run.record["seed"]


def check_next(folder, words):
    assert run_command(*words, "--seed", 3) == 0
    assert os.listdir(folder.parent) == [folder.name]
    assert seed_of(folder) == 3


@pytest.mark.parametrize(("steps", "found"), [(0, 1), (1, 1), (2, 2)])
def test_killed_while_it_gives_way(tmp_path, words, steps, found):
    folder = tmp_path / "runs/run"
    done = subprocess.run([sys.executable, "-c", DIES, str(steps), *words, "--seed", "2"], check=False)
    assert done.returncode == -9
    assert seed_of(folder) == found
    check_next(folder, words)


def test_killed_at_any_moment(tmp_path, words):
    folder, rng = tmp_path / "runs/run", np.random.default_rng(0)
    command = [sys.executable, "-m", "caryatid", *words, "--seed", "2"]
    began = time.monotonic()
    subprocess.run(command, check=True)
    took = time.monotonic() - began
    for moment in rng.uniform(0.3 * took, took, 6):
        process = subprocess.Popen(command)
        time.sleep(moment)
        process.kill()
        process.wait()
        assert not folder.exists() or seed_of(folder) == 2
    check_next(folder, words)
