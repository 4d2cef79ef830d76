"""Rows in words, for the terminal's table and for the page alike."""

from __future__ import annotations

from collections.abc import Sequence

from performance.rows import Row

NOTHING = "–"
MISSED = "missed"
COLUMNS = (
    "row",
    "what",
    "ours",
    "spread",
    "runs",
    "peer",
    "theirs",
    "to peer",
    "pass of",
    "to limit",
    "target",
)
"""Heads of the table."""


def cells(row: Row) -> tuple[str, ...]:
    """The columns of a row."""
    return (
        row.name,
        row.what,
        figure(row.value, row.unit),
        figure(row.spread, row.unit) if row.runs > 1 and row.unit != "1" else NOTHING,
        str(row.runs),
        row.peer or NOTHING,
        figure(row.peer_value, row.unit),
        ratio(row.to_peer),
        row.limit or NOTHING,
        ratio(row.to_limit),
        " ".join(part for part in (asked(row), verdict(row)) if part) or NOTHING,
    )


def notes(rows: Sequence[Row]) -> dict[str, str]:
    """What else there is to say → of which row, and of how many others."""
    names: dict[str, list[str]] = {}
    for row in rows:
        if row.note:
            names.setdefault(row.note, []).append(row.name)
    more = {note: f" and {len(told) - 1} more" if len(told) > 1 else "" for note, told in names.items()}
    return {note: f"`{told[0]}`{more[note]}" for note, told in names.items()}


def figure(value: float | None, unit: str) -> str:
    """A figure of three digits or so, with its unit."""
    return NOTHING if value is None else f"{digits(value)} {'' if unit == '1' else unit}".rstrip()


def ratio(value: float | None) -> str:
    """Ours in others': below one as a fraction."""
    if value is None:
        return NOTHING
    return f"1/{digits(1.0 / value)}" if 0.0 < value < 1.0 else f"{digits(value)} ×"


def asked(row: Row) -> str:
    """What is asked of a row; empty where nothing is."""
    if row.target is None:
        return ""
    if row.target.figure == "value":
        return f"≤ {figure(row.target.at_most, row.unit)}"
    aim = "" if row.target.aim is None else f" (aim {ratio(row.target.aim)})"
    return f"≤ {ratio(row.target.at_most)}{aim}"


def verdict(row: Row) -> str:
    """Whether it is what is asked for; empty where nothing is."""
    if row.target is None:
        return ""
    if row.met is None:
        return "not measured"
    return "met" if row.met else MISSED


def found(row: Row) -> str:
    """The figure a row's target is about."""
    if row.target is None or row.target.figure == "value":
        return figure(row.value, row.unit)
    return ratio(getattr(row, row.target.figure))


def digits(value: float) -> str:
    """A number with three digits that count, or all those before the point."""
    if abs(value) >= 99.95:
        return f"{value:,.0f}"
    if abs(value) >= 9.995:
        return f"{value:.1f}".removesuffix(".0")
    return f"{value:.2f}".rstrip("0").rstrip(".") if abs(value) >= 0.9995 else f"{value:.3g}"
