"""The shape of the code is what docs/architecture.md says."""

from __future__ import annotations

import re
import sys
from dataclasses import replace
from pathlib import Path

import grimp
import networkx as nx
import numba
import pytest
from synthetic import model_of, simulated_views

import caryatid
from caryatid.config import Config

ROOT = Path(caryatid.__file__).parent
PAGE = Path(__file__).parents[1] / "docs/architecture.md"


@pytest.mark.parametrize("types", [False, True], ids=["as it runs", "as it is type-checked"])
def test_no_module_imports_itself_by_way_of_others(types):
    """Packages count as modules here, which layers do not see."""
    graph = grimp.build_graph("caryatid", exclude_type_checking_imports=not types, cache_dir=None)
    imports = nx.DiGraph((m, n) for m in graph.modules for n in graph.find_modules_directly_imported_by(m))
    assert [sorted(c) for c in nx.strongly_connected_components(imports) if len(c) > 1] == []


SHARED = ("geometry/", "runtime/", "graph.py", "errors.py")
"""What every stage speaks in: no stops of a view on its way."""


def files_called(function) -> set[tuple[str, str]]:
    """Pairs of files, the second of which the first calls while a function runs, on one thread."""
    pairs: set[tuple[str, str]] = set()

    def place(frame) -> str:
        path = Path(frame.f_code.co_filename)
        name = path.relative_to(ROOT).as_posix() if path.is_relative_to(ROOT) else ""
        return "" if name.startswith(SHARED) else name

    def watch(frame, event, _) -> None:
        caller = frame.f_back
        if event == "call" and (called := place(frame)):
            while caller is not None and not place(caller):
                caller = caller.f_back
            if caller is not None and place(caller) != called:
                pairs.add((place(caller), called))

    threads, before = numba.get_num_threads(), sys.getprofile()
    numba.set_num_threads(1)
    sys.setprofile(watch)
    try:
        function()
    finally:
        sys.setprofile(before)
        numba.set_num_threads(threads)
    return pairs


def test_a_view_goes_through_the_files_that_the_page_lists():
    listed = {
        (caller, called)
        for caller, line in re.findall(r"^(\S+\.py) → (.+)$", PAGE.read_text(encoding="utf-8"), re.M)
        for called in line.split(", ")
    }
    views = [replace(view) for view in simulated_views("tower")]  # without what other tests had them compute
    scene = model_of(views[:2], Config())
    assert files_called(lambda: scene.update(views[2])) == listed
    assert len(listed) <= 37
