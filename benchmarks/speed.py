"""Measure the loop for `bench.py`: a step (`turn`), its stages, a decision, the map, start-up and growth."""

from __future__ import annotations

import copy
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path

import numba
import numpy as np
import psutil
from peers import hash_voxels, open3d_chain, told
from rows import PAUSE, Effort, Limit, Row, T, in_turns, median, timed, timed_row

from caryatid import Config, Scene, SupportGraph, View, next_best_view
from caryatid.config import SegmentationMethod, SensorConfig
from caryatid.errors import CaryatidError
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Shape, Sphere
from caryatid.geometry.transforms import UP, Array
from caryatid.io.bop import read_recording
from caryatid.io.graph_json import graph_text
from caryatid.manipulation.order import plan_order
from caryatid.planning.decision import PlanningState
from caryatid.planning.expected_visibility import SURFACE_SAMPLES
from caryatid.planning.planners import make_planner
from caryatid.planning.points_of_interest import points_of_interest
from caryatid.robots import Robot
from caryatid.runtime.parallel import one_blas_thread
from caryatid.segmentation.observation import segment_view
from caryatid.segmentation.support_plane import SupportSurface, find_support_surfaces
from caryatid.sensing.clouds import oriented_points
from caryatid.sensing.view_sphere import ViewSphere, direction
from caryatid.sensing.voxel_map import VoxelMap
from caryatid.simulation.scenes import load_scene
from caryatid.simulation.setup import make_simulation
from caryatid.simulation.world import (
    TABLE_HEIGHT,
    Body,
    SimulatedScene,
    build_spec,
    make_table,
    scene_from_spec,
    table_centre,
)

HEAP, VIEWS = "pile-10-1", 8
"""Scene of ten objects, and number of its views: the first one, and seven for the median."""
ELEVATION, GOLDEN_ANGLE = np.deg2rad(38.0), np.pi * (3.0 - np.sqrt(5.0))
"""Elevation of the views, and azimuth between consecutive ones [rad]; it spreads them all around."""
PITCH = 0.11
"""Distance between places on the table of many objects [m]: it leaves gaps between objects of 4 to 7 cm."""
SEGMENTATIONS: tuple[SegmentationMethod, ...] = ("auto", "labels")
SEGMENTS = {"auto": "automatic segments", "labels": "labels given"}
TARGETS = {"turn.auto": 0.5, "turn.labels": 0.5, "perceive.labels": 0.25}
BUDGET = 0.2
"""Budget of a call [s]."""
OBJECTS, POINTS = 36, 30
"""Objects on the table; some are dropped until a decision has at most this many points of interest [1]."""
AXES = {
    "points": "pixels of the image", "objects": "objects on the table", "views": "views seen",
    "voxels": "voxels of the map",
}  # fmt: skip
IMPORT = "import time; t = time.perf_counter(); import caryatid; print(time.perf_counter() - t)"
FIRST_VIEWS = """
import time
started = time.perf_counter()
import caryatid as ct
from caryatid.simulation import load_scene
from caryatid.simulation.setup import make_simulation
for segmentation in ("auto", "labels"):
    simulation = make_simulation(load_scene("clutter"), ct.Config(), noise="carmine", seed=0)
    scene = ct.Scene(segmentation=segmentation)
    for _ in range(2):
        scene.update(simulation.camera.capture(simulation.robot.T_world_camera))
        simulation.robot.move_to(ct.next_best_view(scene, simulation.robot).T_world_camera)
print(time.perf_counter() - started)
"""
"""A user's first steps, in a new process; prints their duration [s]."""


@dataclass(frozen=True, eq=False, slots=True)
class Recording:
    """Views of a scene (V), their true camera poses (V, 4, 4), and a robot that can reach these."""

    config: Config
    poses: Array
    views: tuple[View, ...]
    robot: Robot


def record(scene: SimulatedScene, count: int = VIEWS, sensor: SensorConfig | None = None) -> Recording:
    """Capture views from all around, with the simulated camera's noise and registration error."""
    config = replace(Config(), sensor=sensor or SensorConfig())
    simulation = make_simulation(scene, config, noise="carmine", seed=0)
    poses = _ring(scene, simulation.robot, config, count)
    views = tuple(simulation.camera.capture(T) for T in poses)
    return Recording(config, poses, views, simulation.robot)


