"""The benchmark on a cluster: a scheduler and its workers as processes of this machine."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import run_command
from distributed import Client
from test_benchmark_suites import QUICK, without_times

import caryatid
from caryatid.benchmark.cluster import ClusterExecutor, run_on_worker
from caryatid.benchmark.episodes import run_episode
from caryatid.benchmark.records import Episode, Outcome
from caryatid.benchmark.running import run_all
from caryatid.benchmark.scenes import content_of
from caryatid.benchmark.store import ResultStore
from caryatid.benchmark.suites import find_suite
from caryatid.benchmark.variants import with_planners
from caryatid.errors import CaryatidError, InputError
from caryatid.runtime.fingerprint import fingerprint

LOCAL = ["--host", "127.0.0.1", "--no-dashboard"]


class Cluster:
    """A scheduler of dask.distributed on a free port, with workers that can be killed."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        folder.mkdir()
        self._processes: list[subprocess.Popen[bytes]] = []
        self.scheduler = self._start(
            "scheduler", *LOCAL, "--port=0", f"--scheduler-file={folder / 'address'}"
        )
        self.address = ""

    def wait_for_scheduler(self) -> None:
        file = self._folder / "address"
        while not self.address:
            assert self.scheduler.poll() is None, (self._folder / "0.log").read_text()
            time.sleep(0.05)
            with suppress(FileNotFoundError, json.JSONDecodeError):
                self.address = json.loads(file.read_text())["address"]

    def add_worker(self, threads: int = 1, code: Path | None = None) -> subprocess.Popen[bytes]:
        options = [*LOCAL, "--no-nanny", f"--nthreads={threads}"]
        return self._start("worker", self.address, *options, code=code)

    def end(self) -> None:
        for process in self._processes:
            process.kill()
        for process in self._processes:
            process.wait()

    def _start(self, what: str, *options: str, code: Path | None = None) -> subprocess.Popen[bytes]:
        source = code or Path(caryatid.__file__).parents[1]
        environment = {"PYTHONPATH": str(source), "DASK_TEMPORARY_DIRECTORY": str(self._folder)}
        with (self._folder / f"{len(self._processes)}.log").open("wb") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", f"distributed.cli.dask_{what}", *options],
                stdout=log, stderr=log, cwd=self._folder, env={**os.environ, **environment},
            )  # fmt: skip
        self._processes.append(process)
        return process


@pytest.fixture
def cluster(tmp_path):
    started = Cluster(tmp_path / "cluster")
    try:
        started.wait_for_scheduler()
        yield started
    finally:
        started.end()


def test_a_run_that_loses_a_worker_is_complete_and_the_same(cluster, tmp_path, scene_file, monkeypatch):
    monkeypatch.chdir(scene_file.parents[1])
    folder = scene_file.parent.name
    suite = with_planners(find_suite("smoke"), ["support", "random"])
    suite = replace(suite, scenes=("tower", folder, "dense-99-1"), seeds=2, views=2)
    members = [replace(m, episode=replace(m.episode, settings=QUICK)) for m in suite.members()]
    cluster.add_worker(threads=2)
    victim = cluster.add_worker()
    told: list[Episode] = []
    lost: list[str] = []

    def done(episode: Episode, outcome: Outcome) -> None:
        told.append(episode)
        if not lost:
            lost.extend(watch.processing([name])[name])
            if lost:
                victim.kill()

    with (
        Client(cluster.address, set_as_default=False) as watch,
        ResultStore(tmp_path / "r.sqlite", fingerprint()) as store,
    ):
        watch.wait_for_workers(2)
        (name,) = (worker for worker, threads in watch.nthreads().items() if threads == 1)
        run_all(store, store.plan("smoke", members), ClusterExecutor(cluster.address), done)
        found = {r.member.episode: without_times(r.outcome) for r in store.records("smoke")}
    assert lost
    assert victim.wait() < 0
    assert len(told) == len(found) == len(members) == 12
    assert found == {m.episode: without_times(run_episode(m.episode)) for m in members}
    assert {e.scene for e in told if found[e].error is not None} == {"dense-99-1"}


