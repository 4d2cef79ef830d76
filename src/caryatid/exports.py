"""A scene model for other programs: MJCF, URDF, glTF, GraphML and DOT."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from caryatid.config import ExportConfig, ExportFormat
from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Shape, Sphere
from caryatid.geometry.solids import Solid
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject, SupportGraph
from caryatid.io.staging import write_file
from caryatid.viz.colours import ink_on, object_colour, rgb
from caryatid.viz.scene_3d import make_scene

ENDINGS: Final[dict[str, ExportFormat]] = {
    ".xml": "mjcf",
    ".urdf": "urdf",
    ".glb": "gltf",
    ".gltf": "gltf",
    ".graphml": "graphml",
    ".dot": "dot",
    ".gv": "dot",
}
"""File suffix → format."""


def format_of(path: Path, wanted: ExportFormat | None = None) -> ExportFormat:
    """The format of a file by its suffix.

    Raises:
        InputError: The suffix is unknown, or not that of the wanted format.
    """
    found = ENDINGS.get(path.suffix.lower())
    if found is None or wanted not in (None, found):
        endings = [ending for ending, format_ in ENDINGS.items() if wanted in (None, format_)]
        reason = f"the suffix is not that of {wanted or 'any format'}"
        raise InputError(path, reason, f"use {', '.join(endings)}")
    return found


def export_graph(graph: SupportGraph, path: str | Path, config: ExportConfig | None = None) -> None:
    """Write a scene model in the format of the file's suffix, whole or not at all; replace an existing file.

    Raises:
        InputError: The suffix is unknown, there is nothing to export or too much, the format rejects the
            name of an object, or the file cannot be written.
    """
    path, config = Path(path), config or ExportConfig()
    chosen = format_of(path)
    if not graph.objects:
        raise InputError("the scene model", "has no objects", "give a graph with objects")
    if len(graph.objects) > config.max_objects:
        reason = f"has {len(graph.objects):,} objects, more than export.max_objects = {config.max_objects:,}"
        raise InputError("the scene model", reason, "raise that setting")
    match chosen:
        case "mjcf":
            content = _mjcf(graph, config).encode()
        case "urdf":
            content = _urdf(graph, config).encode()
        case "gltf":
            content = _gltf(graph, config, binary=path.suffix.lower() == ".glb")
        case "graphml":
            content = _graphml(graph).encode()
        case "dot":
            content = to_dot(graph).encode()
    write_file(path, content)


def _mjcf(graph: SupportGraph, config: ExportConfig) -> str:
    """The static body `table`, others for further surfaces, and a free body per object, named by their ids.

    It is a scene to explore.

    Fitted shapes may overlap or hover by millimetres: objects settle by about as much when it is simulated.
    """
    import mujoco

    from caryatid.simulation.world import TABLE, Body, add_body, empty_spec, quaternion

    spec = empty_spec("caryatid")
    try:
        for item in graph.objects:
            if item.role == "object":
                add_body(spec, item.id, Body(item.shape, config.density, config.friction), _rgba(item))
                continue
            R, size = item.shape.T_world_object[:3, :3], item.shape.extents / 2.0
            name = TABLE if item is graph.support_surface else item.id
            static = spec.worldbody.add_body(name=name, pos=item.centre_world, quat=quaternion(R))
            static.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, rgba=_rgba(item))
        spec.compile()
        text: str = spec.to_xml()
        mujoco.MjModel.from_xml_string(text)
    except ValueError as error:
        reason = f"MuJoCo rejects it ({' '.join(str(error).split())})"
        raise InputError("the scene model", reason, "rename objects in graph.json") from error
    return text


def _urdf(graph: SupportGraph, config: ExportConfig) -> str:
    """A link per object, named by its id, fixed to the link `world`; parts of a solid as boxes."""
    robot = Element("robot", name="caryatid")
    SubElement(robot, "link", name="world")
    for item in graph.objects:
        if item.id == "world":
            raise InputError("the scene model", "an object is named 'world'", "rename it in graph.json")
        link = SubElement(robot, "link", name=item.id)
        mass, moments = config.density * item.shape.volume, item.shape.moments
        inertial = SubElement(link, "inertial")
        SubElement(inertial, "mass", value=_numbers(mass))
        diagonal = {name: _numbers(mass * m) for name, m in zip(("ixx", "iyy", "izz"), moments, strict=True)}
        SubElement(inertial, "inertia", diagonal | dict.fromkeys(("ixy", "ixz", "iyz"), "0"))
        for what in ("visual", "collision"):
            for shape in _boxes(item.shape):
                element = SubElement(link, what)
                if shape is not item.shape:
                    SubElement(element, "origin", _pose(shape.T_world_object))
                geometry = SubElement(element, "geometry")
                match shape:
                    case Cylinder(radius=radius, height=height):
                        SubElement(geometry, "cylinder", radius=_numbers(radius), length=_numbers(height))
                    case Sphere(radius=radius):
                        SubElement(geometry, "sphere", radius=_numbers(radius))
                    case _:
                        SubElement(geometry, "box", size=_numbers(*shape.extents))
                if what == "visual":
                    material = SubElement(element, "material", name=f"colour of {item.id}")
                    SubElement(material, "color", rgba=_numbers(*_rgba(item)))
        joint = SubElement(robot, "joint", name=f"world_to_{item.id}", type="fixed")
        SubElement(joint, "parent", link="world")
        SubElement(joint, "child", link=item.id)
        SubElement(joint, "origin", _pose(item.shape.T_world_object))
    indent(robot)
    return tostring(robot, encoding="unicode", xml_declaration=True) + "\n"


def _boxes(shape: Shape) -> Sequence[Shape]:
    """A shape for URDF: itself, or the smallest box around each part, in the shape's frame."""
    if not isinstance(shape, Solid):
        return [shape]
    import trimesh

    bounds = (trimesh.bounds.oriented_bounds(part.vertices) for part in shape.polytopes)
    return [Box(transforms.invert(T_box_object), extents) for T_box_object, extents in bounds]


