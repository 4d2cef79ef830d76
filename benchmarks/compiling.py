"""Which kernels Python calls with what, and how long they take to compile, one by one and side by side.

python benchmarks/compiling.py [--write]
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import tyro
from rich.console import Console
from rich.table import Table

Calls = dict[str, list[str]]
"""Kernels, `module.name` → signatures."""
T = TypeVar("T")


@dataclass(frozen=True)
class Compiling:
    """Tell which kernels a rehearsal of all that caryatid does calls, and what it takes to compile them."""

    write: bool = False
    """Write the list the package has of them."""


def rehearse() -> None:
    """Do with two small scenes and few views what calls kernels: perceive, model, plan, score, read files."""
    import numpy as np

    from caryatid.config import Config, FusionMethod, SegmentationMethod
    from caryatid.evaluation.scores import score
    from caryatid.evaluation.truths import true_scene_from_simulation
    from caryatid.exploration import explore, next_best_view
    from caryatid.io import read_recording, write_recording
    from caryatid.planning.planners import BUILT_IN
    from caryatid.scene import Scene
    from caryatid.sensing.views import SUPPORT_LABEL, Cloud
    from caryatid.simulation.scenes import load_scene
    from caryatid.simulation.setup import make_simulation
    from caryatid.simulation.truth import ground_truth

    config = Config()
    fast = replace(config, active=replace(config.active, sphere_points=4000, max_views=3))
    runs: list[tuple[str, SegmentationMethod, FusionMethod]] = [
        ("tower", "labels", "pc+sg"),
        ("dense-12-0", "auto", "pc"),
        ("tower", "auto", "sg"),
    ]
    clouds: list[Cloud] = []
    for name, segmentation, method in runs:
        settings = replace(fast, fusion=replace(config.fusion, method=method))
        stage = make_simulation(load_scene(name), settings, noise="carmine", seed=0)
        steps = list(explore(stage.camera, stage.robot, config=settings, segmentation=segmentation))
        truth = true_scene_from_simulation(stage.scene, ground_truth(stage.scene))
        score(steps[-1].graph, truth, np.random.default_rng(0))
        clouds.append(steps[-1].cloud)
    views = [step.view for step in steps if step.view is not None]
    with TemporaryDirectory() as folder:
        write_recording(folder, views)
        for segmentation in ("labels", "auto"):
            scene = Scene(fast, segmentation=segmentation)
            for frame in read_recording(folder).frames[:2]:
                scene.update(frame.load())
    for planner in BUILT_IN:
        next_best_view(scene, stage.robot, planner=planner)
    known = clouds[0].labels
    for labels in (None if known is None else np.where(known == SUPPORT_LABEL, 0, known), None):
        Scene(fast).update(replace(clouds[0], labels=labels))


def kernels() -> Iterator[tuple[str, Any]]:
    """All that numba compiles, `module.name` and the kernel."""
    from numba.core.dispatcher import Dispatcher

    for module, content in sorted(sys.modules.items()):
        if module.startswith("caryatid."):
            for name, kernel in vars(content).items():
                if isinstance(kernel, Dispatcher) and kernel.py_func.__module__ == module:
                    yield f"{module.removeprefix('caryatid.')}.{name}", kernel


def calls() -> Calls:
    """Kernels that Python calls in a rehearsal; where all are compiled, others are not looked up."""
    rehearse()
    called = {name: list(kernel.nopython_signatures) for name, kernel in kernels()}
    return {name: [spelt(s.args) for s in signatures] for name, signatures in called.items() if signatures}


def spelt(arguments: tuple[Any, ...]) -> str:
    """The types of a kernel's arguments as numba reads them from a word.

    Raises:
        ValueError: A type has no spelling here.
    """
    from caryatid.runtime.compiling import argument_types

    text = f"({', '.join(map(_spelt, arguments))},)"
    if argument_types(text) != arguments:
        raise ValueError(f"{arguments} is not {text}")
    return text


def _spelt(kind: Any) -> str:
    from numba import types

    match kind:
        case types.Boolean():
            return "boolean"
        case types.Number():
            return str(kind.name)
        case types.Array(ndim=n, layout=layout, mutable=True):
            colons = {"C": [*[":"] * (n - 1), "::1"], "F": ["::1", *[":"] * (n - 1)], "A": [":"] * n}[layout]
            return f"{_spelt(kind.dtype)}[{', '.join(colons)}]"
        case types.Array(ndim=n, layout=layout):
            return f"Array({_spelt(kind.dtype)}, {n}, '{layout}', readonly=True)"
        case types.BaseNamedTuple():
            module = kind.instance_class.__module__.removeprefix("caryatid.")
            name = f"{module}.{kind.instance_class.__name__}"
            return f"Named('{name}', ({', '.join(map(_spelt, kind))},))"
        case types.FunctionType():
            signature: Any = kind.signature
            given = ", ".join(map(_spelt, signature.args))
            return f"FunctionType({_spelt(signature.return_type)}({given}))"
        case types.NoneType():
            return "void"
        case types.BaseTuple():
            return f"Tuple(({', '.join(map(_spelt, kind))},))"
    raise ValueError(f"no spelling for {kind}")


def seconds(calls: Calls) -> dict[str, float]:
    """Time each kernel takes to compile, one after the other [s]; what several call counts for the first."""
    from numba import njit

    from caryatid.runtime.compiling import argument_types

    njit(_warm)(1.0)
    listed = dict(kernels())
    taken = {}
    for name, signatures in calls.items():
        start = time.perf_counter()
        for signature in signatures:
            listed[name].compile(argument_types(signature))
        taken[name] = time.perf_counter() - start
    return taken


def _warm(x: float) -> float:
    return x


def side_by_side() -> float:
    """Time until all are compiled, as after installation [s]."""
    start = time.perf_counter()
    from caryatid.runtime.compiling import compile_kernels

    compile_kernels()
    return time.perf_counter() - start


def apart(cache: Path, function: Callable[..., T], *arguments: Any, beforehand: bool = False) -> T:
    """Call a function in a process of its own with this cache of kernels.

    Args:
        cache: Folder of the cache.
        function: What to call.
        arguments: With what.
        beforehand: Whether all kernels are compiled before the first view.
    """
    os.environ |= {"NUMBA_CACHE_DIR": str(cache)}
    os.environ.pop("CARYATID_COMPILES", None)
    if not beforehand:
        os.environ["CARYATID_COMPILES"] = "0"
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def run(args: Compiling) -> int:
    """Run the rehearsals and print a table."""
    with TemporaryDirectory() as folder:
        apart(Path(folder) / "a", rehearse)
        called = apart(Path(folder) / "a", calls)
        taken = apart(Path(folder) / "b", seconds, called)
        if args.write:
            from caryatid.runtime.compiling import SIGNATURES

            longest = {name: called[name] for name in sorted(called, key=lambda n: -taken[n])}
            SIGNATURES.write_text(json.dumps(longest, indent=1) + "\n", encoding="utf-8")
        together = apart(Path(folder) / "c", side_by_side, beforehand=True)
    table = Table(title="time to compile the kernels that Python calls")
    for column in ("kernel", "signatures", "s"):
        table.add_column(column, justify="left" if column == "kernel" else "right")
    for name in sorted(taken, key=lambda n: -taken[n]):
        table.add_row(name, str(len(called[name])), f"{taken[name]:.2f}")
    table.add_section()
    table.add_row("one after the other", "", f"{sum(taken.values()):.1f}")
    table.add_row("side by side, with imports", "", f"{together:.1f}")
    Console().print(table)
    return 0


if __name__ == "__main__":
    sys.exit(run(tyro.cli(Compiling, description=__doc__)))
