"""All views' poses: a new view is laid onto the earlier ones, then all but the first move jointly."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from caryatid.config import RegistrationConfig
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.sensing.pose_graph import Index, Ties
from caryatid.sensing.registration import Gathering, RegisteredView, twist_transform
from caryatid.sensing.surfels import surfels_of
from caryatid.sensing.views import Cloud

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
        self._views: dict[int, RegisteredView] = {}
        self._twists = np.zeros((0, 6))
        self._ties = Ties.none()

    def copy(self) -> ViewRegistration:
        """Return a registration that knows the same and goes on by itself; the views so far are shared."""
        other = copy.copy(self)
        other.placements = self.placements.copy()
        other._views = self._views.copy()
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
        config, new = self._config, len(self.placements)
        surfels = surfels_of(cloud, config, same_labels=same_labels)
        view = RegisteredView.of(surfels, cloud.viewpoint_world, self._pivot, config)
        self._views[new] = view
        self._twists = np.concatenate([self._twists, np.zeros((1, 6))])
        gathering = Gathering.of(self._views)
        outcome = self._laid(gathering)
        known: Array = np.zeros((6, 6))
        if outcome not in EXACT:
            known = np.asarray(np.linalg.inv(view.information), dtype=np.float64)
        self.placements.append(Placement(np.zeros(6), outcome, known, np.zeros(6), np.eye(6)))
        if outcome == "beyond the limits":
            self._let_go([new])
        elif outcome not in EXACT:
            self._refine(gathering)
        moves = self._moves(gathering)
        if len(self._views) > config.kept:
            self._let_go([self._least_missed()])
        return moves

    def _laid(self, gathering: Gathering) -> Outcome:
        """Lay the newest view onto those that are kept, from where it was reported and coarse to fine."""
        config, reach = self._config, self._config.reaches[-1]
        outlier = config.outlier * reach
        *others, new = self._views
        if not others:
            return "reference"
        exact = [v for v in others if self.placements[v].outcome in EXACT]
        right = self._matched(gathering, exact, [new], reach)
        found = float(right.found.sum())
        if found >= config.min_points and float(right.misfit.sum()) < config.exact * found:
            rest = [v for v in others if v not in exact]
            self._ties = self._ties.joined(right).joined(self._matched(gathering, rest, [new], outlier))
            return "fits as reported"

        reported, information = self._twists, self._views[new].information
        best = fine = gathering.descend(reported, information, self._pivot, reach, config)
        twists = reported.copy()
        for wide in config.reaches[:-1]:
            twists[new] = gathering.descend(twists, information, self._pivot, wide, config).twist
        if np.abs(twists[new] - fine.twist).max() > outlier:
            coarse = gathering.descend(twists, information, self._pivot, reach, config)
            best = coarse if coarse.misfit < fine.misfit else fine
        better = best.misfit < fine.misfit_before
        outcome: Outcome = "aligned" if better else "no better"
        if better:
            twists[new] = best.twist
            self._twists = twists
        ties = self._matched(gathering, others, [new], outlier)
        if ties.found.sum() < config.min_points:
            outcome = "too few partners"
        elif better and self._too_far(best.twist):
            outcome = "beyond the limits"
        if better and outcome != "aligned":
            self._twists = reported
            ties = self._matched(gathering, others, [new], outlier)
        self._ties = self._ties.joined(ties)
        return outcome

    def _matched(
        self,
        gathering: Gathering,
        still: Sequence[int] | Index,
        moving: Sequence[int] | Index,
        outlier: float,
    ) -> Ties:
        """What pairs of views say of each other where they are, from the whole of their samples."""
        first, second = np.broadcast_arrays(np.asarray(still, np.intp), np.asarray(moving, np.intp))
        return gathering.match(first, second, self._twists, self._pivot, outlier, self._config)

    def _too_far(self, twist: Array) -> bool:
        config = self._config
        turn = np.linalg.norm(twist[3:]) > np.radians(config.max_rotation)
        return bool(turn or np.linalg.norm(twist[:3]) > config.max_translation)

    def _refine(self, gathering: Gathering) -> None:
        """Move all kept views together that are not exact, unless that lays them worse; note what is known.

        Views that few partners tie to the others stay where they are.
        """
        config, outlier = self._config, self._config.outlier * self._config.reaches[-1]
        before = self._twists, self._ties
        for _ in range(config.rounds):
            free, hessian = self._solve()
            if len(free) == 0:
                return
            stale = self._ties.stale(self._twists, config.rematch)
            if not stale.any():
                break
            old = self._ties.select(stale)
            anew = self._matched(gathering, old.still, old.moving, outlier)
            self._ties = self._ties.select(~stale).joined(anew)
        if self._ties.mean_misfit(outlier) > before[1].mean_misfit(outlier) + config.settled:
            self._twists, self._ties = before[0], before[1].among(np.array(list(self._views)))
        covariances, informations = _blocks(np.asarray(np.linalg.inv(hessian), np.float64)), _blocks(hessian)
        reported = np.stack([self._views[v].information for v in free])
        for v, covariance, determined, directions in zip(
            free, covariances, *_determined(reported, informations), strict=True
        ):
            self.placements[v] = replace(
                self.placements[v], covariance=covariance, determined=determined, directions=directions
            )

    def _solve(self) -> tuple[list[int], Array]:
        """Move all views to where the pairs of them want them; one that would go too far is let go.

        Returns:
            The views that were free to move, and the inverse covariance of their twists.
        """
        while True:
            enough = self._ties.partners(len(self._twists)) >= self._config.min_points
            free = [v for v in self._views if enough[v] and self.placements[v].outcome not in EXACT]
            informations = np.array([self._views[v].information for v in free]).reshape(-1, 6, 6)
            twists, hessian = self._ties.solve(self._twists, np.array(free, dtype=np.intp), informations)
            far = [v for v in free if self._too_far(twists[v])]
            if not far:
                self._twists = twists
                return free, hessian
            self._let_go(far)

    def _moves(self, gathering: Gathering) -> dict[int, Array]:
        """How views are to be moved now: the newest, and those whose points moved since they last were."""
        numbers = gathering.numbers.tolist()
        told = np.stack([self.placements[v].twist for v in numbers])
        T, T_told = (twist_transform(t, self._pivot) for t in (self._twists[numbers], told))
        moves = {}
        for v, now, then in zip(numbers, T, T_told, strict=True):
            change = gathering.sample(v)[:, :3] @ (now - then)[:3, :3].T + (now - then)[:3, 3]
            if v == numbers[-1] or np.einsum("ni,ni->n", change, change).max() > self._config.settled**2:
                moves[v] = now @ transforms.invert(then)
                self.placements[v] = replace(self.placements[v], twist=self._twists[v])
        return moves

    def _let_go(self, views: Sequence[int]) -> None:
        """Let views stay where they are from now on, and lay no others onto them."""
        for v in views:
            del self._views[v]
        self._ties = self._ties.among(np.array(list(self._views)))

    def _least_missed(self) -> int:
        """The kept view whose surfaces another one shows best; the first that nothing ties to any, if any."""
        kept = list(self._views)
        partners = self._ties.partners(len(self._twists))
        loose = [v for v in kept[1:] if partners[v] < self._config.min_points]
        if loose:
            return loose[0]
        shared = self._ties.shared(np.array(kept))
        pair = divmod(int(np.argmax(shared)), len(kept))
        return kept[max((k for k in pair if k > 0), key=lambda k: shared[k].sum())]


def _blocks(matrix: Array) -> Array:
    """Blocks (F, 6, 6) on the diagonal of a matrix (6·F, 6·F)."""
    size = len(matrix) // 6
    return np.asarray(matrix.reshape(size, 6, size, 6)[np.arange(size), :, np.arange(size)], dtype=np.float64)


def _determined(information: Array, hessian: Array) -> tuple[Array, Array]:
    """Share (F, 6) of what is known that is not the report's, ascending, and the directions (F, 6, 6)."""
    half = np.linalg.inv(np.linalg.cholesky(information))
    values, vectors = np.linalg.eigh(half @ hessian @ half.swapaxes(-1, -2))
    return 1.0 - 1.0 / np.maximum(values, 1.0), half.swapaxes(-1, -2) @ vectors
