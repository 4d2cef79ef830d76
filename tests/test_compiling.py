"""Kernels are compiled once, all of them, beforehand; and what happens where that cannot be."""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numba
import pytest
from conftest import SMALL, run_command

from caryatid.runtime import compiling
from caryatid.runtime.compiling import compile_kernels, compile_share, listed
from caryatid.scene import Scene

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"

AFTERWARDS = """
import json, sys
from numba.core import event
from caryatid.runtime.compiling import compile_kernels

said, late = [], []
compile_kernels(said.append)

class Late(event.Listener):
    def on_start(self, happening):
        kernel = happening.data["dispatcher"].py_func
        late.append(f"{kernel.__module__}.{kernel.__name__}{happening.data['args']}")

    def on_end(self, happening):
        pass

event.register("numba:compile", Late())
if len(sys.argv) > 1:
    sys.path.append(sys.argv[1])
    import compiling
    compiling.rehearse()
compile_kernels(said.append)
print(json.dumps([said, late]))
"""


def python(code, *arguments, **environment):
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=240,
        env=os.environ | environment,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_what_is_compiled_beforehand_is_all_that_is_called(tmp_path):
    """Where this fails, `python benchmarks/compiling.py --write` writes the list anew."""
    said, late = python(AFTERWARDS, BENCHMARKS, NUMBA_CACHE_DIR=str(tmp_path))
    assert said == ["compiling kernels, once after installation: 10 to 20 s"]
    assert late == []
    assert {file.suffix for file in tmp_path.rglob("*") if file.is_file()} == {
        ".nbi",
        ".nbc",
        ".compiled",
        ".lock",
    }
    assert python(AFTERWARDS, NUMBA_CACHE_DIR=str(tmp_path)) == [[], []]


# What is compiled when; with three modules that are not really compiled


@pytest.fixture
def pretended(tmp_path, monkeypatch):
    """Modules a, b that calls a's kernels, and c; the lists of what was to be compiled."""
    sources = {"a": "f = 1", "b": "from caryatid.kernels.a import f", "c": "h = 3"}
    for name, text in sources.items():
        (tmp_path / f"{name}.py").write_text(text)
    signatures = tmp_path / "signatures.json"
    signatures.write_text(json.dumps({"a.f": ["(int64,)"], "b.g": ["(int64,)"], "c.h": ["(int64,)"]}))
    runs = []
    monkeypatch.setattr(compiling, "HERE", tmp_path)
    monkeypatch.setattr(compiling, "SIGNATURES", signatures)
    monkeypatch.setattr(compiling, "CACHE", tmp_path / "cache")
    monkeypatch.setattr(
        compiling, "_run_processes", lambda work, kernels: runs.append([k.name for k in kernels])
    )
    forget()
    yield runs
    forget()


def forget():
    """As a new process knows nothing."""
    listed.cache_clear()
    compiling._stamps.cache_clear()


def test_what_is_compiled_is_not_compiled_again(pretended):
    said = []
    for _ in range(3):
        compile_kernels(said.append)
        forget()
    assert pretended == [["f", "g", "h"]]
    assert len(said) == 1


def test_a_change_is_followed_to_whoever_calls_it(pretended, tmp_path):
    compile_kernels()
    (tmp_path / "a.py").write_text("f = 'another'")
    forget()
    compile_kernels()
    (tmp_path / "c.py").write_text("h = 'another'")
    forget()
    compile_kernels()
    called = {"a.f": ["(int64,)"], "b.g": ["(int64,)", "(float64,)"], "c.h": ["(int64,)"]}
    (tmp_path / "signatures.json").write_text(json.dumps(called))
    forget()
    compile_kernels()
    assert pretended[1:] == [["f", "g"], ["h"], ["g"]]


def test_what_was_there_before_the_last_change_does_not_count(pretended, tmp_path):
    """Its compiled kernels are gone."""
    file = tmp_path / "c.py"
    before, at = file.read_text(), file.stat().st_mtime_ns
    compile_kernels()
    for text, when in (("h = 'another'", at + 1), (before, at)):
        file.write_text(text)
        os.utime(file, ns=(when, when))
        forget()
        compile_kernels()
    assert pretended[1:] == [["h"], ["h"]]


def test_after_an_interrupt_it_starts_again(pretended, monkeypatch):
    work, calls = compiling._run_processes, []

    def interrupted(*arguments):
        calls.append(arguments)
        if len(calls) == 1:
            raise KeyboardInterrupt
        work(*arguments)

    monkeypatch.setattr(compiling, "_run_processes", interrupted)
    with pytest.raises(KeyboardInterrupt):
        compile_kernels()
    compile_kernels()
    assert pretended == [["f", "g", "h"]]


