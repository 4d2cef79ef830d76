"""One episode: a scene is explored and every view is scored."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import cache, lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from caryatid.config import Config, FusionMethod, NoiseModel, Preset, SegmentationMethod
from caryatid.config.settings import preset, read_settings
from caryatid.errors import InputError, in_one_line
from caryatid.evaluation.oracle import planner_for
from caryatid.evaluation.scores import Score, TrueScene, score
from caryatid.evaluation.truths import true_scene_from_simulation
from caryatid.exploration import explore
from caryatid.graph import SupportGraph, TakeStep
from caryatid.manipulation.clearing import SimulatedHands, bodies_of
from caryatid.manipulation.order import plan_order
from caryatid.planning.planners import find_offered
from caryatid.simulation.scenes import SCENE_FILE, TRUTH_FILE, is_builtin, list_scenes, load_scene
from caryatid.simulation.setup import make_simulation
from caryatid.simulation.world import SimulatedScene, poses_of

OrderName = Literal["", "one hand", "two hands", "highest first", "random", "true graph"]
"""Orders of removal; the empty name removes nothing."""
ORDERS: tuple[OrderName, ...] = tuple(name for name in get_args(OrderName) if name)
REMOVAL_VIEWS = (1, 3, 5, 10)
"""Views after which a scene is taken apart, by the scene model at that time."""

Row = dict[str, Any]
"""What was measured after one view: `view` (from 1), `MEASURES`, `counts`, and `forecasts` of its `Score`."""
SCORES = (
    "precision", "recall", "f1", "vertex_precision", "vertex_recall", "vertex_f1", "edge_precision",
    "edge_recall", "edge_f1", "mean_iou", "brier", "average_precision",
)  # fmt: skip
"""Eq. 4 and 5 for vertices and edges together and alone, mean IoU of the matched objects, and scores of
probabilities [1]."""
TIMES = ("planning_seconds", "perception_seconds")
"""Time to choose this view, and from the view to the fused graph [s]; they differ from run to run."""
MEASURES = (*SCORES, "angle", "path", *TIMES, "unharmed", "lifts")
"""Scores; angle on the view sphere [rad] and path length [m]; times; and, for scenes taken apart, whether
nothing was disturbed (1 or 0) and the share of lifts that disturbed nothing [1]."""


@dataclass(frozen=True, slots=True)
class Episode:
    """One run of the loop: everything that, with the code, determines its figures.

    Attributes:
        scene: Name of a built-in scene, or a scene folder; `content` is the digest of its files.
        planner: Planner of the views; `plugin` is the digest of the package that offers it, if it has one.
        settings: Changes, `stage.name=value`, of the settings of the `preset`.
        views: Number of views, including the first.
        seed: Seed of the noise and of every choice.
        order: Order of removal; empty if nothing is removed.
    """

    scene: str
    content: str = ""
    fusion: FusionMethod = "pc+sg"
    planner: str = "support"
    plugin: str = ""
    segmentation: SegmentationMethod = "labels"
    noise: NoiseModel = "carmine"
    preset: Preset = "default"
    settings: tuple[str, ...] = ()
    views: int = 5
    seed: int = 0
    order: OrderName = ""

    def key(self, fingerprint: str) -> str:
        """Digest of the episode and of the code that runs it; a scene's folder counts by its content."""
        known = asdict(self) | ({"scene": ""} if self.content else {})
        return hashlib.sha256(json.dumps([fingerprint, known], sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of an episode: one row per view, or none and the error in one line."""

    rows: tuple[Row, ...]
    error: str | None = None


def run_episode(episode: Episode) -> Outcome:
    """Run an episode; any error is part of the outcome.

    An episode that ends early repeats its last row, because the graph no longer changes.
    """
    try:
        return Outcome(tuple(_rows(episode)))
    except Exception as error:
        return Outcome((), in_one_line(error))


def settings_of(episode: Episode) -> Config:
    """The configuration of an episode.

    Raises:
        InputError: A setting does not exist or its value is not valid.
    """
    own = f"fusion.method={episode.fusion}", f"active.max_views={episode.views}"
    return read_settings(None, (*own, *episode.settings), preset(episode.preset))


def find_scenes(sources: Iterable[str]) -> list[str]:
    """Resolve built-in names, scene folders and folders of scene folders, each scene once.

    Raises:
        InputError: A source is none of these, or a folder holds no scene with its ground truth.
    """
    found: list[str] = []
    for source in sources:
        folder = Path(source)
        if is_builtin(source):
            found.append(source)
            continue
        if not folder.is_dir():
            remedy = f"give a folder of scenes, or one of {', '.join(list_scenes())}"
            raise InputError(source, "is neither a built-in scene nor a folder", remedy)
        scenes = sorted(file.parent for file in (*folder.glob(SCENE_FILE), *folder.glob(f"*/{SCENE_FILE}")))
        if not scenes:
            raise InputError(source, f"has no {SCENE_FILE}", "give a scene folder, or a folder of them")
        if missing := [scene for scene in scenes if not (scene / TRUTH_FILE).is_file()]:
            raise InputError(missing[0], f"has no {TRUTH_FILE}", "write the ground truth")
        found += map(str, scenes)
    return list(dict.fromkeys(found))


def content_of(scene: str) -> str:
    """Digest of a scene folder's files; empty for a built-in scene, which its name determines."""
    return "" if is_builtin(scene) else _digest(sorted(p for p in Path(scene).rglob("*") if p.is_file()))


@cache
def plugin_of(planner: str) -> str:
    """Digest of the package that offers a planner; empty for built-in planners."""
    point = find_offered(planner)
    if point is None:
        return ""
    spec = find_spec(point.module.split(".")[0])
    folders = spec.submodule_search_locations if spec else None
    files = [f for folder in folders or () for f in sorted(Path(folder).rglob("*.py"))]
    if spec and spec.origin and not folders:
        files = [Path(spec.origin)]
    return hashlib.sha256((point.value + _digest(files)).encode()).hexdigest()[:16]


def short_name(scene: str) -> str:
    """Name of a scene: that of its folder, or the built-in one."""
    return scene if is_builtin(scene) else Path(scene).resolve().name


def family(scene: str) -> str:
    """Kind of a scene: the letters before the first number of its name, `designed` where there is none."""
    matched = re.match(r"[A-Za-z_]+(?=[-_]?\d)", short_name(scene))
    return matched[0].rstrip("_-") if matched else "designed"


@lru_cache(maxsize=8)
def open_scene(scene: str, content: str = "") -> tuple[SimulatedScene, TrueScene]:
    """Load a scene and its ground truth; cached, because the episodes of a scene follow each other.

    Raises:
        InputError: It cannot be loaded, or its files have another digest than `content`.
    """
    if content and Path(scene).is_dir() and content_of(scene) != content:
        raise InputError(scene, "its files have changed since the run was planned", "start again")
    simulated = load_scene(scene)
    return simulated, true_scene_from_simulation(simulated)


def _take_apart(
    scene: SimulatedScene, graph: SupportGraph, truth: TrueScene, order: OrderName, config: Config, seed: int
) -> dict[str, float]:
    """Whether taking a scene apart disturbs nothing; unextracted objects go last, highest first."""
    bodies = bodies_of(graph, truth)
    objects = graph.movable
    if objects and order in ("one hand", "two hands"):
        steps = list(plan_order(graph, config, hands=1 if order == "one hand" else 2, seed=seed).steps)
    else:
        ids = [o.id for o in sorted(objects, key=lambda o: (-o.centre_world[2], o.label))]
        if order == "random":
            ids = [objects[k].id for k in np.random.default_rng(seed).permutation(len(objects))]
        elif order == "true graph":
            true = {(i, k) for i in ids for k in ids if (bodies.get(i), bodies.get(k)) in truth.edges}
            ids = order_by_supports(ids, true)
        steps = [TakeStep(i, (), False, 1.0, "not rehearsed") for i in ids]
    steps = [step for step in steps if step.object_id in bodies]
    height = dict(zip(scene.object_bodies.values(), poses_of(scene)[:, 2], strict=True))
    missed = sorted(set(height) - {bodies[s.object_id] for s in steps}, key=lambda b: -height[b])
    steps += [TakeStep(body, (), False, 1.0, "not extracted") for body in missed]
    hands, known = SimulatedHands(scene, config), bodies | {b: b for b in missed}
    ok = [hands.take(step, known).ok for step in steps]
    return {"unharmed": float(all(ok)), "lifts": float(np.mean(ok))}


def order_by_supports(ids: Sequence[str], supports: Iterable[tuple[str, str]]) -> list[str]:
    """Reorder ids so that those that support nothing that is left go first, and otherwise as they are."""
    left, done, supports = list(ids), list[str](), list(supports)
    while left:
        holding = {supporter for supporter, supported in supports if supported in left}
        done.append(left.pop(next((n for n, i in enumerate(left) if i not in holding), 0)))
    return done


def figures_of(found: Score, graph: SupportGraph, true: int) -> Row:
    """Scores of a graph, and the numbers of true, extracted and matched objects."""
    scores = {name: getattr(found, name) for name in SCORES}
    return scores | {"objects": true, "returned": len(graph.objects) - 1, "matched": len(found.ious)}


def _rows(episode: Episode) -> list[Row]:
    config = settings_of(episode)
    scene, truth = open_scene(episode.scene, episode.content)
    simulation = make_simulation(scene, config, noise=episode.noise, seed=episode.seed)
    known: dict[str, Any] = {"segmentation": episode.segmentation, "seed": episode.seed}
    planner, camera = planner_for(episode.planner, simulation.camera, truth, config, **known)
    rows: list[Row] = []
    planning, removal = 0.0, {"unharmed": 0.0, "lifts": 0.0}
    for step in explore(camera, simulation.robot, planner=planner, config=config, early_stop=False, **known):
        found = score(step.graph, truth)
        view = step.index + 1
        if episode.order and view in REMOVAL_VIEWS:
            removal = _take_apart(scene, step.graph, truth, episode.order, config, episode.seed)
        perceiving = [s for stage, s in step.timings.items() if stage not in ("capture", "plan")]
        travelled = {"angle": step.angle_travelled, "path": step.path_travelled}
        times = dict(zip(TIMES, (planning, sum(perceiving)), strict=True))
        figures = figures_of(found, step.graph, len(truth.objects))
        forecasts = {"forecasts": [list(forecast) for forecast in found.forecasts]}
        if rows and rows[-1]["view"] == view:  # The robot could go to no further view.
            break
        rows.append({"view": view} | figures | travelled | times | removal | forecasts)
        planning = step.timings.get("plan", 0.0)
    missing = range(int(rows[-1]["view"]) + 1, episode.views + 1)
    return rows + [rows[-1] | dict.fromkeys(TIMES, 0.0) | {"view": view} for view in missing]


def _digest(files: Iterable[Path]) -> str:
    digest = hashlib.sha256()
    for file in files:
        digest.update(file.name.encode() + b"\0" + hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()
