"""Compare with simple baselines, on the same views, by the figures that others print.

    python benchmarks/others.py --real FOLDERS… [--suite NAME] [--clear SCENES…] [--out FILE.json]

One table is printed and written, as FILE.json with all runs and as FILE.csv. It has these figures:

* `--real`, where frames have masks: precision, recall and F of overlap and boundary of automatic segments,
  and the share of objects with F above 0.75, as Xie et al. compute them for UOIS-Net (IEEE T-RO 2021, and
  `evaluation.py` there): segments are paired with masks for the largest F, and pixels of boundaries agree up
  to 0.3 % of the image's diagonal, which is 3 px of 640 × 480.
* `--real`, where supports are annotated, and `--suite`, in simulated views: precision and recall of supports,
  and their average precision, the figure of Rabino and Tommasi for D3G (arXiv:2409.02035). A support is right
  if both of its ends are found and the directed pair is true, as in mAP_rel of the Open Images Challenge. All
  supports of a line are ranked together. `on objects` leaves out the support surface, which D3G has not.
* `--clear`: the sum of the ways of all other objects per lift, as SafePicking (Wada et al., ICRA 2022, and
  `planned.py` there) sums translations from step to step, here of a quarter of a second; the share of runs
  that succeed with one hand; and lifts over the fewest with which a goal can be reached.

The baselines are:

* Open3D boxes: the largest plane is the table; DBSCAN clusters above it, or the given masks, are objects with
  axis-aligned boxes. A box rests on a lower one that it overlaps from above and nearly touches, and otherwise
  on the table. Goals are reached by removing what rests on them.
* highest first, of the objects that caryatid finds.
* the planners `random` and `occlusion-aware`, which choose other views after the first.

Orders are planned after the same views, and carried out without looking again; ours ends where no lift is
safe. It is also carried out with its unsafe lifts, and as `caryatid clear` does, which looks after each lift.

Objects are matched by their pixels at an IoU of 0.5, so that the shape of a box does not count. Open3D gets
all views as they are, without registration, no point farther than 2 m, and in simulation the table's height.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations, takewhile
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from clear import Clear, translation
from measures import Row, Spread, print_table, run_main
from numpy.typing import NDArray
from peers import GRAIN, open3d_cloud, open3d_clusters, open3d_table
from real import TRUTH, Annotation, Labels, Real, compare_masks, find_recordings, follow, score_clicks
from rich.console import Console
from scipy.spatial import cKDTree

from caryatid.benchmark.episodes import open_scene, order_by_supports
from caryatid.benchmark.suites import SUITES
from caryatid.config import Config, SegmentationMethod
from caryatid.errors import CaryatidError
from caryatid.evaluation.scores import TABLE, Forecast, Score, average_precision, score_masks
from caryatid.exploration import Explorer
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject, Support, SupportGraph, TakeStep, object_id
from caryatid.io.bop import read_recording
from caryatid.manipulation.clearing import SimulatedHands
from caryatid.manipulation.order import plan_order
from caryatid.sensing.views import MAX_LABEL, SUPPORT_LABEL, View
from caryatid.simulation.setup import make_simulation
from caryatid.simulation.truth import read_truth
from caryatid.simulation.world import SimulatedScene

OURS, BOXES, HIGHEST = "caryatid", "Open3D boxes", "highest first"
BOUNDARY = 0.003
"""Distance at which boundaries agree, as a share of the image's diagonal [1]; UOIS-Net's."""
REACH = 2.0
"""Depth beyond which Open3D gets no points [m]: the room behind the table."""
ABOVE, TOUCH = 0.01, 0.02
"""Height over the table from which points belong to objects, and gap up to which boxes touch [m]."""
SMALLEST = 50
"""Minimum size of a cluster that is an object [voxels of 5 mm]."""
PLANNERS = ("random", "occlusion-aware")
"""Baselines of the choice of views, run with labels only to save time."""
Bounds = Mapping[int, tuple[Array, Array]]
"""Lowest and highest corner (3,) [m] of each object's box, by label; the table is at height 0."""


