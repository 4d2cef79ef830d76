from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from arms import HIGH, LIMITS, LOW, PITCH, base_at, gantry

from caryatid.cli.options import LiftingCommand
from caryatid.config import ArmConfig, Config, GripperConfig
from caryatid.errors import InputError
from caryatid.robots import find_robot
from caryatid.robots.arm import ArmRobot
from caryatid.robots.reachability import (
    ReachabilityMap,
    read_reachability,
    sample_reachability,
    write_reachability,
)

CONFIG = ArmConfig(cell=0.1, view_directions=60)
BIN = np.deg2rad(35.0)
"""Angle between directions that share a bin at the most."""


def sample(count: int = 400_000) -> ReachabilityMap:
    return sample_reachability(gantry, LIMITS, count, np.random.default_rng(0), CONFIG)


@pytest.fixture(scope="module")
def reachability() -> ReachabilityMap:
    return sample()


def poses(low, high, count: int = 3000) -> np.ndarray:
    """Poses of the gantry with joints between two ends."""
    return gantry(np.random.default_rng(1).uniform(low, high, (count, 6)))


class TestReachabilityMap:
    def test_it_holds_what_lies_well_within_the_limits_and_nothing_well_beyond(self, reachability):
        inside = poses([*(LOW + 0.05), -np.pi, -0.6, -0.5], [*(HIGH - 0.05), np.pi, -0.4, 0.5])
        assert reachability(inside).all()
        assert reachability.fresh < 0.01
        for joint, *ends in (
            (0, HIGH[0] + 0.1, HIGH[0] + 5.0),
            (1, -5.0, LOW[1] - 0.1),
            (2, HIGH[2] + 0.1, 1e6),
            (4, PITCH[1] + BIN, np.pi / 2.0),
            (5, np.deg2rad(150.0), np.deg2rad(210.0)),
        ):
            beyond = LIMITS.copy()
            beyond[joint] = ends
            assert not reachability(poses(*beyond.T)).any()

    def test_impossible_postures_are_left_out(self):
        def forward(joints):
            return np.where((joints[:, 0] > 0.35)[:, None, None], np.nan, gantry(joints))

        found = sample_reachability(forward, LIMITS, 50_000, np.random.default_rng(0), CONFIG)
        assert found(poses(LIMITS[:, 0], [0.3, *LIMITS[1:, 1]])).mean() > 0.9
        assert not found(poses([0.41, *LIMITS[1:, 0]], LIMITS[:, 1])).any()


@pytest.mark.parametrize(
    ("forward", "limits", "count", "message"),
    [
        (gantry, np.zeros((6, 3)), 10, r"\(J, 2\), not shape \(6, 3\)"),
        (gantry, [[0.0, np.nan]], 10, "finite"),
        (gantry, [[0.0, 1.0], [1.0, 0.5]], 10, "joint 1 has low > high"),
        (gantry, LIMITS, 0, "0 is too few"),
        (lambda joints: gantry(joints)[:, :3], LIMITS, 10, r"returned shape \(1, 3, 4\) for 1 postures"),
        (lambda joints: gantry(joints)[:-1], LIMITS, 10, r"returned shape \(0, 4, 4\)"),
        (lambda joints: 2.0 * gantry(joints), LIMITS, 10, "last row"),
        (lambda joints: gantry(joints) * np.array([-1.0, 1.0, 1.0, 1.0]), LIMITS, 10, "not a rotation"),
        (lambda joints: np.full((len(joints), 4, 4), np.nan), LIMITS, 10, "NaN for every posture"),
    ],
)
def test_what_cannot_be_sampled_is_refused(forward, limits, count, message):
    with pytest.raises(InputError, match=message):
        sample_reachability(forward, limits, count, np.random.default_rng(0))


class TestFiles:
    def test_a_map_comes_back_as_it_was_and_the_same_bytes_go_out(self, reachability, tmp_path):
        one, other = tmp_path / "one.npz", tmp_path / "other"
        write_reachability(one, reachability)
        back = read_reachability(one)
        np.testing.assert_array_equal(back.reached, reachability.reached)
        np.testing.assert_array_equal(back.origin_base, reachability.origin_base)
        assert (back.cell, back.fresh) == (reachability.cell, reachability.fresh)
        write_reachability(other, back)
        assert one.read_bytes() == other.read_bytes()
        assert sorted(p.name for p in tmp_path.iterdir()) == ["one.npz", "other"]

    def test_a_map_is_used_for_what_it_is(self, tmp_path):
        rng, base, world = np.random.default_rng(0), base_at(-0.5, 0.1, 0.7, 30.0), tmp_path / "world.npz"
        camera = sample_reachability(gantry, LIMITS, 2000, rng, CONFIG)
        known = {"kind": "gripper", "T_world_base": base}
        gripper = sample_reachability(gantry, LIMITS, 2000, np.random.default_rng(0), CONFIG, **known)
        T_base_hand = gantry(np.random.default_rng(0).uniform(*LIMITS.T, (2000, len(LIMITS))))
        np.testing.assert_array_equal(gripper(base @ T_base_hand), camera(T_base_hand))
        write_reachability(world, gripper)
        np.testing.assert_array_equal(read_reachability(world)(base @ T_base_hand), camera(T_base_hand))
        with pytest.raises(InputError, match=r"world\.npz: is a map of the gripper in the world frame, but"):
            find_robot(f"arm:{world}")
        with pytest.raises(InputError, match="reachable: is a map of the gripper in the world frame, but"):
            ArmRobot(gripper, base)
        write_reachability(tmp_path / "arm.npz", camera)
        command = LiftingCommand(gripper="parallel", reach=tmp_path / "arm.npz")
        with pytest.raises(InputError, match=r'arm\.npz: .*kind="gripper", T_world_base=…\) makes it'):
            command.reachable(replace(Config(), gripper=GripperConfig(kind="parallel")))
        with pytest.raises(InputError, match="kind: 'foot' is unknown"):
            sample_reachability(gantry, LIMITS, 10, rng, CONFIG, kind="foot")

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"format": np.array("caryatid/graph")}, "not a reachability map"),
            ({"version": np.array(1)}, r"earlier caryatid, without its kind .* and frame; sample it again"),
            ({"version": np.array(3)}, "version 3 is not supported"),
            ({"kind": np.array("foot")}, "not the arrays"),
            ({"frame": np.array("world")}, "not the arrays"),
            ({"frame": np.array("world"), "T_world_base": np.ones((4, 4))}, "T_world_base: the last row"),
            ({"cell": None}, "not the arrays"),
            ({"cell": np.array(np.nan)}, "not the arrays"),
            ({"reached": np.zeros((2, 2, 2, 2))}, "not the arrays"),
            ({"reached": np.zeros((0, 2, 2, 2), dtype=np.uint8)}, "not the arrays"),
            ({"reached": np.array([None])}, "damaged"),
        ],
    )
    def test_another_content_is_refused(self, tmp_path, change, message):
        file = tmp_path / "map.npz"
        write_reachability(file, sample(1000))
        content = dict(np.load(file))
        np.savez(file, **{k: v for k, v in (content | change).items() if v is not None})
        with pytest.raises(InputError, match=rf"map\.npz: .*{message}"):
            read_reachability(file)
        with pytest.raises(InputError, match="the file is missing"):
            read_reachability(tmp_path / "other.npz")
