"""Recordings whose numbers cannot be right: poses, cameras, units and images that a person mixes up."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from conftest import capture, run_command

from caryatid.geometry import transforms
from caryatid.io import write_recording

pytestmark = pytest.mark.slow


def moved(view, rng):
    shift = rng.uniform(0.3, 2.0) * transforms.unit(rng.normal(size=3))
    return replace(view, T_world_camera=transforms.rigid(np.eye(3), shift) @ view.pose)


def turned(view, rng):
    turn = transforms.rotation_from_vector(rng.uniform(0.4, np.pi) * transforms.unit(rng.normal(size=3)))
    return replace(view, T_world_camera=view.pose @ transforms.rigid(turn, np.zeros(3)))


def inverse(view, _):
    return replace(view, T_world_camera=transforms.invert(view.pose))


def by_opengl(view, _):
    return replace(view, T_world_camera=view.pose @ np.diag([1.0, -1.0, -1.0, 1.0]))


def in_millimetres(view, _):
    return replace(view, T_world_camera=transforms.rigid(view.pose[:3, :3], 1000.0 * view.pose[:3, 3]))


def wrong_focal_lengths(view, rng):
    x, y = rng.choice([0.3, 0.5, 1.0, 2.0, 3.0], 2, replace=False)
    return replace(view, K=view.K * np.array([[x, 1.0, 1.0], [1.0, y, 1.0], [1.0, 1.0, 1.0]]))


def scaled(view, rng):
    return replace(view, depth=view.depth * np.float32(rng.choice([1e-3, 0.5, 0.7, 1.4, 2.0, 1000.0])))


def mirrored(view, _):
    return replace(view, depth=view.depth[:, ::-1].copy(), labels=view.labels[:, ::-1].copy())


ERRORS = [moved, turned, inverse, by_opengl, in_millimetres, wrong_focal_lengths, scaled, mirrored]


def nonsense(views, rng):
    """The views, one of them wrong, or all alike, or two with each other's poses."""
    error, which = ERRORS[rng.integers(len(ERRORS))], int(rng.integers(len(views)))
    how = rng.integers(6)
    if how == 0:
        other = (which + 1) % len(views)
        poses = {which: views[other].pose, other: views[which].pose}
        return "swapped", [replace(v, T_world_camera=poses.get(i, v.pose)) for i, v in enumerate(views)]
    if how == 1 and error is not moved:  # a world that is moved as a whole is none the worse
        seed = int(rng.integers(2**32))
        return f"all {error.__name__}", [error(v, np.random.default_rng(seed)) for v in views]
    return f"{error.__name__} {which}", [error(v, rng) if i == which else v for i, v in enumerate(views)]


@pytest.mark.parametrize("command", ["extract", "explore"])
def test_nonsense_is_refused_in_one_line_or_warned_of(command, tmp_path, capsys):
    """Sessions, and so the service, refuse what `extract` refuses or warns of."""
    recording, run = tmp_path / "recording", tmp_path / "run"
    options = ["--out", run, "--quiet", "--no-report"]
    if command == "explore":
        options.append("--no-early-stop")  # otherwise it may not look at a wrong view
    views, silent = capture("clutter", (180.0, 60.0, -60.0)), []
    for case in range(100):
        what, wrong = nonsense(views, np.random.default_rng([case, 21]))
        write_recording(recording, wrong)
        status = run_command(command, recording, *options)
        assert (status, capsys.readouterr().err.count("\n")) in ((0, 0), (1, 1))
        if status == 0 and not json.loads((run / "run.json").read_text())["warnings"]:
            silent.append(f"{case}: {what}")
        shutil.rmtree(recording)
    assert len(silent) <= 5, silent
