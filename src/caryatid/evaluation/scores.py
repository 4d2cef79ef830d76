"""Scores of a support graph and of its probabilities: method notes 5, eqs. 4 and 5 of the paper."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from caryatid.config import EvaluationConfig
from caryatid.errors import InputError
from caryatid.geometry.shapes import Box, Shape
from caryatid.geometry.solids import in_hull
from caryatid.geometry.transforms import Array
from caryatid.graph import SupportGraph
from caryatid.sensing.views import SUPPORT_LABEL

TABLE: Final = "table"
"""Name of the support surface among the true vertices."""


@dataclass(frozen=True, eq=False, slots=True)
class TrueObject:
    """A solid with a test for its inside.

    Attributes:
        name: Body name, or `object<obj_id>`.
        contains: Which of the points (N, 3) [m], world frame, lie inside: (N,) bool.
        aabb_world: Lowest and highest corner (2, 3) [m] of a world-aligned box around it.
    """

    name: str
    contains: Callable[[Array], NDArray[np.bool_]]
    aabb_world: Array


@dataclass(frozen=True, eq=False, slots=True)
class TrueScene:
    """A support graph over solids: the ground truth, or a graph to compare with it.

    Attributes:
        vertices: Names, the table's too.
        edges: Directed pairs (supporter, supported) of names.
        objects: The solids of the vertices that are objects; a vertex without one is never found.
        table: Name of the vertex that is the support surface, or None.
        table_top: Height of its top [m], or None without a table.
    """

    vertices: tuple[str, ...]
    edges: frozenset[tuple[str, str]]
    objects: tuple[TrueObject, ...]
    table: str | None = None
    table_top: float | None = None


class Forecast(NamedTuple):
    """The probability of a support in a graph, and whether it is true.

    Attributes:
        probability: Probability of the support; 0 if the graph lacks it [1].
        by_certain: The same by `certain` alone: 1, and 0.5 if uncertain [1].
        true: It is in the truth.
    """

    probability: float
    by_certain: float
    true: bool


@dataclass(frozen=True, slots=True)
class Score:
    """Scores of a graph against the ground truth.

    A ratio with denominator 0 is 1 if there was nothing to find either, and 0 otherwise.

    Attributes:
        precision: Eq. 4, vertices and edges together [1].
        recall: Eq. 5, vertices and edges together [1].
        f1: Their harmonic mean [1].
        edge_precision: Edges alone [1].
        edge_recall: Edges alone [1].
        vertex_precision: Vertices alone, the table included [1].
        vertex_recall: Vertices alone [1].
        mean_iou: Mean IoU of the matched objects without the table; 0 if none is matched [1].
        brier: Brier score of the forecasts: their mean squared error; 0 is perfect [1].
        average_precision: Area under precision over recall of the forecasts as the probability threshold
            falls from 1; 1 is perfect [1].
        matches: Extracted vertex → its true vertex.
        ious: IoU of each matched object [1].
        forecasts: Those of each support in the graph with both ends matched, and, with probability 0, of
            each true one between matched vertices that the graph lacks. Supports of unmatched vertices say
            nothing about probabilities; they count in precision and recall.
        wrong: Extracted supports that are not in the truth.
        missing: True supports that were not extracted; matched ends have their extracted names.
        unfound: True vertices that are not matched.
    """

    precision: float
    recall: float
    f1: float
    edge_precision: float
    edge_recall: float
    vertex_precision: float
    vertex_recall: float
    mean_iou: float
    brier: float
    average_precision: float
    matches: Mapping[str, str] = field(default_factory=dict)
    ious: Mapping[str, float] = field(default_factory=dict)
    forecasts: tuple[Forecast, ...] = ()
    wrong: tuple[tuple[str, str], ...] = ()
    missing: tuple[tuple[str, str], ...] = ()
    unfound: tuple[str, ...] = ()

    @property
    def vertex_f1(self) -> float:
        """F1 of vertices alone [1]."""
        return _harmonic_mean(self.vertex_precision, self.vertex_recall)

    @property
    def edge_f1(self) -> float:
        """F1 of edges alone [1]."""
        return _harmonic_mean(self.edge_precision, self.edge_recall)

    def to_json(self) -> dict[str, float]:
        """Entry of a view in `caryatid evaluate --json`."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.type == "float"}


