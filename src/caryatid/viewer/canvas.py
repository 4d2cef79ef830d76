"""Drawings handed to the browser: only what has changed since the last one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np

from caryatid.geometry.transforms import Array
from caryatid.simulation.world import quaternion
from caryatid.viewer.marks import Copies, Drawing, Frustum, Label, Lines, Mark, Mesh, Points


class Canvas:
    """The page's scene.

    Args:
        server: A `viser.ViserServer`.
        layers: Layers that can be shown and hidden.
        clicked: Told the id of an object whose shape is clicked.
    """

    def __init__(self, server: Any, layers: tuple[str, ...], clicked: Callable[[str], None]) -> None:
        self._server = server
        self._clicked = clicked
        self._nodes: dict[str, Any] = {}
        self._drawn: Drawing = {}
        self._layers = {name: server.scene.add_frame(f"/{name}", show_axes=False) for name in layers}

    @property
    def drawn(self) -> Drawing:
        """What the browser shows."""
        return dict(self._drawn)

    def show(self, drawing: Drawing) -> None:
        """Show a drawing in place of the last one; marks that are as they were are not sent again."""
        with self._server.atomic():
            for name in self._drawn.keys() - drawing.keys():
                self._nodes.pop(name).remove()
            for name, mark in drawing.items():
                before = self._drawn.get(name)
                if before is not None and (same(before, mark) or _adjusted(self._nodes[name], before, mark)):
                    continue
                self._nodes[name] = self._put(f"/{name}", mark)
        self._drawn = dict(drawing)

    def show_layer(self, name: str, visible: bool) -> None:
        """Show or hide a layer."""
        self._layers[name].visible = visible

    def _put(self, name: str, mark: Mark) -> Any:
        scene = self._server.scene
        match mark:
            case Points():
                return scene.add_point_cloud(
                    name, mark.points, mark.colours, position=mark.origin_world, point_size=mark.size,
                    point_shape="circle", point_shading="flat",
                )  # fmt: skip
            case Mesh():
                node = scene.add_mesh_simple(
                    name, mark.vertices, mark.faces, color=mark.colour, opacity=mark.opacity,
                    flat_shading=mark.flat, side="double", cast_shadow=False, receive_shadow=False,
                    **_pose(mark.T_world_mesh),
                )  # fmt: skip
                if mark.object_id:
                    node.on_click(lambda _: self._clicked(mark.object_id))
                return node
            case Copies():
                return scene.add_batched_meshes_simple(
                    name, mark.vertices, mark.faces, mark.wxyz, mark.positions_world,
                    batched_scales=mark.scales, batched_colors=mark.colours, lod="off",
                    cast_shadow=False, receive_shadow=False,
                )  # fmt: skip
            case Lines():
                colours = np.repeat(mark.colours[:, None], 2, axis=1)
                return scene.add_line_segments(
                    name, mark.ends_world, colours, thickness=mark.width, thickness_units="screen"
                )
            case Frustum():
                return scene.add_camera_frustum(
                    name, mark.field_of_view, mark.aspect, scale=mark.size, thickness=1.6,
                    thickness_units="screen", color=mark.colour, image=mark.picture, format="jpeg",
                    cast_shadow=False, receive_shadow=False,
                    variant="filled" if mark.filled else "wireframe", **_pose(mark.T_world_camera),
                )  # fmt: skip
            case Label():
                return scene.add_label(
                    name, mark.text, position=mark.position_world, anchor="bottom-center",
                    font_screen_scale=0.85,
                )  # fmt: skip


def same(a: Mark, b: Mark) -> bool:
    """Whether two marks look the same."""
    if a is b or type(a) is not type(b):
        return a is b
    values = ((getattr(a, field.name), getattr(b, field.name)) for field in fields(a))
    return all(x is y or np.array_equal(x, y) for x, y in values)


def _adjusted(node: Any, before: Mark, mark: Mark) -> bool:
    """Change what is there where that takes less than putting it there anew; whether it did."""
    match before, mark:
        case Label(), Label() if before.text == mark.text:
            node.position = mark.position_world
        case Mesh(), Mesh() if before.colour == mark.colour and before.faces is mark.faces:
            node.position, node.wxyz = mark.T_world_mesh[:3, 3], quaternion(mark.T_world_mesh[:3, :3])
            if not np.array_equal(before.vertices, mark.vertices):
                node.vertices = mark.vertices
            if before.opacity != mark.opacity:
                node.opacity = mark.opacity
        case _:
            return False
    return True


def _pose(T: Array) -> dict[str, Array]:
    return {"wxyz": quaternion(T[:3, :3]), "position": T[:3, 3]}
