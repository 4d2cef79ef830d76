"""The peers we compare with: other libraries, each behind one call, and a pass that hashes an image's voxels.

A library that cannot be imported raises an error.
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
"""Module → the PyPI package that contains it."""

THRESHOLD = 0.004
"""Maximum distance between a shape and its points [m]: 4σ."""
ITERATIONS = 1000
"""pyransac3d's default for spheres; its defaults for cuboids and cylinders are 5 and 10 times as high."""
NEIGHBOURS = 20
"""Number of points from which a normal is estimated."""

GRAIN, FLAT, NEIGHBOURHOOD = 0.005, 0.01, 0.015
"""Voxel of Open3D's clouds, distance within which points are on a plane, and radius of DBSCAN [m]."""

_FOLDERS = re.compile(r"(?<![\w.])/(?:[^/\s'\"()]+/)+")
_NUMBER = r"(-?[\d.]+(?:e[+-]?\d+)?)"
_TRIPLE = rf"\({_NUMBER}, {_NUMBER}, {_NUMBER}\)"


Estimate = dict[str, Any]
"""A fitter's result: `axis` (3,), `radius` [m] or `extents` (3,) [m]; empty if it finds nothing."""


def told(error: BaseException) -> str:
    """Return an error's message in one line, without the folders of this machine."""
    return _FOLDERS.sub("", " ".join(str(error).split())) or type(error).__name__


def versions() -> str:
    """Return the peers' versions, or that they are not installed."""
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
    """Import Open3D and limit its log to errors; it warns about every box that it cannot orient."""
    o3d = import_module(OPEN3D)
    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    return o3d


def open3d_chain(view: View, max_depth: float) -> Callable[[], int]:
    """Return a function that runs Open3D on a depth image, cropped at a depth [m], up to boxes of clusters.

    The function returns the number of boxes.
    """
    o3d = _open3d()
    height, width = view.depth.shape
    K = o3d.camera.PinholeCameraIntrinsic(width, height, view.K)

    def chain() -> int:
        image = o3d.geometry.Image(view.depth)
        cloud = o3d.geometry.PointCloud.create_from_depth_image(
            image, K, depth_scale=1.0, depth_trunc=max_depth
        )
        cloud = cloud.voxel_down_sample(GRAIN)
        _, rest = open3d_table(cloud)
        clusters = open3d_clusters(rest)
        boxes = 0
        for k in range(clusters.max(initial=-1) + 1):
            cluster = rest.select_by_index(np.flatnonzero(clusters == k))
            with suppress(RuntimeError):  # coplanar points have no box
                cluster.get_oriented_bounding_box()
                boxes += 1
        return boxes

    return chain


def open3d_cloud(points: Array) -> Any:
    """Return Open3D's cloud of points (N, 3) [m], one per voxel, and start its random numbers anew."""
    o3d = _open3d()
    o3d.utility.random.seed(0)
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)).voxel_down_sample(GRAIN)


def open3d_table(cloud: Any) -> tuple[Array, Any]:
    """Find the largest plane by RANSAC; return a, b, c, d of ax + by + cz + d = 0, and the other points."""
    plane, inside = cloud.segment_plane(distance_threshold=FLAT, ransac_n=3, num_iterations=1000)
    return np.asarray(plane), cloud.select_by_index(inside, invert=True)


def open3d_clusters(cloud: Any) -> NDArray[np.int32]:
    """Return the DBSCAN cluster (N,) of each point of a cloud, −1 for noise."""
    return np.asarray(cloud.cluster_dbscan(eps=NEIGHBOURHOOD, min_points=10), dtype=np.int32)


def open3d_box(points: Array) -> Callable[[], Estimate]:
    """Return a function that fits Open3D's minimum-volume box to points (N, 3) [m], converted beforehand."""
    o3d = _open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    return lambda: {"extents": np.asarray(cloud.get_minimal_oriented_bounding_box().extent)}


def pyransac3d_fit(kind: str, points: Array) -> Callable[[], Estimate]:
    """Return a function that fits a `box`, `cylinder` or `sphere` to points (N, 3) [m] with pyransac3d."""
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
    """Return a function that fits a `cylinder` or `sphere` to points (N, 3) [m] with CGAL's efficient RANSAC.

    It first estimates normals if there are none. The points are copied into CGAL's set beforehand, because
    they pass through Python one by one.
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
            int(0.3 * len(points)),  # with fewer points per shape, it looks for more than one shape
            THRESHOLD,
            0.05,  # gap that splits a shape in two [m]: wide, for there is only one, and fastest
            0.9,  # cosine of the angle between a point's normal and the shape's; the default
            0.01,  # probability of missing a larger shape; the default
            False, False, kind == "cylinder", kind == "sphere", False,
        )  # fmt: skip
        return _read_cgal(lines[0]) if len(lines) else {}

    return call


def _read_cgal(line: str) -> Estimate:
    """Parse one of the lines in which CGAL describes shapes."""
    radius = re.search(rf"radius: ?{_NUMBER}", line)
    axis = re.search(rf"axis: {_TRIPLE}", line)
    found: Estimate = {} if radius is None else {"radius": float(radius[1])}
    return found if axis is None else found | {"axis": transforms.unit([float(v) for v in axis.groups()])}


EMPTY = -1
"""Marks a free slot of a hash table; no key is negative."""
REACH = 1 << 20
"""Number of voxels along an axis, with the origin in the middle [1]."""
MIXER = np.uint64(0x9E3779B97F4A7C15)
"""Odd number near 2⁶⁴ / golden ratio; it spreads keys over a hash table."""


def hash_voxels(view: View, size: float) -> NDArray[np.int64]:
    """Return the unique keys of the voxels of this size [m] that hold a view's points, in no order.

    Each thread first computes the keys of a band of the image. Then it takes a share of the hash values, and
    enters the keys with these values into its own open-addressing table.
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
    """Return the keys of the points' voxels, one row per band, without equal neighbours, and their counts."""
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
    """Return each thread's unique keys, at the beginning of its row, and their counts."""
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
