"""What stands beside the scene: texts, the support graph, the image of a view, and removal orders."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from caryatid.config import SupportConfig
from caryatid.exploration import Step
from caryatid.graph import SupportGraph, TakeStep
from caryatid.manipulation.order import Order
from caryatid.objects.reasons import Reasons
from caryatid.sensing.views import View
from caryatid.support.relations import removal_of
from caryatid.viz.colours import SALIENCY_STOPS, object_colour, scale
from caryatid.viz.drawings import draw_chart, draw_image, image_of
from caryatid.viz.graph_drawing import draw_graph
from caryatid.viz.notebook import cell_html
from caryatid.viz.pictures import Picture, element, raster
from caryatid.viz.report import Figure, Section
from caryatid.viz.tables import census, describe_order, happenings, object_table, order_table, support_table

WIDTH = 380
"""Of pictures in a panel [px]."""


def describe_view(
    step: Step, f1: float | None, count: int, before: Step | None = None, order: Order | None = None
) -> str:
    """Describe the scene after a view, what happened since the step before, and what to do next."""
    facts = happenings(before, step)
    if order is not None and order.steps:
        first = order.steps[0]
        told = ["not safe"] * (not first.safe) + [f"hold {other}" for other in first.hold] + [first.why]
        facts.append(("lift first", f"{first.object_id}: {'; '.join(told)}"))
    elif order is not None:
        facts.append(("lift first", f"nothing: {order.refusal}"))
    facts += [] if f1 is None else [("F1", f"{f1:.3f}")]
    return cell_html(Section(f"View {step.index + 1} of {count}", census(step.graph), facts=facts))


def describe_object(
    graph: SupportGraph,
    object_id: str,
    config: SupportConfig,
    *,
    taken: bool = False,
    reasons: Reasons | None = None,
) -> str:
    """Describe an object: its edges, what moves without it, size, fit and reasons; or that it was removed."""
    item = next((o for o in graph.objects if o.id == object_id), None)
    if item is None:
        return cell_html(Section(object_id, "was removed" if taken else "not found up to this view"))
    facts = []
    for supporter, supported, kind, likely, found, why in support_table(graph).rows:
        if item.title in (supporter.text, supported.text):
            evidence = f"{kind.text}, probability {likely.text}, {found.text} views; {why.text}"
            facts.append((f"{supporter.text} → {supported.text}", evidence))
    if item.role == "object":
        removal = removal_of(graph, object_id, config)
        moves = [f"{e.object_id} moves with probability {e.probability:.2f}: {e.why}" for e in removal.moving]
        moves.append(f"nothing else moves with probability {removal.rest:.2f}")
        facts.insert(0, (f"Without {object_id}", "; ".join(moves)))
    table = object_table(graph)
    (row,) = (row for row in table.rows if row[0].text == item.title)
    facts += [(name, e.text) for name, e in zip(table.columns, row, strict=True) if e.text][2:]
    if reasons is not None:
        chosen, *others = reasons.options
        terms = {"points": chosen.points, "free space": chosen.free, "parameters": chosen.parameters}
        cost = ", ".join(f"{name} {nats:.0f}" for name, nats in terms.items())
        facts.append((f"Why {chosen.what}", f"it costs {chosen.total:.0f} nats: {cost}"))
        facts += [(f"{o.what} instead", f"{o.total - chosen.total:+.0f} nats") for o in others]
    return cell_html(Section(item.title, item.shape.kind, facts=facts, colour=object_colour(item.label)))


def describe_lifts(graph: SupportGraph, order: Order | None, lifts: Sequence[TakeStep], asked: str) -> str:
    """Describe an order, if there is one, and for what it was asked; and the lifts made so far."""
    parts = []
    if lifts:
        parts.append(cell_html(Section("Removed so far", facts=_list_lifts(Order(tuple(lifts)), graph))))
    if order is None:
        hint = "Plan an order to see what to lift first, and how surely nothing else moves."
        parts.append(cell_html(Section("", hint)))
    else:
        text = f"{asked}: {' '.join(describe_order(order, graph))}"
        parts.append(cell_html(Section("Order", text, facts=_list_lifts(order, graph))))
    return "".join(parts)


def _list_lifts(order: Order, graph: SupportGraph) -> list[tuple[str, str]]:
    """List the steps of an order: number and object, and how safe it is to lift it."""
    rows = ([entry.text for entry in row] for row in order_table(order, graph).rows)
    return [(f"{number}. {name}", f"{likely}; {why}") for number, name, likely, why in rows]


def draw_linked_graph(graph: SupportGraph, chosen: str, address: str) -> str:
    """Draw the support graph, its vertices linked to an address.

    All but the chosen one and its edges are faint; so are the edges of others while one is pointed at.
    """
    picture, parts = draw_graph(graph, compact=True), []
    names: list[str] = []
    for part in picture.parts:
        kind, *names = part.get("class", "").split() or ["note", *names]  # A note follows its edge.
        part.set("class", " ".join([kind, *names]))
        if chosen and chosen not in names:
            part.set("opacity", "0.3")
        if kind == "node":
            link = element("a", href=f"{address}/{names[0]}")
            link.append(part)
            part = link
        parts.append(part)
    linked = Picture(picture.name, picture.width, picture.height, parts)
    pointed = [f"svg:has(.node.{o.id}:hover) :is(.edge, .note):not(.{o.id})" for o in graph.objects]
    style = f"<style>{', '.join(pointed)} {{ opacity: 0.15 }}</style>" if pointed else ""
    return style + cell_html(Section("", figures=[Figure("", linked)]))


def _draw_pixels(view: View) -> Picture:
    image = image_of(view)
    height, width = image.shape[:2]
    size = float(WIDTH), WIDTH * height / width
    return Picture(view.name, *size, [raster(image, 0.0, 0.0, *size)])


IMAGES: dict[str, Callable[[View, Step], Picture]] = {
    "colour": lambda view, _: _draw_pixels(view),
    "segments and shapes": lambda view, step: draw_image(view, step.labels, step.graph, WIDTH),
    "segments": lambda view, step: draw_image(view, step.labels, step.graph, WIDTH, shapes=False),
    "depth": lambda view, _: _draw_pixels(View(view.depth, view.K, name=view.name)),
}
"""Ways to draw the image of a step's view; the first is cheap, because every view is drawn in it."""


