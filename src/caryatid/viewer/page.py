"""The page: the scene after each view, a slider over the views, and panels with details."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from html import escape
from threading import Event, RLock
from typing import Any, get_args

import numpy as np

from caryatid.config import GRIPPERS, Config, GripperConfig, GripperKind, choose_gripper
from caryatid.errors import CaryatidError, InputError, in_one_line
from caryatid.exploration import Step
from caryatid.geometry import transforms
from caryatid.graph import SupportGraph
from caryatid.manipulation.order import Order, plan_order
from caryatid.runtime.parallel import cores
from caryatid.scene import Scene
from caryatid.sensing.view_sphere import direction
from caryatid.viewer import drawing, panels
from caryatid.viewer.door import Door
from caryatid.viz.notebook import cell_html
from caryatid.viz.report import Section

ALL = "all objects"
"""Goal of an order that removes everything."""


class Page:
    """A viewer in the browser, served by this process.

    Steps are added from any thread and drawn in the page's thread; if they arrive faster than they can be
    drawn, only the newest is drawn. What is shown follows from the steps, the view and the object chosen, and
    the last order; all panels change together.

    Args:
        title: Title of the page.
        config: Settings of the run, to predict which objects move and to plan orders.
        host: Address to listen on; on 127.0.0.1, only programs on this machine can connect.
        port: Port to listen on; if taken, the next free one; 0 = any free port.
        seed: Seed of the rehearsals of orders.
        small: Fold the panels at first, for a small page such as in a notebook.

    Attributes:
        url: Address of the page, with the token that it requires.
        server: The `viser.ViserServer`, to add controls to.
        drawing: The scene in the page.
        steps: The steps added so far.
        scores: F1 after each step, or None without ground truth.
        find_scene: Returns the scene model after the newest step, or None: then only steps tell why objects
            have their shapes, and which space was seen free.
        working: Lock for computing: two threads would change each other's number of BLAS threads.

    Raises:
        InputError: viser is not installed, or the page cannot be served.
    """

    def __init__(
        self,
        title: str,
        config: Config | None = None,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        seed: int = 0,
        small: bool = False,
    ) -> None:
        self.working = RLock()
        self._door = Door(title, host, port, self.describe)
        self.server, self.url = self._door.server, self._door.url
        self.steps: list[Step] = []
        self.scores: list[float | None] = []
        self.find_scene: Callable[[], Scene] | None = None
        self.drawing = drawing.SceneDrawing(self.server, self.describe)
        self._config, self._seed, self._small = config or Config(), seed, small
        self._shown, self._chosen = -1, ""
        self._staged: Step | None = None
        self._planned: tuple[SupportGraph, Order, GripperConfig, str] | None = None
        self._drawer, self._worker = ThreadPoolExecutor(1, "viewer"), ThreadPoolExecutor(1, "loop")
        self._pending: Future[None] | None = None
        self._chart: Any = None
        self._busy, self._running, self._playing = False, Event(), Event()
        self._build()

    def say(self, text: str) -> None:
        """Show a message at the top of the page, replacing the previous one."""
        self._notice.content = cell_html(Section("", text))
        self._notice.visible = bool(text)

    def add(self, step: Step, f1: float | None = None) -> None:
        """Add a step, or replace the step of the same view; a page at the newest step follows."""
        newest = self._shown == len(self.steps) - 1
        if step.index == len(self.steps) > 0:
            self.steps[-1] = drawing.thin_cloud(self.steps[-1])
        self.steps[step.index : step.index + 1] = [drawing.reduce_step(step)]
        self.scores[step.index : step.index + 1] = [f1]
        if newest:
            self._shown = len(self.steps) - 1
        if len(self.steps) == 1:
            self._look_at(step)
        self.redraw()

    def forget(self) -> None:
        """Forget all steps, to begin again."""
        self.steps, self.scores = [], []  # Others may still be drawn.
        self._shown, self._chosen, self._staged, self._planned = -1, "", None, None

    def update(self, scene: Scene) -> None:
        """Add the current state of a scene; the slider goes back to earlier states."""
        if scene.views:
            self.find_scene = lambda: scene
            self.add(drawing.step_of_scene(scene))

    def show_layer(self, name: str, visible: bool) -> None:
        """Show or hide one of `LAYERS`."""
        self._boxes[name].value = visible
        self.drawing.show_layer(name, visible)
        self.redraw()

    def go_to(self, index: int) -> None:
        """Show the scene after a view."""
        index = min(max(index, 0), len(self.steps) - 1)
        if index != self._shown:
            self._playing.clear()
            self._shown = index
            self._staged = None
            self.redraw()

    def describe(self, object_id: str) -> None:
        """Show the details of an object; again, or with an empty id, those of none."""
        self._chosen = "" if object_id == self._chosen else object_id
        self.redraw()

    def stage(self, step: Step | None) -> None:
        """Show a step in place of the view shown, if it is of that view; None returns to what was added."""
        if step is not None and step.index != self._shown:
            step = None  # The user looks at another view.
        if step is not self._staged:
            self._staged = step
            self.redraw()

    def queue_work(self, what: str, work: Callable[[], str | None]) -> None:
        """Queue work, and show the message that it returns."""

        def done() -> None:
            self._show_state(what + " …", busy=True)
            try:
                said = work()
            except CaryatidError as error:
                said = f"{error}"
            except Exception as error:
                said = in_one_line(error)
            self._running.clear()
            self._show_state(said or "", busy=False)

        with contextlib.suppress(RuntimeError):  # The page is being closed.
            self._worker.submit(done)

    def plan_order(self) -> str:
        """Plan an order from the graph of the view shown, with the gripper and goal chosen; return a message.

        Raises:
            CaryatidError: There is nothing to lift.
        """
        step, goal = self.steps[self._shown], None if self._goal.value == ALL else self._goal.value
        graph, voxels = step.graph, step.voxels
        if self.find_scene is not None and step is self.steps[-1]:
            voxels = self.find_scene().voxels
        gripper = choose_gripper(self._gripper.value, self._config.gripper)
        config = replace(self._config, gripper=gripper)
        named = f"gripper {self._gripper.value}, goal {self._goal.value}"
        with self.working:
            order = plan_order(graph, config, goal=goal, seed=self._seed, threads=cores(), voxels=voxels)
        self._planned = graph, order, gripper, named
        return ""

    def play_order(self) -> str:
        """Show the lifts of the order one after the other, until another view is chosen; return a message."""
        step, gone = self.steps[self._shown], set[str]()
        if self._planned is None or self._planned[0] is not step.graph:
            return ""
        rising = [transforms.rigid(np.eye(3), (0.0, 0.0, height)) for height in np.linspace(0.0, 0.5, 8)[1:]]
        self._playing.set()
        for lift in self._planned[1].steps:
            self._show(drawing.take_away(step, gone, lift.object_id, {lift.object_id: T}) for T in rising)
            gone.add(lift.object_id)
            self._show([drawing.take_away(step, gone, lift.object_id, {})])
        self._playing.clear()
        self.stage(None)
        return ""

    def _show(self, film: Iterable[Step]) -> None:
        for picture in film:
            if self._playing.is_set():
                self.stage(picture)
                time.sleep(0.12)  # Time for which each picture of a lift is shown [s].

    def _show_state(self, text: str, *, busy: bool) -> None:
        self._busy = busy
        self.say(text)
        self.redraw()

    def redraw(self) -> None:
        """Schedule drawing, unless it is already scheduled."""
        if self._pending is None or self._pending.running() or self._pending.done():
            with contextlib.suppress(RuntimeError):  # The page is being closed.
                self._pending = self._drawer.submit(self._draw)
                self._pending.add_done_callback(_log_failure)

    def wait(self) -> None:
        """Wait until all requests are done and everything is drawn, and raise drawing errors."""
        self._worker.submit(lambda: None).result()
        self._drawer.submit(lambda: None).result()
        if self._pending is not None:
            self._pending.result()

    def close(self) -> None:
        """Finish the current work, then stop serving the page."""
        self._worker.shutdown(wait=False, cancel_futures=True)
        self._running.clear()
        self._playing.clear()
        self._worker.shutdown()
        self._drawer.shutdown(wait=True, cancel_futures=True)
        self._door.close()

    def _repr_html_(self) -> str:
        """The page in a notebook cell."""
        return f'<iframe src="{escape(self.url)}" width="100%" height="620" style="border:0"></iframe>'

    def _build(self) -> None:
        gui = self.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=drawing.NEXT)
        self.server.scene.set_up_direction("+z")
        self._summary = gui.add_html("", order=-30)
        self._notice = gui.add_html("", order=-20, visible=False)
        self._bar = gui.add_progress_bar(100, animated=True, order=-19, visible=False)
        # Without a hint, which would hide the answer above; the key explains them.
        self._buttons = gui.add_button_group("do", ["plan"], order=-10, visible=False)
        self._buttons.on_click(lambda event: self._list_buttons().get(event.target.value, self.redraw)())
        hint = "Go back to an earlier view"
        # Without an order, a later page of the same process would have it below the layers.
        self._slider = gui.add_slider("view", 1, 2, 1, 1, order=0, visible=False, hint=hint)
        self._slider.on_update(self._slide)
        self._about = gui.add_html("", order=1, visible=False)
        self._panel = panel = gui.add_panel()
        with panel.add_tab("supports"):
            self._graph = gui.add_html("")
        with panel.add_tab("order"):
            self._build_order()
        with panel.add_tab("image"):
            self._kind = gui.add_dropdown("show", [*panels.IMAGES], hint="What to show of the view's image")
            self._image = gui.add_html("")
        with panel.add_tab("scene"):
            self._build_layers()
        with panel.add_tab("key"):
            gui.add_html(panels.explain_signs())
        for control in (self._kind, self._true_colours, self._size):
            control.on_update(lambda _: self.redraw())
        gui.add_command("Deselect the object", hotkey="escape").on_trigger(lambda _: self.describe(""))
        for key, way in (("pageup", -1), ("pagedown", 1)):
            command = gui.add_command("Earlier view" if way < 0 else "Later view", hotkey=key)
            command.on_trigger(lambda _, way=way: self.go_to(self._shown + way))
        self.server.scene.on_click()(self._point)
        self.server.on_client_connect(self._greet)
        if self._small:
            panel.minimize()
        else:
            gui.main_panel.dock_right()
            gui.main_panel.set_width(400)
            panel.dock_below(gui.main_panel)

    def _build_order(self) -> None:
        gui, grippers = self.server.gui, [*get_args(GripperKind), *GRIPPERS]
        chosen = self._config.gripper.kind
        hint = "The gripper that lifts; with none, every object can be grasped"
        self._gripper = gui.add_dropdown("gripper", grippers, initial_value=chosen, hint=hint)
        hint = "Reach one object, and remove only what is in its way"
        self._goal = gui.add_dropdown("goal", [ALL], hint=hint)
        self._play = gui.add_button("play", disabled=True, hint="Show the lifts one after the other")
        self._lifts = gui.add_html("")
        self._play.on_click(lambda _: self.queue_work("showing the lifts", self.play_order))

    def _list_buttons(self) -> dict[str, Callable[[], None]]:
        """List what can be done now, by the names of the buttons."""
        plan = partial(self.queue_work, "planning an order", self.plan_order)
        objects = [o for step in self.steps[self._shown :][:1] for o in step.graph.objects]
        return {} if self._busy or all(o.role != "object" for o in objects) else {"plan": plan}

    def _build_layers(self) -> None:
        gui = self.server.gui
        self._boxes: dict[str, Any] = {}
        hint = "Move your eye to where it began, above the objects, or into the camera of the view shown"
        look = gui.add_button_group("look from", ("start", "above", "camera"), hint=hint)
        look.on_click(lambda event: self._look_from(event.target.value, event.client.camera))
        for name, (shown, hint) in drawing.LAYERS.items():
            box = self._boxes[name] = gui.add_checkbox(name, shown, hint=hint)
            box.on_update(lambda event, name=name: self.show_layer(name, event.target.value))
        hint = "Colour points as cameras saw them"
        self._true_colours = gui.add_checkbox("camera colours", False, hint=hint)
        self._size = gui.add_slider("point size [mm]", 1.0, 12.0, 0.5, 3.0)

    def _look_at(self, step: Step) -> None:
        """Place the initial viewpoint in front of the objects, beside the first camera."""
        x, y = step.visited[0][:2] if len(step.visited) else (-1.0, 0.0)
        azimuth = float(np.arctan2(y + 0.5 * x, x - 0.5 * y))
        outlines = [item.shape.outline() for item in step.graph.movable]
        points = np.concatenate(outlines or [step.sphere.centre_world[None]])
        low, high = points.min(axis=0), points.max(axis=0)
        centre, reach = (low + high) / 2.0, max(float(np.linalg.norm(high - low)) / 2.0, 0.15)
        camera = self.server.initial_camera
        camera.look_at = centre
        camera.fov = 0.72  # Narrow, so that near objects do not hide far ones [rad].
        camera.position = centre + 3.2 * reach * direction(azimuth, 0.55)  # From 3.2 radii, all objects fit.

    def _greet(self, client: Any) -> None:
        """Draw for a new browser; one higher than wide, such as a phone, sees all objects from farther."""
        self.redraw()
        if self.steps and client.camera.aspect < 1.0:
            self._look_from("start", client.camera)

    def _look_from(self, where: str, eye: Any) -> None:
        """Move a browser's eye."""
        start = self.server.initial_camera
        target, up, fov = start.look_at, np.array([0.0, 0.0, 1.0]), start.fov
        position = target + (start.position - target) / min(eye.aspect, 1.0)
        view = self.steps[self._shown].view if self.steps else None
        if where == "start" and eye.aspect < 1.0:  # Above the panel, which such a window has at its bottom.
            lower = 0.15 * np.linalg.norm(position - target) * up
            target, position = target - lower, position - lower
        elif where == "above":
            away = position - target
            position = target + np.linalg.norm(away) * transforms.unit(0.02 * away + (0.0, 0.0, 1.0))
        elif where == "camera" and view is not None and view.T_world_camera is not None:
            R, position = view.T_world_camera[:3, :3], view.T_world_camera[:3, 3]
            target, up = position + np.linalg.norm(target - position) * R[:, 2], -R[:, 1]
            fov = 2.0 * float(np.arctan2(view.depth.shape[0] / 2.0, view.K[1, 1]))
        eye.up_direction, eye.position, eye.look_at, eye.fov = up, position, target, fov

    def _slide(self, event: Any) -> None:
        """Show the view that a person chose; drawing moves the slider too, and later views may have come."""
        if event.client is not None:
            self.go_to(int(event.target.value) - 1)

    def _point(self, event: Any) -> None:
        """Deselect the object if a click meets none."""
        origin, along = np.array(event.ray_origin), transforms.unit(np.array(event.ray_direction))
        ray = origin + np.arange(0.0, 5.0, 0.002)[:, None] * along  # All that one can click at is within 5 m.
        shown = self._staged or (self.steps[self._shown] if self.steps else None)
        # Within 4 mm of a shape, the click may have met it.
        if shown is None or all(o.shape.signed_distance(ray).min() > 0.004 for o in shown.graph.objects):
            self.describe("")

    def _draw(self) -> None:
        known, scores, chosen = self.steps, [*self.scores], self._chosen
        steps, buttons = known[: self._shown + 1], tuple(self._list_buttons())
        self._bar.visible, self._buttons.visible = self._busy, bool(buttons)
        self._buttons.options = buttons or self._buttons.options
        if not steps:
            return
        step, f1, count, number = steps[-1], scores[len(steps) - 1], len(known), len(steps)
        if self._staged is not None:
            step, f1 = self._staged, None
        before = steps[-2] if len(steps) > 1 else None
        lifts = [each.lift for each in steps if each.lift is not None]
        order, gripper, asked = None, None, ""
        if self._planned is not None and self._planned[0] is steps[-1].graph:
            _, order, gripper, asked = self._planned
        told = None if self._staged is not None else order
        possible = () if told is None else told.steps
        lift = next((each for each in possible if each.object_id == chosen), next(iter(possible), None))
        made = panels.describe_lifts(steps[-1].graph, order, lifts, f"after view {number}; {asked}")
        texts = [(self._summary, panels.describe_view(step, f1, count, before, told)), (self._lifts, made)]
        if self.server.get_clients():  # Nobody else sees the pictures, and they cost most.
            address = f"/{self.url.rpartition('/')[2]}/object"
            texts.append((self._graph, panels.draw_linked_graph(step.graph, chosen, address)))
            texts.append((self._image, panels.draw_view(steps[-1], self._kind.value)))
        if any(f1 is not None for f1 in scores):
            if self._chart is None:
                with self._panel.add_tab("F1"):
                    self._chart = self.server.gui.add_html("")
            texts.append((self._chart, panels.draw_scores(scores)))
        if chosen:
            taken = chosen in {lift.object_id for lift in lifts} | {o.id for o in steps[-1].graph.objects}
            texts.append((self._about, self._explain(chosen, step, taken)))
        look = {"point_size": self._size.value / 1000.0, "true_colours": self._true_colours.value}
        places = () if order is None else [each.object_id for each in order.steps]
        with self.server.atomic():  # Scene and texts change together.
            self.drawing.show(step, steps, chosen=chosen, order=places, lift=lift, gripper=gripper, **look)
            self._slider.visible, self._slider.max, self._slider.value = count > 1, max(count, 2), number
            self._about.visible = bool(chosen)
            self._play.disabled = self._busy or order is None or not order.steps
            goals = (ALL, *(o.id for o in steps[-1].graph.movable))
            if self._goal.options != goals:
                self._goal.options = goals
            for panel, text in texts:
                panel.content = text

    def _explain(self, object_id: str, step: Step, taken: bool) -> str:
        """Describe an object, and why it has its shape if that is known."""
        reasons = next((each for each in step.reasons if each.subject == (object_id,)), None)
        with self.working, contextlib.suppress(InputError):
            if self.find_scene is not None and self.steps and step is self.steps[-1]:
                reasons = self.find_scene().why(object_id)
        with self.working:
            graph, config = step.graph, self._config.support
            return panels.describe_object(graph, object_id, config, taken=taken, reasons=reasons)


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
    page = Page("caryatid", scene.config, host=host, port=port, seed=scene.seed, small=True)
    page.update(scene)
    return page


def _log_failure(drawn: Future[None]) -> None:
    """Log an error of the drawing thread; the page keeps showing the step before."""
    error = None if drawn.cancelled() else drawn.exception()
    if error is not None:
        logging.getLogger(__name__).error("the viewer failed to draw a view", exc_info=error)