def score(
    found: SupportGraph | TrueScene,
    truth: TrueScene,
    rng: np.random.Generator | None = None,
    config: EvaluationConfig | None = None,
) -> Score:
    """Score a graph of fitted shapes, or a scene of solids, against true solids; the truth itself scores 1.

    Every edge of the graph counts, also uncertain ones: a wrong guess costs precision. An edge is
    true when both its ends are matched and the directed pair is in the truth, whatever its kind.

    Args:
        found: The extracted graph, in the world frame of the truth.
        truth: The true scene.
        rng: Draws the points that measure volumes; None draws the same ones every time.
        config: Minimum IoU, tolerance of the table's height, points per pair.
    """
    config = config or EvaluationConfig()
    edges = _said(found)
    found = as_scene(found) if isinstance(found, SupportGraph) else found
    iou = _volume_ious(found.objects, truth.objects, config.samples, rng or np.random.default_rng(0))
    names, true_names = [o.name for o in found.objects], [o.name for o in truth.objects]
    matches, ious = _matched(iou, names, true_names, config.min_iou)
    tops = [t.table_top for t in (found, truth) if t.table_top is not None]
    same = len(tops) == 2 and abs(tops[0] - tops[1]) <= config.table_tolerance
    if same and found.table is not None and truth.table is not None:
        matches[found.table] = truth.table
    return _score_matches(found.vertices, edges, truth.vertices, truth.edges, matches, ious)


def score_masks(
    graph: SupportGraph,
    labels: Sequence[NDArray[np.int32]],
    true_labels: Sequence[NDArray[np.int32]],
    vertices: Sequence[str],
    edges: frozenset[tuple[str, str]],
    config: EvaluationConfig | None = None,
) -> Score:
    """Score a graph by pixels, for real frames, where there are no true shapes.

    An object is true if a one-to-one assignment pairs its pixels with a true mask at the minimum IoU; the
    table if graph and truth both have one. Over several frames the pixels of all are pooled.

    Args:
        graph: The extracted graph.
        labels: Label images (H, W), k = the object with label k, one for each frame.
        true_labels: The true ones (H, W), k = the vertex `object<k>`.
        vertices: True vertices, including the table's name if there is one.
        edges: True directed pairs of names.
        config: Minimum IoU.

    Raises:
        InputError: Images differ in number or size.
    """
    config = config or EvaluationConfig()
    objects = [o for o in graph.objects if o.role == "object"]
    names = [name for name in vertices if name != TABLE]
    numbers = [_object_number(name) for name in names]
    iou = mask_ious(labels, true_labels, [o.label for o in objects], numbers)
    matches, ious = _matched(iou, [o.id for o in objects], names, config.min_iou)
    surface = graph.support_surface
    if surface is not None and TABLE in vertices:
        matches[surface.id] = TABLE
    found = [o.id for o in graph.objects]
    return _score_matches(found, _said(graph), vertices, edges, matches, ious)


def _said(found: SupportGraph | TrueScene) -> dict[tuple[str, str], tuple[float, float]]:
    """Probability of each edge, and that by `certain` alone; all are certain in a scene of solids."""
    if isinstance(found, TrueScene):
        return dict.fromkeys(found.edges, (1.0, 1.0))
    return {s.pair: (s.belief, 1.0 if s.certain else 0.5) for s in found.supports}


def _matched(
    iou: Array, found: Sequence[str], true: Sequence[str], min_iou: float
) -> tuple[dict[str, str], dict[str, float]]:
    """One-to-one match of found (F) to true names (T) by IoUs (F, T); and the IoU of each."""
    pairs = assign(iou, min_iou)
    return {found[i]: true[j] for i, j in pairs}, {found[i]: float(iou[i, j]) for i, j in pairs}


