"""Datasets: sequences of frames in any format, decoded one by one.

An input format is a module or object with two functions, `recognises(path)` and
`open_dataset(path, config, options)`. Other packages offer formats as entry points of the group
`caryatid.datasets`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from importlib.metadata import entry_points
from operator import attrgetter
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from caryatid.config import RecordingConfig
from caryatid.errors import InputError, did_you_mean
from caryatid.geometry.transforms import Array
from caryatid.segmentation.diagnosis import BODY, GL, ray_lengths
from caryatid.sensing.views import View

BUILT_IN: Final = ("phones", "bop", "tum", "bags")
"""Modules of `caryatid.io` that are formats, in the order in which they are tried."""
ENTRY_POINTS: Final = "caryatid.datasets"
"""Group of the entry points of other packages' formats."""
NO_COLOUR: Final = "no colour image at that time"
NO_POSE: Final = "no pose"
"""Reasons why a frame of a video does not become a view."""

SAMPLES: Final = Path(__file__).parents[1] / "samples"
"""Folder of the samples in the package."""
DESCRIPTIONS: Final = {
    "sample-recording": "eight views of the simulated scene clutter, with noise, masks and ground truth",
    "sample-cloud": "points of the same scene from all sides, with normals and labels",
}
"""Description of each sample."""


def find_sample(source: str | Path) -> Path:
    """Return the path of the sample with this name, or else the given path."""
    return next(SAMPLES.glob(f"{source}*")) if str(source) in DESCRIPTIONS else Path(source)


@dataclass(frozen=True, eq=False, slots=True)
class Frame:
    """One frame of a dataset, not decoded yet.

    Attributes:
        name: Name of the view it becomes.
        number: Its number in the dataset.
        load: Decodes it. Raises `caryatid.io.images.BrokenImageError` if its image is broken, which others
            may not be, and another `InputError` if it does not fit the dataset.
        T_world_camera: Camera pose (4, 4), or None if unknown.
        time: Time of the image [ns]; 0 if it has none.
        has_labels: Whether its view has labels.
    """

    name: str
    number: int
    load: Callable[[], View]
    T_world_camera: Array | None = None
    time: int = 0
    has_labels: bool = False

    def changed(self, change: Callable[[View], View], **fields: Any) -> Frame:
        """Return a frame with other fields, whose view is changed by a function when it is loaded."""
        return replace(self, load=lambda: change(self.load()), **fields)

    def load_labels(self) -> NDArray[np.int32]:
        """Decode it for its labels (H, W) alone.

        Raises:
            InputError: It has none, or is broken.
        """
        labels = self.load().labels
        if labels is None:
            raise InputError(self.name, "has no masks", "add mask_visib/ and scene_gt.json")
        return labels


