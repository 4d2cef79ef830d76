"""Tables of objects, supports, points of interest and orders; and a text of what a view changed."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from caryatid.geometry.shapes import Cylinder, Shape, Sphere, Uncertainty
from caryatid.graph import DOUBTFUL, Change, SceneObject, SupportGraph, label_of
from caryatid.viz.colours import object_colour, saliency_colour

if TYPE_CHECKING:
    from caryatid.exploration import Step
    from caryatid.manipulation.order import Order
    from caryatid.objects.reasons import Reasons
    from caryatid.planning.decision import Decision


class Entry(NamedTuple):
    """One cell of a table: text, colour `#rrggbb` of the chip before it, doubt; the id its row is about."""

    text: str
    colour: str = ""
    doubt: bool = False
    about: str = ""


class Table(NamedTuple):
    """A table, ready to print: what it is of, its columns' headings, its rows; the last column is widest."""

    heading: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Entry, ...], ...]

    @classmethod
    def of(cls, heading: str, columns: Iterable[str], rows: Iterable[Iterable[str | Entry]]) -> Table:
        """Make a table of rows in which plain texts may stand for entries."""
        entries = (tuple(e if isinstance(e, Entry) else Entry(e) for e in row) for row in rows)
        return cls(heading, tuple(columns), tuple(entries))


def object_table(graph: SupportGraph) -> Table:
    """Make the table of objects: shape, evidence and stability."""
    rows = [_object_row(item, graph) for item in graph.objects]
    return Table.of("Objects", rows[0] if rows else (), (row.values() for row in rows))


def _object_row(item: SceneObject, graph: SupportGraph) -> dict[str, str | Entry]:
    surface, stability = item.role == "support_surface", graph.stability.get(item.id)
    faces = ("−x", "+x", "−y", "+y", "−z", "+z")
    unseen = " ".join(face for face, seen in zip(faces, item.seen, strict=True) if not seen)
    supporters = ", ".join(s.supporter + "?" * s.doubtful for s in graph.supporters(item.id))
    verdict = "–" if surface else "not tested"
    if stability is not None:
        found = ["small area"] * stability.small_area + ["tips"] * stability.tips
        overhang = f", overhang\u00a0{1e3 * stability.overhang:.0f}" * bool(np.isfinite(stability.overhang))
        verdict = f"{', '.join(found) or 'stable'}; r_s\u00a0{stability.ratio:.2f}" + overhang.replace(
            "-", "−"
        )
    centre = ",\u00a0".join(str(round(1e3 * x)) for x in item.centre_world.tolist()).replace("-", "−")
    if item.uncertainty is not None:
        centre += f" ±\u00a0{1e3 * item.uncertainty.position.max():.2g}"
    return {
        "id": Entry(item.title, object_colour(item.label), about=item.id),
        "shape": item.shape.kind,
        "size ± σ [mm]": size_of(item.shape, item.uncertainty),
        "centre ± σ [mm]": centre,
        "in views": f"{item.occurrences} of {item.opportunities}",
        "probability": "–" if item.probability is None else f"{item.probability:.2f}",
        "sides unseen": (unseen or "none") if any(item.seen) else "all",
        "residual [mm]": Entry(
            f"{item.residual * 1e3:.1f}{' poor fit' * item.poor_fit}", doubt=item.poor_fit
        ),
        "supported by": "–" if surface else supporters or "unknown",
        "stability": Entry(verdict, doubt=stability is not None and not stability.stable),
        "evidence": "; ".join(filter(None, (item.why, f"doubtful: {item.doubt}" * bool(item.doubt)))),
    }


def support_table(graph: SupportGraph) -> Table:
    """Make the table of supports: kind, probability and evidence."""
    shown = {o.id: Entry(o.title, object_colour(o.label)) for o in graph.objects}
    rows = (
        (
            shown[s.supporter],
            shown[s.supported],
            s.kind,
            Entry(f"{s.belief:.2f}{', doubtful' * s.doubtful}", doubt=s.doubtful),
            f"{s.occurrences} of {s.opportunities}",
            s.why,
        )
        for s in graph.supports
    )
    columns = ("supporter", "supported", "kind", "probability", "found in views", "evidence")
    return Table.of("Supports", columns, rows)


