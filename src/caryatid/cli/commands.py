"""All commands: help, options, and the function that runs each, imported late; and how tyro parses them."""

from __future__ import annotations

import inspect
import io
import os
import re
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout, suppress
from dataclasses import asdict, dataclass, is_dataclass, make_dataclass
from difflib import get_close_matches
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import PrimitiveConstructorSpec

from caryatid.cli import options
from caryatid.config import ExportFormat, FusionMethod, NoiseModel, Preset, SegmentationMethod

SuiteName = Literal[
    "smoke", "fig5", "fig5-paper", "presets", "planners", "path", "ablation", "ablation-attention", "poses",
    "noise", "house", "easy", "heaps", "dismantle",
]  # fmt: skip
"""Names of the suites; the benchmark is imported later."""
VIEWER_PORT = 8770
"""Default port of the viewer; if taken, the next free one."""
Topics = Annotated[tuple[str, ...], tyro.conf.UseAppendAction, options.shown("TOPIC")]
Folder = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
ImagePath = Annotated[Path | None, options.shown("FILE")]


class RunCommand(options.ComputingCommand):
    """A command that writes a run folder."""

    source: str
    settings: options.Modelling = options.Modelling()
    out: options.OutPath = Path("run")
    """Run folder to write; replaces an existing run."""
    no_report: options.Flag = False
    """Do not write report.html."""


class Explore(RunCommand, options.ExploringCommand, work="run:explore_scene"):
    """Explore a scene view by view and infer which object supports which.

    SOURCE is one of:
      a built-in scene: tower, clutter, pile-8-0, dense-12-0, …
      an MJCF scene, simulated with robot and camera: an .xml file, or a folder with a scene.xml
      a recording: a folder in the BOP format; next views are chosen from its views

    Usage examples:
      caryatid explore tower --out run
      caryatid explore clutter --goal o3 --out run
      caryatid explore scene.xml --views 5 --out run
      caryatid explore tower --robot arm:arm.npz --out run
      caryatid explore recording/ --segmentation auto --out run
      caryatid explore clutter --stream rerun
    """

    source: options.SourceName
    """Scene or recording."""
    no_early_stop: options.Flag = False
    """Continue to the maximum number of views, even if no view is worth its path."""
    goal: Annotated[str | None, options.shown("OBJECT")] = None
    """Id or name of an object to remove: explore only what matters for that, until it is clear what moves."""
    until: Annotated[float | None, options.shown("P", "0.95 with --goal, else never")] = None
    """Stop when every support (with --goal, every effect of the removal) is known with this probability."""
    budget: Annotated[options.Seconds | None, options.shown("SECONDS", "as long as a view takes")] = None
    """Time for each view after the first; the robot then goes on while the view is being added."""
    stream: Annotated[str | None, options.shown("{FILE.rrd,FILE.mcap,rerun}")] = None
    """Also record each view for Rerun or Foxglove, or show it in Rerun's viewer."""


class Demo(RunCommand, work="run:run_demo"):
    """Explore a built-in cluttered table in simulation, and print what each view adds.

    Usage examples:
      caryatid demo
      caryatid demo --scene bridge
    """

    source: Annotated[str, tyro.conf.arg(name="scene", metavar="NAME")] = "clutter"
    """Built-in scene, such as tower, bridge or dense-12-0."""
    views: Annotated[options.Count | None, options.default_of("active.max_views")] = None
    """Maximum number of views, including the first."""


class View(options.ExploringCommand, work="run:show_run"):
    """Show a finished run in the browser, or explore a scene or recording interactively.

    SOURCE is one of:
      a run folder written by explore, extract or clear, or a session; it is not modified
      a built-in scene, an MJCF scene or a recording, as for explore

    By default, only this machine can open the page. The page works offline; Ctrl-C closes it.

    Usage examples:
      caryatid view run
      caryatid view clutter
      caryatid view recording/ --segmentation auto --port 8080 --no-browser
    """

    source: options.SourceName
    """Run, session, scene or recording."""
    host: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = "127.0.0.1"
    """Address to listen on; with any but 127.0.0.1, other machines can open the page by its full address."""
    port: options.Natural = VIEWER_PORT
    """Port to listen on; if taken, the next free one; 0 = any free port."""
    no_browser: options.Flag = False
    """Print the address of the page, but do not open a browser."""