@dataclass(frozen=True)
class Others(Spread):
    """Compare with simple baselines."""

    real: tuple[Path, ...] = ()
    """BOP folders, or folders of them."""
    suite: str | None = None
    """Suite of `caryatid benchmark` whose scenes are explored."""
    clear: tuple[str, ...] = ()
    """Names of built-in scenes to clear, or scene folders."""
    views: int = 3
    """Number of views in simulation."""
    goals: int = 2
    """Number of objects to reach in each scene that is cleared, drawn from those that support another."""
    seed: int = 0
    """Seed of noise and choices."""

    def run(self, console: Console) -> int:
        """Measure everything that is asked for, and print and write the table."""
        if self.suite is not None and self.suite not in SUITES:
            raise CaryatidError(f"unknown suite '{self.suite}': choose from {', '.join(SUITES)}")
        tasks = list[tuple[str, str, SegmentationMethod]]()
        for folder in find_recordings(self.real):
            tasks.append(("real", str(folder), "auto"))
            if all(frame.has_labels for frame in read_recording(folder).frames):
                tasks.append(("real", str(folder), "labels"))
        scenes = () if self.suite is None else SUITES[self.suite].scenes
        for scene in scenes:
            tasks += [("suite", scene, "labels"), ("suite", scene, "auto")]
        tasks += [("clear", scene, "labels") for scene in self.clear]
        if not tasks:
            raise CaryatidError("nothing to compare; give --real FOLDERS, --suite NAME or --clear SCENES")
        rows = [row for part in self.each(self.measure, tasks) for row in part]
        table = sum_up(rows)
        print_table(table.round(3).astype(object).fillna("–"), console)
        self.write({"table": json.loads(table.to_json(orient="records")), "runs": rows})
        if self.out is not None:
            table.to_csv(self.out.with_suffix(".csv"), index=False)
        return 0

    def measure(self, task: tuple[str, str, SegmentationMethod]) -> list[Row]:
        """Measure one recording or scene; return one row per method, and per goal or number of views."""
        part, name, method = task
        if part == "real":
            return score_recording(Path(name), method, self.seed)
        if part == "suite":
            return self.score_scene(name, method)
        return self.clear_scene(name)

    def explore(self, name: str, method: SegmentationMethod, planner: str = "support") -> list[Any]:
        """Explore a scene; return the steps."""
        scene, _ = open_scene(name)
        config = Config()
        simulation = make_simulation(scene, config, noise="carmine", seed=self.seed)
        known: dict[str, Any] = {"segmentation": method, "seed": self.seed, "config": config}
        explorer = Explorer(simulation.camera, simulation.robot, planner=planner, **known)
        steps = [explorer.look()]
        while len(steps) < self.views and explorer.plan().decision is not None:
            explorer.go()
            steps.append(explorer.look())
        return steps

    def score_scene(self, name: str, method: SegmentationMethod) -> list[Row]:
        """Score the supports of a scene after the first and the last view."""
        scene, truth = open_scene(name)
        names = {body: f"object{label}" for label, body in scene.object_bodies.items()} | {scene.table: TABLE}
        vertices = [names.get(v, v) for v in truth.vertices]
        edges = frozenset((names.get(a, a), names.get(b, b)) for a, b in truth.edges)
        rows, height = list[Row](), truth.surfaces[scene.table].height

        def add(made: str, count: int, graph: SupportGraph, labels: Sequence[Labels]) -> None:
            true = [step.view.labels for step in steps[:count]]
            row: Row = {"data": self.suite, "name": name, "segments": method, "method": made}
            row["views"] = self.views if count > 1 else 1
            rows.append(row | score_pixels(graph, labels, true, vertices, edges))

        steps = self.explore(name, method)
        for count in sorted({1, len(steps)}):
            add(OURS, count, steps[count - 1].graph, [step.labels for step in steps[:count]])
            add(BOXES, count, *box_graph([step.view for step in steps[:count]], method, height))
        for planner in PLANNERS if method == "labels" else ():
            steps = self.explore(name, method, planner)
            made = f"{OURS}, {planner} views"
            add(made, len(steps), steps[-1].graph, [step.labels for step in steps])
        return rows

    def clear_scene(self, name: str) -> list[Row]:
        """Take a scene apart, and reach goals in it, in the order of each method after the same views."""
        scene, truth = open_scene(name)
        config, bodies, height = Config(), scene.object_bodies, truth.surfaces[scene.table].height
        steps = self.explore(name, "labels")
        graph, (boxes, _) = steps[-1].graph, box_graph([step.view for step in steps], "labels", height)
        holding = [label for label, body in bodies.items() if any(body == a for a, _ in truth.edges)]
        rng, rows = np.random.default_rng(self.seed), list[Row]()
        drawn = rng.choice(holding, min(self.goals, len(holding)), replace=False).tolist()
        again = Clear(seed=self.seed)
        for label in (None, *drawn):
            goal = None if label is None else object_id(label)
            looked = again.cleared(name, scene, label)
            known: Row = {"data": "all" if label is None else "goals", "name": name, "segments": "labels"}
            known |= {"goal": goal, "fewest": looked.get("fewest", 0)}
            found = {k: looked[k] for k in ("lifts", "harmed", "way")} | {"reached": bool(looked["cleared"])}
            rows.append(known | {"views": "as needed", "method": f"{OURS}, looking again"} | found)
            order = (
                plan_order(graph, config, goal=goal, seed=self.seed).steps if goal in (None, *graph) else ()
            )
            for made, seen, ids in (
                (OURS, graph, [step.object_id for step in takewhile(lambda step: step.safe, order)]),
                (f"{OURS}, unsafe lifts too", graph, [step.object_id for step in order]),
                (HIGHEST, graph, order_by_height(graph, goal)),
                (BOXES, boxes, order_by_boxes(boxes, goal)),
            ):
                found = carry_out(scene, ids, seen, config, None if label is None else bodies[label])
                rows.append(known | {"views": self.views, "method": made} | found)
        return rows


