"""A page that controls an exploration step by step, with any planner and fusion, and clears the table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from caryatid.config import Config, FusionMethod, SegmentationMethod
from caryatid.errors import PlanningError
from caryatid.evaluation.oracle import planner_for
from caryatid.evaluation.scores import score
from caryatid.exploration import Explorer, Step, used_up
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.graph import TakeStep
from caryatid.manipulation.clearing import SimulatedHands, Taken, clear
from caryatid.planning.decision import Decision
from caryatid.planning.planners import BUILT_IN, offered
from caryatid.runtime.parallel import cores
from caryatid.simulation.camera import SimulatedCamera
from caryatid.simulation.lifting import ASIDE
from caryatid.viewer.drawing import take_away
from caryatid.viewer.page import Page

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
        super().__init__(f"caryatid: {self.source.name}", config, host=host, port=port, seed=seed)
        self.find_scene = lambda: self._explorer.scene
        self._add_controls()

    def _begin(self) -> None:
        self.source = source = self._open_source(self._config)
        options = self._options | {"config": self._config}
        self._first, camera = planner_for(self._began_with, source.camera, source.truth, **options)
        options |= {"planner": self._named(self.planner), "masks": self._masks}
        self._explorer = Explorer(camera, source.robot, **options)
        self._decided: Decision | None = None
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
        explorer, truth, f1 = self._explorer, self.source.truth, None
        with self.working:
            if explorer.step is not None and (step := explorer.go()).stop is not None:
                self.add(step, self.scores[step.index])
                self.ended = step.stop
                return self.ended
            explorer.look()
            step = explorer.plan()
            if truth is not None:
                f1 = score(step.graph, truth, np.random.default_rng(0)).f1
            reason = used_up(step.index + 1, self._config.active) or explorer.reason_to_stop()
        self._decided, self.ended = step.decision, step.stop
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
        self._decided = step.decision
        self.add(step, self.scores[step.index])
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
        self.add(step, self.scores[step.index])
        if self._decided is None or step.decision is None:
            return "next view chosen by hand"
        yours, planned = step.decision.score, self._decided.score
        return f"next view chosen by hand: score {yours:.2f}; {self.planner} chose one with {planned:.2f}"

    def clear(self) -> str:
        """Clear a simulated table, as `clear` does; return a message, empty for a recording."""
        explorer, config, camera = self._explorer, self._config, self.source.camera
        if not isinstance(camera, SimulatedCamera):
            return ""
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
            film.extend(take_away(step, (), lift.object_id, T) for T in _moves(taken, hands.names, before))
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
            self._playing.set()
            self._show(film)
            film.clear()
            # A lifted object stays away, though the graph holds it until the next view.
            gone = None if step.lift is None or step.stop is not None else step.lift.object_id
            self.stage(None if gone is None else take_away(step, {gone}, gone, {}))
            self.add(step)
            self.say(said)
            self.ended = step.stop
        return "paused"

    def restart(self) -> str | None:
        """Forget all views, put everything back, and take the first view again; return a message."""
        with self.working:
            self._begin()
        self.forget()
        return _finished(self.turn())

    def start(self) -> None:
        """Take the first or the next view in the worker thread."""
        self._running.clear()
        self.queue_work("taking a view", lambda: _finished(self.turn()))

    def _add_controls(self) -> None:
        gui = self.server.gui
        names = [*dict.fromkeys([*BUILT_IN, *sorted(offered()), self.planner])]
        with gui.add_folder("options", order=2, expand_by_default=False):
            hint = "What chooses the next view"
            planner = gui.add_dropdown("planner", names, initial_value=self.planner, hint=hint)
            hint = "How views are joined: pc = their points, sg = their graphs; repeats the same views"
            method = self._config.fusion.method
            fusion = gui.add_dropdown("fusion", get_args(FusionMethod), initial_value=method, hint=hint)
            hint = "Click the view sphere to choose the next view"
            self._by_hand = gui.add_checkbox("choose by hand", False, hint=hint)
        self._choices, queue = (planner, fusion), self.queue_work
        planner.on_update(lambda _: queue("replanning", lambda: self.use_planner(planner.value)))
        fusion.on_update(lambda _: queue("repeating the same views", lambda: self.use_fusion(fusion.value)))
        self._by_hand.on_update(lambda _: self._show_sphere(self._by_hand.value))

    def _list_buttons(self) -> dict[str, Callable[[], None]]:
        if self._running.is_set():
            return {"pause": self._running.clear}
        if self._busy:
            return {}
        buttons = {"next view": self.start} if self.ended is None else {}
        if not self.steps or self.steps[-1].stop is None:
            buttons["run"] = partial(self._keep_on, "running", self._run)
        buttons |= super()._list_buttons()
        if self.ended is None and isinstance(self.source.camera, SimulatedCamera):
            buttons["clear"] = partial(self._keep_on, "clearing", self.clear)
        buttons["restart"] = partial(self.queue_work, "starting again", self.restart)
        return buttons

    def _keep_on(self, what: str, work: Callable[[], str | None]) -> None:
        """Queue work that goes on until it is paused."""
        self._running.set()
        self.queue_work(what, work)

    def _show_state(self, text: str, *, busy: bool) -> None:
        for choice in self._choices:
            choice.disabled = busy
        super()._show_state(text, busy=busy)

    def _run(self) -> str | None:
        while self._running.is_set():
            said = self.turn()
            if said is not None:
                return _finished(said)
        return "paused"

    def _show_sphere(self, wanted: bool) -> None:
        """Show the view sphere, and move back until all of it is visible."""
        self.show_layer("sphere", wanted)
        if wanted and self.steps:
            sphere = self.steps[-1].sphere
            for client in self.server.get_clients().values():
                away = transforms.unit(np.array(client.camera.position) - sphere.centre_world)
                client.camera.position = sphere.centre_world + 2.7 * sphere.radius * away
                client.camera.look_at = sphere.centre_world

    def _point(self, event: Any) -> None:
        """Choose the candidate within 6° of a click as the next view, if views are chosen by hand."""
        step = self._explorer.step
        if not self._by_hand.value:
            super()._point(event)
        elif step is not None and step.candidates is not None:
            origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
            index = find_candidate(origin, direction, step.sphere, step.candidates, np.deg2rad(6.0))
            if index is not None:
                self.queue_work("choosing", lambda: self.choose(index))


def _finished(reason: str | None) -> str | None:
    return reason and f"Finished: {reason}."


def _moved(names: Sequence[str]) -> str:
    return f"{', '.join(names)} moved" if names else "no other object moved"


def find_candidate(
    origin_world: Array, direction_world: Array, sphere: ViewSphere, candidates: Candidates, within: float
) -> int | None:
    """Find the candidate that a ray from an eye (3,) [m] along a direction (3,) points at, or None.

    It counts where it first meets the sphere or else behind, and may miss by an angle at its centre [rad].
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