def draw_view(step: Step, kind: str) -> str:
    """Draw the image of a step's view as one of `IMAGES`."""
    if step.view is None:
        return cell_html(Section("", "This view is a point cloud, without an image."))
    return cell_html(Section("", figures=[Figure("", IMAGES[kind](step.view, step))]))


def draw_scores(scores: Sequence[float | None]) -> str:
    """Draw F1 after each view."""
    values = [np.nan if f1 is None else f1 for f1 in scores]
    chart = draw_chart("F1 after each view", "F1", {"F1": values}, top=1.0)
    return cell_html(Section("", figures=[Figure("", chart)]))


def explain_signs() -> str:
    """Explain the buttons and the symbols in the scene."""
    signs = {
        "next view, run": "go there and look; look until no view is worth it",
        "plan": "find what to lift first, and then next, so that nothing else moves",
        "clear": "lift what is safe, look again, until nothing is left",
        "restart": "put everything back, and forget all views",
        "Arrow": "supporter → supported, at their contact; thicker = more probable, dashed = doubtful. "
        "Those from a support surface are drawn if doubtful, or if its object is chosen",
        "Number before a name": "its place in the order",
        "Number on an arrow": "probability of the support, if below 1",
        "Number in the graph": "views that found the object, of those that could have shown it",
        "Grid": "10 cm, under the support surface; red and green: x and y of the world, from x = y = 0",
        "Gripper": "how it grasps the object chosen, or the first of the order",
        "Coloured dots on the sphere": "candidate views that the robot can reach, coloured by saliency",
        "Fine grey dots": "views out of reach",
        "Balls with rays": "points of interest, and the views that show them best",
        "Grey robot": "where it stands, and as a line on the floor, the way it came",
        "Grey cameras": "earlier views with their images; the newest is black and larger",
        "Filled camera": "next view: blue = chosen by the planner, pink = chosen by hand",
    }
    bar = scale(np.tile(np.linspace(-1.0, 1.0, 340), (10, 1)), SALIENCY_STOPS)
    picture = Picture("saliency", 340.0, 10.0, [raster(bar, 0.0, 0.0, 340.0, 10.0)])
    caption = "Saliency: from low (already seen) to high (look here); the maximum of each view is red."
    keys = {"Esc": "deselect the object", "Page up, page down": "earlier and later view"}
    figures = [Figure("", picture, caption)]
    return cell_html(Section("Key", facts=[*signs.items(), *keys.items()], figures=figures))
