"""A robot's recording becomes a recording of a few good views, a scene folder of the BOP format."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from caryatid.config import Config, RecordingConfig
from caryatid.errors import InputError
from caryatid.geometry import transforms
from caryatid.geometry.transforms import Array
from caryatid.io.bop_writer import RecordingWriter
from caryatid.io.recordings import sources
from caryatid.io.recordings.bag_footage import BagFootage, Topics
from caryatid.io.recordings.bags import SUFFIXES, is_bag
from caryatid.io.recordings.frame_filter import choose_views
from caryatid.io.recordings.gravity_alignment import level_rotation
from caryatid.io.recordings.sources import Footage, Shot
from caryatid.io.recordings.tum import TumFootage, is_tum_folder, read_tum_camera

NO_TOPICS: Final = Topics()
"""No topic is named: they are found."""
_REMEDIES: Final[Mapping[str, str]] = {
    sources.NO_COLOUR: "leave colour out, or allow more with --set recording.colour_gap=SECONDS",
    sources.NO_POSE: "record its poses all the time, or allow more with --set recording.pose_gap=SECONDS",
    sources.BROKEN: "record it again",
    sources.DARK: "allow less with --set recording.min_readings=SHARE",
}
"""What to do where no frame is usable for one reason."""


@dataclass(frozen=True, eq=False, slots=True)
class Imported:
    """What came of an import.

    Attributes:
        read: Depth images there were.
        chosen: The frames that became views, in order.
        skipped: How many did not, by reason; together with the chosen ones all that were read.
        notes: What a person should know.
    """

    read: int
    chosen: tuple[Shot, ...]
    skipped: dict[str, int]
    notes: tuple[str, ...]


def import_recording(
    source: str | Path,
    out: str | Path,
    topics: Topics = NO_TOPICS,
    *,
    camera_file: Path | None = None,
    level: bool = False,
    config: Config | None = None,
    seed: int = 0,
) -> Imported:
    """Choose sharp frames from different viewpoints and write them as a BOP scene folder.

    Args:
        source: A bag, or a TUM RGB-D folder.
        out: Folder to write; must not exist, or be empty. It appears whole or not at all.
        topics: What to take from a bag.
        camera_file: Camera of a TUM RGB-D folder, or None for the published ones.
        level: Turn the world so that the table is level: for poses whose z axis does not point up.
        config: What is sharp, what is different, and how many views there may be; and how a table is found.
        seed: Seed of how the table is found.

    Raises:
        InputError: The recording is damaged or does not fit the options, no frame of it can become a view,
            there is no table to level the world by, or `out` cannot be written.
    """
    settings = config or Config()
    choosing = settings.recording
    footage = _open(Path(source), topics, camera_file, choosing)
    with RecordingWriter(out) as writer:
        shots = footage.look_through()
        skipped = dict(shots.skipped)
        if not shots.usable:
            raise _nothing_usable(footage.path, shots.read, skipped)
        poses = [shot.T_world_camera for shot in shots.usable if shot.T_world_camera is not None]
        sharpness = np.array([shot.sharpness for shot in shots.usable])
        choice = choose_views(shots.times, sharpness, np.stack(poses) if poses else None, choosing)
        chosen = tuple(shots.usable[index] for index in choice.kept)
        T_level_world = np.eye(4)
        if level and poses:
            T_level_world = level_rotation(
                footage.path, footage.load(chosen), settings, np.random.default_rng(seed)
            )
        for view in footage.load(chosen):
            T = view.T_world_camera
            posed = view if T is None else replace(view, T_world_camera=T_level_world @ T)
            writer.add_view(posed, shots.depth_scale)
        writer.finish()
    counts = {
        sources.BLURRED: choice.blurred,
        sources.ALIKE: choice.alike,
        sources.SPARE: choice.spare,
    }
    skipped |= {reason: count for reason, count in counts.items() if count}
    return Imported(shots.read, chosen, skipped, (*shots.notes, *_levelled(T_level_world)))


def reasons(skipped: Mapping[str, int]) -> str:
    """How many were skipped, by reason, the most frequent one first."""
    return ", ".join(f"{skipped[reason]} {reason}" for reason in sorted(skipped, key=lambda r: -skipped[r]))


def _levelled(T_level_world: Array) -> list[str]:
    """What a person should know of a turn (4, 4) of the world: nothing of none."""
    turn = np.rad2deg(transforms.angle_between(T_level_world[2, :3], np.array([0.0, 0.0, 1.0])))
    return [f"world: turned by {turn:.1f}°, so that the table is level"] if turn > 0.0 else []


def _open(source: Path, topics: Topics, camera_file: Path | None, config: RecordingConfig) -> Footage:
    if not source.exists():
        raise InputError(source, "there is no such file or folder", "give a bag or a TUM RGB-D folder")
    if is_bag(source):
        if camera_file is not None:
            raise InputError("--camera", "is for TUM RGB-D folders", "a bag has its camera in --info TOPIC")
        return BagFootage(source, topics, config)
    if is_tum_folder(source):
        if topics != NO_TOPICS:
            raise InputError(
                "--depth, --info, --rgb, --tf",
                "are for bags",
                f"{source} is a TUM RGB-D folder; leave them out",
            )
        return TumFootage(source, read_tum_camera(source, camera_file), config)
    raise InputError(
        source,
        "is neither a bag nor a TUM RGB-D folder",
        f"give a file that ends in {', '.join(SUFFIXES)}, a folder with metadata.yaml, or one with depth.txt",
    )


def _nothing_usable(path: Path, read: int, skipped: Mapping[str, int]) -> InputError:
    if not read:
        return InputError(path, "holds no depth image", "record it again, or give another --depth TOPIC")
    most = max(skipped, key=lambda reason: skipped[reason])
    return InputError(path, f"none of its {read} depth images is usable: {reasons(skipped)}", _REMEDIES[most])
