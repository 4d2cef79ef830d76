"""Shapes for simulators and 3D viewers: MJCF, URDF, USD and glTF."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from caryatid.config import ExportConfig
from caryatid.errors import InputError, needs_extra
from caryatid.geometry import transforms
from caryatid.geometry.shapes import Box, Cylinder, Shape, Sphere
from caryatid.geometry.solids import Solid
from caryatid.geometry.transforms import Array
from caryatid.graph import SceneObject, SupportGraph
from caryatid.viz.colours import object_colour, rgb, rgba
from caryatid.viz.scene_3d import make_scene


def to_mjcf(graph: SupportGraph, config: ExportConfig) -> str:
    """The static body `table`, others for further surfaces, and a free body per object, named by their ids.

    It is a scene to explore.

    Fitted shapes may overlap or hover by millimetres: objects settle by about as much when it is simulated.

    Raises:
        InputError: MuJoCo rejects the name of an object, or the number of objects.
    """
    import mujoco

    from caryatid.simulation.world import TABLE, Body, add_body, empty_spec, quaternion

    spec = empty_spec("caryatid")
    try:
        for item in graph.objects:
            if item.role == "object":
                add_body(spec, item.id, Body(item.shape, config.density, config.friction), rgba(item.label))
                continue
            R, size = item.shape.T_world_object[:3, :3], item.shape.extents / 2.0
            name = TABLE if item is graph.support_surface else item.id
            static = spec.worldbody.add_body(name=name, pos=item.centre_world, quat=quaternion(R))
            static.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, rgba=rgba(item.label))
        spec.compile()
        text: str = spec.to_xml()
        mujoco.MjModel.from_xml_string(text)
    except ValueError as error:
        reason = f"MuJoCo rejects it ({' '.join(str(error).split())})"
        raise InputError("the scene model", reason, "rename objects in graph.json") from error
    return text


def to_urdf(graph: SupportGraph, config: ExportConfig) -> str:
    """A link per object, named by its id, fixed to the link `world`; parts of a solid as boxes.

    Raises:
        InputError: An object has the name `world`.
    """
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
                    SubElement(material, "color", rgba=_numbers(*rgba(item.label)))
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


def _numbers(*values: float) -> str:
    return " ".join(f"{value + 0.0:.9g}" for value in values)


def to_usd(graph: SupportGraph, config: ExportConfig) -> str:
    """USD as text, in metres and with z up: an Xform with a rigid body per object, surfaces without one.

    Raises:
        InputError: usd-core (extra `usd`) is not installed.
    """
    with needs_extra("usd", "the format usd"):
        from pxr import Gf, Tf, Usd, UsdGeom, UsdPhysics, UsdShade

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    material = UsdShade.Material.Define(stage, "/World/Friction")
    friction = UsdPhysics.MaterialAPI.Apply(material.GetPrim())
    friction.CreateStaticFrictionAttr(config.friction)
    friction.CreateDynamicFrictionAttr(config.friction)
    for item in graph.objects:
        path = f"/World/{Tf.MakeValidIdentifier(item.id)}"
        while stage.GetPrimAtPath(path):
            path += "_"
        frame = UsdGeom.Xform.Define(stage, path)
        frame.AddTransformOp().Set(Gf.Matrix4d(item.shape.T_world_object.T.tolist()))
        body = frame.GetPrim()
        body.SetDisplayName(item.id)
        UsdShade.MaterialBindingAPI.Apply(body).Bind(material, materialPurpose="physics")
        if item.role == "object":
            UsdPhysics.RigidBodyAPI.Apply(body)
            UsdPhysics.MassAPI.Apply(body).CreateDensityAttr(config.density)
        for number, part in enumerate(item.shape.parts, start=1):
            place = f"{path}/part_{number}"
            match part:
                case Solid(polytopes=(hull,)):
                    drawn = UsdGeom.Mesh.Define(stage, place)
                    drawn.CreatePointsAttr(hull.vertices.tolist())
                    drawn.CreateFaceVertexCountsAttr([3] * len(hull.triangles))
                    drawn.CreateFaceVertexIndicesAttr(hull.triangles.ravel().tolist())
                    drawn.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
                    collision = UsdPhysics.MeshCollisionAPI.Apply(drawn.GetPrim())
                    collision.CreateApproximationAttr(UsdPhysics.Tokens.convexHull)
                case Cylinder(radius=radius, height=height):
                    drawn = UsdGeom.Cylinder.Define(stage, place)
                    drawn.CreateRadiusAttr(radius)
                    drawn.CreateHeightAttr(height)
                case Sphere(radius=radius):
                    drawn = UsdGeom.Sphere.Define(stage, place)
                    drawn.CreateRadiusAttr(radius)
                case _:
                    drawn = UsdGeom.Cube.Define(stage, place)
                    drawn.CreateSizeAttr(1.0)
                    drawn.AddScaleOp().Set(Gf.Vec3f(*part.extents.tolist()))
            drawn.CreateExtentAttr(UsdGeom.Boundable.ComputeExtentFromPlugins(drawn, Usd.TimeCode.Default()))
            drawn.CreateDisplayColorAttr([rgba(item.label)[:3]])
            UsdPhysics.CollisionAPI.Apply(drawn.GetPrim())
    text: str = stage.GetRootLayer().ExportToString()
    return text


def to_gltf(graph: SupportGraph, config: ExportConfig, *, binary: bool) -> bytes:
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