class Extract(RunCommand, options.LookingCommand, work="run:extract_views"):
    """Extract shapes and a support graph from all views of a recording, or from one cloud.

    Usage examples:
      caryatid extract recording/ --out run
      caryatid extract table.pcd --segmentation auto --out run
    """

    source: options.SourceName
    """Recording (folder in the BOP format) or cloud (.pcd, .ply)."""
    more: Annotated[tuple[str, ...], tyro.conf.Positional, options.shown("[SOURCE ...]")] = ()
    """More recordings of the same scene, with poses in the same world."""
    label_divisor: options.Count = 1
    """For clouds with labels of object parts: object = label // N."""
    level: options.Flag = False
    """Rotate the world frame of a recording so that the table is level; use it if z does not point up."""


class Clear(options.LiftingCommand, options.ExploringCommand, work="run:clear_table"):
    """Clear a simulated table: look until the next lift is safe, remove the object, look again.

    Objects are lifted straight up, one by one. A lift disturbs another object if it moves that object by
    more than 2 cm or 15°.

    Usage examples:
      caryatid clear bridge
      caryatid clear clutter --goal o3 --hands 2
      caryatid clear scene.xml --risk 0.1 --out run
    """

    source: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")]
    """Built-in or MJCF scene."""
    out: options.OutPath = Path("run")
    """Run folder to write; replaces an existing run."""
    views: Annotated[options.Count | None, options.default_of("active.max_views")] = None
    """Maximum number of views before each lift."""
    no_report: options.Flag = False
    """Do not write report.html."""


class Import(options.Command, work="results:import_log"):
    """Convert a robot's log to a recording: sharp views from different viewpoints, with their poses.

    Read bags of ROS 1 (.bag) and ROS 2 (.mcap, .db3, or a folder with metadata.yaml), whose depth must be
    registered to colour. A folder of the TUM RGB-D benchmark, of nerfstudio (transforms.json with depth),
    Record3D or Stray Scanner needs no topics.

    Usage examples:
      caryatid import pour.bag --out pour
      caryatid import pour.bag --depth /depth/image --info /depth/camera_info --tf map --out pour
      caryatid import rgbd_dataset_freiburg1_desk --out desk
    """

    settings: options.Settings = options.Settings()
    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")]
    """Bag, TUM RGB-D folder with depth.txt, or folder of a phone's recording."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Recording to write, a folder in the BOP format; must be new or empty."""
    depth: Topics = ()
    """Depth images: 16UC1 or mono16 [mm], 32FC1 [m], or PNG-compressed. If omitted, list all topics.
    For several cameras, repeat --depth and --info."""
    info: Topics = ()
    """CameraInfo of the depth images."""
    rgb: Topics = ()
    """Colour images that depth is registered to; also used to pick sharp frames."""
    tf: Annotated[str | None, options.shown("FRAME")] = None
    """World frame with z up, such as map or base_link. If omitted, import one frame without a pose."""
    camera: Annotated[Path | None, options.shown("FILE.json")] = None
    """Intrinsics of a TUM RGB-D folder: fx, fy, cx, cy [px]. If omitted, the published values."""
    level: options.Flag = False
    """Rotate the world frame so that z points up from the table, which most views must show."""
    views: Annotated[options.Count | None, options.default_of("recording.max_views")] = None
    """Maximum number of views."""


