"""Scores of a support graph and of its probabilities: section V of the paper, eqs. 4 and 5."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field, fields
from typing import Final, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from caryatid.config import EvaluationConfig
from caryatid.errors import InputError
from caryatid.geometry.shapes import Box, Shape
from caryatid.geometry.solids import Solid, in_hull
from caryatid.geometry.transforms import Array
from caryatid.graph import SupportGraph
from caryatid.sensing.views import SUPPORT_LABEL

TABLE: Final = "table"
"""Name of the support surface among the true vertices of real frames."""


class TrueSurface(NamedTuple):
    """The top of a support surface.

    Attributes:
        height: Its height [m].
        x: Of its middle [m].
        y: Of its middle [m].
        half_x: Half its size along x [m].
        half_y: Half its size along y [m].
    """

    height: float
    x: float
    y: float
    half_x: float
    half_y: float


@dataclass(frozen=True, eq=False, slots=True)
class TrueScene:
    """The ground truth: a support graph over shapes.

    Attributes:
        vertices: Names, those of the support surfaces too.
        edges: Directed pairs (supporter, supported) of names.
        objects: Shape of each vertex that is an object; a vertex that is neither this nor a surface is never
            found.
        surfaces: Top of each vertex that is a support surface, the main one first.
    """

    vertices: tuple[str, ...]
    edges: frozenset[tuple[str, str]]
    objects: Mapping[str, Shape]
    surfaces: Mapping[str, TrueSurface] = field(default_factory=dict)


class Forecast(NamedTuple):
    """The probability of a support, and whether the support is true.

    Attributes:
        probability: Probability of the support; 0 if the graph lacks it [1].
        true: Whether the support is in the ground truth.
    """

    probability: float
    true: bool


@dataclass(frozen=True, slots=True)
class Score:
    """Scores of a graph against the ground truth.

    A ratio with denominator 0 is 1 if there is nothing to find either, and 0 otherwise.

    Attributes:
        precision: Eq. 4, vertices and edges together [1].
        recall: Eq. 5, vertices and edges together [1].
        f1: Their harmonic mean [1].
        edge_precision: Edges alone [1].
        edge_recall: Edges alone [1].
        vertex_precision: Vertices alone, support surfaces included [1].
        vertex_recall: Vertices alone [1].
        mean_iou: Mean IoU of the matched objects without surfaces; 0 if none is matched [1].
        brier: Brier score of the forecasts: their mean squared error; 0 is perfect, or without forecasts [1].
        average_precision: Area under precision over recall of the forecasts as the probability threshold
            falls from 1; 1 is perfect, or without forecasts [1].
        matches: Extracted vertex → its true vertex.
        ious: IoU of each matched object [1].
        forecasts: One for each support in the graph between matched vertices, and one with probability 0 for
            each true support between matched vertices that the graph lacks. Supports of unmatched vertices
            count in precision and recall only.
        wrong: Extracted supports that are not in the ground truth.
        missing: True supports that were not extracted, by the extracted names of matched vertices.
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

    def to_json(self) -> dict[str, float | None]:
        """Entry of a view in `caryatid evaluate --json`; what nothing was matched for is None."""
        based_on = {"mean_iou": self.ious, "brier": self.forecasts, "average_precision": self.forecasts}
        names = [f.name for f in fields(self) if f.type == "float"]
        return {name: getattr(self, name) if based_on.get(name, True) else None for name in names}


