"""Runs of the benchmark that are interrupted or killed: nothing is lost, nothing done twice."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import psutil
import pytest
from conftest import SMALL
from test_benchmark import QUICK, without_times

from caryatid.benchmark.episodes import Episode, content_of, run_episode
from caryatid.benchmark.store import RESULTS, ResultStore

pytestmark = pytest.mark.slow

SEEDS = 12
COMMAND = ["benchmark", "--suite", "smoke", "--scenes", "tower", "--planner", "random", "--views", "2"]
COMMAND += ["--jobs", "2", *SMALL]


@pytest.fixture
def started(tmp_path):
    """Start the command on a folder, as a terminal would: all its processes get what is typed.

    Ctrl-C is not ignored there, even where it is here, in the background of a shell.
    """
    runs: list[subprocess.Popen[str]] = []

    def start(seeds: int = SEEDS) -> subprocess.Popen[str]:
        options = [*COMMAND, f"--seeds={seeds}", f"--out={tmp_path / 'out'}"]
        command = [sys.executable, "-m", "caryatid", *options]
        run = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
        )
        runs.append(run)
        return run

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield start
    signal.signal(signal.SIGINT, before)
    for run in runs:
        with suppress(ProcessLookupError):
            os.killpg(run.pid, signal.SIGKILL)
        run.communicate()


def all_rows(folder):
    """What is stored, times too, by episode."""
    path = folder / RESULTS
    if not path.is_file() or not path.read_bytes().count(b"\n"):
        return {}
    with ResultStore(path) as store:
        return {key: outcome.rows for key, outcome in store.outcomes.items()}


def wait_for_more(run, folder, known):
    """Wait until an episode is done that was not."""
    while len(found := all_rows(folder)) == len(known):
        assert run.poll() is None, run.communicate()[0]
        time.sleep(0.02)
    return found


def end(run, processes):
    """Wait until a run and all its processes have ended; return its exit status and what it said."""
    said, _ = run.communicate(timeout=60)
    _, alive = psutil.wait_procs(processes, timeout=30)
    assert not alive
    assert "Traceback" not in said
    return run.returncode, said


def workers(run):
    """The processes of a run that run episodes; others come and go."""
    found = []
    for process in psutil.Process(run.pid).children():
        with suppress(psutil.NoSuchProcess):
            if "spawn_main" in " ".join(process.cmdline()):
                found.append(process)
    return found


def interrupt(run, processes):
    os.killpg(run.pid, signal.SIGINT)
    status, said = end(run, processes)
    assert status == 130
    assert said.endswith("interrupted: finished episodes are kept; run the same command to continue\n")


def kill_worker(run, processes):
    workers(run)[0].kill()
    status, said = end(run, processes)
    assert status == 1
    assert said.startswith(
        "error: a process was killed, perhaps for lack of memory; finished episodes are kept:"
    )
    assert said.count("\n") == 1


def kill(run, processes):
    run.kill()
    assert end(run, processes)[0] == -signal.SIGKILL


def test_however_a_run_ends_the_next_one_goes_on(started, tmp_path):
    out = tmp_path / "out"
    known = {}
    for stop in (interrupt, kill_worker, kill):
        run = started()
        assert known.items() < wait_for_more(run, out, known).items()
        stop(run, psutil.Process(run.pid).children(recursive=True))
        found = all_rows(out)
        assert known.items() < found.items()
        known = found
    assert all(len(rows) == 2 for rows in known.values())
    assert len(known) < SEEDS
    status, said = end(started(), ())
    assert status == 0
    assert said.startswith(f"smoke: {SEEDS} of {SEEDS} episodes\n")
    assert known.items() < all_rows(out).items()
    keys = [line["key"] for line in map(json.loads, (out / RESULTS).open()) if "key" in line]
    assert len(keys) == len(set(keys)) == SEEDS
    with ResultStore(out / RESULTS) as store:
        assert len(store.outcomes) == len(store.suites["smoke"]) == SEEDS
        for member in store.suites["smoke"][::5]:
            stored = store.outcomes[member.episode.key(store.about["fingerprint"])]
            assert without_times(stored) == without_times(run_episode(member.episode))


def test_a_scene_folder_must_be_the_same_as_when_it_was_planned(scene_file, tmp_path):
    folder = Path(shutil.copytree(scene_file.parent, tmp_path / "two"))
    episode = Episode(str(folder), content=content_of(str(folder)), settings=QUICK, views=1)
    assert run_episode(episode).error is None
    (folder / "scene.xml").write_text((folder / "scene.xml").read_text().replace("0.85", "0.86"))
    for path, told in ((f"{folder}/.", "its files have changed"), (f"{tmp_path}/away", f"{tmp_path}/away")):
        assert told in str(run_episode(replace(episode, scene=path)).error)
