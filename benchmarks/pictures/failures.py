"""Pictures of what goes wrong, for docs/failures.md: true objects and supports beside those that were found.

    python benchmarks/pictures/failures.py [NAMES…]

Each picture is of a built-in scene explored anew: what a camera saw; the true objects, with the supports that
were missed; and the shapes found for them, with the supports that are not there. All other objects are left
out. The reasons of wrong edges are printed.
"""

from __future__ import annotations

import string
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import matplotlib
import numpy as np
import tyro
from hull import draw_hull
from matplotlib import pyplot as plt
from matplotlib.lines import Line2D
from panels import (
    EXTRA,
    INVENTED_COLOUR,
    LEGEND,
    MISSED,
    RIGHT,
    SIZE,
    arrow,
    best_eye,
    png,
    show_lost,
    show_solids,
    show_view,
)

from caryatid.config import Config, SegmentationMethod
from caryatid.errors import CaryatidError
from caryatid.evaluation.scores import TABLE, Score, score
from caryatid.evaluation.truths import true_scene_from_simulation
from caryatid.exploration import Step, explore
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Shape
from caryatid.geometry.transforms import Array
from caryatid.simulation.scenes import load_scene
from caryatid.simulation.setup import make_simulation
from caryatid.simulation.truth import ground_truth
from caryatid.simulation.world import SimulatedScene, table_top, true_shapes
from caryatid.support.relations import explain
from caryatid.viz.colours import PALETTE

FOLDER = Path(__file__).parents[2] / "docs" / "pictures"


@dataclass(frozen=True)
class Picture:
    """A failure to draw.

    Attributes:
        scene: Name of a built-in scene.
        focus: True objects that take part; they become A, B, C, …
        title: What is wrong.
        segmentation: Where parts come from.
        views: Views the scene is explored for.
        seed: Of noise and choices.
    """

    scene: str
    focus: tuple[str, ...]
    title: str
    segmentation: SegmentationMethod = "labels"
    views: int = 5
    seed: int = 0


PICTURES: Mapping[str, Picture] = {
    "hidden": Picture("dense-15-124", ("object8", "object4"), "A strip of the can A is seen behind B"),
    "friction": Picture(
        "dense-12-107",
        ("object11", "object5", "object6", "object7"),
        "A sits between B and C and presses on their sides; it does not touch D",
    ),
    "wedge": Picture(
        "dense-12-114", ("object6", "object7"), "B leans over A: each carries the other by friction"
    ),
    "lean": Picture(
        "dense-14-116", ("object10", "object11", "object9"), "A hangs between B and C: all contacts are steep"
    ),
    "merged": Picture("packed-20-1", ("object2", "object0"), "A and B become one box", "auto"),
    "split": Picture(
        "dense-15-124", ("object4", "object8"), "An end of A is all that is found, B not at all", "auto"
    ),
    "slivers": Picture(
        "dense-15-103",
        ("object5", "object8", "object4"),
        "A strip of C becomes a box, A is too small to be a part",
        "auto",
    ),
}


NAMELESS = "? is no true object"
HULL = "hull"
"""The picture that needs no scene."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """What exploring the scene of a picture gave."""

    scene: SimulatedScene
    steps: tuple[Step, ...]
    score: Score
    supports: frozenset[tuple[str, str]]


@dataclass(frozen=True)
class Args:
    """Draw pictures of failures."""

    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Pictures. [default: all]"""
    out: Path = FOLDER
    """Folder to write to."""


def run(picture: Picture) -> Outcome:
    """Explore the scene and score what was found."""
    config = Config()
    config = replace(config, active=replace(config.active, max_views=picture.views))
    scene = load_scene(picture.scene)
    truth = ground_truth(scene)
    stage = make_simulation(scene, config, noise="carmine", seed=picture.seed)
    steps = tuple(
        explore(
            stage.camera,
            stage.robot,
            config=config,
            segmentation=picture.segmentation,
            seed=picture.seed,
            early_stop=False,
        )
    )
    result = score(steps[-1].graph, true_scene_from_simulation(scene, truth), np.random.default_rng(0))
    return Outcome(scene, steps, result, frozenset(truth.pairs))