class Check(options.Command, work="results:check_views"):
    """Check the views of a recording: unit and kind of depth, camera, axes and unit of poses, clocks.

    Say what each view shows and, in a line each, what is wrong and how to mend it. The exit status is 1 if
    something is wrong.

    Usage examples:
      caryatid check recording/
      caryatid check recording/ --report check.html
    """

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RECORDING")]
    """Recording: a folder in the BOP or TUM RGB-D format, or of a phone; import bags first."""
    report: Annotated[Path | None, options.shown("FILE.html")] = None
    """Also write a page with pictures of up to 12 views, and of all of them together."""
    level: options.Flag = False
    """Rotate the world frame so that the table is level before it is checked."""
    settings: options.Settings = options.Settings()


class Evaluate(options.Command, work="results:print_scores"):
    """Score each view of a run: precision, recall and F1 of vertices and edges, mean IoU, probabilities.

    Brier score (0 is perfect) and average precision (1 is perfect) rate the probabilities of supports
    between objects that were found.

    Usage examples:
      caryatid evaluate run
      caryatid evaluate run scenes/tower
    """

    run: options.RunPath
    """Run folder or session."""
    truth: Annotated[str | None, tyro.conf.Positional, options.shown("[GT]", "the run's source")] = None
    """Scene (built-in name, scene.xml or its folder), or a recording with masks and gt.json."""


class Order(options.LiftingCommand, options.ComputingCommand, work="results:find_order"):
    """Find a safe order in which to remove all objects, or to reach one.

    Rehearse each lift in physics, on the extracted shapes and on samples of their uncertainty, to estimate
    the probability that nothing else moves. If no order is safe, print the least risky one and the objects
    that block each other.

    Usage examples:
      caryatid order run
      caryatid order run --goal o3
      caryatid order run --risk 0.2
    """

    settings: options.Settings = options.Settings()
    run: options.RunPath
    """Run folder, session, or graph.json; settings and seed are those of the run, if not given."""
    seed: Annotated[options.Natural | None, options.shown(default="that of the run")] = None
    """Random seed of the rehearsals."""


class Report(options.LiftingCommand, options.Command, work="results:redraw_report"):
    """Write the report of a run again, optionally for a gripper, and also as a PDF.

    Usage examples:
      caryatid report run
      caryatid report run --gripper franka
      caryatid report run --pdf report.pdf
    """

    run: options.RunPath
    """Run folder or session; its report.html is replaced."""
    pdf: Annotated[Path | None, options.shown("FILE.pdf")] = None
    """Also write a PDF (A4); replaces an existing file."""
    settings: options.Settings = options.Settings()


class Describe(options.Command, work="results:describe_model"):
    """Describe the scene model of a run in plain text, for people and language models.

    Print objects with their sizes, what supports what with which probability, what supports nothing, and
    what is doubtful.

    Usage examples:
      caryatid describe run
    """

    run: options.RunPath
    """Run folder, session, or graph.json."""


class Why(options.Command, work="results:tell_reasons"):
    """Say why an object has its shape, or why two objects are two: what each explanation costs.

    Costs are in nats, and their terms add up; the explanation in use comes first. A run is computed
    again from its views.

    Usage examples:
      caryatid why run o3
      caryatid why run o3 o5
    """

    run: options.RunPath
    """Run folder or session."""
    objects: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="ID [ID]")]
    """One or two ids of objects."""


