"""What the tables and lines of a cell say, in words."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from caryatid.viz.colours import object_colour
from caryatid.viz.notebook.cell import Entry, Table
from caryatid.viz.rows import object_rows, point_rows, support_rows

if TYPE_CHECKING:
    from caryatid.geometry.shapes import Shape
    from caryatid.geometry.transforms import Array
    from caryatid.graph import SupportGraph
    from caryatid.manipulation.order import Order
    from caryatid.planning.decision import Decision
    from caryatid.sensing.views import View


def census(graph: SupportGraph) -> str:
    """Count the objects and supports of a graph."""
    objects = sum(o.role == "object" for o in graph.objects)
    uncertain = sum(not s.certain for s in graph.supports)
    said = f"{_counted(objects, 'object')}, {_counted(len(graph.supports), 'support')}"
    return f"{said}, {uncertain} of them uncertain" if uncertain else said


def of_graph(graph: SupportGraph) -> tuple[Table, ...]:
    """Tables of a graph's objects and of its supports."""
    objects = Table(
        "Objects",
        ("id", "shape", "size [mm]", "found in", "sides not seen", "stands", "held by"),
        tuple(
            (
                Entry(row.id, row.colour),
                Entry(row.shape),
                Entry(row.size),
                Entry(f"{row.seen} views"),
                Entry(row.unseen),
                Entry(row.stability),
                Entry(row.supporters),
            )
            for row in object_rows(graph)
        ),
    )
    supports = Table(
        "Supports",
        ("supporter", "supported", "kind", "found in", "why"),
        tuple(
            (
                Entry(row.supporter, row.supporter_colour),
                Entry(row.supported, row.supported_colour),
                Entry(row.kind if row.certain else f"{row.kind}, uncertain"),
                Entry(f"{row.evidence} views"),
                Entry(row.why),
            )
            for row in support_rows(graph)
        ),
    )
    return objects, supports


def of_points(decision: Decision | None) -> tuple[Table, ...]:
    """The table of points of interest, the most salient first; none where there are none."""
    rows = tuple((Entry(r.subject), Entry(r.saliency), Entry(r.why)) for r in point_rows(decision))
    return (Table("Points of interest", ("about", "saliency", "why"), rows),) if rows else ()


def of_order(order: Order) -> Table:
    """The table of what to take, one after the other."""
    rows = tuple(
        (
            Entry(str(number)),
            Entry(step.object_id, object_colour(int(step.object_id[1:]))),
            Entry(", ".join(step.hold) or "–"),
            Entry("yes" if step.safe else f"no, risk {step.risk:.0%}"),
            Entry(step.why),
        )
        for number, step in enumerate(order.steps, 1)
    )
    return Table("Steps", ("", "take", "hold", "safe", "why"), rows, unfolded=True)


def readings_of(view: View) -> str:
    """Say how much of a depth image holds a reading, and from where to where."""
    depth = view.depth[view.valid]
    if depth.size == 0:
        return "none"
    near, far = np.percentile(depth, (1.0, 99.0))
    return f"{view.valid.mean():.0%} of the pixels, {near:.2f} to {far:.2f} m"


def pose_of(T_world_camera: Array | None) -> str:
    """Say where a camera stands and how it looks down from its pose (4, 4), or that this is not known."""
    if T_world_camera is None:
        return "pose not known"
    x, y, z = T_world_camera[:3, 3]
    down = np.degrees(np.arcsin(np.clip(-T_world_camera[2, 2], -1.0, 1.0)))
    return f"at {x:.2f}, {y:.2f}, {z:.2f} m, looking {down:.0f}° down".replace("-", "−")


def lean_of(shape: Shape) -> str:
    """Say by what angle the nearest to vertical of its axes leans; for a cylinder, its own axis."""
    vertical = np.abs(shape.T_world_object[2, :3])
    upright = vertical[2] if shape.kind == "cylinder" else vertical.max()
    return f"{np.degrees(np.arccos(np.clip(upright, 0.0, 1.0))):.0f}° off the vertical"


def size_of(shape: Shape) -> str:
    """Say the sizes of a shape in millimetres."""
    match shape.size:
        case [x, y, z]:
            return f"{1e3 * x:.0f} × {1e3 * y:.0f} × {1e3 * z:.0f} mm"
        case {"radius": radius, "height": height}:
            return f"⌀ {2e3 * radius:.0f} mm, {1e3 * height:.0f} mm long"
        case {"radius": radius}:
            return f"⌀ {2e3 * radius:.0f} mm"
    raise ValueError(f"no shape has the size {shape.size}")


def _counted(number: int, name: str) -> str:
    return f"{number} {name}" if number == 1 else f"{number} {name}s"
