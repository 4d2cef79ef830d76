"""Which values a setting may have: said by its type, and looked after wherever settings are made."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

from caryatid.errors import InputError


@dataclass(frozen=True, slots=True)
class Range:
    """The numbers between two ends.

    Attributes:
        least: Lower end, in the unit of what it is of.
        most: Upper end.
        above: Whether the lower end itself is left out.
        below: Whether the upper end itself is left out.
    """

    least: float = -math.inf
    most: float = math.inf
    above: bool = False
    below: bool = False

    def __contains__(self, value: float) -> bool:
        return (self.least < value if self.above else self.least <= value) and (
            value < self.most if self.below else value <= self.most
        )

    def __str__(self) -> str:
        start = f"above {self.least:g}" if self.above else f"from {self.least:g}"
        if self.most == math.inf:
            return start if self.above else f"{start} on"
        end = f"{'below ' if self.below else ''}{self.most:g}"
        return f"{start} {'and' if self.above else 'to'} {end}"


@dataclass(frozen=True, slots=True)
class Choice:
    """A few names.

    Attributes:
        names: What may be chosen.
    """

    names: tuple[str, ...]

    def __contains__(self, value: str) -> bool:
        return value in self.names

    def __str__(self) -> str:
        return f"one of {', '.join(self.names)}"


@dataclass(frozen=True, slots=True)
class Rising:
    """Lists in which no number is smaller than the one before it."""

    def __contains__(self, values: tuple[float, ...]) -> bool:
        return all(a <= b for a, b in pairwise(values))

    def __str__(self) -> str:
        return "in rising order"


Positive = Annotated[float, Range(0.0, above=True)]
NotNegative = Annotated[float, Range(0.0)]
Share = Annotated[float, Range(0.0, 1.0)]
Likelihood = Annotated[float, Range(0.0, 1.0, above=True, below=True)]
"""A probability that is neither impossible nor certain: its odds are finite."""
Factor = Annotated[float, Range(1.0)]
Cosine = Annotated[float, Range(-1.0, 1.0)]
Angle = Annotated[float, Range(0.0, 180.0)]
Acute = Annotated[float, Range(0.0, 90.0, below=True)]
"""An angle whose cosine is divided by."""
Elevation = Annotated[float, Range(-90.0, 90.0)]
Azimuth = Annotated[float, Range(-360.0, 360.0)]
Count = Annotated[int, Range(1)]
WholeNumber = Annotated[int, Range(0)]
Lengths = Annotated[tuple[Positive, Positive], Rising()]
"""The least and the most a length may be."""
Counts = Annotated[tuple[WholeNumber, WholeNumber], Rising()]
"""The least and the most there may be."""


_KINDS: dict[type, dict[str, Any]] = {}
"""What `kinds` found out."""


class Stage:
    """Settings of one stage; they cannot be made with a value outside its range.

    Raises:
        InputError: A value is; the message says which, and what its range is.
    """

    __slots__ = ()

    def __post_init__(self) -> None:
        for name, kind in kinds(type(self)).items():
            value = getattr(self, name)
            if wanted := out_of_range(value, kind):
                raise InputError(f"{type(self).__name__}.{name}", f"{value!r} is not valid", f"give {wanted}")


def kinds(stage: type) -> dict[str, Any]:
    """Settings of a stage → their types, with the ranges."""
    if stage not in _KINDS:
        _KINDS[stage] = get_type_hints(stage, include_extras=True)
    return _KINDS[stage]


def out_of_range(value: Any, kind: Any) -> str:
    """What a value would have to be, where it is outside the range of its type; otherwise nothing.

    Args:
        value: Of the right type.
        kind: The type, with ranges.
    """
    plain, *rules = get_args(kind) if get_origin(kind) is Annotated else (kind,)
    if get_origin(plain) is tuple:
        broken = [f"each {rule}" for part, rule in _parts(value, plain) if part not in rule]
        broken += [str(rule) for rule in rules if value not in rule]
        names = value and isinstance(value[0], str)
        return f"a list of {len(value)} {'names' if names else 'numbers'}, {broken[0]}" if broken else ""
    noun = "a whole number" if plain is int else "a number"
    return next((f"{noun} {rule}" for rule in rules if value not in rule), "")


def _parts(values: tuple[Any, ...], kind: Any) -> Iterator[tuple[Any, Range | Choice]]:
    """Parts of a tuple, each with the ranges it is to be in, or what it may be."""
    kinds_of_parts = get_args(kind)
    for place, part in enumerate(values):
        own = kinds_of_parts[0] if kinds_of_parts[-1] is Ellipsis else kinds_of_parts[place]
        if get_origin(own) is Literal:
            yield part, Choice(get_args(own))
        elif get_origin(own) is Annotated:
            for rule in get_args(own)[1:]:
                yield part, rule
