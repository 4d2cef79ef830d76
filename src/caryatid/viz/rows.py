"""What the report's tables say, in words: objects, supports, points of interest, what a view changed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import TYPE_CHECKING

import numpy as np

from caryatid.geometry.shapes import Cylinder, Shape, Sphere
from caryatid.graph import SceneObject, SupportGraph
from caryatid.viz import colours

if TYPE_CHECKING:
    from caryatid.planning.decision import Decision

FACES = ("−x", "+x", "−y", "+y", "−z", "+z")
"""Names of an object's sides, in the order of `SceneObject.seen`."""


@dataclass(frozen=True, slots=True)
class ObjectRow:
    """One line of the table of objects, ready to print.

    Attributes:
        id: Its id.
        colour: Its colour, `#rrggbb`.
        shape: Name of the shape.
        size: Sizes [mm].
        seen: In how many views it was found.
        unseen: Which sides no points bear out.
        residual: Mean distance of its points [mm].
        poor_fit: No shape explains its points.
        stability: Which tests say that it falls.
        unstable: Whether one does.
        ratio: Support area ratio r_s of eq. 1.
        overhang: How far its centre of mass lies outside [mm].
        supporters: Ids of what holds it.
        surface: It is the support surface.
        why: How the shape came about, and what is doubtful.
    """

    id: str
    colour: str
    shape: str
    size: str
    seen: str
    unseen: str
    residual: str
    poor_fit: bool
    stability: str
    unstable: bool
    ratio: str
    overhang: str
    supporters: str
    surface: bool
    why: str


@dataclass(frozen=True, slots=True)
class SupportRow:
    """One line of the table of supports, ready to print.

    Attributes:
        supporter: Id of what holds.
        supporter_colour: Its colour, `#rrggbb`.
        supported: Id of what is held.
        supported_colour: Its colour, `#rrggbb`.
        kind: How.
        certain: Whether it is.
        evidence: In how many views it was found.
        why: Which test put it there.
    """

    supporter: str
    supporter_colour: str
    supported: str
    supported_colour: str
    kind: str
    certain: bool
    evidence: str
    why: str


@dataclass(frozen=True, slots=True)
class PointRow:
    """One line of the table of points of interest, ready to print.

    Attributes:
        subject: Ids of the objects it is about.
        colour: Colour of its saliency, `#rrggbb`.
        saliency: How much it is worth.
        why: What for.
    """

    subject: str
    colour: str
    saliency: str
    why: str


def object_rows(graph: SupportGraph) -> tuple[ObjectRow, ...]:
    """Say of each object what it is, how well it is known and whether it stands."""
    return tuple(_object_row(item, graph) for item in graph.objects)


def support_rows(graph: SupportGraph) -> tuple[SupportRow, ...]:
    """Say of each support what it is, how often it was found and why."""
    colour = {o.id: colours.object_colour(o.label) for o in graph.objects}
    return tuple(
        SupportRow(
            s.supporter,
            colour[s.supporter],
            s.supported,
            colour[s.supported],
            s.kind,
            s.certain,
            f"{s.occurrences} of {s.opportunities}",
            s.why,
        )
        for s in graph.supports
    )


def point_rows(decision: Decision | None) -> tuple[PointRow, ...]:
    """Say of each point of interest what it is about, the most salient first."""
    points = () if decision is None else decision.points_of_interest
    return tuple(
        PointRow(
            " – ".join(p.subject) or "–", colours.saliency_colour(p.saliency), f"{p.saliency:.2f}", p.why
        )
        for p in sorted(points, key=lambda p: -p.saliency)
    )


def settings_rows(settings: Mapping[str, object]) -> list[tuple[str, str]]:
    """Flatten settings, dataclasses and mappings inside them, to pairs `stage.name`, value."""
    rows = []
    for name, value in settings.items():
        if is_dataclass(value) and not isinstance(value, type):
            value = {f.name: getattr(value, f.name) for f in fields(value)}
        if isinstance(value, Mapping):
            rows += [(f"{name}.{inner}", said) for inner, said in settings_rows(value)]
        else:
            rows.append((str(name), f"{value:g}" if isinstance(value, float) else str(value)))
    return rows


def _object_row(item: SceneObject, graph: SupportGraph) -> ObjectRow:
    surface = item.role == "support_surface"
    stability = graph.stability.get(item.id)
    unseen = [face for face, seen in zip(FACES, item.seen, strict=True) if not seen]
    supporters = [s.supporter if s.certain else f"{s.supporter}?" for s in graph.supporters(item.id)]
    if stability is None:
        verdict, ratio, overhang = "–" if surface else "not tested", "–", "–"
    else:
        tests = [n for n, fired in (("small area", stability.small_area), ("tips", stability.tips)) if fired]
        verdict = ", ".join(tests) or "stable"
        ratio, overhang = f"{stability.ratio:.2f}", _whole(1e3 * stability.overhang)
    return ObjectRow(
        item.id,
        colours.object_colour(item.label),
        item.shape.kind,
        _size(item.shape),
        f"{item.occurrences} of {item.opportunities}",
        "none" if not unseen else "all" if len(unseen) == len(FACES) else " ".join(unseen),
        f"{item.residual * 1e3:.1f}",
        item.poor_fit,
        verdict,
        stability is not None and not stability.stable,
        ratio,
        overhang,
        "–" if surface else ", ".join(supporters) or "nothing known",
        surface,
        f"{item.why}; doubtful: {item.doubt}" if item.doubt else item.why,
    )


def _whole(value: float) -> str:
    return f"{value:.0f}".replace("-", "−") if np.isfinite(value) else "–"


def _size(shape: Shape) -> str:
    """Sizes in millimetres."""
    match shape:
        case Cylinder():
            return f"⌀ {2e3 * shape.radius:.0f}, {1e3 * shape.height:.0f} long"
        case Sphere():
            return f"⌀ {2e3 * shape.radius:.0f}"
    return " × ".join(f"{1e3 * e:.0f}" for e in shape.extents)