class Export(options.Command, work="results:export_model"):
    """Export the scene model of a run to simulators, 3D viewers, motion planners, and graph tools.

    With the suffix .rrd or .mcap, export every view of the run, for Rerun or Foxglove.

    Usage examples:
      caryatid export run --format mjcf --out scene.xml
      caryatid export run --format moveit --out scene.json --set export.frame=base_link
      caryatid export run --out scene.glb
      caryatid export run --out views.rrd
    """

    settings: options.Settings = options.Settings()
    run: options.RunPath
    """Run folder, session, or graph.json."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """File to write, with the suffix of its format; replaces an existing file."""
    format: Annotated[ExportFormat | None, options.shown(default="by the suffix of FILE")] = None
    """mjcf (.xml), usd: free bodies on a table; urdf: links fixed to the world; gltf (.glb): meshes;
    moveit (.json): planning scene; dot: the graph."""


class Benchmark(options.Command, work="results:compare_methods"):
    """Compare methods over scenes and seeds, and draw figures.

    Finished episodes are kept: stop at any time, and run the same command to continue. Without --suite,
    redraw the figures of the results in the folder.

    Usage examples:
      caryatid benchmark --suite smoke --out bench
      caryatid benchmark --suite planners --planner support --planner random --out bench
      caryatid benchmark --suite fig5 --scenes my-scenes/ --seeds 1 --out bench
      caryatid benchmark --suite planners --segmentation auto --noise none --out bench
    """

    out: Annotated[Path, tyro.conf.arg(metavar="DIR")]
    """Folder of the results; existing results are reused."""
    suite: Annotated[SuiteName | None, options.shown()] = None
    """Suite of methods, scenes and conditions to run."""
    scenes: Annotated[options.Words, options.shown("SCENE")] = ()
    """Replace the suite's scenes: a built-in name, a scene folder, or a folder of those; may be repeated."""
    planner: options.Several[Annotated[str, options.planner_name()]] = ()
    """Replace the suite's planners, by name or as module:Class; may be repeated."""
    fusion: options.Several[FusionMethod] = ()
    """Replace the suite's fusion; may be repeated."""
    segmentation: options.Several[SegmentationMethod] = ()
    """Replace the suite's segmentation; may be repeated. Default: labels."""
    noise: options.Several[NoiseModel] = ()
    """Replace the suite's camera noise; may be repeated. Default: carmine."""
    preset: Annotated[Preset | None, options.shown(default="the suite's")] = None
    """Settings to start from in all episodes: caryatid's defaults, or those of the paper."""
    set: Annotated[options.Words, options.shown("STAGE.NAME=VALUE")] = ()
    """Change one setting of all episodes, such as `--set noise.translation=0.02`; may be repeated."""
    seeds: Annotated[options.Count | None, options.shown(default="the suite's")] = None
    """Number of seeds; every episode runs with seeds 0 to N−1."""
    views: Annotated[options.Count | None, options.shown(default="the suite's")] = None
    """Number of views of every episode, including the first."""
    jobs: Annotated[options.Count | None, options.shown(default="all cores")] = None
    """Number of processes."""
    retry: options.Flag = False
    """Run failed episodes again."""
    reference: Annotated[str | None, options.shown("METHOD")] = None
    """Method that the others are compared with, instead of the suite's or, without that one, the first."""


class SessionStep(options.ComputingCommand):
    """A command on a session."""

    folder: Folder
    """Folder of the session."""


class New(SessionStep, options.PlanningCommand, work="sessions:begin_session"):
    """Create a session in a new folder.

    Usage examples:
      caryatid session new table
      caryatid session new table --segmentation auto --set "robot.camera_height=[1.2, 1.8]"
      caryatid session new table --robot arm:arm.npz
    """

    folder: Folder
    """Folder of the session; must be new or empty."""


class Add(SessionStep, work="sessions:add_view"):
    """Add a view; exit status 0 means that the view is safe on disk.

    camera.json: {"K": 3×3 [px], "T_world_camera": 4×4 [m], "depth_scale": mm per unit of depth (default 1)}
    The first view may omit T_world_camera: its table then defines the world frame (z = 0), --json prints the
    camera pose, and `next` requires --candidates.

    Usage examples:
      caryatid session add table --depth depth.png --camera camera.json
      caryatid session add table --depth depth.npy --rgb rgb.png --labels labels.png --camera camera.json
    """

    depth: Annotated[Path, tyro.conf.arg(metavar="D.png")]
    """Depth image: 16-bit PNG, or .npy in metres; 0 or NaN = no reading."""
    camera: Annotated[Path, tyro.conf.arg(metavar="C.json")]
    """Camera matrix, camera pose, and scale of the depth image."""
    rgb: ImagePath = None
    """Colour image: PNG, JPEG or .npy."""
    labels: ImagePath = None
    """Object number of each pixel: grey PNG or .npy; 0 = no object. An object has one number in all views."""
    number: Annotated[int | None, options.shown("N")] = None
    """Number of the view, from 0; makes a repeated command safe: an existing view is not added again."""


