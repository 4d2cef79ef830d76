"""What people use today, each behind one call; what cannot be imported raises."""

from __future__ import annotations

import random
import re
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.sensing.views import View

OPEN3D, PYRANSAC3D, CGAL = "open3d", "pyransac3d", "CGAL.CGAL_Shape_detection"
DISTRIBUTIONS = {OPEN3D: "open3d", PYRANSAC3D: "pyransac3d", CGAL: "cgal"}
"""Module → the package of the registry it comes with."""

VOXEL = 0.005
"""Edge of the voxels Open3D's chain thins by [m]."""
PLANE = (0.01, 3, 1000)
"""Threshold [m], points of a sample and iterations of its plane."""
CLUSTER = (0.015, 10)
"""Reach [m] and fewest points of its clusters."""

THRESHOLD = 0.004
"""Distance within which points belong to a shape [m]: 4σ."""
ITERATIONS = 1000
"""Of pyransac3d: its default for spheres; those for cuboids and cylinders are 5 and 10 times as many."""
CGAL_SHARE = 0.3
"""Share of the points a shape of CGAL's has at least: less makes it look for more shapes than the one."""
CGAL_GAP = 0.05
"""Distance beyond which points of one shape are two for CGAL [m]: wide, there is one; it is fastest so."""
CGAL_NORMAL = 0.9
"""Cosine of the angle between a point's normal and the shape's for CGAL; its default."""
CGAL_MISS = 0.01
"""Probability that CGAL overlooks a larger shape; its default."""
NEIGHBOURS = 20
"""Points a normal is estimated from."""

_FOLDERS = re.compile(r"(?<![\w.])/(?:[^/\s'\"()]+/)+")
_NUMBER = r"(-?[\d.]+(?:e[+-]?\d+)?)"
_TRIPLE = rf"\({_NUMBER}, {_NUMBER}, {_NUMBER}\)"


Estimate = dict[str, Any]
"""What a fitter says of a shape: `axis` (3,), `radius` [m] or `extents` (3,) [m]; or nothing."""


def told(error: BaseException) -> str:
    """What an error says, in one line, without the folders of this machine."""
    return _FOLDERS.sub("", " ".join(str(error).split())) or type(error).__name__


def versions() -> str:
    """The peers' versions, or that they are not there."""
    named = []
    for module, name in DISTRIBUTIONS.items():
        try:
            named.append(f"{name} {version(name)}")
            import_module(module)
        except PackageNotFoundError:
            named.append(f"{name} not installed")
        except (ImportError, OSError):
            named[-1] += " (broken)"
    return ", ".join(named)


def _open3d() -> Any:
    """Open3D, told to say errors only; it warns of every box that cannot be turned."""
    o3d = import_module(OPEN3D)
    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    return o3d


def open3d_chain(view: View, max_depth: float) -> Callable[[], int]:
    """Open3D from the depth image to a box a cluster.

    Args:
        view: Depth [m] and intrinsics [px].
        max_depth: Readings beyond count for nothing [m].

    Returns:
        The call; it returns how many boxes there are.
    """
    o3d = _open3d()
    height, width = view.depth.shape
    K = o3d.camera.PinholeCameraIntrinsic(
        width, height, view.K[0, 0], view.K[1, 1], view.K[0, 2], view.K[1, 2]
    )

    def chain() -> int:
        image = o3d.geometry.Image(view.depth)
        cloud = o3d.geometry.PointCloud.create_from_depth_image(
            image, K, depth_scale=1.0, depth_trunc=max_depth
        )
        cloud = cloud.voxel_down_sample(VOXEL)
        _, table = cloud.segment_plane(*PLANE)
        rest = cloud.select_by_index(table, invert=True)
        clusters = np.asarray(rest.cluster_dbscan(*CLUSTER))
        boxes = 0
        for k in range(clusters.max(initial=-1) + 1):
            cluster = rest.select_by_index(np.flatnonzero(clusters == k))
            with suppress(RuntimeError):  # what lies in one plane has no box
                cluster.get_oriented_bounding_box()
                boxes += 1
        return boxes

    return chain


def open3d_box(points: Array) -> Callable[[], Estimate]:
    """Open3D's box of the least volume around points (N, 3) [m]; their conversion is not part of the call."""
    o3d = _open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    return lambda: {"extents": np.asarray(cloud.get_minimal_oriented_bounding_box().extent)}


def pyransac3d_fit(kind: str, points: Array, iterations: int = ITERATIONS) -> Callable[[], Estimate]:
    """pyransac3d's fit of a `box`, `cylinder` or `sphere` to points (N, 3) [m]."""
    library = import_module(PYRANSAC3D)

    def call() -> Estimate:
        random.seed(0)
        options = {"thresh": THRESHOLD, "maxIteration": iterations}
        if kind == "box":
            return {"extents": np.asarray(library.Cuboid().fit(points, **options).extents)}
        if kind == "sphere":
            return {"radius": float(library.Sphere().fit(points, **options).radius)}
        found = library.Cylinder().fit(points, **options)
        return {"axis": np.asarray(found.axis), "radius": float(found.radius)}

    return call


def cgal_fit(kind: str, points: Array, normals: Array | None) -> Callable[[], Estimate]:
    """CGAL's efficient RANSAC of a `cylinder` or a `sphere`; with no normals it estimates them first.

    Copying the points into CGAL's set, which goes through Python one by one, is not part of the call.

    Args:
        kind: Which shape.
        points: (N, 3) [m].
        normals: Unit normals (N, 3), or None.
    """
    shapes = import_module(CGAL)
    kernel, sets = import_module("CGAL.CGAL_Kernel"), import_module("CGAL.CGAL_Point_set_3")
    processing = import_module("CGAL.CGAL_Point_set_processing_3")
    cloud = sets.Point_set_3()
    cloud.add_normal_map()
    cloud.reserve(len(points))
    directions = np.zeros_like(points) if normals is None else normals
    for p, n in zip(points.tolist(), directions.tolist(), strict=True):
        cloud.insert(kernel.Point_3(*p), kernel.Vector_3(*n))
    owner = cloud.add_int_map("shape")

    def call() -> Estimate:
        if normals is None:
            processing.pca_estimate_normals(cloud, NEIGHBOURS)
        lines = shapes.efficient_RANSAC(
            cloud, owner, int(CGAL_SHARE * len(points)), THRESHOLD, CGAL_GAP, CGAL_NORMAL, CGAL_MISS,
            False, False, kind == "cylinder", kind == "sphere", False,
        )  # fmt: skip
        return _read_cgal(lines[0]) if len(lines) else {}

    return call


def _read_cgal(line: str) -> Estimate:
    """Read one of the lines CGAL describes shapes with."""
    radius = re.search(rf"radius: ?{_NUMBER}", line)
    axis = re.search(rf"axis: {_TRIPLE}", line)
    found: Estimate = {} if radius is None else {"radius": float(radius[1])}
    return found if axis is None else found | {"axis": transforms.unit([float(v) for v in axis.groups()])}
