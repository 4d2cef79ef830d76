"""What pairs of views say of each other's poses, kept and solved for all of them together.

Half the sum of the partners' squared distances over their variance is quadratic in the twist of one view
against the other as long as partners keep their weight.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from caryatid.geometry.transforms import Array

Edges = NDArray[np.void]
"""Pairs of views (E,), with fields as in `EDGE`."""

EDGE = np.dtype(
    [
        ("still", np.intp),  # The view in which partners were looked for,
        ("moving", np.intp),  # and the one whose patches looked for them.
        ("apart", np.float64, 6),  # Twist of the moving view less that of the still one when they did.
        ("asked", np.float64),  # How many patches looked for a partner,
        ("found", np.float64),  # and how many found one.
        ("misfit", np.float64),  # Sum of their distances [m], none counting more than an outlier.
        (
            "gradient",
            np.float64,
            6,
        ),  # Of the half sum by the moving view's twist; by the other's the opposite.
        ("information", np.float64, (6, 6)),  # Inverse covariance of one view's twist against the other.
    ]
)


def among(edges: Edges, views: list[int]) -> Edges:
    """Pairs of two of these views."""
    return edges[np.isin(edges["still"], views) & np.isin(edges["moving"], views)]


def change(edges: Edges, twists: Array) -> Array:
    """By how much (E, 6) pairs moved since partners were looked for, by the twists of all views (V, 6)."""
    return np.asarray(twists[edges["moving"]] - twists[edges["still"]] - edges["apart"], dtype=np.float64)


def mean_misfit(edges: Edges, outlier: float) -> float:
    """Mean distance [m] over the patches that looked for a partner; one without is an outlier [m]."""
    asked, found = edges["asked"].sum(), edges["found"].sum()
    return float((edges["misfit"].sum() + (asked - found) * outlier) / max(asked, 1))


def partners(edges: Edges, views: int) -> Array:
    """How many partners (V,) each of `views` = V views has in all others, or they have in it."""
    number = np.zeros(views)
    for end in ("still", "moving"):
        np.add.at(number, edges[end], edges["found"])
    return number


def solve(edges: Edges, twists: Array, free: NDArray[np.intp], informations: Array) -> tuple[Array, Array]:
    """Move the free views to where the pairs and their reported poses want them, all together.

    Args:
        edges: What the pairs say.
        twists: Where all views are (V, 6).
        free: Numbers (F,) of the views that may move, ascending.
        informations: Inverse covariance (F, 6, 6) of their reported poses.

    Returns:
        Where all views are (V, 6), and the inverse covariance (6·F, 6·F) of the free views' twists.
    """
    information = edges["information"]
    gradient = edges["gradient"] + np.einsum("eij,ej->ei", information, change(edges, twists))
    column = np.full(len(twists), -1)
    column[free] = np.arange(len(free))
    i, j = column[edges["moving"]], column[edges["still"]]
    H = np.zeros((len(free), len(free), 6, 6))
    H[np.arange(len(free)), np.arange(len(free))] = informations
    g = np.einsum("fij,fj->fi", informations, twists[free])
    for end, sign in ((i, 1.0), (j, -1.0)):
        np.add.at(H, (end[end >= 0], end[end >= 0]), information[end >= 0])
        np.add.at(g, end[end >= 0], sign * gradient[end >= 0])
    both = (i >= 0) & (j >= 0)
    np.subtract.at(H, (i[both], j[both]), information[both])
    np.subtract.at(H, (j[both], i[both]), information[both])
    hessian = H.transpose(0, 2, 1, 3).reshape(6 * len(free), 6 * len(free))
    moved = twists.copy()
    moved[free] -= np.linalg.solve(hessian, g.ravel()).reshape(-1, 6)
    return moved, hessian