class Next(SessionStep, work="sessions:plan_view"):
    """Print the next best view as JSON: camera pose, platform pose, gaze, expected gain and reason.

    candidates.json: {"T_world_camera": [4×4 …] reachable poses, "path_length": [m …], "refused": [4×4 …]
    poses to which the robot cannot go after all}; all are optional

    Usage examples:
      caryatid session next table
      caryatid session next table --candidates candidates.json
    """

    candidates: Annotated[Path | None, options.shown("C.json")] = None
    """Candidate poses to choose from, instead of those that the session's robot reaches; or poses to omit."""


class Graph(SessionStep, work="sessions:show_graph"):
    """Print the current support graph in the format of graph.json.

    Usage examples:
      caryatid session graph table > graph.json
    """


class Take(SessionStep, work="sessions:report_change"):
    """Report that the robot removed or moved an object; exit status 0 means that this is safe on disk.

    moved.json: {"T": 4×4 [m], the object's motion as a rigid transform in the world frame}

    Usage examples:
      caryatid session take table o3
      caryatid session take table o3 --moved moved.json
    """

    object: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="ID")]
    """ID of the object."""
    moved: Annotated[Path | None, options.shown("T.json")] = None
    """The object's motion. If omitted, the object was removed."""
    number: Annotated[int | None, options.shown("N")] = None
    """Number of the report, from 0; makes a repeated command safe: the newest report is not repeated."""


class Undo(SessionStep, work="sessions:undo_last"):
    """Undo the last view, or the last report of a removed or moved object.

    Usage examples:
      caryatid session undo table
    """


@dataclass(frozen=True)
class Session:
    """Keep a scene model in a folder, and add views from the robot's own software.

    Saved data survives a crash. Only one command writes at a time.
    """

    step: New | Add | Next | Graph | Take | Undo

    @property
    def general(self) -> options.General:
        """Output options of the step."""
        return self.step.general

    def __call__(self) -> int | None:
        """Run the step."""
        return self.step()


class Serve(SessionStep, work="sessions:serve_sessions"):
    """Serve sessions over HTTP, for robot software in any language; /openapi.json describes the API.

    On 127.0.0.1, only programs on this machine can connect, without a token. Any other --host requires
    requests with `Authorization: Bearer TOKEN`. Traffic is not encrypted: use a network you trust.

    Usage examples:
      caryatid serve sessions
      CARYATID_TOKEN=$(openssl rand -hex 16) caryatid serve sessions --host 0.0.0.0
    """

    settings: options.Settings = options.Settings()
    folder: Folder
    """Folder of the sessions; created if missing."""
    host: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = "127.0.0.1"
    """Address to listen on."""
    port: options.Natural = 8765
    """Port to listen on; 0 = any free port."""
    token: Annotated[str | None, options.shown("TOKEN")] = None
    """Token that requests must send; prefer CARYATID_TOKEN, which process lists do not show."""
    open_sessions: options.Count = 4
    """Number of sessions kept in memory; others are computed again from their views on request."""
    waiting: options.Count = 16
    """Maximum number of requests that arrive or wait; further requests get status 503."""
    max_request: options.Count = 16
    """Maximum size of a request [MB]."""


class Scenes(options.Command, work="commands:print_scenes"):
    """List the built-in scenes and the sample recordings.

    Usage examples:
      caryatid scenes
    """


class Doctor(options.Command, work="results:describe_installation"):
    """Say what is installed and what is missing: versions, system, compiled kernels, Chromium, extras.

    Usage examples:
      caryatid doctor
    """


class Config(options.Command, work="commands:print_config"):
    """Print all settings as TOML, to edit and pass to --config.

    Usage examples:
      caryatid config > settings.toml
    """

    settings: options.Modelling = options.Modelling()


