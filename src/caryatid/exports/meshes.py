"""A scene model for viewers: glTF, a node for each object."""

from __future__ import annotations

import numpy as np
import trimesh
from trimesh.exchange.gltf import export_glb, export_gltf
from trimesh.visual.material import PBRMaterial

from caryatid.config import ExportConfig
from caryatid.graph import SceneObject, SupportGraph
from caryatid.viz.colours import object_colour, rgb

WORLD = "z_up"
"""Name of the node whose frame is caryatid's world; the file itself has y up, as glTF wants."""
_T_FILE_WORLD = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


def to_gltf(graph: SupportGraph, config: ExportConfig, *, binary: bool = True) -> bytes:
    """Write a scene model as glTF: under the node `z_up` a node for each object, called as its id.

    Objects have the report's colours. Shape, size and role are in each mesh's extras.

    Args:
        graph: The scene model.
        config: How fine meshes are.
        binary: As one binary file (`.glb`), not as JSON (`.gltf`).
    """
    scene = trimesh.Scene(base_frame="file")
    scene.graph.update(frame_from="file", frame_to=WORLD, matrix=_T_FILE_WORLD)
    for item in graph.objects:
        mesh = item.shape.mesh(config.corners)
        mesh.visual = trimesh.visual.TextureVisuals(material=_material(item))
        mesh.metadata = {"role": item.role, "shape": item.shape.kind, "size": item.shape.size}
        T_world_object = item.shape.T_world_object
        scene.add_geometry(
            mesh, node_name=item.id, geom_name=item.id, parent_node_name=WORLD, transform=T_world_object
        )
    if binary:
        data: bytes = export_glb(scene)
        return data
    files = export_gltf(scene, embed_buffers=True)
    text: bytes = files["model.gltf"]
    return text


def _material(item: SceneObject) -> PBRMaterial:
    return PBRMaterial(
        name=item.id,
        baseColorFactor=[*rgb(object_colour(item.label)), 255],
        metallicFactor=0.0,
        roughnessFactor=0.8,
    )