def _pose(T: Array) -> dict[str, str]:
    """A pose (4, 4) as URDF writes it."""
    from scipy.spatial.transform import Rotation

    with warnings.catch_warnings():
        # Straight up or down, many roll-pitch-yaw angles fit; SciPy warns and takes one.
        warnings.simplefilter("ignore", UserWarning)
        angles = Rotation.from_matrix(T[:3, :3]).as_euler("xyz")
    return {"xyz": _numbers(*T[:3, 3]), "rpy": _numbers(*angles)}


def _rgba(item: SceneObject) -> tuple[float, float, float, float]:
    """The report's colour of an object, 0 … 1."""
    red, green, blue = rgb(object_colour(item.label))
    return red / 255.0, green / 255.0, blue / 255.0, 1.0


def _numbers(*values: float) -> str:
    return " ".join(f"{value + 0.0:.9g}" for value in values)


def _gltf(graph: SupportGraph, config: ExportConfig, *, binary: bool) -> bytes:
    """A node per object, named by its id, in the report's colour."""
    from trimesh.exchange.gltf import export_glb, export_gltf
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    def look(item: SceneObject) -> TextureVisuals:
        colour = [*rgb(object_colour(item.label)), 255]
        known = {"baseColorFactor": colour, "metallicFactor": 0.0, "roughnessFactor": 0.8}
        return TextureVisuals(material=PBRMaterial(name=item.id, **known))

    scene = make_scene(graph, look, config.corners)
    content: bytes = export_glb(scene) if binary else export_gltf(scene, embed_buffers=True)["model.gltf"]
    return content


def _graphml(graph: SupportGraph) -> str:
    """Edges run from supporter to supported; sizes and centres x, y, z of vertices are in metres."""
    import networkx as nx

    plain = nx.DiGraph()
    for item in graph.objects:
        x, y, z = item.centre_world.tolist()
        size = list(item.shape.extents) if isinstance(item.shape, Solid) else item.shape.size
        lengths = size.values() if isinstance(size, Mapping) else size
        attributes: dict[str, Any] = {"role": item.role, "label": item.label, "shape": item.shape.kind}
        attributes |= {"size": " ".join(f"{length:.6g}" for length in lengths), "x": x, "y": y, "z": z}
        attributes["colour"] = object_colour(item.label)
        attributes |= {"occurrences": item.occurrences, "opportunities": item.opportunities}
        plain.add_node(item.id, **attributes)
    for support in graph.supports:
        names = ("kind", "certain", "occurrences", "opportunities")
        known = {} if support.probability is None else {"probability": support.probability}
        plain.add_edge(*support.pair, **known, **{name: getattr(support, name) for name in names})
    return "\n".join(nx.generate_graphml(plain)) + "\n"


def to_dot(graph: SupportGraph) -> str:
    """Write the support graph as DOT, drawn as in the report: surfaces below, doubtful supports dashed."""
    lines = ["digraph supports {", "  rankdir=BT;", '  node [style=filled, fontname="sans-serif"];']
    for item in graph.objects:
        colour = object_colour(item.label)
        attributes: dict[str, Any] = {
            "label": item.id if item.role == "object" else f"{item.id} · support surface",
            "shape": {"cylinder": "cylinder", "sphere": "circle"}.get(item.shape.kind, "box"),
            "fillcolor": colour,
            "fontcolor": ink_on(colour),
            "tooltip": f"{item.shape.kind}, found in {item.occurrences} of {item.opportunities} views",
        }
        lines.append(f"  {_quoted(item.id)} [{_listed(attributes)}];")
    for support in graph.supports:
        attributes = {
            "style": "dashed" if support.doubtful else "solid",
            "penwidth": f"{max(0.6, 2.4 * support.belief):.2f}",
            "label": f"{'' if support.kind == 'bottom-up' else f'{support.kind} '}{support.belief:.2f}",
            "tooltip": f"{support.kind}, found in {support.occurrences} of {support.opportunities} views",
        }
        ends = " -> ".join(_quoted(name) for name in support.pair)
        lines.append(f"  {ends} [{_listed(attributes)}];")
    return "\n".join([*lines, "}"]) + "\n"


def _listed(attributes: Mapping[str, str]) -> str:
    return ", ".join(f"{name}={_quoted(value)}" for name, value in attributes.items())


def _quoted(text: str) -> str:
    """A quoted string of DOT: backslashes begin escapes in what is shown, quotes end it."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + " ".join(escaped.splitlines()) + '"'
