"""Options that are names of something: what is not known is a usage error that lists what is."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Annotated

from tyro.constructors import PrimitiveConstructorSpec

from caryatid.benchmark.suites import SUITES, find_suite
from caryatid.errors import InputError
from caryatid.planning.planners import BUILT_IN, ORACLE, make_planner
from caryatid.robots import ARM, HUMANOID, find_robot


def name_of(find: Callable[[str], object], metavar: Iterable[str]) -> PrimitiveConstructorSpec[str]:
    """A name that `find` accepts.

    Args:
        find: Raises InputError where it does not know a name.
        metavar: Names the help shows.
    """

    def parse(words: list[str]) -> str:
        try:
            find(words[0])
        except InputError as error:
            raise ValueError(f"{error.reason}; {error.remedy}") from None
        return words[0]

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="{" + ",".join(metavar) + "}",
        instance_from_str=parse,
        is_instance=lambda value: value is None or isinstance(value, str),
        str_from_instance=lambda value: [value],
    )


def _known_planner(name: str) -> None:
    if name not in {*BUILT_IN, ORACLE}:
        make_planner(name)


PlannerName = Annotated[str, name_of(_known_planner, [*BUILT_IN, ORACLE, "…"])]
"""`oracle`, or a name `make_planner` knows, of another package's planner too."""


def _known_robot(name: str) -> None:
    if ":" not in name:
        find_robot(name)


RobotName = Annotated[str, name_of(_known_robot, [HUMANOID, f"{ARM}FILE.npz", "module:callable", "…"])]
"""A name `find_robot` knows; what a file or a module is, is seen when it is opened."""

SuiteName = Annotated[str | None, name_of(find_suite, SUITES)]
"""A name `find_suite` knows."""
