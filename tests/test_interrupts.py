"""Ctrl-C at many moments: the command ends with 130, and what was done so far is a whole run."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import psutil
import pytest
from conftest import SMALL, run_command

from caryatid.steps import read_run

pytestmark = pytest.mark.slow


class Command:
    """A command in a process of its own, in which Ctrl-C is what it is in a shell."""

    def __init__(self, *words, on_interrupt=signal.SIG_DFL):
        self._process = subprocess.Popen(
            [sys.executable, "-m", "caryatid", *map(str, words)],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, on_interrupt),
        )  # fmt: skip

    def wait_for(self, text):
        """Read what it says until some text comes."""
        for line in self._process.stderr:
            if text in line:
                return
        pytest.fail(f"it ended without saying {text!r}")

    def kill(self):
        """End it at once."""
        self._process.kill()
        self._process.communicate(timeout=60)

    def interrupt(self, number=signal.SIGINT):
        """Press Ctrl-C, or send another signal; status, stdout and the last line of stderr."""
        os.killpg(self._process.pid, number)
        out, err = self._process.communicate(timeout=60)
        assert "Traceback" not in err
        return self._process.returncode, out, (err.splitlines() or [""])[-1]


def whole(folder, views):
    """The run that was kept, with nothing half-written beside it."""
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]
    run = read_run(folder)
    assert run.record["interrupted"] is True
    assert views <= len(run.views) == len(run.record["steps"])
    assert (folder / "graph.json").read_bytes() == (
        folder / f"views/{len(run.views) - 1:02d}/graph.json"
    ).read_bytes()
    assert all(view.load_labels().any() for view in run.views)
    return run


@pytest.mark.parametrize(("moment", "number"), [("view 1:", signal.SIGINT), ("view 3:", signal.SIGTERM)])
def test_an_exploration_keeps_its_views(tmp_path, scene_file, moment, number):
    folder = tmp_path / "runs" / "run"
    words = ["explore", scene_file, "--out", folder, "--no-early-stop", *SMALL]
    assert run_command(*words, "--views", 1, "--quiet") == 0, "an older run, which gives way to what is kept"
    command = Command(*words, "--views", 50)
    command.wait_for(moment)
    status, out, told = command.interrupt(number)
    assert (status, out) == (130, "")
    run = whole(folder, 3 if moment == "view 3:" else 1)
    count = "1 view is" if len(run.views) == 1 else f"{len(run.views)} views are"
    assert told == f"interrupted: {count} kept in {folder}; `caryatid report {folder}` writes the report"
    assert len(run.record["scores"]) == len(run.views)


def test_a_clearing_keeps_its_views(tmp_path, scene_file):
    command = Command("clear", scene_file, "--out", tmp_path / "run", *SMALL)
    command.wait_for("view 2:")
    status, out, told = command.interrupt()
    assert (status, out) == (130, "")
    assert f"views are kept in {tmp_path / 'run'}; `caryatid report" in told


def test_what_reads_only_ends_at_once_and_leaves_nothing(tmp_path, scene_file):
    assert run_command("explore", scene_file, "--out", tmp_path / "run", "--views", 1, *SMALL, "--quiet") == 0
    before = sorted(tmp_path.rglob("*"))
    command = Command("order", tmp_path / "run", "--set", "rehearsal.draws=20000", "--risk", 0.00003)
    while not any("mujoco" in each.path for each in psutil.Process(command._process.pid).memory_maps()):
        time.sleep(0.1)
    time.sleep(1.0)
    assert command.interrupt() == (130, "", "interrupted: nothing was written")
    assert sorted(tmp_path.rglob("*")) == before


def test_two_interrupts_end_it_too(tmp_path, scene_file):
    words = ["explore", scene_file, "--out", tmp_path / "run", "--views", 50, "--no-early-stop", *SMALL]
    command = Command(*words)
    command.wait_for("view 2:")
    os.killpg(command._process.pid, signal.SIGINT)
    assert command.interrupt()[0] == 130
    assert [path.name for path in tmp_path.iterdir() if path.name != "run"] == []


def test_a_command_in_the_background_goes_on(tmp_path, scene_file):
    """A shell that starts it with & lets it ignore Ctrl-C, which is meant for another."""
    words = ["explore", scene_file, "--out", tmp_path / "run", "--views", 2, "--no-early-stop", *SMALL]
    command = Command(*words, on_interrupt=signal.SIG_IGN)
    command.wait_for("view 1:")
    assert command.interrupt()[0] == 0
    assert len(read_run(tmp_path / "run").views) == 2
