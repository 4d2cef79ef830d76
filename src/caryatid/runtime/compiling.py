"""Compile all kernels once after installation, in a few parallel processes, before the first view.

numba compiles a kernel at its first call and caches it on disk, so no list of kernels is needed: the
processes *warm up*. Each calls everything that uses kernels, on small scenes (`caryatid.simulation.warm_up`),
starting with a different part. While one of them compiles a kernel, the others wait for it and then read it
from disk. A kernel that no warm-up calls is compiled at its first call; add such a call there.
"""

from __future__ import annotations

import gc
import hashlib
import json
import logging
import os
import platform
import re
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numba
from filelock import FileLock
from numba import njit
from numba.core.caching import FunctionCache

from caryatid.errors import InputError
from caryatid.runtime.display import call
from caryatid.runtime.parallel import cores

log = logging.getLogger(__name__)
"""Reports that kernels are being compiled, and why they cannot be."""

ROOT = Path(__file__).parents[1]
MARK = "CARYATID_COMPILES"
"""Set in the environment of the processes that warm up, so that they start no others."""

CODE = """
import os, sys, threading
threading.Thread(target=lambda: os._exit(len(sys.stdin.read()) + 1), daemon=True).start()
sys.path.append(sys.argv[1])
from caryatid.runtime.compiling import warm_up
warm_up(sys.argv[2], int(sys.argv[3]))
"""
"""The program of such a process. It ends with its parent, and imports caryatid from the same place."""


def compile_kernels() -> None:
    """Compile all kernels that are not compiled yet: after installation, and after a change of their sources.

    Several processes may call this at once: one compiles, the others wait.

    Raises:
        InputError: No folder for compiled kernels is writable.
    """
    if numba.config.DISABLE_JIT or MARK in os.environ or not sys.executable or hasattr(sys, "frozen"):
        return
    folder = cache_of(Path(__file__).parent)
    machine = _digest(numba.__version__, platform.python_version(), llvm.get_host_cpu_name())
    stamp = folder / f"compiled-{machine}.json"
    wanted = _digests()
    if _read(stamp) == wanted:
        return
    folder.mkdir(parents=True, exist_ok=True)
    with FileLock(folder / "compiling.lock"):
        done = _read(stamp)
        if done == wanted:
            return
        log.info("compiling kernels (once after installation, about 20 seconds)")
        for module in wanted.keys() - {name for name, digest in done.items() if wanted.get(name) == digest}:
            # numba does not notice a change of a kernel in another module that this one calls.
            source = ROOT / f"{module.replace('.', '/')}.py"
            for index in cache_of(source.parent).glob(f"{source.stem}.*.nbi"):
                index.unlink(missing_ok=True)
        _run_processes(folder)
        stamp.write_text(json.dumps(wanted), encoding="utf-8")


def warm_up(locks: str, number: int) -> None:
    """Call all kernels, starting at one by the process's number; several take turns by locks in a folder."""
    # A compiler makes many long-lived objects; looking for garbage among them takes a sixth of its time.
    gc.disable()
    _take_turns(Path(locks))
    call("warm-up", number)


@cache
def cache_of(folder: Path) -> Path:
    """Folder in which numba keeps the compiled kernels of the modules in a folder.

    Raises:
        InputError: No such folder is writable.
    """
    names: dict[str, Any] = {}
    exec(compile("def nothing(): pass", str(folder / "__init__.py"), "exec"), names)
    try:
        return Path(njit(cache=True)(names["nothing"]).stats.cache_path)
    except RuntimeError:
        reason = "no writable folder for compiled kernels"
        raise InputError("NUMBA_CACHE_DIR", reason, "set it to a writable folder") from None


def _run_processes(folder: Path) -> None:
    """Warm up in several processes that take turns by locks in a folder, and wait for them."""
    # A killed process leaves the folder behind, and the next one replaces it.
    work, processes = folder / "compiling", list[subprocess.Popen[bytes]]()
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir()
    try:
        for number in range(min(cores(), 4)):  # more would wait for the kernels that take longest
            process = subprocess.Popen(
                [sys.executable, "-P", "-c", CODE, str(ROOT.parent), str(work), str(number)],
                env=os.environ | {MARK: "1", "NUMBA_NUM_THREADS": "1"},
                stdin=subprocess.PIPE,  # it closes when this process ends, however it does
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                process_group=0,  # Ctrl-C reaches this process only.
            )
            processes.append(process)
        for process in processes:
            process.wait(1200.0)  # [s], far more than a machine busy with other work needs
    except (OSError, subprocess.TimeoutExpired) as error:
        log.debug("kernels are compiled at their first calls: %s", error)
    finally:
        for process in processes:
            process.kill()
            process.wait()
            assert process.stdin is not None
            process.stdin.close()
        shutil.rmtree(work, ignore_errors=True)


def _take_turns(folder: Path) -> None:
    """Let numba compile a kernel only if no other process does, and otherwise wait for the result.

    This also makes writing to numba's cache exclusive: two processes that write the index of one kernel would
    lose entries. A process waits only for kernels that it is about to call, so there is no deadlock.
    """
    load, save = FunctionCache.load_overload, FunctionCache.save_overload
    locks: dict[str, FileLock] = {}

    def lock_of(kept: Any) -> FileLock:
        name = _digest(kept._cache_file._index_path)
        return locks.setdefault(name, FileLock(folder / f"{name}.lock"))

    def load_or_lock(self: FunctionCache, signature: Any, context: Any) -> Any:
        found = load(self, signature, context)
        if found is None:
            lock_of(self).acquire()
            found = load(self, signature, context)
            if found is not None:
                lock_of(self).release()
        return found

    def save_and_unlock(self: FunctionCache, signature: Any, compiled: Any) -> None:
        save(self, signature, compiled)
        lock_of(self).release()

    FunctionCache.load_overload, FunctionCache.save_overload = load_or_lock, save_and_unlock


def _digests() -> dict[str, str]:
    """Modules that hold kernels → digest of their source and of all modules they import."""
    texts = {
        ".".join(file.relative_to(ROOT).with_suffix("").parts): file.read_text(encoding="utf-8")
        for file in ROOT.rglob("*.py")
    }
    imports = {
        module: set(re.findall(r"^from caryatid\.([\w.]+) import", text, re.MULTILINE))
        for module, text in texts.items()
        if re.search("^@(kernel|inner)", text, re.MULTILINE)
    }
    digests = {}
    for module in imports:
        needed, waiting = set(), {module}
        while waiting:
            needed |= waiting
            waiting = set().union(*(imports.get(name, set()) for name in waiting)) - needed
        digests[module] = _digest(*(texts.get(name, "") for name in sorted(needed)))
    return digests


def _read(stamp: Path) -> dict[str, str]:
    """Modules whose kernels are compiled → digest of what they were compiled from."""
    try:
        digests: dict[str, str] = json.loads(stamp.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return digests


def _digest(*texts: str) -> str:
    return hashlib.sha256("\0".join(texts).encode()).hexdigest()[:16]
