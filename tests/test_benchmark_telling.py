"""What is told of a result."""

from __future__ import annotations

import pytest
from benchmark_records import make_suite

from caryatid.benchmark.telling import Result, report_all
from caryatid.errors import InputError


@pytest.fixture
def results():
    own = make_suite(["support", "mine"], scenes=2, seeds=1, views=2)
    planners = make_suite(["support", "random", "oracle"], scenes=2, seeds=1, views=2)
    return [Result("planners", planners, len(planners)), Result("own", own, len(own)), Result("fig5", [], 9)]


def test_each_suite_has_its_reference_or_that_which_is_wanted(results):
    def references(wanted=None):
        return {report.name: report.summary.reference for report in report_all(results, wanted)}

    assert references() == {"planners": "random", "own": "support"}
    assert references("oracle") == {"planners": "oracle", "own": "support"}
    assert references("mine") == {"planners": "random", "own": "mine"}


def test_a_reference_that_is_nowhere_lists_the_methods(results):
    with pytest.raises(InputError, match="no such method; choose one of support, random, oracle, mine"):
        report_all(results, "PC")


def test_a_result_says_how_much_of_it_is_done(results):
    assert [result.said() for result in results] == [
        "planners: 6 of 6 episodes", "own: 4 of 4 episodes", "fig5: 0 of 9 episodes",
    ]  # fmt: skip
