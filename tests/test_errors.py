from __future__ import annotations

import pickle

import pytest

from caryatid.errors import CaryatidError, InputError, PerceptionError, PlanningError, in_one_line


@pytest.mark.parametrize("remedy", ["", "give another"])
def test_an_input_error_crosses_processes_as_it_is(remedy):
    error = InputError("scene.xml", "is broken", remedy)
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is InputError
    assert (copy.source, copy.reason, copy.remedy) == ("scene.xml", "is broken", remedy)
    assert str(copy) == str(error)


@pytest.mark.parametrize("kind", [CaryatidError, PerceptionError, PlanningError])
def test_other_errors_cross_processes_too(kind):
    copy = pickle.loads(pickle.dumps(kind("nothing is seen")))
    assert type(copy) is kind
    assert str(copy) == "nothing is seen"


def test_what_failed_is_said_in_one_line():
    assert in_one_line(InputError("a.xml", "is\nbroken")) == "a.xml: is broken"
    assert in_one_line(FileNotFoundError(2, "No such file", "a.xml")) == "a.xml: no such file"
    assert "ZeroDivisionError" in in_one_line(ZeroDivisionError("by zero"))