def _ring(scene: SimulatedScene, robot: Robot, config: Config, count: int) -> Array:
    """Return reachable poses (V, 4, 4) around the table; the first is the robot's current one."""
    sphere = ViewSphere.around(table_centre(scene), config.active)
    reached = robot.candidates(sphere)
    first = sphere.direction_of(robot.T_world_camera)
    azimuths = np.arctan2(first[1], first[0]) + GOLDEN_ANGLE * np.arange(1, count)
    wanted = np.stack([first, *(direction(a, ELEVATION) for a in azimuths)])
    poses = reached.T_world_camera[np.argmax(reached.directions @ wanted.T, axis=0)]
    poses[0] = robot.T_world_camera
    return poses


def table_of(count: int, size: tuple[float, float] = (1.2, 1.2), pitch: float = PITCH) -> SimulatedScene:
    """Build a table [m] with boxes, cylinders and balls in rows, a third of them on top of others."""
    rng = np.random.default_rng([count, 0])
    stacked = count // 3
    rows = int(np.ceil(np.sqrt((count - stacked) * size[0] / size[1])))
    columns = int(np.ceil((count - stacked) / rows))
    places = (np.argwhere(np.ones((rows, columns))) - (np.array([rows, columns]) - 1) / 2.0) * pitch
    places = places[np.argsort(np.hypot(*places.T), kind="stable")][: count - stacked]
    below = [_standing(xy, 0.0, rng, flat=k < stacked) for k, xy in enumerate(places)]
    above = [_standing(b.T_world_object[:2, 3], b.extents[2], rng) for b in below[:stacked]]
    name = f"table-of-{count}"
    return scene_from_spec(
        build_spec([Body(s) for s in (*below, *above)], name, make_table(size)), name, name
    )


def _standing(xy: Array, height: float, rng: np.random.Generator, *, flat: bool = False) -> Shape:
    """Draw a shape that stands at a height above the table [m]; with `flat`, one that others can stand on."""
    turn = transforms.rotation_from_vector((0.0, 0.0, rng.uniform(-np.pi, np.pi)))
    kind = rng.choice(["box", "cylinder"] if flat else ["box", "cylinder", "sphere"])
    size = rng.uniform(0.04, 0.07, 3)
    tall = size[0] if kind == "sphere" else size[2]
    T = transforms.rigid(turn, (*xy, TABLE_HEIGHT + height + tall / 2.0 + 1e-4))
    if kind == "box":
        return Box(T, size)
    return Cylinder(T, size[0] / 2.0, size[2]) if kind == "cylinder" else Sphere(T, size[0] / 2.0)


Laps = dict[str, float]
"""Durations of a step and its parts [s]."""


def fresh(view: View, *, labels: bool = True) -> View:
    """Copy a view as it comes from the camera: nothing is computed from it yet."""
    return replace(view, labels=view.labels if labels else None)


class Episode:
    """A scene model that gets a recording's views one by one, fresh from the camera."""

    def __init__(self, recording: Recording, segmentation: SegmentationMethod) -> None:
        self.scene = Scene(recording.config, segmentation=segmentation)
        self._robot, self._labels = copy.copy(recording.robot), segmentation == "labels"
        self._visited: list[Array] = []

    def look(self, T_world_camera: Array, view: View) -> Laps:
        """Add a view and choose the next one; return the durations of the step, its parts and stages [s]."""
        time.sleep(PAUSE)
        self._robot.move_to(T_world_camera)
        started = time.perf_counter()
        self.scene.update(fresh(view, labels=self._labels))
        known = time.perf_counter()
        assert self.scene.sphere is not None
        self._visited.append(self.scene.sphere.direction_of(T_world_camera))
        next_best_view(self.scene, self._robot, np.array(self._visited))
        ended = time.perf_counter()
        whole = {"turn": ended - started, "perceive": known - started, "plan": ended - known}
        return dict(self.scene.timings) | whole


