"""How figures are written out."""

from __future__ import annotations

import math

from caryatid.benchmark.bootstrap import Estimate

NONE = "–"
"""Where there is no figure."""
MINUS = "−"
"""The sign, which a hyphen is not."""


def say_number(value: float | None, digits: int = 3) -> str:
    """Write a number with so many digits after the point; an infinite one was not reached."""
    if value is None or math.isnan(value):
        return NONE
    if math.isinf(value):
        return "not reached"
    text = f"{value:.{digits}f}"
    return text.replace("-", MINUS) if float(text) else text.replace("-", "")


def say_difference(value: float | None, digits: int = 3) -> str:
    """Write a number with its sign, whichever it is."""
    text = say_number(value, digits)
    return f"+{text}" if value is not None and value > 0.0 and text.strip("0.") else text


def say_estimate(estimate: Estimate | None, digits: int = 3, *, signed: bool = False) -> str:
    """Write a figure and its interval; of a threshold out of reach of the whole interval just that."""
    if estimate is None:
        return NONE
    say = say_difference if signed else say_number
    text = say(estimate.value, digits)
    if estimate.low is None or estimate.high is None or text == NONE or math.isinf(estimate.low):
        return text
    return f"{text} [{say(estimate.low, digits)}, {say(estimate.high, digits)}]"


def say_time(time: float | None) -> str:
    """Write a time [s] in the unit it is best read in, with three digits."""
    if time is None:
        return NONE
    for size, unit in ((1.0, "s"), (1e-3, "ms")):
        if time >= 0.9995 * size:
            return f"{time / size:#.3g} {unit}".replace(". ", " ")
    return f"{1e6 * time:.0f} µs"


def say_count(number: int, one: str) -> str:
    """Write a number of things; `one` is what one of them is called."""
    return f"{number:,} {one}" + ("" if number == 1 else "s")


def say_tick(time: float) -> str:
    """Write a round time [s] as an axis does."""
    for size, unit in ((1.0, "s"), (1e-3, "ms")):
        if time >= 0.999 * size:
            return f"{time / size:g} {unit}"
    return f"{1e6 * time:g} µs"