@dataclass(frozen=True, eq=False)
class Dataset(Sequence[View]):
    """A sequence of views, decoded on access from its frames and not kept.

    Attributes:
        path: File or folder.
        frames: The frames, in order.
        skipped: Number of others that cannot become views, by reason.
        notes: Notes for the user.
        is_video: Whether neighbouring frames show nearly the same, so that a few should be chosen.
    """

    path: Path
    frames: Sequence[Frame]
    skipped: Mapping[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    is_video: bool = False

    def __repr__(self) -> str:
        return f"Dataset('{self.path}', {len(self.frames)} views)"

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [frame.load() for frame in self.frames[index]]
        return self.frames[index].load()

    @property
    def has_poses(self) -> bool:
        """Every frame has a pose."""
        return all(frame.T_world_camera is not None for frame in self.frames)

    @property
    def has_labels(self) -> bool:
        """Every frame has labels."""
        return all(frame.has_labels for frame in self.frames)

    def frame(self, name: str) -> Frame:
        """Return the frame whose name ends as `name` does after its last slash.

        Raises:
            InputError: There is none.
        """
        for frame in self.frames:
            if frame.name.rpartition("/")[2] == name.rpartition("/")[2]:
                return frame
        raise InputError(self.path, f"has no frame '{name}'", "give the recording of this run")


def join_datasets(datasets: Sequence[Dataset]) -> Dataset:
    """Join datasets of one scene, whose poses share a world; their frames are ordered by time and renumbered.

    Raises:
        InputError: One of several has no poses.
    """
    first, *others = datasets
    if not others:
        return first
    for dataset in datasets:
        if not dataset.has_poses:
            remedy = "give poses in one world to all, such as --tf FRAME of import"
            raise InputError(dataset.path, "has no camera poses, so it cannot be joined with others", remedy)
    frames = sorted((frame for dataset in datasets for frame in dataset.frames), key=attrgetter("time"))
    title = "+".join(dict.fromkeys(dataset.path.resolve().name for dataset in datasets))

    def renumbered(number: int, frame: Frame) -> Frame:
        name = f"{title}/{number:06d}"
        return frame.changed(lambda view: replace(view, name=name), name=name, number=number)

    skipped = sum((Counter(dataset.skipped) for dataset in datasets), Counter[str]())
    notes = tuple(dict.fromkeys(note for dataset in datasets for note in dataset.notes))
    return Dataset(first.path, [renumbered(*each) for each in enumerate(frames)], skipped, notes)


@dataclass(frozen=True, slots=True)
class OpenOptions:
    """Options of formats.

    Attributes:
        depth: Topic of a bag's depth images, registered to colour if there is any.
        info: Topic of the depth images' camera.
        rgb: Topic of colour images, or None.
        world: Frame of a bag that is the world, level with z up; None takes no poses.
        camera_file: Camera of a TUM RGB-D folder, or None for the published ones.
        masks: Whether the masks of a recording are read.
    """

    depth: str | None = None
    info: str | None = None
    rgb: str | None = None
    world: str | None = None
    camera_file: Path | None = None
    masks: bool = True


def format_of(path: Path) -> Any:
    """The format of a path: a module or object with `recognises` and `open_dataset`, or None."""
    ours = (import_module(f"caryatid.io.{name}") for name in BUILT_IN)
    others = (entry_point.load() for entry_point in entry_points(group=ENTRY_POINTS))
    return next((known for known in (*ours, *others) if known.recognises(path)), None)


def open_dataset(
    path: str | Path, config: RecordingConfig | None = None, options: OpenOptions | None = None
) -> Dataset:
    """Open a BOP scene or TUM RGB-D folder, a bag, a phone's recording, or a format of another package.

    Raises:
        InputError: It does not exist, has an unknown format, or is damaged.
    """
    path = find_sample(path)
    known = format_of(path) if path.exists() else None
    if known is None:
        bags = "a bag (.bag, .mcap, .db3, or a folder with metadata.yaml)"
        phones = "a recording of nerfstudio, Record3D or Stray Scanner"
        meant = did_you_mean(str(path), DESCRIPTIONS)
        remedy = f"{meant}give a BOP scene folder, {bags}, a TUM RGB-D folder with depth.txt, or {phones}"
        raise InputError(path, "unknown format" if path.exists() else "no such file or folder", remedy)
    config = config or RecordingConfig()
    dataset = known.open_dataset(path, config, options or OpenOptions())
    if (config.axes, config.depth) == ("optical", "axis"):
        return dataset
    axes = {"optical": np.eye(4), "opengl": GL, "body": BODY}[config.axes]

    def convert(view: View) -> View:
        """Give a view of another convention our camera axes and depth."""
        if config.depth == "ray":
            view = replace(view, depth=(view.depth / ray_lengths(view)).astype(np.float32))
        return view if view.T_world_camera is None else view.with_pose(view.T_world_camera @ axes)

    poses = [None if (T := f.T_world_camera) is None else T @ axes for f in dataset.frames]
    frames = [f.changed(convert, T_world_camera=T) for f, T in zip(dataset.frames, poses, strict=True)]
    return replace(dataset, frames=frames)
