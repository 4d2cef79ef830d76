"""A scene model for simulators: MJCF of free bodies on a table, URDF of links fixed to the world."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import mujoco
from scipy.spatial.transform import Rotation

from caryatid.config import ExportConfig
from caryatid.errors import InputError
from caryatid.geometry.shapes import Cylinder, Shape, Sphere
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject, SupportGraph
from caryatid.simulation.world import TABLE, Solid, add_solid, quaternion
from caryatid.viz.colours import object_colour, rgb

WORLD = "world"
"""Name of a URDF's root link."""


def to_mjcf(graph: SupportGraph, config: ExportConfig) -> str:
    """Write a scene model as MJCF: the static body `table`, and a free body for each object, named by its id.

    It is a scene caryatid explores, too. Shapes that were fitted may overlap or hover by millimetres: objects
    settle by about as much when it is simulated.

    Args:
        graph: The scene model.
        config: Density and friction.

    Raises:
        InputError: MuJoCo does not take the model, because of a name for example.
    """
    spec = mujoco.MjSpec()
    spec.modelname = "caryatid"
    spec.option.impratio = 10.0
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    try:
        for item in graph.objects:
            if item.role == "support_surface":
                _add_surface(spec, item)
            else:
                add_solid(spec, item.id, Solid(item.shape, config.density, config.friction), _rgba(item))
        spec.compile()
        text: str = spec.to_xml()
        mujoco.MjModel.from_xml_string(text)
    except ValueError as error:
        reason = f"MuJoCo does not take it ({' '.join(str(error).split())})"
        raise InputError("the scene model", reason, "rename objects in graph.json") from error
    return text


def to_urdf(graph: SupportGraph, config: ExportConfig) -> str:
    """Write a scene model as URDF: a link for each object, called as its id, fixed to the link `world`.

    Args:
        graph: The scene model.
        config: Density.

    Raises:
        InputError: An object is called `world`.
    """
    robot = Element("robot", name="caryatid")
    SubElement(robot, "link", name=WORLD)
    for item in graph.objects:
        if item.id == WORLD:
            raise InputError("the scene model", f"an object is called '{WORLD}'", "rename it in graph.json")
        link = SubElement(robot, "link", name=item.id)
        _add_inertia(link, item.shape, config.density)
        for part in ("visual", "collision"):
            geometry = SubElement(SubElement(link, part), "geometry")
            SubElement(geometry, *_urdf_shape(item.shape))
        material = SubElement(link[1], "material", name=f"colour of {item.id}")
        SubElement(material, "color", rgba=_numbers(_rgba(item)))
        joint = SubElement(robot, "joint", name=f"{WORLD}_to_{item.id}", type="fixed")
        SubElement(joint, "parent", link=WORLD)
        SubElement(joint, "child", link=item.id)
        T_world_object = item.shape.T_world_object
        SubElement(joint, "origin", xyz=_numbers(T_world_object[:3, 3]), rpy=_numbers(_rpy(T_world_object)))
    indent(robot)
    return tostring(robot, encoding="unicode", xml_declaration=True) + "\n"


def _add_surface(spec: mujoco.MjSpec, item: SceneObject) -> None:
    T_world_object = item.shape.T_world_object
    table = spec.worldbody.add_body(
        name=TABLE, pos=T_world_object[:3, 3], quat=quaternion(T_world_object[:3, :3])
    )
    table.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=item.shape.extents / 2.0, rgba=_rgba(item))


def _urdf_shape(shape: Shape) -> tuple[str, dict[str, str]]:
    match shape:
        case Cylinder():
            return "cylinder", {"radius": f"{shape.radius:.9g}", "length": f"{shape.height:.9g}"}
        case Sphere():
            return "sphere", {"radius": f"{shape.radius:.9g}"}
    return "box", {"size": _numbers(shape.extents)}


def _add_inertia(link: Element, shape: Shape, density: float) -> None:
    mass = density * shape.volume
    inertial = SubElement(link, "inertial")
    SubElement(inertial, "mass", value=f"{mass:.9g}")
    diagonal = dict(zip(("ixx", "iyy", "izz"), (f"{mass * m:.9g}" for m in shape.moments), strict=True))
    aside_of: Mapping[str, str] = dict.fromkeys(("ixy", "ixz", "iyz"), "0")
    SubElement(inertial, "inertia", {**diagonal, **aside_of})


def _rpy(T_world_object: Array) -> Array:
    """Roll, pitch and yaw (3,) [rad] about the world's x, y and z."""
    with warnings.catch_warnings():
        # Straight up or down there are many; scipy says so and takes one.
        warnings.simplefilter("ignore", UserWarning)
        angles: Array = Rotation.from_matrix(T_world_object[:3, :3]).as_euler("xyz")
    return angles


def _rgba(item: SceneObject) -> tuple[float, float, float, float]:
    """The report's colour of an object, 0 … 1."""
    red, green, blue = rgb(object_colour(item.label))
    return red / 255.0, green / 255.0, blue / 255.0, 1.0


def _numbers(values: Array | tuple[float, ...]) -> str:
    return " ".join(f"{value + 0.0:.9g}" for value in values)
