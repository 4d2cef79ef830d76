"""Your own robot: an arm with a camera in its hand, given by its kinematics, explores in simulation.

On the command line, with its map in a file: `caryatid explore clutter --robot arm:arm.npz --out run`.
"""

import numpy as np

import caryatid as ct
from caryatid.evaluation import score, true_scene_from_simulation
from caryatid.geometry.transforms import Array
from caryatid.robots import Surroundings
from caryatid.robots.arm import ArmRobot
from caryatid.robots.reachability import sample_reachability
from caryatid.simulation import ground_truth, load_scene
from caryatid.simulation.setup import make_simulation

DH = [  # a [m], alpha [rad], d [m] of each joint: an arm of 0.85 m reach
    (0.0, np.pi / 2, 0.1625), (-0.425, 0.0, 0.0), (-0.3922, 0.0, 0.0),
    (0.0, np.pi / 2, 0.1333), (0.0, -np.pi / 2, 0.0997), (0.0, 0.0, 0.0996),
]  # fmt: skip
LIMITS = np.pi * np.array([(-1, 1), (-1, 0), (-0.85, 0.85), (-1, 1), (-1, 1), (-1, 1)])
CAMERA_IN_HAND = (0.0, -0.06, 0.03)  # looks along the flange, 6 cm beside it: your hand-eye calibration


def forward(joints: Array) -> Array:
    """From joints (N, 6) to `T_base_camera` (N, 4, 4)."""
    T = np.tile(np.eye(4), (len(joints), 1, 1))
    for q, (a, alpha, d) in zip(joints.T, DH, strict=True):
        c, s, ca, sa, zero, one = np.cos(q), np.sin(q), np.cos(alpha), np.sin(alpha), 0.0 * q, 0.0 * q + 1.0
        rows = [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [zero, sa * one, ca * one, d * one]]
        T = T @ np.moveaxis(np.array([*rows, [zero, zero, zero, one]]), -1, 0)
    T[:, :3, 3] += T[:, :3, :3] @ CAMERA_IN_HAND
    return T


def main() -> None:
    """Sample what the arm reaches, put it beside the table, and let it look."""
    reach = sample_reachability(forward, LIMITS, 500_000, np.random.default_rng(0))
    print(f"map of {np.count_nonzero(reach.reached):,} positions and directions, {reach.fresh:.0%} missing")

    def arm(place: Surroundings) -> ArmRobot:
        return ArmRobot(reach, place.T_world_base, place.config.arm, furniture=place.floor)

    scene = load_scene("pile-8-2")
    truth = true_scene_from_simulation(scene, ground_truth(scene))
    stage = make_simulation(scene, ct.Config(), noise="carmine", seed=0, robot=arm)
    for step in ct.explore(stage.camera, stage.robot, early_stop=False):
        f1 = score(step.graph, truth, np.random.default_rng(0)).f1
        print(f"view {step.index + 1}: {len(step.graph.movable)} objects, F1 {f1:.2f}", end="")
        print(f" after {step.path_travelled:.1f} m of the hand, {step.sphere.radius:.2f} m from the middle")
        if step.index == 4:
            break
    assert f1 > 0.9


if __name__ == "__main__":
    main()