def _score_matches(
    found_vertices: Sequence[str],
    found_edges: Mapping[tuple[str, str], tuple[float, float]],
    vertices: Sequence[str],
    edges: Set[tuple[str, str]],
    matches: dict[str, str],
    ious: dict[str, float],
) -> Score:
    """All scores, given the one-to-one match of extracted and true vertices."""
    named = {(matches.get(a, ""), matches.get(b, "")): said for (a, b), said in found_edges.items()}
    judged = {pair: Forecast(*said, pair in edges) for pair, said in named.items() if all(pair)}
    v, e = len(matches), sum(forecast.true for forecast in judged.values())
    precision, recall = _ratios(v + e, len(found_vertices) + len(found_edges), len(vertices) + len(edges))
    of_vertices = _ratios(v, len(found_vertices), len(vertices))
    of_edges = _ratios(e, len(found_edges), len(edges))
    mean_iou = float(np.mean(list(ious.values()))) if ious else 0.0
    f1 = _harmonic_mean(precision, recall)
    there = set(matches.values())
    missed = [pair for pair in edges if there.issuperset(pair) and pair not in judged]
    forecasts = (*judged.values(), *[Forecast(0.0, 0.0, True)] * len(missed))
    brier = float(np.mean([(f.probability - f.true) ** 2 for f in forecasts])) if forecasts else 0.0
    of_forecasts = brier, average_precision(forecasts)
    shares = precision, recall, f1, *of_edges, *of_vertices, mean_iou, *of_forecasts
    known_as = {true: name for name, true in matches.items()}
    wrong = [(a, b) for a, b in found_edges if (matches.get(a, ""), matches.get(b, "")) not in edges]
    missing = [(known_as.get(a, a), known_as.get(b, b)) for a, b in sorted(edges - named.keys())]
    unfound = tuple(name for name in vertices if name not in there)
    return Score(*shares, matches, ious, forecasts, tuple(wrong), tuple(missing), unfound)


def average_precision(forecasts: Sequence[Forecast]) -> float:
    """Sum of precision times gain in recall, as the probability threshold falls from 1 to above 0.

    Equal probabilities are one step. A support with probability 0 is never found.

    Args:
        forecasts: The forecasts of supports.

    Returns:
        In [0, 1]; 1 if there is nothing to find and nothing found, 0 if only false ones are found.
    """
    said, _, true = np.array(forecasts, dtype=np.float64).reshape(-1, 3).T
    order = np.argsort(-said, kind="stable")[: np.count_nonzero(said)]
    steps = np.flatnonzero(np.diff(said[order], append=-1.0))
    hits = np.cumsum(true[order])[steps]
    if not true.any():
        return float(len(steps) == 0)
    return float(np.diff(hits, prepend=0.0) @ (hits / (steps + 1)) / true.sum())


def _volume_ious(
    found: Sequence[TrueObject], true: Sequence[TrueObject], samples: int, rng: np.random.Generator
) -> Array:
    """Intersection over union (F, T) of solids by Monte Carlo; 10,000 points per pair: σ = 0.01 at worst."""
    iou = np.zeros((len(found), len(true)))
    for i, a in enumerate(found):
        for j, b in enumerate(true):
            low = np.maximum(a.aabb_world[0], b.aabb_world[0])
            high = np.minimum(a.aabb_world[1], b.aabb_world[1])
            if (low >= high).any():
                continue
            start = np.minimum(a.aabb_world[0], b.aabb_world[0])
            end = np.maximum(a.aabb_world[1], b.aabb_world[1])
            points_world = rng.uniform(start, end, size=(samples, 3))
            in_a, in_b = a.contains(points_world), b.contains(points_world)
            union = int(np.count_nonzero(in_a | in_b))
            iou[i, j] = np.count_nonzero(in_a & in_b) / union if union else 0.0
    return iou


