"""The active vision loop taken turn by turn, with planner, fusion and next view in a person's hand."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from caryatid.config import Config, FusionMethod, SegmentationMethod
from caryatid.errors import CaryatidError
from caryatid.evaluation.oracle import planner_for
from caryatid.evaluation.scores import score
from caryatid.exploration import Step, explore
from caryatid.graph import SupportGraph
from caryatid.objects.fusion import changed
from caryatid.planning.decision import Decision
from caryatid.planning.planners import ORACLE, make_planner
from caryatid.robots import Posture, Robot, refusal_of
from caryatid.robots.arm import ArmRobot
from caryatid.robots.recording import RecordingRobot
from caryatid.viewer.moments import Moment, Standing, moment_of_step
from caryatid.viewer.steering import SteeredRobot, SwitchedPlanner, planned_anew, taken_by_hand

if TYPE_CHECKING:
    from caryatid.sources import Source

ENDLESS = 100_000
"""Views the loop underneath may take [1]: it is the person who ends it."""


class Loop:
    """An exploration that waits for its next turn to be asked for.

    It does not end by itself as `explore` does, but says when that would have: see `pause`.

    Args:
        open_source: Opens what is explored, anew each time, for some settings.
        config: All settings; `config.active.max_views` is when it says that it would pause.
        planner: Name of who chooses the next view.
        segmentation: Where parts come from.
        seed: Seed of every random choice.

    Attributes:
        source: What is explored.
        config: All settings.
        moments: What came of each view.
        ended: Why no further view can be taken, or None.
        pause: Why `explore` would have ended after the newest view, or None.

    Raises:
        CaryatidError: The source cannot be opened, or there is no such planner.
    """

    def __init__(
        self,
        open_source: Callable[[Config], Source],
        config: Config,
        *,
        planner: str = "support",
        segmentation: SegmentationMethod | None = None,
        seed: int = 0,
    ) -> None:
        self._open_source, self._segmentation, self._seed = open_source, segmentation, seed
        self._began_with = planner
        self._planner_name = planner
        self.config = config
        self._begin()

    def _begin(self) -> None:
        config = self.config
        self.source = source = self._open_source(config)
        chooser, camera = planner_for(
            self._began_with,
            source.camera,
            source.truth,
            config,
            segmentation=self._segmentation,
            seed=self._seed,
        )
        self._first = chooser
        self._planner = SwitchedPlanner(chooser)
        self._robot = SteeredRobot(source.robot)
        self._steps = explore(
            camera,
            self._robot,
            planner=self._planner,
            config=replace(config, active=replace(config.active, max_views=ENDLESS)),
            segmentation=self._segmentation,
            seed=self._seed,
            early_stop=False,
        )
        self.moments: list[Moment] = []
        self.ended: str | None = None
        self.pause: str | None = None
        self._planned: Decision | None = None
        if self._planner_name != self._began_with:
            self._planner.planner = make_planner(self._planner_name)

    @property
    def planner(self) -> str:
        """Name of who chooses the next view."""
        return self._planner_name

    @property
    def fusion(self) -> FusionMethod:
        """What is fused over views."""
        return self.config.fusion.method

    def turn(self) -> Moment | None:
        """Go to the next view, take it, and plan; None where no further view can be taken.

        Raises:
            CaryatidError: The view cannot be used; no further one can be taken then.
        """
        if self.ended is not None:
            return None
        before = self.moments[-1].graph if self.moments else SupportGraph()
        try:
            step = next(self._steps, None)
        except CaryatidError as error:
            self.ended = str(error)
            raise
        if step is None:
            self.ended = self.ended or "there is no further view"
            return None
        moment = self._moment(step)
        self._planned = step.decision
        self.moments.append(moment)
        self.ended = step.stop
        self.pause = step.stop or self._would_stop(before, step.graph)
        return moment

    def retrace(self, earlier: Sequence[Moment]) -> Iterator[Moment]:
        """Take the views of some moments, from the first on, whoever chooses others now.

        Yields:
            What came of each view.
        """
        for before in earlier:
            moment = self.turn()
            if moment is None:
                return
            goes_to = before.decision
            own = moment.decision
            if before is not earlier[-1] and goes_to is not None and not _same_view(own, goes_to):
                self._robot.go_instead(goes_to.T_world_camera)
                moment = self.moments[-1] = moment.going_to(goes_to, by_hand=before.by_hand)
            yield moment

    def use_planner(self, name: str) -> Moment | None:
        """Let another planner choose, the next view already; the newest moment, with its choice.

        Raises:
            CaryatidError: There is no such planner, or it can choose no view.
        """
        oracle = name == ORACLE and self._began_with == ORACLE
        self._planner.planner = self._first if oracle else make_planner(name)
        self._planner_name = name
        state = self._planner.state
        if state is None or not self.moments or self.ended is not None:
            return None
        return self._go_to(planned_anew(state, self._planner.planner, self._robot, self._seed))

    def use_fusion(self, method: FusionMethod) -> Iterator[Moment]:
        """Begin anew with another fusion and take the same views again.

        Yields:
            What came of each view.
        """
        earlier = self.moments
        self.config = replace(self.config, fusion=replace(self.config.fusion, method=method))
        self._begin()
        yield from self.retrace(earlier)

    def rate(self, index: int) -> Decision | None:
        """What going to a candidate would be worth, by the planner's figures."""
        state, planned = self._planner.state, self._planned
        if state is None or planned is None or index >= len(state.candidates):
            return None
        return taken_by_hand(state, index, planned)

    def choose(self, index: int) -> Moment | str:
        """Go to this candidate next, whatever the planner says; the newest moment, or why it cannot be."""
        decision = self.rate(index)
        if decision is None:
            return "there is no next view to choose"
        refused = refusal_of(self._robot, decision.T_world_camera)
        if refused is not None:
            return refused.reason
        return self._go_to(decision, by_hand=True)

    @property
    def planned(self) -> Decision | None:
        """What the planner chose, also where a person has chosen otherwise."""
        return self._planned

    def _go_to(self, decision: Decision, *, by_hand: bool = False) -> Moment:
        self._robot.go_instead(decision.T_world_camera)
        if not by_hand:
            self._planned = decision
        self.moments[-1] = self.moments[-1].going_to(decision, by_hand=by_hand)
        return self.moments[-1]

    def _moment(self, step: Step) -> Moment:
        f1 = None
        if self.source.truth is not None:
            f1 = score(step.graph, self.source.truth, np.random.default_rng(0)).f1
        standing = standing_of(self.source.robot, self.config)
        return moment_of_step(step, robot=standing, score=f1)

    def _would_stop(self, before: SupportGraph, after: SupportGraph) -> str | None:
        views = len(self.moments)
        if views == self.config.active.max_views:
            return f"{views} views were asked for"
        if views > 1 and not changed(before, after, self.config.fusion):
            return "the last view changed nothing"
        return None


def _same_view(own: Decision | None, other: Decision) -> bool:
    """Whether the loop goes there by itself; poses from a file are rounded, its own are not."""
    return own is not None and np.allclose(own.T_world_camera, other.T_world_camera, atol=1e-6)


def standing_of(robot: Robot, config: Config) -> Standing | None:
    """How a robot stands where it is, or None where that is not known."""
    if isinstance(robot, RecordingRobot):
        return None
    posture = robot.solve(robot.T_world_camera)
    if not isinstance(posture, Posture):
        return None
    arm = isinstance(robot, ArmRobot)
    return Standing(posture, robot.T_world_camera, config.robot.footprint, arm)
