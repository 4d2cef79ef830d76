"""Fits of single shapes against pyransac3d, CGAL and Open3D: time, and how far off the result is."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import fits
import numpy as np

import caryatid as ct
from caryatid.config import FitConfig
from caryatid.fitting.primitives import Fit
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Shape
from caryatid.sensing.clouds import estimate_normals
from performance import limits
from performance.clock import timed
from performance.effort import FULL, Effort
from performance.peers import (
    NEIGHBOURS,
    THRESHOLD,
    Estimate,
    Missing,
    cgal_fit,
    open3d_box,
    pyransac3d_fit,
    told,
)
from performance.rows import Median, Row, Target, timed_row
from performance.samples import Kind, Sample, Setting, draw

RUNS = 3
"""Runs on each sample, but of pyransac3d, which is slow: one."""
USUAL = 5000
"""Points the targets speak of; only with these errors are taken, and shapes chosen."""
SLOW = 10_000
"""With more points pyransac3d is left out [1]: a cylinder would take it eight seconds."""
FIT = replace(fits.ONE_VIEW, threshold=THRESHOLD)
"""Settings of our fit: every point has an error of its own, and the threshold is everybody's."""
VARIANTS: Mapping[str, Callable[[Kind], FitConfig]] = {
    "fit": lambda kind: replace(FIT, shapes=(kind,)),
    "choose": lambda kind: FIT,
}
"""First part of a row's name → our settings for a kind of shape."""
TOLD = "fit"
"""The variant that is told the shape, as the peers are; targets are for it."""
ALONE = "fit, alone"
"""The same where it estimates the normals first."""

PYRANSAC3D, CGAL, CGAL_ALONE, MINIMAL = "pyransac3d", "CGAL", "CGAL without normals", "Open3D's minimal box"
NAMES = {PYRANSAC3D: "pyransac3d", CGAL: "cgal", CGAL_ALONE: "cgal-alone", MINIMAL: "open3d"}
"""Last part of a row's name."""
PEERS: Mapping[Kind, tuple[str, ...]] = {
    "cylinder": (PYRANSAC3D, CGAL, CGAL_ALONE),
    "box": (PYRANSAC3D, MINIMAL),
    "sphere": (PYRANSAC3D, CGAL, CGAL_ALONE),
}
QUANTITIES = {"axis": "deg", "radius": "mm", "extents": "mm", "volume": "%"}
"""What is compared of the results, and its unit."""
FASTER = {
    ("cylinder", PYRANSAC3D): 1.0 / 200.0,
    ("cylinder", CGAL): 2.0,
    ("box", PYRANSAC3D): 1.0 / 50.0,
    ("box", MINIMAL): 1.0,
}
"""Largest share of the peer's time that is asked for."""
BETTER = {("cylinder", CGAL)}
"""Where no more error than the peer's is asked for."""


@dataclass(frozen=True, eq=False, slots=True)
class Found:
    """What a fitter took and found.

    Attributes:
        seconds: Of each run.
        errors: Quantity → error on each sample; NaN where nothing was found.
    """

    seconds: list[float]
    errors: dict[str, list[float]]


def measure_fits(kind: Kind, effort: Effort = FULL) -> list[Row]:
    """Rows of one kind of shape, a sample a run; every fitter gets the same ones."""
    rows: list[Row] = []
    for setting in settings(kind, effort):
        peers = [p for p in PEERS[kind] if takes_part(p, setting)]
        found = run(setting, peers, [draw(setting, seed) for seed in range(effort.runs)])
        for variant in variants(setting):
            for peer in peers:
                if peer == CGAL_ALONE and variant != TOLD:
                    continue
                ours = found[ALONE if peer == CGAL_ALONE else variant]
                assert isinstance(ours, Found)
                rows += compared(variant, ours, peer, found[peer], setting)
    return rows


def settings(kind: Kind, effort: Effort) -> list[Setting]:
    """What fitters of a kind of shape are compared on: the usual number of points from all around as well."""
    one_side = [Setting(kind, count, "one side") for count in effort.points]
    return [*one_side, Setting(kind, USUAL, "all around")]


def takes_part(peer: str, setting: Setting) -> bool:
    """Whether a peer is run in a setting."""
    if peer == PYRANSAC3D:
        return setting.count < SLOW
    return peer != CGAL_ALONE or setting.side == "one side"


def variants(setting: Setting) -> list[str]:
    """Ours that are run in a setting."""
    return [name for name in VARIANTS if name == TOLD or setting.count == USUAL]


def run(setting: Setting, peers: Sequence[str], samples: Sequence[Sample]) -> dict[str, Found | Missing]:
    """Run our fitters and some peers' on the samples of a setting, in turns; a peer that fails is missing."""
    found: dict[str, Found | Missing] = {}
    for sample in samples:
        for name, call in fitters(setting, peers, sample).items():
            entry = found.setdefault(name, Found([], {}))
            if isinstance(call, Missing) or isinstance(entry, Missing):
                found[name] = call if isinstance(call, Missing) else entry
                continue
            slow = name == PYRANSAC3D
            try:
                for _ in range(1 if slow else RUNS):
                    seconds, estimate = timed(call, warm=not slow)
                    entry.seconds.append(seconds)
            except Exception as failure:
                if name not in peers:
                    raise
                found[name] = Missing(f"{name} failed: {told(failure)}")
                continue
            for quantity, error in errors(estimate, sample.shape).items():
                entry.errors.setdefault(quantity, []).append(error)
    return found


