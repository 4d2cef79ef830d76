"""A benchmark that is interrupted, killed or started twice: nothing is lost, nothing done twice."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing, suppress

import psutil
import pytest
from conftest import run_command
from test_benchmark_suites import without_times

from caryatid.benchmark.episodes import run_episode
from caryatid.benchmark.records import MEASURES
from caryatid.benchmark.store import ResultStore

SEEDS = 8
COMMAND = ["benchmark", "--suite", "smoke", "--scenes", "tower", "--planner", "random", "--views", "2"]
COMMAND += ["--jobs", "2"]


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
    path = folder / "results.sqlite"
    if not path.is_file():
        return {}
    with closing(sqlite3.connect(f"{path.as_uri()}?mode=ro", uri=True, timeout=30.0)) as database:
        assert database.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        if not database.execute("SELECT * FROM sqlite_master WHERE name = 'views'").fetchall():
            return {}
        keys = [key for (key,) in database.execute("SELECT key FROM episodes")]
        select = f"SELECT view, {', '.join(MEASURES)} FROM views WHERE key = ? ORDER BY view"
        return {key: database.execute(select, (key,)).fetchall() for key in keys}


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
    assert end(run, processes) == (130, "interrupted: what is done is kept, start again to go on\n")


def kill_worker(run, processes):
    workers(run)[0].kill()
    status, said = end(run, processes)
    assert status == 1
    assert said.startswith("error: a process was killed, perhaps for want of memory; what is done is kept:")
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
    assert not list(out.glob("*-run*"))
    with ResultStore(out / "results.sqlite") as store:
        records = store.records("smoke")
    assert len(records) == len(all_rows(out)) == SEEDS
    for record in records[::3]:
        assert without_times(record.outcome) == without_times(run_episode(record.member.episode))


def test_a_run_interrupted_as_it_starts_leaves_quietly(started):
    run = started()
    while len(workers(run)) < 2:
        assert run.poll() is None
        time.sleep(0.01)
    interrupt(run, psutil.Process(run.pid).children(recursive=True))


def test_a_second_run_on_a_folder_is_refused_and_reading_is_not(started, tmp_path, capsys):
    out = tmp_path / "out"
    run = started(seeds=200)
    done = len(wait_for_more(run, out, {}))
    assert run_command(*COMMAND, "--out", out) == 1
    assert "results.sqlite: another run is under way; wait for its end, or" in capsys.readouterr().err
    assert run_command("benchmark", "--out", out, "--json") == 0
    told = json.loads(capsys.readouterr().out)["suites"]["smoke"]
    assert done <= told["done"] < told["planned"] == 200
    assert run.poll() is None
    interrupt(run, psutil.Process(run.pid).children(recursive=True))
    assert not list(out.glob("*-run*"))
