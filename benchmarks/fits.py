"""Measure fits of shapes to half views: points of one surface seen from one direction.

    python benchmarks/fits.py [--trials 200] [--gate]

A trial draws a shape of table-top size, a viewing direction, and points on the surface seen within 80° of it,
uniformly dense in the image. Each point gets Gaussian noise in space. Normals are those of planes through the
neighbours of each point; like normals from depth, they are noisy, and rounded at edges. Only what such a view
can tell is measured:

* An extent of a box counts if a face along it is seen, because that face shows its full length. If a single
  face is seen, two of the three extents count.
* Axis and radius of a cylinder always count, even if it is seen end-on (a disc). Its height counts only if
  the lateral surface is seen.
* The right shape always counts, even for a single face or a disc.
* `within` is the share of errors within twice the standard deviation that the fit claims for an independent
  error: 95 % if the claim is exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from measures import Gated, Measure, Row, run_main
from peers import NEIGHBOURS
from rich.console import Console
from scipy.spatial import cKDTree

from caryatid.config import FitConfig
from caryatid.fitting.primitives import Fit, fit
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Shape, Sphere
from caryatid.geometry.transforms import Array
from caryatid.objects.fusion import axes_rotation

BASELINE = Path(__file__).with_name("fits_baseline.json")
"""The committed figures."""
SETTINGS = (("", 0.001, 5000), ("noisy.", 0.003, 800))
"""Prefix of the measures, σ [m], and number of points: the targets' setting, and a sensor's at 1.5 m."""
KINDS = ("box", "cylinder", "sphere")
STEEPEST = np.radians(80.0)
"""Maximum angle between a surface's normal and the viewing direction for readings [rad]."""
ONE_VIEW = FitConfig(correlated=1.0, registration=0.0, rim=0.0)
"""Point errors are independent here: no registration error, no smoothing, no loss of pixels at rims."""


def random_shape(kind: str, rng: np.random.Generator) -> Shape:
    """Draw a shape of table-top size in any pose."""
    T = transforms.rigid(transforms.random_rotation(rng), rng.uniform(-0.3, 0.3, 3))
    if kind == "box":
        return Box(T, rng.uniform(0.04, 0.25, 3))
    if kind == "cylinder":
        return Cylinder(T, float(rng.uniform(0.02, 0.06)), float(rng.uniform(0.05, 0.25)))
    return Sphere(T, float(rng.uniform(0.02, 0.08)))