class Completion(options.Command, work="commands:print_completion"):
    """Print a shell completion script for commands, options, scenes, settings and files.

    Usage examples:
      source <(caryatid completion bash)
      caryatid completion bash > ~/.local/share/bash-completion/completions/caryatid
      caryatid completion zsh > "${fpath[1]}/_caryatid"
      caryatid completion fish > ~/.config/fish/completions/caryatid.fish
      caryatid completion tcsh > ~/.caryatid.tcsh && echo source ~/.caryatid.tcsh >> ~/.tcshrc
    """

    shell: Annotated[Literal["bash", "zsh", "fish", "tcsh"], tyro.conf.Positional]
    """Shell to print the script for."""


COMMANDS: dict[str, type[options.Command | Session]] = {
    command.__name__.lower(): command
    for command in (
        Demo, Check, Explore, Extract, View, Evaluate, Order, Clear, Import, Report, Describe, Why, Export,
        Benchmark, Session, Serve, Scenes, Doctor, Config, Completion,
    )
}  # fmt: skip
"""The commands in the order of the help."""

DESCRIPTION = """Explore a cluttered table and find out which object supports which.

Get started:
  caryatid demo                  explore a built-in table in simulation
  caryatid view clutter          watch an exploration in the browser, view by view
  caryatid explore tower         explore another built-in scene, or your own scene or recording
  caryatid extract sample-cloud  process one cloud, or all views of a recording
  caryatid order run             find a safe order in which to remove the objects of a run
  caryatid COMMAND --help        show what a command does, its options, and examples
"""
"""Text at the top of the help."""

MARKERS = (
    tyro.conf.FlagCreatePairsOff,
    tyro.conf.HelptextFromCommentsOff,
    tyro.conf.OmitArgPrefixes,
    tyro.conf.OmitSubcommandPrefixes,
)
"""How tyro turns fields into options."""


def read_command(arguments: Sequence[str]) -> Any:
    """Parse the arguments into a command that is ready to be called.

    Raises:
        SystemExit: After --help, with 0; on wrong options, with 2.
    """
    shown = sys.stdout.isatty() and sys.stderr.isatty() and not os.environ.get("NO_COLOR")
    tyro._experimental_options["ansi_codes"] = shown
    if list(arguments[:1]) in ([], ["help"]):
        arguments = [*arguments[1:], "--help"]
    name, *words = arguments
    if name.startswith("-"):
        return _parse(_any_command(), "caryatid", arguments).command
    if name not in COMMANDS:
        meant = "".join(f" Did you mean {word}?" for word in get_close_matches(name, COMMANDS, 1))
        sys.stderr.write(f"error: there is no command '{name}'.{meant} `caryatid --help` lists all.\n")
        raise SystemExit(2)
    try:
        return _parse(COMMANDS[name], f"caryatid {name}", words)
    except SystemExit as end:
        if end.code:
            _suggest(name, words)
        raise


def _parse(kind: Any, program: str, arguments: Sequence[str]) -> Any:
    description = None if kind in COMMANDS.values() else DESCRIPTION
    return tyro.cli(
        kind, prog=program, description=description, args=arguments, config=MARKERS, registry=options.REGISTRY
    )


def _suggest(name: str, words: Sequence[str]) -> None:
    """Print the value of an option that a mistyped one resembles."""
    choices = _choices(COMMANDS[name])
    for option, word in pairwise(words):
        known = choices.get(option, []) if not word.startswith("-") else []
        if word not in known and (meant := get_close_matches(word, known, 1)):
            sys.stderr.write(f"Did you mean {meant[0]}?\n")


def _choices(kind: Any, option: str = "") -> dict[str, list[str]]:
    """The words that each option of a command chooses from; `kind` is its type, or that of an option."""
    if isinstance(kind, PrimitiveConstructorSpec):
        return {option: list(kind.choices or ())}
    if get_origin(kind) is Literal:
        return {option: [str(word) for word in get_args(kind)]}
    if isinstance(kind, type) and is_dataclass(kind):
        hints = get_type_hints(kind, include_extras=True)
        parts = [(part, f"--{name.replace('_', '-')}") for name, part in hints.items()]
    else:
        parts = [(part, option) for part in (*get_args(kind), *getattr(kind, "__metadata__", ()))]
    return {name: words for part in parts for name, words in _choices(*part).items()}


