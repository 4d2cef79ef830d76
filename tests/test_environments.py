"""Signals, damaged kernels, threads, and compilers that outlive nobody."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest
from conftest import SMALL
from numba import njit

from caryatid.runtime import parallel

pytestmark = pytest.mark.slow


def test_sigterm_is_as_an_interrupt(tmp_path, scene_file):
    words = ["explore", scene_file, "--out", tmp_path / "run", "--views", 50, "--no-early-stop", *SMALL]
    process = subprocess.Popen(
        [sys.executable, "-m", "caryatid", *map(str, words)], stderr=subprocess.PIPE, text=True
    )
    assert next(line for line in process.stderr if line.startswith("view "))
    process.send_signal(signal.SIGTERM)
    assert "kept in" in process.communicate(timeout=60)[1]
    assert process.returncode == 130
    assert os.listdir(tmp_path) == ["run"]


def test_a_damaged_kernel_is_compiled_again(tmp_path):
    names = {}
    source = tmp_path / "kernel.py"
    source.write_text("def f(x): return x + 1\n")
    for damage in (None, ".nbc", ".nbi"):
        for file in (tmp_path / "__pycache__").glob(f"*{damage}"):
            file.write_bytes(file.read_bytes()[:-20])
        exec(compile("def f(x): return x + 1", str(source), "exec"), names)
        assert njit(cache=True)(names["f"])(1) == 2


def test_threads_are_those_that_are_asked_for(monkeypatch):
    for asked, threads in (("3", 3), ("0", None), ("many", None)):
        monkeypatch.setenv("CARYATID_THREADS", asked)
        parallel.cores.cache_clear()
        assert parallel.cores() == (threads or parallel.cores.__wrapped__())
    parallel.cores.cache_clear()


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