def mask_ious(
    labels: Sequence[NDArray[np.int32]],
    true_labels: Sequence[NDArray[np.int32]],
    found: Sequence[int],
    true: Sequence[int],
) -> Array:
    """Intersection over union (F, T) of masks, the pixels of all frames pooled.

    Args:
        labels: Label images (H, W), or labels of points (N,).
        true_labels: The true ones, (H, W) or (N,) as those.
        found: F label numbers in `labels`.
        true: T label numbers in `true_labels`; numbers that belong to no object match nothing.

    Raises:
        InputError: Images differ in number or size.
    """
    if [a.size for a in labels] != [b.size for b in true_labels]:
        shapes, true_shapes = [a.shape for a in labels], [b.shape for b in true_labels]
        why = f"the run has label images of {shapes}, the truth of {true_shapes}"
        raise InputError("labels", why, "give the truth of the frames the run was made from")
    intersection = np.zeros((len(found) + 1, len(true) + 1))
    for image, true_image in zip(labels, true_labels, strict=True):
        row, column = _order(image, found), _order(true_image, true)
        counts = np.bincount(row * intersection.shape[1] + column, minlength=intersection.size)
        intersection += counts.reshape(intersection.shape)
    union = intersection.sum(axis=1, keepdims=True) + intersection.sum(axis=0) - intersection
    return (intersection / np.maximum(union, 1.0))[1:, 1:]


def assign(iou: Array, min_iou: float) -> list[tuple[int, int]]:
    """Pair rows with columns of IoUs (F, T) for the largest sum (Hungarian); drop pairs below the minimum."""
    rows, columns = linear_sum_assignment(iou, maximize=True)
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if iou[i, j] >= min_iou]


def as_scene(graph: SupportGraph) -> TrueScene:
    """Convert a graph of fitted shapes to a scene of solids, with vertices named by their ids."""
    surface = graph.support_surface
    return TrueScene(
        vertices=tuple(o.id for o in graph.objects),
        edges=frozenset(s.pair for s in graph.supports),
        objects=tuple(_solid(o.id, o.shape) for o in graph.objects if o.role == "object"),
        table=None if surface is None else surface.id,
        table_top=None if surface is None else _top_height(surface.shape),
    )


def _top_height(shape: Shape) -> float:
    """Height [m] of the middle of a shape's top; of a box, of its most level upper face."""
    T_world_object = shape.T_world_object
    if isinstance(shape, Box):
        rise = np.abs(T_world_object[2, :3])
        up = int(np.argmax(rise))
        return float(T_world_object[2, 3] + rise[up] * shape.extents[up] / 2.0)
    return float(T_world_object[2, 3] + shape.support(np.array([[0.0, 0.0, 1.0]]))[0])


def _solid(name: str, shape: Shape) -> TrueObject:
    if len(shape.parts) > 1:
        # Hollow objects count with their inside, here as in the ground truth.
        corners = shape.outline()
        return TrueObject(
            name, partial(in_hull, corners), np.stack([corners.min(axis=0), corners.max(axis=0)])
        )
    reach = shape.support(np.eye(3))
    centre = shape.T_world_object[:3, 3]
    return TrueObject(
        name,
        lambda points_world: shape.signed_distance(points_world) <= 0.0,
        np.stack([centre - reach, centre + reach]),
    )


def _ratios(right: int, claimed: int, true: int) -> tuple[float, float]:
    """Precision and recall from the numbers of right, claimed and true items."""
    nothing = 1.0 if claimed == true == 0 else 0.0
    return right / claimed if claimed else nothing, right / true if true else nothing


def _harmonic_mean(a: float, b: float) -> float:
    return 2.0 * a * b / (a + b) if a + b > 0.0 else 0.0


def _object_number(name: str) -> int:
    """Label of a vertex `object<obj_id>`; 0, which is not an object, for any other name."""
    digits = name.removeprefix("object")
    return int(digits) if name.startswith("object") and digits.isascii() and digits.isdigit() else 0


def _order(image: NDArray[np.int32], labels: Sequence[int]) -> NDArray[np.intp]:
    """Position of each pixel's label in `labels`, from 1; 0 where it is none of them."""
    table = np.zeros(SUPPORT_LABEL + 1, dtype=np.intp)
    for position, label in enumerate(labels, start=1):
        if 0 < label < SUPPORT_LABEL:
            table[label] = position
    return table[image.ravel()]
