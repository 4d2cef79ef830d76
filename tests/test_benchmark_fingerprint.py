"""What code made a figure."""

from __future__ import annotations

import sys
from importlib.metadata import EntryPoint

import pytest

from caryatid.benchmark.plugins import plugin_of
from caryatid.planning import planners
from caryatid.planning.planners import BUILT_IN, ORACLE
from caryatid.runtime.fingerprint import fingerprint


def test_the_code_has_one_fingerprint():
    assert fingerprint() == fingerprint()
    assert len(fingerprint()) == 16


@pytest.mark.parametrize("name", [*BUILT_IN, ORACLE, "unheard-of"])
def test_planners_of_ours_are_part_of_the_fingerprint(name):
    assert plugin_of(name) == ""


@pytest.mark.parametrize("package", [True, False])
def test_a_plugin_is_told_from_its_next_version(tmp_path, monkeypatch, package):
    file = tmp_path / ("guesser/__init__.py" if package else "guesser.py")
    file.parent.mkdir(exist_ok=True)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "guesser", raising=False)
    point = EntryPoint("guess", "guesser:Planner", planners.ENTRY_POINTS)
    monkeypatch.setattr(planners, "entry_points", lambda group: [point])
    file.write_text("A = 1\n")
    before = plugin_of("guess")
    assert before == plugin_of("guess") != ""
    file.write_text("A = 2\n")
    assert plugin_of("guess") != before
