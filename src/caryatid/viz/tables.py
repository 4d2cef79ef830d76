"""What tables say in words: objects, supports, points of interest, orders; and what a view changed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
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


def object_table(graph: SupportGraph) -> Table:
    """Say of each object what it is, how well it is known and whether it stands."""
    columns = (
        "id", "shape", "size [mm]", "in views", "sides unseen", "residual [mm]", "supported by", "stability",
        "r_s", "overhang [mm]", "how it came about",
    )  # fmt: skip
    return Table("Objects", columns, tuple(_object_row(item, graph) for item in graph.objects))


def _object_row(item: SceneObject, graph: SupportGraph) -> tuple[Entry, ...]:
    surface = item.role == "support_surface"
    stability = graph.stability.get(item.id)
    unseen = [face for face, seen in zip(FACES, item.seen, strict=True) if not seen]
    supporters = [s.supporter if s.certain else f"{s.supporter}?" for s in graph.supporters(item.id)]
    verdict, ratio, overhang, unstable = "–" if surface else "not tested", "–", "–", False
    if stability is not None:
        tests = [n for n, fired in (("small area", stability.small_area), ("tips", stability.tips)) if fired]
        verdict, ratio, unstable = (
            ", ".join(tests) or "stable",
            f"{stability.ratio:.2f}",
            not stability.stable,
        )
        if np.isfinite(stability.overhang):
            overhang = f"{1e3 * stability.overhang:.0f}".replace("-", "−")
    return (
        Entry(item.id, object_colour(item.label)),
        Entry(item.shape.kind),
        Entry(size_of(item.shape)),
        Entry(f"{item.occurrences} of {item.opportunities}"),
        Entry("none" if not unseen else "all" if len(unseen) == len(FACES) else " ".join(unseen)),
        Entry(f"{item.residual * 1e3:.1f}{' poor fit' if item.poor_fit else ''}", doubt=item.poor_fit),
        Entry("–" if surface else ", ".join(supporters) or "nothing known"),
        Entry(verdict, doubt=unstable),
        Entry(ratio),
        Entry(overhang),
        Entry(f"{item.why}; doubtful: {item.doubt}" if item.doubt else item.why),
    )


def support_table(graph: SupportGraph) -> Table:
    """Say of each support what it is, how often it was found and why."""
    colour = {o.id: object_colour(o.label) for o in graph.objects}
    rows = tuple(
        (
            Entry(s.supporter, colour[s.supporter]),
            Entry(s.supported, colour[s.supported]),
            Entry(s.kind),
            Entry("yes" if s.certain else "uncertain", doubt=not s.certain),
            Entry(f"{s.occurrences} of {s.opportunities}"),
            Entry(s.why),
        )
        for s in graph.supports
    )
    columns = ("supporter", "supported", "kind", "certain", "found in views", "why it is there")
    return Table("Supports", columns, rows)


def point_table(decision: Decision | None) -> Table:
    """Say of each point of interest what it is about, the most salient first."""
    points = () if decision is None else decision.points_of_interest
    rows = tuple(
        (
            Entry(" – ".join(p.subject) or "–"),
            Entry(f"{p.saliency:.2f}", saliency_colour(p.saliency)),
            Entry(p.why),
        )
        for p in sorted(points, key=lambda p: -p.saliency)
    )
    return Table("Points of interest", ("about", "saliency", "why"), rows)


def order_table(order: Order) -> Table:
    """Say what to take away, one after the other."""
    rows = tuple(
        (
            Entry(str(number)),
            Entry(step.object_id, object_colour(int(step.object_id[1:]))),
            Entry(", ".join(step.hold) or "–"),
            Entry("yes" if step.safe else f"no, risk {step.risk:.0%}", doubt=not step.safe),
            Entry(step.why),
        )
        for number, step in enumerate(order.steps, 1)
    )
    return Table("Steps", ("", "take", "hold", "safe", "why"), rows)


def settings_table(settings: Mapping[str, object]) -> Table:
    """Flatten settings, dataclasses and mappings inside them, to `stage.name` and value."""

    def flat(inner: Mapping[str, object], prefix: str) -> list[tuple[Entry, Entry]]:
        rows = []
        for name, value in inner.items():
            if is_dataclass(value) and not isinstance(value, type):
                value = {f.name: getattr(value, f.name) for f in fields(value)}
            if isinstance(value, Mapping):
                rows += flat(value, f"{prefix}{name}.")
            else:
                text = f"{value:g}" if isinstance(value, float) else str(value)
                rows.append((Entry(f"{prefix}{name}"), Entry(text)))
        return rows

    return Table("Settings", ("name", "value"), tuple(flat(settings, "")))


def size_of(shape: Shape) -> str:
    """Say the sizes of a shape in millimetres."""
    match shape:
        case Cylinder():
            return f"⌀ {2e3 * shape.radius:.0f} × {1e3 * shape.height:.0f}"
        case Sphere():
            return f"⌀ {2e3 * shape.radius:.0f}"
    return " × ".join(f"{1e3 * e:.0f}" for e in shape.extents)


def census(graph: SupportGraph) -> str:
    """Count the objects and supports of a graph."""
    objects = sum(o.role == "object" for o in graph.objects)
    uncertain = sum(not s.certain for s in graph.supports)
    supports = len(graph.supports)
    text = f"{objects} object{'s' * (objects != 1)}, {supports} support{'s' * (supports != 1)}"
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
    return (
        "; ".join(
            f"{name}: {', '.join(i if isinstance(i, str) else ' → '.join(i) for i in items)}"
            for name, items in parts.items()
            if items
        )
        or "nothing new"
    )
