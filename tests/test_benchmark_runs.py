"""Runs of the benchmark that are interrupted, killed or lose workers: nothing is lost, nothing done twice."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import psutil
import pytest
from conftest import SMALL, run_command
from distributed import Client
from test_benchmark import QUICK, without_times

import caryatid
from caryatid.benchmark.episodes import Episode, Outcome, content_of, run_episode
from caryatid.benchmark.running import connect, run_on_cluster, run_on_worker
from caryatid.benchmark.store import RESULTS, ResultStore
from caryatid.benchmark.suites import SUITES, change_suite
from caryatid.errors import CaryatidError, InputError
from caryatid.runtime import fingerprint

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


# Workers of a cluster


class Cluster:
    """A scheduler of dask.distributed on a free port, with workers that can be killed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.processes: list[subprocess.Popen[bytes]] = []
        self.address = ""
        folder.mkdir()
        self.scheduler = self.start("scheduler", "--port=0", f"--scheduler-file={folder / 'address'}")
        while not self.address:
            assert self.scheduler.poll() is None, (folder / "0.log").read_text()
            time.sleep(0.05)
            with suppress(FileNotFoundError, json.JSONDecodeError):
                self.address = json.loads((folder / "address").read_text())["address"]

    def add_worker(self, threads: int = 1, code: Path | None = None) -> subprocess.Popen[bytes]:
        return self.start("worker", self.address, "--no-nanny", f"--nthreads={threads}", code=code)

    def start(self, what: str, *options: str, code: Path | None = None) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"distributed.cli.dask_{what}", "--host=127.0.0.1", "--no-dashboard"]
        paths = {"PYTHONPATH": str(code or Path(caryatid.__file__).parents[1])}
        paths["DASK_TEMPORARY_DIRECTORY"] = str(self.folder)
        with (self.folder / f"{len(self.processes)}.log").open("wb") as log:
            process = subprocess.Popen(
                [*command, *options], stdout=log, stderr=log, cwd=self.folder, env=os.environ | paths
            )
        self.processes.append(process)
        return process

    def end(self) -> None:
        for process in self.processes:
            process.kill()
            process.wait()


@pytest.fixture
def cluster(tmp_path):
    started = Cluster(tmp_path / "cluster")
    yield started
    started.end()


def test_a_run_that_loses_a_worker_is_complete_and_the_same(cluster, tmp_path, scene_file, monkeypatch):
    monkeypatch.chdir(scene_file.parents[1])
    folder = scene_file.parent.name
    suite = change_suite(SUITES["smoke"], planners=["support", "random"])
    suite = replace(suite, scenes=("tower", folder, "dense-99-1"), seeds=2, views=2)
    members = [replace(m, episode=replace(m.episode, settings=QUICK)) for m in suite.members()]
    cluster.add_worker(threads=2)
    victim = cluster.add_worker()
    lost: list[str] = []
    found: dict[Episode, Outcome] = {}
    with Client(cluster.address, set_as_default=False) as watch:
        watch.wait_for_workers(2)
        (name,) = (worker for worker, threads in watch.nthreads().items() if threads == 1)
        for episode, outcome in run_on_cluster([m.episode for m in members], cluster.address):
            assert episode not in found
            found[episode] = without_times(outcome)
            if not lost:
                lost.extend(watch.processing([name])[name])
                if lost:
                    victim.kill()
    assert lost
    assert victim.wait() < 0
    assert len(found) == len(members) == 12
    assert found == {m.episode: without_times(run_episode(m.episode)) for m in members}
    assert {e.scene for e, outcome in found.items() if outcome.error is not None} == {"dense-99-1"}


def test_the_command_runs_on_a_cluster(cluster, tmp_path, capsys):
    cluster.add_worker()
    command = ["benchmark", "--suite", "smoke", "--scenes", "tower", "--planner", "random", "--views", "1"]
    assert run_command(*command, "--scheduler", cluster.address, "--out", tmp_path / "out", "--json") == 0
    captured = capsys.readouterr()
    told = json.loads(captured.out)["suites"]["smoke"]
    assert (told["planned"], told["done"], told["failed"]) == (1, 1, 0)
    assert captured.err == ""


def test_workers_with_other_code_are_refused(cluster, tmp_path):
    other = shutil.copytree(
        Path(caryatid.__file__).parent, tmp_path / "other/caryatid", ignore=shutil.ignore_patterns("*.nb*")
    )
    with (other / "scene.py").open("a") as file:
        file.write("CHANGED = True\n")
    told: list[str] = []

    def tell(text: str) -> None:
        told.append(text)
        cluster.add_worker(code=other.parent)

    with pytest.raises(CaryatidError, match=r"^a worker runs other code .* install the same caryatid"):
        list(run_on_cluster([Episode("tower", settings=QUICK, views=1)], cluster.address, tell, 1.0))
    assert told == [f"no workers; start some: dask worker {cluster.address} --nthreads 1 --nworkers N"]


def test_a_worker_without_the_planner_is_refused():
    episode = Episode("tower", planner="above-first", plugin="abc", settings=QUICK, views=1)
    with pytest.raises(CaryatidError, match=r"lacks the package of planner above-first, .*; install it"):
        run_on_worker(episode, fingerprint())


def test_a_scheduler_that_goes_ends_the_run(cluster):
    episodes = [Episode("tower", settings=QUICK)]
    with pytest.raises(
        CaryatidError, match=r"the scheduler at tcp://\S+ has gone; finished episodes are kept"
    ):
        list(run_on_cluster(episodes, cluster.address, lambda text: cluster.scheduler.kill(), 1.0))


def test_an_address_where_nobody_answers_says_what_to_do():
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        for listening in (False, True):
            if listening:
                silent.listen()
            address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
            with pytest.raises(InputError, match=rf"{address}: no scheduler answers .* start one with"):
                connect(address, 0.5)
    for address in ("nowhere", "", "ftp://127.0.0.1:1"):
        with pytest.raises(InputError, match="no scheduler answers"):
            connect(address, 0.5)


def test_a_scene_folder_must_be_the_same_on_the_worker(scene_file, tmp_path):
    folder = Path(shutil.copytree(scene_file.parent, tmp_path / "two"))
    episode = Episode(str(folder), content=content_of(str(folder)), settings=QUICK, views=1)
    assert run_on_worker(episode, fingerprint()).error is None
    (folder / "scene.xml").write_text((folder / "scene.xml").read_text().replace("0.85", "0.86"))
    for path, told in ((f"{folder}/.", "its files have changed"), (f"{tmp_path}/away", f"{tmp_path}/away")):
        assert told in str(run_on_worker(replace(episode, scene=path), fingerprint()).error)
