"""Planners from the literature: the view whose rays gather most volumetric information in the voxel map.

The formulations are those of Isler et al. (An Information Gain Formulation for Active Volumetric 3D
Reconstruction, 2016) and Delmerico et al. (A Comparison of Volumetric Information Gain Metrics for Active 3D
Object Reconstruction, 2018). With p_o the occupancy of a voxel, H its binary entropy and p_v = ∏ (1 − p_o)
over the voxels before it, a ray gathers up to the first occupied voxel

* `occlusion-aware`: Σ p_v H(p_o). Space seen free counts as well: at the lower clamp a long ray through it
  gathers more than one through unknown space, which soon hides what is behind;
* `unobserved-voxel`: the same over unknown voxels only;
* `rear-side-voxel`: 1 where that occupied voxel is met from an unknown one, which is its unseen back;
* `rear-side-entropy`: Σ H over the run of unknown voxels that ends there;
* `proximity-count`: Σ (d_max − d) over unknown voxels at a distance d < d_max from an occupied one. What
  lies before a surface has been seen free, so these are at its back.

They come from the reconstruction of one object in a box known beforehand. Here the box is the space over
the support surfaces up to the height of the highest heap. Without it the room behind, the floor, and what is
outside the image would outweigh everything: half of the map's voxels are still unknown after a first view.
For the same reason p_v is 1 where a ray enters the box. Unknown space inside objects counts, as it does
there: these planners do not know shapes.
"""

from __future__ import annotations

from functools import cache, partial

import numpy as np
from scipy.ndimage import distance_transform_edt

from caryatid.config import ActiveVisionConfig
from caryatid.geometry.rays import room, traverse
from caryatid.geometry.transforms import Array, unit
from caryatid.planning.candidates import Looks
from caryatid.planning.decision import Decision, PlanningState, check_candidates, decide, path_cost
from caryatid.planning.expected_visibility import space_above
from caryatid.planning.planners import VOLUMETRIC
from caryatid.runtime.parallel import for_each, inner, kernel
from caryatid.sensing.voxel_map import OCCUPIED, UNKNOWN, VoxelMap

PROXIMITY = 0.1
"""d_max of `proximity-count` [m]; a common object reaches that far behind its seen side."""


class VolumetricPlanner:
    """Chooses the candidate with the largest utility IG / ΣIG − cost / Σcost.

    Args:
        formulation: How information is counted, one of `VOLUMETRIC`.
    """

    def __init__(self, formulation: str) -> None:
        self._formulation = formulation
        self._column = VOLUMETRIC.index(formulation)

    def plan(self, state: PlanningState, rng: np.random.Generator) -> Decision:
        """Choose the candidate with the largest utility; the first of equal ones.

        The decision's saliency, cost and score are the two terms of the utility and their difference, in
        units of the largest share of information. Candidates beside an earlier view are left out: these
        planners do not choose a view of their list twice. Without a support surface or objects there is no
        box to look into, and nothing is gathered.
        """
        check_candidates(state)
        candidates, config = state.candidates, state.config
        looks = candidates.looks(config.look_directions)
        # Nearer to an earlier view than to one another.
        cosine = candidates.directions[looks.chosen] @ state.visited.T
        old = cosine.max(axis=1) >= np.cos(np.sqrt(4.0 * np.pi / config.look_directions))
        if not old.all():
            looks = Looks.of(looks.chosen[~old], candidates.directions)
        corners = space_above(state.graph, state.voxels)
        gain = np.zeros(len(looks.chosen))
        if corners is not None:
            T_world_camera = candidates.T_world_camera[looks.chosen]
            box = state.voxels.cut(*corners)
            gain = ray_information(box, T_world_camera, image_rays(config))[:, self._column]
        saliency, cost = gain / (gain.max() or 1.0), path_cost(state)[looks.chosen]
        return decide(
            candidates,
            saliency,
            cost / (cost.sum() or 1.0) * (saliency.sum() or 1.0),
            lambda best: self._why(gain, best),
            looks=looks,
            elsewhere=partial(np.zeros, len(state.sphere.directions)),
        )

    def _why(self, gain: Array, best: int) -> str:
        """One sentence: how the chosen view's information compares with the others'."""
        if gain.max() <= 0.0:
            return f"no view is expected to add {self._formulation} information; this one is the cheapest"
        ratio, share = gain[best] / gain.mean(), gain[best] / gain.max()
        mean = f"{ratio:.1f} times the mean {self._formulation} information of all views"
        return f"{mean}, {share:.0%} of the maximum"


