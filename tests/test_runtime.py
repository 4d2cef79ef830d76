"""Kernels are compiled once, beforehand; work is shared out among threads."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time

import numba
import numpy as np
import pytest
from conftest import SMALL
from numba import njit

from caryatid.runtime import compiling, parallel
from caryatid.runtime.compiling import compile_kernels
from caryatid.runtime.parallel import for_each

SOURCE = "from caryatid.runtime.parallel import kernel\n@kernel\ndef f(x):\n    return x\n"

SMALL_WARM_UP = """
import os
from numba import njit
from numba.core import event

@njit(cache=True)
def inner(x):
    return x + 1

@njit(cache=True)
def outer(x):
    return inner(x) + 1

class Compiled(event.Listener):
    def on_start(self, happening):
        with open(os.environ["COMPILED"], "a") as file:
            file.write(happening.data["dispatcher"].py_func.__name__ + "\\n")

    def on_end(self, happening):
        pass

event.register("numba:compile", Compiled())

def warm_up(number):
    for kernel in (inner, outer) if number else (outer, inner):
        kernel(1)
"""

HOOKED = "from caryatid.runtime.display import hooks\nimport caryatid\nhooks['warm-up'] = 'small:warm_up'\n"

WARMED_UP = """
import logging
from caryatid.runtime.compiling import compile_kernels
logging.basicConfig(level=logging.INFO, format="%(message)s")
compile_kernels()
from small import warm_up
warm_up(0)
compile_kernels()
"""


@pytest.mark.slow
def test_two_processes_compile_each_kernel_once(tmp_path):
    """Both begin with an empty cache; one compiles, the other waits, and neither compiles anything later."""
    (tmp_path / "small.py").write_text(SMALL_WARM_UP)
    (tmp_path / "sitecustomize.py").write_text(HOOKED)
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    compiled = tmp_path / "compiled"
    environment = {"PYTHONPATH": path, "NUMBA_CACHE_DIR": str(tmp_path), "COMPILED": str(compiled)}
    command = [sys.executable, "-c", WARMED_UP]
    both = [
        subprocess.Popen(command, env=os.environ | environment, stderr=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    said = [process.communicate(timeout=120)[1] for process in both]
    assert [process.returncode for process in both] == [0, 0], said
    assert sorted(said) == ["", "compiling kernels (once after installation, about 20 seconds)\n"]
    assert sorted(compiled.read_text().split()) == ["inner", "outer"]


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
from caryatid.runtime.compiling import compile_kernels
compile_kernels()
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


@pytest.mark.slow
def test_ctrl_c_while_compiling_leaves_no_run_and_no_stamp(tmp_path):
    cache = tmp_path / "cache"
    process = subprocess.Popen(
        [sys.executable, "-m", "caryatid", "explore", "tower", "--out", str(tmp_path / "run")],
        env=os.environ | {"NUMBA_CACHE_DIR": str(cache)}, stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    assert process.stderr.readline().startswith("compiling kernels")
    time.sleep(1.0)
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=60)[1]
    assert (process.returncode, said) == (130, "interrupted: nothing was written\n")
    assert not list(cache.rglob("compiled-*.json"))
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_compilers_end_with_the_process_that_started_them(tmp_path):
    """Killed in its first compilation, it leaves no process, and the next run takes its folder over."""
    code = "from caryatid.runtime.compiling import compile_kernels; compile_kernels()"
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    process = subprocess.Popen([sys.executable, "-c", code], env=environment)
    while not list(tmp_path.rglob("*.lock")) or not list(tmp_path.rglob("*.nbi")):
        time.sleep(0.2)
        assert process.poll() is None
    process.kill()
    process.wait()
    time.sleep(1.0)
    listed = subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True, check=True).stdout
    assert str(tmp_path) not in listed


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package of modules a, b that imports a, and c, each with a kernel; a list of the rehearsals."""
    runs = []
    for name, imported in (("a", ""), ("b", "from caryatid.a import f\n"), ("c", "")):
        (tmp_path / f"{name}.py").write_text(imported + SOURCE)
    monkeypatch.delenv(compiling.MARK, raising=False)
    monkeypatch.setattr(compiling, "ROOT", tmp_path)
    monkeypatch.setattr(compiling, "cache_of", lambda folder: tmp_path / "cache")
    monkeypatch.setattr(compiling, "_run_processes", lambda _: runs.append(_indexes(tmp_path)))
    return runs