def draw(picture: Picture, outcome: Outcome) -> Any:
    """Draw a picture as a figure and print why its wrong edges are, or are not, there."""
    shapes = true_shapes(outcome.scene)
    labels = {body: label for label, body in outcome.scene.object_bodies.items()}
    true = {name: shapes[labels[name]] for name in picture.focus}
    tags = {
        name: (text, matplotlib.colors.to_rgb(colour))
        for name, text, colour in zip(picture.focus, string.ascii_uppercase, PALETTE, strict=False)
    }
    top = table_top(outcome.scene).height
    eye = best_eye(list(true.values()), top)
    figure, panels = plt.subplots(1, 3, figsize=(3 * SIZE[0] / 100, SIZE[1] / 100 + 0.95), dpi=100)
    figure.subplots_adjust(0.004, 0.075, 0.996, 0.85, wspace=0.015)
    figure.suptitle(picture.title, fontsize=15, fontweight="bold", y=0.985)
    lines = [Line2D([], [], color=colour, linewidth=3.0, label=text) for text, colour in LEGEND]
    lines.append(
        Line2D([], [], color=INVENTED_COLOUR, marker="s", markersize=11, linestyle="", label=NAMELESS)
    )
    figure.legend(handles=lines, loc="lower center", ncols=len(lines), frameon=False, fontsize=11)
    show_view(panels[0], outcome.steps, {labels[name]: tag for name, tag in tags.items()})
    solids = {name: (shape, *tags[name]) for name, shape in true.items()}
    show_solids(panels[1], solids, top, eye, "true objects and supports")
    for pair, right in true_supports(outcome):
        if pair[1] in true and (pair[0] in true or (pair[0] == TABLE and not right)):
            arrow(panels[1], eye, true.get(pair[0]), true[pair[1]], top, RIGHT if right else MISSED)
            if not right:
                print(f"  missed: {reason(outcome, pair)}")
    found = found_shapes(outcome, true)
    solids = {i: (shape, *tags.get(name, ("?", INVENTED_COLOUR))) for i, (name, shape) in found.items()}
    show_solids(panels[2], solids, top, eye, "found objects and supports")
    for name in set(true) - {name for name, _ in found.values()}:
        show_lost(panels[2], true[name], tags[name][0], eye)
    matches = outcome.score.matches
    for s in outcome.steps[-1].graph.supports:
        right = (matches.get(s.supporter), matches.get(s.supported)) in outcome.supports
        on_table = matches.get(s.supporter) == TABLE
        if s.supported in found and (s.supporter in found or (on_table and not right)):
            supporter = None if on_table else found[s.supporter][1]
            arrow(panels[2], eye, supporter, found[s.supported][1], top, RIGHT if right else EXTRA)
            if not right:
                print(f"  not there: {s.why}")
    return figure


def true_supports(outcome: Outcome) -> list[tuple[tuple[str, str], bool]]:
    """True pairs (supporter, supported), and whether each was found."""
    taken = {true: found for found, true in outcome.score.matches.items()}
    got = {s.pair for s in outcome.steps[-1].graph.supports}
    return [((a, b), (taken.get(a), taken.get(b)) in got) for a, b in sorted(outcome.supports)]


def reason(outcome: Outcome, pair: tuple[str, str]) -> str:
    """Why a true support was not found."""
    taken = {true: found for found, true in outcome.score.matches.items()}
    lost = [name for name in pair if name not in taken]
    if lost:
        return f"{lost[0]} was lost"
    return explain(outcome.steps[-1].graph, taken[pair[0]], taken[pair[1]], Config().support)


def found_shapes(outcome: Outcome, true: Mapping[str, Shape]) -> dict[str, tuple[str, Shape]]:
    """Found objects in focus by id, with true name and shape, and nameless ones that meet those in focus."""
    found: dict[str, tuple[str, Shape]] = {}
    for o in outcome.steps[-1].graph.objects:
        name = outcome.score.matches.get(o.id, "")
        if o.role != "object" or (name and name not in true):
            continue
        inside = [bool((s.signed_distance(sample(o.shape)) < 0.0).mean() > 0.1) for s in true.values()]
        if name or any(inside):
            found[o.id] = (name, o.shape)
    return found


def sample(shape: Shape) -> Array:
    """Points (N, 3) [m] inside a shape."""
    rng = np.random.default_rng(0)
    local = rng.uniform(-0.5, 0.5, (4000, 3)) * shape.extents
    points_world = transforms.transform(shape.T_world_object, local)
    return points_world[shape.signed_distance(points_world) < 0.0]


def main() -> int:
    """Draw the pictures."""
    args = tyro.cli(Args)
    matplotlib.use("agg")
    known = (*PICTURES, HULL)
    unknown = [name for name in args.names if name not in known]
    if unknown:
        raise CaryatidError(f"no picture '{unknown[0]}': choose from {', '.join(known)}")
    args.out.mkdir(parents=True, exist_ok=True)
    for name in args.names or known:
        if name == HULL:
            figure = draw_hull(SIZE)
        else:
            outcome = run(PICTURES[name])
            print(f"{name}: {PICTURES[name].scene}, F1 {outcome.score.f1:.3f}")
            figure = draw(PICTURES[name], outcome)
        (args.out / f"{name}.png").write_bytes(png(figure))
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except CaryatidError as error:
        sys.exit(f"error: {error}")
