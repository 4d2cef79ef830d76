"""What pairs of views say of each other's poses, kept and solved for all of them together."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from caryatid.geometry.transforms import Array

Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False, slots=True)
class PoseEdges:
    """What pairs of views say of each other's poses, by the partners that patches of one have in the other.

    Half the sum of the partners' squared distances over their variance is quadratic in the twist of one view
    against the other as long as partners keep their weight.

    Attributes:
        still: Number (E,) of the view in which partners were looked for.
        moving: Number (E,) of the one whose patches looked for them.
        apart: Twist (E, 6) of the moving view less that of the still one when they did.
        asked: How many patches (E,) looked for a partner.
        found: How many (E,) found one.
        misfit: Sum (E,) of the distances of partners from each other's planes [m], none counting more than an
            outlier.
        gradient: Of that half sum by the moving view's twist (E, 6); by the other's it is the opposite.
        information: Inverse covariance (E, 6, 6) of the twist of one view against the other.
    """

    still: Index
    moving: Index
    apart: Array
    asked: Index
    found: Array
    misfit: Array
    gradient: Array
    information: Array

    @classmethod
    def none(cls) -> PoseEdges:
        """No pairs."""
        number, nothing = np.zeros(0, dtype=np.intp), np.zeros(0)
        return cls(
            *(number, number, np.zeros((0, 6)), number),
            *(nothing, nothing, np.zeros((0, 6)), np.zeros((0, 6, 6))),
        )

    def select(self, keep: NDArray[np.bool_]) -> PoseEdges:
        """Return the pairs picked by a mask (E,)."""
        return PoseEdges(*(values[keep] for values in self._arrays()))

    def joined(self, other: PoseEdges) -> PoseEdges:
        """Return these pairs and others."""
        both = zip(self._arrays(), other._arrays(), strict=True)
        return PoseEdges(*(np.concatenate(values) for values in both))

    def among(self, views: Index) -> PoseEdges:
        """Return the pairs of two of these views."""
        return self.select(np.isin(self.still, views) & np.isin(self.moving, views))

    def stale(self, twists: Array, limit: float) -> NDArray[np.bool_]:
        """Pairs (E,) that moved by more than a limit [m, rad] against each other since partners were found.

        Args:
            twists: Where all views are (V, 6).
            limit: The limit.
        """
        return np.asarray(np.abs(self._change(twists)).max(axis=1, initial=0.0) > limit)

    def mean_misfit(self, outlier: float) -> float:
        """Mean distance [m] over the patches that looked for a partner; one without is an outlier [m]."""
        missing = float(self.asked.sum() - self.found.sum())
        return (float(self.misfit.sum()) + missing * outlier) / max(int(self.asked.sum()), 1)

    def partners(self, views: int) -> Array:
        """How many partners (V,) each of `views` = V views has in all others, or they have in it."""
        number = np.zeros(views)
        for ends in (self.still, self.moving):
            np.add.at(number, ends, self.found)
        return number

    def shared(self, views: Index) -> Array:
        """Share (V, V) of the patches that looked for a partner and found one, of each pair of some views.

        Args:
            views: Their numbers (V,), ascending; both views of all pairs are among them.
        """
        share = np.zeros((len(views), len(views)))
        i, j = np.searchsorted(views, self.moving), np.searchsorted(views, self.still)
        share[i, j] = share[j, i] = self.found / np.maximum(self.asked, 1)
        return share

    def solve(self, twists: Array, free: Index, informations: Array) -> tuple[Array, Array]:
        """Move the free views to where the pairs and their reported poses want them, all together.

        Args:
            twists: Where all views are (V, 6).
            free: Numbers (F,) of the views that may move, ascending.
            informations: Inverse covariance (F, 6, 6) of their reported poses.

        Returns:
            Where all views are (V, 6), and the inverse covariance (6·F, 6·F) of the free views' twists.
        """
        gradient = self.gradient + np.einsum("eij,ej->ei", self.information, self._change(twists))
        column = np.full(len(twists), -1)
        column[free] = np.arange(len(free))
        i, j = column[self.moving], column[self.still]
        H = np.zeros((len(free), len(free), 6, 6))
        H[np.arange(len(free)), np.arange(len(free))] = informations
        g = np.einsum("fij,fj->fi", informations, twists[free])
        for end, sign in ((i, 1.0), (j, -1.0)):
            np.add.at(H, (end[end >= 0], end[end >= 0]), self.information[end >= 0])
            np.add.at(g, end[end >= 0], sign * gradient[end >= 0])
        both = (i >= 0) & (j >= 0)
        np.subtract.at(H, (i[both], j[both]), self.information[both])
        np.subtract.at(H, (j[both], i[both]), self.information[both])
        hessian = H.transpose(0, 2, 1, 3).reshape(6 * len(free), 6 * len(free))
        moved = twists.copy()
        moved[free] -= np.linalg.solve(hessian, g.ravel()).reshape(-1, 6)
        return moved, hessian

    def _arrays(self) -> tuple[Any, ...]:
        return tuple(getattr(self, field.name) for field in fields(self))

    def _change(self, twists: Array) -> Array:
        """By how much (E, 6) pairs moved against each other since partners were looked for."""
        return np.asarray(twists[self.moving] - twists[self.still] - self.apart, dtype=np.float64)
