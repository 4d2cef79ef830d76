"""One piece of HTML under a cell: a heading, facts, pictures and tables that unfold without a script."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING

from caryatid.viz.style import drawing_rules

if TYPE_CHECKING:
    import jinja2


@dataclass(frozen=True, slots=True)
class Figure:
    """A picture.

    Attributes:
        svg: Its markup, escaped where it was drawn.
        width: What it takes at the most [px].
        caption: What is to be seen in it.
    """

    svg: str
    width: int
    caption: str = ""


@dataclass(frozen=True, slots=True)
class Entry:
    """What stands in one place of a table.

    Attributes:
        text: What it says.
        colour: Colour of the chip before it, `#rrggbb`, or empty.
    """

    text: str
    colour: str = ""


@dataclass(frozen=True, slots=True)
class Table:
    """A table that unfolds under its heading.

    Attributes:
        heading: What it is of.
        columns: Their headings.
        rows: As many entries in each.
        unfolded: It is open from the beginning.
    """

    heading: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Entry, ...], ...]
    unfolded: bool = False


@dataclass(frozen=True, slots=True)
class Cell:
    """All a notebook shows of one object, ready to print.

    Attributes:
        title: What it is.
        lead: The rest of the first line.
        note: A sentence below it.
        facts: Names and values.
        figures: Pictures, side by side.
        tables: Tables, one below the other.
        colour: Colour of the chip before the title, `#rrggbb`, or empty.
    """

    title: str
    lead: str = ""
    note: str = ""
    facts: tuple[tuple[str, str], ...] = ()
    figures: tuple[Figure, ...] = ()
    tables: tuple[Table, ...] = ()
    colour: str = ""


def render(cell: Cell) -> str:
    """Write a cell as HTML; every text in it is escaped."""
    return str(_template().render(cell=cell, style=_style()))


@cache
def _template() -> jinja2.Template:
    import jinja2

    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    return environment.from_string(_read("cell.html.jinja"))


@cache
def _style() -> str:
    """The cell's style sheet and that of the report's drawings, which reaches no further than the cell."""
    drawings = re.sub(r"(^|, )svg\b", r"\1.caryatid-cell svg", drawing_rules(), flags=re.MULTILINE)
    return "".join(line.strip() for line in (_read("cell.css") + drawings).splitlines())


def _read(name: str) -> str:
    return resources.files("caryatid.viz.notebook").joinpath(name).read_text(encoding="utf-8")
