"""What we are compared with: other libraries, each behind one call, and a pass that hashes an image's voxels.

What cannot be imported raises.
"""

from __future__ import annotations

import random
import re
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np
from numba import get_num_threads, njit, prange
from numpy.typing import NDArray

from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.sensing.views import View

OPEN3D, PYRANSAC3D, CGAL = "open3d", "pyransac3d", "CGAL.CGAL_Shape_detection"
DISTRIBUTIONS = {OPEN3D: "open3d", PYRANSAC3D: "pyransac3d", CGAL: "cgal"}
"""Module → the package of the registry it comes with."""

THRESHOLD = 0.004
"""Distance within which points belong to a shape [m]: 4σ."""
ITERATIONS = 1000
"""Of pyransac3d: its default for spheres; those for cuboids and cylinders are 5 and 10 times as many."""
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
    """Open3D from a depth image, readings up to a depth [m], to a box a cluster, counting the boxes."""
    o3d = _open3d()
    height, width = view.depth.shape
    K = o3d.camera.PinholeCameraIntrinsic(width, height, view.K)

    def chain() -> int:
        image = o3d.geometry.Image(view.depth)
        cloud = o3d.geometry.PointCloud.create_from_depth_image(
            image, K, depth_scale=1.0, depth_trunc=max_depth
        )
        cloud = cloud.voxel_down_sample(0.005)
        _, table = cloud.segment_plane(distance_threshold=0.01, ransac_n=3, num_iterations=1000)
        rest = cloud.select_by_index(table, invert=True)
        clusters = np.asarray(rest.cluster_dbscan(eps=0.015, min_points=10))
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


def pyransac3d_fit(kind: str, points: Array) -> Callable[[], Estimate]:
    """pyransac3d's fit of a `box`, `cylinder` or `sphere` to points (N, 3) [m]."""
    library = import_module(PYRANSAC3D)

    def call() -> Estimate:
        random.seed(0)
        options = {"thresh": THRESHOLD, "maxIteration": ITERATIONS}
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
            cloud, owner,
            int(0.3 * len(points)),  # fewer points a shape make it look for more shapes than the one
            THRESHOLD,
            0.05,  # gap at which points of one shape are two [m]: wide, there is one; it is fastest so
            0.9,  # cosine of the angle between a point's normal and the shape's; the default
            0.01,  # probability of overlooking a larger shape; the default
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


EMPTY = -1
"""What stands in a free place of a table; no key is negative."""
REACH = 1 << 20
"""Voxels along an axis, the origin in the middle [1]."""
MIXER = np.uint64(0x9E3779B97F4A7C15)
"""Odd, near 2⁶⁴ over the golden ratio: spreads keys over a table."""


def hash_voxels(view: View, size: float) -> NDArray[np.int64]:
    """Keys of the voxels of an edge [m] that hold a view's points, each once, in no order.

    Each thread takes a band of the image; then each takes a share of the hashes, and enters the keys that
    have one of them into an open-addressing table of its own.
    """
    threads = get_num_threads()
    keys, counts = _keys(view.depth, view.K, view.pose, 1.0 / size, threads)
    places = 1 << int(np.ceil(np.log2(max(2 * counts.sum() // threads, 2))))
    tables, taken = _tables(keys, counts, places)
    return np.concatenate([table[: taken[t]] for t, table in enumerate(tables)])


@njit(cache=True, parallel=True)
def _keys(
    depth: NDArray[np.float32], K: Array, T: Array, scale: float, threads: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Keys of the points' voxels, a row a band of the image, no two neighbours the same; and how many."""
    height, width = depth.shape
    keys = np.empty((threads, (height // threads + 1) * width), dtype=np.int64)
    counts = np.zeros(threads, dtype=np.int64)
    x = (np.arange(width) - K[0, 2]) / K[0, 0]
    for t in prange(threads):
        count, last = 0, EMPTY
        for v in range(height * t // threads, height * (t + 1) // threads):
            y = (v - K[1, 2]) / K[1, 1]
            a, b, c = T[0, 1] * y + T[0, 2], T[1, 1] * y + T[1, 2], T[2, 1] * y + T[2, 2]
            for u in range(width):
                z = depth[v, u]
                if z > 0.0:
                    i = int(np.floor(((T[0, 0] * x[u] + a) * z + T[0, 3]) * scale)) + REACH // 2
                    j = int(np.floor(((T[1, 0] * x[u] + b) * z + T[1, 3]) * scale)) + REACH // 2
                    k = int(np.floor(((T[2, 0] * x[u] + c) * z + T[2, 3]) * scale)) + REACH // 2
                    key = (i * REACH + j) * REACH + k
                    if key != last:
                        keys[t, count] = key
                        count += 1
                        last = key
        counts[t] = count
    return keys, counts


@njit(cache=True, parallel=True)
def _tables(
    keys: NDArray[np.int64], counts: NDArray[np.int64], places: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Each thread's keys, once, at the beginning of its row, and how many."""
    threads = len(keys)
    found = np.empty((threads, counts.sum()), dtype=np.int64)
    taken = np.zeros(threads, dtype=np.int64)
    mask = np.uint64(places - 1)
    for t in prange(threads):
        table = np.full(places, EMPTY, dtype=np.int64)
        for band in range(threads):
            for n in range(counts[band]):
                key = keys[band, n]
                mixed = (np.uint64(key) * MIXER) >> np.uint64(32)
                if ((mixed * np.uint64(threads)) >> np.uint64(32)) != np.uint64(t):
                    continue
                place = mixed & mask
                while table[place] != key and table[place] != EMPTY:
                    place = (place + np.uint64(1)) & mask
                if table[place] == EMPTY:
                    table[place] = key
                    found[t, taken[t]] = key
                    taken[t] += 1
    return found, taken
