"""Import of a robot's log: a few good views, written as a scene folder in the BOP format."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from scipy.ndimage import laplace
from scipy.spatial.transform import Rotation

from caryatid.config import Config, RecordingConfig
from caryatid.errors import InputError, PerceptionError
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.io.bop import write_views
from caryatid.io.datasets import NO_COLOUR, NO_POSE, Dataset, Frame, OpenOptions, join_datasets, open_dataset
from caryatid.io.images import BrokenImageError
from caryatid.io.staging import StagedFolder
from caryatid.io.video import SECOND
from caryatid.segmentation.diagnosis import GL_AXES, check_camera
from caryatid.segmentation.observation import level_transform

BROKEN: Final = "broken"
DARK: Final = "too few depth readings"
SPARE: Final = "more than max_views"
"""Reasons why a frame does not become a view."""
_REMEDIES: Final[Mapping[str, str]] = {
    NO_COLOUR: "omit colour, or allow longer gaps with --set recording.colour_gap=SECONDS",
    NO_POSE: "record poses throughout, or allow longer gaps with --set recording.pose_gap=SECONDS",
    DARK: "allow fewer with --set recording.min_readings=SHARE",
}
"""Remedies if no frame is usable, by reason."""


def import_recording(
    source: str | Path,
    out: str | Path,
    options: OpenOptions | Sequence[OpenOptions] | None = None,
    *,
    level: bool = False,
    config: Config | None = None,
) -> Dataset:
    """Choose sharp frames from different viewpoints and write them as a BOP scene folder.

    Args:
        source: A bag, a TUM RGB-D folder, or another dataset that `open_dataset` recognises.
        out: Folder to write; must not exist, or be empty. It appears whole or not at all.
        options: Topics of a bag, for each of its cameras, and the camera of a TUM RGB-D folder.
        level: Turn the world so that the table is level, for poses whose z axis does not point up.
        config: Which frames are sharp and different, the maximum number of views, and how to find a table.

    Returns:
        The source with the frames that became views.

    Raises:
        InputError: The recording is damaged or does not fit the options, no frame can become a view, no table
            is found to level the world, or `out` cannot be written.
    """
    config = config or Config()
    cameras = options if isinstance(options, Sequence) else [options]
    datasets = [open_dataset(source, config.recording, camera) for camera in cameras]
    with StagedFolder(out) as folder:
        chosen = join_datasets([choose_frames(dataset, config.recording) for dataset in datasets])
        if len(cameras) > 1:  # of all together, no more than `max_views`
            chosen = choose_frames(chosen, config.recording)
        if level:
            chosen = levelled(chosen, config)
        write_views(folder, chosen)
    return chosen


def levelled(dataset: Dataset, config: Config) -> Dataset:
    """Turn the world of a dataset so that the table is level; without poses, nothing changes.

    Raises:
        InputError: No table is found to level the world.
    """
    if not dataset.has_poses:
        return dataset
    T_level_world = _level_rotation(dataset, config)
    turn = np.rad2deg(transforms.angle_between(T_level_world[2, :3], transforms.UP))
    note = f"world frame rotated by {turn:.1f}° to level the table"
    frames = [
        frame.changed(
            lambda view: view.with_pose(T_level_world @ view.pose),
            T_world_camera=None if (T := frame.T_world_camera) is None else T_level_world @ T,
        )
        for frame in dataset.frames
    ]
    return replace(dataset, frames=frames, notes=(*dataset.notes, note))


def choose_frames(dataset: Dataset, config: RecordingConfig) -> Dataset:
    """Choose sharp frames of a video, each from another viewpoint; single images count as sharp.

    Sharpness is the variance of the Laplacian of the brightness. Without colour it is the share of pixels
    with a reading, because a moving depth camera loses readings at edges. The chosen frames are ordered by
    time; the others count as skipped.

    Raises:
        InputError: No frame can become a view.
    """
    if not dataset.is_video:
        config = replace(config, sharp_share=0.0)
    skipped = Counter(dataset.skipped)
    usable: list[Frame] = []
    sharpness: list[float] = []
    broken = ""
    for frame in dataset.frames:
        try:
            view = frame.load()
        except BrokenImageError as error:
            broken = broken or f", such as {error.source}: {error.reason}"
            skipped[BROKEN] += 1
            continue
        readings = float(view.valid.mean())
        if readings < config.min_readings:
            skipped[DARK] += 1
            continue
        usable.append(frame)
        grey = None if view.rgb is None else view.rgb.mean(axis=2, dtype=np.float32)
        sharpness.append(readings if grey is None else float(laplace(grey).var()))
    if not usable and not skipped:
        remedy = "record it again, or give another --depth TOPIC"
        raise InputError(dataset.path, "has no depth images", remedy)
    if not usable:
        reason = f"none of its {skipped.total()} depth images is usable: {reasons(skipped)}{broken}"
        raise InputError(dataset.path, reason, _REMEDIES.get(skipped.most_common(1)[0][0], "record it again"))
    times = np.array([(frame.time - usable[0].time) / SECOND for frame in usable])
    poses = [frame.T_world_camera for frame in usable if frame.T_world_camera is not None]
    T_world_camera = np.stack(poses) if len(poses) == len(usable) else None
    kept, others = choose_views(times, np.array(sharpness), T_world_camera, config)
    skipped.update(others)
    return replace(dataset, frames=[usable[index] for index in kept], skipped=skipped)


def choose_views(
    times: Array, sharpness: Array, T_world_camera: Array | None, config: RecordingConfig
) -> tuple[list[int], dict[str, int]]:
    """Choose frames that are sharp for their time and have different viewpoints.

    Going through time, the sharpest of the next frames is chosen whose viewpoint differs from all chosen
    ones. If there are too many, those farthest from each other stay.

    Frames have ascending times (N,) [s], N > 0, sharpness (N,), of which only ratios count, and poses
    (N, 4, 4). Without poses, a single frame is chosen. Return the indices of the chosen ones, ascending, and
    the number of others by reason.
    """
    if T_world_camera is None:
        return [int(np.argmax(sharpness))], dict(+Counter({SPARE: len(times) - 1}))
    first = np.searchsorted(times, times - config.sharp_window, side="left")
    stop = np.searchsorted(times, times + config.sharp_window, side="right")
    sharpest = [sharpness[a:b].max() for a, b in zip(first, stop, strict=True)]
    sharp = sharpness >= config.sharp_share * np.array(sharpest)
    candidates = np.flatnonzero(sharp)
    chosen: list[int] = []
    free = np.ones(len(candidates), dtype=np.bool_)
    while free.any():
        earliest = times[candidates[np.argmax(free)]]
        soon = free & (times[candidates] <= earliest + config.sharp_window)
        best = candidates[soon][np.argmax(sharpness[candidates[soon]])]
        chosen.append(int(best))
        free &= _apart(T_world_camera[candidates], T_world_camera[best], config) > 1.0
    # Of too many, the first stays, and then always the one farthest from those that stay.
    kept, poses = [0], T_world_camera[chosen]
    gap = _apart(poses, poses[0], config)
    while len(kept) < min(config.max_views, len(poses)):
        kept.append(int(np.argmax(gap)))
        gap = np.minimum(gap, _apart(poses, poses[kept[-1]], config))
    others = Counter({"blurred": len(times) - len(candidates), SPARE: len(chosen) - len(kept)})
    others["same viewpoint as another view"] = len(candidates) - len(chosen)
    return sorted(chosen[i] for i in kept), dict(+others)


def reasons(skipped: Mapping[str, int]) -> str:
    """Number of skipped frames by reason, the most frequent one first."""
    return ", ".join(f"{count} {reason}" for reason, count in Counter(skipped).most_common())


def _level_rotation(dataset: Dataset, config: Config) -> Array:
    """Find the smallest rotation of the world about its origin (4, 4) that makes the table level.

    Each view votes for the up direction as if it had no pose, by the largest plane that faces its camera with
    the rest of the scene in front. The direction nearest to all others wins.
    """
    rng, found, eyes, sights = np.random.default_rng(0), [], [], []
    for view in dataset:
        check_camera(view, config.cloud.max_coordinate)
        with suppress(PerceptionError):
            T_level_camera = level_transform(replace(view, T_world_camera=None), config, rng)
            found.append(transforms.rotate(view.pose, T_level_camera[2, :3]))
            eyes.append(view.pose[:3, 3])
            # From the camera to the table along the optical axis.
            sights.append(view.pose[:3, 2] * T_level_camera[2, 3] / max(-T_level_camera[2, 2], 0.1))
    if not found:
        raise InputError(dataset.path, "no view shows a table, which --level requires", "omit --level")
    # Views of one table look at about the same place; with OpenGL axes, that is behind the cameras.
    ahead, behind = (np.std(np.array(eyes) + way * np.array(sights), axis=0).max() for way in (1.0, -1.0))
    if behind < 0.5 * ahead:
        raise InputError(dataset.path, f"the cameras look away from what they show: {GL_AXES}")
    ups = np.stack(found)
    between = transforms.angle_between(ups[:, None], ups[None])
    near = between[int(np.argmin(between.sum(axis=1)))] <= np.deg2rad(config.surface.max_tilt)
    if 2 * int(near.sum()) < len(ups):
        reason = f"only {int(near.sum())} of {len(ups)} views agree on which way is up"
        remedy = "omit --level, and give poses of the camera's optical frame (x right, y down, z forward)"
        raise InputError(dataset.path, reason, remedy)
    turn, _ = Rotation.align_vectors(transforms.UP[None], ups[near].mean(axis=0)[None])
    return transforms.rigid(turn.as_matrix(), np.zeros(3))


def _apart(T_world_camera: Array, T_world_other: Array, config: RecordingConfig) -> Array:
    """Distance (N,) of poses (N, 4, 4) from another one (4, 4), in units of the smallest new view."""
    distance = np.linalg.norm(T_world_camera[:, :3, 3] - T_world_other[:3, 3], axis=1)
    turns = Rotation.from_matrix(T_world_other[:3, :3].T @ T_world_camera[:, :3, :3])
    return np.maximum(distance / config.min_distance, np.degrees(turns.magnitude()) / config.min_angle)
