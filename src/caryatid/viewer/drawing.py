"""What the page's scene shows of a step, drawn with viser's own primitives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from caryatid.exploration import RobotPose, Step
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject, Support, SupportGraph
from caryatid.scene import Scene
from caryatid.sensing.view_sphere import ViewSphere
from caryatid.sensing.views import Cloud, View
from caryatid.viz.colours import DEPTH_STOPS, NOTHING_COLOUR, SALIENCY_STOPS, object_colour, rgb, scale

LAYERS = ("cloud", "shapes", "names", "supports", "sphere", "interest", "cameras", "robot")
"""What can be shown and hidden."""
MOST_POINTS, PICTURE_WIDTH = 1_000_000, 240
"""Points kept of a cloud at most, evenly picked, and width a camera's picture is reduced to [px]."""
OPACITY, CHOSEN_OPACITY, TABLE_OPACITY = 0.36, 0.7, 0.16
"""Of shapes: one sees the points and the arrows in them."""
CERTAIN, UNCERTAIN = (26, 32, 40), (196, 78, 12)
"""Colours of supports; uncertain ones are dashed too."""
SHAFT, HEAD, HEAD_LENGTH, KIND, DASH = 0.0035, 0.0095, 0.028, 0.011, 0.016
"""Radii of an arrow's shaft and head, length of its head, size of its kind's sign, length of a dash [m]."""
UNDER_TABLE = 0.07
"""How far below a contact an arrow begins whose supporter is the table [m]."""
SPHERE_DOTS, SPHERE_SIZE, BEYOND_DOTS = 10_000, 0.01, 900
"""Dots drawn of a whole view sphere, their size [m], and how many are drawn where the robot cannot go."""
EARLIER, NEXT, BY_HAND, BEYOND, ROBOT = (
    (128, 136, 146),
    (11, 92, 148),
    (170, 30, 120),
    (206, 209, 213),
    (120, 130, 142),
)
"""Colours of earlier views, the planner's choice, one by hand, where no view is possible, and the robot."""
CAMERA_SIZE = 0.09
"""Of a drawn camera [m]; the newest is larger by half."""


@dataclass(frozen=True, eq=False, slots=True)
class Moment:
    """What there is to see after one view.

    Attributes:
        step: What is known.
        score: F1 of vertices and edges together, or None where the ground truth is not known.
        by_hand: The next view was chosen by a person.
    """

    step: Step
    score: float | None = None
    by_hand: bool = False


def moment_of_scene(scene: Scene) -> Moment:
    """What a scene of at least one view knows now; it need not have been explored."""
    visited = np.zeros((0, 3))
    sphere = scene.sphere or ViewSphere.around(np.zeros(3), scene.config.active)
    labels = np.zeros(0, dtype=np.int32) if scene.labels is None else scene.labels
    if scene.T_world_camera is not None:
        visited = sphere.direction_of(scene.T_world_camera)[None]
    name = f"after {scene.views} view{'s' * (scene.views > 1)}"
    return Moment(
        Step(
            scene.views - 1,
            name,
            None,
            labels,
            scene.graph,
            scene.cloud,
            sphere,
            visited,
            None,
            None,
            {},
            0.0,
            0.0,
            None,
        )
    )