def score(
    graph: SupportGraph,
    truth: TrueScene,
    rng: np.random.Generator | None = None,
    config: EvaluationConfig | None = None,
) -> Score:
    """Score a graph of fitted shapes against true ones.

    Every edge of the graph counts, doubtful ones too: a wrong guess costs precision. An edge is true if both
    ends are matched and the directed pair is in the ground truth, whatever its kind. Support surfaces match
    one to one where their tops have the same height and overlap.

    Args:
        graph: The extracted graph, in the world frame of the truth.
        truth: The true scene.
        rng: Draws the points that measure volumes; None draws the same ones every time.
        config: Minimum IoU, tolerance of the surfaces' heights, points per pair.
    """
    config = config or EvaluationConfig()
    rng = rng or np.random.default_rng(0)
    found, true = [o.shape for o in graph.movable], list(truth.objects.values())
    # By Monte Carlo; 10,000 points per pair: σ = 0.01 at worst.
    iou, true_bounds = np.zeros((len(found), len(true))), [_bounds(shape) for shape in true]
    for i, a in enumerate(found):
        low_a, high_a = _bounds(a)
        for j, (b, (low_b, high_b)) in enumerate(zip(true, true_bounds, strict=True)):
            if (np.maximum(low_a, low_b) >= np.minimum(high_a, high_b)).any():
                continue
            start, end = np.minimum(low_a, low_b), np.maximum(high_a, high_b)
            points_world = rng.uniform(start, end, size=(config.samples, 3))
            in_a, in_b = _inside(a, points_world), _inside(b, points_world)
            union = int(np.count_nonzero(in_a | in_b))
            iou[i, j] = np.count_nonzero(in_a & in_b) / union if union else 0.0
    surfaces = _match_surfaces(graph, truth, config.table_tolerance)
    return _matched(graph, truth.vertices, truth.edges, iou, list(truth.objects), surfaces, config.min_iou)


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
    names = [name for name in vertices if name != TABLE]
    found = [o.label for o in graph.movable]
    # Other names than `object<obj_id>` are of no object, like the label 0.
    numbered = [re.fullmatch("object([0-9]+)", name) for name in names]
    iou = mask_ious(labels, true_labels, found, [int(n[1]) if n else 0 for n in numbered])
    main = graph.support_surface
    surfaces = {main.id: TABLE} if main is not None and TABLE in vertices else {}
    return _matched(graph, vertices, edges, iou, names, surfaces, config.min_iou)


def _matched(
    graph: SupportGraph,
    vertices: Sequence[str],
    edges: Set[tuple[str, str]],
    iou: Array,
    names: Sequence[str],
    surfaces: Mapping[str, str],
    min_iou: float,
) -> Score:
    """Match the graph's objects (F) one to one with those of these names (T) by IoUs (F, T), and score.

    The true name of each matched support surface is given by its id.
    """
    objects = [o.id for o in graph.movable]
    pairs = assign(iou, min_iou)
    matches = {objects[i]: names[j] for i, j in pairs} | dict(surfaces)
    ious = {objects[i]: float(iou[i, j]) for i, j in pairs}
    found = {(matches.get(s.supporter, ""), matches.get(s.supported, "")): s for s in graph.supports}
    judged = {pair: Forecast(s.belief, pair in edges) for pair, s in found.items() if all(pair)}
    v, e = len(matches), sum(forecast.true for forecast in judged.values())
    claimed_v, claimed_e = len(graph.objects), len(graph.supports)
    precision, recall = _ratios(v + e, claimed_v + claimed_e, len(vertices) + len(edges))
    of_vertices, of_edges = _ratios(v, claimed_v, len(vertices)), _ratios(e, claimed_e, len(edges))
    mean_iou = float(np.mean(list(ious.values()))) if ious else 0.0
    f1 = _harmonic_mean(precision, recall)
    there = set(matches.values())
    missed = [pair for pair in edges if there.issuperset(pair) and pair not in judged]
    forecasts = (*judged.values(), *[Forecast(0.0, True)] * len(missed))
    brier = float(np.mean([(f.probability - f.true) ** 2 for f in forecasts])) if forecasts else 0.0
    of_forecasts = brier, average_precision(forecasts)
    shares = precision, recall, f1, *of_edges, *of_vertices, mean_iou, *of_forecasts
    known_as = {true: name for name, true in matches.items()}
    wrong = [s.pair for s in graph.supports if tuple(matches.get(end, "") for end in s.pair) not in edges]
    missing = [(known_as.get(a, a), known_as.get(b, b)) for a, b in sorted(edges - found.keys())]
    unfound = tuple(name for name in vertices if name not in there)
    return Score(*shares, matches, ious, forecasts, tuple(wrong), tuple(missing), unfound)


def average_precision(forecasts: Sequence[Forecast]) -> float:
    """Sum of precision times gain in recall, as the probability threshold falls from 1 to above 0.

    Equal probabilities form one step. A support with probability 0 is never found. Without any to find, the
    result is 1 if nothing is found, and 0 otherwise.
    """
    said, true = np.array(forecasts, dtype=np.float64).reshape(-1, 2).T
    order = np.argsort(-said, kind="stable")[: np.count_nonzero(said)]
    steps = np.flatnonzero(np.diff(said[order], append=-1.0))
    hits = np.cumsum(true[order])[steps]
    if not true.any():
        return float(len(steps) == 0)
    return float(np.diff(hits, prepend=0.0) @ (hits / (steps + 1)) / true.sum())