def reason_table(reasons: Sequence[Reasons], graph: SupportGraph) -> Table:
    """Make the table of what objects cost as what they are, and as what costs least otherwise [nats]."""
    shown = {o.id: Entry(o.title, object_colour(o.label)) for o in graph.objects}
    rows: list[tuple[str | Entry, ...]] = []
    for reason in reasons:
        (object_id,), (chosen, *others) = reason.subject, reason.options
        terms = (chosen.points, chosen.free, chosen.parameters, chosen.total)
        otherwise = f"{others[0].what} {others[0].total - chosen.total:+.0f}" if others else "–"
        otherwise += f" ({others[0].note})" if others and others[0].note else ""
        rows.append((shown[object_id], chosen.what, *(f"{nats:.0f}" for nats in terms), otherwise))
    columns = ("object", "explanation", "points", "free space", "parameters", "total", "next best")
    return Table.of("Why these shapes: costs in nats", columns, rows)


def point_table(decision: Decision | None) -> Table:
    """Make the table of points of interest, the most salient first."""
    points = () if decision is None else sorted(decision.points_of_interest, key=lambda p: -p.saliency)
    rows = (
        (" – ".join(p.subject) or "–", Entry(f"{p.saliency:.2f}", saliency_colour(p.saliency)), p.why)
        for p in points
    )
    return Table.of("Points of interest", ("objects", "saliency", "reason"), rows)


def describe_order(order: Order, graph: SupportGraph | None = None) -> list[str]:
    """Say what to remove in which order and how safe that is, what is refused, and what was not checked.

    Objects have the names of a graph, if it is given.
    """
    listed = _name_lifts(order, graph)
    safe = next((k for k, step in enumerate(order.steps) if not step.safe), len(listed))
    lead = "safe order" if order.safe else "safe as far as it goes"
    if safe < len(listed):
        first = f"safe at first: {', '.join(listed[:safe])}; then" if safe else "no lift is safe;"
        lead, listed = f"{first} the least risky", listed[safe:]
    line = f"{lead} (nothing else moves: {1.0 - order.risk:.0%}): {', '.join(listed)}"
    unchecked = f"not checked: {order.unchecked}" * bool(order.unchecked)
    texts = (line if order.steps else "no lift is possible", order.refusal, unchecked)
    return [sentence(text) for text in texts if text]


def order_table(order: Order, graph: SupportGraph | None = None, *, brief: bool = False) -> Table:
    """Make the table of the steps of an order, with the names of a graph; if brief, of those not alike.

    Alike are safe steps with the lowest risk, without a hold or a grasp.
    """
    listed = _name_lifts(order, graph)
    least = min((step.risk for step in order.steps), default=0.0) + 0.005
    rows = (
        (
            str(number),
            Entry(listed[number - 1], object_colour(label_of(step.object_id))),
            Entry(f"{1.0 - step.risk:.2f}{'' if step.safe else ', too low'}", doubt=not step.safe),
            step.why,
        )
        for number, step in enumerate(order.steps, 1)
        if not brief or step.hold or step.grasp or not step.safe or step.risk > least
    )
    columns = ("step", "remove", "probability", "reason")
    return Table.of(f"Steps {order.gripper}".strip(), columns, rows)


def _name_lifts(order: Order, graph: SupportGraph | None) -> list[str]:
    """Name what each step of an order lifts, and what the other hand holds."""
    names = {} if graph is None else {o.id: o.title for o in graph.objects}
    held = (f" (hold {' and '.join(names.get(i, i) for i in s.hold)})" * bool(s.hold) for s in order.steps)
    return [names.get(s.object_id, s.object_id) + hold for s, hold in zip(order.steps, held, strict=True)]


def describe_removed(lifts: Sequence[Mapping[str, Any]]) -> list[str]:
    """Say what was removed (`lifts` of run.json), and what moved with it; nothing if there were no lifts."""
    done = [lift for lift in lifts if lift["body"] is not None]
    names = (x["object"] + "".join(f" ({held} held)" for held in x["held"]) for x in done)
    moved = "; ".join(f"{', '.join(x['disturbed'])} moved with {x['object']}" for x in done if x["disturbed"])
    return [f"Removed, in this order: {', '.join(names)}; {moved or 'nothing else moved'}."] if done else []