def _any_command() -> Any:
    """The type of all commands, each with the first line of its help."""
    subcommands = []
    for name, command in COMMANDS.items():
        summary = (inspect.getdoc(command) or "").partition("\n")[0]
        spec = tyro.conf.subcommand(name, constructor=command, description=summary)
        subcommands.append(Annotated[Any, spec])
    # Where there is no help text, tyro looks for one in the sources of `typing`, which takes long.
    chosen: Any = Annotated[Union[tuple(subcommands)], tyro.conf.arg(help="")]  # noqa: UP007
    version: Any = Annotated[bool, tyro.conf.arg(help="Print the version.", help_behavior_hint="")]
    return make_dataclass("Caryatid", [("command", chosen), ("version", version, False)])


def print_scenes(command: Scenes) -> None:
    from caryatid.cli.output import table
    from caryatid.io.datasets import DESCRIPTIONS
    from caryatid.simulation.scenes import list_scenes

    scenes, columns = list_scenes(), ("name", "description")
    shown = table("Built-in scenes", columns, scenes.items()), table("Samples", columns, DESCRIPTIONS.items())
    command.output.result({"scenes": scenes, "samples": DESCRIPTIONS}, *shown)


def print_config(command: Config) -> None:
    from caryatid.config.settings import write_settings

    config = command.settings.read()
    command.output.result(asdict(config), write_settings(config))


OFFERS = """

def offer_values(command, names):
    for option in command['options']:
        if '--set' in option['flags']:
            option.update(type='choice', choices=SETTINGS)
    for name, child in command['subcommands'].items():
        offer_values(child, [])
    command['subcommands'].update((name, dict(command, subcommands={})) for name in names)

for name, command in COMPLETION_SPEC['subcommands'].items():
    offer_values(command, SOURCES.get(name, []))
"""
"""What tyro's script does not know: settings and sources. Fish quotes it: no double quote, backslash or $."""
FILES = {
    "get_completions(words, current_index, COMPLETION_SPEC)  #": (
        "get_completions(words, current_index, COMPLETION_SPEC) or ['__TYRO_COMPLETE_FILES__']  #"
    ),
    'compgen -f -- "$cur"': 'compgen -f -- "${COMP_WORDS[COMP_CWORD]}"',
    '  COMPREPLY=("${matches[@]}")\n': (
        '  COMPREPLY=("${matches[@]}")\n'
        '  if [[ "${COMPREPLY[0]}" == *= ]]; then compopt -o nospace 2> /dev/null; fi\n'
    ),
}
"""Changes to tyro's script: files wherever nothing else is known, and no space after a setting's =."""


def print_completion(command: Completion) -> None:
    from caryatid.config import Config as AllSettings
    from caryatid.io.datasets import DESCRIPTIONS
    from caryatid.simulation.scenes import DESIGNED

    script = io.StringIO()
    with redirect_stdout(script), suppress(SystemExit):
        _parse(_any_command(), "caryatid", ["--tyro-write-completion", command.shell, "-"])
    settings = [f"{stage}.{name}=" for stage, values in asdict(AllSettings()).items() for name in values]
    both = [*DESIGNED, *(name for name in DESCRIPTIONS if "recording" in name)]
    sources = {"explore": both, "view": both, "clear": [*DESIGNED], "extract": [*DESCRIPTIONS]}
    offers = OFFERS.replace("SETTINGS", repr(settings)).replace("SOURCES", repr(sources))
    known = re.sub(
        "^COMPLETION_SPEC = .*", lambda line: line[0] + offers, script.getvalue(), flags=re.MULTILINE
    )
    for old, new in FILES.items():
        known = known.replace(old, new)
    command.output.result({"shell": command.shell, "script": known}, known)
