"""Compiled work shared out among the cores: each piece is done once, and the same on any number of them."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from numba import njit
from numpy.typing import NDArray

from caryatid.runtime.parallel import for_each

Data = tuple[NDArray[np.float64], float, NDArray[np.float64]]
"""Numbers, a factor, and where results go; of no type of this file, which what is kept on disk would name."""


@njit
def scaled(index: int, data: Data) -> None:
    numbers, factor, results = data
    results[index] += factor * numbers[index]


@njit
def summed(index: int, data: Data) -> None:
    numbers, factor, results = data
    results[index] += factor + numbers[index]


@pytest.mark.parametrize("count", [0, 1, 2, 100])
def test_each_piece_of_work_is_done_once(count):
    numbers, results = np.arange(100.0), np.zeros(100)
    for_each(scaled, count, (numbers, 3.0, results))
    expected = 3.0 * numbers
    expected[count:] = 0.0
    np.testing.assert_array_equal(results, expected)


def test_two_kinds_of_work_on_the_same_data_are_told_apart():
    numbers, results = np.arange(10.0), np.zeros(10)
    for_each(scaled, 10, (numbers, 3.0, results))
    for_each(summed, 10, (numbers, 3.0, results))
    for_each(scaled, 10, (numbers, 3.0, results))
    np.testing.assert_array_equal(results, 7.0 * numbers + 3.0)


COUNTED = """
import sys
import numpy as np
from numba import njit
sys.path.insert(0, sys.argv[1])
import kinds
from caryatid.runtime.parallel import for_each

@njit
def count(index, data):
    data.results[index] += index

data = getattr(kinds, sys.argv[2])(np.zeros(3))
for_each(count, 3, data)
sys.stdout.write(str(data.results.tolist()))
"""


def run_with(cache, code, *arguments):
    """Run Python with a folder of its own for what is compiled; returns what it printed."""
    env = os.environ | {"NUMBA_CACHE_DIR": str(cache), "PYTHONPATH": os.pathsep.join(sys.path)}
    run = subprocess.run(
        [sys.executable, "-c", code, *arguments], env=env, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    return run.stdout


def test_types_that_were_renamed_since_do_not_break_it(tmp_path):
    """What was compiled for them is kept on disk, where it can no longer be read."""
    for name in ("Before", "Afterwards"):
        (tmp_path / "kinds.py").write_text(
            f"from typing import Any, NamedTuple\nclass {name}(NamedTuple):\n    results: Any\n"
        )
        assert run_with(tmp_path / "cache", COUNTED, str(tmp_path), name) == "[0.0, 1.0, 2.0]"


def test_a_loop_that_was_kept_on_disk_may_be_the_first_to_run(tmp_path):
    """The second of two kinds: what it shares with the first is not compiled with it."""
    kind = "class {}(NamedTuple):\n    results: Any\n"
    both = kind.format("One") + kind.format("Two")
    (tmp_path / "kinds.py").write_text("from typing import Any, NamedTuple\n" + both)
    for name in ("One", "Two", "Two"):
        assert run_with(tmp_path / "cache", COUNTED, str(tmp_path), name) == "[0.0, 1.0, 2.0]"


THREADED = """
import hashlib
import sys
import numba
import numpy as np
from test_primitives import CONFIG, fits_of, heap
from caryatid.config import ExplanationConfig
from caryatid.objects.description_length import Evidence, explain
from caryatid.fitting.primitives import Fit
objects = heap()
said = hashlib.sha256()
for result in fits_of(objects, range(len(objects))):
    if isinstance(result, Fit):
        shape, u = result.shape, result.uncertainty
        for part in (shape.T_world_object, shape.extents, u.position, u.rotation, u.sizes, u.sides):
            said.update(part.tobytes())
        said.update(np.array([result.cost, result.residual, result.inliers, *result.seen]).tobytes())
parts = [Evidence(o.points, o.normals, np.ones(len(o)), 0.003, None) for o in objects]
for best in explain(parts, ExplanationConfig(), CONFIG, [np.random.default_rng(0)] * len(parts)):
    said.update(np.array(best.cost).tobytes())
    said.update(b"" if best.shape is None else best.shape.T_world_object.tobytes())
sys.stdout.write(f"{numba.get_num_threads()} {said.hexdigest()}")
"""


def test_the_number_of_threads_changes_no_bit_of_a_fit():
    said = []
    for threads in ("1", "3"):
        env = os.environ | {"NUMBA_NUM_THREADS": threads, "PYTHONPATH": os.pathsep.join(sys.path)}
        run = subprocess.run(
            [sys.executable, "-c", THREADED], env=env, capture_output=True, text=True, check=True
        )
        said.append(run.stdout.split())
    assert [n for n, _ in said] == ["1", "3"]
    assert said[0][1] == said[1][1]
