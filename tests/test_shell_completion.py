"""`caryatid completion`: what a shell offers where the user presses Tab."""

from __future__ import annotations

import shutil
import subprocess
from typing import get_args

import pytest
from conftest import run_command

from caryatid.benchmark.suites import SUITES
from caryatid.cli.commands import COMMANDS, SuiteName
from caryatid.planning.planners import BUILT_IN

pytestmark = pytest.mark.slow

BASH = """
source "$1"; shift
COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1))
_tyro_caryatid || exit 1
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.fixture
def offered(tmp_path, capsys):
    """What bash offers for the last of some words, in a folder of two files."""
    assert run_command("completion", "bash") == 0
    script = tmp_path / "completion"
    script.write_text(capsys.readouterr().out)
    folder = tmp_path / "here"
    (folder / "recording").mkdir(parents=True)
    (folder / "table.pcd").touch()

    def offer(*words):
        command = ["bash", "--norc", "-c", BASH, "bash", script, "caryatid", *words]
        done = subprocess.run(command, capture_output=True, text=True, cwd=folder, timeout=60, check=True)
        return set(done.stdout.split())

    return offer


def test_commands_options_values_and_files_are_completed(offered):
    assert offered("") >= set(COMMANDS)
    assert offered("ex") == {"explore", "extract", "export"}
    assert offered("session", "") >= {"new", "add", "next", "graph", "undo"}
    assert offered("explore", "tower", "--no") == {"--noise", "--no-early-stop", "--no-report"}
    assert offered("explore", "tower", "--fusion", "") == {"pc", "sg", "pc+sg"}
    assert offered("explore", "tower", "--planner", "") >= {*BUILT_IN, "oracle"}
    assert offered("benchmark", "--suite", "") >= {"smoke", "fig5", "planners"}
    formats = {"mjcf", "urdf", "usd", "gltf", "moveit", "dot"}
    assert offered("export", "run", "--format", "") == formats
    assert "table.pcd" in offered("explore", "x", "--out", "ta")
    assert offered("extract", "tab") == {"table.pcd"}
    assert offered("order", "rec") == {"recording"}
    assert offered("explore", "t") == offered("view", "t") == {"tower"}
    assert offered("explore", "tower", "--set", "fit.h") == {"fit.hypotheses="}
    assert offered("session", "new", "s", "--set", "export.") == {
        f"export.{name}=" for name in ("corners", "density", "frame", "friction")
    }


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish", "tcsh"])
def test_every_shell_gets_a_script_it_can_read(shell, tmp_path, capsys):
    assert run_command("completion", shell) == 0
    text = capsys.readouterr().out
    assert all(name in text for name in COMMANDS)
    if shutil.which(shell):
        (tmp_path / "script").write_text(text)
        command = [shell, "-n", tmp_path / "script"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        assert (done.returncode, done.stderr) == (0, "")


def test_the_suites_are_those_of_the_benchmark():
    assert tuple(SUITES) == get_args(SuiteName)
