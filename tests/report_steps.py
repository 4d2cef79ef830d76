"""Steps of an exploration for the report to draw: a table, a box, a can on it and a ball."""

from __future__ import annotations

import numpy as np

from caryatid.config import ReportConfig
from caryatid.exploration import Step
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Sphere, fibonacci_sphere
from caryatid.graph import SceneObject, Stability, Support, SupportGraph
from caryatid.planning.candidates import Candidates
from caryatid.planning.decision import Decision
from caryatid.planning.points_of_interest import PointOfInterest
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.sensing.views import SUPPORT_LABEL, Cloud, View
from caryatid.viz.drawings import Projection

SMALL = ReportConfig(image_width=160)
K = np.array([[200.0, 0.0, 79.5], [0.0, 200.0, 59.5], [0.0, 0.0, 1.0]])
TOP = 0.7


def at(x: float, y: float, z: float) -> np.ndarray:
    return transforms.rigid(np.eye(3), (x, y, z))


def make_graph() -> SupportGraph:
    table = SceneObject("o0", 0, Box(at(0, 0, TOP - 0.02), np.array([0.6, 0.8, 0.04])), "support_surface")
    box = SceneObject("o1", 1, Box(at(0, 0, TOP + 0.05), np.array([0.1, 0.16, 0.1])), why="three faces seen")
    can = SceneObject("o2", 2, Cylinder(at(0, 0.02, TOP + 0.16), 0.03, 0.12), residual=0.0024, poor_fit=True)
    ball = SceneObject("o7", 7, Sphere(at(0.2, 0.2, TOP + 0.04), 0.04), occurrences=1, opportunities=2)
    supports = (
        Support("o0", "o1", occurrences=2, opportunities=2, why="the table lies below <o1>"),
        Support("o1", "o2", occurrences=1, opportunities=2),
        Support("o0", "o2", certain=False, occurrences=1, opportunities=5, why="o2 tips"),
        Support("o2", "o1", "top-down", certain=False, occurrences=3, opportunities=4),
    )
    stability = {"o1": Stability(1.0, -0.05, False, False), "o2": Stability(0.06, 0.012, True, True)}
    return SupportGraph((table, box, can, ball), supports, stability)


def make_view(graph: SupportGraph, rgb: bool = True) -> View:
    """A view in which every surface point of every shape is a pixel, the nearest wins."""
    T_world_camera = transforms.look_at((1.0, 0.2, TOP + 0.6), (0.0, 0.0, TOP + 0.05))
    depth = np.zeros((120, 160), dtype=np.float32)
    labels = np.zeros((120, 160), dtype=np.int32)
    points = [item.shape.surface(0.003)[0] for item in graph.objects]
    of_point = np.repeat([item.label for item in graph.objects], [len(p) for p in points])
    pixels, z = Projection(T_world_camera, K, depth).project(np.concatenate(points))
    u, v = np.rint(pixels).astype(int).T
    far_to_near = np.argsort(-z)
    seen = far_to_near[((u >= 0) & (u < 160) & (v >= 0) & (v < 120))[far_to_near]]
    depth[v[seen], u[seen]], labels[v[seen], u[seen]] = z[seen], of_point[seen]
    colour = np.full((120, 160, 3), 90, dtype=np.uint8) if rgb else None
    return View(depth, K, T_world_camera, colour, labels, name="view <7> & more")


def make_cloud(graph: SupportGraph) -> Cloud:
    surfaces = [item.shape.surface(0.015) for item in graph.objects]
    labels = np.repeat([item.label or SUPPORT_LABEL for item in graph.objects], [len(p) for p, _ in surfaces])
    points, normals = (np.concatenate(part) for part in zip(*surfaces, strict=True))
    return Cloud(points, normals, labels.astype(np.int32), name="fused")


def make_step(index: int = 0, *, rgb: bool = True, decide: bool = True) -> Step:
    graph = make_graph()
    view = make_view(graph, rgb)
    directions = fibonacci_sphere(2000)
    sphere = ViewSphere(np.array([0.0, 0.0, TOP]), 1.5, directions)
    reached = np.flatnonzero((directions[:, 2] > 0.3) & (directions[:, 2] < 0.7))
    poses = sphere.poses(directions[reached])
    candidates = Candidates(poses, directions[reached], np.ones(len(reached)), {"too low": 12}, reached)
    point = PointOfInterest(
        np.array([0, 0, TOP + 0.1]), np.array([0.6, 0, 0.8]), 0.62, ("o1", "o2"), "seen once <i>"
    )
    saliency = np.linspace(-1.0, 1.0, len(directions))
    decision = Decision(poses[3], 3, 0.8, 0.25, 0.55, "sees o2 & o7 best", (point,), None, saliency)
    return Step(
        index=index,
        name="view <7> & more",
        view=view,
        labels=view.labels,
        graph=graph,
        cloud=make_cloud(graph),
        sphere=sphere,
        visited=transforms.unit(np.array([[0.8, 0.1, 0.5], [0.0, 0.8, 0.5]]))[: index + 1],
        candidates=candidates if decide else None,
        decision=decision if decide else None,
        timings={"capture": 0.04, "fit": 0.2},
        angle_travelled=0.9 * index,
        path_travelled=1.4 * index,
        stop=None if decide else "the graph did not change",
    )


def good(f1: float) -> dict[str, float]:
    return {"precision": f1 + 0.02, "recall": f1 - 0.02, "f1": f1}