def size_of(shape: Shape, uncertainty: Uncertainty | None = None) -> str:
    """Return the size of a shape as text [mm], with its standard deviations if they are given."""
    axes = (0, 2) if isinstance(shape, Cylinder) else (0,) if isinstance(shape, Sphere) else (0, 1, 2)
    sigma = ["", "", ""] if uncertainty is None else [f"±{1e3 * x:.2g}" for x in uncertainty.sizes]
    sizes = [f"{1e3 * shape.extents[axis]:.0f}{sigma[axis]}" for axis in axes]
    return "⌀ " * isinstance(shape, Cylinder | Sphere) + " × ".join(sizes)


def count_of(number: int, name: str) -> str:
    """Return a number and a noun in the singular or plural."""
    ending = "" if number == 1 else "es" if name.endswith("x") else "s"
    return f"{number:,} {name}{ending}"


def census(graph: SupportGraph) -> str:
    """Count the objects and supports of a graph."""
    surfaces, doubtful = len(graph.support_surfaces), sum(s.doubtful for s in graph.supports)
    objects = count_of(len(graph.movable), "object")
    on = f" on {surfaces} support surfaces" if surfaces > 1 else ""
    text = f"{objects}{on}, {count_of(len(graph.supports), 'support')}"
    return f"{text}, {doubtful} of them doubtful" if doubtful else text


def doubts(graph: SupportGraph) -> list[tuple[str, str, tuple[str, ...]]]:
    """List doubtful supports and objects, why and what view would help, with ids; most doubtful first.

    An object is doubtful if it has no known supporter, its shape fits poorly or is implausible, or the
    probability that its pose and size are about right is low. What both of two objects are doubtful for, such
    as an overlap, is listed once.
    """
    found, told = list[tuple[str, str, tuple[str, ...]]](), set[tuple[str, frozenset[str]]]()
    for s in sorted(graph.supports, key=lambda s: abs(s.belief - 0.5)):
        if s.doubtful:
            lead = f"{graph[s.supporter].title} → {graph[s.supported].title}, probability {s.belief:.2f}"
            found.append((lead, f"{s.why.rstrip('.')}. {_settled_by(graph, *s.pair)}", s.pair))
    for item in graph.objects:
        poor = f"the points are {1e3 * item.residual:.1f} mm off the shape on average"
        known = item.role == "support_surface" or graph.supporters(item.id)
        reasons = [poor] * item.poor_fit
        for doubt in filter(None, item.doubt.split("; ")):
            what, *words = doubt.split()
            about = what, frozenset([item.id, *(word for word in words if word in graph)])
            reasons += [doubt] * (about not in told)
            told.add(about)
        reasons += ["its supporter is unknown"] * (not known)
        if item.probability is not None and item.probability <= DOUBTFUL:
            reasons.append(f"its pose and size are about right with probability {item.probability:.2f} only")
        if reasons:
            found.append((item.title, f"{'; '.join(reasons)}. {_settled_by(graph, item.id)}", (item.id,)))
    return found


def sides_to_see(graph: SupportGraph) -> list[tuple[SceneObject, int]]:
    """List unseen sides of what is doubtful: objects, and the azimuth [°] from where one can be seen."""
    items = {name: graph[name] for *_, ids in doubts(graph) for name in ids}.values()
    return [(item, side) for item in items for side in _unseen(item) if side is not None]


def _unseen(item: SceneObject) -> list[int | None]:
    """Azimuths [°] from where unseen sides of an object can be seen; None is above."""
    if item.role == "support_surface" or not any(item.seen):
        return []
    R = item.shape.T_world_object[:3, :3]
    outward = np.stack([-R.T, R.T], axis=1).reshape(6, 3)  # −x, +x, −y, …
    sides = outward[~np.array(item.seen) & (outward[:, 2] > -0.5)]
    return [None if z > 0.8 else round(float(np.degrees(np.arctan2(y, x)))) % 360 for x, y, z in sides]


def _settled_by(graph: SupportGraph, *ids: str) -> str:
    """Where to look to see the unseen sides of objects."""
    sides = {i: ["above" if a is None else f"azimuth {a}°" for a in _unseen(graph[i])] for i in ids}
    views = [f"{name} from {' and '.join(places)}" for name, places in sides.items() if places]
    if views:
        return f"Look at {'; '.join(views)}: no view shows that side."
    return "All visible sides were seen; the rest is noise, or hidden between objects."