def _inside(shape: Shape, points_world: Array) -> NDArray[np.bool_]:
    """Which points (N, 3) lie inside a shape (N,); a hollow object counts with its inside."""
    if len(shape.parts) > 1:
        return in_hull(shape.outline(), points_world)
    return shape.signed_distance(points_world) <= 0.0


def _bounds(shape: Shape) -> tuple[Array, Array]:
    """Lowest and highest corner, (3,) each [m], of the world-aligned box around a shape."""
    if isinstance(shape, Solid):
        corners = shape.outline()
        return corners.min(axis=0), corners.max(axis=0)
    centre, reach = shape.T_world_object[:3, 3], shape.support(np.eye(3))
    return centre - reach, centre + reach


def mask_ious(
    labels: Sequence[NDArray[np.int32]],
    true_labels: Sequence[NDArray[np.int32]],
    found: Sequence[int],
    true: Sequence[int],
) -> Array:
    """Intersection over union (F, T) of masks, the pixels of all frames pooled.

    Labels are images (H, W), or of points (N,). Numbers that belong to no object match nothing.

    Raises:
        InputError: Images differ in number or size.
    """
    if [a.size for a in labels] != [b.size for b in true_labels]:
        shapes, true_shapes = [a.shape for a in labels], [b.shape for b in true_labels]
        why = f"the run has label images of {shapes}, but the ground truth of {true_shapes}"
        raise InputError("labels", why, "give the ground truth of the frames of this run")
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
    """Take a graph of fitted shapes as the truth, with vertices named by their ids."""
    return TrueScene(
        vertices=tuple(o.id for o in graph.objects),
        edges=frozenset(s.pair for s in graph.supports),
        objects={o.id: o.shape for o in graph.movable},
        surfaces={o.id: _top_of(o.shape) for o in graph.support_surfaces},
    )


def _match_surfaces(graph: SupportGraph, truth: TrueScene, tolerance: float) -> dict[str, str]:
    """True surface of each support surface of a graph, one to one, with the largest overlap of tops (IoU)."""
    found = {o.id: _top_of(o.shape) for o in graph.support_surfaces}
    # A bin's floor may lie within the tolerance above its table: the better overlap decides.
    overlap = np.zeros((len(found), len(truth.surfaces)))
    for i, a in enumerate(found.values()):
        for j, b in enumerate(truth.surfaces.values()):
            overlap[i, j] = _top_overlap(a, b) if abs(a.height - b.height) <= tolerance else 0.0
    names, true = list(found), list(truth.surfaces)
    return {names[i]: true[j] for i, j in assign(overlap, 0.0) if overlap[i, j] > 0.0}


def _top_of(shape: Shape) -> TrueSurface:
    """Top of a surface's shape: height of the middle, of a box of its most level upper face; its bounds."""
    rise = np.abs(shape.T_world_object[2, :3])
    x, y, height = shape.T_world_object[:3, 3].tolist()
    half_x, half_y, up = shape.support(np.eye(3)).tolist()
    if isinstance(shape, Box):
        up = float(rise.max() * shape.extents[np.argmax(rise)] / 2.0)
    return TrueSurface(height + up, x, y, half_x, half_y)


def _top_overlap(a: TrueSurface, b: TrueSurface) -> float:
    """IoU of two tops, seen from above [1]."""
    one, other = (shapely.box(t.x - t.half_x, t.y - t.half_y, t.x + t.half_x, t.y + t.half_y) for t in (a, b))
    return float(one.intersection(other).area / one.union(other).area)


def _ratios(right: int, claimed: int, true: int) -> tuple[float, float]:
    """Precision and recall from the numbers of right, claimed and true items."""
    nothing = 1.0 if claimed == true == 0 else 0.0
    return right / claimed if claimed else nothing, right / true if true else nothing


def _harmonic_mean(a: float, b: float) -> float:
    return 2.0 * a * b / (a + b) if a + b > 0.0 else 0.0


def _order(image: NDArray[np.int32], labels: Sequence[int]) -> NDArray[np.intp]:
    """Position of each pixel's label in `labels`, from 1; 0 where it is none of them."""
    table = np.zeros(SUPPORT_LABEL + 1, dtype=np.intp)
    for position, label in enumerate(labels, start=1):
        if 0 < label < SUPPORT_LABEL:
            table[label] = position
    return table[image.ravel()]