def test_of_two_at_once_one_compiles_and_the_other_waits(pretended, monkeypatch):
    work, started = compiling._run_processes, threading.Event()

    def slowly(*arguments):
        started.set()
        time.sleep(0.5)
        work(*arguments)

    monkeypatch.setattr(compiling, "_run_processes", slowly)
    first = threading.Thread(target=compile_kernels)
    first.start()
    assert started.wait(10.0)
    said = []
    compile_kernels(said.append)
    assert pretended == [["f", "g", "h"]]
    assert said == []
    first.join()


@pytest.mark.parametrize("why", ["jit", "child", "frozen", "nowhere"])
def test_where_it_cannot_be_it_is_left_alone(pretended, monkeypatch, why):
    match why:
        case "jit":
            monkeypatch.setattr(numba.config, "DISABLE_JIT", 1)
        case "child":
            monkeypatch.setenv(compiling.MARK, "1")
        case "frozen":
            monkeypatch.setattr(sys, "frozen", True, raising=False)
        case "nowhere":
            monkeypatch.setattr(sys, "executable", "")
    compile_kernels()
    assert pretended == []


def test_a_scene_has_its_kernels_compiled_and_says_so_to_a_log(pretended, caplog):
    with caplog.at_level(logging.INFO, logger="caryatid"):
        Scene()
        Scene()
    assert pretended == [["f", "g", "h"]]
    assert [r.message for r in caplog.records] == ["compiling kernels, once after installation: 10 to 20 s"]


@pytest.mark.parametrize("option", ["", "--quiet", "--json"])
def test_a_command_says_so_before_its_first_view(pretended, tmp_path, scene_file, recording, capsys, option):
    for command in (["explore", scene_file, "--views", 1, *SMALL], ["extract", recording]):
        (tmp_path / "c.py").write_text(f"h = '{command[0]}'")
        forget()
        assert run_command(*command, "--no-report", "--out", tmp_path / "run", *option.split()) == 0
        first = capsys.readouterr().err.partition("\n")[0]
        assert first == ("" if option else "compiling kernels, once after installation: 10 to 20 s")
    assert len(pretended) == 2


def test_what_cannot_be_explored_is_said_without_compiling(pretended, tmp_path):
    for command in ("explore", "extract"):
        assert run_command(command, tmp_path / "nowhere", "--out", tmp_path / "run") == 1
    assert pretended == []


# Real kernels


def test_an_interrupt_leaves_nothing_behind(tmp_path):
    cache = tmp_path / "cache"
    process = subprocess.Popen(
        [sys.executable, "-m", "caryatid", "explore", "tower", "--out", str(tmp_path / "run")],
        env=os.environ | {"NUMBA_CACHE_DIR": str(cache)},
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert process.stderr.readline().startswith("compiling kernels")
    while not list(cache.rglob("compiling-*/*.log")):
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=60)[1]
    assert process.returncode == 130
    assert said == "interrupted: nothing was written\n"
    assert not list(cache.rglob("compiling-*"))
    assert not list(cache.rglob("*.compiled"))
    assert not (tmp_path / "run").exists()


def test_processes_that_do_not_start_do_no_harm(tmp_path, monkeypatch):
    monkeypatch.setattr(compiling, "CACHE", tmp_path)
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    forget()
    said = []
    compile_kernels(said.append)
    compile_kernels(said.append)
    forget()
    assert len(said) == 1
    assert not list(tmp_path.glob("*.nbc"))


def test_a_kernel_that_cannot_be_compiled_does_not_keep_others_from_it(tmp_path, monkeypatch, capsys):
    good = listed()[-1]
    signatures = {
        "nowhere.f": ["(int64,)"],
        f"{good.module}.nothing": ["(int64,)"],
        f"{good.module}.{good.name}": list(good.signatures),
    }
    monkeypatch.setattr(compiling, "SIGNATURES", tmp_path / "signatures.json")
    (tmp_path / "signatures.json").write_text(json.dumps(signatures))
    listed.cache_clear()
    compile_share(str(tmp_path), ["nowhere", good.module])
    listed.cache_clear()
    assert (tmp_path / f"{good.module}.{good.name}").read_text() == str(compiling.CACHE)
    assert (tmp_path / f"{good.module}.nothing").read_text() == ""
    assert "nowhere.f: " in capsys.readouterr().err


def test_where_compiled_kernels_cannot_be_kept_it_is_said(tmp_path):
    """As in a folder that cannot be written to, of a user without a home."""
    done = subprocess.run(
        [sys.executable, "-m", "caryatid", "explore", "tower", "--out", str(tmp_path / "run")],
        env=os.environ | {"NUMBA_CACHE_LOCATOR_CLASSES": "ZipCacheLocator"},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.startswith("error: NUMBA_CACHE_DIR: compiled kernels cannot be kept")
    assert done.stderr.count("\n") == 1
