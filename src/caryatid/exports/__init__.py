"""A scene model for other programs: MJCF, URDF, glTF, GraphML and DOT."""

from __future__ import annotations

from typing import TYPE_CHECKING

from caryatid.runtime.late import imported_late

if TYPE_CHECKING:
    from caryatid.exports.graphs import to_dot, to_graphml
    from caryatid.exports.meshes import to_gltf
    from caryatid.exports.models import to_mjcf, to_urdf
    from caryatid.exports.writing import export_graph

__all__ = ["export_graph", "to_dot", "to_gltf", "to_graphml", "to_mjcf", "to_urdf"]

if not TYPE_CHECKING:
    __getattr__ = imported_late(
        __name__,
        {
            "graphs": ["to_dot", "to_graphml"],
            "meshes": ["to_gltf"],
            "models": ["to_mjcf", "to_urdf"],
            "writing": ["export_graph"],
        },
    )


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