def describe(graph: SupportGraph) -> str:
    """Describe a scene model in plain text: objects, what supports them, what is free, what is doubtful."""
    titles = {o.id: o.title for o in graph.objects}
    sizes = "sizes in mm along an object's own axes (x × y × z, or ⌀ × length), and its height"
    lines = [f"{census(graph)}; {sizes}; probabilities in brackets"]
    for item in graph.objects:
        held = [f"{titles[s.supporter]} ({s.belief:.2f})" for s in graph.supporters(item.id)]
        role = f"supported by {' and '.join(held) or 'something unseen'}"
        if item.role == "support_surface":
            role = "support surface"
        high = 1e3 * float(item.shape.support(np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])).sum())
        lines.append(f"- {item.title}: {item.shape.kind} {size_of(item.shape)}, {high:.0f} high, {role}")
    holding = {s.supporter for s in graph.supports}
    free = [o.title for o in graph.movable if o.id not in holding]
    lines.append(f"support nothing (`caryatid order` rehearses lifting them): {', '.join(free) or 'none'}")
    doubtful = [f"- {lead}: {reason}" for lead, reason, _ in doubts(graph)]
    return "\n".join([*lines, f"doubtful: {'' if doubtful else 'nothing'}".rstrip(), *doubtful]) + "\n"


def sentence(text: str) -> str:
    """Begin with a capital, unless with an id, and end with a full stop."""
    first = text[:1] if text[1:2].isdigit() else text[:1].upper()
    return f"{first}{text[1:].rstrip('.')}." if text else ""


def noticed(before: Step | None, step: Step) -> list[Change]:
    """List what happened to objects before a view, without the lift after the view before."""
    lifted = None if before is None or before.lift is None else before.lift.object_id
    return [c for c in step.changes if (c.kind, c.object_id) != ("removed", lifted)]


def happenings(before: Step | None, step: Step) -> list[tuple[str, str]]:
    """List what happened to objects before and after a view, and last what comes next or why nothing does."""
    told: list[tuple[str, str]] = [(c.kind, f"{c.object_id}: {c.why}") for c in noticed(before, step)]
    if step.removal is not None:
        told.append((f"without {step.removal.object_id}", str(step.removal)))
    if step.lift is not None:
        told.append(("removed", f"{step.lift.object_id}: {step.lift.why}"))
    if step.stop is not None:
        told.append(("finished", step.stop))
    elif step.decision is not None:
        told.append(("next", step.decision.why))
    return told


def changes(before: Step | None, step: Step) -> dict[str, list[str]]:
    """List the changes of a view: the objects found, changed (`now`), and gone, where there are any.

    Those that were lifted, or `noticed` as removed, are not listed as gone.
    """
    known, now = {} if before is None else _supported(before.graph), _supported(step.graph)
    names = {} if before is None else {o.id: o.title for o in before.graph.objects}
    lifts = [each.lift for each in (before, step) if each is not None and each.lift is not None]
    told = {lift.object_id for lift in lifts} | {c.object_id for c in step.changes if c.kind == "removed"}
    lines = {
        "found": [text for id_, text in now.items() if id_ not in known],
        "now": [text for id_, text in now.items() if known.get(id_, text) != text],
        "gone": [names[id_] for id_ in known if id_ not in now and id_ not in told],
    }
    return {kind: items for kind, items in lines.items() if items}


def _supported(graph: SupportGraph) -> dict[str, str]:
    """Shape and supporters of each object by id; doubtful supporters with a question mark.

    The support surface is the table if it is the only one.
    """
    only, texts = len(graph.support_surfaces) == 1, {}
    for item in graph.objects:
        supporters = sorted(graph.supporters(item.id), key=lambda s: s.supporter)
        names = [
            ("the table" if only and graph[s.supporter].role != "object" else graph[s.supporter].title)
            + "?" * s.doubtful
            for s in supporters
        ]
        if item.role == "object":
            held = f"supported by {' and '.join(names) or 'something unseen'}"
            about = f"{item.id} ({item.shape.kind})"
            about = f"{item.name} ({item.id}, {item.shape.kind})" if item.name else about
            texts[item.id] = f"{about} {held}"
    return texts