def carry_out(
    scene: SimulatedScene, ids: Sequence[str], graph: SupportGraph, config: Config, goal: str | None
) -> Row:
    """Lift objects of a graph one after the other; count lifts and harm, and say whether the goal is gone.

    Without a goal, it is whether all are.
    """
    hands, way, harmed, lifts = SimulatedHands(scene, config), 0.0, 0, 0
    bodies = hands.bodies(graph)
    for id in ids:
        before = hands.state
        taken = hands.take(TakeStep(id, (), False, 1.0, ""), bodies)
        if taken.body is not None:
            way += translation([before, *taken.film], hands.names.index(taken.body))
            harmed, lifts = harmed + (not taken.ok), lifts + 1
    reached = not hands.left if goal is None else goal not in hands.left
    return {"lifts": lifts, "harmed": harmed, "way": way, "reached": reached}


def score_recording(folder: Path, method: SegmentationMethod, seed: int) -> list[Row]:
    """Score ours and Open3D's segments and supports of a recording by all truths that it has.

    Variants with masks have their masks compared with automatic segments, but are not clicked frames twice.
    """
    outcome, rows = follow(folder, method, seed, Config()), []
    truths = [view.labels for view in outcome.views if view.labels is not None]
    masked = len(truths) == len(outcome.views)
    for made, (graph, labels) in (
        (OURS, (outcome.graph, outcome.labels)),
        (BOXES, box_graph(outcome.views, method)),
    ):
        row: Row = {"data": folder.parent.name, "name": folder.name, "segments": method, "method": made}
        row["views"] = len(outcome.views)
        if masked and method == "auto":
            row["masks"] = [
                compare_masks(np.where(found > MAX_LABEL, 0, found), true, tolerance_of(true))
                for found, true in zip(labels, truths, strict=True)
            ]
        annotation = Real().annotation(folder)
        if masked and (folder / TRUTH).exists():
            truth = read_truth(folder / TRUTH)
            row |= score_pixels(graph, labels, truths, truth.vertices, frozenset(truth.pairs))
        elif annotation is not None and (method == "labels" or not folder.name.endswith("-masks")):
            row |= score_clicked(graph, labels[0], annotation)
        rows.append(row)
    return rows


def score_pixels(
    graph: SupportGraph,
    labels: Sequence[Labels],
    true: Sequence[Labels],
    vertices: Sequence[str],
    edges: frozenset[tuple[str, str]],
) -> Row:
    """Return the forecasts of all supports, and of those on objects, with objects matched by pixels."""
    found = score_masks(graph, labels, true, vertices, edges)
    above, known = without_surfaces(graph), [v for v in vertices if v != TABLE]
    upper = frozenset(pair for pair in edges if TABLE not in pair)
    on_objects = score_masks(above, labels, true, known, upper)
    return {"all": forecasts(graph, found, edges), "on objects": forecasts(above, on_objects, upper)}


def score_clicked(graph: SupportGraph, labels: Labels, annotation: Annotation) -> Row:
    """Return the forecasts of annotated supports; those of objects without a click are not judged."""
    upper = Annotation(
        annotation.objects,
        *([e for e in kind if e[0] != "T"] for kind in (annotation.edges, annotation.maybe)),
    )
    found = {}
    for name, seen, asked in (
        ("all", graph, annotation),
        ("on objects", without_surfaces(graph), upper),
    ):
        judged = score_clicks(seen, labels, asked)["forecasts"]
        lacking = len({*asked.edges}) - sum(f.true for f in judged)
        found[name] = judged + [Forecast(0.0, True)] * lacking
    return found