def _indexes(folder):
    """Modules whose kernels are kept; all are once this returns."""
    kept = sorted(path.name[0] for path in (folder / "cache").glob("*.nbi"))
    for name in "abc":
        (folder / "cache" / f"{name}.f-3.py311.nbi").touch()
    return kept


def test_only_what_changed_and_what_calls_it_is_compiled_again(package, tmp_path, caplog):
    caplog.set_level("INFO", "caryatid")
    for _ in range(2):
        compile_kernels()
    (tmp_path / "a.py").write_text(SOURCE + "\n")
    compile_kernels()
    (tmp_path / "c.py").write_text(SOURCE + "\n")
    compile_kernels()
    assert package == [[], ["c"], ["a", "b"]]
    assert caplog.messages == ["compiling kernels (once after installation, about 20 seconds)"] * 3


@pytest.mark.parametrize(
    "prevent",
    [
        lambda patch: patch.setattr(numba.config, "DISABLE_JIT", 1),
        lambda patch: patch.setenv(compiling.MARK, "1"),
        lambda patch: patch.setattr(sys, "frozen", True, raising=False),
        lambda patch: patch.setattr(sys, "executable", ""),
    ],
)
def test_where_nothing_can_be_compiled_beforehand_nothing_is(package, monkeypatch, prevent):
    prevent(monkeypatch)
    compile_kernels()
    assert package == []


# Sharing work out


def test_threads_are_those_that_are_asked_for(monkeypatch):
    for asked, threads in (("3", 3), ("0", None), ("many", None)):
        monkeypatch.setenv("CARYATID_THREADS", asked)
        parallel.cores.cache_clear()
        assert parallel.cores() == (threads or parallel.cores.__wrapped__())
    parallel.cores.cache_clear()


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


@njit
def add_scaled(index, data):
    numbers, factor, results = data
    results[index] += factor * numbers[index]


@pytest.mark.parametrize("count", [0, 1, 2, 100])
def test_each_piece_of_work_is_done_once(count):
    numbers, results = np.arange(100.0), np.zeros(100)
    for_each(add_scaled, count, (numbers, 3.0, results))
    np.testing.assert_array_equal(results, np.where(np.arange(100) < count, 3.0 * numbers, 0.0))


KEPT = """
import sys
import numpy as np
from numba import njit
sys.path.insert(0, sys.argv[1])
import kinds
from caryatid.runtime.parallel import for_each

@njit(cache=True)
def count(index, data):
    data.results[index] += index

data = getattr(kinds, sys.argv[2])(np.zeros(3))
for_each(count, 3, data)
sys.stdout.write(str(data.results.tolist()))
"""


@pytest.mark.slow
def test_a_kept_kernel_whose_types_were_renamed_is_compiled_again(tmp_path):
    script = tmp_path / "kept.py"
    script.write_text(KEPT)
    for name in ("Before", "Afterwards"):
        (tmp_path / "kinds.py").write_text(
            f"from typing import Any, NamedTuple\nclass {name}(NamedTuple):\n    results: Any\n"
        )
        done = subprocess.run(
            [sys.executable, str(script), str(tmp_path), name],
            env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")},
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.stdout == "[0.0, 1.0, 2.0]", done.stderr


@pytest.mark.slow
def test_a_damaged_kernel_is_compiled_again(tmp_path):
    names = {}
    source = tmp_path / "kernel.py"
    source.write_text("def f(x): return x + 1\n")
    for damage in (None, ".nbc", ".nbi"):
        for file in (tmp_path / "__pycache__").glob(f"*{damage}"):
            file.write_bytes(file.read_bytes()[:-20])
        exec(compile("def f(x): return x + 1", str(source), "exec"), names)
        assert njit(cache=True)(names["f"])(1) == 2