def measure_turns(effort: Effort) -> list[Row]:
    """Measure the step, perception and the stages; ours and Open3D's chain alternate view by view.

    After a warm-up, some passes cover all views; the others cover only the first view, for its median.
    """
    recording = record(load_scene(HEAP))
    chains, missing = [], ""
    try:
        chains = [open3d_chain(view, recording.config.cloud.max_depth) for view in recording.views]
    except (ImportError, OSError) as error:
        missing = told(error)
    first, later = defaultdict[str, list[Laps]](list), defaultdict[str, list[Laps]](list)
    for repeat in range(effort.runs + 1):
        episodes = {name: Episode(recording, name) for name in SEGMENTATIONS}
        for k in range(len(recording.views) if repeat <= min(3, effort.runs) else 1):
            took = {"chain": {"chain": timed(chains[k], warm=False)[0]}} if chains else {}
            took |= {n: e.look(recording.poses[k], recording.views[k]) for n, e in episodes.items()}
            for name, laps in took.items() if repeat else ():
                (later if k else first)[name].append(laps)
    view = recording.views[0]
    images = view.depth.nbytes + (0 if view.rgb is None else view.rgb.nbytes)
    rows = [
        timed_row(
            f"{kind}.{name}{which}",
            f"{what}, {SEGMENTS[name]}{', first view alone' if which else ''}",
            [laps[kind] for laps in found[name]],
            peer="Open3D's chain",
            theirs=[laps["chain"] for laps in found["chain"]],
            limit=(images, 0.0),
            target=None if which else TARGETS.get(f"{kind}.{name}"),
            note=missing,
        )
        for kind, what in (("turn", "view in → next view"), ("perceive", "view in → graph"))
        for name in SEGMENTATIONS
        for which, found in (("", later), (".first", first))
    ]
    return rows + _stages(recording, later, effort)


