"""A page that controls an exploration step by step, with any planner and fusion, and clears the table."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from threading import Event
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from caryatid.config import Config, FusionMethod, SegmentationMethod
from caryatid.errors import CaryatidError, PlanningError, in_one_line
from caryatid.evaluation.oracle import planner_for
from caryatid.evaluation.scores import score
from caryatid.exploration import Explorer, Step, used_up
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.graph import TakeStep
from caryatid.manipulation.clearing import SimulatedHands, Taken, clear
from caryatid.manipulation.order import plan_order
from caryatid.planning.decision import Decision
from caryatid.planning.planners import BUILT_IN, offered
from caryatid.runtime.parallel import cores
from caryatid.simulation.camera import SimulatedCamera
from caryatid.simulation.lifting import ASIDE
from caryatid.viewer.page import Page
from caryatid.viz.notebook import cell_html
from caryatid.viz.report import Section

if TYPE_CHECKING:
    from caryatid.io.mask_sources import MaskSource
    from caryatid.planning.candidates import Candidates
    from caryatid.sensing.view_sphere import ViewSphere
    from caryatid.sources import Source


class LoopPage(Page):
    """A page that explores a source at the user's request, in one worker thread.

    The exploration continues until the user stops it; the page shows when `explore` would have stopped.

    Args:
        open_source: Opens the source with the given settings; called again after a change of fusion.
        config: All settings; `run` pauses after `config.active.max_views` views.
        planner: Name of the planner.
        segmentation: `labels`, `auto`, or None to use labels if available.
        seed: Seed of every random choice.
        masks: Source of masks, or None to use those of the views.
        host: Address to listen on.
        port: Port to listen on; if taken, the next free one; 0 = any free port.

    Attributes:
        source: The scene or recording.
        planner: Name of the planner.
        ended: Why no further view can be taken, or None.

    Raises:
        CaryatidError: The source cannot be opened, the planner is unknown, or the page cannot be served.
    """

    def __init__(
        self,
        open_source: Callable[[Config], Source],
        config: Config,
        *,
        planner: str = "support",
        segmentation: SegmentationMethod | None = None,
        seed: int = 0,
        masks: MaskSource | None = None,
        host: str = "127.0.0.1",
        port: int = 0,
    ) -> None:
        self._open_source, self._config, self._began_with = open_source, config, planner
        self._options: dict[str, Any] = {"segmentation": segmentation, "seed": seed}
        self.planner, self._masks = planner, masks
        self._begin()
        super().__init__(f"caryatid: {self.source.name}", config.support, host=host, port=port)
        self.why = lambda object_id: self._explorer.scene.why(object_id)
        self._worker = ThreadPoolExecutor(1, "loop")
        self._running = Event()
        self._add_controls()

    def _begin(self) -> None:
        self.source = source = self._open_source(self._config)
        options = self._options | {"config": self._config}
        self._first, camera = planner_for(self._began_with, source.camera, source.truth, **options)
        options |= {"planner": self._named(self.planner), "masks": self._masks}
        self._explorer = Explorer(camera, source.robot, **options)
        self._planned: Decision | None = None
        self.ended: str | None = None

    def _named(self, name: str) -> Any:
        """The planner of this name; the oracle depends on the source, so only the first planner can be it."""
        return self._first if name == self._began_with else name

    def turn(self) -> str | None:
        """Go to the next view, look and plan; return why `explore` would stop now, or None.

        Raises:
            CaryatidError: The view cannot be used.
        """
        if self.ended is not None:
            return self.ended
        self.stage(None)
        self._order.visible = False
        explorer, truth, f1 = self._explorer, self.source.truth, None
        with self.working:
            if explorer.step is not None and (step := explorer.go()).stop is not None:
                self._put(step)
                self.ended = step.stop
                return self.ended
            explorer.look()
            step = explorer.plan()
            if truth is not None:
                f1 = score(step.graph, truth, np.random.default_rng(0)).f1
            reason = used_up(step.index + 1, self._config.active) or explorer.reason_to_stop()
        self._planned, self.ended = step.decision, step.stop
        self.add(replace(step, stop=reason), f1)
        return reason

    def use_planner(self, name: str) -> str:
        """Replace the planner, starting with the next view; return a message.

        Raises:
            CaryatidError: The planner is unknown, or finds no next view.
        """
        with self.working:
            self._explorer.use_planner(self._named(name))
            self.planner = name
            if self._explorer.step is None or self.ended is not None:
                return ""
            step = self._explorer.plan()
        if step.decision is None:
            raise PlanningError(step.stop or "the planner found no next view")
        self._planned = step.decision
        self._put(step)
        return f"next view chosen by {name}"

    def use_fusion(self, method: FusionMethod) -> str:
        """Restart with another fusion and repeat the same views; return a message."""
        earlier = [step.decision for step in self.steps]
        self._config = replace(self._config, fusion=replace(self._config.fusion, method=method))
        with self.working:
            self._begin()
        for number, decision in enumerate(earlier, start=1):
            self.turn()
            if number < len(earlier) and decision is not None and self.ended is None:
                self.choose(decision)
        return f"same views, fusion {method}"

    def choose(self, chosen: Decision | int) -> str:
        """Override the planner's choice of the next view; return a message.

        Raises:
            PlanningError: The candidate does not exist, or the robot refuses it.
        """
        with self.working:
            step = self._explorer.choose(chosen)
        self._put(step)
        if self._planned is None or step.decision is None:
            return "next view chosen by hand"
        yours, planned = step.decision.score, self._planned.score
        return f"next view chosen by hand: score {yours:.2f}; {self.planner} chose one with {planned:.2f}"

    def _put(self, step: Step) -> None:
        """Show the newest step with another next view."""
        self.add(step, self.scores[step.index])

    def clear(self) -> str:
        """Clear a simulated table, as `clear` does; for a recording, show a safe order."""
        explorer, config, camera = self._explorer, self._config, self.source.camera
        if not isinstance(camera, SimulatedCamera):
            return self._show_order(self.steps[-1], config)
        hands, said, harmed = SimulatedHands(camera.scene, config), "", set[str]()
        film: list[Step] = []
        self.source = replace(self.source, truth=None)  # Ground truth is of the scene before any lift.

        def take(lift: TakeStep) -> bool:
            nonlocal said
            step, before = explorer.step, hands.state
            assert step is not None
            self.stage(None)
            self.add(step)
            taken = hands.take(lift, hands.bodies(step.graph))
            film.extend(_without(step, (), lift.object_id, T) for T in _moves(taken, hands.names, before))
            camera.scene = hands.scene
            done = "Found nothing at" if taken.body is None else "Removed"
            said = f"{done} {lift.object_id}; {_moved(taken.disturbed)}."
            harmed.update(taken.disturbed)
            return taken.body is not None

        steps = clear(explorer, take, threads=cores())
        while self._running.is_set():
            with self.working:
                step = next(steps, None)
            if step is None:
                return f"Finished: {self.ended}; {_moved(sorted(harmed))}."
            self._show(film)
            film.clear()
            # A lifted object stays away, though the graph holds it until the next view.
            gone = None if step.lift is None or step.stop is not None else step.lift.object_id
            self.stage(None if gone is None else _without(step, {gone}, gone, {}))
            self.add(step)
            self.say(said)
            self.ended = step.stop
        return "paused"

    def _show_order(self, step: Step, config: Config) -> str:
        with self.working:
            order = plan_order(step.graph, config, seed=self._options["seed"], threads=cores())
        facts = []
        for number, lift in enumerate(order.steps, 1):
            held = f"hold {', '.join(lift.hold)}; " if lift.hold else ""
            facts.append((f"{number}. {lift.object_id}", held + lift.why))
        self._order.content, self._order.visible = cell_html(Section("Order", facts=facts)), True
        rising = [transforms.rigid(np.eye(3), (0.0, 0.0, height)) for height in np.linspace(0.0, 0.5, 8)[1:]]
        gone: set[str] = set()
        for lift in order.steps:
            if not self._running.is_set():
                return "paused"
            self._show(_without(step, gone, lift.object_id, {lift.object_id: T}) for T in rising)
            gone.add(lift.object_id)
            self.stage(_without(step, gone, lift.object_id, {}))
        self.stage(None)
        return f"Finished: {order.refusal or 'all objects can be removed safely in the order listed below'}."

    def _show(self, film: Iterable[Step]) -> None:
        for picture in film:
            self.stage(picture)
            time.sleep(0.12)  # Time for which each picture of a lift is shown [s].

    def start(self) -> None:
        """Take the first or the next view in the worker thread."""
        self._running.clear()
        self._do("taking a view", lambda: _finished(self.turn()))

    def wait(self) -> None:
        """Wait until all requests are done and drawn."""
        self._worker.submit(lambda: None).result()
        super().wait()

    def close(self) -> None:
        """Finish the current view, then stop serving the page."""
        self._worker.shutdown(wait=False, cancel_futures=True)
        self._running.clear()
        self._worker.shutdown()
        super().close()

    def _add_controls(self) -> None:
        gui = self.server.gui
        names = [*dict.fromkeys([*BUILT_IN, *sorted(offered()), self.planner])]
        with gui.add_folder("loop", order=-10):
            self._next = gui.add_button("next view", hint="Move to the next view and take it")
            self._go = gui.add_button("run", hint="Take views until the exploration would stop")
            self._pause = gui.add_button("pause", hint="Stop after the current view", disabled=True)
            planner = gui.add_dropdown("planner", names, initial_value=self.planner)
            fusion = gui.add_dropdown(
                "fusion", get_args(FusionMethod), initial_value=self._config.fusion.method
            )
            hint = "Click the view sphere to choose the next view"
            by_hand = gui.add_checkbox("choose by hand", False, hint=hint)
            hint = "Remove all objects: look until a lift is safe, remove the object, look again"
            self._clear = gui.add_button("clear", hint=hint)
            self._order = gui.add_html("", visible=False)
        self._choices = planner, fusion
        self._next.on_click(lambda _: self.start())
        self._go.on_click(lambda _: self._keep_doing("running", self._run))
        self._pause.on_click(lambda _: self._running.clear())
        self._clear.on_click(lambda _: self._keep_doing("clearing", self.clear))
        planner.on_update(lambda _: self._do("replanning", lambda: self.use_planner(planner.value)))
        fusion.on_update(
            lambda _: self._do("repeating the same views", lambda: self.use_fusion(fusion.value))
        )
        by_hand.on_update(lambda _: self._listen(by_hand.value))

    def _keep_doing(self, what: str, work: Callable[[], str | None]) -> None:
        """Queue work that `pause` can stop."""
        if not self._running.is_set():
            self._running.set()
            self._do(what, work)

    def _do(self, what: str, work: Callable[[], str | None]) -> None:
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

    def _show_state(self, text: str, *, busy: bool) -> None:
        self.say(text)
        self._next.disabled = busy or self.ended is not None
        self._go.disabled = busy or (bool(self.steps) and self.steps[-1].stop is not None)
        self._pause.disabled = not busy
        simulated = isinstance(self.source.camera, SimulatedCamera)
        self._clear.disabled = busy or not self.steps or (simulated and self.ended is not None)
        for choice in self._choices:
            choice.disabled = busy

    def _run(self) -> str | None:
        while self._running.is_set():
            said = self.turn()
            if said is not None:
                return _finished(said)
        return "paused"

    def _listen(self, wanted: bool) -> None:
        scene = self.server.scene
        scene.remove_click_callback("all")
        self.show_layer("sphere", wanted)
        if wanted and self.steps:
            sphere = self.steps[-1].sphere
            for client in self.server.get_clients().values():  # Move back until the whole sphere is visible.
                away = transforms.unit(np.array(client.camera.position) - sphere.centre_world)
                client.camera.position = sphere.centre_world + 2.7 * sphere.radius * away
                client.camera.look_at = sphere.centre_world
        if wanted:
            scene.on_click()(self._pointed)

    def _pointed(self, event: Any) -> None:
        """Choose the candidate within 6° of a click as the next view."""
        step = self._explorer.step
        if step is None or step.candidates is None:
            return
        origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
        index = candidate_under(origin, direction, step.sphere, step.candidates, np.deg2rad(6.0))
        if index is not None:
            self._do("choosing", lambda: self.choose(index))


def _finished(reason: str | None) -> str | None:
    return reason and f"Finished: {reason}."


def _moved(names: Sequence[str]) -> str:
    return f"{', '.join(names)} moved" if names else "no other object moved"


def candidate_under(
    origin_world: Array, direction_world: Array, sphere: ViewSphere, candidates: Candidates, within: float
) -> int | None:
    """Which candidate a ray from the eye points at, where it first meets the sphere or else behind.

    Args:
        origin_world: The eye (3,) [m].
        direction_world: Where the ray goes (3,).
        sphere: The view sphere.
        candidates: The views on it that can be reached.
        within: How far off the candidate may be, at the sphere's centre [rad].
    """
    ray = direction_world / np.linalg.norm(direction_world)
    offset = sphere.centre_world + sphere.radius * candidates.directions - origin_world
    along = offset @ ray
    aside = np.linalg.norm(offset - along[:, None] * ray, axis=1)
    hit = (along > 0.0) & (aside <= within * sphere.radius)
    if not hit.any():
        return None
    return int(np.argmin(np.where(hit & (along < along[hit].min() + sphere.radius / 2.0), aside, np.inf)))


# A lift, picture by picture


def _moves(taken: Taken, names: Sequence[str], before: Array) -> list[dict[str, Array]]:
    """How far the extracted shapes move with the bodies they stand for, until the lifted one is put aside."""
    film = taken.film
    if taken.body is not None:
        film = film[film[:, names.index(taken.body), 2] < ASIDE / 2.0]
    states = np.concatenate([before[None], film])  # (1 + T, N, 7): positions and quaternions, w first
    poses = np.tile(np.eye(4), (*states.shape[:2], 1, 1))
    poses[..., :3, 3] = states[..., :3]
    turns = Rotation.from_quat(states[..., 3:].reshape(-1, 4), scalar_first=True).as_matrix()
    poses[..., :3, :3] = turns.reshape(*states.shape[:2], 3, 3)
    moves = poses[1:] @ transforms.invert(poses[0])
    return [{i: T[names.index(body)] for i, body in taken.bodies.items()} for T in moves]


def _without(step: Step, gone: Collection[str], lifted: str, T_world_world: Mapping[str, Array]) -> Step:
    """A step as it looks while an object is being lifted and others are gone.

    Shapes that have moved leave their points behind, and so their points are not shown.
    """
    graph, cloud, still = step.graph, step.cloud, np.eye(4)
    objects = tuple(
        replace(o, shape=o.shape.moved(T_world_world.get(o.id, still)))
        for o in graph.objects
        if o.id not in gone
    )
    supports = tuple(
        replace(s, contact_world=None, normal_world=None)
        for s in graph.supports
        if not {s.supporter, s.supported} & {lifted, *gone}
    )
    moved = {i for i, T in T_world_world.items() if np.abs(T - still).max() > 2e-3}
    away = [o.label for o in graph.objects if o.id in {*gone, *moved}]
    if away and cloud.labels is not None:
        cloud = cloud.select(~np.isin(cloud.labels, away))
    shown = replace(graph, objects=objects, supports=supports)
    return replace(step, graph=shown, cloud=cloud, decision=None, candidates=None)
