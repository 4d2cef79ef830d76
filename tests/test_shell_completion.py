"""`caryatid completion`: what a shell offers where the user presses Tab."""

from __future__ import annotations

import json
import shutil
import subprocess

import pytest
from conftest import run_command

from caryatid import cli
from caryatid.planning.planners import BUILT_IN

SHELLS = ("bash", "zsh", "fish", "tcsh")

BASH = """
source "$1"; shift
COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1))
_shtab_caryatid || exit 1
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.fixture(scope="module")
def script(tmp_path_factory):
    """The script for a shell, as a file."""
    folder = tmp_path_factory.mktemp("completion")

    def write(shell):
        path = folder / shell
        if not path.exists():
            from caryatid.cli.completing import completion_script

            path.write_text(completion_script(shell))
        return path

    return write


@pytest.fixture
def offered(script, tmp_path):
    """What bash offers for the last of some words, in a folder of two files."""
    (tmp_path / "recording").mkdir()
    (tmp_path / "table.pcd").touch()

    def offer(*words):
        done = subprocess.run(
            ["bash", "--norc", "-c", BASH, "bash", script("bash"), "caryatid", *words],
            capture_output=True,
            text=True,
            cwd=tmp_path,
            timeout=60,
            check=True,
        )
        assert done.stderr == ""
        return set(done.stdout.split())

    return offer


def test_commands_and_their_steps_are_completed(offered):
    assert offered("") == set(cli.commands())
    assert offered("ex") == {"explore", "extract", "export"}
    assert offered("session", "") == {"new", "add", "next", "graph", "undo"}


def test_options_are_those_of_the_command(offered):
    assert offered("explore", "tower", "--no") == {"--noise", "--no-early-stop", "--no-report"}
    assert offered("order", "run", "--go") == {"--goal"}
    assert offered("session", "add", "table", "--de") == {"--depth", "--debug"}
    assert offered("order", "run", "--planner") == set()


@pytest.mark.parametrize(
    ("words", "values"),
    [
        ("explore tower --fusion", {"pc", "sg", "pc+sg"}),
        ("explore tower --segmentation", {"labels", "auto"}),
        ("dismantle tower --noise", {"none", "carmine"}),
        ("dismantle tower --hands", {"1", "2"}),
        ("explore tower --planner", {*BUILT_IN, "oracle"}),
        ("benchmark --planner support --planner", {*BUILT_IN, "oracle"}),
        ("benchmark --suite", {"smoke", "fig5", "planners", "full"}),
        ("export run --format", {"mjcf", "urdf", "gltf", "graphml", "dot"}),
        ("demo --scene", {"tower", "bridge", "clutter"}),
        ("completion", set(SHELLS)),
    ],
)
def test_values_of_options_are_completed(offered, words, values):
    found = offered(*words.split(), "")
    assert values <= found
    assert "None" not in found
    assert "table.pcd" not in found


@pytest.mark.parametrize(
    "words",
    ["extract", "order", "evaluate run", "serve", "session new", "explore x --out", "config --config"],
)
def test_files_are_completed_where_files_are_meant(offered, words):
    assert offered(*words.split(), "") == {"recording", "table.pcd"}
    assert offered(*words.split(), "ta") == {"table.pcd"}


def test_where_a_scene_is_meant_names_and_files_are_completed(offered):
    assert offered("explore", "t") == {"tower", "table.pcd"}
    assert offered("explore", "--noise", "carmine", "re") == {"recording"}
    assert offered("benchmark", "--scenes", "to") == {"tower"}


@pytest.mark.parametrize("shell", SHELLS)
def test_the_script_is_what_the_shell_reads(script, shell, capsys):
    assert run_command("completion", shell) == 0
    text = capsys.readouterr().out
    assert text == script(shell).read_text()
    assert all(name in text for name in (*cli.commands(), "occlusion-aware", "clutter"))
    assert run_command("completion", shell, "--json") == 0
    assert json.loads(capsys.readouterr().out) == {"shell": shell, "script": text}
    if shutil.which(shell):
        done = subprocess.run(
            [shell, "-n", script(shell)], capture_output=True, text=True, timeout=60, check=False
        )
        assert (done.returncode, done.stderr) == (0, "")


def test_a_shell_that_is_not_known_is_a_usage_error(capsys):
    assert run_command("completion", "sh") == 2
    assert "bash" in capsys.readouterr().err
