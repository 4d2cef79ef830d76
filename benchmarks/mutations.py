"""Measure whether faults of recordings are named: units, kinds of depth, cameras, axes, poses and clocks.

    python benchmarks/mutations.py [SCENES…] [--seed 0]

Sound recordings of simulated scenes, five views each, are spoilt in one way at a time. A fault is named if
`diagnose` says what the fault's pattern matches; said if it or the scene model says something else; silent if
nothing is said and the graph lacks a tenth of F1. Sound recordings show the false alarms.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
import pandas as pd
import tyro
from measures import OnScenes, Row, run_main
from scipy.spatial.transform import Rotation

from caryatid.benchmark.episodes import open_scene
from caryatid.config.settings import read_settings
from caryatid.errors import CaryatidError
from caryatid.evaluation.scores import score
from caryatid.evaluation.truths import true_scene_from_simulation
from caryatid.geometry import transforms
from caryatid.scene import Scene
from caryatid.segmentation.diagnosis import BODY, GL, Y_UP, diagnose, ray_lengths
from caryatid.sensing.views import View
from caryatid.simulation.setup import make_simulation

SCENES = (
    *("tower", "clutter", "shelf", "hidden_stack", "pile-8-3", "pile-12-5", "pile-10-2"),
    *("house-8-1", "storeys-6-2", "blocks-6-1"),
)
VIEWS = 5
"""Views of each recording, on a circle around the table, up to 45° apart."""

Fault = Callable[[list[View], float], list[View]]
"""Spoils views; a number from 0 to 1 says how much."""


def depth(change: Callable[[View, float], Any]) -> Fault:
    """Spoil depth."""
    return lambda views, k: [replace(v, depth=change(v, k).astype(np.float32)) for v in views]


def pose(change: Callable[[Any], Any]) -> Fault:
    """Spoil poses."""
    return lambda views, _: [v.with_pose(change(v.pose)) for v in views]


def moved(factor: float) -> Fault:
    """Give translations in another unit."""
    return pose(lambda T: transforms.rigid(T[:3, :3], factor * T[:3, 3]))


def camera(scale: Callable[[float], float]) -> Fault:
    """Give K for another resolution."""
    return lambda views, k: [replace(v, K=v.K * [[scale(k)], [scale(k)], [1.0]]) for v in views]


def rolled(T: Any) -> Any:
    """Read a quaternion in the wrong order."""
    quaternion = np.roll(Rotation.from_matrix(T[:3, :3]).as_quat(), 1)
    return transforms.rigid(Rotation.from_quat(quaternion).as_matrix(), T[:3, 3])


def turned(quarters: int) -> Fault:
    """Turn images by quarters of a turn."""

    def one(view: View) -> View:
        K, (height, width) = view.K.copy(), view.depth.shape
        if quarters == 2:
            K[:2, 2] = width - 1 - K[0, 2], height - 1 - K[1, 2]
        else:
            K[[0, 1], [0, 1]] = K[1, 1], K[0, 0]
            K[:2, 2] = (K[1, 2], width - 1 - K[0, 2]) if quarters == 1 else (height - 1 - K[1, 2], K[0, 2])
        return replace(view, depth=np.rot90(view.depth, quarters).copy(), rgb=None, K=K)

    return lambda views, _: [one(view) for view in views]


def inverse(view: View, _: float) -> Any:
    """Invert depth."""
    return np.divide(1.0, view.depth, out=np.zeros(view.depth.shape), where=view.valid)


def buffer(view: View, _: float) -> Any:
    """Return the values of a depth buffer between 0.1 and 10 m."""
    near, far = 0.1, 10.0
    return np.where(view.valid, (1.0 / near - inverse(view, 0.0)) / (1.0 / near - 1.0 / far), 0.0)


FAULTS: Mapping[str, tuple[Fault, str]] = {
    "sound": (lambda views, _: views, r"$^"),
    "depth in mm": (depth(lambda v, _: 1e3 * v.depth), "in millimetres"),
    "depth in cm": (depth(lambda v, _: 1e2 * v.depth), "in centimetres"),
    "depth in 0.1 mm": (depth(lambda v, _: 1e4 * v.depth), "tenths of a millimetre"),
    "depth divided twice": (depth(lambda v, _: 1e-3 * v.depth), "in kilometres"),
    "along the ray": (depth(lambda v, _: v.depth * ray_lengths(v)), "along the ray"),
    "inverse depth": (depth(inverse), "inverse depth"),
    "depth buffer": (depth(buffer), r"buffer in \[0, 1\]"),
    "K of a larger image": (camera(lambda k: 1.5 + 2.5 * k), "multiply its first two rows"),
    "K of a smaller image": (camera(lambda k: 0.3 + 0.4 * k), "multiply its first two rows"),
    "OpenGL axes": (pose(lambda T: T @ GL), "OpenGL's"),
    "body axes": (pose(lambda T: T @ BODY.T), "camera's body"),
    "inverse poses": (pose(transforms.invert), "is the inverse"),
    "y up": (pose(lambda T: Y_UP.T @ T), "y axis points up"),
    "y up, OpenGL axes": (pose(lambda T: Y_UP.T @ T @ GL), "OpenGL's.* y axis points up"),
    "z down": (pose(lambda T: GL @ T), "z axis points down"),
    "quaternion order": (pose(rolled), "quaternion"),
    "poses in mm": (moved(1e3), "in millimetres"),
    "poses in cm": (moved(1e2), "centimetres"),
    "poses divided twice": (moved(1e-3), "in kilometres"),
    "turned by 90°": (turned(1), "turned by 90°"),
    "turned by 180°": (turned(2), "turned by 180°"),
    "mirrored": (
        lambda views, _: [replace(v, depth=v.depth[:, ::-1].copy(), rgb=None) for v in views],
        "mirrored",
    ),
    "late poses": (
        lambda views, _: [v.with_pose(views[max(n - 1, 0)].pose) for n, v in enumerate(views)],
        "pose is that of the view before",
    ),
}
"""Faults, and patterns of what names them."""


class Listener(logging.Handler):
    """Keeps what is logged."""

    def __init__(self, said: list[str]) -> None:
        super().__init__()
        self.said = said

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a message."""
        self.said.append(record.getMessage())


