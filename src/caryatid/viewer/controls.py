"""The loop worked from the page: next view, run and pause, planner, fusion, a view by hand, dismantling."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from threading import Event
from typing import Any, get_args

import numpy as np

from caryatid.config import FusionMethod
from caryatid.errors import CaryatidError, in_one_line
from caryatid.manipulation.order import plan_order
from caryatid.planning.planners import BUILT_IN, ORACLE, offered
from caryatid.runtime.parallel import cores
from caryatid.viewer.loop import Loop, candidate_under, taken_apart
from caryatid.viewer.page import Page


class Controls:
    """Buttons that work a loop, and the one thread that does the work.

    Args:
        page: Where they are shown.
        loop: What they work.
        seed: Seed of rehearsals.
    """

    def __init__(self, page: Page, loop: Loop, *, seed: int = 0) -> None:
        self._page, self._loop, self._seed = page, loop, seed
        self._worker = ThreadPoolExecutor(1, "loop")
        self._running = Event()
        self._closed = False
        self._build()

    def start(self) -> None:
        """Take the first view, or the next."""
        self._running.clear()
        self._do("taking a view", self._turn)

    def wait(self) -> None:
        """Wait until all that has been asked for is done and drawn."""
        self._worker.submit(lambda: None).result()
        self._page.wait()

    def close(self) -> None:
        """Stop working, once the view that is being taken is there."""
        self._closed = True
        self._running.clear()
        self._worker.shutdown(wait=True, cancel_futures=True)

    def _build(self) -> None:
        gui, loop = self._page.server.gui, self._loop
        names = [*BUILT_IN, *sorted(offered()), *([ORACLE] if loop.planner == ORACLE else [])]
        with gui.add_folder("loop", order=-10):
            self._next = self._button("next view", self.start, "Take one turn of the loop")
            self._go = self._button("run", self._run, "Take turn after turn")
            self._pause = self._button("pause", self._running.clear, "Stop after this turn")
            self._planner = gui.add_dropdown("planner", names, initial_value=loop.planner)
            self._fusion = gui.add_dropdown("fusion", get_args(FusionMethod), initial_value=loop.fusion)
            hint = "Then click the view sphere: the view you point at is taken next"
            self._by_hand = gui.add_checkbox("choose the next view by hand", False, hint=hint)
            hint = "Find a safe order to take everything away, and play it"
            self._dismantle = self._button("dismantle", self._play_order, hint)
        self._pause.disabled = True
        self._planner.on_update(lambda _: self._do("planning again", self._replan))
        self._fusion.on_update(lambda _: self._do("taking the same views again", self._fuse_again))
        self._by_hand.on_update(lambda _: self._listen(self._by_hand.value))

    def _button(self, label: str, press: Callable[[], None], hint: str) -> Any:
        button = self._page.server.gui.add_button(label, hint=hint)
        button.on_click(lambda _: press())
        return button

    def _run(self) -> None:
        """Take turn after turn, until the loop would end by itself or `pause` is pressed."""
        if not self._running.is_set():
            self._running.set()
            self._do("running", self._run_on)

    def _play_order(self) -> None:
        """Find a safe order and play it: in physics where there is a simulation, else as the order says."""
        if self._loop.moments and not self._running.is_set():
            self._running.set()
            self._do("rehearsing lifts", self._take_apart)

    def _do(self, what: str, work: Callable[[], str | None]) -> None:
        """Have work done, after what is being done, and say what it returns at its end."""

        def done() -> None:
            if self._closed:
                return
            self._say(what + " …", busy=True)
            try:
                said = work()
            except CaryatidError as error:
                said = f"{error}"
            except Exception as error:
                said = in_one_line(error)
            self._running.clear()
            self._say(said or "", busy=False)

        if not self._closed:
            self._worker.submit(done)

    def _say(self, text: str, *, busy: bool) -> None:
        self._page.say(text)
        self._next.disabled = self._go.disabled = busy or self._loop.ended is not None
        self._pause.disabled = not busy
        self._dismantle.disabled = busy or not self._loop.moments
        self._planner.disabled = self._fusion.disabled = busy

    def _turn(self) -> str | None:
        self._page.stage(None)
        with self._page.working:
            moment = self._loop.turn()
        if moment is not None:
            self._page.add(moment)
        return self._loop.pause

    def _run_on(self) -> str | None:
        while self._running.is_set() and not self._closed:
            said = self._turn()
            if said is not None or self._loop.ended is not None:
                return said
        return "paused"

    def _replan(self) -> str | None:
        with self._page.working:
            moment = self._loop.use_planner(self._planner.value)
        if moment is None:
            return None
        self._page.add(moment)
        return f"{self._loop.planner} chose the next view"

    def _fuse_again(self) -> str:
        self._page.stage(None)
        with self._page.working:
            for moment in self._loop.use_fusion(self._fusion.value):
                self._page.add(moment)
        return f"the same views, fused by {self._loop.fusion}"

    def _listen(self, wanted: bool) -> None:
        scene = self._page.server.scene
        scene.remove_click_callback("all")
        if wanted:
            scene.on_click()(self._pointed)

    def _pointed(self, event: Any) -> None:
        """Take the candidate within 6° of a click next, whatever the planner says."""
        step = self._loop.moments[-1].step if self._loop.moments else None
        if step is None or step.candidates is None:
            return
        origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
        index = candidate_under(origin, direction, step.sphere, step.candidates, np.deg2rad(6.0))
        if index is not None:
            self._do("choosing", lambda: self._choose(index))

    def _choose(self, index: int) -> str:
        chosen, planned = self._loop.choose(index), self._loop.planned
        self._page.add(chosen)
        if planned is None or chosen.step.decision is None:
            return "your view is next"
        yours = chosen.step.decision.score
        return f"your view is next: score {yours:.2f}, the choice of {self._loop.planner} {planned.score:.2f}"

    def _take_apart(self) -> str:
        loop, moment, said = self._loop, self._loop.moments[-1], ""
        with self._page.working:
            order = plan_order(moment.step.graph, loop.config, seed=self._seed, threads=cores())
        for step, done in taken_apart(moment.step, order.steps, loop.source, loop.config):
            if not self._running.is_set() or self._closed:
                return "paused"
            self._page.stage(replace(moment, step=step))
            if done:
                said = done
                self._page.say(said)
            time.sleep(0.12)  # Each picture of a lift stands for so long [s].
        return f"{order.refusal or 'a safe order'}; {said}"
