"""Kernels are compiled once after installation: all of them, in processes side by side, before any view.

numba keeps what it compiles on disk, with one index a kernel, and processes that write to the same one get in
each other's way. So each compiles for a folder of its own, whole kernels one after the other, and then their
files are moved to where numba looks for them. `signatures.json` says which kernels Python calls with what;
`benchmarks/compiling.py` writes it. What it does not list is compiled at its first call, as ever.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import platform
import re
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import llvmlite.binding as llvm
import numba
from numba import njit, types

from caryatid.errors import InputError
from caryatid.runtime.interrupts import interrupts_held
from caryatid.runtime.threads import cores

log = logging.getLogger(__name__)
"""Tells that kernels are compiled, and why they cannot be."""

ROOT = Path(__file__).parents[1]
SIGNATURES = Path(__file__).with_name("signatures.json")
"""Kernels that Python calls, `room.module.name` → signatures; those that take longest come first."""


def cache_of(module: str) -> Path:
    """Folder in which numba keeps the compiled kernels of a module.

    Args:
        module: Its name within the package, `room.module`.

    Raises:
        InputError: There is no folder that can be written to.
    """
    names: dict[str, Any] = {}
    exec(compile("def nothing(): pass", str(_source(module)), "exec"), names)
    try:
        return Path(njit(cache=True)(names["nothing"]).stats.cache_path)
    except RuntimeError:
        raise InputError(
            "NUMBA_CACHE_DIR",
            "compiled kernels cannot be kept, no folder for them can be written to",
            "set it to one that can",
        ) from None


def _source(module: str) -> Path:
    return ROOT / f"{module.replace('.', '/')}.py"


PROCESSES = 8
"""Processes at the most [1]; with more, the longest kernel decides how long it takes."""

PATIENCE = 300.0
"""A process that takes longer is given up [s]; ten times what the slowest machines need."""

MARK = "CARYATID_COMPILES"
"""Set in the environment of such processes: whatever they are, they start no more of their kind."""

IMPORT = re.compile(r"^from caryatid\.([\w.]+) import", re.MULTILINE)
"""A module that imports another one."""

CODE = """
import sys
sys.path.append(sys.argv[1])
from caryatid.runtime.compiling import compile_share
compile_share(sys.argv[2], sys.argv[3:])
"""
"""What such a process runs; where it does not find caryatid otherwise, it looks where this process did."""


@dataclass(frozen=True, slots=True)
class Kernel:
    """A kernel that Python calls.

    Attributes:
        module: Its module, `room.module`.
        name: Its name there.
        signatures: Types of its arguments, as numba writes them.
    """

    module: str
    name: str
    signatures: tuple[str, ...]

    def dispatcher(self) -> Any:
        """The kernel as numba made it.

        Raises:
            AttributeError, ImportError: There is none of that name.
        """
        return getattr(import_module(f"caryatid.{self.module}"), self.name)


@cache
def listed() -> tuple[Kernel, ...]:
    """The kernels that Python calls, those that take longest first."""
    document: dict[str, list[str]] = json.loads(SIGNATURES.read_text(encoding="utf-8"))
    named = [(name.rpartition("."), tuple(signatures)) for name, signatures in document.items()]
    return tuple(Kernel(module, name, signatures) for (module, _, name), signatures in named)


def compile_kernels(say: Callable[[str], None] = log.info) -> None:
    """Compile all kernels that are not yet: after installation, and where they or what they call changed.

    Afterwards a stamp for each module says so. A kernel that cannot be compiled now is compiled at its first
    call, and fails there.

    Args:
        say: Told in one line, where there is something to do.
    """
    if numba.config.DISABLE_JIT or MARK in os.environ or not sys.executable or hasattr(sys, "frozen"):
        return
    if not _missing():
        return
    cache = cache_of("runtime.compiling")
    cache.mkdir(parents=True, exist_ok=True)
    with _alone(cache / "compiling.lock"):
        missing = _missing()
        if not missing:
            return
        say("compiling kernels, once after installation: 10 to 20 s")
        kernels = [kernel for kernel in listed() if kernel.module in missing]
        with TemporaryDirectory(prefix="compiling-", dir=cache) as work:
            _run_processes(Path(work), kernels)
            for kernel in kernels:
                _publish(kernel, Path(work))
        for path, digest in missing.values():
            path.write_text(digest, encoding="utf-8")


def compile_share(work: str, modules: Sequence[str]) -> None:
    """Compile kernels that no other process has taken, one after the other; called in a process of its own.

    Args:
        work: Folder in which the processes say what they take, and where their files are.
        modules: Modules whose kernels are to be compiled.
    """
    for kernel in listed():
        if kernel.module not in modules:
            continue
        taken = Path(work) / f"{kernel.module}.{kernel.name}"
        try:
            taken.touch(exist_ok=False)
        except FileExistsError:
            continue
        try:
            for signature in kernel.signatures:
                kernel.dispatcher().compile(argument_types(signature))
        except Exception as error:
            sys.stderr.write(f"{taken.name}: {error}\n")
        else:
            taken.write_text(str(cache_of(kernel.module)), encoding="utf-8")


def argument_types(signature: str) -> tuple[Any, ...]:
    """The types that a signature names in numba's words; `Named('module.Name', (…))` is a NamedTuple's."""
    names = vars(types) | {"Named": _named}
    arguments: tuple[Any, ...] = eval(signature, {}, names)
    return arguments


def _named(name: str, fields: tuple[Any, ...]) -> Any:
    module, _, own = name.rpartition(".")
    return types.BaseTuple.from_types(fields, getattr(import_module(f"caryatid.{module}"), own))


def _run_processes(work: Path, kernels: Sequence[Kernel]) -> None:
    """Have processes share the kernels among them, each with a cache of its own, and wait for them."""
    modules = sorted({kernel.module for kernel in kernels})
    command = [sys.executable, "-P", "-c", CODE, str(ROOT.parent), str(work), *modules]
    processes: list[subprocess.Popen[bytes]] = []
    end = time.monotonic() + PATIENCE
    try:
        with interrupts_held():
            for number in range(min(cores(), PROCESSES, len(kernels))):
                own = {MARK: "1", "NUMBA_CACHE_DIR": str(work / f"cache-{number}")}
                with open(work / f"{number}.log", "wb") as told:
                    processes.append(
                        subprocess.Popen(
                            command, env=os.environ | own, stdin=subprocess.DEVNULL, stdout=told, stderr=told
                        )
                    )
        for process in processes:
            process.wait(max(end - time.monotonic(), 0.0))
    except (OSError, subprocess.TimeoutExpired) as error:
        log.debug("kernels are compiled at their first calls: %s", error)
    finally:
        for process in processes:
            process.kill()
            process.wait()
    for said in sorted(work.glob("*.log")):
        log.debug("%s", said.read_text(encoding="utf-8", errors="replace"))


def _publish(kernel: Kernel, work: Path) -> None:
    """Move a kernel's files to where numba looks for them, the index last."""
    taken = work / f"{kernel.module}.{kernel.name}"
    cache = taken.read_text(encoding="utf-8") if taken.exists() else ""
    if not cache:
        return
    target = cache_of(kernel.module)
    target.mkdir(parents=True, exist_ok=True)
    name = f"{kernel.module.rpartition('.')[2]}.{kernel.name}"
    for file in sorted(Path(cache).glob(f"{name}-*.nb[ci]")):
        file.replace(target / file.name)