def forecasts(graph: SupportGraph, found: Score, edges: frozenset[tuple[str, str]]) -> list[Forecast]:
    """Return one for every support of a graph, and one with probability 0 for every true one that it lacks.

    Those of `Score` leave out the supports of unmatched objects. Here they are wrong, or lacking.
    """
    strange = [s.belief for s in graph.supports if not {*s.pair} <= found.matches.keys()]
    lacking = len(edges) - sum(f.true for f in found.forecasts)
    return [*found.forecasts, *(Forecast(p, False) for p in strange), *[Forecast(0.0, True)] * lacking]


def rate(judged: Sequence[Forecast]) -> dict[str, float]:
    """Precision and recall of supports [%], their average precision [1], and the number of true ones."""
    claimed = [f.true for f in judged if f.probability > 0.0]
    true = sum(f.true for f in judged)
    precision, recall = (100.0 * sum(claimed) / max(n, 1) for n in (len(claimed), true))
    return {"P": precision, "R": recall, "AP": average_precision(judged), "true": true}


def tolerance_of(image: Labels) -> float:
    """Distance [px] at which the boundaries of masks in an image (H, W) agree for UOIS-Net."""
    return float(np.ceil(BOUNDARY * np.linalg.norm(image.shape)))


def without_surfaces(graph: SupportGraph) -> SupportGraph:
    """Return the objects of a graph, and the supports between them."""
    objects = graph.movable
    ids = {o.id for o in objects}
    return SupportGraph(objects, tuple(s for s in graph.supports if {*s.pair} <= ids))


def box_graph(
    views: Sequence[View], method: SegmentationMethod, height: float | None = None
) -> tuple[SupportGraph, list[Labels]]:
    """Make a graph of Open3D's boxes of masks or clusters, and the label image (H, W) of each view.

    Both are empty if there are no points within reach.

    Args:
        views: The views; the table is level if its height is given.
        method: Where objects come from.
        height: Height of the table [m]; None = that of the largest plane.
    """
    images = [np.zeros(view.depth.shape, dtype=np.int32) for view in views]
    seen = [view.valid & (view.depth < REACH) for view in views]
    poses = [np.eye(4) if view.T_world_camera is None else view.T_world_camera for view in views]
    points = [  # in the frame of the first camera
        transforms.transform(transforms.invert(poses[0]) @ T, view.points_camera[shown])
        for T, view, shown in zip(poses, views, seen, strict=True)
    ]
    every, given = np.concatenate(points), list[NDArray[np.int32]]()
    if method == "labels":
        masks = [
            image if view.labels is None else view.labels for image, view in zip(images, views, strict=True)
        ]
        given = [np.where(mask > MAX_LABEL, 0, mask)[shown] for mask, shown in zip(masks, seen, strict=True)]
    ground = every[np.concatenate(given) <= 0] if given else every
    if len(ground) < SMALLEST:
        return SupportGraph(), images
    rest = open3d_cloud(ground)
    if height is None:
        plane, rest = open3d_table(rest)
        plane = plane / np.linalg.norm(plane[:3]) * (1.0 if plane[3] > 0.0 else -1.0)  # the camera is above
    else:
        plane = np.append(poses[0][2, :3], poses[0][2, 3] - height)
    T = transforms.level_world(plane[:3], -plane[3] * plane[:3])
    if not given:
        rest = rest.select_by_index(np.flatnonzero(np.asarray(rest.points) @ plane[:3] + plane[3] > ABOVE))
        given = assign_clusters(rest, points)
    bounds: dict[int, tuple[Array, Array]] = {}
    for image, shown, labels in zip(images, seen, given, strict=True):
        image[shown] = np.maximum(labels, 0)
    numbers = np.concatenate(given)
    for label in np.unique(numbers[numbers > 0]).tolist():
        cloud = open3d_cloud(transforms.transform(T, every[numbers == label]))
        box = cloud.remove_statistical_outlier(20, 2.0)[0].get_axis_aligned_bounding_box()
        low, high = np.asarray(box.min_bound), np.asarray(box.max_bound)
        if (high > low).all():
            bounds[label] = low, high
    return graph_of_boxes(bounds, poses[0] @ transforms.invert(T)), images


def assign_clusters(cloud: Any, points: Sequence[Array]) -> list[NDArray[np.int32]]:
    """Return the number, from 1, of each point's cluster (N,) in each view; 0 for none and for small ones."""
    if not len(cloud.points):
        return [np.zeros(len(own), dtype=np.int32) for own in points]
    cluster = open3d_clusters(cloud) + 1
    sizes = np.bincount(cluster)
    kept = (sizes >= SMALLEST) & (np.arange(len(sizes)) > 0)
    cluster = (np.cumsum(kept) * kept)[cluster].astype(np.int32)
    tree = cKDTree(np.asarray(cloud.points))
    found = []
    for own in points:
        _, nearest = tree.query(own, distance_upper_bound=2.0 * GRAIN)
        found.append(np.append(cluster, np.int32(0))[nearest])
    return found