@cache
def image_rays(config: ActiveVisionConfig) -> Array:
    """Directions (R, 3) in the camera, unit: a square grid over the image within `config.view_cone`.

    Neighbours are 2 cm, two voxels, apart at the view sphere's centre, so that no object is missed.
    """
    spacing, edge = 0.02 / config.sphere_radius, np.tan(np.deg2rad(config.view_cone))
    steps = spacing * np.arange(-np.floor(edge / spacing), np.floor(edge / spacing) + 1.0)
    x, y = (g.ravel() for g in np.meshgrid(steps, steps))
    inside = np.hypot(x, y) <= edge
    return unit(np.column_stack([x[inside], y[inside], np.ones(inside.sum())]))


def ray_information(voxels: VoxelMap, T_world_camera: Array, rays_camera: Array) -> Array:
    """Sum the information (C, 5) that the rays (R, 3), unit, of each camera (C, 4, 4) gather.

    It has one column per name of `VOLUMETRIC`: [bit] for entropies, [m] for `proximity-count`.
    """
    occupancy, states = voxels.occupancy, np.ascontiguousarray(voxels.states)
    entropy = -occupancy * np.log2(occupancy) - (1.0 - occupancy) * np.log2(1.0 - occupancy)
    nearness = np.zeros_like(occupancy)
    if (states == OCCUPIED).any():
        distance = voxels.config.size * distance_transform_edt(states != OCCUPIED)
        nearness[states == UNKNOWN] = np.maximum(PROXIMITY - distance[states == UNKNOWN], 0.0)
    layers = np.stack([occupancy, entropy, nearness], axis=-1)
    cameras = (np.ascontiguousarray(T_world_camera), rays_camera)
    gathered = np.zeros((len(T_world_camera), len(VOLUMETRIC)))
    data = (states, layers, *cameras, voxels.origin_world, voxels.config.size, gathered)
    for_each(_gather, len(T_world_camera), data)
    return gathered


@kernel
def _gather(c, data):  # type: ignore[no-untyped-def]
    """Sum what the rays of one camera gather."""
    states, layers, T_world_camera, rays, origin, size, gathered = data
    T, found = T_world_camera[c], room(states.shape)
    start = ((T[0, 3] - origin[0]) / size, (T[1, 3] - origin[1]) / size, (T[2, 3] - origin[2]) / size)
    for r in range(len(rays)):
        x, y, z = rays[r, 0], rays[r, 1], rays[r, 2]
        ray = (
            (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z) / size,
            (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z) / size,
            (T[2, 0] * x + T[2, 1] * y + T[2, 2] * z) / size,
        )
        slabs = traverse(found, states.shape, start, ray, 0.0, np.inf)
        _gather_ray(states.reshape(-1), layers.reshape(-1, 3), found, slabs, gathered[c])


@inner
def _gather_ray(states, layers, found, slabs, gathered):  # type: ignore[no-untyped-def]
    """Add what one ray gathers up to the first occupied voxel to `gathered` (5,)."""
    visible, run, before = 1.0, 0.0, np.uint32(np.iinfo(np.uint32).max)
    for n in range(slabs):
        for m in range(3):
            voxel = np.uint32(found[m, n])
            if voxel == before:
                continue
            before = voxel
            occupancy, entropy, state = layers[voxel, 0], layers[voxel, 1], states[voxel]
            gathered[0] += visible * entropy
            if state == UNKNOWN:
                gathered[1] += visible * entropy
                gathered[4] += layers[voxel, 2]
                run += entropy
            elif state == OCCUPIED:
                if run > 0.0:
                    gathered[2] += 1.0
                    gathered[3] += run
                return
            else:
                run = 0.0
            visible *= 1.0 - occupancy
