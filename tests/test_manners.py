"""Manners all commands share: help with examples, one document with --json, no colour where nobody looks."""

from __future__ import annotations

import inspect
import io
import json
import os
import pickle
import re
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from bag_files import write_tum
from conftest import SMALL, run_command, write_view_files
from test_benchmark import fill
from test_import import camera_file

from caryatid import __version__
from caryatid.benchmark.store import RESULTS
from caryatid.cli import commands
from caryatid.cli.commands import COMMANDS as TOP
from caryatid.cli.commands import read_command
from caryatid.errors import InputError, PerceptionError, in_one_line

ESCAPE = "\x1b"
QUICK = ["--set", "rehearsal.draws=2", "--risk", "0.5"]
STEPS = ("new", "add", "next", "graph", "undo")
COMMANDS = [name for name in TOP if name != "session"] + [f"session {step}" for step in STEPS]


def documented(command):
    """The docstring of a command."""
    name, _, step = command.partition(" ")
    return inspect.getdoc(getattr(commands, step.capitalize()) if step else TOP[name])


def examples(command):
    """What the help says one may try, without what the shell does with the result."""
    _, _, block = documented(command).partition("Usage examples:\n")
    return [line.strip() for line in block.splitlines() if line.strip()]


# Help


@pytest.mark.parametrize("command", ["session", *COMMANDS])
def test_help_is_clean_and_its_examples_are_commands(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    assert run_command(*command.split(), "--help") == 0
    text = capsys.readouterr().out
    assert not re.search(r"None|default: (False|True)|\b(STR|INT|PATH)\b", text)
    assert not re.search(r"default: .*default: [^│]*\)\s*│", text)
    tried = [] if command == "session" else examples(command)
    assert tried or command == "session"
    assert all(" ".join(example.split()) in " ".join(text.split()) for example in tried)
    for example in tried:
        words = shlex.split(re.sub(r"\$\([^)]*\)|.*<\((.*)\)", r"\1", example), comments=True)
        words = words[words.index("caryatid") + 1 :]
        ends = [words.index(sign) for sign in (">", "|", "&&") if sign in words]
        words = words[: min(ends, default=len(words))]
        assert words[: len(command.split())] == command.split()
        assert read_command(words).general is not None


def test_the_help_of_all_says_where_to_begin_and_each_command_in_a_line(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "160")

    def said(words):
        assert run_command(*words.split()) == 0
        return capsys.readouterr().out

    text = said("--help")
    assert text == said("help") == said("")
    assert said("explore --help") == said("help explore")
    lines = text.splitlines()
    begin = lines.index("Get started:")
    assert lines[begin + 1].split()[:2] == ["caryatid", "demo"]
    for name in TOP:
        (line,) = (line for line in lines if f"• {name} " in line)
        assert inspect.getdoc(TOP[name]).splitlines()[0][:60] in line
    assert "Usage examples:" not in lines
    assert "Print the version." in text
    assert said("--version") == said("-V") == said("version") == f"caryatid {__version__}\n"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("explore", "SOURCE"),
        ("session", "{new, add, next, graph, take, undo}"),
        ("session add", "DIR"),
        ("explore tower --out x --fusion k", "Expected one of ('pc', 'sg', 'pc+sg')"),
        ("session new x --segmentation k", "Expected one of ('labels', 'auto')"),
        ("explore tower --out x --planner k", "Expected one of ('support', 'attention', 'paper', 'random'"),
        ("export x --out x --format k", "Expected one of ('mjcf', 'urdf', 'usd', 'gltf', 'moveit'"),
        ("explore tower --out x --views 0", "0 is not an integer of at least 1"),
        ("explore tower --out x --seed -1", "-1 is not an integer of at least 0"),
        ("explore tower --out x --colour", "--colour"),
        ("juggle", "juggle"),
        ("expore tower", "Did you mean explore?"),
        ("explore tower --planner suport", "Did you mean support?"),
        ("benchmark --suite smok", "Did you mean smoke?"),
        ("benchmark --planner suport", "Did you mean support?"),
        ("explore tower --noise carmin", "Did you mean carmine?"),
        ("session new x --segmentation lables", "Did you mean labels?"),
    ],
)
def test_a_usage_error_is_short_and_names_the_remedy(words, said, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    assert run_command(*words.split()) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert said in captured.err
    assert len(captured.err.splitlines()) < 20


# --json


@pytest.fixture(scope="module")
def kept(tmp_path_factory, views):
    """A recording to import, results of a benchmark and a session, to be read."""
    folder = tmp_path_factory.mktemp("kept")
    write_tum(folder / "tum", views)
    camera_file(folder, views[0].K).rename(folder / "tum.json")
    fill(folder / "bench" / RESULTS, ("support", "random"), scenes=2)
    write_view_files(folder, views[0])
    add = ["--depth", folder / "depth.png", "--labels", folder / "labels.png", "--camera"]
    assert run_command("session", "new", folder / "session", "--quiet") == 0
    assert run_command("session", "add", folder / "session", *add, folder / "camera.json", "--quiet") == 0
    return folder


WORKING = {
    "demo": ("--scene tower --views 1 --out {out} {small}", {"run", "graph"}),
    "explore": ("{scene} --views 1 --out {out} {small}", {"run", "graph"}),
    "extract": ("{recording} --out {out}", {"run", "graph"}),
    "evaluate": ("{run} {scenes}", {"views", "warnings"}),
    "order": ("{run} {quick}", {"steps", "safe", "refusal"}),
    "clear": ("{scene} --views 2 --out {out} {small} {quick}", {"success", "steps", "left"}),
    "import": ("{kept}/tum --camera {kept}/tum.json --out {out}", {"recording", "views", "frames"}),
    "report": ("{run}", set()),
    "describe": ("{run}", {"text"}),
    "export": ("{run} --out {out}.xml", {"file", "format"}),
    "benchmark": ("--out {bench}", {"results", "suites"}),
    "session new": ("{out}", {"session", "views"}),
    "session add": ("{session} {view}", {"view", "changed", "graph"}),
    "session next": ("{session}", {"T_world_camera", "why"}),
    "session graph": ("{session}", {"objects", "supports"}),
    "session take": ("{session} o1", {"views", "graph"}),
    "session undo": ("{session}", {"views", "graph"}),
    "scenes": ("", {"scenes", "samples"}),
    "config": ("", {"fit", "fusion"}),
    "completion": ("bash", {"shell", "script"}),
    "serve": ("{out} --port 0", set()),
    "view": ("{run} --no-browser --port 0", set()),
}
"""Words that make each command work, and keys of its document; `serve` and `view` go on until stopped."""
PRINTING = (
    "evaluate",
    "order",
    "describe",
    "clear",
    "scenes",
    "config",
    "completion",
    "session next",
    "session graph",
)
"""Those that print a result also with --quiet and without --json."""
ENDING = [name for name in WORKING if name not in ("serve", "view")]


@pytest.fixture
def words(tmp_path, kept, kept_run, scene_file, recording):
    """The words that make a command work, in a folder of its own."""

    def spelled(command):
        for name in ("session", "bench"):
            shutil.copytree(kept / name, tmp_path / name)
        places = {
            "out": tmp_path / "out", "kept": kept, "run": kept_run, "scene": scene_file,
            "scenes": scene_file.parent, "recording": recording, "session": tmp_path / "session",
            "bench": tmp_path / "bench", "small": shlex.join(SMALL), "quick": shlex.join(QUICK),
            "view": f"--depth {kept}/depth.png --labels {kept}/labels.png --camera {kept}/camera.json",
        }  # fmt: skip
        return [*command.split(), *shlex.split(WORKING[command][0].format(**places))]

    return spelled


@pytest.mark.slow
@pytest.mark.parametrize("command", ENDING)
def test_with_json_stdout_is_one_document_and_stderr_is_empty(command, words, capfd):
    capfd.readouterr()
    assert run_command(*words(command), "--json") == 0
    said = capfd.readouterr()
    assert said.err == ""
    assert json.loads(said.out).keys() >= WORKING[command][1]
    assert said.out.endswith("\n")


# Environments that lack something


POOR = {"TMPDIR": "/nowhere", "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


def begun(words, redirected="", folder=None):
    """A quiet command without HOME, TMPDIR and UTF-8, in a shell that redirects it."""
    shell = ["sh", "-c", f'exec "$@" {redirected}', "sh", sys.executable, "-m", "caryatid"]
    known = {name: value for name, value in os.environ.items() if name != "HOME"} | POOR
    return subprocess.Popen(
        [*shell, *map(str, words), "--quiet"], cwd=folder, env=known, text=True,
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


REDIRECTED = [(command, to) for to in (">&- 2>&-", ">/dev/full") for command in ENDING]
REDIRECTED += [(command, "") for command in PRINTING]
"""Without the other commands in a pipe: they print nothing, and so end in /dev/full as they would there."""


@pytest.mark.slow
@pytest.mark.parametrize(("command", "redirected"), REDIRECTED)
def test_a_command_ends_well_or_in_one_line_whatever_is_missing(command, redirected, words):
    """Also in a folder that nobody, not even root, can write to."""
    process = begun(words(command), redirected, "/sys")
    _, said = process.communicate(timeout=120)
    assert process.returncode == (redirected == ">/dev/full" and command in PRINTING), said
    assert said.count("\n") == process.returncode


@pytest.mark.slow
@pytest.mark.parametrize("command", WORKING)
def test_sigterm_ends_a_command_in_one_line(command, words):
    process = begun(words(command))
    status = Path(f"/proc/{process.pid}/status")
    while process.poll() is None and not int(status.read_text().split("SigCgt:")[1].split()[0], 16) >> 14 & 1:
        time.sleep(0.01)
    process.terminate()
    _, said = process.communicate(timeout=120)
    assert process.returncode in (0, 130), said
    assert said.count("\n") == (process.returncode == 130)


def test_an_interrupt_in_a_callback_is_not_lost():
    """Python drops what a weak reference's callback raises, and so a signal that comes while one runs."""
    program = """
import os, signal, time, weakref
import caryatid.cli as cli

class Thing: pass

def main():
    thing = Thing()
    watch = weakref.ref(thing, lambda _: os.kill(os.getpid(), signal.SIGTERM) or [n for n in range(9)])
    try:
        del thing
        time.sleep(30)
    except KeyboardInterrupt:
        return 130
    return 0

cli.main = main
cli.run_from_shell()
"""
    ended = subprocess.run([sys.executable, "-c", program], stderr=subprocess.PIPE, text=True, timeout=60)
    assert (ended.returncode, ended.stderr) == (130, "")


def test_a_system_without_posix_signals_is_refused_in_one_sentence():
    program = "import signal; del signal.SIGALRM; import caryatid.cli as cli; cli.run_from_shell()"
    ended = subprocess.run([sys.executable, "-c", program], stderr=subprocess.PIPE, text=True, timeout=60)
    assert ended.returncode == 1
    assert ended.stderr == "error: caryatid: this system has no POSIX signals; on Windows, run it in WSL\n"


# Colours, and what moves


class Stream(io.StringIO):
    """A stream that is a terminal, or not."""

    def __init__(self, terminal):
        super().__init__()
        self.isatty = lambda: terminal


@pytest.fixture
def said_on(monkeypatch):
    """What a command writes to stdout and stderr where these are terminals, or not."""

    def said(words, *, out, err, **environment):
        with monkeypatch.context() as patched:
            for name in ("NO_COLOR", "FORCE_COLOR"):
                patched.delenv(name, raising=False)
            for name, value in ({"TERM": "xterm-256color"} | environment).items():
                patched.setenv(name, value)
            streams = Stream(out), Stream(err)
            patched.setattr(sys, "stdout", streams[0])
            patched.setattr(sys, "stderr", streams[1])
            run_command(*words)
        return streams[0].getvalue(), streams[1].getvalue()

    return said


COLOUR = re.compile(r"\x1b\[(?:\d+;)*[349]\d")


@pytest.mark.parametrize("words", ["explore nowhere --out", "explore tower --fusion k --out", "order --x"])
def test_errors_are_coloured_on_a_terminal_unless_no_color_is_set(words, said_on, tmp_path):
    spelled = [*words.split(), *([tmp_path / "run"] if words.endswith("--out") else [])]
    assert COLOUR.search(said_on(spelled, out=True, err=True)[1]) or "nowhere" in words
    for quiet in ({"NO_COLOR": "1"}, {"TERM": "dumb"}):
        assert not COLOUR.search(said_on(spelled, out=True, err=True, **quiet)[1])
    assert ESCAPE not in said_on(spelled, out=True, err=False)[1]
    assert ESCAPE not in said_on(spelled, out=False, err=False)[1]


@pytest.mark.slow
def test_help_and_tables_are_plain_in_a_pipe(kept_run, said_on):
    for words in (["--help"], ["order", "--help"], ["order", kept_run, *QUICK]):
        assert ESCAPE in "".join(said_on(words, out=True, err=True))
        out, err = said_on(words, out=False, err=False)
        assert out
        assert ESCAPE not in out + err
        assert not COLOUR.search("".join(said_on(words, out=True, err=True, NO_COLOR="1")))


@pytest.mark.slow
def test_a_spinner_turns_on_a_terminal_only(kept_run, said_on):
    words = ["order", kept_run, *QUICK]
    assert "rehearsing" in said_on(words, out=False, err=True)[1]
    assert said_on(words, out=True, err=False)[1] == ""
    assert said_on(words, out=True, err=False, FORCE_COLOR="1")[1] == ""
    assert said_on(words, out=False, err=True, TERM="dumb")[1] == ""
    assert said_on([*words, "--quiet"], out=False, err=True)[1] == ""


# Errors


@pytest.mark.parametrize(
    "error", [InputError("scene.xml", "is broken", "give another"), PerceptionError("nothing is seen")]
)
def test_an_error_crosses_processes_as_it_is(error):
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is type(error)
    assert (vars(copy), str(copy)) == (vars(error), str(error))


def test_a_failure_is_one_line():
    assert in_one_line(InputError("a.xml", "is\nbroken")) == "a.xml: is broken"
    assert in_one_line(FileNotFoundError(2, "No such file", "a.xml")) == "a.xml: no such file"
    assert "ZeroDivisionError" in in_one_line(ZeroDivisionError("by zero"))
