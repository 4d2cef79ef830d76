"""The voxel map's update with a VGA view against a pass that only unprojects and hashes the points."""

from __future__ import annotations

from caryatid.runtime.threads import one_blas_thread
from caryatid.sensing.voxel_map import VoxelMap
from performance import limits
from performance.clock import in_turns
from performance.effort import FULL, Effort
from performance.frames import fresh, heap, record
from performance.hashing import hash_voxels, hash_voxels_reference
from performance.rows import Median, Row, Target, timed_row

VIEWS = 3
"""The last of them is entered into a map that holds the others."""
TARGET = Target(3.0)
PASS = "unprojecting and hashing alone"


def measure_map(effort: Effort = FULL) -> list[Row]:
    """Rows of the map's update."""
    recording = record(heap(), VIEWS)
    config, view = recording.config, recording.views[-1]
    centre_world = recording.poses[0][:3, 3] + config.active.sphere_radius * recording.poses[0][:3, 2]
    known = VoxelMap.around(centre_world, config.voxels)
    for earlier in recording.views[:-1]:
        known = known.integrate(earlier, config.cloud.max_depth)
    size = config.voxels.size
    found = in_turns(
        {
            "map": lambda: known.integrate(view, config.cloud.max_depth),
            "pass": lambda: hash_voxels(view, size),
            "numpy": one_blas_thread(lambda: hash_voxels_reference(fresh(view), size)),
        },
        3 * effort.runs,
    )
    limit = limits.machine().limit(*limits.map_limit(view.depth.size, known.hits.size))
    ours, theirs, count = Median.of(found["map"]), Median.of(found["pass"]), len(hash_voxels(view, size))
    what = f"update of the voxel map, {size * 100.0:g} cm"
    note = (
        f"{int(view.valid.sum()):,} points in {count:,} voxels; the map bounds its space, the pass does not"
    )
    return [
        timed_row(
            "map", what, ours, peer=PASS, theirs=theirs, limit=limit, target=TARGET,
            note=note,
        ),
        timed_row("map.numpy", what, ours, peer=f"{PASS}, in NumPy", theirs=Median.of(found["numpy"])),
    ]  # fmt: skip
