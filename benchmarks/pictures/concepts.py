"""Pictures of each stage of the loop on one scene, for docs/concepts.md.

    python benchmarks/pictures/concepts.py [NAMES…]

The scene has something leaning, something held from above, and a stack that the first view does not see. The
same command draws the same pictures, byte for byte.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import matplotlib
import numpy as np
import tyro
from matplotlib import pyplot as plt
from solids import Eye, draw_solids
from stages import (
    colour_of,
    framed,
    on_table,
    plate,
    png,
    show_graph,
    show_interest,
    show_planes,
    show_points,
    show_shapes,
    show_sphere,
)

from caryatid.config import Config
from caryatid.exploration import Step, explore
from caryatid.geometry.transforms import Array
from caryatid.manipulation.order import plan_order
from caryatid.planning.decision import Decision, PlanningState
from caryatid.planning.planners import make_planner
from caryatid.scene import Scene
from caryatid.sensing.views import SUPPORT_LABEL
from caryatid.simulation.setup import make_simulation
from caryatid.simulation.world import SimulatedScene, box, build_spec, cylinder, scene_from_spec, sphere
from caryatid.viz import colours

FOLDER = Path(__file__).parents[2] / "docs" / "pictures" / "concepts"
SIZE = (560, 430)
"""Width and height of a panel with shapes [px]."""
SQUARE = 440
"""Side of a panel with the view sphere [px]."""
DPI = 100
VIEWS = 4
SOLIDS = (
    box((0.1, 0.2, 0.28), at=(-0.08, 0.14, 0.14), density=1200.0, friction=0.1),
    box((0.02, 0.09, 0.24), at=(-0.169, 0.14, 0.1215), turn=(0.0, 14.0, 0.0), friction=0.1),
    box((0.12, 0.12, 0.07), at=(0.08, 0.14, 0.035)),
    cylinder(0.035, 0.09, at=(0.08, 0.14, 0.115)),
    box((0.11, 0.1, 0.1), at=(0.0, -0.07, 0.05)),
    box((0.07, 0.36, 0.02), at=(0.0, -0.19, 0.11), density=500.0),
    cylinder(0.04, 0.08, at=(0.0, -0.06, 0.16), density=3000.0),
    sphere(0.035, at=(-0.1, -0.2, 0.035)),
)
"""A tall box, a board that leans on it, a stack behind it; a beam on a block, held by a weight; a ball."""


@dataclass(frozen=True, eq=False)
class Story:
    """The scene, explored.

    Attributes:
        steps: Its views.
        top: Height of the table [m].
        eye: Where solids are drawn from.
        state: What planners saw after the first view.
    """

    steps: tuple[Step, ...]
    top: float
    eye: Eye
    state: PlanningState


def tell() -> Story:
    """Explore the scene."""
    config = Config()
    config = replace(config, active=replace(config.active, max_views=VIEWS))
    scene: SimulatedScene = scene_from_spec(build_spec(SOLIDS, "concepts"), "concepts", "concepts", least=1.0)
    stage = make_simulation(scene, config, noise="carmine", seed=0)
    steps = tuple(explore(stage.camera, stage.robot, config=config, segmentation="auto", early_stop=False))
    first = Scene(config, segmentation="auto")
    assert steps[0].view is not None
    first.update(steps[0].view)
    assert first.voxels is not None
    assert steps[0].candidates is not None
    state = PlanningState(
        steps[0].graph, steps[0].sphere, first.voxels, steps[0].visited, steps[0].candidates, config.active
    )
    surface = steps[-1].graph.support_surface
    assert surface is not None
    top = float(surface.centre_world[2] + surface.shape.extents[2] / 2.0)
    return Story(steps, top, eye_from(290.0, 33.0, np.array([-0.02, -0.03, top + 0.1]), 0.3), state)


def eye_from(
    azimuth: float, elevation: float, centre_world: Array, radius: float, size: tuple[int, int] = SIZE
) -> Eye:
    """An eye in a direction [deg] that sees a ball of some radius [m] around a point (3,) [m]."""
    a, e = np.deg2rad([azimuth, elevation])
    direction = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
    return Eye.towards(centre_world, direction, radius, *size)


def panels(count: int, width: int = SIZE[0], height: int = SIZE[1], title: float = 26.0) -> tuple[Any, Any]:
    """A figure of panels side by side, each of a size [px] with room for a title [px]."""
    figure, axes = plt.subplots(
        1, count, figsize=(count * width / DPI, (height + title) / DPI), dpi=DPI, squeeze=False
    )
    figure.subplots_adjust(0.004, 0.004, 0.996, height / (height + title), wspace=0.02)
    return figure, axes[0]


def draw_view(story: Story) -> bytes:
    """What the camera gives: colour and depth."""
    view = story.steps[0].view
    figure, (left, right) = panels(2, 480, 300)
    assert view is not None
    assert view.rgb is not None
    near, far = np.percentile(view.depth[view.valid], (2.0, 60.0))
    shade = colours.scale((view.depth - near) / (far - near), colours.DEPTH_STOPS)
    shade[~view.valid] = 0
    titles = ("colour", "depth, near is light; black: no reading")
    for panel, image, title in zip((left, right), (view.rgb, shade), titles, strict=True):
        panel.imshow(image[90:390, 80:560])
        panel.set_title(title, fontsize=10)
        panel.axis("off")
    return png(figure, 256)


def draw_parts(story: Story) -> bytes:
    """What is taken for one thing."""
    step = story.steps[0]
    figure, (left, right) = panels(2, 480, 300)
    assert step.view is not None
    assert step.view.rgb is not None
    grey = np.repeat(step.view.rgb.mean(axis=-1, keepdims=True) / 255.0, 3, axis=2) * 0.45 + 0.5
    surface = step.labels == SUPPORT_LABEL
    part = (step.labels > 0) & ~surface
    tint = colours.label_colours(step.labels) / 255.0
    first, second = grey.copy(), grey.copy()
    first[surface] = 0.35 * grey[surface] + 0.65 * tint[surface]
    second[part] = tint[part]
    for panel, image, title in ((left, first, "the support surface"), (right, second, "the parts on it")):
        panel.imshow(image[90:390, 80:560])
        panel.set_title(title, fontsize=10)
        panel.axis("off")
    for item in on_table(step.graph):
        v, u = np.nonzero(step.labels == item.label)
        if len(u):
            plate(right, np.array([np.median(u) - 80, np.median(v) - 90]), item)
    return png(figure, 256)


def draw_shapes(story: Story) -> bytes:
    """Points, and the shapes fitted to them."""
    figure, (left, right) = panels(2)
    eye = first_eye(story)
    show_points(left, story.steps[0].cloud, eye)
    left.set_title("points of the first view, from the side", fontsize=10)
    show_shapes(right, on_table(story.steps[0].graph), story.top, eye)
    right.set_title("the shapes that explain them", fontsize=10)
    return png(figure, 256)


def first_eye(story: Story, size: tuple[int, int] = SIZE) -> Eye:
    """An eye that sees what the first view saw, a little from the side."""
    radius = 0.3 * max(1.0, 0.88 * SIZE[0] / SIZE[1] * size[1] / size[0])
    return eye_from(222.0, 30.0, np.array([-0.04, -0.06, story.top + 0.09]), radius, size)


def draw_contacts(story: Story) -> bytes:
    """Contacts with their separating planes."""
    figure, (left, right) = panels(2)
    graph = story.steps[-1].graph
    show_shapes(left, on_table(graph), story.top, story.eye, pale=0.35)
    show_planes(left, [s for s in graph.supports if s.certain], story.eye)
    left.set_title("certain supports: planes and their normals", fontsize=10)
    show_shapes(right, on_table(graph), story.top, story.eye, pale=0.35)
    show_planes(right, [s for s in graph.supports if not s.certain], story.eye)
    right.set_title("uncertain ones: leaning, and held from above", fontsize=10)
    return png(figure, 256)


def draw_graph(story: Story) -> bytes:
    """The support graph."""
    figure, (left, right) = panels(2)
    graph = story.steps[-1].graph
    show_shapes(left, on_table(graph), story.top, story.eye)
    left.set_title("the shapes after four views", fontsize=10)
    show_graph(right, graph, counts=False)
    right.set_title("what holds up what: certain, and uncertain (dashed)", fontsize=10)
    return png(figure, 256)


def draw_fusion(story: Story) -> bytes:
    """How the graph grows."""
    figure, axes = panels(3, 380, 330)
    for panel, step in zip(axes, (story.steps[0], story.steps[1], story.steps[3]), strict=True):
        show_graph(panel, step.graph)
        panel.set_title(f"after view {step.index + 1}", fontsize=10)
    return png(figure, 256)


def draw_interest(story: Story) -> bytes:
    """Points of interest and the saliency they give the sphere."""
    figure, (left, right) = panels(2, SQUARE, SQUARE)
    decision = decided(story, "attention")
    eye = first_eye(story, (SQUARE, SQUARE))
    show_shapes(left, on_table(story.steps[0].graph), story.top, eye, pale=0.45)
    show_interest(left, decision.points_of_interest, eye)
    left.set_title("points of interest, with their rays to the sphere", fontsize=10)
    show_on_sphere(right, story, decision)
    right.set_title("saliency on the view sphere, from above", fontsize=10)
    return png(figure)


def draw_next(story: Story) -> bytes:
    """The next best view of the default planner."""
    figure, (left, right) = panels(2, SQUARE, SQUARE)
    decision, following = story.steps[0].decision, story.steps[1].view
    assert decision is not None
    assert following is not None
    assert following.rgb is not None
    show_on_sphere(left, story, decision)
    left.set_title("what each view would show anew, less the way there", fontsize=10)
    right.imshow(following.rgb[50:430, 140:520])
    right.set_title("the view that was chosen", fontsize=10)
    right.axis("off")
    return png(figure)


def draw_order(story: Story) -> bytes:
    """A safe order to take everything away."""
    graph = story.steps[-1].graph
    order = plan_order(graph, Config())
    left = {o.id: o for o in on_table(graph)}
    count = 4
    figure, axes = plt.subplots(2, count, figsize=(11.2, 4.9), dpi=DPI)
    figure.subplots_adjust(0.004, 0.004, 0.996, 0.95, wspace=0.02, hspace=0.1)
    small = Eye(story.eye.T_world_camera, np.diag([0.5, 0.5, 1.0]) @ story.eye.K, SIZE[0] // 2, SIZE[1] // 2)
    for number, (panel, step) in enumerate(zip(axes.ravel(), order.steps, strict=True)):
        items = list(left.values())
        taken = [o.id == step.object_id for o in items]
        shade = [colour_of(o) if t else (0.8, 0.8, 0.8) for o, t in zip(items, taken, strict=True)]
        image, seen = draw_solids([o.shape for o in items], shade, story.top, small)
        panel.imshow(image)
        v, u = np.nonzero(seen == taken.index(True))
        plate(panel, np.array([np.median(u), np.median(v)]), left.pop(step.object_id), 8.0)
        framed(panel, small)
        held = f", hold {', '.join(step.hold)}" if step.hold else ""
        panel.set_title(f"{number + 1}: take {step.object_id}{held}", fontsize=9)
    return png(figure, 256)


def decided(story: Story, planner: str) -> Decision:
    """What a planner chooses after the first view."""
    return make_planner(planner).plan(story.state, np.random.default_rng(0))


def show_on_sphere(panel: Any, story: Story, decision: Decision) -> None:
    """Show a decision after the first view on the sphere."""
    show_sphere(panel, story.state.sphere, decision, story.state.visited, story.state.candidates.indices)


PICTURES: Mapping[str, Callable[[Story], bytes]] = {
    "view": draw_view,
    "parts": draw_parts,
    "shapes": draw_shapes,
    "contacts": draw_contacts,
    "graph": draw_graph,
    "fusion": draw_fusion,
    "interest": draw_interest,
    "next": draw_next,
    "order": draw_order,
}


@dataclass(frozen=True)
class Args:
    """Draw the pictures of docs/concepts.md."""

    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """Pictures. [default: all]"""
    out: Path = FOLDER
    """Folder to write to."""


def main(args: Args) -> int:
    """Explore the scene and draw."""
    matplotlib.use("agg")
    unknown = sorted(set(args.names) - set(PICTURES))
    if unknown:
        sys.stderr.write(f"error: there is no picture '{unknown[0]}'; there are {', '.join(PICTURES)}\n")
        return 1
    story = tell()
    args.out.mkdir(parents=True, exist_ok=True)
    for name in args.names or PICTURES:
        content = PICTURES[name](story)
        (args.out / f"{name}.png").write_bytes(content)
        print(f"{name}: {len(content) / 1000:.0f} kB")
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Args)))
