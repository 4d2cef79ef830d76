"""The model in 3D: as a scene for glTF, and as a page that needs nothing else, trimesh's own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject, Support, SupportGraph
from caryatid.sensing.view_sphere import direction
from caryatid.viz.colours import Colour, ink_on, object_colour, rgb
from caryatid.viz.drawings import named_objects
from caryatid.viz.pictures import THEME

if TYPE_CHECKING:
    import trimesh
    from trimesh.visual import TextureVisuals

LETTER = 0.024
"""Height of a name plate [m]."""
_CONTROLS = """<style> body { background: none; } canvas { visibility: hidden; } p { position: absolute;
top: 0; margin: 8px; color: #5d666f; font: 13px system-ui, sans-serif; }</style>
<p hidden>Drag to rotate, scroll to zoom. Arrows are visible through objects; orange: doubtful.
<button onclick="controls.reset()">Reset</button></p><script> const told = document.querySelector('p');
function shown() { if (!window.controls) { requestAnimationFrame(shown); return; }
controls.target0.copy(controls.target); render(); told.hidden = false;
document.querySelector('canvas').style.visibility = 'visible'; document.body.style.background = 'white'; }
if (document.createElement('canvas').getContext('webgl2')) new IntersectionObserver(([page]) =>
page.isIntersecting && told.hidden && shown()).observe(document.documentElement);
else { told.textContent = 'This browser cannot show 3D: WebGL is missing or disabled.'; told.hidden = false; }
</script>"""
"""Shows the shapes once they are in sight, and until then what is behind the page; or says why it cannot."""


def make_scene(
    graph: SupportGraph, look: Callable[[SceneObject], TextureVisuals], corners: int = 48
) -> trimesh.Scene:
    """Make the node `z_up`, and under it a node for the shape of each object, named by its id.

    Args:
        graph: The objects.
        look: Returns the look of an object's mesh.
        corners: Number of corners of circles.
    """
    import trimesh

    # glTF has y up; the frame of the node `z_up` is caryatid's world.
    T_file_world = [[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]
    scene = trimesh.Scene(base_frame="file")
    scene.graph.update(frame_from="file", frame_to="z_up", matrix=T_file_world)
    for item in graph.objects:
        mesh = item.shape.mesh(corners)
        mesh.visual = look(item)
        mesh.metadata = {"role": item.role, "shape": item.shape.kind, "size": item.shape.size}
        _add(scene, item.id, mesh, item.shape.T_world_object)
    return scene


def _add(scene: trimesh.Scene, name: str, mesh: trimesh.Trimesh, T_world_mesh: Array | None = None) -> None:
    scene.add_geometry(mesh, name, name, parent_node_name="z_up", transform=T_world_mesh)


def scene_3d_html(graph: SupportGraph, azimuth: float) -> str:
    """Write a page on which the mouse turns the shapes, with arrows from supporter to supported.

    Objects are translucent, so that arrows show through them. Arrows are the thicker the more probable their
    support is; doubtful ones have another colour. Each object has its name on two opposite sides.

    Args:
        graph: The shapes and their supports, of at least one object.
        azimuth: Direction about the vertical from which it is seen at first [rad].
    """
    import trimesh
    from trimesh.viewer.notebook import scene_to_html

    found = graph.movable or graph.objects
    points = np.concatenate([item.shape.outline() for item in found])

    def shown(item: SceneObject) -> SceneObject:
        """Of a surface, only what is below or above objects: the page turns about the middle of all."""
        if item.role == "object":
            return item
        T, half = item.shape.T_world_object, item.shape.extents / 2.0
        own = transforms.transform(transforms.invert(T), points)
        low = np.clip(own.min(axis=0) - 0.05, -half, half - 0.05)
        high = np.clip(own.max(axis=0) + 0.05, low + 0.05, np.maximum(half, low + 0.05))
        low[2], high[2] = half[2] - 0.01, half[2]
        return replace(item, shape=Box(T @ transforms.rigid(np.eye(3), (low + high) / 2.0), high - low))

    def look(item: SceneObject) -> TextureVisuals:
        return _material(rgb(object_colour(item.label)), 150 if item.role == "object" else 255)

    scene = make_scene(replace(graph, objects=tuple(map(shown, graph.objects))), look)
    for item in named_objects(graph):
        for side, turn in (("front", 0.0), ("back", np.pi)):
            _add(scene, f"name of {item.id}, {side}", *_plate(shown(item), azimuth + turn))
    for number, support in enumerate(graph.supports):
        arrow = support_arrow(support, graph)
        if arrow is not None:
            arrow.visual = _material(rgb(THEME["doubt" if support.doubtful else "ink"]), 255)
            _add(scene, f"support {number}", arrow)
    centre, (x, height, y) = scene.bounds.mean(axis=0), np.ptp(scene.bounds, axis=0).tolist()
    # From 25° above, all fits into 26° of sight at 1.9 times this distance.
    reach = max(x, y, 1.2 * height + 0.5 * max(x, y))
    forward = direction(azimuth, np.deg2rad(25.0))
    eye = centre + 1.9 * reach * np.array([forward[0], forward[2], -forward[1]])
    scene.camera = trimesh.scene.Camera(name="camera", resolution=(1200, 460), fov=(60.0, 26.0))
    T_file_camera = transforms.look_at(eye, centre, (0.0, 1.0, 0.0))
    scene.camera_transform = T_file_camera @ np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL looks along −z.
    page: str = scene_to_html(scene)
    return page.replace("</body>", f"{_CONTROLS}</body>")


def support_ends(support: Support, graph: SupportGraph) -> tuple[Array, Array]:
    """Where the arrow of a support begins and ends (3,): up to 3 cm on both sides of its contact.

    That of a support surface begins on it. Where the contact is unknown, it runs from centre to centre.
    """
    ends, along = [graph[support.supporter], graph[support.supported]], support.normal_world
    start, end, surface = ends[0].centre_world, ends[1].centre_world, ends[0].role == "support_surface"
    if support.contact_world is not None and along is not None:
        low, high = (along * min(0.03, np.ptp(o.shape.outline() @ along) / 2.0) for o in ends)
        return support.contact_world - (not surface) * low, support.contact_world + high
    if surface:
        start = np.array([*end[:2], start[2] + ends[0].shape.extents.min() / 2.0])
    return start, end


def _material(colour: Colour, opacity: int) -> TextureVisuals:
    """A matt colour 0 … 255 of an opacity 0 … 255, a third of it without light; the page's lamp is strong."""
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    look: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    look |= {"alphaMode": "OPAQUE" if opacity == 255 else "BLEND"}
    lit, unlit = [round(0.4 * c) for c in colour], [0.35 * c / 255.0 for c in colour]
    return TextureVisuals(material=PBRMaterial(baseColorFactor=[*lit, opacity], emissiveFactor=unlit, **look))


def support_arrow(support: Support, graph: SupportGraph) -> trimesh.Trimesh | None:
    """Make the mesh of the arrow of a support in the world: the thicker the more probable it is."""
    return make_arrow(*support_ends(support, graph), 0.0035 * max(support.belief, 0.3))


def make_arrow(start: Array, end: Array, radius: float) -> trimesh.Trimesh | None:
    """Make the mesh of an arrow between two points (3,) [m], or None where it has no length."""
    import trimesh

    along = end - start
    length = float(np.linalg.norm(along))
    if length < 1e-6:
        return None
    head = min(8.0 * radius, 0.5 * length)
    neck = end - head * along / length
    T_world_head = trimesh.geometry.align_vectors([0.0, 0.0, 1.0], along)
    T_world_head[:3, 3] = neck
    tip = trimesh.creation.cone(2.7 * radius, head, sections=16, transform=T_world_head)
    return trimesh.creation.cylinder(radius, segment=[start, neck], sections=12) + tip


def name_plate(name: str, label: int) -> Image.Image:
    """Draw the name of an object on a plate of the colour of its label."""
    colour = object_colour(label)
    image = Image.new("RGB", (24 + 32 * len(name), 72), colour)
    font, middle = ImageFont.load_default(52), (image.width / 2.0, 36.0)
    ImageDraw.Draw(image).text(middle, name, ink_on(colour), font, anchor="mm")
    ImageDraw.Draw(image).rectangle((0, 0, image.width - 1, 71), outline="white", width=4)
    return image


def _plate(item: SceneObject, azimuth: float) -> tuple[trimesh.Trimesh, Array]:
    """A name plate before an object, and its pose (4, 4); it cannot be seen from behind."""
    import trimesh
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    image = name_plate(item.id, item.label)
    image = image.point(lambda value: 255.0 * (value / 255.0) ** 0.45)  # The page shows textures linearly.
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    corners = np.column_stack([(uv - 0.5) * LETTER * (image.width / 72.0, 1.0), np.zeros(4)])
    look = PBRMaterial(emissiveTexture=image, emissiveFactor=[1.0] * 3, baseColorFactor=[0, 0, 0, 255])
    out, up = direction(azimuth, 0.0), np.array([0.0, 0.0, 1.0])
    reach = float(item.shape.support(out[None])[0])
    if item.role == "support_surface":  # Beyond a corner the plate would hang in the air: to the edge.
        across = np.abs(item.shape.T_world_object[:3, :2].T @ out)
        reach = float((item.shape.extents[:2] / 2.0 / np.maximum(across, 1e-9)).min())
    before = item.centre_world + (reach + 0.001) * out
    T_world_plate = transforms.rigid(np.column_stack([np.cross(up, out), up, out]), before)
    visual = TextureVisuals(uv=uv, material=look)
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False), T_world_plate
