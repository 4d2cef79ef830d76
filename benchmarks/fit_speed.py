"""Compare fits of single shapes with pyransac3d, CGAL and Open3D: time and error."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import product
from typing import Literal

import fits
import numpy as np
from peers import NEIGHBOURS, THRESHOLD, Estimate, cgal_fit, open3d_box, pyransac3d_fit, told
from rows import Effort, Row, median, timed, timed_row
from speed import fit_limit

import caryatid as ct
from caryatid.config import FitConfig
from caryatid.fitting.primitives import Fit
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Shape
from caryatid.geometry.transforms import Array
from caryatid.sensing.clouds import estimate_normals

Kind = Literal["box", "cylinder", "sphere"]
Fitter = Callable[[], Estimate]
RUNS = 3
"""Runs on each sample; pyransac3d is slow and runs once."""
USUAL, SLOW = 5000, 10_000
"""Number of points for which targets hold, errors are computed and `choose` is measured; and the number from
which pyransac3d is omitted, because a cylinder would take it eight seconds."""
SIGMA = 0.001
"""Noise of the points along each axis [m]."""
FIT = replace(fits.ONE_VIEW, threshold=THRESHOLD)
"""Settings of our fit: point errors are independent, and the threshold is the same as for the peers."""
PYRANSAC3D, CGAL, CGAL_ALONE, MINIMAL = "pyransac3d", "CGAL", "CGAL without normals", "Open3D's minimal box"
NAMES = {PYRANSAC3D: "pyransac3d", CGAL: "cgal", CGAL_ALONE: "cgal-alone", MINIMAL: "open3d"}
"""Last part of a row's name."""
PEERS = {
    "cylinder": (PYRANSAC3D, CGAL, CGAL_ALONE),
    "box": (PYRANSAC3D, MINIMAL),
    "sphere": (PYRANSAC3D, CGAL, CGAL_ALONE),
}
UNITS = {"axis": "deg", "radius": "mm", "extents": "mm", "volume": "%"}
FASTER = {
    ("cylinder", PYRANSAC3D): 1.0 / 200.0, ("cylinder", CGAL): 2.0, ("box", PYRANSAC3D): 1.0 / 50.0,
    ("box", MINIMAL): 1.0,
}  # fmt: skip
"""Targets: maximum ratio of our time to the peer's if the kind of shape is given to both. Against CGAL's
cylinders, our errors have a target too."""


def measure_fits(kind: Kind, effort: Effort) -> list[Row]:
    """Measure one kind of shape; each run draws one sample, the same for all fitters."""
    settings = [(count, "one side") for count in effort.points] + [(USUAL, "all around")]
    return [row for count, side in settings for row in _compare(kind, count, side, effort.runs)]


def _compare(kind: Kind, count: int, side: str, runs: int) -> Iterator[Row]:
    """Compare our fits with the peers': time and, for the usual number of points, errors."""
    peers = [
        p
        for p in PEERS[kind]
        if not (p == PYRANSAC3D and count >= SLOW) and not (p == CGAL_ALONE and side != "one side")
    ]
    variants = ["fit", "choose"] if count == USUAL else ["fit"]
    fitters = [*variants, *(["fit alone"] if CGAL_ALONE in peers else []), *peers]
    seconds: dict[str, list[float]] = defaultdict(list)
    errors: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    missing: dict[str, str] = {}
    for seed in range(runs):
        shape, points, normals, eye = draw(kind, count, side, seed)
        makers = _fitters(kind, points, normals, eye)
        for name in [name for name in fitters if name not in missing]:
            try:
                call = makers[name]()
                for _ in range(1 if name == PYRANSAC3D else RUNS):
                    took, estimate = timed(call, warm=name != PYRANSAC3D)
                    seconds[name].append(took)
            except Exception as error:
                if name not in peers:
                    raise
                missing[name] = told(error)
                seconds[name], errors[name] = [], defaultdict(list)
                continue
            for quantity, off in errors_of(estimate, shape).items():
                errors[name][quantity].append(off)
    where = f"{kind}.{count // 1000}k-{side.replace(' ', '-')}"
    words = f"{kind}, {count // 1000}k points, {side}"
    for variant, peer in product(variants, peers):
        if peer == CGAL_ALONE and variant != "fit":
            continue
        ours, name = "fit alone" if peer == CGAL_ALONE else variant, f"{variant}.{where}.{NAMES[peer]}"
        usual, note = count == USUAL, missing.get(peer, "")
        yield timed_row(
            name, words, seconds[ours], peer=peer, theirs=seconds[peer], limit=fit_limit(count), note=note,
            target=FASTER.get((kind, peer)) if usual and variant == "fit" else None,
        )  # fmt: skip
        for quantity in errors[ours] if usual else ():
            value, spread, known, lost = _median_known(errors[ours][quantity])
            theirs, _, _, theirs_lost = _median_known(errors[peer][quantity])
            notes = [note] if note else [f"{peer} found nothing in {theirs_lost}"] if theirs_lost else []
            notes += [f"ours found another shape in {lost} of {known + lost}"] if lost else []
            target = 1.0 if variant == "fit" and (kind, peer) == ("cylinder", CGAL) else None
            yield Row(
                f"{name}.{quantity}", f"{words}: error of the {quantity}", value, UNITS[quantity], spread,
                known, peer, theirs, target=target, note="; ".join(notes),
            )  # fmt: skip


