"""What tables say in words: objects, supports, points of interest, orders; and what a view changed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, is_dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from caryatid.geometry.shapes import Cylinder, Shape, Sphere
from caryatid.graph import SceneObject, SupportGraph
from caryatid.viz.colours import object_colour, saliency_colour

if TYPE_CHECKING:
    from caryatid.manipulation.order import Order
    from caryatid.planning.decision import Decision

FACES = ("−x", "+x", "−y", "+y", "−z", "+z")
"""Names of an object's sides, in the order of `SceneObject.seen`."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One place of a table.

    Attributes:
        text: What it says.
        colour: Colour of the chip before it, `#rrggbb`, or empty.
        doubt: It says something doubtful.
    """

    text: str
    colour: str = ""
    doubt: bool = False


@dataclass(frozen=True, slots=True)
class Table:
    """A table, ready to print.

    Attributes:
        heading: What it is of.
        columns: Their headings; the last column is the widest.
        rows: As many entries in each.
    """

    heading: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Entry, ...], ...]


def _table(heading: str, columns: tuple[str, ...], rows: Any) -> Table:
    """A table of rows whose entries may be plain texts."""
    entries = (tuple(e if isinstance(e, Entry) else Entry(e) for e in row) for row in rows)
    return Table(heading, columns, tuple(entries))


def object_table(graph: SupportGraph) -> Table:
    """Say of each object what it is, how well it is known and whether it stands."""
    columns = (
        "id", "shape", "size [mm]", "in views", "sides unseen", "residual [mm]", "supported by", "stability",
        "r_s", "overhang [mm]", "how it came about",
    )  # fmt: skip
    return _table("Objects", columns, (_object_row(item, graph) for item in graph.objects))


def _object_row(item: SceneObject, graph: SupportGraph) -> tuple[str | Entry, ...]:
    surface, stability = item.role == "support_surface", graph.stability.get(item.id)
    unseen = " ".join(face for face, seen in zip(FACES, item.seen, strict=True) if not seen)
    supporters = ", ".join(s.supporter if s.certain else f"{s.supporter}?" for s in graph.supporters(item.id))
    verdict, ratio, overhang = "–" if surface else "not tested", "–", "–"
    if stability is not None:
        fired = (("small area", stability.small_area), ("tips", stability.tips))
        verdict, ratio = ", ".join(name for name, yes in fired if yes) or "stable", f"{stability.ratio:.2f}"
        if np.isfinite(stability.overhang):
            overhang = f"{1e3 * stability.overhang:.0f}".replace("-", "−")
    return (
        Entry(item.id, object_colour(item.label)),
        item.shape.kind,
        size_of(item.shape),
        f"{item.occurrences} of {item.opportunities}",
        "all" if not any(item.seen) else unseen or "none",
        Entry(f"{item.residual * 1e3:.1f}{' poor fit' if item.poor_fit else ''}", doubt=item.poor_fit),
        "–" if surface else supporters or "nothing known",
        Entry(verdict, doubt=stability is not None and not stability.stable),
        ratio,
        overhang,
        f"{item.why}; doubtful: {item.doubt}" if item.doubt else item.why,
    )


def support_table(graph: SupportGraph) -> Table:
    """Say of each support what it is, how often it was found and why."""
    colour = {o.id: object_colour(o.label) for o in graph.objects}
    rows = (
        (
            Entry(s.supporter, colour[s.supporter]),
            Entry(s.supported, colour[s.supported]),
            s.kind,
            Entry("yes" if s.certain else "uncertain", doubt=not s.certain),
            f"{s.occurrences} of {s.opportunities}",
            s.why,
        )
        for s in graph.supports
    )
    columns = ("supporter", "supported", "kind", "certain", "found in views", "why it is there")
    return _table("Supports", columns, rows)


def point_table(decision: Decision | None) -> Table:
    """Say of each point of interest what it is about, the most salient first."""
    points = () if decision is None else sorted(decision.points_of_interest, key=lambda p: -p.saliency)
    rows = (
        (" – ".join(p.subject) or "–", Entry(f"{p.saliency:.2f}", saliency_colour(p.saliency)), p.why)
        for p in points
    )
    return _table("Points of interest", ("about", "saliency", "why"), rows)


def order_table(order: Order) -> Table:
    """Say what to take away, one after the other."""
    rows = (
        (
            str(number),
            Entry(step.object_id, object_colour(int(step.object_id[1:]))),
            ", ".join(step.hold) or "–",
            Entry("yes" if step.safe else f"no, risk {step.risk:.0%}", doubt=not step.safe),
            step.why,
        )
        for number, step in enumerate(order.steps, 1)
    )
    return _table("Steps", ("", "take", "hold", "safe", "why"), rows)


def settings_table(settings: Mapping[str, object]) -> Table:
    """Flatten settings, dataclasses and mappings inside them, to `stage.name` and value."""

    def flat(inner: Mapping[str, object], prefix: str) -> list[tuple[str, str]]:
        rows = []
        for name, value in inner.items():
            if is_dataclass(value) and not isinstance(value, type):
                value = asdict(value)
            if isinstance(value, Mapping):
                rows += flat(value, f"{prefix}{name}.")
            else:
                rows.append((f"{prefix}{name}", f"{value:g}" if isinstance(value, float) else str(value)))
        return rows

    return _table("Settings", ("name", "value"), flat(settings, ""))


def size_of(shape: Shape) -> str:
    """Say the sizes of a shape in millimetres."""
    match shape:
        case Cylinder():
            return f"⌀ {2e3 * shape.radius:.0f} × {1e3 * shape.height:.0f}"
        case Sphere():
            return f"⌀ {2e3 * shape.radius:.0f}"
    return " × ".join(f"{1e3 * e:.0f}" for e in shape.extents)


def count_of(number: int, name: str) -> str:
    """Say how many there are of something, in the singular or plural."""
    ending = "" if number == 1 else "es" if name.endswith("x") else "s"
    return f"{number} {name}{ending}"


def census(graph: SupportGraph) -> str:
    """Count the objects and supports of a graph."""
    objects = sum(o.role == "object" for o in graph.objects)
    uncertain = sum(not s.certain for s in graph.supports)
    text = f"{count_of(objects, 'object')}, {count_of(len(graph.supports), 'support')}"
    return f"{text}, {uncertain} of them uncertain" if uncertain else text


def changes(before: SupportGraph, after: SupportGraph) -> str:
    """Say what a view added to and took from the graph."""
    old, new = ({o.id: o.shape.kind for o in graph.objects} for graph in (before, after))
    old_edges, new_edges = ({s.pair: s.certain for s in graph.supports} for graph in (before, after))
    both = [pair for pair in new_edges if pair in old_edges]
    parts: dict[str, list[Any]] = {
        "new objects": [n for n in new if n not in old],
        "objects gone": [n for n in old if n not in new],
        "new supports": [p for p in new_edges if p not in old_edges],
        "supports gone": [p for p in old_edges if p not in new_edges],
        "now certain": [p for p in both if new_edges[p] and not old_edges[p]],
        "now in doubt": [p for p in both if old_edges[p] and not new_edges[p]],
        "other shape": [n for n in new if n in old and old[n] != new[n]],
    }
    said = (
        f"{name}: {', '.join(i if isinstance(i, str) else ' → '.join(i) for i in items)}"
        for name, items in parts.items()
        if items
    )
    return "; ".join(said) or "nothing new"
