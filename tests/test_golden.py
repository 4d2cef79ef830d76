"""Golden runs give the same graphs: the same objects and edges, sizes and places to a millimetre."""

from __future__ import annotations

import json

import pytest
from golden_runs import GOLDEN, RUNS, execute, summary


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] if r.slow else []) for n, r in RUNS.items()]
)
def test_a_golden_run_gives_the_same_graph(name, tmp_path):
    if not RUNS[name].available:
        pytest.skip("needs the shared data")
    golden = json.loads(GOLDEN.read_text(encoding="utf-8"))[name]
    found = summary(execute(name, tmp_path)["graph.json"])
    assert found["supports"] == golden["supports"]
    assert found["objects"].keys() == golden["objects"].keys()
    for o, expected in golden["objects"].items():
        assert found["objects"][o]["shape"] == expected["shape"]
        for figure in ("size", "centre"):
            assert found["objects"][o][figure] == pytest.approx(expected[figure], abs=1e-3)