def measure_beside(effort: Effort) -> list[Row]:
    """Measure the step with one busy process per core beside it, against the same step without them."""
    recording, rows, cores = record(load_scene(HEAP)), [], os.cpu_count() or 1
    for name in SEGMENTATIONS:
        took: dict[int, list[float]] = {0: [], cores: []}
        for _ in range(effort.runs // 3 + 1):
            for count, turns in took.items():
                episode = Episode(recording, name)
                busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
                try:
                    looks = map(episode.look, recording.poses, recording.views)
                    turns += [laps["turn"] for laps in looks][1:]
                finally:
                    for process in busy:
                        process.kill()
                        process.wait()
        what = f"view in → next view beside {cores} busy processes, {SEGMENTS[name]}"
        theirs, peer = took[0], "without them"
        rows.append(timed_row(f"turn.{name}.beside", what, took[cores], peer=peer, theirs=theirs, target=3.0))
    return rows


def _stages(recording: Recording, later: dict[str, list[Laps]], effort: Effort) -> list[Row]:
    """Measure the stages: those that can be called alone, on the first view, and those within steps."""
    config, view = recording.config, recording.views[0]
    points, normals, pixels = oriented_points(view, config.cloud)
    assert view.labels is not None
    loose = np.flatnonzero(view.labels.ravel()[pixels] == 0)
    loose = loose[:: max(1, len(loose) // 20_000)]

    def surfaces() -> list[SupportSurface]:
        rng = np.random.default_rng(0)
        return find_support_surfaces(points[loose], normals[loose], UP, config.surface, rng)

    found = surfaces()

    def segments() -> object:
        rng = np.random.default_rng(0)
        return segment_view(fresh(view, labels=False), found, config, rng)

    # Depth in; position, normal and pixel of each point out; six running sums and three unknowns per pixel.
    size = view.depth.size
    of_points = (4.0 * size + 56.0 * len(points), 64.0 * size)
    alone: dict[str, tuple[str, Callable[[], object], Limit]] = {
        "points": (
            "oriented points of a view", lambda: oriented_points(fresh(view), config.cloud), of_points,
        ),
        "surface": ("support surfaces among them", surfaces, (48.0 * len(loose), 0.0)),
        "parts": ("automatic segments of a view", segments, (8.0 * size, 0.0)),
    }  # fmt: skip
    rows = [
        timed_row(f"stage.{name}", what, in_turns({name: call}, 3 * effort.runs)[name], limit=limit)
        for name, (what, call, limit) in alone.items()
    ]
    valid, objects = float(view.valid.sum()), len(np.unique(view.labels)) - 1
    shape_numbers = 22  # pose and size of a fitted shape, and their uncertainties
    voxels = float(np.prod(np.ceil(np.array(config.voxels.extent) / config.voxels.size)))
    limits: dict[str, Limit] = {
        "segment": (4.0 * size + 56.0 * valid, 64.0 * size),
        "register": (48.0 * valid, 0.0),
        "map": (4.0 * size + 4.0 * voxels, 0.0),
        "fit": fit_limit(int(np.count_nonzero(view.labels[view.valid]))),
        "infer": (8.0 * shape_numbers * objects, 6.0 * objects * (objects - 1)),
        "fuse": (8.0 * shape_numbers * objects, 0.0),
        "plan": plan_limit(voxels, config.active.sphere_points, config),
    }
    for name in SEGMENTATIONS:
        for stage in [s for s in later[name][0] if s not in ("turn", "perceive")]:
            what = f"{stage}, in a step with {SEGMENTS[name]}"
            took = [laps[stage] for laps in later[name]]
            rows.append(timed_row(f"stage.{name}.{stage}", what, took, limit=limits.get(stage)))
    return rows


def fit_limit(points: int) -> Limit:
    """Limit of a fit: score three shapes at 20 operations per point, one least-squares step of 9 numbers."""
    return 48.0 * points, points * (20.0 * 3 + 20.0 + 2.0 * 9 + 9 * 10.0)


def plan_limit(voxels: float, candidates: int, config: Config) -> Limit:
    """Limit of a decision: read map and poses once; rotate each sample to each look, at 20 operations."""
    return voxels + 152.0 * candidates, 20.0 * SURFACE_SAMPLES * config.active.look_directions


def measure_decision(effort: Effort) -> list[Row]:
    """Measure one decision over the view sphere: the default planner against the field's volumetric one."""
    recording = record(table_of(OBJECTS), 2)
    scene, robot, config = Scene(recording.config, segmentation="labels"), recording.robot, recording.config
    for view in recording.views:
        scene.update(fresh(view))
    sphere, voxels = scene.sphere, scene.voxels
    assert sphere is not None
    assert voxels is not None
    robot.move_to(recording.poses[-1])
    visited = sphere.direction_of(recording.poses)
    objects, points = list(scene.graph.objects), POINTS + 1
    while points > POINTS:  # an object has one per supporter, and at least one
        objects.pop()
        ids = {o.id for o in objects}
        graph = SupportGraph(tuple(objects), tuple(s for s in scene.graph.supports if ids.issuperset(s.pair)))
        points = len(points_of_interest(graph, sphere, visited, config.active))
    unasked = copy.copy(robot)
    state = PlanningState(graph, sphere, voxels, visited, robot.candidates(sphere), config.active)
    every = replace(state, config=replace(config.active, look_directions=1_000_000))

    def plan(name: str, state: PlanningState) -> Callable[[], object]:
        planner = make_planner(name)
        return one_blas_thread(lambda: planner.plan(state, np.random.default_rng(0)))

    found = in_turns(
        {
            "ours": plan("support", state),
            "theirs": plan("occlusion-aware", state),
            "every": plan("occlusion-aware", every),
            "reach": lambda: copy.copy(unasked).candidates(sphere),
        },
        effort.runs,
    )
    what = f"one decision, {points} points of interest"
    limit = plan_limit(voxels.hits.size, len(state.candidates), config)
    note = (
        f"{len(sphere.directions):,} views, {len(state.candidates):,} within reach; the planner beside it "
        f"looks from one in {config.active.look_directions:,} directions all around"
    )
    return [
        timed_row(
            "decision", what, found["ours"], peer="the planner occlusion-aware", theirs=found["theirs"],
            limit=limit, target=0.05, note=note,
        ),
        timed_row(
            "decision.every", what, found["ours"], peer="occlusion-aware, from every view",
            theirs=found["every"], limit=limit, note="both score every view in reach",
        ),
        timed_row(
            "decision.reach", "which views the robot reaches, before it", found["reach"],
            limit=(152.0 * len(sphere.directions), 0.0),
        ),
    ]  # fmt: skip


def measure_map(effort: Effort) -> list[Row]:
    """Measure a map update with a VGA view against a pass that only unprojects and hashes its points."""
    recording = record(load_scene(HEAP), 3)
    config, view = recording.config, recording.views[-1]
    centre_world = recording.poses[0][:3, 3] + config.active.sphere_radius * recording.poses[0][:3, 2]
    known = VoxelMap.around(centre_world, config.voxels)
    for earlier in recording.views[:-1]:
        known = known.integrate(earlier, config.cloud.max_depth)
    size = config.voxels.size
    calls = {
        "map": lambda: known.integrate(view, config.cloud.max_depth), "pass": lambda: hash_voxels(view, size),
    }  # fmt: skip
    found = in_turns(calls, 3 * effort.runs)
    what, peer = f"update of the voxel map, {size * 100.0:g} cm", "unprojecting and hashing alone"
    points, count = int(view.valid.sum()), len(hash_voxels(view, size))
    note = f"{points:,} points in {count:,} voxels; the map bounds its space, the pass does not"
    limit = (4.0 * view.depth.size + 4.0 * known.hits.size, 0.0)
    theirs = found["pass"]
    return [
        timed_row("map", what, found["map"], peer=peer, theirs=theirs, limit=limit, target=3.0, note=note)
    ]


def measure_start(effort: Effort) -> list[Row]:
    """Measure start-up, each run in its own process; the first run of each kind is the warm-up."""

    def run(*arguments: str, **environment: str) -> str:
        command, known = [sys.executable, *arguments], os.environ | environment
        return subprocess.check_output(command, env=known, stderr=subprocess.DEVNULL, text=True)

    importing = [float(run("-c", IMPORT)) for _ in range(effort.runs + 1)][1:]
    helping = [timed(lambda: run("-m", "caryatid", "--help"), warm=False)[0] for _ in range(effort.runs + 1)]
    with tempfile.TemporaryDirectory() as cache:
        runs = 1 + min(3, effort.runs)
        cold, *warm = [float(run("-c", FIRST_VIEWS, NUMBA_CACHE_DIR=cache)) for _ in range(runs)]
    views = "two views with automatic segments, two with labels"
    return [
        Row(f"start.{name}", what, median(took)[0], "s", median(took)[1], len(took), target=target)
        for name, what, took, target in (
            ("import", "import caryatid", importing, 0.5),
            ("help", "caryatid --help", helping[1:], 0.4),
            ("first", f"first use, nothing compiled: {views}", [cold], 30.0),
            ("compile", "of it, compiling", [cold - median(warm)[0]], 30.0),
            ("again", "the same in a new process, compiled", warm, None),
        )
    ]


def measure_growth(axis: str, effort: Effort) -> list[Row]:
    """Measure the exponents with which a step's time grows along one of `AXES`, and memory of many views."""
    if axis == "views":
        return [row for name in SEGMENTATIONS for row in _over_views(name, effort.views)]
    recordings, seen = [], effort.runs + 1
    if axis == "points":
        usual = SensorConfig()
        for w in effort.widths:
            height, focal = w * usual.height // usual.width, usual.focal * w / usual.width
            sensor = replace(usual, width=w, height=height, focal=focal)
            recordings.append((float(w * height), record(load_scene(HEAP), seen, sensor)))
    elif axis == "objects":
        recordings = [(float(n), record(table_of(n), seen)) for n in effort.objects]
    else:
        known = record(load_scene(HEAP), seen)
        for edge in effort.voxels:
            config = replace(known.config, voxels=replace(known.config.voxels, size=edge))
            count = float(np.prod(np.ceil(np.array(config.voxels.extent) / edge)))
            recordings.append((count, replace(known, config=config)))
    rows = []
    for name in SEGMENTATIONS:
        turns = []
        for _, recording in (recordings[0], *recordings):
            episode = Episode(recording, name)
            took = map(episode.look, recording.poses, recording.views)
            turns.append(median([laps["turn"] for laps in took][1:])[0])
        rows.append(_exponent(axis, name, [size for size, _ in recordings], turns[1:]))
    return rows


def _exponent(axis: str, segmentation: str, sizes: Sequence[float], turns: Sequence[float]) -> Row:
    """Fit the exponent with which a step's time grows with size: least squares on the logarithms of both."""
    whole, upper = (
        np.polyfit(np.log(sizes[k:]), np.log(turns[k:]), 1)[0] for k in (0, (len(sizes) - 1) // 2)
    )
    what = f"growth with {AXES[axis]}, {SEGMENTS[segmentation]}"
    note = f"{sizes[0]:,.0f} to {sizes[-1]:,.0f}; over the upper half {upper:.2f}"
    target = 1.1 if axis in ("objects", "views") else None
    name = f"growth.{axis}.{segmentation}"
    return Row(name, what, float(whole), "1", runs=len(sizes), target=target, note=note)


def _over_views(segmentation: SegmentationMethod, views: int) -> list[Row]:
    """Measure growth with the number of views, from the tenth on, and peak memory, in a separate process."""
    (turns, held), peak = _alone(_many_views, segmentation, views)
    edges = np.unique(np.geomspace(min(10, len(turns) // 2), len(turns) + 1, 13).astype(int))
    bins = [range(a, b) for a, b in pairwise(edges)]
    sizes = [float(np.exp(np.mean(np.log(b)))) for b in bins]
    row = _exponent("views", segmentation, sizes, [median([turns[v - 1] for v in b])[0] for b in bins])
    what = f"peak memory of {views} views, {SEGMENTS[segmentation]}"
    note = f"{held[-1] - held[len(held) // 5]:.0f} MB in the last four fifths of them"
    return [row, Row(f"growth.memory.{segmentation}", what, peak, "MB", target=1024.0, note=note)]


def _alone(call: Callable[..., T], *arguments: object) -> tuple[T, float]:
    """Run a call in a separate process; return its result and the peak memory of that process [MB]."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        result = pool.submit(call, *arguments).result()
        # Unlike getrusage's, this peak excludes the parent process.
        status = pool.submit(Path("/proc/self/status").read_text, "ascii").result()
    return result, _peak(status)


def _many_views(segmentation: SegmentationMethod, views: int) -> tuple[list[float], list[float]]:
    """Return the duration of each of many steps [s], and the memory held after it [MB]."""
    scene = load_scene(HEAP)
    episode, process = Episode(record(scene, 1), segmentation), psutil.Process()
    turns: list[float] = []
    held: list[float] = []
    simulation = make_simulation(scene, Config(), noise="carmine", seed=0)
    for T_world_camera in _ring(scene, simulation.robot, Config(), views):
        turns.append(episode.look(T_world_camera, simulation.camera.capture(T_world_camera))["turn"])
        held.append(process.memory_info().rss / 1e6)
    return turns, held


def measure_large(effort: Effort) -> list[Row]:
    """Measure a table of 3 × 2 m with very many objects: a step, peak memory, and a removal order."""
    rows = []
    for name in SEGMENTATIONS:
        turns, peak, ordering, found = _alone(_many_objects, name, effort.crowd)[0]
        what = f"{effort.crowd} objects on 3 × 2 m, {SEGMENTS[name]}"
        note = f"{found} found after {len(turns)} views, each of a part of the table"
        rows += [
            timed_row(f"large.turn.{name}", f"{what}: a turn", turns[1:], target=1000.0, note=note),
            Row(f"large.memory.{name}", f"{what}: peak memory", peak, "MB", target=1500.0),
        ]
        if ordering:
            rows.append(Row("large.order", f"{what}: a removal order", ordering, "s", target=60.0))
    return rows


def _many_objects(segmentation: SegmentationMethod, count: int) -> tuple[list[float], float, float, int]:
    """Return times of steps [s], peak memory [MB], time of a removal order with labels [s], objects found."""
    size, middle = (3.0, 2.0), np.array([0.0, 0.0, TABLE_HEIGHT])
    config = replace(Config(), voxels=replace(Config().voxels, extent=(3.2, 2.2, 0.5)))
    simulation = make_simulation(table_of(count, size, 0.17), config, noise="carmine", seed=0)
    scene, turns = Scene(config, segmentation=segmentation), []
    for azimuth in GOLDEN_ANGLE * np.arange(8):
        out = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        pose = transforms.look_at(middle + (1.9, 1.4, 0.0) * out + (0.0, 0.0, 1.3), middle + 0.5 * out)
        view, started = simulation.camera.capture(pose), time.perf_counter()
        scene.update(fresh(view, labels=segmentation == "labels"))
        next_best_view(scene, simulation.robot)
        turns.append(time.perf_counter() - started)
    peak, started = _peak(Path("/proc/self/status").read_text("ascii")), time.perf_counter()
    if segmentation == "labels":
        plan_order(scene.graph, config, hands=2, threads=numba.get_num_threads())
    ordering = time.perf_counter() - started if segmentation == "labels" else 0.0
    return turns, peak, ordering, len(scene.graph.objects) - 1


def _peak(status: str) -> float:
    """Read the peak memory [MB] of a process from the text of its status file."""
    return int(status.split("VmHWM:")[1].split()[0]) / 1024.0


def measure_real(effort: Effort) -> list[Row]:
    """Measure real frames: the first view of each, on one thread, and ten views of the slowest."""
    folders = [f for f in sorted(effort.real.glob("*/")) if "-masks" not in f.name]
    if not folders:
        return [Row("perceive.real", "real frames", None, target=1000.0, note=f"{effort.real} is missing")]
    took, _ = _alone(_real_views, folders[:1] + folders, 1)
    seconds, slowest = max((seconds, folder) for folder, seconds in took.items())
    _, peak = _alone(_real_views, [slowest], 10)
    what = "real frame in → graph, automatic segments, CPU time on one thread"
    return [
        timed_row("perceive.real", what, [*took.values()], target=1000.0),
        timed_row("perceive.real.slowest", f"the slowest, {slowest.name}", [seconds], target=2500.0),
        Row("growth.memory.real", "peak memory of ten views of that frame", peak, "MB", target=1024.0),
    ]


def measure_budget(effort: Effort) -> list[Row]:
    """Measure how long calls with a budget take, on views of a heap and on real frames."""
    sources: list[tuple[SegmentationMethod, list[View]]] = []
    heap = record(load_scene(HEAP), 4).views
    for name in SEGMENTATIONS:
        sources.append((name, [fresh(view, labels=name == "labels") for view in heap]))
    folders = [f for f in sorted(effort.real.glob("*/")) if "-masks" not in f.name]
    sources += [("auto", [read_recording(folder)[0]]) for folder in folders]
    took, differing = list[float](), 0
    for segmentation, views in sources:
        whole, hurried = Scene(segmentation=segmentation), Scene(segmentation=segmentation)
        for view in views:
            with suppress(CaryatidError):
                whole.update(view)
        while views or hurried.open:
            following, started = views.pop(0) if views else None, time.perf_counter()
            with suppress(CaryatidError):
                hurried.update(following, budget=BUDGET)
            took.append(1e3 * (time.perf_counter() - started))
        differing += graph_text(whole.graph) != graph_text(hurried.graph)
    what = f"99 % of calls with a budget of {1e3 * BUDGET:g} ms return within"
    note = f"{len(sources)} scenes and frames, of which {differing} end with another graph than without"
    row = Row(
        "perceive.budget", what, float(np.quantile(took, 0.99)), "ms", runs=len(took), target=1.2e3 * BUDGET
    )
    return [replace(row, note=note)]


def _real_views(folders: Sequence[Path], views: int) -> dict[Path, float]:
    """Add the same view several times; return the CPU time [s] of the last, per recording with a surface."""
    numba.set_num_threads(1)
    took = {}
    for folder in folders:
        scene = Scene(segmentation="auto")
        for _ in range(views):
            view, started = read_recording(folder)[0], time.process_time()
            # A single image has no pose until a surface gives it one.
            scene.update(view if scene.T_world_camera is None else view.with_pose(scene.T_world_camera))
            if scene.views:  # otherwise the view is kept for later
                took[folder] = time.process_time() - started
    return took