def _fitters(kind: Kind, points: Array, normals: Array, eye: Array) -> dict[str, Callable[[], Fitter]]:
    """Return functions that prepare each fitter, ours and the peers', for a sample."""
    return {
        "fit": lambda: _ours(points, normals, replace(FIT, shapes=(kind,))),
        "choose": lambda: _ours(points, normals, FIT),
        "fit alone": lambda: _ours(points, eye, replace(FIT, shapes=(kind,))),
        PYRANSAC3D: lambda: pyransac3d_fit(kind, points),
        CGAL: lambda: cgal_fit(kind, points, normals),
        CGAL_ALONE: lambda: cgal_fit(kind, points, None),
        MINIMAL: lambda: open3d_box(points),
    }


def _median_known(errors: Sequence[float]) -> tuple[float | None, float, int, int]:
    """Return median and spread of the known errors, their number, and the number of unknown ones."""
    known = [e for e in errors if not np.isnan(e)]
    value, spread = median(known) if known else (None, 0.0)
    return value, spread, len(known), len(errors) - len(known)


def draw(kind: Kind, count: int, side: str, seed: int) -> tuple[Shape, Array, Array, Array]:
    """Draw a table-top shape, points (N, 3) on it [m], their normals (N, 3), and a viewpoint (3,) [m].

    One side shows everything that is measured: two faces of a box, the lateral surface of a cylinder.
    """
    rng = np.random.default_rng([fits.KINDS.index(kind), count, seed])
    shape = fits.random_shape(kind, rng)
    centre = shape.T_world_object[:3, 3]
    if side == "all around":
        points, outward = fits.dense_surface(shape, count, rng)
        points = points + SIGMA * rng.normal(size=points.shape)
        return shape, points, fits.normals_of(points, outward), centre
    while True:
        points, normals, view = fits.half_view(shape, count, SIGMA, rng)
        facing = np.abs(view @ shape.T_world_object[:3, :3]) > np.cos(fits.STEEPEST)
        if {"sphere": True, "box": facing.sum() > 1, "cylinder": facing[:2].any()}[kind]:
            return shape, points, normals, centre + view


def _ours(points: Array, normals: Array, config: FitConfig) -> Fitter:
    """Return a function that runs our fit, like the peers'; given a viewpoint (3,), it estimates normals."""

    def call() -> Estimate:
        given = estimate_normals(points, normals, NEIGHBOURS) if normals.ndim == 1 else normals
        found = ct.fit(points, given, config=config, rng=np.random.default_rng(0))
        if not isinstance(found, Fit):
            return {}
        if isinstance(found.shape, ct.Box):
            return {"extents": found.shape.extents}
        axis = {"axis": found.shape.T_world_object[:3, 2]} if isinstance(found.shape, ct.Cylinder) else {}
        return axis | {"radius": found.shape.extents[0] / 2.0}

    return call


def errors_of(estimate: Estimate, shape: Shape) -> dict[str, float]:
    """Return the errors of axis [deg], radius, mean extent [mm] and volume [%]; NaN if unknown."""
    if isinstance(shape, ct.Box):
        extents = np.sort(estimate.get("extents", np.full(3, np.nan)))
        off = float(np.abs(extents - np.sort(shape.extents)).mean())
        return {
            "extents": 1e3 * off,
            "volume": 100.0 * abs(float(np.prod(extents) / np.prod(shape.extents)) - 1.0),
        }
    radius = 1e3 * abs(float(estimate.get("radius", np.nan)) - float(shape.extents[0]) / 2.0)
    if isinstance(shape, ct.Sphere):
        return {"radius": radius}
    if "axis" not in estimate:
        return {"axis": np.nan, "radius": radius}
    angle = float(np.degrees(transforms.angle_between(estimate["axis"], shape.T_world_object[:3, 2])))
    return {"axis": min(angle, 180.0 - angle), "radius": radius}
