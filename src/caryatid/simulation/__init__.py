"""Simulated tables: scenes in physics, a depth camera without GL, and the true support graph."""

from __future__ import annotations

from caryatid.simulation.camera import SimulatedCamera
from caryatid.simulation.generation import generate
from caryatid.simulation.scenes import is_builtin, list_scenes, load_scene
from caryatid.simulation.truth import GroundTruth, TrueEdge, ground_truth, read_truth, write_truth
from caryatid.simulation.world import SimulatedScene, static_boxes, table_centre, true_shapes

__all__ = [
    "GroundTruth", "SimulatedCamera", "SimulatedScene", "TrueEdge", "generate", "ground_truth", "is_builtin",
    "list_scenes", "load_scene", "read_truth", "static_boxes", "table_centre", "true_shapes", "write_truth",
]  # fmt: skip