def graph_of_boxes(bounds: Bounds, T_world_table: Array) -> SupportGraph:
    """Make the graph of boxes, and of what rests on what by `rests_on`."""

    def solid(low: Array, high: Array) -> Box:
        return Box(T_world_table @ transforms.rigid(np.eye(3), (low + high) / 2.0), high - low)

    table = solid(np.array([-1.0, -1.0, -0.02]), np.array([1.0, 1.0, 0.0]))
    objects = [SceneObject(object_id(SUPPORT_LABEL), SUPPORT_LABEL, table, "support_surface")]
    objects += [SceneObject(object_id(label), label, solid(*ends)) for label, ends in bounds.items()]
    supports = [Support(object_id(a), object_id(b), probability=p) for (a, b), p in rests_on(bounds).items()]
    return SupportGraph(tuple(objects), tuple(supports))


def rests_on(bounds: Bounds) -> dict[tuple[int, int], float]:
    """Find what rests on what: (supporter, supported) → share of the smaller footprint that overlaps [1].

    The higher box rests on the lower one if they overlap from above and nearly touch. A box near the table,
    or on no other, rests on the table, whose label is `SUPPORT_LABEL`.
    """
    found: dict[tuple[int, int], float] = {}
    for a, b in permutations(bounds, 2):
        (low_a, high_a), (low_b, high_b) = bounds[a], bounds[b]
        shared = (np.minimum(high_a, high_b) - np.maximum(low_a, low_b))[:2].clip(min=0.0).prod()
        higher = low_b[2] + high_b[2] > low_a[2] + high_a[2]
        if shared and higher and abs(low_b[2] - high_a[2]) <= TOUCH:
            found[a, b] = float(shared / min((high_a - low_a)[:2].prod(), (high_b - low_b)[:2].prod()))
    held = {b for _, b in found}
    for b, (low, _) in bounds.items():
        if low[2] <= TOUCH or b not in held:
            found[SUPPORT_LABEL, b] = 1.0 if low[2] <= TOUCH else 0.5
    return found


def order_by_height(graph: SupportGraph, goal: str | None = None) -> list[str]:
    """Return the objects of a graph, the highest centre first, up to a goal; all if the goal is not found."""
    objects = graph.movable
    ids = [o.id for o in sorted(objects, key=lambda o: -o.centre_world[2])]
    return ids[: ids.index(goal) + 1] if goal in ids else ids


def order_by_boxes(graph: SupportGraph, goal: str | None = None) -> list[str]:
    """Return the objects of a graph, or a goal and all that rests on it, so that none leaves before its load.

    Among those without a load, the highest goes first.
    """
    ids, pairs, above = order_by_height(graph), [s.pair for s in graph.supports], {goal}
    while more := {b for a, b in pairs if a in above} - above:
        above |= more
    return order_by_supports([i for i in ids if goal not in ids or i in above], pairs)


def sum_up(rows: Sequence[Row]) -> pd.DataFrame:
    """Return the table: one line for each kind of data, segments, number of views and method."""
    keys = ["data", "segments", "views", "method"]
    lines = []
    for key, part in pd.DataFrame(rows).groupby(keys, sort=False):
        line: Row = dict(zip(keys, key, strict=True))
        for column in ("masks", "all", "on objects"):
            if column not in part or not (lists := part[column].dropna().tolist()):
                continue
            items = [item for items in lists for item in items]
            if column == "masks":
                line |= {"frames": len(items)} | pd.DataFrame(items).mean().to_dict()
            else:
                line |= {"graphs": len(lists)} | {f"{column}: {k}": v for k, v in rate(items).items()}
        if "way" in part and part["way"].notna().all():
            good = part["reached"].astype(bool) & (part["harmed"] == 0)
            known = part[part["reached"].astype(bool) & (part["fewest"] > 0)]
            line |= {"runs": len(part), "lifts": int(part["lifts"].sum()), "success": float(good.mean())}
            line |= {"unharmed": float((part["harmed"] == 0).mean())}
            line |= {"moved per lift, cm": 100.0 * part["way"].sum() / max(part["lifts"].sum(), 1)}
            line |= {"harmful lifts": int(part["harmed"].sum()), "reached": float(part["reached"].mean())}
            if len(known):
                line["lifts / fewest"] = float(known["lifts"].sum() / known["fewest"].sum())
        if len(line) > len(keys):  # some recordings have no truth
            lines.append(line)
    return pd.DataFrame(lines)


if __name__ == "__main__":
    run_main(Others)
