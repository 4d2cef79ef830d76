"""What a benchmark is made of: episodes, what was measured view by view, and where each belongs."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from typing import Literal, get_args

from caryatid.config import FusionMethod, NoiseModel, SegmentationMethod

OrderName = Literal["", "one hand", "two hands", "highest first", "random", "true graph"]
"""How objects are put in order to be taken away; nothing is taken with the empty name."""

ORDERS: tuple[OrderName, ...] = tuple(name for name in get_args(OrderName) if name)
"""All of them that take something."""


@dataclass(frozen=True, slots=True)
class Episode:
    """One run of the loop: with a fingerprint of the code, everything that determines its figures.

    Attributes:
        scene: Name of a built-in scene, or a scene folder.
        content: Digest of a scene folder's files; empty for a built-in scene, which its name determines.
        fusion: What is fused.
        planner: Who chooses the views.
        plugin: Digest of the package that offers the planner; empty for those that come with caryatid.
        segmentation: Where parts come from.
        noise: Noise of the camera.
        settings: Changes of the default settings, `stage.name=value`.
        views: Views it has, the first one too.
        seed: Seed of the noise and of every choice.
        order: How the objects are put in order to be taken away; empty where nothing is.
    """

    scene: str
    content: str = ""
    fusion: FusionMethod = "pc+sg"
    planner: str = "support"
    plugin: str = ""
    segmentation: SegmentationMethod = "labels"
    noise: NoiseModel = "carmine"
    settings: tuple[str, ...] = ()
    views: int = 5
    seed: int = 0
    order: OrderName = ""

    def key(self, fingerprint: str) -> str:
        """Digest of the episode and of the code that runs it; where a scene's folder lies does not matter.

        Args:
            fingerprint: Of the code, see `caryatid.runtime.fingerprint`.
        """
        told = asdict(self) | ({"scene": ""} if self.content else {})
        text = json.dumps([fingerprint, told], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True, slots=True)
class ViewRow:
    """What was measured after one view.

    Attributes:
        view: How many views there have been, 1 after the first.
        precision: Eq. 4, vertices and edges together [1].
        recall: Eq. 5, vertices and edges together [1].
        f1: Their harmonic mean [1].
        vertex_precision: Vertices alone, the table included [1].
        vertex_recall: Vertices alone [1].
        vertex_f1: Vertices alone [1].
        edge_precision: Edges alone [1].
        edge_recall: Edges alone [1].
        edge_f1: Edges alone [1].
        mean_iou: Of the matched objects [1].
        angle: Travelled so far on the view sphere [rad].
        path: Travelled so far over the floor [m].
        planning_seconds: Time the choice of this view took [s]; 0 for the first.
        perception_seconds: Time from this view to the fused graph [s].
        unharmed: 1 where the scene, taken apart after this view, comes to no harm, else 0; between the views
            after which it is, and where it never is, what it was before, 0 at first.
        lifts: Share of the lifts that disturb nothing [1]; likewise.
    """

    view: int
    precision: float
    recall: float
    f1: float
    vertex_precision: float
    vertex_recall: float
    vertex_f1: float
    edge_precision: float
    edge_recall: float
    edge_f1: float
    mean_iou: float
    angle: float
    path: float
    planning_seconds: float
    perception_seconds: float
    unharmed: float = 0.0
    lifts: float = 0.0


MEASURES = tuple(name for name in ViewRow.__slots__ if name != "view")
"""Names of what is measured after each view."""

TIMES = ("planning_seconds", "perception_seconds")
"""Measures that differ from run to run and from machine to machine."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What an episode gave.

    Attributes:
        rows: One row a view; none where it failed.
        error: Why it failed, in one line, or None.
    """

    rows: tuple[ViewRow, ...]
    error: str | None = None


@dataclass(frozen=True, slots=True)
class Member:
    """An episode of a suite, and what it is compared as.

    Attributes:
        episode: What is run.
        method: Label of the method: one line of a figure.
        condition: Label of noise and segmentation: one figure of a suite.
        family: Kind of the scene: `designed`, `pile`, `dense`, …
    """

    episode: Episode
    method: str
    condition: str
    family: str


@dataclass(frozen=True, slots=True)
class Record:
    """A member of a suite that was run.

    Attributes:
        member: What was run.
        outcome: What it gave.
    """

    member: Member
    outcome: Outcome
