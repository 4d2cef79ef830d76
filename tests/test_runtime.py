"""Kernels are compiled once and kept; work is shared out among threads."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import numba
import numpy as np
import pytest
from conftest import SMALL

from caryatid.runtime import parallel
from caryatid.scene import Stopwatch

# Sharing work out


def test_threads_are_those_that_are_asked_for(monkeypatch):
    for asked, threads in (("3", 3), ("0", None), ("many", None)):
        monkeypatch.setenv("CARYATID_THREADS", asked)
        parallel.cores.cache_clear()
        assert parallel.cores() == (threads or parallel.cores.__wrapped__())
    parallel.cores.cache_clear()


def test_work_that_is_shared_out_may_share_out_work():
    def rows(number):
        return sum(parallel.on_threads(lambda k: 10 * number + k, 10))

    assert parallel.on_threads(rows, 20) == [sum(range(10 * n, 10 * n + 10)) for n in range(20)]


def test_after_a_failure_no_other_task_begins_and_none_goes_on():
    begun, over = [], []

    def task(number):
        begun.append(number)
        if number == 2:
            raise ValueError("broken")
        over.append(number)

    with pytest.raises(ValueError, match="broken"):
        parallel.on_threads(task, 10_000)
    assert len(over) == len(begun) - 1


OVERLAPPING = """
import sys
from threading import Event, Thread
import numpy
from threadpoolctl import threadpool_info
from caryatid.runtime.parallel import one_blas_thread

def threads():
    return [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]

usual, running, ends = threads(), [Event(), Event()], [Event(), Event()]

@one_blas_thread
def run(number):
    running[number].set()
    ends[number].wait()

started = [Thread(target=run, args=(number,)) for number in range(2)]
for thread, event in zip(started, running):
    thread.start()
    event.wait()
assert set(threads()) == {1}, threads()
for number in map(int, sys.argv[1:]):
    ends[number].set()
    started[number].join()
assert threads() == usual, threads()
"""


@pytest.mark.parametrize("order", ["01", "10"])
def test_blas_gets_its_threads_back_after_functions_that_overlap(order):
    subprocess.run([sys.executable, "-c", OVERLAPPING, *order], check=True, timeout=60.0)


# Kernels on disk

INNER = """
from typing import NamedTuple
from caryatid.runtime.parallel import kernel
STEP = 1
class {name}(NamedTuple):
    number: int
@kernel
def inner(x):
    return x + 1
"""
OUTER = """
import sys
import b
from caryatid.runtime.parallel import kernel
from b import STEP, inner
@kernel
def outer(data, more):
    return inner(data.number) + more * STEP
print(outer(getattr(b, sys.argv[1])(1), 10), sum(outer.stats.cache_misses.values()))
"""


def run_kernels(folder, inner, name="Data", **changes):
    """Write the module `b`, and run a kernel of another module that calls it."""
    (folder / "b.py").write_text(inner.format(name=name))
    (folder / "a.py").write_text(OUTER)
    os.utime(folder / "a.py", (1e9, 1e9))
    environment = {"PYTHONPATH": os.pathsep.join(sys.path), "NUMBA_CACHE_DIR": str(folder / "cache")}
    return subprocess.run(
        [sys.executable, str(folder / "a.py"), name],
        env=os.environ | environment | changes, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip


@pytest.mark.slow
def test_a_kernel_is_compiled_again_only_if_it_or_what_it_uses_has_changed(tmp_path):
    said = [
        run_kernels(tmp_path, INNER).stdout,
        run_kernels(tmp_path, INNER).stdout,
        run_kernels(tmp_path, INNER.replace("x + 1", "x + 100")).stdout,
        run_kernels(tmp_path, INNER.replace("STEP = 1", "STEP = 50")).stdout,
        run_kernels(tmp_path, INNER.replace("STEP = 1", "STEP = 50"), "Renamed").stdout,
    ]
    assert said == ["12 1\n", "12 0\n", "111 1\n", "502 1\n", "502 1\n"]
    for kept in (tmp_path / "cache").rglob("*.nb*"):
        kept.write_bytes(kept.read_bytes()[:-20])
    assert run_kernels(tmp_path, INNER.replace("STEP = 1", "STEP = 50"), "Renamed").stdout == "502 1\n"


def test_compiling_a_kernel_is_not_counted_as_the_time_of_a_stage():
    slow = numba.njit(lambda x: np.linalg.solve(x, x))
    watch = Stopwatch()
    slow(np.eye(3))
    watch.lap("fit")
    slow(np.eye(3))
    watch.lap("plan")
    assert watch.laps["compile"] > 10.0 * watch.laps["fit"] >= 0.0
    assert [*watch.laps] == ["fit", "compile", "plan"]


def test_without_a_folder_for_kernels_the_error_says_what_to_set(tmp_path):
    said = run_kernels(tmp_path, INNER, NUMBA_CACHE_LOCATOR_CLASSES="ZipCacheLocator").stderr
    assert "NUMBA_CACHE_DIR: no writable folder for compiled kernels; set it to a writable folder" in said


LATE = """
import json, sys
from numba.core import event

class Late(event.Listener):
    def on_start(self, happening):
        kernel = happening.data["dispatcher"].py_func
        late.append(f"{kernel.__module__}.{kernel.__name__}")

    def on_end(self, happening):
        pass

late = []
from caryatid.simulation.warm_up import warm_up
warm_up()
event.register("numba:compile", Late())
from caryatid.cli import main
out, *small = sys.argv[1:]
explore = ["explore", "clutter", "--segmentation", "auto", "--noise", "carmine", "--views", "3", "--quiet"]
assert main([*explore, "--out", out, *small]) == 0
assert main(["order", out, "--quiet", "--set", "rehearsal.draws=2"]) in (0, 3)
print(json.dumps([name for name in late if name.startswith("caryatid")]))
"""


@pytest.mark.slow
def test_a_run_needs_no_kernel_that_is_not_compiled_beforehand(tmp_path):
    command = [sys.executable, "-c", LATE, str(tmp_path / "run"), *SMALL]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    assert json.loads(done.stdout.splitlines()[-1]) == []