def half_view(shape: Shape, count: int, sigma: float, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Draw a random viewing direction; return points (N, 3) [m], normals (N, 3), and the direction (3,)."""
    view = transforms.random_rotation(rng)[:, 2]
    dense, outward = dense_surface(shape, 40 * count, rng)
    cosine = outward @ view
    weight = np.where(cosine > np.cos(STEEPEST), cosine, 0.0)
    chosen = rng.choice(len(dense), count, replace=False, p=weight / weight.sum())
    points = dense[chosen] + sigma * rng.normal(size=(count, 3))
    return points, normals_of(points, np.broadcast_to(view, points.shape)), view


def normals_of(points: Array, outward: Array) -> Array:
    """Return normals (N, 3) of planes through each point's neighbours, oriented like outward ones (N, 3)."""
    _, near = cKDTree(points).query(points, NEIGHBOURS)
    spread = points[near] - points[near].mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", spread, spread))[1][:, :, 0]
    return np.where((np.sum(normals * outward, axis=1) < 0.0)[:, None], -normals, normals)


def dense_surface(shape: Shape, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Draw points (N, 3) [m] uniformly on the whole surface, with outward normals (N, 3)."""
    if isinstance(shape, Sphere):
        outward = transforms.unit(rng.normal(size=(count, 3)))
        local = shape.radius * outward
    elif isinstance(shape, Box):
        e = shape.extents
        areas = np.repeat([e[1] * e[2], e[0] * e[2], e[0] * e[1]], 2)
        side = rng.choice(6, count, p=areas / areas.sum())
        local = rng.uniform(-0.5, 0.5, (count, 3)) * e
        outward = np.zeros((count, 3))
        outward[np.arange(count), side // 2] = 2.0 * (side % 2) - 1.0
        local = np.where(outward != 0.0, outward * e / 2.0, local)
    else:
        assert isinstance(shape, Cylinder)
        areas = np.array([2.0 * shape.radius * shape.height, shape.radius**2, shape.radius**2])
        side = rng.choice(3, count, p=areas / areas.sum())
        angle = rng.uniform(0.0, 2.0 * np.pi, count)
        ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
        z = shape.height / 2.0 * np.where(side == 0, rng.uniform(-1.0, 1.0, count), 2.0 * side - 3.0)
        reach = shape.radius * np.where(side == 0, 1.0, np.sqrt(rng.uniform(size=count)))
        outward = np.where((side == 0)[:, None], ring, np.array([0.0, 0.0, 1.0]) * np.sign(z)[:, None])
        local = reach[:, None] * ring + np.array([0.0, 0.0, 1.0]) * z[:, None]
    return transforms.transform(shape.T_world_object, local), transforms.rotate(shape.T_world_object, outward)


def run_trial(task: tuple[str, int, float, int]) -> Row:
    """Draw a shape and a view of it, fit, and compare.

    Returns:
        `kind` of the true shape, `found` (kind of the fit, or `none`), `note`, and `errors`: quantity, error
        and claimed standard deviation [mm, deg] of everything the view can tell; none if the shape is wrong.
    """
    kind, seed, sigma, count = task
    rng = np.random.default_rng([KINDS.index(kind), seed])
    shape = random_shape(kind, rng)
    points, normals, view = half_view(shape, count, sigma, rng)
    result = fit(points, normals, config=ONE_VIEW, rng=np.random.default_rng(seed))
    note = f"{kind} {seed}: {np.round(1e3 * shape.extents, 1)}"
    if not isinstance(result, Fit):
        return {"kind": kind, "found": "none", "errors": [], "note": note}
    found = result.shape.kind
    note += f" → {found} {np.round(1e3 * result.shape.extents, 1)}"
    errors = errors_of(result, shape, view) if found == kind else []
    return {"kind": kind, "found": found, "errors": errors, "note": note}


def errors_of(result: Fit, shape: Shape, view: Array) -> list[tuple[str, float, float]]:
    """Return signed errors of what a view can tell, with their claimed σ: lengths [mm], angles [deg]."""
    assert result.uncertainty is not None
    found, claimed = result.shape, result.uncertainty
    turn, angle = axes_rotation(found, shape)
    longer = 1e3 * (np.abs(turn.T @ found.extents) - shape.extents)
    sigma = 1e3 * np.abs(turn.T @ claimed.sizes)
    if isinstance(shape, Sphere):
        return [("radius", longer[0] / 2.0, sigma[0] / 2.0)]
    cosine = np.abs(view @ shape.T_world_object[:3, :3])
    if isinstance(shape, Cylinder):
        tilt = float(np.degrees(np.hypot(*claimed.rotation[:2])))
        errors = [("axis", float(np.degrees(angle)), tilt), ("radius", longer[0] / 2.0, sigma[0] / 2.0)]
        mantle = bool(np.hypot(cosine[0], cosine[1]) > np.cos(STEEPEST))
        return errors + [("height", longer[2], sigma[2])] * mantle
    facing = cosine > np.cos(STEEPEST)
    return [("extent", longer[k], sigma[k]) for k in range(3) if np.delete(facing, k).any()]


def measures(prefix: str, trials: Sequence[Row]) -> list[Measure]:
    """Return the share of right shapes, and median, 95th percentile and bias of each quantity's error."""
    found = []
    for kind, part in pd.DataFrame(trials).groupby("kind", sort=False):
        right = float((part["found"] == kind).mean())
        found.append(Measure(f"{prefix}{kind}.right", right, "1", "higher", 0.01))
        errors = pd.DataFrame(part["errors"].sum(), columns=["quantity", "error", "sigma"])
        for quantity, each in errors.groupby("quantity", sort=False):
            name, size = f"{prefix}{kind}.{quantity}", each["error"].abs()
            within = float((size < 2.0 * each["sigma"]).mean())
            found.append(Measure(f"{name}.within", within, "1", "higher", 0.05))
            unit, bias = ("deg", 0.0) if quantity == "axis" else ("mm", abs(each["error"].mean()))
            for label, figure in ("median", size.median()), ("95", size.quantile(0.95)), ("bias", bias):
                found.append(Measure(f"{name}.{label}", float(figure), unit, "lower", 0.1 + 0.1 * figure))
    return found


@dataclass(frozen=True)
class Fits(Gated):
    """Fit shapes to synthetic half views."""

    trials: int = 200
    """Number of trials per kind of shape."""

    def run(self, console: Console) -> int:
        """Fit, print and compare."""
        found, rows = list[Measure](), list[Row]()
        for prefix, sigma, count in SETTINGS:
            tasks = [(kind, seed, sigma, count) for kind in KINDS for seed in range(self.trials)]
            trials = self.each(run_trial, tasks, chunk=10)
            rows += [{"setting": prefix} | trial for trial in trials]
            found += measures(prefix, trials)
        self.write(rows)
        return self.finish(found, BASELINE, console)


if __name__ == "__main__":
    run_main(Fits)
