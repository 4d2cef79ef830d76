"""All views' poses: a new view is laid onto the earlier ones, then all but the first move jointly."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np

from caryatid import frames
from caryatid.config import RegistrationConfig
from caryatid.frames import Array
from caryatid.registration import Matches, RegisteredView, match, misfit, solve, twist_transform
from caryatid.surfels import surfels_of
from caryatid.views import Cloud

Outcome = Literal[
    "reference", "fits as reported", "aligned", "too few partners", "beyond the limits", "no better"
]

EXACT = ("reference", "fits as reported")
"""Views that stay where they were reported, whatever comes later."""


@dataclass(frozen=True, eq=False, slots=True)
class Placement:
    """Where a view is, better than it was reported.

    Attributes:
        twist: Move from where it was reported (6,): 3 × m, 3 × rad, about the pivot.
        outcome: What became of its alignment when it came; later views may move it whatever that was.
        covariance: Of the twist (6, 6) [m, rad]; zero where the view defines the world or is exact.
        determined: Share (6,) of what is known of each of `directions` that comes from matching, ascending;
            the rest is the report's. Near 0 = what the views share does not show it.
        directions: Independent moves (6, 6), one a column, as twists in standard deviations of the report.
    """

    twist: Array
    outcome: Outcome
    covariance: Array
    determined: Array
    directions: Array


class ViewRegistration:
    """Where the views are; the first one defines the world.

    Args:
        pivot_world: What twists turn about (3,) [m]; best amid the points.
        config: Expected errors and limits.

    Attributes:
        placements: One for each view.
    """

    def __init__(self, pivot_world: Array, config: RegistrationConfig) -> None:
        self.placements: list[Placement] = []
        self._pivot = pivot_world
        self._config = config
        self._views: list[RegisteredView] = []
        self._twists = np.zeros((0, 6))
        self._pairs: dict[tuple[int, int], tuple[Array, Matches]] = {}

    def copy(self) -> ViewRegistration:
        """Return a registration that knows the same and goes on by itself; the views so far are shared."""
        other = copy.copy(self)
        other.placements = self.placements.copy()
        other._views = self._views.copy()
        other._pairs = self._pairs.copy()
        return other

    def add(self, cloud: Cloud, *, same_labels: bool) -> dict[int, Array]:
        """Take in a view.

        Args:
            cloud: Its labelled points in the world as reported; 65535 = the support surface.
            same_labels: Whether labels mean the same in every view.

        Returns:
            How the new view is to be moved and, on top of what they were moved before, earlier ones: view →
            transform (4, 4) of the world.
        """
        config, new = self._config, len(self._views)
        surfels = surfels_of(cloud, config, same_labels=same_labels)
        self._views.append(RegisteredView.of(surfels, cloud.viewpoint_world, self._pivot, config))
        self._twists = np.concatenate([self._twists, np.zeros((1, 6))])
        before = [*(p.twist for p in self.placements), np.zeros(6)]
        outcome = self._laid(new)
        known: Array = np.zeros((6, 6))
        if outcome not in EXACT:
            known = np.asarray(np.linalg.inv(self._views[new].information), dtype=np.float64)
        self.placements.append(Placement(np.zeros(6), outcome, known, np.zeros(6), np.eye(6)))
        free = [v for v, p in enumerate(self.placements) if p.outcome not in EXACT]
        if new in free:
            self._refine(free)
        moves = {new: np.eye(4)}
        for v in free:
            T, T_before = (twist_transform(t, self._pivot) for t in (self._twists[v], before[v]))
            points = self._views[v].surfels.points_world
            apart = np.linalg.norm(frames.transform(T, points) - frames.transform(T_before, points), axis=1)
            if v == new or apart.max(initial=0.0) > config.settled:
                moves[v] = T @ frames.invert(T_before)
                self.placements[v] = replace(self.placements[v], twist=self._twists[v])
        return moves

    def _laid(self, new: int) -> Outcome:
        """Lay a new view onto the earlier ones, from where it was reported and coarse to fine."""
        config = self._config
        if new == 0:
            return "reference"
        reported = self._twists
        first = self._found(new, reported, config.reaches[-1])
        right = [m for m in first if self.placements[m.still].outcome in EXACT]
        enough = sum(len(m.points) for m in right) >= config.min_points
        if enough and misfit(right, None, reported, self._pivot, config.reaches[-1]) < config.exact:
            return "fits as reported"
        scores = [self._misfit(new, reported)]
        found = [reported]
        for reaches in (config.reaches[-1:], config.reaches):
            found.append(self._descended(new, reported, reaches))
            scores.append(self._misfit(new, found[-1]))
        best = int(np.argmin(scores))
        if sum(len(m.points) for m in self._found(new, found[best], config.reaches[-1])) < config.min_points:
            return "too few partners"
        if best == 0:
            return "no better"
        if self._too_far(found[best][new]):
            return "beyond the limits"
        self._twists = found[best]
        return "aligned"

    def _descended(self, new: int, twists: Array, reaches: tuple[float, ...]) -> Array:
        config = self._config
        for reach in reaches:
            for _ in range(config.rounds):
                pairs = self._found(new, twists, reach)
                outlier = config.outlier * reach
                found = solve(self._views, pairs, twists, [new], self._pivot, outlier, config).twists
                settled = np.abs(found - twists).max() < config.converged
                twists = found
                if settled:
                    break
        return twists

    def _found(self, new: int, twists: Array, reach: float) -> list[Matches]:
        T = [twist_transform(t, self._pivot) for t in twists]
        return [match(self._views, new, v, T, reach, self._config) for v in range(new)]

    def _misfit(self, new: int, twists: Array) -> float:
        reach = self._config.reaches[-1]
        pairs = self._found(new, twists, reach)
        asked = len(self._views[new].sample) * len(pairs)
        return misfit(pairs, asked, twists, self._pivot, self._config.outlier * reach)

    def _too_far(self, twist: Array) -> bool:
        config = self._config
        turn = np.linalg.norm(twist[3:]) > np.radians(config.max_rotation)
        return bool(turn or np.linalg.norm(twist[:3]) > config.max_translation)

    def _refine(self, free: list[int]) -> None:
        """Move all free views together, unless that lays them worse; note what is known of each."""
        config, reach = self._config, self._config.reaches[-1]
        kept, pairs = self._twists, self._all_pairs(self._twists, reach)
        partners = {v: sum(len(m.points) for m in pairs if v in (m.moving, m.still)) for v in free}
        free = [v for v in free if partners[v] >= config.min_points]
        if not free:
            return
        asked = sum(len(self._views[m.moving].sample) for m in pairs)
        before = misfit(pairs, asked, kept, self._pivot, config.outlier * reach)
        twists = kept
        for _ in range(config.rounds):
            solution = solve(self._views, pairs, twists, free, self._pivot, config.outlier * reach, config)
            settled = np.abs(solution.twists - twists).max() < config.settled
            twists = solution.twists
            pairs = self._all_pairs(twists, reach)
            if settled:
                break
        worse = misfit(pairs, asked, twists, self._pivot, config.outlier * reach) > before
        self._twists = kept if worse or any(self._too_far(t) for t in twists) else twists
        covariance: Array = np.asarray(np.linalg.inv(solution.hessian), dtype=np.float64)
        for k, v in enumerate(free):
            block = np.s_[6 * k : 6 * k + 6]
            determined, directions = _determined(self._views[v].information, solution.hessian[block, block])
            self.placements[v] = replace(
                self.placements[v],
                covariance=covariance[block, block],
                determined=determined,
                directions=directions,
            )

    def _all_pairs(self, twists: Array, reach: float) -> list[Matches]:
        """Partners between all pairs of views, looked for anew where the two moved against each other."""
        T = [twist_transform(t, self._pivot) for t in twists]
        for still, moving in combinations(range(len(T)), 2):
            T_still_moving = frames.invert(T[still]) @ T[moving]
            known = self._pairs.get((still, moving))
            if known is None or np.abs(known[0] - T_still_moving).max() > self._config.settled:
                found = match(self._views, moving, still, T, reach, self._config)
                self._pairs[still, moving] = T_still_moving, found
        return [found for _, found in self._pairs.values()]


def _determined(information: Array, hessian: Array) -> tuple[Array, Array]:
    """Share (6,) of what is known that is not the report's, ascending, and the directions (6, 6) it is of."""
    half = np.linalg.inv(np.linalg.cholesky(information))
    values, vectors = np.linalg.eigh(half @ hessian @ half.T)
    return 1.0 - 1.0 / np.maximum(values, 1.0), half.T @ vectors
