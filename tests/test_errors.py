from __future__ import annotations

import pickle

import pytest

from caryatid.errors import InputError, PerceptionError, in_one_line


@pytest.mark.parametrize(
    "error", [InputError("scene.xml", "is broken", "give another"), PerceptionError("nothing is seen")]
)
def test_an_error_crosses_processes_as_it_is(error):
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is type(error)
    assert (vars(copy), str(copy)) == (vars(error), str(error))


def test_what_failed_is_said_in_one_line():
    assert in_one_line(InputError("a.xml", "is\nbroken")) == "a.xml: is broken"
    assert in_one_line(FileNotFoundError(2, "No such file", "a.xml")) == "a.xml: no such file"
    assert "ZeroDivisionError" in in_one_line(ZeroDivisionError("by zero"))
