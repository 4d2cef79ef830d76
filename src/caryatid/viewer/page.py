"""The page: the scene after each view, a slider over the views, and panels with details."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from html import escape
from threading import RLock
from typing import Any

import numpy as np

from caryatid.config import SupportConfig
from caryatid.errors import InputError
from caryatid.exploration import Step
from caryatid.graph import SupportGraph
from caryatid.objects.reasons import Reasons
from caryatid.scene import Scene
from caryatid.sensing.view_sphere import direction
from caryatid.support.relations import removal_of
from caryatid.viewer.door import Door
from caryatid.viewer.drawing import LAYERS, NEXT, SceneDrawing, reduced, step_of_scene, thinned
from caryatid.viz.colours import SALIENCY_STOPS, object_colour, scale
from caryatid.viz.drawings import draw_chart
from caryatid.viz.graph_drawing import draw_graph
from caryatid.viz.notebook import cell_html
from caryatid.viz.pictures import Picture, raster
from caryatid.viz.report import Figure, Section
from caryatid.viz.tables import census, noticed, object_table, support_table


class Page:
    """A viewer in the browser, served by this process.

    Steps are added from any thread and drawn in the page's thread; if they arrive faster than they can be
    drawn, only the newest is drawn.

    Args:
        title: Title of the page.
        support: Settings with which the graphs were inferred, to predict which objects move.
        host: Address to listen on; on 127.0.0.1, only programs on this machine can connect.
        port: Port to listen on; if taken, the next free one; 0 = any free port.
        small: Fold the panels at first, for a small page such as in a notebook.

    Attributes:
        url: Address of the page, with the token that it requires.
        server: The `viser.ViserServer`, to add controls to.
        drawing: The scene in the page.
        steps: The steps added so far.
        scores: F1 after each step, or None without ground truth.
        why: Says why an object of the newest step has its shape, or None: then only its last step tells.
        working: Lock for computing: two threads would change each other's number of BLAS threads.

    Raises:
        InputError: viser is not installed, or the page cannot be served.
    """

    def __init__(
        self,
        title: str,
        support: SupportConfig | None = None,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        small: bool = False,
    ) -> None:
        self.working = RLock()
        self._door = Door(title, host, port)
        self.server, self.url = self._door.server, self._door.url
        self.steps: list[Step] = []
        self.scores: list[float | None] = []
        self.why: Callable[[str], Reasons] | None = None
        self.drawing = SceneDrawing(self.server, self.describe)
        self._support, self._small = support or SupportConfig(), small
        self._shown, self._chosen = -1, ""
        self._staged: Step | None = None
        self._drawer = ThreadPoolExecutor(1, "viewer")
        self._pending: Future[None] | None = None
        self._build()

    def say(self, text: str) -> None:
        """Show a message at the top of the page, replacing the previous one."""
        self._notice.content = cell_html(Section("", text))
        self._notice.visible = bool(text)

    def add(self, step: Step, f1: float | None = None) -> None:
        """Add a step, or replace the step of the same view; a page at the newest step follows."""
        newest = self._shown == len(self.steps) - 1
        if step.index == len(self.steps) > 0:
            self.steps[-1] = thinned(self.steps[-1])
        self.steps[step.index : step.index + 1] = [reduced(step)]
        self.scores[step.index : step.index + 1] = [f1]
        if newest:
            self._shown = len(self.steps) - 1
        if len(self.steps) == 1:
            self._look_at(step)
        self.redraw()

    def update(self, scene: Scene) -> None:
        """Add the current state of a scene; the slider goes back to earlier states."""
        if scene.views:
            self.why = scene.why
            self.add(step_of_scene(scene))

    def show_layer(self, name: str, visible: bool) -> None:
        """Show or hide one of `LAYERS`."""
        self._boxes[name].value = visible
        self.drawing.show_layer(name, visible)
        self.redraw()

    def go_to(self, index: int) -> None:
        """Show the scene after a view."""
        index = min(max(index, 0), len(self.steps) - 1)
        if index != self._shown:
            self._shown = index
            self._staged = None
            self.redraw()

    def describe(self, object_id: str) -> None:
        """Show the details of an object."""
        self._chosen = object_id
        self.redraw()

    def stage(self, step: Step | None) -> None:
        """Show a step without adding it; None returns to the added steps."""
        if step is not self._staged:
            self._staged = step
            self.redraw()

    def in_turn(self, steps: Iterator[Step]) -> Iterator[Step]:
        """Compute steps one by one, each while this page computes nothing."""
        while True:
            with self.working:
                step = next(steps, None)
            if step is None:
                return
            yield step

    def redraw(self) -> None:
        """Schedule drawing, unless it is already scheduled."""
        if self._pending is None or self._pending.running() or self._pending.done():
            with contextlib.suppress(RuntimeError):  # The page is being closed.
                self._pending = self._drawer.submit(self._draw)
                self._pending.add_done_callback(_log_failure)

    def wait(self) -> None:
        """Wait until everything is drawn, and raise drawing errors."""
        self._drawer.submit(lambda: None).result()
        if self._pending is not None:
            self._pending.result()

    def close(self) -> None:
        """Stop serving the page."""
        self._drawer.shutdown(wait=True, cancel_futures=True)
        self._door.close()

    def _repr_html_(self) -> str:
        """The page in a notebook cell."""
        return f'<iframe src="{escape(self.url)}" width="100%" height="620" style="border:0"></iframe>'

    def _build(self) -> None:
        gui = self.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=NEXT)
        self.server.scene.set_up_direction("+z")
        self._notice = gui.add_html("", order=-20, visible=False)
        hint = "Go back to an earlier view"
        # Without an order, a later page of the same process would have it below the layers.
        self._slider = gui.add_slider("view", 1, 2, 1, 1, order=0, visible=False, hint=hint)
        self._slider.on_update(lambda _: self.go_to(int(self._slider.value) - 1))
        self._summary = gui.add_html("", order=1)
        self._boxes: dict[str, Any] = {}
        with gui.add_folder("show", order=90):
            for name, shown in LAYERS.items():
                box = self._boxes[name] = gui.add_checkbox(name, shown)
                box.on_update(lambda event, name=name: self.show_layer(name, event.target.value))
            self._true_colours = gui.add_checkbox("camera colours", False)
            self._size = gui.add_slider("point size [mm]", 1.0, 12.0, 0.5, 3.0)
        for control in (self._true_colours, self._size):
            control.on_update(lambda _: self.redraw())
        panel, about = gui.add_panel(), gui.add_panel()
        with panel.add_tab("supports"):
            self._graph = gui.add_html("")
        with panel.add_tab("F1"):
            self._chart = gui.add_html(cell_html(Section("", "No ground truth available.")))
        with panel.add_tab("key"):
            gui.add_html(_describe_signs())
        with about.add_tab("object"):
            hint = "Click an object in the scene to see its details."
            self._about = gui.add_html(cell_html(Section("", hint)))
        panel.dock_left()
        panel.set_width(380)
        about.dock_below(panel)
        if self._small:
            panel.minimize()
        else:
            gui.main_panel.dock_right()

    def _look_at(self, step: Step) -> None:
        """Place the initial viewpoint in front of the objects, beside the first camera."""
        x, y = step.visited[0][:2] if len(step.visited) else (-1.0, 0.0)
        azimuth = float(np.arctan2(y + 0.5 * x, x - 0.5 * y))
        outlines = [item.shape.outline() for item in step.graph.objects if item.role == "object"]
        points = np.concatenate(outlines or [step.sphere.centre_world[None]])
        low, high = points.min(axis=0), points.max(axis=0)
        centre, reach = (low + high) / 2.0, max(float(np.linalg.norm(high - low)) / 2.0, 0.15)
        camera = self.server.initial_camera
        camera.look_at = centre
        camera.fov = 0.72  # Narrow, so that near objects do not hide far ones [rad].
        camera.position = centre + 3.2 * reach * direction(azimuth, 0.55)  # From 3.2 radii, all objects fit.

    def _draw(self) -> None:
        steps, scores, chosen = self.steps[: self._shown + 1], [*self.scores], self._chosen
        if not steps:
            return
        step, f1 = steps[-1], scores[self._shown]
        if self._staged is not None:
            step, f1 = self._staged, None
        count, graph = len(self.steps), step.graph
        before = steps[-2] if len(steps) > 1 else None
        texts = [(self._summary, describe_view(step, f1, count, before))]
        drawn = Figure("", draw_graph(graph, compact=True))
        texts.append((self._graph, cell_html(Section("", figures=[drawn]))))
        if any(f1 is not None for f1 in scores):
            known = [np.nan if f1 is None else f1 for f1 in scores]
            chart = Figure("", draw_chart("F1 after each view", "F1", {"F1": known}, top=1.0))
            texts.append((self._chart, cell_html(Section("", figures=[chart]))))
        if chosen:
            with self.working:
                gone = {each.lift.object_id for each in steps if each.lift is not None}
                taken = chosen in gone | {o.id for o in steps[-1].graph.objects}
                why = self._reasons_of(chosen, step)
                text = describe_object(graph, chosen, self._support, taken=taken, reasons=why)
                texts.append((self._about, text))
        look = {"point_size": self._size.value / 1000.0, "true_colours": self._true_colours.value}
        # Scene and texts change together.
        with self.server.atomic():
            self.drawing.show(step, steps, chosen=chosen, **look)
            self._slider.visible = count > 1
            self._slider.max = max(count, 2)
            self._slider.value = self._shown + 1
            for panel, text in texts:
                panel.content = text

    def _reasons_of(self, object_id: str, step: Step) -> Reasons | None:
        """Why an object has its shape after a step; None if that is unknown."""
        if self.why is not None and step is self.steps[-1]:
            with contextlib.suppress(InputError):
                return self.why(object_id)
        return next((reasons for reasons in step.reasons if reasons.subject == (object_id,)), None)


def show(scene: Scene, *, host: str = "127.0.0.1", port: int = 0) -> Page:
    """Open a page that shows a scene.

    Args:
        scene: A scene with any number of views.
        host: Address to listen on; on 127.0.0.1, only programs on this machine can connect.
        port: Port to listen on; if taken, the next free one; 0 = any free port.

    Returns:
        The page with its `url`, `update(scene)` and `close()`; a notebook displays it.

    Raises:
        InputError: viser is not installed.
    """
    page = Page("caryatid", scene.config.support, host=host, port=port, small=True)
    page.update(scene)
    return page


# Texts beside the scene


def describe_view(step: Step, f1: float | None, count: int, before: Step | None = None) -> str:
    """Describe the scene after a view, what happened since the step before, and what comes next."""
    facts = [] if f1 is None else [("F1", f"{f1:.3f}")]
    facts += [(change.kind, f"{change.object_id}: {change.why}") for change in noticed(before, step)]
    if step.removal is not None:
        facts.append((f"without {step.removal.object_id}", str(step.removal)))
    if step.lift is not None:
        facts.append(("removed", f"{step.lift.object_id}: {step.lift.why}"))
    if step.stop is not None:
        facts.append(("finished", step.stop))
    elif step.decision is not None:
        facts.append(("next", step.decision.why))
    return cell_html(Section(f"View {step.index + 1} of {count}", census(step.graph), facts=facts))


def _describe_signs() -> str:
    """Explain the symbols in the scene."""
    signs = {
        "Arrow": "supporter → supported; thicker = more probable, dashed = doubtful. "
        "Supports by a support surface are drawn only if doubtful",
        "Number on an arrow": "probability of the support, if below 1",
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
    return cell_html(Section("Key", facts=[*signs.items()], figures=[Figure("", picture, caption)]))


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
        facts += [(f"Without {object_id}", text) for text in moves]
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


def _log_failure(drawn: Future[None]) -> None:
    """Log an error of the drawing thread; the page keeps showing the step before."""
    error = None if drawn.cancelled() else drawn.exception()
    if error is not None:
        logging.getLogger(__name__).error("the viewer failed to draw a view", exc_info=error)
