"""The 3D scene of a step, drawn with viser's primitives."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from caryatid.config import GripperConfig
from caryatid.exploration import RobotPose, Step
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Sphere
from caryatid.geometry.transforms import Array
from caryatid.graph import Grasp, SupportGraph, TakeStep
from caryatid.manipulation.grasps import gripper_boxes, turn_of
from caryatid.planning.decision import Decision
from caryatid.scene import Scene
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.sensing.views import Cloud, View
from caryatid.viz.colours import SALIENCY_STOPS, Colour, label_colours, object_colour, rgb, scale
from caryatid.viz.drawings import image_of, named_objects
from caryatid.viz.scene_3d import support_ends
from caryatid.viz.tables import count_of

LAYERS = {
    "shapes": (True, "Fitted shapes"),
    "names": (True, "Ids of the objects"),
    "supports": (True, "What supports what, as arrows"),
    "cameras": (True, "Where the views were taken, and the next"),
    "gripper": (True, "How the gripper takes the first object of the order, or the one chosen"),
    "grid": (True, "10 cm under the support surface, and the axes of the world"),
    "cloud": (False, "The points of all views"),
    "sphere": (False, "Where the camera can go; red = worth looking from"),
    "interest": (False, "What is worth looking at, and from where"),
    "robot": (False, "Where the robot stood, and the way it came"),
}
"""Layers that can be shown and hidden: whether they are visible at first, and what they show."""
SURE, DOUBTFUL = (26, 32, 40), (196, 78, 12)
"""Colours of supports; doubtful ones are dashed too."""
EARLIER, NEXT, BY_HAND = (128, 136, 146), (11, 92, 148), (170, 30, 120)
"""Colours of earlier views, the planner's choice, and one by hand."""
EARLIER_POINTS = 10_000
"""Points kept of the cloud of an earlier view, so that 200 views take less than 100 MB [1]."""
ARROW = {"shaft_radius": 0.0035, "head_radius": 0.0095, "head_length": 0.02}
"""Sizes of an arrow [m]."""
OPACITY, FAINT = 0.55, 0.2
"""Of objects, through which arrows can be seen; and of all that is not chosen [1]."""
SCREEN: dict[str, Any] = {"thickness": 1.6, "thickness_units": "screen"}
MATT: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False}


