"""What SOURCE and RUN of the command line are: a scene, a recording, a cloud, a run, a session, a graph."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import NoneType
from typing import Any, Literal, NamedTuple

import numpy as np

from caryatid.config import Config, NoiseModel, SegmentationMethod
from caryatid.errors import InputError, NoSurfaceError, PerceptionError, WrongViewError, check_type
from caryatid.evaluation.scores import TrueScene
from caryatid.evaluation.truths import true_scene_from_simulation
from caryatid.exploration import Explorer, Step
from caryatid.graph import SupportGraph
from caryatid.io.cloud_frames import level_cloud
from caryatid.io.datasets import Dataset, OpenOptions, find_sample, format_of, join_datasets, open_dataset
from caryatid.io.graph_json import read_graph
from caryatid.io.importing import choose_frames, levelled
from caryatid.io.mask_sources import MaskSource, without_ignored
from caryatid.io.point_clouds import read_stored_cloud
from caryatid.robots import HUMANOID, Robot, find_robot
from caryatid.robots.protocol import RecordingCamera, RecordingRobot
from caryatid.scene import KEPT, LEFT_OUT, Scene
from caryatid.sensing.views import Camera
from caryatid.sensing.voxel_map import VoxelMap
from caryatid.sessions.session import Session, is_session
from caryatid.simulation.scenes import is_builtin, load_scene
from caryatid.simulation.setup import make_simulation
from caryatid.steps import Run, RunWriter, is_run, read_config, read_run, read_steps

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False, slots=True)
class Source:
    """A scene or recording to explore.

    Attributes:
        name: Short name.
        camera: Camera that takes the views.
        robot: Robot, placed at the first view.
        truth: Ground truth, or None if unknown.
    """

    name: str
    camera: Camera = field(repr=False)
    robot: Robot = field(repr=False)
    truth: TrueScene | None = field(repr=False)


Kind = Literal["scene", "recording", "cloud", "run", "session", "graph"]


def kind_of(source: str) -> Kind:
    """Return what SOURCE or RUN is; names of built-in scenes and samples come before files."""
    path = find_sample(source)
    if not is_name(source):
        if path.suffix == ".json" and path.is_file():
            return "graph"
        if is_run(path):
            return "run"
        if is_session(path):
            return "session"
    if path.suffix.lower() in (".pcd", ".ply"):
        return "cloud"
    if is_builtin(source) or not path.exists() or format_of(path) is None:
        return "scene"
    return "recording"


def is_name(source: str) -> bool:
    """Whether SOURCE is the name of a built-in scene or a sample."""
    return is_builtin(source) or find_sample(source) != Path(source)


class Model(NamedTuple):
    """What is known of a scene: graph, settings, seed, and which space was seen free; None = unknown."""

    graph: SupportGraph
    config: Config
    seed: int
    space: VoxelMap | None


def read_known_graph(path: Path) -> SupportGraph:
    """Read the graph of a run, a session, or a graph.json.

    Raises:
        InputError: It is none of these, or the file is missing or broken.
    """
    if path.is_file():
        return read_graph(path)
    if not is_session(path):
        return read_run(path).graph
    with Session.open(path, read_only=True) as session:
        return session.graph


def read_model(path: Path) -> Model:
    """Read the model of a run, a session, or a graph.json, which has no more than its graph.

    Raises:
        InputError: It is none of these, or a file in it is missing or broken.
    """
    if path.is_file():
        return Model(read_graph(path), Config(), 0, None)
    if not is_session(path):
        run = read_run(path)
        return Model(run.graph, read_config(run), run.record["seed"], run.views[-1].load_step().voxels)
    with Session.open(path, read_only=True) as session:
        scene = session.scene
        return Model(scene.graph, scene.config, scene.seed, scene.voxels)


def read_scene(path: Path) -> Scene:
    """Compute the scene model of a run again from its views, or read that of a session.

    Raises:
        InputError: It is neither, a file in it is missing or broken, or it is of a cloud or another version.
    """
    if is_session(path):
        with Session.open(path, read_only=True) as session:
            return session.scene
    run = read_run(path)
    options, seed = run.record["options"], run.record["seed"]
    scene = Scene(read_config(run), segmentation=options.get("segmentation"), seed=seed)
    for step in read_steps(run):
        if step.view is None:
            raise InputError(path, "is of a cloud, without views", "give a run of depth images, or a session")
        scene.update(step.view)
        if step.lift is not None:
            scene.removed(step.lift.object_id)
    if scene.graph.to_networkx().edges != run.graph.to_networkx().edges:
        raise InputError(path, "gives another graph with this version", "extract or explore again")
    return scene


@contextmanager
def open_run(folder: Path) -> Iterator[Run]:
    """Read a run; a session is replayed into one, which is deleted at the end of the `with` block.

    Raises:
        InputError: It is neither, a file in it is missing or broken, or a session has no view of a table.
    """
    if not is_session(folder):
        yield read_run(folder)
        return
    with TemporaryDirectory() as place, Session.open(folder, read_only=True) as session:
        b, copy = session.beginning, Path(place) / "run"
        options = {"planner": b.planner, "robot": b.robot, "segmentation": b.segmentation}
        about: dict[str, Any] = {"command": "session", "source": str(folder), "seed": b.seed}
        with RunWriter(copy, b.settings, about | {"options": options}) as writer:
            for step in session.replay():
                writer.add(step)
        yield replace(read_run(copy), folder=folder)


def open_source(
    source: str,
    config: Config,
    *,
    noise: NoiseModel,
    segmentation: SegmentationMethod | None,
    seed: int,
    robot: str = HUMANOID,
    masks: MaskSource | None = None,
    ignore: Path | None = None,
    level: bool = False,
    keyframe: str | None = None,
) -> Source:
    """Open an MJCF file or folder, the name of a built-in scene, or a recording.

    The other arguments are as in `simulate` for a scene, and as in `open_recording` for a recording.

    Raises:
        InputError: The source is unknown, broken, or lacks required labels; or the robot is unknown, a
            robot or keyframe is given for a recording, or an ignore mask or `level` for a simulation.
        PlanningError: The robot cannot reach a view of the table.
    """
    kind = _viewable(source)
    if kind == "cloud":
        raise InputError(source, "a single cloud cannot be explored", "use `caryatid extract`")
    if kind == "recording":
        if robot != HUMANOID:
            reason = "a recording has no robot, because its camera poses are fixed"
            raise InputError(source, reason, "omit --robot")
        if keyframe is not None:
            raise InputError(source, "is a recording, and --keyframe is for scenes", "omit --keyframe")
        recording = open_recording(source, config, segmentation, masks, ignore, level)
        poses = [np.eye(4) if f.T_world_camera is None else f.T_world_camera for f in recording.frames]
        return Source(recording.path.name, RecordingCamera(recording), RecordingRobot(poses), None)
    for option, given in (("--ignore", ignore is not None), ("--level", level)):
        if given:
            raise InputError(source, f"is a simulation, and {option} is for recordings", f"omit {option}")
    return simulate(source, noise=noise, robot=robot, seed=seed, config=config, keyframe=keyframe)


def simulate(
    scene: str | Path = "clutter",
    *,
    noise: NoiseModel = "carmine",
    robot: str = HUMANOID,
    seed: int = 0,
    config: Config | None = None,
    keyframe: str | None = None,
) -> Source:
    """Simulate a scene, a robot in front of it, and the robot's camera.

    Args:
        scene: Name of a built-in scene, an MJCF file, or a folder with a `scene.xml`.
        noise: Noise of the camera: `carmine`, or `none`.
        robot: Name of the robot: `humanoid`, `arm:FILE.npz` or `module:callable`.
        seed: Seed of the noise.
        config: All settings, or None for the defaults.
        keyframe: Name or number of a keyframe of an MJCF scene to start from; None = `home` or the only one.

    Returns:
        The camera, the robot at its first view, and the ground truth.

    Raises:
        InputError: The scene, keyframe, noise model or robot is unknown.
        PlanningError: The robot cannot reach a view of the table.
    """
    check_type("scene", scene, (str, Path), "give the name of a built-in scene, or an MJCF file")
    check_type("config", config, (Config, NoneType), "give a caryatid.Config")
    check_type("robot", robot, str, "give the name of a robot, such as humanoid")
    config = config or Config()
    make, loaded = find_robot(robot), load_scene(scene, config.physics, keyframe)
    truth = true_scene_from_simulation(loaded)
    made = make_simulation(loaded, config, noise=noise, seed=seed, robot=make)
    return Source(loaded.name, made.camera, made.robot, truth)


def open_recording(
    folder: str,
    config: Config,
    segmentation: SegmentationMethod | None,
    masks: MaskSource | None = None,
    ignore: Path | None = None,
    level: bool = False,
    more: Sequence[str] = (),
) -> Dataset:
    """Open a dataset and decode every frame once, to report a broken frame before any other work.

    It is joined with `more` of the same scene, whose poses are in the same world. A few sharp frames are
    chosen from a video. A mask source replaces the masks of the dataset. Pixels of a mask to ignore are
    dropped, as by `without_ignored`. With `level`, the world frame is rotated so that the table is level. The
    segmentation is `labels`, `auto`, or None to use labels if available.

    Raises:
        InputError: The dataset or the mask is broken, required labels are missing, a segment is too small
            for a shape, or no table is visible to level the world frame.
    """
    use_masks = masks is None and segmentation != "auto"
    opened = [open_dataset(f, config.recording, OpenOptions(masks=use_masks)) for f in (folder, *more)]
    recording = join_datasets([choose_frames(d, config.recording) if d.is_video else d for d in opened])
    if ignore is not None:
        drop = partial(without_ignored, ignore=ignore, max_pixels=config.recording.max_pixels)
        recording = replace(recording, frames=[frame.changed(drop) for frame in recording.frames])
    if level:
        recording = levelled(recording, config)
    for note in recording.notes:
        log.info(note)
    if segmentation == "labels" and use_masks and not recording.has_labels:
        raise InputError(folder, "has no masks", "add mask_visib/, or use --segmentation auto")
    points: Counter[int] = Counter()
    for frame in recording.frames:
        view = frame.load()
        if view.labels is not None and use_masks:
            pixels = np.bincount(view.labels[view.valid])
            points.update({label: int(pixels[label]) for label in np.flatnonzero(pixels).tolist()})
    if segmentation != "auto":
        _check_segments(folder, points, config)
    return recording


def extract(
    source: str,
    config: Config,
    *,
    segmentation: SegmentationMethod | None,
    seed: int,
    label_divisor: int = 1,
    masks: MaskSource | None = None,
    ignore: Path | None = None,
    level: bool = False,
    more: Sequence[str] = (),
) -> Iterator[Step]:
    """Open a recording or a cloud, and return the steps of all its views.

    A recording is joined with `more` of the same scene. For a cloud with labels of object parts, object =
    label // `label_divisor`. The other arguments are as in `open_source`, but the seed is that of every
    random choice.

    Raises:
        InputError: The source is unknown, broken, or lacks required labels; or masks are given for a cloud.
        PerceptionError: A cloud shows no support surface.
    """
    kind = _viewable(source)
    if is_builtin(source):
        raise InputError(source, "a scene, which has no views yet", f"use `caryatid explore {source}`")
    explorer = Explorer(config=config, segmentation=segmentation, seed=seed, masks=masks)
    if kind != "cloud":
        opened = open_recording(source, config, segmentation, masks, ignore, level, more)
        return _look_at_all(explorer, opened)
    if more:
        raise InputError(source, "a single cloud cannot be joined with others", "give recordings only")
    if masks is not None or ignore is not None:
        remedy = "omit --masks and --ignore; a cloud has its labels in the field label"
        raise InputError(source, "masks need images, and a cloud has none", remedy)
    stored, use_labels = read_stored_cloud(source, label_divisor), segmentation != "auto"
    if segmentation == "labels" and stored.labels is None:
        raise InputError(source, "has no field label", "use --segmentation auto")
    if use_labels and stored.labels is not None:
        _check_segments(source, Counter(stored.labels[stored.kept].tolist()), config)
    cloud = level_cloud(stored, config, np.random.default_rng(seed), use_labels=use_labels)
    return (replace(step, labels=stored.spread(step.labels)) for step in map(explorer.look, [cloud]))


def _viewable(source: str) -> Kind:
    """Return the kind of a source; refuse what has no views to take, and say if a name hides a file."""
    kind, lifts = kind_of(source), f"plan lifts with `caryatid order {source}`"
    if kind == "graph":
        remedy = f"{lifts}, or make it a scene with `caryatid export {source} --out scene.xml`"
        raise InputError(source, "is a graph, not a scene or recording", remedy)
    if kind in ("run", "session"):
        remedy = (
            f"view it with `caryatid view {source}`, score it with `caryatid evaluate {source}`, or {lifts}"
        )
        raise InputError(source, f"is a {kind}, not a scene or recording", remedy)
    if is_name(source) and Path(source).exists():
        hint = "%s: using the one that comes with caryatid; for the file or folder here, write ./%s"
        log.info(hint, source, source)
    return kind


def _look_at_all(explorer: Explorer, recording: Dataset) -> Iterator[Step]:
    """The steps of all views, or the error of the last if none shows a support surface."""
    newest = None
    for left, frame in zip(range(len(recording))[::-1], recording.frames, strict=True):
        try:
            for step in explorer.looks(frame.load()):
                if newest is not None:
                    yield newest
                newest = step
        except NoSurfaceError as error:
            if not left:
                raise
            log.warning(KEPT, error)
        except (WrongViewError, PerceptionError) as error:
            if newest is None:
                raise
            log.warning(LEFT_OUT, error)
    if newest is not None:
        yield explorer.conclude_step(newest)


def _check_segments(source: str, points: Mapping[int, int], config: Config) -> None:
    """Reject a segment with fewer points than a shape needs; 0 is not an object."""
    least = config.fit.min_points
    small = sorted(label for label, count in points.items() if label != 0 and count < least)
    if small:
        reason = f"segment {small[0]} has {points[small[0]]} points with depth, but a shape needs {least}"
        raise InputError(source, reason, "remove or enlarge its mask, or use --segmentation auto")