def test_the_command_runs_on_a_cluster(cluster, tmp_path, capsys):
    cluster.add_worker()
    command = ["benchmark", "--suite", "smoke", "--scenes", "tower", "--planner", "random", "--views", "1"]
    assert run_command(*command, "--scheduler", cluster.address, "--out", tmp_path / "out", "--json") == 0
    captured = capsys.readouterr()
    told = json.loads(captured.out)["suites"]["smoke"]
    assert (told["planned"], told["done"], told["failed"]) == (1, 1, 0)
    assert captured.err == ""
    assert not (tmp_path / "out" / "results.sqlite-run").exists()


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

    executor = ClusterExecutor(cluster.address, tell, patience=1.0)
    late, early = r"a worker runs other code \(\w+\) than", r"worker tcp://\S+ runs other code \(\w+\) than"
    for who in (late, early):
        with pytest.raises(CaryatidError, match=rf"^{who} this process .* install the same caryatid"):
            list(executor.run([Episode("tower", settings=QUICK, views=1)]))
    assert len(told) == 1
    assert told[0] == f"no workers; waiting for some: dask worker {cluster.address} --nthreads 1 --nworkers N"


def test_a_worker_without_the_planner_is_refused():
    episode = Episode("tower", planner="above-first", plugin="abc", settings=QUICK, views=1)
    with pytest.raises(CaryatidError, match="not the same package that offers the planner above-first; inst"):
        run_on_worker(episode, fingerprint())


def test_a_scheduler_that_goes_ends_the_run(cluster):
    executor = ClusterExecutor(cluster.address, lambda text: cluster.scheduler.kill(), patience=1.0)
    with pytest.raises(CaryatidError, match=r"the scheduler at tcp://\S+ is gone; what is done is kept"):
        list(executor.run([Episode("tower", settings=QUICK)]))


def test_an_address_where_nobody_answers_says_what_to_do():
    episodes = [Episode("tower", settings=QUICK)]
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        for listening in (False, True):
            if listening:
                silent.listen()
            address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
            with pytest.raises(InputError, match=rf"{address}: no scheduler answers .* start one with"):
                list(ClusterExecutor(address, patience=0.5).run(episodes))
    for address in ("nowhere", "", "ftp://127.0.0.1:1"):
        with pytest.raises(InputError, match="no scheduler answers"):
            list(ClusterExecutor(address, patience=0.5).run(episodes))


def test_without_dask_the_remedy_is_told(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r'needs dask\.distributed; pip install "caryatid\[cluster\]"'):
        list(ClusterExecutor("tcp://127.0.0.1:1").run([Episode("tower")]))


def test_a_cluster_has_the_processes_it_has(tmp_path, capsys):
    command = ["benchmark", "--suite", "smoke", "--scheduler", "tcp://127.0.0.1:1", "--jobs", "2"]
    assert run_command(*command, "--out", tmp_path / "out") == 1
    assert "--jobs: a cluster has the workers it has; leave --jobs or" in capsys.readouterr().err


def test_a_scene_folder_must_be_the_same_on_the_worker(scene_file, tmp_path):
    folder = Path(shutil.copytree(scene_file.parent, tmp_path / "two"))
    episode = Episode(str(folder), content=content_of(str(folder)), settings=QUICK, views=1)
    assert run_on_worker(episode, fingerprint()).error is None
    (folder / "scene.xml").write_text((folder / "scene.xml").read_text().replace("0.85", "0.86"))
    again = replace(episode, scene=f"{folder}/.")
    assert "its files are not those this run was planned with" in str(
        run_on_worker(again, fingerprint()).error
    )
    away = replace(episode, scene=str(tmp_path / "away"))
    assert str(tmp_path / "away") in str(run_on_worker(away, fingerprint()).error)