def reduce_step(step: Step) -> Step:
    """Return the step reduced to what is drawn of it, so that the page can keep every step."""
    view, cloud, candidates, decision = step.view, step.cloud, step.candidates, step.decision
    labels: Any = step.labels[:0]
    if view is not None:
        every = max(1, view.depth.shape[1] // 320)
        view = replace(view, labels=None, normals_camera=None, ignored=None).every(every)
        labels = step.labels[::every, ::every].astype(np.uint16, order="C")  # Up to SUPPORT_LABEL.
    points: Any = cloud.points_world.astype(np.float32)
    cloud = replace(cloud, points_world=points, normals_world=np.zeros(points.shape, np.int8))
    upper = step.sphere.directions[step.sphere.directions[:, 2] > 0.0]
    # A copy, because a slice would keep all of them.
    sphere = replace(step.sphere, directions=upper[:: max(1, len(upper) // 900)].copy())
    if candidates is not None:
        none = candidates.T_world_camera[:0]
        candidates = replace(candidates, T_world_camera=none, path_length=none[:, 0, 0], indices=None)
    if decision is not None:
        decision = replace(decision, sphere_saliency=None)
    drawn = replace(step, view=view, labels=labels, cloud=cloud)
    return replace(drawn, sphere=sphere, candidates=candidates, decision=decision)


def thin_cloud(step: Step) -> Step:
    """Return the step with at most `EARLIER_POINTS` of its cloud."""
    every = -(-len(step.cloud) // EARLIER_POINTS)
    return step if every < 2 else replace(step, cloud=step.cloud.select(np.arange(0, len(step.cloud), every)))


def step_of_scene(scene: Scene) -> Step:
    """What a scene of at least one view knows now; it need not have been explored."""
    sphere = scene.sphere or ViewSphere.around(np.zeros(3), scene.config.active)
    labels = np.zeros(0, dtype=np.int32) if scene.labels is None else scene.labels
    seen_from = scene.T_world_camera
    visited = np.zeros((0, 3)) if seen_from is None else sphere.direction_of(seen_from)[None]
    name = f"after {count_of(scene.views, 'view')}"
    known = (scene.graph, scene.cloud, sphere, visited)
    return Step(scene.views - 1, name, None, labels, *known, None, None, {}, 0.0, 0.0, None)


def take_away(step: Step, gone: Collection[str], lifted: str, T_world_world: Mapping[str, Array]) -> Step:
    """Return a step as it looks while an object is being lifted, others are gone, and some moved by T (4, 4).

    Shapes that have moved leave their points behind, and so their points are not shown.
    """
    graph, cloud, still = step.graph, step.cloud, np.eye(4)
    objects = tuple(
        replace(o, shape=o.shape.moved(T_world_world.get(o.id, still)))
        for o in graph.objects
        if o.id not in gone
    )
    supports = tuple(
        replace(s, contact_world=None, normal_world=None)
        for s in graph.supports
        if not {s.supporter, s.supported} & {lifted, *gone}
    )
    moved = {i for i, T in T_world_world.items() if np.abs(T - still).max() > 2e-3}
    away = [o.label for o in graph.objects if o.id in {*gone, *moved}]
    if away and cloud.labels is not None:
        cloud = cloud.select(~np.isin(cloud.labels, away))
    shown = replace(graph, objects=objects, supports=supports)
    return replace(step, graph=shown, cloud=cloud, decision=None, candidates=None)


class SceneDrawing:
    """The page's scene; a layer is sent when it is shown, and again only when what it shows has changed.

    Args:
        server: A `viser.ViserServer`.
        clicked: Called with the id of an object whose shape is clicked.

    Attributes:
        nodes: What the browser shows, by layer, or layer and camera.
    """

    def __init__(self, server: Any, clicked: Callable[[str], None]) -> None:
        self._server, self._scene, self._clicked = server, server.scene, clicked
        self._frames = {
            name: self._scene.add_frame(f"/{name}", show_axes=False, visible=shown)
            for name, (shown, _) in LAYERS.items()
        }
        self._shown: dict[str, tuple[Any, ...]] = {}
        self._looks: dict[str, dict[str, Any]] = {}
        self.nodes: dict[str, list[Any]] = {name: [] for name in LAYERS}

    def show_layer(self, name: str, visible: bool) -> None:
        """Show or hide a layer; what it shows is sent with the next `show`."""
        self._frames[name].visible = visible

    def show(
        self,
        step: Step,
        steps: Sequence[Step],
        *,
        chosen: str = "",
        order: Sequence[str] = (),
        lift: TakeStep | None = None,
        gripper: GripperConfig | None = None,
        point_size: float = 0.003,
        true_colours: bool = False,
    ) -> None:
        """Show a step, with the cameras of all steps so far, in place of the one before.

        An object may stand out, objects may have their places in an order, and a gripper may be at a lift's
        grasp; points have a diameter [m], and their objects' colours or their own.
        """
        graph, decision = step.graph, step.decision
        chosen = chosen if any(o.id == chosen for o in graph.objects) else ""
        surfaces = np.concatenate([np.zeros((0, 3)), *(o.shape.outline() for o in graph.support_surfaces)])
        heights = min(surfaces[:, 2], default=0.0), max(surfaces[:, 2], default=0.0) + 0.002
        layers: dict[str, tuple[Any, ...]] = {
            "cloud": (_draw_cloud, step.cloud, point_size, true_colours),
            "shapes": (_draw_shapes, graph, chosen),
            "names": (_draw_names, graph, tuple(order)),
            "supports": (_draw_supports, graph, chosen),
            "gripper": (_draw_gripper, None if lift is None else lift.grasp, gripper),
            "grid": (_draw_grid, *heights),
            "sphere": (_draw_sphere, step.sphere, step.candidates, decision),
            "interest": (_draw_interest, step.sphere, decision),
            "robot": (_draw_robot, step.robot, steps[-2] if len(steps) > 1 else None),
        }
        for each in steps:
            colour = SURE if each is steps[-1] else EARLIER
            layers[f"cameras/{each.index + 1}"] = _draw_camera, f"{each.index + 1}", each.view, None, colour
        if decision is not None and step.stop is None:
            colour = BY_HAND if decision.why == "chosen by hand" else NEXT
            layers["cameras/next"] = _draw_camera, "next", steps[-1].view, decision, colour
        with self._server.atomic():
            for name in self._shown.keys() - layers.keys():
                self._send(name, {})
                del self._shown[name], self.nodes[name]
            for name, shown in layers.items():
                if self._frames[name.partition("/")[0]].visible and self._shown.get(name) != shown:
                    draw, *known = shown
                    self._send(name, {node: (add, look) for add, node, look in draw(*known)})
                    self._shown[name] = shown

    def _send(self, layer: str, wanted: dict[str, tuple[str, dict[str, Any]]]) -> None:
        """Have a layer consist of these nodes.

        Known ones are changed where they differ, which costs least, and a slow browser would replace them
        one by one, and meanwhile show some where they are and others where they were.
        """
        known = {node.name: node for node in self.nodes.get(layer, [])}
        for name in [each for each in reversed(known) if each not in wanted]:  # Edges before their shape.
            known.pop(name).remove()
            del self._looks[name]
        for name, (add, look) in wanted.items():
            if name not in known:
                known[name] = getattr(self._scene, f"add_{add}")(name, **look)
                if add == "mesh_simple":
                    object_id = name.rpartition("/")[2]
                    known[name].on_click(lambda _, object_id=object_id: self._clicked(object_id))
            else:
                before = self._looks[name]
                for key, value in look.items():
                    if value is not before[key] and not np.array_equal(value, before[key]):
                        setattr(known[name], key, value)
            self._looks[name] = look
        self.nodes[layer] = [known[name] for name in wanted]


# Layers: of each node how viser adds it, its name, and what it looks like

Nodes = Iterator[tuple[str, str, dict[str, Any]]]


def _draw_points(name: str, points: Array, colours: NDArray[np.uint8], size: float) -> Nodes:
    """Points (N, 3); they are sent as half floats, and so counted from their middle."""
    middle = points.mean(axis=0)
    look = {"points": (points - middle).astype(np.float32), "colors": colours, "position": middle}
    yield "point_cloud", name, look | {"point_size": size, "point_shape": "circle", "point_shading": "flat"}


def _draw_label(name: str, text: str, at: Array) -> Nodes:
    look = {"text": text, "position": at, "anchor": "center-center", "font_screen_scale": 1.1}
    yield "label", name, look


def _draw_lines(name: str, ends: Array, colours: Any, **look: Any) -> Nodes:
    """Line segments (N, 2, 3), if there are any."""
    if len(ends):
        yield "line_segments", name, {"points": ends, "colors": np.array(colours, dtype=np.uint8)} | look


def _draw_cloud(cloud: Cloud, size: float, true_colours: bool) -> Nodes:
    if len(cloud):
        labels = np.zeros(len(cloud), dtype=np.int32) if cloud.labels is None else cloud.labels
        colours = cloud.rgb if true_colours and cloud.rgb is not None else label_colours(labels)
        yield from _draw_points("/cloud/points", cloud.points_world, colours, size)


UNIT_SOLIDS = Box, Cylinder, Sphere
"""Shapes that differ only in scale, so that the browser keeps their mesh when they are fitted anew."""


@lru_cache(64)
def _solid_of(shape: Any) -> tuple[Array, Array, Array]:
    """Vertices (V, 3), faces (F, 3) and ends of edges (E, 2, 3) in the frame of a shape, or of one of 1 m."""
    if shape in UNIT_SOLIDS:
        shape = shape.from_extents(np.eye(4), np.ones(3))
    mesh, T_object_world = shape.mesh(), transforms.invert(shape.T_world_object)
    return mesh.vertices, mesh.faces, transforms.transform(T_object_world, shape.creases())


def _draw_shapes(graph: SupportGraph, chosen: str) -> Nodes:
    """Shapes and their edges, which are part of them; where one is chosen, the others are faint."""
    for item in graph.objects:
        shape, name, colour = item.shape, f"/shapes/{item.id}", rgb(object_colour(item.label))
        kind: Any = type(shape)
        simple = kind in UNIT_SOLIDS
        vertices, faces, ends = _solid_of(kind if simple else shape)
        size = {"scale": tuple(shape.extents.tolist()) if simple else (1.0, 1.0, 1.0)}
        faint, strong = chosen not in (item.id, ""), OPACITY if item.role == "object" else 1.0
        look = {"vertices": vertices, "faces": faces, "color": colour, "side": "double"} | size
        look |= {"opacity": FAINT if faint else strong, "flat_shading": shape.kind == "box"}
        yield "mesh_simple", name, look | _pose(shape.T_world_object) | MATT
        dark = 0.55 * np.array(colour) + 100.0 * faint
        yield from _draw_lines(f"{name}/edges", ends, dark, **size, **SCREEN)


def _draw_names(graph: SupportGraph, order: tuple[str, ...]) -> Nodes:
    """Names and ids, after their places in an order."""
    places = {name: f"{number}. " for number, name in enumerate(order, start=1)}
    for item in named_objects(graph):
        text = places.get(item.id, "") + item.title
        yield from _draw_label(f"/names/{item.id}", text, item.centre_world)


def _draw_gripper(grasp: Grasp | None, gripper: GripperConfig | None) -> Nodes:
    """The gripper at a grasp."""
    if grasp is None or gripper is None:
        return
    T_world_boxes = grasp.T_world_gripper @ transforms.invert(turn_of(gripper))
    for number, (low, high) in enumerate(gripper_boxes(gripper, grasp.width)):
        place = T_world_boxes @ transforms.rigid(np.eye(3), (low + high) / 2.0)
        look: dict[str, Any] = {"dimensions": tuple(high - low), "color": EARLIER, "opacity": 0.7}
        yield "box", f"/gripper/part {number}", look | _pose(place) | MATT


def _draw_grid(height: float, top: float) -> Nodes:
    """A grid below everything, and the world's x and y axes at the height of the surface."""
    look: dict[str, Any] = {"width": 4.0, "height": 4.0, "cell_size": 0.1, "section_size": 0.5}
    look |= {"cell_color": EARLIER, "section_color": EARLIER, "cell_thickness": 0.3}
    look |= {"section_thickness": 0.6, "shadow_opacity": 0.0}
    yield "grid", "/grid/lines", look | {"position": (0.0, 0.0, height - 0.001)}
    axes = np.array([(0.0, 0.0, top)] * 2 + [(0.1, 0.0, top), (0.0, 0.1, top)]).reshape(2, 2, 3)
    colours = np.array([[(200, 40, 40)] * 2, [(40, 140, 40)] * 2], dtype=np.uint8)
    yield from _draw_lines("/grid/axes", axes.swapaxes(0, 1), colours, **SCREEN)


def _draw_supports(graph: SupportGraph, chosen: str) -> Nodes:
    """Arrows at contacts, which show through the shapes: of surfaces if doubtful, or of the one chosen."""
    for number, support in enumerate(graph.supports):
        from_surface = graph[support.supporter].role == "support_surface"
        if chosen not in support.pair if chosen else from_surface and not support.doubtful:
            continue
        start, end = support_ends(support, graph)
        along = end - start
        length = float(np.linalg.norm(along))
        if length < 1e-6:
            continue
        colour, share = DOUBTFUL if support.doubtful else SURE, max(support.belief, 0.3)
        neck = start
        if support.doubtful:
            neck = end - min(2.0 * ARROW["head_length"] / length, 0.5) * along
            count = max(2, round(float(np.linalg.norm(neck - start)) / 0.016))
            dashes, wide = np.linspace(start, neck, 2 * count).reshape(-1, 2, 3), 0.007 * share
            yield from _draw_lines(f"/supports/dashes {number}", dashes, DOUBTFUL, thickness=wide)
        look: dict[str, Any] = ARROW | {
            "shaft_radius": share * ARROW["shaft_radius"],
            "colors": np.array(colour),
        }
        yield "arrows", f"/supports/arrow {number}", look | {"points": np.array([[neck, end]])}
        kind = "" if support.kind == "bottom-up" else f"{support.kind} "
        if kind or support.belief < 0.995:
            text, middle = f"{kind}{support.belief:.2f}", (start + end) / 2.0
            yield from _draw_label(f"/supports/probability {number}", text, middle)


def _draw_sphere(sphere: ViewSphere, candidates: Any, decision: Any) -> Nodes:
    """Where the camera can go, painted with saliency; where it cannot, pale and only above the table."""
    pale = np.full(sphere.directions.shape, (206, 209, 213), dtype=np.uint8)
    yield from _draw_points("/sphere/beyond", sphere.positions_world, pale, 0.005)
    if candidates is not None and len(candidates):
        few = candidates.looks(10_000).chosen
        rated = None if decision is None else decision.candidate_saliency
        # Planners differ in what they count in: the largest, of either sign, gets the end of the scale.
        largest = 0.0 if rated is None else float(np.abs(rated).max(initial=0.0))
        saliency = np.zeros(len(few)) if rated is None or largest == 0.0 else rated[few] / largest
        at = sphere.centre_world + sphere.radius * candidates.directions[few]
        colours = scale(saliency, SALIENCY_STOPS)
        yield from _draw_points("/sphere/reachable", at, colours, 0.01 if len(few) > 100 else 0.04)


def _draw_interest(sphere: ViewSphere, decision: Any) -> Nodes:
    """Points of interest where they are, joined to where on the view sphere they are seen best."""
    points = () if decision is None else decision.points_of_interest
    if points:
        at = np.array([p.position_world for p in points])
        colours = scale(np.array([p.saliency for p in points]), SALIENCY_STOPS)
        ends = sphere.centre_world + sphere.radius * np.array([p.direction for p in points])
        both = np.repeat(colours[:, None], 2, axis=1)
        yield from _draw_points("/interest/points", at, colours, 0.02)
        yield from _draw_lines("/interest/rays", np.stack([at, ends], axis=1), both, **SCREEN)


def _draw_camera(name: str, view: View | None, following: Decision | None, colour: Colour) -> Nodes:
    """A view's camera with what it saw, or the camera at the next view."""
    T_world_camera = None if following is None else following.T_world_camera
    look: dict[str, Any] = {"variant": "filled", "scale": 0.05}
    if view is not None and following is None:
        T_world_camera = view.T_world_camera
        look = {"image": image_of(view), "format": "jpeg", "variant": "wireframe"}
        look["scale"] = 0.06 if colour == SURE else 0.04
    if view is None or T_world_camera is None:
        return
    height, width = view.depth.shape
    look |= {"fov": 2.0 * float(np.arctan2(height / 2.0, view.K[1, 1])), "aspect": width / height}
    yield (
        "camera_frustum",
        f"/cameras/{name}",
        look | {"color": colour} | _pose(T_world_camera) | SCREEN | MATT,
    )
    yield from _draw_label(f"/cameras/name {name}", name, T_world_camera[:3, 3] + [0.0, 0.0, 0.06])


def _draw_robot(robot: RobotPose | None, before: Step | None) -> Nodes:
    """The robot's base with links to its camera, and the way it came."""
    if robot is None:
        return
    (x, y, _), eye = robot.posture.platform_world, robot.T_world_camera[:3, 3]
    foot = np.array([x, y, eye[2] - robot.posture.camera_height])
    elbow = (foot + eye) / 2.0 + (0.0, 0.0, 0.25) if robot.arm else np.array([x, y, eye[2]])
    look: dict[str, Any] = {"radius": 0.08 if robot.arm else robot.footprint, "height": 0.2, "color": SURE}
    yield "cylinder", "/robot/base", look | {"position": foot + (0.0, 0.0, 0.1)} | MATT
    links = np.array([[foot, elbow], [elbow, eye]])
    yield from _draw_lines("/robot/links", links, EARLIER, thickness=0.1)
    stops = () if before is None or before.decision is None else before.decision.waypoints
    way = np.array([[*stop.platform_world[:2], foot[2]] for stop in stops]).reshape(-1, 3)
    yield from _draw_lines("/robot/way", np.stack([way[:-1], way[1:]], axis=1), SURE, **SCREEN)


def _pose(T_world: Array) -> dict[str, Any]:
    from viser.transforms import SO3

    return {"wxyz": SO3.from_matrix(T_world[:3, :3]).wxyz, "position": T_world[:3, 3]}