def _missing() -> dict[str, tuple[Path, str]]:
    """Modules whose kernels are not compiled: what file is to say that they are, and how."""
    return {
        module: (path, digest)
        for module, (path, digest) in _stamps().items()
        if not path.exists() or path.read_text(encoding="utf-8") != digest
    }


@cache
def _stamps() -> dict[str, tuple[Path, str]]:
    """Of each module a file, and what it has to say where its kernels are compiled on this machine.

    It tells what they were compiled from: sources, of what they call too, at which numba does not look, and
    what they are called with.
    """
    machine = _digest((numba.__version__, platform.python_version(), llvm.get_host_cpu_name()))
    cache = cache_of("runtime.compiling")
    stamps: dict[str, tuple[Path, str]] = {}
    for module in {kernel.module for kernel in listed()}:
        sources = [(name, *_changed(_source(name))) for name in sorted(_needed(module))]
        calls = [kernel for kernel in listed() if kernel.module == module]
        stamps[module] = (cache / f"{module}.{machine}.compiled", _digest((sources, calls)))
    return stamps


def _needed(module: str) -> set[str]:
    """A module, those it imports from this package, and so on."""
    found: set[str] = set()
    waiting = {module}
    while waiting:
        found |= waiting
        files = [file for name in waiting if (file := _source(name)).exists()]
        texts = [file.read_text(encoding="utf-8") for file in files]
        waiting = {name for text in texts for name in IMPORT.findall(text)} - found
    return found


def _changed(file: Path) -> tuple[int, int]:
    """When a file was changed, and its size, by which numba goes; zeros where there is none."""
    if not file.exists():
        return 0, 0
    return file.stat().st_mtime_ns, file.stat().st_size


def _digest(what: object) -> str:
    return hashlib.sha256(repr(what).encode()).hexdigest()[:16]


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Wait until no other process does the same; where files cannot be locked, do not."""
    lock = sqlite3.connect(path, isolation_level=None, timeout=0.0)
    try:
        while True:
            try:
                lock.execute("BEGIN EXCLUSIVE")
                break
            except sqlite3.OperationalError as error:
                if error.sqlite_errorcode != sqlite3.SQLITE_BUSY:
                    break
                time.sleep(0.1)
        yield
    finally:
        lock.close()