def fitters(
    setting: Setting, peers: Sequence[str], sample: Sample
) -> dict[str, Callable[[], Estimate] | Missing]:
    """Our fitters and some peers' on a sample of a setting, by name."""
    kind, points, normals = setting.kind, sample.points, sample.normals
    calls: dict[str, Callable[[], Estimate] | Missing] = {
        name: our_fit(sample, VARIANTS[name](kind)) for name in variants(setting)
    }
    if CGAL_ALONE in peers:
        calls[ALONE] = our_fit(sample, VARIANTS[TOLD](kind), alone=True)
    makers: dict[str, Callable[[], Callable[[], Estimate] | Missing]] = {
        PYRANSAC3D: lambda: pyransac3d_fit(kind, points),
        CGAL: lambda: cgal_fit(kind, points, normals),
        CGAL_ALONE: lambda: cgal_fit(kind, points, None),
        MINIMAL: lambda: open3d_box(points),
    }
    return calls | {peer: makers[peer]() for peer in peers}


def our_fit(sample: Sample, config: FitConfig, *, alone: bool = False) -> Callable[[], Estimate]:
    """Our fit, behind a call like the peers'; `alone` it estimates the normals first."""

    def call() -> Estimate:
        normals = estimate_normals(sample.points, sample.eye, NEIGHBOURS) if alone else sample.normals
        found = ct.fit(sample.points, normals, config=config, rng=np.random.default_rng(0))
        return estimate_of(found.shape) if isinstance(found, Fit) else Estimate()

    return call


def estimate_of(shape: Shape) -> Estimate:
    """What a shape says of its axis, radius and extents; a box has no radius."""
    if isinstance(shape, ct.Cylinder):
        return Estimate(shape.T_world_object[:3, 2], shape.radius)
    if isinstance(shape, ct.Sphere):
        return Estimate(radius=shape.radius)
    return Estimate(extents=shape.extents)


def errors(estimate: Estimate, shape: Shape) -> dict[str, float]:
    """How far off: axis [deg], radius and mean of the extents [mm], volume [%]; NaN where nothing is said."""
    if isinstance(shape, ct.Box):
        if estimate.extents is None:
            return {"extents": np.nan, "volume": np.nan}
        off = np.sort(estimate.extents) - np.sort(shape.extents)
        larger = float(np.prod(estimate.extents) / np.prod(shape.extents))
        return {"extents": 1e3 * float(np.abs(off).mean()), "volume": 100.0 * abs(larger - 1.0)}
    radius = np.nan if estimate.radius is None else 1e3 * abs(estimate.radius - float(shape.extents[0]) / 2.0)
    if isinstance(shape, ct.Sphere):
        return {"radius": radius}
    if estimate.axis is None:
        return {"axis": np.nan, "radius": radius}
    angle = float(np.degrees(transforms.angle_between(estimate.axis, shape.T_world_object[:3, 2])))
    return {"axis": min(angle, 180.0 - angle), "radius": radius}


def compared(variant: str, ours: Found, peer: str, theirs: Found | Missing, setting: Setting) -> list[Row]:
    """Rows of a fit of ours beside a peer's: time and, at the usual number of points, the errors."""
    name, usual = f"{variant}.{setting.name}.{NAMES[peer]}", setting.count == USUAL
    faster = FASTER.get((setting.kind, peer)) if usual and variant == TOLD else None
    rows = [
        timed_row(
            name,
            setting.words,
            Median.of(ours.seconds),
            peer=peer,
            theirs=None if isinstance(theirs, Missing) else Median.of(theirs.seconds),
            limit=limits.machine().limit(*limits.fit_limit(setting.count)),
            target=None if faster is None else Target(faster),
            note=theirs.reason if isinstance(theirs, Missing) else "",
        )
    ]
    if usual:
        better = variant == TOLD and (setting.kind, peer) in BETTER
        rows += [_error(name, q, ours, peer, theirs, setting, better=better) for q in ours.errors]
    return rows


def _error(
    name: str,
    quantity: str,
    ours: Found,
    peer: str,
    theirs: Found | Missing,
    setting: Setting,
    *,
    better: bool,
) -> Row:
    """The row of an error: its median over the samples where something was found."""
    off = ours.errors[quantity]
    known = [error for error in off if not np.isnan(error)]
    peer_value, note = None, ""
    if isinstance(theirs, Missing):
        note = theirs.reason
    else:
        lost = int(np.isnan(theirs.errors[quantity]).sum())
        peer_value = float(np.nanmedian(theirs.errors[quantity])) if lost < len(off) else None
        note = f"{peer} found nothing in {lost} of {len(off)}" if lost else ""
    lost = len(off) - len(known)
    note += f"{'; ' if note and lost else ''}ours found another shape in {lost} of {len(off)}" if lost else ""
    return Row(
        f"{name}.{quantity}",
        f"{setting.words}: error of the {quantity}",
        Median.of(known).value if known else None,
        QUANTITIES[quantity],
        Median.of(known).spread if known else 0.0,
        len(known),
        peer,
        peer_value,
        target=Target(1.0) if better else None,
        note=note,
    )
