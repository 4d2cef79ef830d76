"""The option --planner: names of planners, of other packages too."""

from __future__ import annotations

from typing import Annotated

from tyro.constructors import PrimitiveConstructorSpec

from caryatid.errors import InputError
from caryatid.planners import BUILT_IN, make_planner


def _checked_name(words: list[str]) -> str:
    try:
        make_planner(words[0])
    except InputError as error:
        raise ValueError(f"{error.reason}; {error.remedy}") from None
    return words[0]


PlannerName = Annotated[
    str,
    PrimitiveConstructorSpec(
        nargs=1,
        metavar="{" + ",".join(BUILT_IN) + ",…}",
        instance_from_str=_checked_name,
        is_instance=lambda value: isinstance(value, str),
        str_from_instance=lambda value: [value],
    ),
]
"""A name `make_planner` knows; others are usage errors."""