def reduced(step: Step) -> Step:
    """A step with no more of its cloud and image than is drawn, so that the page can keep every one."""
    view, cloud = step.view, step.cloud
    if len(cloud) > MOST_POINTS:
        kept = np.zeros(len(cloud), dtype=np.bool_)
        kept[:: -(-len(cloud) // MOST_POINTS)] = True
        cloud = cloud.select(kept)
    if view is not None:
        stride = max(1, view.depth.shape[1] // PICTURE_WIDTH)
        view = View(
            view.depth[::stride, ::stride].copy(),
            np.diag([1.0 / stride, 1.0 / stride, 1.0]) @ view.K,
            view.T_world_camera,
            None if view.rgb is None else view.rgb[::stride, ::stride].copy(),
            name=view.name,
        )
    return replace(step, view=view, cloud=cloud)


class SceneDrawing:
    """The page's scene; a layer is sent again only when what it shows has changed.

    Args:
        server: A `viser.ViserServer`.
        clicked: Called with the id of an object whose shape is clicked.
    """

    def __init__(self, server: Any, clicked: Callable[[str], None]) -> None:
        self._server, self._clicked = server, clicked
        self._frames = {name: server.scene.add_frame(f"/{name}", show_axes=False) for name in LAYERS}
        self._keys: dict[str, tuple[object, ...]] = {}
        self._nodes: dict[str, list[Any]] = {name: [] for name in LAYERS}

    @property
    def nodes(self) -> dict[str, list[Any]]:
        """What the browser shows, by layer."""
        return self._nodes

    def show_layer(self, name: str, visible: bool) -> None:
        """Show or hide a layer."""
        self._frames[name].visible = visible

    def show(
        self,
        moment: Moment,
        steps: Sequence[Step],
        *,
        chosen: str = "",
        point_size: float = 0.003,
        true_colours: bool = False,
    ) -> None:
        """Show a moment in place of the one before.

        Args:
            moment: What is known.
            steps: The steps so far, the newest last.
            chosen: Id of the object that stands out.
            point_size: Diameter of the cloud's points [m].
            true_colours: Points as the camera saw them, not in their objects' colours.
        """
        step = moment.step
        layers: dict[str, tuple[tuple[object, ...], Callable[[], list[Any]]]] = {
            "cloud": (
                (step.cloud, point_size, true_colours),
                lambda: self._cloud(step.cloud, point_size, true_colours),
            ),
            "shapes": ((step.graph, chosen), lambda: self._shapes(step.graph, chosen)),
            "names": ((step.graph,), lambda: self._names(step.graph)),
            "supports": ((step.graph,), lambda: self._supports(step.graph)),
            "sphere": ((step.sphere, step.candidates, step.decision), lambda: self._sphere(step)),
            "interest": ((step.sphere, step.decision), lambda: self._interest(step)),
            "cameras": ((*steps, step.decision, moment.by_hand), lambda: self._cameras(moment, steps)),
            "robot": ((step.robot,), lambda: [] if step.robot is None else self._robot(step.robot)),
        }
        with self._server.atomic():
            for name, (key, draw) in layers.items():
                if self._keys.get(name) != key:
                    for node in self._nodes[name]:
                        node.remove()
                    self._nodes[name], self._keys[name] = draw(), key

    def _points(self, name: str, points: Array, colours: NDArray[np.uint8], size: float) -> Any:
        """Points (N, 3); they are sent as half floats, and so counted from their middle."""
        middle = points.mean(axis=0)
        return self._server.scene.add_point_cloud(
            name, (points - middle).astype(np.float32), colours, position=middle, point_size=size,
            point_shape="circle", point_shading="flat",
        )  # fmt: skip

    def _cloud(self, cloud: Cloud, size: float, true_colours: bool) -> list[Any]:
        if len(cloud) == 0:
            return []
        colours = cloud.rgb if true_colours else None
        if colours is None:
            labels = np.zeros(len(cloud), dtype=np.uint16) if cloud.labels is None else cloud.labels
            table = np.zeros((65536, 3), dtype=np.uint8)
            for label in np.flatnonzero(np.bincount(labels, minlength=1)):
                table[label] = rgb(NOTHING_COLOUR if label == 0 else object_colour(int(label)))
            colours = table[labels]
        return [self._points("/cloud/points", cloud.points_world, colours, size)]

    def _shapes(self, graph: SupportGraph, chosen: str) -> list[Any]:
        nodes, outlines, colours = [], [], []
        for item in graph.objects:
            surface = item.role == "support_surface"
            opacity = TABLE_OPACITY if surface else CHOSEN_OPACITY if item.id == chosen else OPACITY
            body = self._body(item, f"/shapes/{item.id}", opacity=opacity, side="double")
            body.on_click(lambda _, name=item.id: self._clicked(name))
            nodes.append(body)
            edges = _edges(item)
            outlines.append(edges)
            dark = 0.55 * np.array(rgb(object_colour(item.label)))
            colours.append(np.tile(dark.astype(np.uint8), (len(edges), 2, 1)))
        if outlines:
            ends, paint = np.concatenate(outlines), np.concatenate(colours)
            add = self._server.scene.add_line_segments
            nodes.append(add("/shapes/outlines", ends, paint, thickness=1.6, thickness_units="screen"))
        return nodes

    def _body(self, item: SceneObject, name: str, **look: Any) -> Any:
        mesh = item.shape.mesh()
        look |= {"color": rgb(object_colour(item.label)), "cast_shadow": False, "receive_shadow": False}
        look |= {"flat_shading": item.shape.kind == "box"} | _pose(item.shape.T_world_object)
        return self._server.scene.add_mesh_simple(name, mesh.vertices, mesh.faces, **look)

    def _names(self, graph: SupportGraph) -> list[Any]:
        up = np.array([[0.0, 0.0, 1.0]])
        return [
            self._label(f"/names/{o.id}", o.id, o.centre_world + up[0] * float(o.shape.support(up)[0]))
            for o in graph.objects
            if o.role != "support_surface"
        ]

    def _label(self, name: str, text: str, at: Array) -> Any:
        return self._server.scene.add_label(
            name, text, position=at, anchor="bottom-center", font_screen_scale=0.85
        )

    def _arrows(self, name: str, ends: list[Array], colour: tuple[int, int, int]) -> list[Any]:
        if not ends:
            return []
        size = {"shaft_radius": SHAFT, "head_radius": HEAD, "head_length": HEAD_LENGTH}
        return [self._server.scene.add_arrows(name, np.array(ends), colour, **size)]

    def _supports(self, graph: SupportGraph) -> list[Any]:
        """Arrows from supporter to supported; a ball stands for leaning, a cube for weight from above."""
        scene, certain, uncertain, nodes = self._server.scene, [], [], []
        dashes: list[Array] = []
        for number, support in enumerate(graph.supports):
            start, end = _ends(support, graph)
            length = float(np.linalg.norm(end - start))
            if length < 1e-6:
                continue
            along = (end - start) / length
            if support.certain:
                certain.append(np.array([start, end]))
            else:
                neck = end - min(2.0 * HEAD_LENGTH, 0.5 * length) * along
                uncertain.append(np.array([neck, end]))
                count = max(2, round(float(np.linalg.norm(neck - start)) / DASH))
                stops = start + np.linspace(0.0, 1.0, 2 * count)[:, None] * (neck - start)
                dashes += list(stops.reshape(-1, 2, 3))
            colour = CERTAIN if support.certain else UNCERTAIN
            place = {"color": colour, "position": (start + end) / 2.0}
            if support.kind == "lean":
                nodes.append(scene.add_icosphere(f"/supports/lean {number}", radius=KIND, **place))
            elif support.kind == "top-down":
                nodes.append(
                    scene.add_box(f"/supports/top-down {number}", dimensions=(1.7 * KIND,) * 3, **place)
                )
        nodes += self._arrows("/supports/certain", certain, CERTAIN)
        nodes += self._arrows("/supports/uncertain", uncertain, UNCERTAIN)
        if dashes:
            nodes.append(
                scene.add_line_segments(
                    "/supports/dashes", np.array(dashes), UNCERTAIN, thickness=2.0 * SHAFT
                )
            )
        return nodes

    def _sphere(self, step: Step) -> list[Any]:
        """Where the camera can go, painted with saliency; where it cannot, pale and only above the table."""
        sphere, candidates = step.sphere, step.candidates
        above = sphere.positions_world[sphere.directions[:, 2] > 0.0]
        above = above[:: max(1, len(above) // BEYOND_DOTS)]
        pale = np.tile(np.array(BEYOND, dtype=np.uint8), (len(above), 1))
        nodes = [self._points("/sphere/beyond", above, pale, 0.5 * SPHERE_SIZE)]
        if candidates is not None and len(candidates):
            few = candidates.looks(SPHERE_DOTS).chosen
            rated = None if step.decision is None else step.decision.candidate_saliency
            # Planners differ in what they count in: the largest, of either sign, gets the end of the scale.
            largest = 0.0 if rated is None else float(np.abs(rated).max(initial=0.0))
            saliency = np.zeros(len(few)) if rated is None or largest == 0.0 else rated[few] / largest
            size = SPHERE_SIZE if len(few) > 100 else 4.0 * SPHERE_SIZE
            at = sphere.centre_world + sphere.radius * candidates.directions[few]
            nodes.append(self._points("/sphere/reachable", at, scale(saliency, SALIENCY_STOPS), size))
        return nodes

    def _interest(self, step: Step) -> list[Any]:
        """Points of interest where they are, joined to where on the view sphere they are seen best."""
        points = () if step.decision is None else step.decision.points_of_interest
        if not points:
            return []
        at = np.array([p.position_world for p in points])
        colours = scale(np.array([p.saliency for p in points]), SALIENCY_STOPS)
        ends = step.sphere.centre_world + step.sphere.radius * np.array([p.direction for p in points])
        rays = self._server.scene.add_line_segments(
            "/interest/rays", np.stack([at, ends], axis=1), np.repeat(colours[:, None], 2, axis=1),
            thickness=1.0, thickness_units="screen",
        )  # fmt: skip
        return [self._points("/interest/points", at, colours, 0.02), rays]

    def _cameras(self, moment: Moment, steps: Sequence[Step]) -> list[Any]:
        nodes: list[Any] = []
        views = [(step.index, step.view) for step in steps if step.view is not None]
        for number, view in views:
            if view.T_world_camera is not None:
                newest = number == steps[-1].index
                size, colour = (1.5 * CAMERA_SIZE, CERTAIN) if newest else (CAMERA_SIZE, EARLIER)
                look = {"image": _picture(view), "format": "jpeg", "variant": "wireframe"}
                nodes += self._camera(str(number), view, view.T_world_camera, size, colour, **look)
        if views and moment.step.decision is not None:
            colour = BY_HAND if moment.by_hand else NEXT
            T_world_camera = moment.step.decision.T_world_camera
            nodes += self._camera("next", views[-1][1], T_world_camera, CAMERA_SIZE, colour, variant="filled")
        return nodes

    def _camera(
        self,
        name: str,
        lens: View,
        T_world_camera: Array,
        size: float,
        colour: tuple[int, int, int],
        **look: Any,
    ) -> list[Any]:
        height, width = lens.depth.shape
        field_of_view = 2.0 * float(np.arctan2(height / 2.0, lens.K[1, 1]))
        frustum = self._server.scene.add_camera_frustum(
            f"/cameras/{name}", field_of_view, width / height, scale=size, thickness=1.6,
            thickness_units="screen", color=colour, cast_shadow=False,
            receive_shadow=False, **look, **_pose(T_world_camera),
        )  # fmt: skip
        return [frustum, self._label(f"/cameras/name {name}", name, T_world_camera[:3, 3] + [0.0, 0.0, 0.06])]

    def _robot(self, robot: RobotPose) -> list[Any]:
        """A platform, column and neck, or the base of an arm and its links."""
        scene, eye = self._server.scene, robot.T_world_camera[:3, 3]
        x, y, yaw = robot.posture.platform_world
        height, radius = (0.1, 0.08) if robot.arm else (0.3, robot.footprint)
        foot = np.array([x, y, max(0.0, eye[2] - robot.posture.camera_height)])
        top = foot + [0.0, 0.0, height]
        middle = (top + eye) / 2.0 + [0.0, 0.0, 0.25] if robot.arm else np.array([x, y, eye[2]])
        links = np.array([[top, middle], [middle, eye]])
        forward = np.array([np.cos(yaw), np.sin(yaw), 0.0])
        nose = np.array([top, top + 0.8 * radius * forward])
        place = {"position": foot + [0.0, 0.0, height / 2.0], "color": ROBOT}
        return [
            scene.add_cylinder("/robot/platform", radius=radius, height=height, **place),
            scene.add_line_segments("/robot/links", links, ROBOT, thickness=0.1),
            *self._arrows("/robot/front", [nose], CERTAIN),
        ]


def _edges(item: SceneObject) -> Array:
    """Lines (N, 2, 3) [m] along the edges and rims of a shape, wherever it is seen from."""
    mesh, T_world_object = item.shape.mesh(), item.shape.T_world_object
    if item.shape.kind == "sphere":
        return np.zeros((0, 2, 3))
    sharp = mesh.face_adjacency_edges[mesh.face_adjacency_angles > np.radians(30.0)]
    return np.stack([transforms.transform(T_world_object, mesh.vertices[ends]) for ends in sharp.T], axis=1)


def _ends(support: Support, graph: SupportGraph) -> tuple[Array, Array]:
    """Where an arrow begins and ends; from the table it rises to its supported object."""
    supporter, supported = graph[support.supporter], graph[support.supported]
    start, end, contact = supporter.centre_world, supported.centre_world, support.contact_world
    if supporter.role == "support_surface":
        start = np.array([*(end if contact is None else contact)[:2], start[2] - UNDER_TABLE])
    if supported.role == "support_surface":
        end = np.array([*(start if contact is None else contact)[:2], end[2]])
    return start, end


def _picture(view: View) -> NDArray[np.uint8]:
    """A view's image, or its depth in colours where it has none."""
    if view.rgb is not None:
        return view.rgb
    valid = view.depth > 0.0
    near, far = np.quantile(view.depth[valid], (0.02, 0.98)) if valid.any() else (0.0, 1.0)
    colours = scale((view.depth.astype(np.float64) - near) / max(float(far - near), 1e-6), DEPTH_STOPS)
    return np.where(valid[..., None], colours, np.uint8(0))


def _pose(T_world: Array) -> dict[str, Any]:
    from viser.transforms import SO3

    return {"wxyz": SO3.from_matrix(T_world[:3, :3]).wxyz, "position": T_world[:3, 3]}