@dataclass(frozen=True)
class Mutations(OnScenes):
    """Spoil recordings, and see what is said."""

    scenes: Annotated[tuple[str, ...], tyro.conf.Positional] = SCENES
    """Names of built-in scenes."""

    def measure(self, name: str) -> list[Row]:
        """Spoil the recording of one scene in every way."""
        config, (scene, _) = read_settings(None, self.set), open_scene(name)
        made = make_simulation(scene, config, noise=self.noise, seed=self.seed)
        rng, start = np.random.default_rng([self.seed, len(name)]), made.robot.T_world_camera
        step = np.cumsum(rng.uniform(20.0, 45.0, VIEWS))
        turns = [
            transforms.rigid(Rotation.from_euler("z", a, degrees=True).as_matrix(), np.zeros(3)) for a in step
        ]
        views = [replace(made.camera.capture(T @ start), labels=None) for T in turns]
        truth, rows, best = true_scene_from_simulation(scene), list[Row](), 0.0
        for fault, (spoil, pattern) in FAULTS.items():
            said, f1 = list[str](), 0.0
            handler = Listener(said)
            logging.getLogger("caryatid").addHandler(handler)
            try:
                spoilt = spoil(views, float(rng.uniform()))
                problems = diagnose(spoilt, config).problems
                named = any(re.search(pattern, problem) for problem in problems)
                if not problems:
                    model = Scene(config, segmentation="auto", seed=self.seed)
                    for view in spoilt:
                        model.update(view)
                    f1 = score(model.graph, truth).f1
            except CaryatidError as error:
                problems, named = [*problems, f"{error}"], bool(re.search(pattern, f"{error}"))
            finally:
                logging.getLogger("caryatid").removeHandler(handler)
            best = max(best, f1)
            loud = named or problems or any("no depth in" not in text for text in said)
            verdict = "named" if named else "said" if loud else "right" if f1 > best - 0.1 else "silent"
            rows.append({"scene": name, "fault": fault, "verdict": verdict, "what": [*problems, *said][:2]})
        return rows

    def summary(self, rows: pd.DataFrame) -> dict[str, float]:
        """Return shares of the spoilt recordings, and the number of sound ones of which something is said."""
        sound = rows["fault"] == "sound"
        spoilt = rows[~sound]["verdict"]
        found = {"spoilt": float(len(spoilt))}
        found |= {name: float((spoilt == name).mean()) for name in ("named", "said", "right", "silent")}
        return found | {"false alarms": float((rows[sound]["verdict"] != "right").sum())}

    def remark(self, row: Row) -> str:
        """Say what was not named."""
        if row["verdict"] == "named" or (row["verdict"] == "right" and row["fault"] == "sound"):
            return ""
        return f"{row['scene']}, {row['fault']}: {row['verdict']}: {'; '.join(row['what'])[:150]}"


if __name__ == "__main__":
    run_main(Mutations)
