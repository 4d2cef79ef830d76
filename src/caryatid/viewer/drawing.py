"""The 3D scene of a step, drawn with viser's primitives."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from caryatid.config import GripperConfig
from caryatid.exploration import RobotPose, Step
from caryatid.geometry import transforms
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


def reduced(step: Step) -> Step:
    """The step reduced to what is drawn of it, so that the page can keep every step."""
    view, cloud, candidates, decision = step.view, step.cloud, step.candidates, step.decision
    labels = step.labels[:0]
    if view is not None:
        every = max(1, view.depth.shape[1] // 320)
        view = replace(view, labels=None, normals_camera=None, ignored=None).every(every)
        labels = np.ascontiguousarray(step.labels[::every, ::every])
    points: Any = cloud.points_world.astype(np.float32)
    cloud = replace(cloud, points_world=points, normals_world=np.zeros(points.shape, np.int8))
    upper = step.sphere.directions[step.sphere.directions[:, 2] > 0.0]
    sphere = replace(step.sphere, directions=upper[:: max(1, len(upper) // 900)])
    if candidates is not None:
        none = candidates.T_world_camera[:0]
        candidates = replace(candidates, T_world_camera=none, path_length=none[:, 0, 0], indices=None)
    if decision is not None:
        decision = replace(decision, sphere_saliency=None)
    drawn = replace(step, view=view, labels=labels, cloud=cloud)
    return replace(drawn, sphere=sphere, candidates=candidates, decision=decision)


def thinned(step: Step) -> Step:
    """The step with at most `EARLIER_POINTS` of its cloud."""
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


def without(step: Step, gone: Collection[str], lifted: str, T_world_world: Mapping[str, Array]) -> Step:
    """A step as it looks while an object is being lifted, others are gone, and some moved by T (4, 4).

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
        self._frames = {name: self._scene.add_frame(f"/{name}", show_axes=False) for name in LAYERS}
        for name, (shown, _) in LAYERS.items():
            self._frames[name].visible = shown
        self._shown: dict[str, tuple[object, ...]] = {}
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
        grasp; points have a diameter [m], and their
        objects' colours or their own.
        """
        decision = step.decision
        surfaces = np.concatenate(
            [np.zeros((0, 3)), *(o.shape.outline() for o in step.graph.support_surfaces)]
        )
        layers: dict[str, tuple[object, ...]] = {
            "cloud": (step.cloud, point_size, true_colours),
            "shapes": (step.graph, chosen if any(o.id == chosen for o in step.graph.objects) else ""),
            "names": (step.graph, tuple(order)),
            "supports": (step.graph,),
            "gripper": (None if lift is None else lift.grasp, gripper),
            "grid": (min(surfaces[:, 2], default=0.0), max(surfaces[:, 2], default=0.0) + 0.002),
            "sphere": (step.sphere, step.candidates, decision),
            "interest": (step.sphere, decision),
            "robot": (step.robot, steps[-2] if len(steps) > 1 else None),
        }
        for each in steps:
            colour = SURE if each is steps[-1] else EARLIER
            layers[f"cameras/{each.index + 1}"] = f"{each.index + 1}", each.view, None, colour
        if decision is not None and step.stop is None:
            colour = BY_HAND if decision.why == "chosen by hand" else NEXT
            layers["cameras/next"] = "next", steps[-1].view, decision, colour
        with self._server.atomic():
            for name in self._shown.keys() - layers.keys():
                del self._shown[name]
                self._remove(name)
                del self.nodes[name]
            for name, shown in layers.items():
                layer = name.partition("/")[0]
                if self._frames[layer].visible and self._shown.get(name) != shown:
                    if layer != "shapes":
                        self._remove(name)
                    self.nodes[name], self._shown[name] = getattr(self, f"_{layer}")(*shown), shown

    def _remove(self, name: str, kept: Sequence[Any] = ()) -> None:
        """Remove a layer's nodes from the scene, but those kept."""
        names = {node.name for node in kept}
        for node in reversed(self.nodes.get(name, [])):  # Edges before their shape.
            if node.name not in names:
                node.remove()

    def _points(self, name: str, points: Array, colours: NDArray[np.uint8], size: float) -> Any:
        """Points (N, 3); they are sent as half floats, and so counted from their middle."""
        middle = points.mean(axis=0)
        return self._scene.add_point_cloud(
            name, (points - middle).astype(np.float32), colours, position=middle, point_size=size,
            point_shape="circle", point_shading="flat",
        )  # fmt: skip

    def _cloud(self, cloud: Cloud, size: float, true_colours: bool) -> list[Any]:
        if len(cloud) == 0:
            return []
        labels = np.zeros(len(cloud), dtype=np.int32) if cloud.labels is None else cloud.labels
        colours = cloud.rgb if true_colours and cloud.rgb is not None else label_colours(labels)
        return [self._points("/cloud/points", cloud.points_world, colours, size)]

    def _shapes(self, graph: SupportGraph, chosen: str) -> list[Any]:
        """Shapes and their edges; where one is chosen, the others are faint.

        Known shapes are changed in place, and edges are part of them: a slow browser replaces shapes one by
        one, and meanwhile shows some where they are and others where they were.
        """
        known, nodes = {node.name: node for node in self.nodes["shapes"]}, []
        for item in graph.objects:
            mesh, T_world_object = item.shape.mesh(), item.shape.T_world_object
            name, colour = f"/shapes/{item.id}", rgb(object_colour(item.label))
            look = {"vertices": mesh.vertices, "faces": mesh.faces, "color": colour}
            strong = OPACITY if item.role == "object" else 1.0
            look |= {"opacity": strong if chosen in (item.id, "") else FAINT} | _pose(T_world_object)
            look["flat_shading"] = item.shape.kind == "box"
            ends = transforms.transform(transforms.invert(T_world_object), item.shape.creases())
            dark = (0.55 * np.array(colour)).astype(np.uint8)
            if name in known:
                nodes.append(_changed(known[name], look))
            else:
                nodes.append(self._scene.add_mesh_simple(name, side="double", **look, **MATT))
                nodes[-1].on_click(lambda _, name=item.id: self._clicked(name))
            edges = f"{name}/edges"
            if edges in known and len(ends):
                nodes.append(_changed(known[edges], {"points": ends, "colors": dark}))
            else:
                nodes += self._lines(edges, ends, dark, **SCREEN)
        self._remove("shapes", nodes)
        return nodes

    def _names(self, graph: SupportGraph, order: tuple[str, ...]) -> list[Any]:
        """Names and ids, after their places in an order."""
        places = {name: f"{number}. " for number, name in enumerate(order, start=1)}
        tags = [(item, places.get(item.id, "") + item.title) for item in named_objects(graph)]
        return [self._label(f"/names/{item.id}", text, item.centre_world) for item, text in tags]

    def _label(self, name: str, text: str, at: Array) -> Any:
        look: dict[str, Any] = {"anchor": "center-center", "font_screen_scale": 1.1}
        return self._scene.add_label(name, text, position=at, **look)

    def _lines(self, name: str, ends: Array, colours: Any, **look: Any) -> list[Any]:
        """Line segments (N, 2, 3), if there are any."""
        return [self._scene.add_line_segments(name, ends, colours, **look)] if len(ends) else []

    def _gripper(self, grasp: Grasp | None, gripper: GripperConfig | None) -> list[Any]:
        """The gripper at a grasp."""
        if grasp is None or gripper is None:
            return []
        T_world_boxes, nodes = grasp.T_world_gripper @ transforms.invert(turn_of(gripper)), []
        for number, (low, high) in enumerate(gripper_boxes(gripper, grasp.width)):
            place = T_world_boxes @ transforms.rigid(np.eye(3), (low + high) / 2.0)
            look: dict[str, Any] = {"dimensions": tuple(high - low), "opacity": 0.7} | _pose(place) | MATT
            nodes.append(self._scene.add_box(f"/gripper/part {number}", color=EARLIER, **look))
        return nodes

    def _grid(self, height: float, top: float) -> list[Any]:
        """A grid below everything, and the world's x and y axes at the height of the surface."""
        look: dict[str, Any] = {"width": 4.0, "height": 4.0, "cell_size": 0.1, "section_size": 0.5}
        look |= {"cell_color": (234, 236, 238), "section_color": (214, 217, 221), "shadow_opacity": 0.0}
        grid = self._scene.add_grid("/grid/lines", position=(0.0, 0.0, height - 0.001), **look)
        axes = np.array([(0.0, 0.0, top)] * 2 + [(0.1, 0.0, top), (0.0, 0.1, top)]).reshape(2, 2, 3)
        colours = np.array([[(200, 40, 40)] * 2, [(40, 140, 40)] * 2], dtype=np.uint8)
        return [grid, *self._lines("/grid/axes", axes.swapaxes(0, 1), colours, **SCREEN)]

    def _supports(self, graph: SupportGraph) -> list[Any]:
        """Arrows at contacts, which show through the shapes; of surfaces only if doubtful."""
        nodes: list[Any] = []
        for number, support in enumerate(graph.supports):
            if graph[support.supporter].role == "support_surface" and not support.doubtful:
                continue
            start, end = support_ends(support, graph)
            along = end - start
            length = float(np.linalg.norm(along))
            if length < 1e-6:
                continue
            colour, share = DOUBTFUL if support.doubtful else SURE, max(support.belief, 0.3)
            neck = start
            if support.doubtful:
                neck = end - min(2.0 * ARROW["head_length"] / length, 0.5) * (end - start)
                count = max(2, round(float(np.linalg.norm(neck - start)) / 0.016))
                dashes, wide = np.linspace(start, neck, 2 * count).reshape(-1, 2, 3), 0.007 * share
                nodes += self._lines(f"/supports/dashes {number}", dashes, DOUBTFUL, thickness=wide)
            look = ARROW | {"shaft_radius": share * ARROW["shaft_radius"]}
            points = np.array([[neck, end]])
            nodes.append(self._scene.add_arrows(f"/supports/arrow {number}", points, colour, **look))
            kind = "" if support.kind == "bottom-up" else f"{support.kind} "
            if kind or support.belief < 0.995:
                text = f"{kind}{support.belief:.2f}"
                nodes.append(self._label(f"/supports/probability {number}", text, (start + end) / 2.0))
        return nodes

    def _sphere(self, sphere: ViewSphere, candidates: Any, decision: Any) -> list[Any]:
        """Where the camera can go, painted with saliency; where it cannot, pale and only above the table."""
        pale = np.full(sphere.directions.shape, (206, 209, 213), dtype=np.uint8)
        nodes = [self._points("/sphere/beyond", sphere.positions_world, pale, 0.005)]
        if candidates is not None and len(candidates):
            few = candidates.looks(10_000).chosen
            rated = None if decision is None else decision.candidate_saliency
            # Planners differ in what they count in: the largest, of either sign, gets the end of the scale.
            largest = 0.0 if rated is None else float(np.abs(rated).max(initial=0.0))
            saliency = np.zeros(len(few)) if rated is None or largest == 0.0 else rated[few] / largest
            at = sphere.centre_world + sphere.radius * candidates.directions[few]
            colours = scale(saliency, SALIENCY_STOPS)
            nodes.append(self._points("/sphere/reachable", at, colours, 0.01 if len(few) > 100 else 0.04))
        return nodes

    def _interest(self, sphere: ViewSphere, decision: Any) -> list[Any]:
        """Points of interest where they are, joined to where on the view sphere they are seen best."""
        points = () if decision is None else decision.points_of_interest
        if not points:
            return []
        at = np.array([p.position_world for p in points])
        colours = scale(np.array([p.saliency for p in points]), SALIENCY_STOPS)
        ends = sphere.centre_world + sphere.radius * np.array([p.direction for p in points])
        both = np.repeat(colours[:, None], 2, axis=1)
        rays = self._lines("/interest/rays", np.stack([at, ends], axis=1), both, **SCREEN)
        return [self._points("/interest/points", at, colours, 0.02), *rays]

    def _cameras(self, name: str, view: View | None, following: Decision | None, colour: Colour) -> list[Any]:
        """A view's camera with what it saw, or the camera at the next view."""
        T_world_camera = None if following is None else following.T_world_camera
        look: dict[str, Any] = {"variant": "filled", "scale": 0.05}
        if view is not None and following is None:
            T_world_camera = view.T_world_camera
            look = {"image": image_of(view), "format": "jpeg", "variant": "wireframe"}
            look["scale"] = 0.06 if colour == SURE else 0.04
        if view is None or T_world_camera is None:
            return []
        height, width = view.depth.shape
        look |= _pose(T_world_camera) | SCREEN | MATT
        angle, shape = 2.0 * float(np.arctan2(height / 2.0, view.K[1, 1])), width / height
        frustum = self._scene.add_camera_frustum(f"/cameras/{name}", angle, shape, color=colour, **look)
        return [frustum, self._label(f"/cameras/name {name}", name, T_world_camera[:3, 3] + [0.0, 0.0, 0.06])]

    def _robot(self, robot: RobotPose | None, before: Step | None) -> list[Any]:
        """The robot's base with links to its camera, and the way it came."""
        if robot is None:
            return []
        (x, y, _), eye = robot.posture.platform_world, robot.T_world_camera[:3, 3]
        foot = np.array([x, y, eye[2] - robot.posture.camera_height])
        elbow = (foot + eye) / 2.0 + (0.0, 0.0, 0.25) if robot.arm else np.array([x, y, eye[2]])
        radius, place = 0.08 if robot.arm else robot.footprint, foot + (0.0, 0.0, 0.1)
        nodes = [self._scene.add_cylinder("/robot/base", radius, 0.2, SURE, position=place, **MATT)]
        nodes += self._lines("/robot/links", np.array([[foot, elbow], [elbow, eye]]), EARLIER, thickness=0.1)
        stops = () if before is None or before.decision is None else before.decision.waypoints
        way = np.array([[*stop.platform_world[:2], foot[2]] for stop in stops]).reshape(-1, 3)
        return nodes + self._lines("/robot/way", np.stack([way[:-1], way[1:]], axis=1), SURE, **SCREEN)


def _changed(node: Any, look: dict[str, Any]) -> Any:
    """A node with these properties; viser sends those that differ."""
    for name, value in look.items():
        setattr(node, name, value)
    return node


def _pose(T_world: Array) -> dict[str, Any]:
    from viser.transforms import SO3

    return {"wxyz": SO3.from_matrix(T_world[:3, :3]).wxyz, "position": T_world[:3, 3]}
