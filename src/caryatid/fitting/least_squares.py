"""Least squares on the geometric residual: the signed distance of points to a shape's surface."""

from __future__ import annotations

import numpy as np

from caryatid.geometry import BOX, CYLINDER, SPHERE
from caryatid.geometry.points import quantile, solve_positive
from caryatid.geometry.signed_distance import copy, gradient, local, signed_distances
from caryatid.runtime.parallel import inner, kernel

RIDGE = 1e-3 * np.array([1.0, 1.0, 1.0, 0.01, 0.01, 0.01, 0.01, 0.01, 0.01])
"""Added to the diagonal, times the damping, so that parameters that no point determines stay in place."""
NOISE_FLOOR = 0.001
"""Minimum standard deviation that the weights assume [m]: the error of smoothed points of several views.
With less, faces with few of the points would be outliers of the others.
"""
CONVERGED = 1e-4
"""Least squares stop at a step that lowers the cost by less than this share; the rest is far below noise."""


@kernel
def levenberg_marquardt(kind, shape, points, steps, min_extent, shrink, converged):  # type: ignore[no-untyped-def]
    """Minimise the Geman–McClure cost of signed distances of points (N, 3) to a shape.

    The shape (5, 3) is replaced by the one of the lowest cost. There is a minimum extent [m] and a pull
    `shrink` on the extents [m]; the last step lowers the cost by no more than the share `converged`.
    """
    columns, size = np.empty(9, np.intp), 0
    for a in range(9):
        if a < 7 or kind == BOX or (kind == CYLINDER and a == 8):
            columns[size] = a
            size += 1
    damping = 1e-3
    H_all, g_all = np.empty((9, 9)), np.empty(9)
    H, g = np.empty((size, size)), np.empty(size)
    trial, absolute = np.empty((5, 3)), np.empty(len(points))
    distance = signed_distances(kind, shape[:3], shape[3], shape[4], points)
    for _ in range(steps):
        for i in range(len(points)):
            absolute[i] = abs(distance[i])
        # Points further off than 2.5 robust standard deviations lose most of their weight.
        scale = 2.5 * max(1.4826 * quantile(absolute, 0.5), NOISE_FLOOR)
        normal_equations(kind, shape, points, scale, H_all, g_all)
        cost = _cost(distance, scale, shrink, shape, columns[:size])
        improved = False
        trial_cost = cost
        for _ in range(6):
            for a in range(size):
                g[a] = -(g_all[columns[a]] + (shrink / 2.0 if a >= 6 else 0.0))
                for b in range(size):
                    H[a, b] = H_all[columns[a], columns[b]]
                H[a, a] += damping * (H[a, a] + RIDGE[a])
            step = solve_positive(H, g)
            _stepped(kind, shape, step, columns, min_extent, trial)
            distance = signed_distances(kind, trial[:3], trial[3], trial[4], points)
            trial_cost = _cost(distance, scale, shrink, trial, columns[:size])
            if trial_cost < cost:
                improved = True
                copy(trial, shape)
                break
            damping *= 6.0
        if not improved:
            break
        damping = max(damping / 10.0, 1e-7)
        if cost - trial_cost < converged * cost:
            break


@kernel
def normal_equations(kind, shape, points, scale, H, g):  # type: ignore[no-untyped-def]
    """Write Gauss–Newton matrix (9, 9) and gradient (9,) of the mean Geman–McClure cost over points (N, 3).

    Columns: translation [m] and rotation [rad] in the object's frame, then half extents [m]; of a cylinder
    x and y share the radius (column 6, half height in column 8), of a sphere all three (column 6). A point at
    a distance of `scale` [m] weighs a quarter.
    """
    J = np.zeros(9)
    for a in range(9):
        g[a] = 0.0
        for b in range(9):
            H[a, b] = 0.0
    R, centre, share = shape[:3], shape[3], 1.0 / len(points)
    hx, hy, hz = shape[4, 0], shape[4, 1], shape[4, 2]
    for i in range(len(points)):
        x, y, z = local(R, centre, points, i)
        d, gx, gy, gz = gradient(kind, x, y, z, hx, hy, hz)
        weight = share / (1.0 + (d / scale) ** 2) ** 2
        J[0], J[1], J[2] = -gx, -gy, -gz
        J[3], J[4], J[5] = gy * z - gz * y, gz * x - gx * z, gx * y - gy * x
        if kind == BOX:
            J[6], J[7], J[8] = -abs(gx), -abs(gy), -abs(gz)
        elif kind == CYLINDER:
            J[6], J[8] = -np.sqrt(gx * gx + gy * gy), -abs(gz)
        else:
            J[6] = -1.0
        for a in range(9):
            if J[a] != 0.0:
                weighted = weight * J[a]
                g[a] += weighted * d
                for b in range(a + 1):
                    H[a, b] += weighted * J[b]
    for a in range(9):
        for b in range(a):
            H[b, a] = H[a, b]


@inner
def _stepped(kind, shape, step, columns, min_extent, trial):  # type: ignore[no-untyped-def]
    """Write the shape after a step in its own frame, shortened to 3 cm and 0.3 rad, no extent too short."""
    longest = 1.0
    for a in range(len(step)):
        longest = max(longest, abs(step[a]) / (0.3 if 3 <= a < 6 else 0.03))
    copy(shape, trial)
    turned, moved, grown = trial[:3], trial[3], trial[4]
    for a in range(6, len(step)):
        grown[columns[a] - 6] = max(grown[columns[a] - 6] + step[a] / longest, min_extent / 2.0)
    if kind == SPHERE:
        grown[1] = grown[2] = grown[0]
    elif kind == CYLINDER:
        grown[1] = grown[0]
    x, y, z = step[3] / longest, step[4] / longest, step[5] / longest
    angle = np.sqrt(x * x + y * y + z * z)
    # Rodrigues' formula for the rows of R: v cos + (v × k) sin + k (k · v)(1 − cos).
    sine = np.sin(angle) / angle if angle >= 1e-12 else 1.0
    rest = (1.0 - np.cos(angle)) / (angle * angle) if angle >= 1e-12 else 0.0
    for i in range(3):
        u, v, w = shape[i, 0], shape[i, 1], shape[i, 2]
        moved[i] += (u * step[0] + v * step[1] + w * step[2]) / longest
        along = rest * (u * x + v * y + w * z)
        cosine = np.cos(angle) if angle >= 1e-12 else 1.0
        turned[i, 0] = cosine * u + sine * (v * z - w * y) + along * x
        turned[i, 1] = cosine * v + sine * (w * x - u * z) + along * y
        turned[i, 2] = cosine * w + sine * (u * y - v * x) + along * z


@inner
def _cost(distance, scale, shrink, shape, columns):  # type: ignore[no-untyped-def]
    """The Geman–McClure cost of distances (N,), and the pull on the half extents, each once."""
    total = sizes = 0.0
    for d in distance:
        squared = (d / scale) ** 2
        total += squared / (1.0 + squared)
    for column in columns[6:]:
        sizes += shape[4, column - 6]
    return total / len(distance) * scale**2 + shrink * sizes
